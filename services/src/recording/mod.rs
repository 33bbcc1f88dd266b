//! Recordings: the messages of the services as an MCAP file, and back.
//!
//! Every message is a JSON object with a JSON schema, so that Foxglove and other robotics tools can read it. Its field `bytes` contains the
//! message from shared memory in hexadecimal, so that a replay is identical bit for bit. Numbers beyond JavaScript's range (epochs,
//! sources) are hexadecimal texts. One channel has the daemon's moments, the data behind each step's scores ([`crate::moment`]). This is the
//! profile [`Profile::Roomcast`], the only one that can be read back. [`ros2`] writes recordings for programs of ROS 2.

mod chunks;
pub mod ros2;
mod tape;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError};
use roomcast_ipc::raw::{
    ByteImage, DecisionV1, ForecastV1, Message, NarrationV1, PersonForecastsV1, PersonScoresV1, RobotReportV1,
    RoomScoresV1,
};
use roomcast_ipc::{Presence, question};
use roomcast_ros2::types::CdrError;
use serde_json::{Value, json};

use self::chunks::TooMuch;
pub use self::tape::Received;
use self::tape::{Form, Tape};
use crate::moment::Moment;

/// Largest recording, also with its records unpacked: a reader holds it in memory.
pub const FILE_BYTES_MAX: u64 = 4 << 30;
/// Largest record and largest unpacked chunk: a file's stated lengths allocate no more than this.
pub const RECORD_BYTES_MAX: usize = 64 << 20;

const EVENTS_BETWEEN_LOOKS: u64 = 256;

const SCHEMAS: &str = "https://json-schema.org/draft/2020-12/schema";

/// Recordings of version 0.1 have moments as attachments, the first of each daemon and map.
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
    #[error("failed to use the recording {0}: {1}; check the path and its permissions")]
    Io(PathBuf, #[source] std::io::Error),
    /// The file cannot be written to its end.
    #[error(
        "failed to write the recording {0}: {1}; make room on its disk, or record elsewhere. Of what was written up to then `mcap recover` makes a whole recording"
    )]
    Write(PathBuf, #[source] std::io::Error),
    /// The file exists, and is not overwritten.
    #[error("the recording {0} exists already; choose another name, or move it away")]
    Exists(PathBuf),
    /// The file is larger than [`FILE_BYTES_MAX`].
    #[error(
        "the recording {0} has more than {FILE_BYTES_MAX} bytes, unpacked: record fewer seconds at a time (--seconds)"
    )]
    TooLarge(PathBuf),
    /// A chunk is larger than [`RECORD_BYTES_MAX`].
    #[error(
        "the recording {0} has a chunk of {1} bytes, unpacked, and at most {RECORD_BYTES_MAX} are read: write it again with smaller chunks, for instance with `mcap filter --chunk-size`"
    )]
    Chunk(PathBuf, u64),
    /// A stop was requested before the recording was read.
    #[error("stopped before the recording {0} was read")]
    Stopped(PathBuf),
    /// The file is not a valid MCAP file.
    #[error("the recording {0} is damaged or no MCAP file: {1}; `mcap recover` saves what can be saved")]
    Mcap(PathBuf, #[source] Box<McapError>),
    /// The file was written for other programs.
    #[error(
        "the recording {0} has the profile {1:?}, and only those of the profile \"roomcast\" are read: record without --profile"
    )]
    Profile(PathBuf, String),
    /// A message is longer than CDR allows.
    #[error("failed to write a message of the topic {0}: {1}")]
    Cdr(String, #[source] CdrError),
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

/// The enum of all kinds of messages, and the functions that do the same for each kind.
macro_rules! recorded {
    ($($(#[$doc:meta])* $kind:ident($message:ty),)*) => {
        /// A message of any publish-subscribe service.
        #[derive(Debug, Clone, PartialEq)]
        pub enum Recorded {
            $($(#[$doc])* $kind(Box<$message>),)*
        }

        impl Recorded {
            /// The service of the message.
            #[must_use]
            pub fn topic(&self) -> &'static str {
                match self {
                    $(Self::$kind(_) => <$message>::SERVICE.name,)*
                }
            }

            /// The message's bytes as in shared memory.
            #[must_use]
            pub fn to_bytes(&self) -> Vec<u8> {
                match self {
                    $(Self::$kind(message) => message.to_bytes(),)*
                }
            }

            fn sequence(&self) -> u64 {
                match self {
                    $(Self::$kind(message) => message.sequence,)*
                }
            }

            fn decode(topic: &str, bytes: &[u8]) -> Result<Self, String> {
                fn message<M: Message + ByteImage>(bytes: &[u8]) -> Result<Box<M>, String> {
                    let message =
                        M::from_bytes(bytes).ok_or_else(|| format!("{} bytes are no {}", bytes.len(), M::TYPE_NAME))?;
                    message.check().map_err(|error| error.to_string())?;
                    Ok(Box::new(message))
                }
                $(if topic == <$message>::SERVICE.name {
                    return Ok(Self::$kind(message(bytes)?));
                })*
                Err(format!("the service {topic:?} is unknown"))
            }
        }
    };
}

recorded! {
    /// Narration.
    Narration(NarrationV1),
    /// Room scores.
    RoomScores(RoomScoresV1),
    /// The scores for each person.
    PersonScores(PersonScoresV1),
    /// Forecast.
    Forecast(ForecastV1),
    /// The forecast for each person.
    PersonForecasts(PersonForecastsV1),
    /// Decision.
    Decision(DecisionV1),
    /// Robot's report.
    RobotReport(RobotReportV1),
}

impl Recorded {
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
}

/// A time in Foxglove's form.
fn time(unix_ns: u64) -> Value {
    json!({"sec": unix_ns / 1_000_000_000, "nsec": unix_ns % 1_000_000_000})
}

/// JSON has no infinity: a room without items has no score.
fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

/// Long, because it is a list: each kind of message with its fields.
fn schemas() -> [(&'static str, &'static str, Value); 7] {
    let (text, integer, number) = (json!({"type": "string"}), json!({"type": "integer"}), json!({"type": "number"}));
    let point = json!({"type": "object", "title": "time", "properties": {"sec": integer, "nsec": integer}});
    let room = json!({"type": "array", "items": {"type": "object", "properties":
        {"id": text, "probability": number, "log_score_nats": {"type": ["number", "null"]}}}});
    let numbers = json!({"type": "array", "items": number});
    let timing = json!({"type": "object", "properties":
        {"wait": integer, "tokenise": integer, "prefix": integer, "trie": integer, "ground": integer}});
    let course =
        json!({"type": "array", "items": {"type": "object", "properties": {"id": text, "probability": numbers}}});
    fn schema<M: Message>(properties: Value) -> (&'static str, &'static str, Value) {
        let mut properties = properties;
        properties["bytes"] = json!({"type": "string", "description": "the message as in shared memory, hexadecimal"});
        let schema = json!({"$schema": SCHEMAS, "title": M::TYPE_NAME, "type": "object", "properties": properties});
        (M::SERVICE.name, M::TYPE_NAME, schema)
    }
    [
        schema::<NarrationV1>(json!({
            "source": text, "person": integer, "person_name": text, "kind": integer, "text": text, "epoch": text, "sequence": integer, "observed": point,
        })),
        schema::<RoomScoresV1>(json!({
            "epoch": text, "sequence": integer, "computed": point, "label_mass": number, "flags": integer, "rooms": room,
            "timing_ns": timing, "model": text, "map": text,
        })),
        schema::<PersonScoresV1>(json!({
            "epoch": text, "sequence": integer, "persons": integer, "map": text,
            "person": {"type": "array", "items": {"type": "object", "properties":
                {"person": integer, "name": text, "presence": text, "since_ns": integer, "elsewhere": number,
                    "flags": integer, "label_mass": number, "rooms": room}}},
        })),
        schema::<ForecastV1>(json!({
            "epoch": text, "sequence": integer, "flags": integer, "horizon_s": numbers, "elsewhere": numbers, "rooms": course,
        })),
        schema::<PersonForecastsV1>(json!({
            "epoch": text, "sequence": integer, "persons": integer, "horizon_s": numbers,
            "person": {"type": "array", "items": {"type": "object", "properties":
                {"person": integer, "name": text, "presence": text, "flags": integer, "elsewhere": numbers, "rooms": course}}},
        })),
        schema::<DecisionV1>(json!({
            "robot": text, "robot_name": text, "from": text, "to": text, "policy": text, "reason": text, "probability": number,
            "stay_s": number, "flags": integer, "sequence": integer, "scores_sequence": integer, "decided": point,
            "action": integer, "cancels": integer,
        })),
        schema::<RobotReportV1>(json!({
            "robot": text, "robot_name": text, "kind": integer, "room": text,
            "position_m": {"type": ["array", "null"], "items": number}, "battery": {"type": ["number", "null"]}, "note": text,
            "decision_sequence": integer, "epoch": text, "sequence": integer, "reported": point,
        })),
    ]
}

/// Writes a recording.
#[expect(missing_debug_implementations, reason = "the writer of mcap has none")]
pub struct Recorder {
    tape: Tape,
    channels: BTreeMap<&'static str, u16>,
    /// The fingerprint of the map in the newest moment with a map.
    map: Option<String>,
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
        let schema = &json!({"$schema": SCHEMAS, "title": "roomcast.Moment", "type": "object"}).to_string();
        let form = Form {
            name: "roomcast.Moment",
            schema_encoding: "jsonschema",
            schema,
            message_encoding: "json",
            metadata: BTreeMap::new(),
        };
        channels.insert(question::MOMENT, tape.channel(question::MOMENT, &form)?);
        Ok(Self { tape, channels, map: None })
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

    /// Writes a daemon's moment. The map goes into the first moment of each map alone.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Write`].
    pub fn keep(&mut self, moment: &Moment, received: Received) -> Result<(), RecordingError> {
        let mut data = serde_json::to_value(moment).unwrap_or_default();
        if self.map.as_ref() == Some(&moment.map_fingerprint) {
            data["scene"] = Value::Null;
        }
        self.map = Some(moment.map_fingerprint.clone());
        let header = MessageHeader {
            channel_id: self.channels[question::MOMENT],
            sequence: moment.sequence as u32,
            log_time: self.tape.time_ns(received).0,
            publish_time: received.unix_ns.0,
        };
        self.tape.write_uncounted(&header, data.to_string().as_bytes())
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

/// A recording: every message with the time of its receipt, in the order of the file. The time is in nanoseconds, with the first one in Unix
/// time.
#[derive(Debug, Default)]
pub struct Recording {
    /// The messages.
    pub messages: Vec<(u64, Recorded)>,
    /// The wall clock at the receipt of each message, for hours of the day.
    pub received_unix_ns: Vec<u64>,
    /// The moments with a map: the first of each map.
    pub maps: Vec<Moment>,
    /// The file ends within a record, as after a kill of the recorder: the rest is missing.
    pub is_torn: bool,
}

/// The moment to look for in a recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Wanted {
    /// The last one.
    Last,
    /// The last one up to these seconds from the recording's beginning.
    At(f64),
    /// The last one with this sequence number of scores.
    Sequence(u64),
}

/// A moment of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedMoment {
    /// Seconds from the recording's beginning.
    pub at_s: f64,
    /// The data behind the scores.
    pub moment: Moment,
    /// As [`Recording::is_torn`].
    pub is_torn: bool,
}

/// Looks for a moment while a recording is read.
struct Search {
    wanted: Wanted,
    start_ns: Option<u64>,
    found: Option<(f64, Vec<u8>)>,
}

/// The part of a moment that a search needs.
#[derive(serde::Deserialize)]
struct Head {
    sequence: u64,
    scene: Option<serde::de::IgnoredAny>,
}

impl Search {
    fn is_wanted(&self, at_s: f64, sequence: u64) -> bool {
        match self.wanted {
            Wanted::Last => true,
            Wanted::At(wanted_s) => at_s <= wanted_s,
            Wanted::Sequence(wanted) => sequence == wanted,
        }
    }
}

fn moment_of(data: &[u8]) -> Result<Moment, String> {
    Moment::from_json(&String::from_utf8_lossy(data)).map_err(|error| error.to_string())
}

/// Keeps a moment if it has a map, or if it is looked for.
fn keep(recording: &mut Recording, search: Option<&mut Search>, time_ns: u64, data: &[u8]) -> Result<(), String> {
    let Head { sequence, scene } = serde_json::from_slice(data).map_err(|error| error.to_string())?;
    if scene.is_some() {
        recording.maps.push(moment_of(data)?);
    }
    let Some(search) = search else { return Ok(()) };
    let at_s = time_ns.saturating_sub(search.start_ns.unwrap_or(time_ns)) as f64 / 1e9;
    if search.is_wanted(at_s, sequence) {
        search.found = Some((at_s, data.to_vec()));
    }
    Ok(())
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
    decode_until(path, &bytes_of(path)?, is_stopped, None)
}

/// The bytes of a file that begins as a recording, or its beginning.
fn bytes_of(path: &Path) -> Result<Vec<u8>, RecordingError> {
    let mut bytes = Vec::new();
    let mut read = || {
        let mut file = File::open(path)?;
        file.by_ref().take(MAGIC.len() as u64).read_to_end(&mut bytes)?;
        if bytes == MAGIC {
            file.take(FILE_BYTES_MAX).read_to_end(&mut bytes)?;
        }
        Ok(())
    };
    read().map_err(|source| RecordingError::Io(path.to_owned(), source))?;
    if bytes.len() as u64 > FILE_BYTES_MAX { Err(RecordingError::TooLarge(path.to_owned())) } else { Ok(bytes) }
}

/// Reads one moment of a recording; `None` if the recording has no such moment.
///
/// # Errors
///
/// [`RecordingError`], for the first message that is none, and for a moment that is none.
pub fn moment(path: &Path, wanted: Wanted) -> Result<Option<RecordedMoment>, RecordingError> {
    find(path, &bytes_of(path)?, wanted)
}

/// As [`moment`], of a recording's bytes; `path` is for errors.
///
/// # Errors
///
/// As [`moment`].
pub fn find(path: &Path, bytes: &[u8], wanted: Wanted) -> Result<Option<RecordedMoment>, RecordingError> {
    let mut search = Search { wanted, start_ns: None, found: None };
    let recording = decode_until(path, bytes, &|| false, Some(&mut search))?;
    let Some((at_s, data)) = search.found else { return Ok(None) };
    let wrong = |reason| {
        let topic = question::MOMENT.to_owned();
        RecordingError::Message { path: path.to_owned(), index: 0, topic, reason }
    };
    let mut moment = moment_of(&data).map_err(wrong)?;
    if moment.scene.is_null() {
        let of_map = recording.maps.iter().find(|own| own.map_fingerprint == moment.map_fingerprint);
        moment.scene = of_map.ok_or_else(|| wrong("the recording lacks its map".to_owned()))?.scene.clone();
    }
    Ok(Some(RecordedMoment { at_s, moment, is_torn: recording.is_torn }))
}

/// Reads a recording's bytes; `path` is for errors.
///
/// # Errors
///
/// [`RecordingError`], for the first message that is none.
pub fn decode(path: &Path, bytes: &[u8]) -> Result<Recording, RecordingError> {
    decode_until(path, bytes, &|| false, None)
}

impl Recording {
    fn take(
        &mut self,
        header: &MessageHeader,
        topic: &str,
        data: &[u8],
        mut search: Option<&mut Search>,
    ) -> Result<(), String> {
        if let Some(search) = &mut search {
            search.start_ns.get_or_insert(header.log_time);
        }
        if topic == question::MOMENT {
            return keep(self, search, header.log_time, data);
        }
        let message = original(data).and_then(|bytes| Recorded::decode(topic, &bytes))?;
        self.messages.push((header.log_time, message));
        self.received_unix_ns.push(header.publish_time);
        Ok(())
    }
}

fn decode_until(
    path: &Path,
    bytes: &[u8],
    is_stopped: &dyn Fn() -> bool,
    mut search: Option<&mut Search>,
) -> Result<Recording, RecordingError> {
    chunks::check(bytes).map_err(|fault| match fault {
        TooMuch::Chunk(bytes) => RecordingError::Chunk(path.to_owned(), bytes),
        TooMuch::All => RecordingError::TooLarge(path.to_owned()),
    })?;
    let mcap = |source| RecordingError::Mcap(path.to_owned(), Box::new(source));
    let wrong = |index, topic: &str, reason| {
        let (path, topic) = (path.to_owned(), topic.to_owned());
        RecordingError::Message { path, index, topic, reason }
    };
    let options = LinearReaderOptions::default().with_record_length_limit(RECORD_BYTES_MAX);
    let mut reader = LinearReader::new_with_options(options.with_validate_chunk_crcs(true));
    let (mut recording, mut topics) = (Recording::default(), BTreeMap::new());
    let (mut rest, mut unpacked) = (bytes, 0_u64);
    let is_finished = bytes.ends_with(MAGIC);
    let mut events = 0_u64;
    while let Some(event) = reader.next_event() {
        events += 1;
        if events.is_multiple_of(EVENTS_BETWEEN_LOOKS) && is_stopped() {
            return Err(RecordingError::Stopped(path.to_owned()));
        }
        let (opcode, data) = match event {
            Err(_) if !is_finished && !recording.messages.is_empty() => {
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
            return Err(RecordingError::TooLarge(path.to_owned()));
        }
        match opcode {
            op::HEADER | op::CHANNEL | op::MESSAGE => match mcap::parse_record(opcode, data).map_err(mcap)? {
                Record::Header(header) if !header.profile.is_empty() => {
                    return Err(RecordingError::Profile(path.to_owned(), header.profile));
                }
                Record::Channel(channel) => {
                    topics.insert(channel.id, channel.topic);
                }
                Record::Message { header, data } => {
                    let topic = topics.get(&header.channel_id);
                    let topic = topic.ok_or(McapError::UnknownChannel(header.sequence, header.channel_id));
                    let topic = topic.map_err(mcap)?;
                    let index = recording.messages.len();
                    let taken = recording.take(&header, topic, &data, search.as_deref_mut());
                    taken.map_err(|reason| wrong(index, topic, reason))?;
                }
                _ => {}
            },
            op::ATTACHMENT => {
                let (time_ns, name, data) = attachment(data).ok_or(McapError::UnexpectedEof).map_err(mcap)?;
                if name.starts_with(MOMENT_FILES) {
                    let kept = keep(&mut recording, search.as_deref_mut(), time_ns, data);
                    kept.map_err(|reason| wrong(recording.messages.len(), &name, reason))?;
                }
            }
            // Schemas, statistics and indexes are not needed.
            _ => {}
        }
    }
    Ok(recording)
}

/// Time, name and content of an attachment's record, after a check of the checksum. The crate's own reader assumes that the record is complete.
fn attachment(record: &[u8]) -> Option<(u64, String, &[u8])> {
    let (content, checksum) = record.split_last_chunk()?;
    // The times of the receipt and of the creation precede the name.
    let (time_ns, rest) = content.split_first_chunk()?;
    let (_created, rest) = rest.split_at_checked(8)?;
    let (length, rest) = rest.split_first_chunk()?;
    let (name, rest) = rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)?;
    let (length, rest) = rest.split_first_chunk()?;
    let (_media_type, rest) = rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)?;
    let (length, data) = rest.split_first_chunk()?;
    let whole = u64::from_le_bytes(*length) == data.len() as u64;
    let checksum = u32::from_le_bytes(*checksum);
    (whole && (checksum == 0 || checksum == crc32fast::hash(content)))
        .then(|| (u64::from_le_bytes(*time_ns), String::from_utf8_lossy(name).into_owned(), data))
}

fn original(data: &[u8]) -> Result<Vec<u8>, String> {
    let value: Value = serde_json::from_slice(data).map_err(|error| error.to_string())?;
    let text = value.get("bytes").and_then(Value::as_str).ok_or("the field \"bytes\" is missing")?;
    hex::decode(text).map_err(|_| "the field \"bytes\" is not hexadecimal".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::ids::{BootNs, UnixNs};
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

    fn example(sequence: u64, map: &str) -> Moment {
        let moment = json!({
            "version": crate::moment::VERSION, "epoch": "3", "sequence": sequence, "computed_unix_ns": 0, "model": "", "model_fingerprint": "",
            "map_fingerprint": map, "grounding": GroundingOptions::default(), "binding_name": "", "binding": "", "narration": [], "included": [], "labels": [], "scene": {"of": map},
        });
        serde_json::from_value(moment).unwrap()
    }

    #[test]
    fn a_moment_is_found_by_number_and_time_and_has_its_map() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("day.mcap");
        let mut recorder = Recorder::create(&path).unwrap();
        let second_ns = 1_000_000_000;
        recorder.write(&messages()[0].1, at(0)).unwrap();
        for (sequence, map) in [(1, "a"), (2, "a"), (3, "b"), (4, "a")] {
            recorder.keep(&example(sequence, map), at(sequence * second_ns)).unwrap();
        }
        recorder.finish().unwrap();
        assert_eq!(recorder.written(), 1, "moments are no messages of the services");
        assert_eq!(read(&path).unwrap().messages.len(), 1);
        let found = |wanted| moment(&path, wanted).unwrap().map(|found| (found.at_s, found.moment));
        assert_eq!(found(Wanted::Last), Some((4.0, example(4, "a"))));
        assert_eq!(found(Wanted::At(2.5)), Some((2.0, example(2, "a"))));
        assert_eq!(found(Wanted::Sequence(3)), Some((3.0, example(3, "b"))));
        assert_eq!(found(Wanted::Sequence(2)), Some((2.0, example(2, "a"))), "its map is in the moment before");
        assert_eq!(found(Wanted::Sequence(7)), None);
        assert_eq!(found(Wanted::At(0.5)), None);
    }

    #[test]
    fn a_recording_is_not_overwritten_and_a_damaged_one_is_named() {
        let (_folder, path) = recorded(&messages());
        assert!(matches!(Recorder::create(&path), Err(RecordingError::Exists { .. })));
        // A file without an end is not read to it.
        assert!(matches!(read(Path::new("/dev/zero")), Err(RecordingError::Mcap { .. })));
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
            let mut bytes = MAGIC.to_vec();
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
        let stopped = decode_until(path, &few, &|| true, None);
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
