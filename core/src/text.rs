//! Which characters may stand in names and sentences, and files of bounded size.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// What a file holds; none when that is more than `bytes_max`. A device or a pipe has no size, so it is the reading that ends there.
///
/// # Errors
/// When it cannot be read.
pub fn read_at_most(path: &Path, bytes_max: u64) -> io::Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    File::open(path)?.take(bytes_max.saturating_add(1)).read_to_end(&mut bytes)?;
    Ok((bytes.len() as u64 <= bytes_max).then_some(bytes))
}

/// The same as text.
///
/// # Errors
/// As [`read_at_most`], and [`io::ErrorKind::InvalidData`] when it is not UTF-8, [`io::ErrorKind::FileTooLarge`] when it is larger.
pub fn read_text_at_most(path: &Path, bytes_max: u64) -> io::Result<String> {
    let too_large = || io::Error::new(io::ErrorKind::FileTooLarge, format!("it has more than {bytes_max} bytes"));
    let bytes = read_at_most(path, bytes_max)?.ok_or_else(too_large)?;
    String::from_utf8(bytes).map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is not UTF-8"))
}

/// Whether a character has no place in them: control characters, which would reach terminals and logs; and those without a shape of their
/// own, which make text look like other text (directions, zero width, line ends, tags). Messages between processes refuse the same.
#[must_use]
pub fn is_hidden(character: char) -> bool {
    character.is_control()
        || matches!(character,
            '\u{ad}' | '\u{61c}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}'
            | '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}')
}

/// Whether a text has these words next to one another, as whole words; both in lower case.
///
/// ```
/// use roomcast_core::text::has_words;
///
/// assert!(has_words("ben gives ada the mug", "ada") && !has_words("an adaptor", "ada"));
/// ```
#[must_use]
pub fn has_words(text: &str, words: &str) -> bool {
    let is_end = |c: Option<char>| !c.is_some_and(char::is_alphanumeric);
    let mut found = text.match_indices(words);
    !words.is_empty()
        && found
            .any(|(at, _)| is_end(text[..at].chars().next_back()) && is_end(text[at + words.len()..].chars().next()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A device says that it has no bytes, and has no end.
    #[test]
    fn what_has_no_size_is_read_to_its_limit() {
        let device = Path::new("/dev/zero");
        assert_eq!(read_at_most(device, 1000).unwrap(), None);
        assert_eq!(read_text_at_most(device, 1000).unwrap_err().kind(), io::ErrorKind::FileTooLarge);
        assert_eq!(read_at_most(Path::new("/dev/null"), 0).unwrap(), Some(Vec::new()));
    }
}
