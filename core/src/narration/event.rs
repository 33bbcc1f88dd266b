//! The events of the input. Each input becomes one at the boundary of the daemon; no code behind it reads English.

use std::fmt;
use std::sync::Arc;

use super::{SENTENCE_BYTES_MAX, SensorReport, Sentence, TextError, refused};
use crate::text::is_hidden;

/// Whether a person is in the house.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, Hash, strum::IntoStaticStr, serde::Serialize, serde::Deserialize,
)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Presence {
    /// No event of the person yet.
    #[default]
    Unknown,
    /// In the house.
    Present,
    /// Out of the house, and expected back.
    Away,
    /// Out of the house, and not expected back.
    Gone,
}

impl Presence {
    /// Its name in messages and on the command line.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

/// The name of a room as a narrator gives it; the map decides which room it is. Its copies share one text.
#[derive(Debug, Clone, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct RoomName(Arc<str>);

impl RoomName {
    /// A name with a letter or digit, without control characters, of at most half a sentence.
    ///
    /// # Errors
    /// Any other text is refused.
    pub fn new(name: &str) -> Result<Self, TextError> {
        let name = name.trim();
        let name = name.strip_prefix("the ").unwrap_or(name);
        let is_name =
            name.contains(char::is_alphanumeric) && !name.contains(is_hidden) && name.len() <= SENTENCE_BYTES_MAX / 2;
        if is_name && name != "the" { Ok(Self(name.into())) } else { no_presence(name) }
    }

    /// The name.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for RoomName {
    type Error = TextError;

    fn try_from(name: String) -> Result<Self, TextError> {
        Self::new(&name).or_else(|_| refused(format!("{name:?} is no room: give a room's id, name or alias")))
    }
}

impl From<RoomName> for String {
    fn from(name: RoomName) -> Self {
        name.0.as_ref().to_owned()
    }
}

/// What a narrator reports about a person or a room.
#[derive(Debug, Clone, PartialEq, Eq, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum Event {
    /// An action: context for the language model. Its person is in the house.
    Did(Sentence),
    /// A device or program knows that the person is in the house, and perhaps the room.
    Present(Option<RoomName>),
    /// The person is out of the house and expected back.
    Away,
    /// The person has left for good, as a visitor does.
    Gone,
    /// All persons are out of the house.
    #[strum(serialize = "everybody-away")]
    AllAway,
    /// The room has no people in it.
    Empty(RoomName),
    /// A sensor reports its state. Its person may be known, as of a phone.
    Sensor(Arc<SensorReport>),
}

fn no_presence<T>(text: &str) -> Result<T, TextError> {
    let shown: String = text.chars().take(80).collect();
    refused(format!(
        "{shown:?} is no presence: say `present`, `present in the kitchen`, `nobody in the kitchen`, `away`, `everybody away` or `gone`"
    ))
}

impl Event {
    /// Reads a message of the kind presence: the text that [`fmt::Display`] writes for all events but `Did`.
    ///
    /// # Errors
    /// Any other text is refused.
    pub fn presence(text: &str) -> Result<Self, TextError> {
        let room = |room: &str| RoomName::new(room).or_else(|_| no_presence(text));
        match text.trim() {
            json if json.starts_with('{') => match SensorReport::parse(json) {
                Ok(report) => Ok(Self::Sensor(Arc::new(report))),
                Err(fault) => refused(format!("this is no sensor's report: {fault}")),
            },
            "present" => Ok(Self::Present(None)),
            "away" => Ok(Self::Away),
            "gone" => Ok(Self::Gone),
            "everybody away" => Ok(Self::AllAway),
            other => match (other.strip_prefix("present in "), other.strip_prefix("nobody in ")) {
                (Some(name), _) => Ok(Self::Present(Some(room(name)?))),
                (_, Some(name)) => Ok(Self::Empty(room(name)?)),
                (None, None) => no_presence(text),
            },
        }
    }

    /// The sentence for the language model; `None` for a presence.
    #[must_use]
    pub fn sentence(&self) -> Option<&Sentence> {
        if let Self::Did(sentence) = self { Some(sentence) } else { None }
    }

    /// The room that a presence names.
    #[must_use]
    pub fn room(&self) -> Option<&str> {
        match self {
            Self::Present(Some(room)) | Self::Empty(room) => Some(room.as_str()),
            _ => None,
        }
    }

    /// The presence of its person afterwards. An empty room has no person, and a sensor knows none.
    #[must_use]
    pub fn person_presence(&self) -> Presence {
        match self {
            Self::Did(_) | Self::Present(_) => Presence::Present,
            Self::Away | Self::AllAway => Presence::Away,
            Self::Gone => Presence::Gone,
            Self::Empty(_) | Self::Sensor(_) => Presence::Unknown,
        }
    }

    /// Whether its person is known from the event alone: an empty room and an empty house have none.
    #[must_use]
    pub fn has_person(&self) -> bool {
        !matches!(self, Self::AllAway | Self::Empty(_) | Self::Sensor(_))
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Did(sentence) => sentence.fmt(f),
            Self::Present(None) => f.write_str("present"),
            Self::Present(Some(room)) => write!(f, "present in the {}", room.as_str()),
            Self::Away => f.write_str("away"),
            Self::Gone => f.write_str("gone"),
            Self::AllAway => f.write_str("everybody away"),
            Self::Empty(room) => write!(f, "nobody in the {}", room.as_str()),
            Self::Sensor(report) => report.fmt(f),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presences_are_read_as_they_are_written() {
        for text in ["present", "present in the tea kitchen", "away", "gone", "everybody away", "nobody in the hall"] {
            assert_eq!(Event::presence(text).map(|event| event.to_string()).as_deref(), Ok(text));
        }
        for text in "|in the kitchen|present in the|present in the  |nobody in the !|present in a\u{7}b|Away".split('|')
        {
            Event::presence(text).unwrap_err();
        }
        RoomName::new(&"x".repeat(SENTENCE_BYTES_MAX)).unwrap_err();
    }
}
