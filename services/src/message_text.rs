//! What a narration message says: its text, read as its kind.

use roomcast_core::narration::{Action, DeviceState, Observed, ObservedError, PresenceStatement, Said, Sentence};
use roomcast_ipc::narration_kind;

/// The sentence that a message's text becomes, read as its kind says ([`narration_kind`]): the kind is the narrator's word, so a sentence
/// that looks like an action stays a sentence; a device's state may be told in any words. Narrators ask this before they send, so that
/// they send nothing that the daemon refuses.
///
/// # Errors
/// The text's fault, as that kind.
fn sentence_of(kind: u32, text: &str) -> Result<Sentence, ObservedError> {
    if kind == narration_kind::ACTION {
        return Ok(Observed::Action(Action::parse(text)?).sentence()?);
    }
    if kind == narration_kind::DEVICE
        && let Some(device) = DeviceState::parse(text)
    {
        return Ok(device.sentence()?);
    }
    Ok(Sentence::new(text)?)
}

/// What a message's text says, read as its kind says: presence, or a sentence, which may say in plain words that its person leaves.
///
/// # Errors
/// The text's fault, as that kind.
pub fn said_of(kind: u32, text: &str) -> Result<Said, ObservedError> {
    if kind == narration_kind::PRESENCE {
        return Ok(Said::Presence(PresenceStatement::parse(text)?));
    }
    Ok(Said::of(sentence_of(kind, text)?))
}

#[cfg(test)]
mod tests {
    use roomcast_core::{narration, semantic_map, text};

    use super::*;

    #[test]
    fn the_kind_says_how_a_text_is_read() {
        let said = |kind: u32, text: &str| said_of(kind, text).map(|said| said.to_string());
        assert_eq!(said(narration_kind::PRESENCE, "present in the kitchen").unwrap(), "present in the kitchen");
        assert_eq!(said(narration_kind::SENTENCE, "present in the kitchen").unwrap(), "Present in the kitchen.");
        assert_eq!(said(narration_kind::SENTENCE, "Ada leaves the house.").unwrap(), "away");
        assert_eq!(said(narration_kind::ACTION, "[Grab] <mug> (1)").unwrap(), "They grab the mug.");
        let error = said(narration_kind::PRESENCE, "in the kitchen").unwrap_err().to_string();
        assert!(error.contains("say `present`"), "{error}");
    }

    /// Somebody has one number in messages and in the core, and a name one length.
    #[test]
    fn somebody_is_somebody() {
        assert_eq!(narration::SOMEBODY, roomcast_ipc::ALL_PERSONS);
        assert_eq!(narration::PERSON_NAME_BYTES_MAX, roomcast_ipc::NAME_BYTES);
    }

    /// Row "bidirectional and zero-width labels" of the attacks: what messages refuse, maps and sentences refuse, and no other character.
    #[test]
    fn messages_and_maps_refuse_the_same_characters() {
        for character in (0..=u32::from(char::MAX)).filter_map(char::from_u32) {
            assert_eq!(text::is_hidden(character), roomcast_ipc::text::is_hidden(character), "{character:?}");
        }
    }

    /// Row "1 000 rooms" of the attacks.
    #[test]
    fn a_map_has_no_more_rooms_than_a_message() {
        assert_eq!(semantic_map::MAX_ROOMS, roomcast_ipc::MAX_ROOMS);
    }
}
