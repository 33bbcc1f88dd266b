//! The JSON messages between narrators and robots. A peer's bytes are untrusted beyond the checks here. Unknown keys, and narrations with unreadable
//! content, are skipped: later versions may add some.

use roomcast_core::narration::line::AHEAD_NS;
pub use roomcast_core::narration::line::{Kind, Who};
use roomcast_ipc::raw::{Message, NarrationV1};
use roomcast_ipc::{sequence, text};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Largest message of a peer in bytes. A narration's text has 1024 bytes, each at most six in JSON.
pub const BYTES_MAX: usize = 8 << 10;

/// A younger event is new.
const NEW_NS: u64 = 1_000_000_000;

/// A 64-bit number as sixteen hexadecimal digits: JSON numbers are exact up to 53 bits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Hex(pub u64);

impl Serialize for Hex {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(&format_args!("{:016x}", self.0))
    }
}

impl<'de> Deserialize<'de> for Hex {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let digits = text.len() == 16 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        let number = if digits { u64::from_str_radix(&text, 16).ok() } else { None };
        number.map(Hex).ok_or_else(|| serde::de::Error::custom("sixteen hexadecimal digits are expected"))
    }
}

/// An observation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Observation {
    /// The text, in the notation of its kind.
    pub text: String,
    /// Its kind.
    #[serde(default, skip_serializing_if = "is_sentence")]
    pub kind: Kind,
    /// The person. For somebody, the daemon finds out the person.
    #[serde(default, skip_serializing_if = "Who::is_somebody")]
    pub person: Who,
    /// The number of persons that the narrator counted; 0 if it counted none.
    #[serde(default, skip_serializing_if = "is_none")]
    pub count: u8,
}

fn is_none(count: &u8) -> bool {
    *count == 0
}

pub(crate) fn is_zero(number: &u64) -> bool {
    *number == 0
}

fn is_sentence(kind: &Kind) -> bool {
    *kind == Kind::Sentence
}

/// Why a message is invalid.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Fault(pub String);

impl Observation {
    /// The message without sender and time. It is checked as the daemon does.
    ///
    /// # Errors
    ///
    /// [`Fault`] with the reason.
    pub fn message(&self) -> Result<NarrationV1, Fault> {
        let fault = |error: &dyn std::fmt::Display| Fault(error.to_string());
        let content = self.text.trim();
        let message = NarrationV1::new(self.kind as u32, content).map_err(|error| fault(&error))?;
        let person_name = text::encode("person", self.person.name()).map_err(|error| fault(&error))?;
        self.kind.event(content).map_err(|error| fault(&error))?;
        Ok(NarrationV1 { person: self.person.number().0, person_name, count: self.count.into(), ..message })
    }
}

/// A narration on its way to a robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Narrated {
    /// Random per start of the narrator; kept in its spool.
    pub epoch: Hex,
    /// 1, 2, 3, ... within the epoch.
    pub sequence: u64,
    /// The first number that the narrator can still send.
    pub first: u64,
    /// The event's age when it was sent.
    pub age_ns: u64,
    /// How far its time lay in the future when the narrator got it: the clock of its input is fast.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub ahead_ns: u64,
    /// When it was sent, by the sender's monotonic clock.
    pub sent_ns: u64,
    /// The id of that clock.
    pub clock: Hex,
    /// The observation.
    #[serde(flatten)]
    pub observation: Observation,
}

/// The number of a narration whose content this version cannot read: a later version may have new kinds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct Numbered {
    /// As in [`Narrated`].
    pub epoch: Hex,
    /// As in [`Narrated`].
    pub sequence: u64,
    /// As in [`Narrated`].
    pub first: u64,
}

/// Reads a peer's message.
///
/// # Errors
///
/// [`Fault`] for too many bytes, and for unexpected JSON.
pub fn read<'de, T: Deserialize<'de>>(bytes: &'de [u8]) -> Result<T, Fault> {
    if bytes.len() > BYTES_MAX {
        return Err(Fault(format!("{} bytes, at most {BYTES_MAX}", bytes.len())));
    }
    serde_json::from_slice(bytes).map_err(|error| Fault(error.to_string()))
}

/// When a message arrived, and its delay.
#[derive(Debug, Clone, Copy)]
pub struct Arrived {
    /// The monotonic clock.
    pub now_ns: u64,
    /// The wall clock.
    pub now_unix_ns: u64,
    /// How long it was delayed.
    pub excess_ns: u64,
}

impl Narrated {
    /// The message for the daemon, in the hub's name and by this machine's clocks.
    ///
    /// # Errors
    ///
    /// [`Fault`] if the daemon would refuse it.
    pub fn message(&self, narrator: &str, arrived: Arrived) -> Result<NarrationV1, Fault> {
        let age_ns = self.age_ns.saturating_add(arrived.excess_ns);
        // The daemon compares both times to measure how fast that clock is. This works only for a new event.
        let ahead_ns = if age_ns < NEW_NS { self.ahead_ns.min(AHEAD_NS) } else { 0 };
        let message = NarrationV1 {
            source: sequence::source_of_name(narrator),
            epoch: self.epoch.0,
            sequence: self.sequence,
            // An event before this machine's start has no monotonic time: 0, by the contract.
            observed_ns: arrived.now_ns.saturating_sub(age_ns).saturating_add(ahead_ns),
            observed_unix_ns: arrived.now_unix_ns.saturating_sub(age_ns).saturating_add(ahead_ns),
            source_name: text::encode_cut(narrator),
            ..self.observation.message()?
        };
        message.check().map_err(|error| Fault(error.to_string()))?;
        Ok(message)
    }
}

/// How far a robot has processed a narrator's narration.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Confirmed {
    /// The narrator's epoch; 0 before the first message.
    pub epoch: Hex,
    /// The expected number; 0 before the first message.
    pub next: u64,
    /// The daemon has processed everything up to this number.
    pub confirmed: u64,
    /// How many of these were not narration, or were dropped by the daemon.
    pub refused: u64,
}

/// A robot's message to a hub about its narration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Said {
    /// The confirmed numbers.
    #[serde(flatten)]
    pub confirmed: Confirmed,
    /// Whether the robot will report how the daemon understood each confirmed event.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub explains: bool,
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::raw::{ALL_PERSONS, narration_kind};

    use super::*;

    const GOOD: &str = r#"{"epoch":"00000000000000ff","sequence":3,"first":1,"age_ns":5,"sent_ns":9,"clock":"0000000000000001","text":"They grab the mug."}"#;
    const ARRIVED: Arrived = Arrived { now_ns: 100, now_unix_ns: 1_000, excess_ns: 10 };

    #[test]
    fn a_narration_is_of_this_machines_clocks() {
        let narrated: Narrated = read(GOOD.as_bytes()).unwrap();
        let message = narrated.message("hall-camera", ARRIVED).unwrap();
        assert_eq!((message.epoch, message.sequence, message.person), (255, 3, ALL_PERSONS));
        assert_eq!((message.observed_ns, message.observed_unix_ns), (85, 985));
        assert_eq!((message.text(), message.source_name()), ("They grab the mug.", "hall-camera"));
        assert_eq!(serde_json::to_string(&narrated).unwrap(), GOOD);
    }

    #[test]
    fn a_fast_clock_is_told_to_the_daemon_while_the_event_is_new() {
        let ahead = GOOD.replace(r#""age_ns":5"#, r#""age_ns":5,"ahead_ns":2000000000"#);
        let times = |arrived| {
            let message = read::<Narrated>(ahead.as_bytes()).unwrap().message("hub", arrived).unwrap();
            (message.observed_ns, message.observed_unix_ns)
        };
        assert_eq!(times(ARRIVED), (2_000_000_085, 2_000_000_985));
        let late = Arrived { now_ns: 9_000_000_000, now_unix_ns: 9_000_000_000, excess_ns: 5_000_000_000 };
        assert_eq!(times(late), (3_999_999_995, 3_999_999_995));
    }

    #[test]
    fn each_kind_is_read_as_the_daemon_reads_it() {
        let with = |more: &str| {
            let narrated: Narrated = read(GOOD.replace("\"text\":\"They grab the mug.\"", more).as_bytes())?;
            narrated.message("hub", ARRIVED)
        };
        assert_eq!(with(r#""text":"[Grab] <mug> (1)","kind":"action""#).unwrap().kind, narration_kind::ACTION);
        assert_eq!(with(r#""text":"away","kind":"presence","person":"Ada""#).unwrap().person_name(), "Ada");
        assert_eq!(with(r#""text":"They sit.","person":7"#).unwrap().person, 7);
        // Digits name a person by number, as in lines for the daemon.
        let numbered = with(r#""text":"They sit.","person":" 7""#).unwrap();
        assert_eq!((numbered.person, numbered.person_name()), (7, ""));
        for bad in [
            r#""text":"[Fly] <mug> (1)","kind":"action""#,
            r#""text":"in the kitchen","kind":"presence""#,
            r#""text":"""#,
            r#""text":"a\u001b[2J""#,
            r#""text":"They sit.","kind":"shout""#,
            r#""text":"They sit.","person":" ""#,
            r#""text":"They sit.","person":-1"#,
            r#""text":"They sit.","person":4294967295"#,
            r#""text":"They sit.","person":"-1""#,
            r#""text":"They sit.","person":"4294967295""#,
            r#""text":"They sit.","person":"me""#,
            r#""text":"They sit.","person":"Nobody""#,
            r#""text":"They sit.","person":"they""#,
            r#""kind":"sentence""#,
        ] {
            with(bad).unwrap_err();
        }
    }

    #[test]
    fn hostile_bytes_are_refused() {
        for bad in
            [b"".as_slice(), b"[", b"\xff\xfe", b"null", b"{}", b"{\"epoch\":7}", &[b'['; 4000], &[b' '; BYTES_MAX + 1]]
        {
            read::<Narrated>(bad).unwrap_err();
            read::<Confirmed>(bad).unwrap_err();
        }
        let zero: Narrated = read(GOOD.replace("00ff", "0000").as_bytes()).unwrap();
        assert!(zero.message("hub", ARRIVED).is_err(), "no epoch is 0");
        let old: Narrated = read(GOOD.replace("\"age_ns\":5", "\"age_ns\":18446744073709551615").as_bytes()).unwrap();
        assert_eq!(old.message("hub", ARRIVED).unwrap().observed_ns, 0);
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_are_taken_without_a_panic(bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..300), text in ".{0,40}") {
            let _read = read::<Narrated>(&bytes);
            for kind in [Kind::Sentence, Kind::Action, Kind::Device, Kind::Presence] {
                let _message = Observation { text: text.clone(), kind, person: Who::Name(text.clone()), count: 0 }.message();
            }
        }
    }
}
