//! Text in messages: UTF-8 in a fixed array, zero padded, without control characters.

use crate::MessageError;

/// Writes `text` into a zeroed array of `N` bytes.
///
/// # Errors
///
/// [`MessageError::TextTooLong`] when it has more than `N` bytes, [`MessageError::ControlCharacter`] when it has one.
///
/// ```
/// let bytes = roomcast_ipc::text::encode::<8>("room", "hall")?;
/// assert_eq!(&bytes, b"hall\0\0\0\0");
/// assert!(roomcast_ipc::text::encode::<8>("room", "living room").is_err());
/// # Ok::<(), roomcast_ipc::MessageError>(())
/// ```
pub fn encode<const N: usize>(field: &'static str, text: &str) -> Result<[u8; N], MessageError> {
    refuse_control_characters(field, text)?;
    let mut bytes = [0; N];
    match bytes.get_mut(..text.len()) {
        Some(head) => head.copy_from_slice(text.as_bytes()),
        None => return Err(MessageError::TextTooLong { field, bytes: text.len(), limit: N }),
    }
    Ok(bytes)
}

/// As [`encode`], for text that may be cut: ends at the last character that fits; control characters become spaces.
#[must_use]
pub fn encode_cut<const N: usize>(text: &str) -> [u8; N] {
    let mut bytes = [0; N];
    let mut end = 0;
    for character in text.chars() {
        let character = if is_hidden(character) { ' ' } else { character };
        match bytes.get_mut(end..end + character.len_utf8()) {
            Some(place) => end += character.encode_utf8(place).len(),
            None => break,
        }
    }
    bytes
}

/// Reads text up to the first zero byte.
///
/// # Errors
///
/// [`MessageError::NotUtf8`], [`MessageError::ControlCharacter`], or [`MessageError::Untidy`] when bytes follow the first zero.
pub fn decode<'a>(field: &'static str, bytes: &'a [u8]) -> Result<&'a str, MessageError> {
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    let (text, tail) = bytes.split_at(end);
    if tail.iter().any(|byte| *byte != 0) {
        return Err(MessageError::Untidy { field });
    }
    let text = std::str::from_utf8(text).map_err(|error| MessageError::NotUtf8 { field, at: error.valid_up_to() })?;
    refuse_control_characters(field, text)?;
    Ok(text)
}

/// As [`decode`] for bytes that were already checked; empty if they are not text.
#[must_use]
pub(crate) fn checked(bytes: &[u8]) -> &str {
    decode("", bytes).unwrap_or("")
}

/// Whether a character must not occur in a sentence or name: control characters, which would reach terminals and logs, and invisible
/// characters, which make text look like other text (directions, zero width, line ends, tags).
#[must_use]
pub fn is_hidden(character: char) -> bool {
    character.is_control()
        || matches!(character,
            '\u{ad}' | '\u{61c}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}'
            | '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}')
}

fn refuse_control_characters(field: &'static str, text: &str) -> Result<(), MessageError> {
    match text.char_indices().find(|(_, character)| is_hidden(*character)) {
        Some((at, character)) => Err(MessageError::ControlCharacter { field, at, code_point: u32::from(character) }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_survives_the_way_through_a_message() {
        for text in ["", "hall", "They walk to the café."] {
            assert_eq!(decode("text", &encode::<64>("text", text).unwrap()).unwrap(), text);
        }
    }

    #[test]
    fn hostile_bytes_are_refused_with_their_place() {
        assert!(matches!(decode("text", &[b'a', 0xff, b'b']), Err(MessageError::NotUtf8 { at: 1, .. })));
        assert!(matches!(
            decode("text", b"a\x1b[2J"),
            Err(MessageError::ControlCharacter { at: 1, code_point: 0x1b, .. })
        ));
        assert!(matches!(decode("text", "a\u{202e}b".as_bytes()), Err(MessageError::ControlCharacter { .. })));
        assert!(matches!(decode("text", b"a\0b"), Err(MessageError::Untidy { .. })));
    }

    #[test]
    fn cut_text_ends_at_a_character() {
        assert_eq!(checked(&encode_cut::<4>("caf\u{e9}")), "caf");
        assert_eq!(checked(&encode_cut::<8>("a\nb")), "a b");
    }
}
