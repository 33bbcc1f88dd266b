//! What a narration message says: its text, read as its kind.

use roomcast_core::narration::{Action, DeviceState, Observed, ObservedError, Sentence};
use roomcast_ipc::narration_kind;

/// The sentence that a message's text becomes, read as its kind says ([`narration_kind`]): the kind is the narrator's word, so a sentence
/// that looks like an action stays a sentence; a device's state may be told in any words. Narrators ask this before they send, so that
/// they send nothing that the daemon refuses.
///
/// # Errors
/// The text's fault, as that kind.
pub(crate) fn sentence_of(kind: u32, text: &str) -> Result<Sentence, ObservedError> {
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
