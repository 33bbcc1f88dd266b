//! The prompt `N_h + B`: narration, then a binding sequence that cues the future. The stable part comes first.
//!
//! The trailing space of a binding sequence moves to the label (`" mug"`), because in training data a word follows its space within one token.

use crate::text::is_hidden;
use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

/// The binding sequence `B`, and whether the narration precedes it.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct BindingSequence {
    name: Cow<'static, str>,
    text: Cow<'static, str>,
    uses_narration: bool,
}

/// Most bytes of a binding sequence.
pub const BINDING_BYTES_MAX: usize = 1024;

/// An unusable binding sequence.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum BindingError {
    /// Only white space.
    #[error(
        "the binding sequence is empty: give words that cue the next object, such as \"Next, they will go to the \""
    )]
    Empty,
    /// Longer than 1024 bytes.
    #[error("the binding sequence has {bytes} bytes, more than {BINDING_BYTES_MAX}: shorten it")]
    TooLong {
        /// Its length in bytes.
        bytes: usize,
    },
    /// Contains a control character.
    #[error("the binding sequence holds the control character {character:?} at byte {at}: remove it")]
    Control {
        /// The character.
        character: char,
        /// Its byte offset.
        at: usize,
    },
}

const EXPENSIVE: &str = "The most expensive object in the world is the ";
const P0: &str = "Next, they will go to the ";

/// The built-in binding sequences: name, text, whether the narration precedes them. `p0` to `p5` are the paper's prompts.
const BUILT_IN: [(&str, &str, bool); 7] = [
    ("default", "Next, the human will go to the ", true),
    ("p0", P0, true),
    ("p1", "The next object they are walking to is the ", true),
    ("p2", "After this, they are going to interact with the ", true),
    ("p3", "The most tasty object in the world is the ", true),
    ("p4", EXPENSIVE, false),
    ("p5", P0, false),
];

impl BindingSequence {
    /// A user's binding sequence.
    ///
    /// # Errors
    /// If it is empty, too long or contains control characters.
    pub fn custom(text: &str) -> Result<Self, BindingError> {
        if text.trim().is_empty() {
            return Err(BindingError::Empty);
        }
        if text.len() > BINDING_BYTES_MAX {
            return Err(BindingError::TooLong { bytes: text.len() });
        }
        if let Some((at, character)) = text.char_indices().find(|(_, c)| is_hidden(*c)) {
            return Err(BindingError::Control { character, at });
        }
        Ok(Self { name: Cow::Borrowed("custom"), text: Cow::Owned(text.to_owned()), uses_narration: true })
    }

    /// The built-in binding sequence with this name: `default`, `p0` to `p5`.
    #[must_use]
    pub fn built_in(name: &str) -> Option<Self> {
        BUILT_IN.iter().find(|(n, ..)| n.eq_ignore_ascii_case(name)).map(|&(name, text, uses_narration)| Self {
            name: Cow::Borrowed(name),
            text: Cow::Borrowed(text),
            uses_narration,
        })
    }

    /// Every built-in binding sequence, in the paper's order after the default.
    pub fn all_built_in() -> impl Iterator<Item = Self> {
        BUILT_IN.iter().filter_map(|(name, ..)| Self::built_in(name))
    }

    /// This binding sequence without narration, for the "no narration" baseline.
    #[must_use]
    pub fn without_narration(mut self) -> Self {
        self.uses_narration = false;
        self
    }

    /// Its name: a built-in one, or `custom`.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its text as given, trailing space included.
    #[must_use]
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Its text without the trailing white space, which moves to the label.
    #[must_use]
    pub fn stem(&self) -> &str {
        self.text.trim_end()
    }

    /// Whether the narration precedes it (false for P4 and P5).
    #[must_use]
    pub fn uses_narration(&self) -> bool {
        self.uses_narration
    }
}

impl Default for BindingSequence {
    fn default() -> Self {
        let (name, text, uses_narration) = BUILT_IN[0];
        Self { name: Cow::Borrowed(name), text: Cow::Borrowed(text), uses_narration }
    }
}

/// Parses a built-in name (`p1`); any other text is a custom binding sequence.
impl FromStr for BindingSequence {
    type Err = BindingError;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        Self::built_in(s).map_or_else(|| Self::custom(s), Ok)
    }
}

impl fmt::Display for BindingSequence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

/// Writes the prompt for `sentences` and `binding` to `out`, which is cleared first: the sentences joined by single spaces, a space, the binding
/// sequence's stem.
pub fn write_prompt<'a>(
    sentences: impl IntoIterator<Item = &'a str>,
    binding: &BindingSequence,
    trailing_space: bool,
    out: &mut String,
) {
    out.clear();
    if binding.uses_narration() {
        for sentence in sentences {
            if sentence.is_empty() {
                continue;
            }
            out.push_str(sentence);
            out.push(' ');
        }
    }
    out.push_str(if trailing_space { binding.text() } else { binding.stem() });
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prompt(binding: &BindingSequence) -> String {
        let mut out = String::from("left over");
        write_prompt(["They walk to the mug.", "They grab the mug."], binding, false, &mut out);
        out
    }

    #[test]
    fn the_narration_stands_before_the_binding() {
        assert_eq!(
            prompt(&BindingSequence::default()),
            "They walk to the mug. They grab the mug. Next, the human will go to the"
        );
    }

    #[test]
    fn p4_and_p5_drop_the_narration() {
        assert_eq!(prompt(&BindingSequence::built_in("P4").unwrap()), "The most expensive object in the world is the");
        assert_eq!(prompt(&"p5".parse().unwrap()), "Next, they will go to the");
    }

    #[test]
    fn a_name_is_built_in_and_other_text_is_custom() {
        assert_eq!("p1".parse::<BindingSequence>().unwrap().name(), "p1");
        let own: BindingSequence = "Then they head for the ".parse().unwrap();
        assert_eq!((own.name(), own.stem()), ("custom", "Then they head for the"));
    }

    #[test]
    fn unusable_bindings_are_named() {
        assert_eq!("  ".parse::<BindingSequence>(), Err(BindingError::Empty));
        assert!(matches!("a\u{7}b".parse::<BindingSequence>(), Err(BindingError::Control { at: 1, .. })));
        assert!(matches!("x".repeat(2000).parse::<BindingSequence>(), Err(BindingError::TooLong { bytes: 2000 })));
    }
}
