//! Recordings: the messages of the services as an MCAP file, and back.
//!
//! Every message is a JSON object with a JSON schema, so that Foxglove and other robotics tools can read it. Its field `bytes` contains the
//! message from shared memory in hexadecimal, so that a replay is identical bit for bit. Numbers beyond JavaScript's range (epochs,
//! sources) are hexadecimal texts. Attachments contain the daemon's moments: the map in use, and the narration from before the recording
//! ([`crate::moment`]). This is the profile [`Profile::Roomcast`], the only one that can be read back. [`ros2`] writes recordings for
//! programs of ROS 2.

mod chunks;
pub mod ros2;
mod tape;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{Attachment, McapError};
use roomcast_ipc::raw::{
    ByteImage, DecisionV1, ForecastV1, Layout, Message, NarrationV1, PersonForecastsV1, PersonScoresV1, PersonV1,
    RobotReportV1, RoomScoresV1, person_flags, presence,
};
use roomcast_ipc::{Presence, Sender};
use roomcast_ros2::types::CdrError;
use serde_json::{Value, json};

use self::chunks::TooMuch;
pub use self::tape::Received;
use self::tape::{Form, Tape};
use crate::config::IntakeLimits;
use crate::daemon::{Intake, Taken};
use crate::habits_reason::PersonHabits;
use crate::moment::Moment;
use roomcast_core::ids::{BootNs, PersonId};
use roomcast_core::narration::{Event, Observation, Sentence, person_number, same_name};
use roomcast_core::text::read_at_most;

/// Largest recording, also with its records unpacked: a reader holds it in memory.
pub const FILE_BYTES_MAX: u64 = 4 << 30;
/// Largest record and largest unpacked chunk: a file's stated lengths allocate no more than this.
pub const RECORD_BYTES_MAX: usize = 64 << 20;

const EVENTS_BETWEEN_LOOKS: u64 = 256;

const MOMENT_FILES: &str = "moment-";

roomcast_core::choices! {
    /// The readers of a recording.
    #[derive(Default)]
    pub enum Profile {
        /// For `replay`, `explain` and `view`: every message bit for bit, as JSON with schemas.
        #[default]
        Roomcast,
        /// For `ros2 bag` and other programs of ROS 2: standard messages in CDR.
        Ros2,
    }
}

/// A recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The file cannot be opened or read.
    #[error("failed to use the recording {path}: {source}; check the path and its permissions")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file cannot be written to its end.
    #[error(
        "failed to write the recording {path}: {source}; make room on its disk, or record elsewhere. Of what was written up to then `mcap recover` makes a whole recording"
    )]
    Write {
        /// The file.
        path: PathBuf,
        /// The error of the system or the writer.
        source: std::io::Error,
    },
    /// The file exists, and is not overwritten.
    #[error("the recording {path} exists already; choose another name, or move it away")]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The file is larger than [`FILE_BYTES_MAX`].
    #[error(
        "the recording {path} has more than {FILE_BYTES_MAX} bytes, unpacked: record fewer seconds at a time (--seconds)"
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
    },
    /// A chunk is larger than [`RECORD_BYTES_MAX`].
    #[error(
        "the recording {path} has a chunk of {bytes} bytes, unpacked, and at most {RECORD_BYTES_MAX} are read: write it again with smaller chunks, for instance with `mcap filter --chunk-size`"
    )]
    Chunk {
        /// The file.
        path: PathBuf,
        /// The claimed size, in bytes.
        bytes: u64,
    },
    /// A stop was requested before the recording was read.
    #[error("stopped before the recording {path} was read")]
    Stopped {
        /// The file.
        path: PathBuf,
    },
    /// The file is not a valid MCAP file.
    #[error("the recording {path} is damaged or no MCAP file: {source}; `mcap recover` saves what can be saved")]
    Mcap {
        /// The file.
        path: PathBuf,
        /// The reader's error.
        source: Box<McapError>,
    },
    /// The file was written for other programs.
    #[error(
        "the recording {path} has the profile {profile:?}, and only those of the profile \"roomcast\" are read: record without --profile"
    )]
    Profile {
        /// The file.
        path: PathBuf,
        /// Its profile.
        profile: String,
    },
    /// A message is longer than CDR allows.
    #[error("failed to write a message of the topic {topic}: {source}")]
    Cdr {
        /// The topic.
        topic: String,
        /// The serialiser's error.
        source: CdrError,
    },
    /// A message in it is not one of Roomcast's.
    #[error(
        "message {index} of the recording {path}, on {topic}: {reason}; it was written by another program or damaged"
    )]
    Message {
        /// The file.
        path: PathBuf,
        /// The message's index, from 0.
        index: usize,
        /// The service.
        topic: String,
        /// The fault.
        reason: String,
    },
}

/// A message of any publish-subscribe service.
#[derive(Debug, Clone, PartialEq)]
pub enum Recorded {
    /// Narration.
    Narration(Box<NarrationV1>),
    /// Room scores.
    RoomScores(Box<RoomScoresV1>),
    /// The scores for each person.
    PersonScores(Box<PersonScoresV1>),
    /// Forecast.
    Forecast(Box<ForecastV1>),
    /// The forecast for each person.
    PersonForecasts(Box<PersonForecastsV1>),
    /// Decision.
    Decision(Box<DecisionV1>),
    /// Robot's report.
    RobotReport(Box<RobotReportV1>),
}

impl Recorded {
    /// The service of the message.
    #[must_use]
    pub fn topic(&self) -> &'static str {
        match self {
            Self::Narration(_) => NarrationV1::SERVICE.name,
            Self::RoomScores(_) => RoomScoresV1::SERVICE.name,
            Self::PersonScores(_) => PersonScoresV1::SERVICE.name,
            Self::Forecast(_) => ForecastV1::SERVICE.name,
            Self::PersonForecasts(_) => PersonForecastsV1::SERVICE.name,
            Self::Decision(_) => DecisionV1::SERVICE.name,
            Self::RobotReport(_) => RobotReportV1::SERVICE.name,
        }
    }

    /// The message's bytes as in shared memory.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        match self {
            Self::Narration(message) => message.to_bytes(),
            Self::RoomScores(message) => message.to_bytes(),
            Self::PersonScores(message) => message.to_bytes(),
            Self::Forecast(message) => message.to_bytes(),
            Self::PersonForecasts(message) => message.to_bytes(),
            Self::Decision(message) => message.to_bytes(),
            Self::RobotReport(message) => message.to_bytes(),
        }
    }

    fn readable(&self) -> Value {
        match self {
            Self::Narration(message) => json!({
                "source": message.source_name(), "person": message.person, "person_name": message.person_name(),
                "kind": message.kind, "text": message.text(),
                "epoch": format!("{:016x}", message.epoch), "sequence": message.sequence,
                "observed": time(message.observed_unix_ns),
            }),
            Self::RoomScores(message) => json!({
                "epoch": format!("{:016x}", message.epoch), "sequence": message.sequence,
                "computed": time(message.computed_unix_ns), "label_mass": message.label_mass, "flags": message.flags,
                "rooms": message.rooms().iter().map(|room| json!({
                    "id": room.id(), "probability": room.probability, "log_score_nats": finite(room.log_score_nats),
                })).collect::<Vec<_>>(),
                "timing_ns": {"wait": message.wait_ns, "tokenise": message.tokenise_ns, "prefix": message.prefix_ns,
                    "trie": message.trie_ns, "ground": message.ground_ns},
                "model": hex::encode(message.model_fingerprint), "map": hex::encode(message.map_fingerprint),
            }),
            Self::PersonScores(message) => json!({
                "epoch": format!("{:016x}", message.epoch), "sequence": message.sequence, "persons": message.persons,
                "person": message.persons().iter().map(|person| json!({
                    "person": person.person, "name": person.name(), "presence": Presence::of(person.presence).word(),
                    "since_ns": person.since_ns, "elsewhere": person.elsewhere, "flags": person.flags,
                    "label_mass": person.label_mass,
                    "rooms": message.probabilities(person).zip(person.log_score_nats).map(|((id, probability), nats)| json!({
                        "id": id, "probability": probability, "log_score_nats": finite(nats),
                    })).collect::<Vec<_>>(),
                })).collect::<Vec<_>>(),
                "map": hex::encode(message.map_fingerprint),
            }),
            Self::Forecast(message) => json!({
                "epoch": format!("{:016x}", message.epoch), "sequence": message.sequence,
                "flags": message.flags, "horizon_s": message.horizon_s.get(..message.horizon_count as usize),
                "elsewhere": message.elsewhere.get(..message.horizon_count as usize),
                "rooms": (0..message.room_count as usize).filter_map(|index| message.room(index)).map(|(id, row)| json!({
                    "id": id, "probability": row,
                })).collect::<Vec<_>>(),
            }),
            Self::PersonForecasts(message) => json!({
                "epoch": format!("{:016x}", message.epoch), "sequence": message.sequence, "persons": message.persons,
                "horizon_s": message.horizons_s(),
                "person": message.persons().iter().map(|person| json!({
                    "person": person.person, "name": person.name(), "presence": Presence::of(person.presence).word(),
                    "flags": person.flags, "elsewhere": person.elsewhere.get(..message.horizon_count as usize),
                    "rooms": message.rooms().zip(&person.probability).map(|(id, row)| json!({
                        "id": id, "probability": row.get(..message.horizon_count as usize),
                    })).collect::<Vec<_>>(),
                })).collect::<Vec<_>>(),
            }),
            Self::Decision(message) => json!({
                "robot": format!("{:016x}", message.robot), "robot_name": message.robot_name(), "from": message.from(), "to": message.to(),
                "policy": message.policy(), "reason": message.reason(), "probability": message.probability,
                "stay_s": message.stay_ns as f64 / 1e9, "flags": message.flags, "sequence": message.sequence,
                "scores_sequence": message.scores_sequence, "decided": time(message.decided_unix_ns),
                "action": message.action, "cancels": message.cancels,
            }),
            Self::RobotReport(message) => json!({
                "robot": format!("{:016x}", message.robot), "robot_name": message.robot_name(), "kind": message.kind,
                "room": message.room(), "position_m": message.position_m(), "battery": message.battery(), "note": message.note(),
                "decision_sequence": message.decision_sequence, "epoch": format!("{:016x}", message.epoch),
                "sequence": message.sequence, "reported": time(message.reported_unix_ns),
            }),
        }
    }

    fn sequence(&self) -> u64 {
        match self {
            Self::Narration(message) => message.sequence,
            Self::RoomScores(message) => message.sequence,
            Self::PersonScores(message) => message.sequence,
            Self::Forecast(message) => message.sequence,
            Self::PersonForecasts(message) => message.sequence,
            Self::Decision(message) => message.sequence,
            Self::RobotReport(message) => message.sequence,
        }
    }

    fn decode(topic: &str, bytes: &[u8]) -> Result<Self, String> {
        fn message<M: Message + ByteImage>(bytes: &[u8]) -> Result<Box<M>, String> {
            let message =
                M::from_bytes(bytes).ok_or_else(|| format!("{} bytes are no {}", bytes.len(), M::TYPE_NAME))?;
            message.check().map_err(|error| error.to_string())?;
            Ok(Box::new(message))
        }
        Ok(match topic {
            topic if topic == NarrationV1::SERVICE.name => Self::Narration(message(bytes)?),
            topic if topic == RoomScoresV1::SERVICE.name => Self::RoomScores(message(bytes)?),
            topic if topic == PersonScoresV1::SERVICE.name => Self::PersonScores(message(bytes)?),
            topic if topic == ForecastV1::SERVICE.name => Self::Forecast(message(bytes)?),
            topic if topic == PersonForecastsV1::SERVICE.name => Self::PersonForecasts(message(bytes)?),
            topic if topic == DecisionV1::SERVICE.name => Self::Decision(message(bytes)?),
            topic if topic == RobotReportV1::SERVICE.name => Self::RobotReport(message(bytes)?),
            other => return Err(format!("the service {other:?} is unknown")),
        })
    }
}

/// A time in Foxglove's form.
fn time(unix_ns: u64) -> Value {
    json!({"sec": unix_ns / 1_000_000_000, "nsec": unix_ns % 1_000_000_000})
}

/// JSON has no infinity: a room without items has no score.
fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

fn schemas() -> [(&'static str, &'static str, Value); 7] {
    let object = |title: &str, properties: Value| {
        let mut properties = properties;
        properties["bytes"] = json!({"type": "string", "description": "the message as in shared memory, hexadecimal"});
        json!({"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, "type": "object", "properties": properties})
    };
    let (text, integer, number) = (json!({"type": "string"}), json!({"type": "integer"}), json!({"type": "number"}));
    let point = json!({"type": "object", "title": "time", "properties": {"sec": integer, "nsec": integer}});
    let room = json!({"type": "array", "items": {"type": "object", "properties":
        {"id": text, "probability": number, "log_score_nats": {"type": ["number", "null"]}}}});
    let numbers = json!({"type": "array", "items": number});
    let timing = json!({"type": "object", "properties":
        {"wait": integer, "tokenise": integer, "prefix": integer, "trie": integer, "ground": integer}});
    let course =
        json!({"type": "array", "items": {"type": "object", "properties": {"id": text, "probability": numbers}}});
    [
        (
            NarrationV1::SERVICE.name,
            NarrationV1::TYPE_NAME,
            object(
                NarrationV1::TYPE_NAME,
                json!({
                    "source": text, "person": integer, "person_name": text, "kind": integer, "text": text, "epoch": text, "sequence": integer, "observed": point,
                }),
            ),
        ),
        (
            RoomScoresV1::SERVICE.name,
            RoomScoresV1::TYPE_NAME,
            object(
                RoomScoresV1::TYPE_NAME,
                json!({
                    "epoch": text, "sequence": integer, "computed": point, "label_mass": number, "flags": integer, "rooms": room,
                    "timing_ns": timing, "model": text, "map": text,
                }),
            ),
        ),
        (
            PersonScoresV1::SERVICE.name,
            PersonScoresV1::TYPE_NAME,
            object(
                PersonScoresV1::TYPE_NAME,
                json!({
                    "epoch": text, "sequence": integer, "persons": integer, "map": text,
                    "person": {"type": "array", "items": {"type": "object", "properties":
                        {"person": integer, "name": text, "presence": text, "since_ns": integer, "elsewhere": number,
                            "flags": integer, "label_mass": number, "rooms": room}}},
                }),
            ),
        ),
        (
            ForecastV1::SERVICE.name,
            ForecastV1::TYPE_NAME,
            object(
                ForecastV1::TYPE_NAME,
                json!({
                    "epoch": text, "sequence": integer, "flags": integer, "horizon_s": numbers, "elsewhere": numbers, "rooms": course,
                }),
            ),
        ),
        (
            PersonForecastsV1::SERVICE.name,
            PersonForecastsV1::TYPE_NAME,
            object(
                PersonForecastsV1::TYPE_NAME,
                json!({
                    "epoch": text, "sequence": integer, "persons": integer, "horizon_s": numbers,
                    "person": {"type": "array", "items": {"type": "object", "properties":
                        {"person": integer, "name": text, "presence": text, "flags": integer, "elsewhere": numbers,
                            "rooms": course}}},
                }),
            ),
        ),
        (
            DecisionV1::SERVICE.name,
            DecisionV1::TYPE_NAME,
            object(
                DecisionV1::TYPE_NAME,
                json!({
                    "robot": text, "robot_name": text, "from": text, "to": text, "policy": text, "reason": text, "probability": number,
                    "stay_s": number,
                    "flags": integer, "sequence": integer, "scores_sequence": integer, "decided": point, "action": integer, "cancels": integer,
                }),
            ),
        ),
        (
            RobotReportV1::SERVICE.name,
            RobotReportV1::TYPE_NAME,
            object(
                RobotReportV1::TYPE_NAME,
                json!({
                    "robot": text, "robot_name": text, "kind": integer, "room": text,
                    "position_m": {"type": ["array", "null"], "items": number}, "battery": {"type": ["number", "null"]}, "note": text,
                    "decision_sequence": integer, "epoch": text, "sequence": integer, "reported": point,
                }),
            ),
        ),
    ]
}

/// Writes a recording.
#[expect(missing_debug_implementations, reason = "the writer of mcap has none")]
pub struct Recorder {
    tape: Tape,
    channels: BTreeMap<&'static str, u16>,
}

impl Recorder {
    /// Creates the file; one that exists is not overwritten.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Exists`], [`RecordingError::Io`], [`RecordingError::Write`].
    pub fn create(path: &Path) -> Result<Self, RecordingError> {
        // MCAP's own profiles define the encoding of messages; these have none.
        let mut tape = Tape::create(path, "")?;
        let mut channels = BTreeMap::new();
        for (topic, name, schema) in schemas() {
            let schema = &schema.to_string();
            let (schema_encoding, message_encoding) = ("jsonschema", "json");
            let form = Form { name, schema_encoding, schema, message_encoding, metadata: BTreeMap::new() };
            channels.insert(topic, tape.channel(topic, &form)?);
        }
        Ok(Self { tape, channels })
    }

    /// Appends a message.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Write`].
    pub fn write(&mut self, message: &Recorded, received: Received) -> Result<(), RecordingError> {
        let mut data = message.readable();
        data["bytes"] = hex::encode(message.to_bytes()).into();
        let received_ns = self.tape.time_ns(received);
        let header = MessageHeader {
            channel_id: self.channels[message.topic()],
            // The file's field has 32 bits; the whole number is in the message.
            sequence: message.sequence() as u32,
            log_time: received_ns.0,
            publish_time: received.unix_ns.0,
        };
        self.tape.write(&header, data.to_string().as_bytes())
    }

    /// Writes a daemon's moment (its JSON) as an attachment.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Write`].
    pub fn attach(&mut self, moment: &Moment, received: Received) -> Result<(), RecordingError> {
        let data = serde_json::to_vec(moment).unwrap_or_default();
        let received_ns = self.tape.time_ns(received);
        self.tape.attach(&Attachment {
            log_time: received_ns.0,
            create_time: received_ns.0,
            name: format!("{MOMENT_FILES}{}-{}.json", moment.epoch, moment.sequence),
            media_type: "application/json".to_owned(),
            data: data.into(),
        })
    }

    /// The number of messages written.
    #[must_use]
    pub fn written(&self) -> u64 {
        self.tape.written()
    }

    /// Flushes to the file, so that a crash loses no older messages.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Write`].
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.tape.flush()
    }

    /// Ends the file with its index.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Write`].
    pub fn finish(&mut self) -> Result<(), RecordingError> {
        self.tape.finish()
    }
}

/// A recording: every message with the time of its receipt, in the order of the file, and its moments. The time is in nanoseconds, with the
/// first one in Unix time.
#[derive(Debug, Default)]
pub struct Recording {
    /// The messages.
    pub messages: Vec<(u64, Recorded)>,
    /// The wall clock at the receipt of each message, for hours of the day.
    pub received_unix_ns: Vec<u64>,
    /// The daemon's moments at the start of the recording and after each change of the daemon or its map: the map in use, and the narration
    /// from before the recording.
    pub moments: Vec<Moment>,
    /// The file ends within a record, as after a kill of the recorder: the rest is missing.
    pub is_torn: bool,
}

/// A moment of a recording, as far as the recording contains it.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedMoment {
    /// The scores.
    pub scores: RoomScoresV1,
    /// Seconds from the recording's beginning.
    pub at_s: f64,
    /// The daemon's moment before these scores: the map in use, the binding sequence, the grounding.
    pub base: Option<usize>,
    /// The narration in the scores with its persons, oldest first. For persons in the daemon's messages, it is exactly the window.
    pub narration: Vec<(PersonId, Sentence)>,
    /// Persons with an empty window, and whether they are in the house.
    pub silent: Vec<(PersonId, bool)>,
    /// The names of persons, by number.
    pub names: BTreeMap<PersonId, String>,
    /// The learned habits, by person, as far as the forecasts of the scores contain them.
    pub habits: Vec<PersonHabits>,
}

impl Recording {
    /// The scores with a sequence number (the last of them, if several daemons ran), or the last before `at_s` seconds from the start, or
    /// the last of all; with their narration. `None` without such scores.
    #[must_use]
    pub fn moment(&self, sequence: Option<u64>, at_s: Option<f64>) -> Option<RecordedMoment> {
        let start_ns = self.messages.first().map_or(0, |(time, _)| *time);
        let seconds = |time: u64| time.saturating_sub(start_ns) as f64 / 1e9;
        let (time, scores) = self.messages.iter().rev().find_map(|(time, message)| match message {
            Recorded::RoomScores(scores)
                if sequence.is_none_or(|sequence| scores.sequence == sequence)
                    && at_s.is_none_or(|at_s| seconds(*time) <= at_s) =>
            {
                Some((*time, **scores))
            }
            _ => None,
        })?;
        let (epoch, map) = (format!("{:016x}", scores.epoch), hex::encode(scores.map_fingerprint));
        let of_daemon = |moment: &&Moment| moment.epoch == epoch && moment.sequence <= scores.sequence;
        let base = self.moments.iter().rposition(|moment| moment.map_fingerprint == map && moment.epoch == epoch);
        // The last moment before these scores contains older narration, so the search skips that.
        let known = self.moments.iter().filter(of_daemon).max_by_key(|moment| moment.sequence);
        let mut narration: Vec<(PersonId, Sentence)> = known.map_or_else(Vec::new, |moment| {
            let sentences = moment.narration.iter();
            sentences.filter_map(|read| Some((read.person, Sentence::new(&read.text).ok()?))).collect()
        });
        let already = |message: &NarrationV1| {
            let (source, epoch) = (format!("{:016x}", message.source), format!("{:016x}", message.epoch));
            let included = known.into_iter().flat_map(|moment| &moment.included);
            included.filter(|i| i.source == source && i.epoch == epoch).any(|i| i.sequence >= message.sequence)
        };
        let claimed = |message: &NarrationV1| {
            let mut included = scores.included().iter();
            included.any(|i| (i.source, i.epoch) == (message.source, message.epoch) && message.sequence <= i.sequence)
        };
        let heard = || {
            self.messages.iter().filter_map(|(received, message)| match message {
                Recorded::Narration(message) if !already(message) => Some((&**message, *received)),
                _ => None,
            })
        };
        let told = self.told(&scores);
        let told_of =
            |person: PersonId| told.and_then(|told| told.persons().iter().find(|told| told.person == person.0));
        let window = |person: PersonId| match (told_of(person), scores.persons) {
            (Some(told), _) => Some(told.window as usize),
            (None, 0..=1) => Some(scores.window as usize),
            _ => None,
        };
        // Scores that wait for the journal contain a little more than they claim, and the recording may lack the message with the claim. So
        // narration also counts up to the person's last observation, or, without data on persons, up to the size of the window.
        let unclaimed = heard().filter(|(message, received)| !claimed(message) && *received <= time);
        let claimed = heard().filter(|(message, _)| claimed(message)).map(|(message, _)| (message, true));
        let mut intake = Intake::new(IntakeLimits { rate_per_s: 0.0, burst: 1.0 });
        for (message, is_claimed) in claimed.chain(unclaimed.map(|(message, _)| (message, false))) {
            // The time of an observation stays unchanged, since it is compared with the daemon's data on persons.
            let taken = intake.take(message, Sender::simulated(message.source), BootNs(message.observed_ns));
            let Taken::Accepted { observation, .. } = taken else { continue };
            let last = narration.last().map(|(person, _)| *person);
            let likely = last.or_else(|| match told.map(PersonScoresV1::persons) {
                // Without data on persons there is one person without a name.
                None | Some([]) => Some(PersonId(0)),
                Some([only]) => Some(PersonId(only.person)),
                Some(_) => None,
            });
            // With several persons, an event of an unknown person is left out.
            let person = self.person_of(&observation, scores.epoch);
            let person = person.or_else(|| self.at_start(&observation, scores.epoch)).or(likely);
            let Some(person) = person else { continue };
            let of_person = narration.iter().filter(|(of, _)| *of == person).count();
            let is_contained = match told_of(person) {
                Some(told) => message.observed_ns > 0 && message.observed_ns <= told.observed_ns,
                None => window(person).is_some_and(|window| of_person < window),
            };
            if !is_claimed && !is_contained {
                continue;
            }
            match observation.event {
                Event::Did(sentence) => narration.push((person, sentence)),
                Event::AllAway => narration.clear(),
                // A person who leaves begins a new window.
                Event::Away | Event::Gone => narration.retain(|(of, _)| *of != person),
                Event::Present(_) | Event::Empty(_) | Event::Sensor(_) => {}
            }
        }
        // The daemon's message gives the size of each window: an hour without a sentence ends one, and a person who is gone has none.
        let mut excess: BTreeMap<PersonId, usize> = BTreeMap::new();
        narration.iter().for_each(|(person, _)| *excess.entry(*person).or_default() += 1);
        let all_are_told = told.is_some_and(|told| told.persons <= told.person_count);
        for (person, excess) in &mut excess {
            let window = window(*person).unwrap_or(if all_are_told { 0 } else { usize::MAX });
            *excess = excess.saturating_sub(window);
        }
        narration.retain(|(person, _)| match excess.get_mut(person) {
            Some(excess @ 1..) => {
                *excess -= 1;
                false
            }
            _ => true,
        });
        let mut names = known.map_or_else(BTreeMap::new, |moment| moment.names.clone());
        names.extend(told.into_iter().flat_map(PersonScoresV1::persons).filter_map(|told| {
            let name = told.name();
            (!name.is_empty()).then(|| (PersonId(told.person), name.to_owned()))
        }));
        let silent = told.into_iter().flat_map(PersonScoresV1::persons).filter(|told| told.window == 0);
        let silent = silent.filter(|told| told.presence != presence::GONE);
        let silent = silent.map(|told| (PersonId(told.person), told.presence == presence::PRESENT)).collect();
        let habits = self.forecasts(&scores).map_or_else(Vec::new, PersonHabits::of_published);
        Some(RecordedMoment { scores, at_s: seconds(time), base, narration, silent, names, habits })
    }

    /// Each person's forecast: the first from the scores, or else the last one before them.
    fn forecasts(&self, scores: &RoomScoresV1) -> Option<&PersonForecastsV1> {
        let of_daemon = self.messages.iter().filter_map(|(_, told)| match told {
            Recorded::PersonForecasts(told) if told.epoch == scores.epoch && told.sequence <= scores.sequence => {
                Some(&**told)
            }
            _ => None,
        });
        of_daemon.reduce(|newest, told| if told.sequence > newest.sequence { told } else { newest })
    }

    /// The daemon's person scores with some scores.
    fn told(&self, scores: &RoomScoresV1) -> Option<&PersonScoresV1> {
        self.messages.iter().rev().find_map(|(_, told)| match told {
            Recorded::PersonScores(told) if (told.epoch, told.sequence) == (scores.epoch, scores.sequence) => {
                Some(&**told)
            }
            _ => None,
        })
    }

    /// The person with the published name at the start of a text.
    fn at_start(&self, observation: &Observation, epoch: u64) -> Option<PersonId> {
        let text = observation.sentence()?.to_lowercase();
        self.messages.iter().find_map(|(_, message)| match message {
            Recorded::PersonScores(scores) if scores.epoch == epoch => {
                let is_at_start = |person: &&PersonV1| {
                    let name = person.name().to_lowercase();
                    !name.is_empty() && text.strip_prefix(&name).is_some_and(|rest| rest.starts_with([' ', ',', ':']))
                };
                scores.persons().iter().find(is_at_start).map(|person| PersonId(person.person))
            }
            _ => None,
        })
    }

    /// The person of an observation, by the daemon's messages, which name only the newest one of each person in a step, or by the
    /// observation itself. `None` if neither names a person.
    fn person_of(&self, observation: &Observation, epoch: u64) -> Option<PersonId> {
        let told = |is_theirs: &dyn Fn(&PersonV1) -> bool| {
            self.messages.iter().find_map(|(_, told)| match told {
                Recorded::PersonScores(told) if told.epoch == epoch => {
                    told.persons().iter().find(|person| is_theirs(person)).map(|person| PersonId(person.person))
                }
                _ => None,
            })
        };
        let is_newest =
            |person: &PersonV1| observation.observed_ns > BootNs(0) && person.observed_ns == observation.observed_ns.0;
        match observation.name.as_deref() {
            Some(name) => told(&|person| same_name(person.name(), name))
                .or_else(|| told(&|person| !person.has(person_flags::BY_FIT) && is_newest(person)))
                .or_else(|| Some(person_number(name))),
            None if observation.person == PersonId::SOMEBODY => {
                told(&|person| person.has(person_flags::BY_FIT) && is_newest(person))
            }
            None => Some(observation.person),
        }
    }
}

/// Reads a recording.
///
/// # Errors
///
/// [`RecordingError`], for the first message that is none.
pub fn read(path: &Path) -> Result<Recording, RecordingError> {
    read_until(path, &|| false)
}

/// As [`read`], until a stop is requested.
///
/// # Errors
///
/// As [`read`], and [`RecordingError::Stopped`].
pub fn read_until(path: &Path, is_stopped: &dyn Fn() -> bool) -> Result<Recording, RecordingError> {
    let io = |source| RecordingError::Io { path: path.to_owned(), source };
    let bytes = read_at_most(path, FILE_BYTES_MAX).map_err(io)?;
    decode_until(path, &bytes.ok_or_else(|| RecordingError::TooLarge { path: path.to_owned() })?, is_stopped)
}

/// Reads a recording's bytes; `path` is for errors.
///
/// # Errors
///
/// [`RecordingError`], for the first message that is none.
pub fn decode(path: &Path, bytes: &[u8]) -> Result<Recording, RecordingError> {
    decode_until(path, bytes, &|| false)
}

fn decode_until(path: &Path, bytes: &[u8], is_stopped: &dyn Fn() -> bool) -> Result<Recording, RecordingError> {
    chunks::check(bytes).map_err(|fault| match fault {
        TooMuch::Chunk(bytes) => RecordingError::Chunk { path: path.to_owned(), bytes },
        TooMuch::All => RecordingError::TooLarge { path: path.to_owned() },
    })?;
    let mcap = |source| RecordingError::Mcap { path: path.to_owned(), source: Box::new(source) };
    let wrong = |index, topic: &str, reason| {
        let (path, topic) = (path.to_owned(), topic.to_owned());
        RecordingError::Message { path, index, topic, reason }
    };
    let options = LinearReaderOptions::default().with_record_length_limit(RECORD_BYTES_MAX);
    let mut reader = LinearReader::new_with_options(options.with_validate_chunk_crcs(true));
    let (mut recording, mut topics) = (Recording::default(), BTreeMap::new());
    let (mut rest, mut index, mut unpacked) = (bytes, 0, 0_u64);
    let is_finished = bytes.ends_with(mcap::MAGIC);
    let mut events = 0_u64;
    while let Some(event) = reader.next_event() {
        events += 1;
        if events.is_multiple_of(EVENTS_BETWEEN_LOOKS) && is_stopped() {
            return Err(RecordingError::Stopped { path: path.to_owned() });
        }
        let (opcode, data) = match event {
            Err(_) if !is_finished && index > 0 => {
                recording.is_torn = true;
                break;
            }
            Err(error) => return Err(mcap(error)),
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let (next, later) = rest.split_at(wanted.min(rest.len()));
                reader.insert(next.len()).copy_from_slice(next);
                reader.notify_read(next.len());
                rest = later;
                continue;
            }
            Ok(LinearReadEvent::Record { opcode, data }) => (opcode, data),
        };
        // An empty record also has some bytes.
        unpacked = unpacked.saturating_add(data.len() as u64 + 9);
        if unpacked > FILE_BYTES_MAX {
            return Err(RecordingError::TooLarge { path: path.to_owned() });
        }
        match opcode {
            op::HEADER | op::CHANNEL | op::MESSAGE => match mcap::parse_record(opcode, data).map_err(mcap)? {
                Record::Header(header) if !header.profile.is_empty() => {
                    return Err(RecordingError::Profile { path: path.to_owned(), profile: header.profile });
                }
                Record::Channel(channel) => {
                    topics.insert(channel.id, channel.topic);
                }
                Record::Message { header, data } => {
                    let topic = topics.get(&header.channel_id);
                    let topic = topic.ok_or(McapError::UnknownChannel(header.sequence, header.channel_id));
                    let topic = topic.map_err(mcap)?;
                    let decoded = original(&data).and_then(|bytes| Recorded::decode(topic, &bytes));
                    let decoded = decoded.map_err(|reason| wrong(index, topic, reason))?;
                    recording.messages.push((header.log_time, decoded));
                    recording.received_unix_ns.push(header.publish_time);
                    index += 1;
                }
                _ => {}
            },
            op::ATTACHMENT => {
                let (name, data) = attachment(data).ok_or(McapError::UnexpectedEof).map_err(mcap)?;
                if name.starts_with(MOMENT_FILES) {
                    let moment = Moment::from_json(&String::from_utf8_lossy(data));
                    recording.moments.push(moment.map_err(|error| wrong(0, &name, error.to_string()))?);
                }
            }
            // Schemas, statistics and indexes are not needed.
            _ => {}
        }
    }
    Ok(recording)
}

/// Name and content of an attachment's record, after a check of the checksum. The crate's own reader assumes that the record is complete.
fn attachment(record: &[u8]) -> Option<(String, &[u8])> {
    let (content, checksum) = record.split_last_chunk()?;
    // Two times precede the name.
    let (_times, rest) = content.split_at_checked(16)?;
    let (length, rest) = rest.split_first_chunk()?;
    let (name, rest) = rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)?;
    let (length, rest) = rest.split_first_chunk()?;
    let (_media_type, rest) = rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)?;
    let (length, data) = rest.split_first_chunk()?;
    let whole = u64::from_le_bytes(*length) == data.len() as u64;
    let checksum = u32::from_le_bytes(*checksum);
    (whole && (checksum == 0 || checksum == crc32fast::hash(content)))
        .then(|| (String::from_utf8_lossy(name).into_owned(), data))
}

fn original(data: &[u8]) -> Result<Vec<u8>, String> {
    let value: Value = serde_json::from_slice(data).map_err(|error| error.to_string())?;
    let text = value.get("bytes").and_then(Value::as_str).ok_or("the field \"bytes\" is missing")?;
    hex::decode(text).map_err(|_| "the field \"bytes\" is not hexadecimal".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::ids::UnixNs;
    use roomcast_ipc::raw::IncludedV1;
    use roomcast_ipc::text;

    fn messages() -> Vec<(u64, Recorded)> {
        let mut narration = NarrationV1::new(1, "[Grab] <mug> (1)").unwrap();
        (narration.source, narration.epoch, narration.sequence) = (u64::MAX, u64::MAX - 1, 7);
        let mut scores =
            RoomScoresV1 { epoch: 3, sequence: 1, room_count: 2, label_mass: 0.1 + 0.2, ..Default::default() };
        for (room, id) in scores.room.iter_mut().zip(["kitchen", "bathroom"]) {
            room.id = text::encode("id", id).unwrap();
            room.probability = 0.5;
            room.log_score_nats = f64::NEG_INFINITY;
        }
        let mut persons =
            PersonScoresV1 { epoch: 3, sequence: 1, room_count: 1, persons: 2, person_count: 2, ..Default::default() };
        persons.id[0] = text::encode("id", "kitchen").unwrap();
        for (number, person) in (0..2).zip(&mut persons.person) {
            (person.person, person.probability[0]) = (number, 1.0);
        }
        let mut forecasts =
            PersonForecastsV1 { epoch: 3, room_count: 1, horizon_count: 2, person_count: 1, ..Default::default() };
        forecasts.id[0] = text::encode("id", "kitchen").unwrap();
        forecasts.person[0].name = text::encode("name", "ada").unwrap();
        (forecasts.person[0].probability[0][1], forecasts.person[0].elsewhere[0]) = (0.5, 1.0);
        let to = text::encode("to", "bathroom").unwrap();
        let decision = DecisionV1 { robot: 1, epoch: 2, sequence: 3, to, probability: 0.25, ..Default::default() };
        let report = RobotReportV1 { robot: 1, epoch: 2, sequence: 3, ..Default::default() };
        vec![
            (1_000, Recorded::Narration(Box::new(narration))),
            (2_000, Recorded::RoomScores(Box::new(scores))),
            (2_200, Recorded::PersonScores(Box::new(persons))),
            (2_500, Recorded::Forecast(Box::new(ForecastV1 { room_count: 1, horizon_count: 2, ..Default::default() }))),
            (2_600, Recorded::PersonForecasts(Box::new(forecasts))),
            (3_000, Recorded::Decision(Box::new(decision))),
            (3_100, Recorded::RobotReport(Box::new(report))),
        ]
    }

    /// A time with both clocks equal.
    fn at(ns: u64) -> Received {
        Received { unix_ns: UnixNs(ns), monotonic_ns: BootNs(ns) }
    }

    fn recorded(messages: &[(u64, Recorded)]) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("day.mcap");
        let mut recorder = Recorder::create(&path).unwrap();
        for (time, message) in messages {
            recorder.write(message, at(*time)).unwrap();
        }
        recorder.finish().unwrap();
        (folder, path)
    }

    #[test]
    fn what_was_recorded_comes_back_bit_for_bit() {
        let (_folder, path) = recorded(&messages());
        let back = read(&path).unwrap().messages;
        assert_eq!(back, messages());
        for ((_, a), (_, b)) in back.iter().zip(messages()) {
            assert_eq!(a.to_bytes(), b.to_bytes());
        }
        let summary = mcap::Summary::read(&std::fs::read(&path).unwrap()).unwrap().unwrap();
        assert_eq!(summary.stats.unwrap().message_count, messages().len() as u64);
        assert!(summary.schemas.values().all(|schema| schema.encoding == "jsonschema"));
    }

    /// Scores that waited for the journal claim less than they contain, and a slow recorder may miss the message with the claim.
    #[test]
    fn scores_contain_what_was_heard_before_them_also_where_they_do_not_claim_it() {
        let narration = |sequence: u64, text: &str| {
            let message = NarrationV1::new(roomcast_ipc::raw::narration_kind::SENTENCE, text).unwrap();
            Recorded::Narration(Box::new(NarrationV1 { source: 7, epoch: 1, sequence, ..message }))
        };
        let mut scores =
            RoomScoresV1 { epoch: 3, sequence: 4, window: 2, persons: 1, source_count: 1, ..Default::default() };
        scores.included[0] = IncludedV1 { source: 7, epoch: 1, sequence: 1, ..IncludedV1::default() };
        let messages = vec![
            (10, narration(1, "They open the fridge.")),
            (11, narration(2, "They grab the milk.")),
            (12, Recorded::RoomScores(Box::new(scores))),
            (13, narration(3, "They close the fridge.")),
        ];
        let mut recording = Recording { messages, ..Recording::default() };
        let contained = |recording: &Recording| -> Vec<String> {
            let narration = recording.moment(None, None).unwrap().narration;
            narration.iter().map(|(_, sentence)| sentence.as_str().to_owned()).collect()
        };
        assert_eq!(contained(&recording), ["They open the fridge.", "They grab the milk."]);
        scores.window = 1;
        recording.messages[2].1 = Recorded::RoomScores(Box::new(scores));
        assert_eq!(contained(&recording), ["They open the fridge."]);
        scores.window = 3;
        recording.messages[2].1 = Recorded::RoomScores(Box::new(scores));
        assert_eq!(contained(&recording), ["They open the fridge.", "They grab the milk."]);
    }

    /// Sentences without a name, of two persons in turn: the daemon's messages name the persons.
    #[test]
    fn a_sentence_without_a_person_is_of_whom_the_daemon_says() {
        let (ada, ben) = (person_number("ada"), person_number("ben"));
        let (mut windows, mut messages) = ([0_u64, 0], Vec::new());
        let mut tell = |at: u64, sequence: u64, who: usize, text: &str, name: &str| {
            let message = NarrationV1::new(roomcast_ipc::raw::narration_kind::SENTENCE, text).unwrap();
            let person_name = text::encode("name", name).unwrap();
            let observed_ns = at * 1_000_000_000;
            let person = PersonId::SOMEBODY.0;
            let narration = NarrationV1 { source: 7, epoch: 1, sequence, observed_ns, person, person_name, ..message };
            windows[who] += 1;
            let mut scores =
                RoomScoresV1 { epoch: 3, sequence, window: sequence, source_count: 1, ..Default::default() };
            scores.included[0] = IncludedV1 { source: 7, epoch: 1, sequence, ..IncludedV1::default() };
            let mut persons = PersonScoresV1 { epoch: 3, sequence, ..Default::default() };
            for (of, (number, name)) in [(ada, "ada"), (ben, "ben")].into_iter().enumerate() {
                if windows[of] == 0 {
                    continue;
                }
                let told = &mut persons.person[persons.person_count as usize];
                (told.person, told.name, told.window) = (number.0, text::encode("name", name).unwrap(), windows[of]);
                told.presence = presence::PRESENT;
                told.flags = if of == who && narration.person_name().is_empty() { person_flags::BY_FIT } else { 0 };
                told.observed_ns = if of == who { observed_ns } else { 1 };
                persons.person_count += 1;
            }
            (persons.persons, scores.persons) = (persons.person_count, persons.person_count);
            messages.push((at, Recorded::Narration(Box::new(narration))));
            messages.push((at, Recorded::RoomScores(Box::new(scores))));
            messages.push((at, Recorded::PersonScores(Box::new(persons))));
        };
        tell(1, 1, 0, "They open the fridge.", "ada");
        tell(2, 2, 1, "They take a shower.", "ben");
        tell(3, 3, 0, "They grab the milk.", "");
        tell(4, 4, 1, "They dry themselves with the towel.", "");
        tell(5, 5, 0, "They close the fridge.", "");
        let of = |messages: &[(u64, Recorded)]| -> Vec<(PersonId, String)> {
            let recording = Recording { messages: messages.to_vec(), ..Recording::default() };
            let narration = recording.moment(None, None).unwrap().narration;
            narration.into_iter().map(|(person, sentence)| (person, sentence.as_str().to_owned())).collect()
        };
        let of_whom: Vec<PersonId> = of(&messages).into_iter().map(|(person, _)| person).collect();
        assert_eq!(of_whom, [ada, ben, ada, ben, ada]);
        // The first sentence of all, of a person whom only a sensor has observed: it adds no person 0.
        let first_plain = of(&messages[6..]);
        assert_eq!(first_plain[0], (ada, "They grab the milk.".to_owned()));
        // If the recording lacks the daemon's message and there are several persons, the sentence is left out.
        let is_heard = |at: u64, told: &Recorded| at != 3 || matches!(told, Recorded::Narration(_));
        let unheard = messages[6..].iter().filter(|(at, told)| is_heard(*at, told));
        let texts: Vec<String> = of(&unheard.cloned().collect::<Vec<_>>()).into_iter().map(|(_, text)| text).collect();
        assert_eq!(texts, ["They dry themselves with the towel.", "They close the fridge."]);
    }

    /// Plain sentences of several persons without a window at the start of the recording: each sentence names its person.
    #[test]
    fn a_recording_that_begins_before_anybody_has_a_window_is_explained() {
        let names = ["Anna", "Ben"];
        let mut messages = Vec::new();
        let mut tell = |sequence: u64, texts: &[&str], windows: [u64; 2], presences: [u32; 2], observed: [u64; 2]| {
            for (text, number) in texts.iter().zip(sequence..) {
                let message = NarrationV1::new(roomcast_ipc::raw::narration_kind::SENTENCE, text).unwrap();
                let person = PersonId::SOMEBODY.0;
                let narration = NarrationV1 {
                    source: 7,
                    epoch: 1,
                    sequence: number,
                    observed_ns: number * 1_000_000_000,
                    person,
                    ..message
                };
                messages.push((number, Recorded::Narration(Box::new(narration))));
            }
            let last = sequence + texts.len() as u64 - 1;
            let mut scores =
                RoomScoresV1 { epoch: 3, sequence: last, persons: 2, source_count: 1, ..Default::default() };
            scores.included[0] = IncludedV1 { source: 7, epoch: 1, sequence: last, ..IncludedV1::default() };
            scores.window = windows.iter().sum();
            let mut persons = PersonScoresV1 { epoch: 3, sequence: last, persons: 2, ..Default::default() };
            persons.person_count = 2;
            for (told, at) in persons.person.iter_mut().zip(0..2) {
                (told.person, told.name) = (person_number(names[at]).0, text::encode("name", names[at]).unwrap());
                (told.window, told.presence) = (windows[at], presences[at]);
                told.observed_ns = observed[at] * 1_000_000_000;
            }
            messages.push((last, Recorded::RoomScores(Box::new(scores))));
            messages.push((last, Recorded::PersonScores(Box::new(persons))));
        };
        let (present, away) = (presence::PRESENT, presence::AWAY);
        tell(1, &["Anna opens the fridge."], [1, 0], [present, away], [1, 0]);
        tell(2, &["Ben sits on the sofa."], [1, 1], [present; 2], [1, 2]);
        // Two in one step; the daemon's message names only the newest.
        tell(3, &["Anna grabs the milk.", "Anna pours the milk."], [3, 1], [present; 2], [4, 2]);
        tell(5, &["Ben leaves the house."], [3, 0], [present, away], [4, 5]);
        let (anna, ben) = (person_number("Anna"), person_number("Ben"));
        let of = |messages: &[(u64, Recorded)], sequence: u64| -> Vec<(PersonId, String)> {
            let recording = Recording { messages: messages.to_vec(), ..Recording::default() };
            let narration = recording.moment(Some(sequence), None).unwrap().narration;
            narration.into_iter().map(|(person, sentence)| (person, sentence.as_str().to_owned())).collect()
        };
        let [fridge, sofa, grabs, pours] = [
            (anna, "Anna opens the fridge.".to_owned()),
            (ben, "Ben sits on the sofa.".to_owned()),
            (anna, "Anna grabs the milk.".to_owned()),
            (anna, "Anna pours the milk.".to_owned()),
        ];
        assert_eq!(of(&messages, 4), [fridge.clone(), sofa, grabs.clone(), pours.clone()]);
        assert_eq!(of(&messages, 5), [fridge, grabs, pours]);
    }

    #[test]
    fn a_recording_is_not_overwritten_and_a_damaged_one_is_named() {
        let (_folder, path) = recorded(&messages());
        assert!(matches!(Recorder::create(&path), Err(RecordingError::Exists { .. })));
        std::fs::write(&path, b"no recording").unwrap();
        assert!(matches!(read(&path), Err(RecordingError::Mcap { .. })));
    }

    /// A reader gets everything that was written before the recorder was killed.
    #[test]
    fn a_torn_recording_is_read_as_far_as_it_goes() {
        let (_folder, path) = recorded(&messages());
        let (whole, all) = (std::fs::read(&path).unwrap(), read(&path).unwrap());
        assert!(!all.is_torn);
        let mut torn = 0;
        for length in (0..whole.len()).step_by(31) {
            match decode(&path, &whole[..length]) {
                Ok(part) => {
                    assert!(part.is_torn, "{length}");
                    assert_eq!(part.messages, all.messages[..part.messages.len()], "{length}");
                    torn += 1;
                }
                Err(error) => assert!(matches!(error, RecordingError::Mcap { .. }), "{length}: {error}"),
            }
        }
        assert!(torn > 0);
        // Damage within a complete file is not a torn end.
        let mut damaged = whole.clone();
        damaged[whole.len() / 2] ^= 1;
        assert!(decode(&path, &damaged).map_or(true, |recording| !recording.is_torn));
    }

    /// The wall clock is set ahead, as on a robot that starts in 1970 and finds the network, and back.
    #[test]
    fn a_clock_that_is_set_leaves_a_recording_its_times() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("day.mcap");
        let mut recorder = Recorder::create(&path).unwrap();
        let (hour_ns, now_ns) = (3_600_000_000_000, 1_800_000_000_000_000_000);
        let wall = [hour_ns, hour_ns + 1_000, now_ns, now_ns + 1_000, now_ns - hour_ns, 0, now_ns];
        for ((unix_ns, monotonic_ns), (_, message)) in wall.into_iter().zip((500..).step_by(1_000)).zip(messages()) {
            recorder
                .write(&message, Received { unix_ns: UnixNs(unix_ns), monotonic_ns: BootNs(monotonic_ns) })
                .unwrap();
        }
        recorder.finish().unwrap();
        let times: Vec<u64> = read(&path).unwrap().messages.into_iter().map(|(time, _)| time - hour_ns).collect();
        assert_eq!(times, [0, 1_000, 2_000, 3_000, 4_000, 5_000, 6_000]);
        assert_eq!(read(&path).unwrap().received_unix_ns, wall, "hours of the day are the wall clock's");
    }

    /// Signs are not digits, though numbers may have them.
    #[test]
    fn bytes_are_pairs_of_digits_alone() {
        let bytes = |text: &str| original(json!({"bytes": text}).to_string().as_bytes());
        assert_eq!(bytes("00fF"), Ok(vec![0, 255]));
        for text in ["+f", "f", "0g", "\u{e9}"] {
            assert!(bytes(text).unwrap_err().contains("is not hexadecimal"), "{text}");
        }
    }

    #[test]
    fn a_message_of_another_program_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("other.mcap");
        let mut recorder = Recorder::create(&path).unwrap();
        let header = MessageHeader {
            channel_id: recorder.channels[NarrationV1::SERVICE.name],
            sequence: 0,
            log_time: 0,
            publish_time: 0,
        };
        recorder.tape.write(&header, br#"{"bytes": "00ff"}"#).unwrap();
        recorder.finish().unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("2 bytes are no roomcast.NarrationV1"), "{error}");
    }

    /// This many zeros, packed as blocks of zstd that repeat a byte.
    fn packed_zeros(count: usize) -> Vec<u8> {
        const BLOCK: usize = 128 << 10;
        let mut packed = vec![0x28, 0xb5, 0x2f, 0xfd, 0, 0x50];
        for begun in (0..count).step_by(BLOCK) {
            let block = (count - begun).min(BLOCK);
            let head = (block << 3) | (1 << 1) | usize::from(begun + block == count);
            packed.extend_from_slice(&head.to_le_bytes()[..3]);
            packed.push(0);
        }
        packed
    }

    /// 6 MB of packed zeros blocked `replay` for ten minutes.
    #[test]
    fn a_recording_of_zeros_is_refused_and_a_stop_ends_the_reading() {
        let zeros = |size: usize, count: usize| {
            let packed = packed_zeros(size);
            let mut bytes = mcap::MAGIC.to_vec();
            for _ in 0..count {
                let sizes = [[0; 16].as_slice(), &(size as u64).to_le_bytes(), &[0; 4], &4_u32.to_le_bytes(), b"zstd"];
                let content = [sizes.concat(), (packed.len() as u64).to_le_bytes().to_vec(), packed.clone()].concat();
                bytes.push(op::CHUNK);
                bytes.extend((content.len() as u64).to_le_bytes());
                bytes.extend(content);
            }
            bytes
        };
        let path = Path::new("zeros.mcap");
        let error = decode(path, &zeros(RECORD_BYTES_MAX + 9, 1)).unwrap_err().to_string();
        assert!(error.contains("has a chunk of 67108873 bytes, unpacked, and at most 67108864 are read"), "{error}");
        let many = zeros(RECORD_BYTES_MAX / 9 * 9, 65);
        assert!(matches!(decode(path, &many), Err(RecordingError::TooLarge { .. })));
        let few = zeros(9_000, 1);
        let stopped = decode_until(path, &few, &|| true);
        assert!(matches!(stopped, Err(RecordingError::Stopped { .. })));
    }

    /// Row "MCAP with a hostile length" of the attacks: every length of a small recording is replaced by impossible ones.
    #[test]
    fn hostile_lengths_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("small.mcap");
        let mut recorder = Recorder::create(&path).unwrap();
        let message =
            NarrationV1 { source: 1, epoch: 1, sequence: 1, ..NarrationV1::new(1, "[Grab] <mug> (1)").unwrap() };
        recorder.write(&Recorded::Narration(Box::new(message)), at(7)).unwrap();
        recorder.finish().unwrap();
        let whole = std::fs::read(&path).unwrap();
        assert_eq!(decode(&path, &whole).unwrap().messages.len(), 1);
        let mut refused = 0;
        for at in 0..whole.len() - 8 {
            for hostile in [u64::MAX, u64::MAX >> 1, 1 << 40, (1 << 32) - 1] {
                let mut bytes = whole.clone();
                bytes[at..at + 8].copy_from_slice(&hostile.to_le_bytes());
                refused += u32::from(decode(&path, &bytes).is_err());
            }
        }
        assert!(refused > 500, "{refused}");
    }
}
