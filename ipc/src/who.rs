//! The person that an event is about.

use crate::IpcError;
use crate::raw::ALL_PERSONS;

/// Words that are no person's name. The daemon drops an event with such a name.
const NO_NAMES: [&str; 21] = [
    "nobody",
    "me",
    "who",
    "they",
    "he",
    "she",
    "i",
    "we",
    "you",
    "somebody",
    "someone",
    "everybody",
    "everyone",
    "all",
    "the whole family",
    "the entire family",
    "the whole household",
    "they all",
    "we all",
    "all of them",
    "all of us",
];

/// The person that an event is about.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Who {
    /// An unknown person: the daemon weighs the event for all persons.
    #[default]
    Somebody,
    /// A person's number.
    Number(u32),
    /// A person's name.
    Name(String),
}

impl From<u32> for Who {
    fn from(number: u32) -> Self {
        Self::Number(number)
    }
}

/// Digits alone are a number, as in JSON lines.
impl From<&str> for Who {
    fn from(text: &str) -> Self {
        let text = text.trim();
        match text.parse() {
            Ok(number) if text.bytes().all(|byte| byte.is_ascii_digit()) => Self::Number(number),
            _ => Self::Name(text.to_owned()),
        }
    }
}

impl From<&String> for Who {
    fn from(text: &String) -> Self {
        text.as_str().into()
    }
}

impl From<Option<&str>> for Who {
    fn from(text: Option<&str>) -> Self {
        text.map_or(Self::Somebody, Self::from)
    }
}

impl Who {
    pub(crate) fn in_message(&self) -> Result<(u32, &str), IpcError> {
        match self {
            Self::Somebody => Ok((ALL_PERSONS, "")),
            Self::Number(number) if *number < ALL_PERSONS => Ok((*number, "")),
            Self::Name(name) if is_name(name) => Ok((ALL_PERSONS, name)),
            other => Err(IpcError::Argument(format!(
                "person {other:?}: give a number from 0 to {}, a name with letters, or Who::Somebody",
                ALL_PERSONS - 1
            ))),
        }
    }
}

fn is_name(name: &str) -> bool {
    let digits = name.trim_start_matches('-');
    let is_number = !digits.is_empty() && digits.chars().all(char::is_numeric);
    name.chars().any(char::is_alphanumeric) && !is_number && !NO_NAMES.contains(&name.to_lowercase().as_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_are_a_number_and_other_text_is_a_name() {
        assert_eq!(Who::from(" 3 "), Who::Number(3));
        assert_eq!(Who::from("Ada"), Who::Name("Ada".to_owned()));
        assert_eq!(Who::from(None), Who::Somebody);
        assert_eq!(Who::from("ada").in_message().unwrap(), (ALL_PERSONS, "ada"));
    }

    #[test]
    fn words_that_name_no_person_are_refused() {
        for who in ["nobody", "Me", "-3", "", "?", "4294967295"] {
            assert!(Who::from(who).in_message().is_err(), "{who}");
        }
    }
}
