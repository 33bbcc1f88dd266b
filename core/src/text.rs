//! Which characters may stand in names and sentences.

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
