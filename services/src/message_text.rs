//! Reads the event of a narration message.

use roomcast_core::narration::line::Kind;
use roomcast_core::narration::{Event, TextError};

/// The event of a message's text, read as its kind ([`roomcast_ipc::raw::narration_kind`]): a presence or an action.
///
/// # Errors
/// The text's fault, as that kind.
pub fn event_of(kind: u32, text: &str) -> Result<Event, TextError> {
    Kind::from_repr(kind).unwrap_or_default().event(text)
}

#[cfg(test)]
mod tests {
    use roomcast_core::ids::PersonId;
    use roomcast_core::{narration, semantic_map, text};
    use roomcast_ipc::raw::narration_kind;

    use super::*;

    #[test]
    fn the_kind_says_how_a_text_is_read() {
        let said = |kind: u32, text: &str| event_of(kind, text).map(|event| event.to_string());
        assert_eq!(said(narration_kind::PRESENCE, "present in the kitchen").unwrap(), "present in the kitchen");
        assert_eq!(said(narration_kind::SENTENCE, "present in the kitchen").unwrap(), "Present in the kitchen.");
        assert_eq!(said(narration_kind::SENTENCE, "Ada leaves the house.").unwrap(), "Ada leaves the house.");
        assert_eq!(said(narration_kind::ACTION, "[Grab] <mug> (1)").unwrap(), "They grab the mug.");
        let error = said(narration_kind::PRESENCE, "in the kitchen").unwrap_err().to_string();
        assert!(error.contains("say `present`"), "{error}");
    }

    /// The core and the messages use the same numbers.
    #[test]
    fn a_kind_is_the_messages_kind() {
        let numbers = [
            (Kind::Sentence, narration_kind::SENTENCE),
            (Kind::Action, narration_kind::ACTION),
            (Kind::Device, narration_kind::DEVICE),
            (Kind::Presence, narration_kind::PRESENCE),
        ];
        for (kind, number) in numbers {
            assert_eq!((kind as u32, Kind::from_repr(number)), (number, Some(kind)));
        }
        assert_eq!(Kind::from_repr(narration_kind::PRESENCE + 1), None);
    }

    /// `SOMEBODY` has the same number in messages and in the core, and the longest name has the same length.
    #[test]
    fn somebody_is_somebody() {
        assert_eq!(PersonId::SOMEBODY, PersonId(roomcast_ipc::raw::ALL_PERSONS));
        assert_eq!(narration::PERSON_NAME_BYTES_MAX, roomcast_ipc::raw::NAME_BYTES);
    }

    /// Row "bidirectional and zero-width labels" of the attacks: messages, maps and sentences reject the same characters.
    #[test]
    fn messages_and_maps_refuse_the_same_characters() {
        for character in (0..=u32::from(char::MAX)).filter_map(char::from_u32) {
            assert_eq!(text::is_hidden(character), roomcast_ipc::text::is_hidden(character), "{character:?}");
        }
    }

    /// Row "1 000 rooms" of the attacks.
    #[test]
    fn a_map_has_no_more_rooms_than_a_message() {
        assert_eq!(semantic_map::MAX_ROOMS, roomcast_ipc::raw::MAX_ROOMS);
    }
}
