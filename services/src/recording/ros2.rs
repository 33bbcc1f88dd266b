//! Recordings for ROS 2: CDR messages of standard types with their definitions, on the topics of the bridge, so that `ros2 bag` and
//! Foxglove can read them.

use std::collections::BTreeMap;
use std::path::Path;

use mcap::records::{MessageHeader, Metadata};
use roomcast_core::grounding::{Partition, partitions};
use roomcast_core::ids::{BootNs, PersonId, UnixNs};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_ipc::raw::{ForecastV1, NarrationV1, PersonForecastsV1, probability_at};
use roomcast_ipc::sequence;
use roomcast_ros2::types::{Classification, Header, MarkerArray, Message, Text, encode};
use roomcast_ros2::{content, markers, schema, words};

use super::tape::{Form, Tape};
use super::{Received, Recorded, RecordingError};
use crate::message_text::event_of;
use crate::moment::Moment;

pub(super) const PROFILE: &str = "ros2";
/// The frame of the map's coordinates, the bridge's default.
const FRAME: &str = "map";

/// The history that a player offers to later subscribers of a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kept {
    /// The last message: transient-local, depth 1.
    Last,
    /// None: volatile, depth 10.
    Not,
}

impl Kept {
    /// The quality of service in rosbag2's form, by the numbers that all its versions read: history 1 keeps the last ones, reliability 1 is
    /// reliable, durability 1 transient-local and 2 volatile, liveliness 1 automatic; times without an end.
    fn profile(self) -> String {
        let (depth, durability) = match self {
            Self::Last => (1, 1),
            Self::Not => (10, 2),
        };
        let endless = "\n    sec: 9223372036\n    nsec: 854775807";
        format!(
            "- history: 1\n  depth: {depth}\n  reliability: 1\n  durability: {durability}\n  deadline:{endless}\n  lifespan:{endless}\n  \
             liveliness: 1\n  liveliness_lease_duration:{endless}\n  avoid_ros_namespace_conventions: false"
        )
    }
}

impl Received {
    /// The wall clock's time of an earlier monotonic time.
    fn before(self, monotonic_ns: BootNs) -> UnixNs {
        self.unix_ns.saturating_sub(self.monotonic_ns.since(monotonic_ns))
    }

    /// A message's time, or the time of its receipt if it has none.
    fn or(self, unix_ns: UnixNs) -> UnixNs {
        if unix_ns == UnixNs(0) { self.unix_ns } else { unix_ns }
    }
}

/// The time of receipt in the file, the message's wall clock time, and its number.
#[derive(Debug, Clone, Copy)]
struct Stamp {
    received_ns: UnixNs,
    made_unix_ns: UnixNs,
    sequence: u64,
}

impl Stamp {
    fn header(self) -> Header {
        Header::of_unix_ns(self.made_unix_ns.0, FRAME)
    }
}

fn ahead_s() -> impl Iterator<Item = f64> {
    [0.0].into_iter().chain(content::HORIZONS_S)
}

/// Writes a recording for ROS 2.
#[expect(missing_debug_implementations, reason = "the writer of mcap has none")]
pub struct Ros2Recorder {
    tape: Tape,
    channels: BTreeMap<String, u16>,
    persons: BTreeMap<PersonId, String>,
    robots: BTreeMap<u64, String>,
    map: Option<(String, Vec<Partition>)>,
    /// The map of the newest scores.
    scored: Option<String>,
    /// A forecast that waits for its map.
    undrawn: Option<(Box<ForecastV1>, Stamp)>,
}

impl Ros2Recorder {
    /// Creates the file; an existing one is not overwritten. `robot` is the name of the planner's robot.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Exists`], [`RecordingError::Io`], [`RecordingError::Write`].
    pub fn create(path: &Path, robot: &str) -> Result<Self, RecordingError> {
        let mut tape = Tape::create(path, PROFILE)?;
        // Versions of rosbag2 from 9 to today's expect words for the numbers of qualities, unless this record exists and is empty.
        let metadata = [("serialized_metadata".to_owned(), String::new())].into();
        tape.tell(&Metadata { name: "rosbag2".to_owned(), metadata })?;
        let mut recorder = Self {
            tape,
            channels: BTreeMap::new(),
            persons: BTreeMap::new(),
            robots: [(sequence::source_of_name(robot), robot.to_owned())].into(),
            map: None,
            scored: None,
            undrawn: None,
        };
        recorder.channel::<Text>("narration", Kept::Not)?;
        for ahead_s in ahead_s() {
            recorder.channel::<Classification>(&format!("rooms{}", content::horizon(ahead_s)), Kept::Last)?;
        }
        recorder.channel::<MarkerArray>("markers", Kept::Last)?;
        recorder.channel::<Text>("decision", Kept::Last)?;
        recorder.channel::<Text>("report", Kept::Not)?;
        Ok(recorder)
    }

    fn channel<M: Message>(&mut self, topic: &str, kept: Kept) -> Result<u16, RecordingError> {
        if let Some(channel) = self.channels.get(topic) {
            return Ok(*channel);
        }
        let metadata = [("offered_qos_profiles", kept.profile()), ("topic_type_hash", M::HASH.to_owned())];
        let form = Form {
            name: M::NAME,
            schema_encoding: "ros2msg",
            schema: &schema::of::<M>(),
            message_encoding: "cdr",
            metadata: metadata.map(|(key, value)| (key.to_owned(), value)).into(),
        };
        let channel = self.tape.channel(&format!("/roomcast/{topic}"), &form)?;
        self.channels.insert(topic.to_owned(), channel);
        Ok(channel)
    }

    fn say<M: Message + serde::Serialize>(
        &mut self,
        topic: &str,
        kept: Kept,
        stamp: Stamp,
        message: &M,
    ) -> Result<(), RecordingError> {
        let channel_id = self.channel::<M>(topic, kept)?;
        let header = MessageHeader {
            channel_id,
            // The file's field has 32 bits.
            sequence: stamp.sequence as u32,
            log_time: stamp.received_ns.0,
            publish_time: stamp.made_unix_ns.0,
        };
        let data = encode(message).map_err(|source| RecordingError::Cdr(topic.to_owned(), source))?;
        self.tape.write(&header, &data)
    }

    /// Appends a message's content. Scores have no topic.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Write`], [`RecordingError::Cdr`].
    pub fn write(&mut self, message: &Recorded, received: Received) -> Result<(), RecordingError> {
        let sequence = message.sequence();
        let received_ns = self.tape.time_ns(received);
        let at = |made_unix_ns| Stamp { received_ns, made_unix_ns, sequence };
        match message {
            Recorded::Narration(message) => {
                let said = self.narrated(message);
                self.say("narration", Kept::Not, at(received.or(UnixNs(message.observed_unix_ns))), &said)
            }
            Recorded::RoomScores(scores) => {
                self.scored = Some(hex::encode(scores.map_fingerprint));
                self.draw()
            }
            Recorded::Forecast(forecast) => {
                let stamp = at(received.before(BootNs(forecast.computed_ns)));
                for ahead_s in ahead_s() {
                    let rooms = content::of_rooms(forecast, ahead_s, stamp.header());
                    self.say(&format!("rooms{}", content::horizon(ahead_s)), Kept::Last, stamp, &rooms)?;
                }
                self.undrawn = Some((forecast.clone(), stamp));
                self.draw()
            }
            Recorded::PersonForecasts(message) => {
                self.persons(message, at(received.before(BootNs(message.computed_ns))))
            }
            Recorded::Decision(decision) => {
                let said = words::decision(decision, &self.robot(decision.robot, decision.robot_name()));
                self.say("decision", Kept::Last, at(received.or(UnixNs(decision.decided_unix_ns))), &said)
            }
            Recorded::RobotReport(report) => {
                let said = words::report(report, &self.robot(report.robot, report.robot_name()));
                self.say("report", Kept::Not, at(received.or(UnixNs(report.reported_unix_ns))), &said)
            }
            Recorded::PersonScores(_) => Ok(()),
        }
    }

    /// The sentence in the daemon's form, with the person's name if it is known.
    fn narrated(&self, message: &NarrationV1) -> Text {
        let said = event_of(message.kind, message.text()).map(|said| said.to_string());
        let own = Some(message.person_name()).filter(|name| !name.is_empty());
        let name = own.or_else(|| self.persons.get(&PersonId(message.person)).map(String::as_str));
        words::narration(said.as_deref().unwrap_or(message.text()), name)
    }

    /// A robot's name from this message or an earlier one, or else its number.
    fn robot(&mut self, number: u64, told: &str) -> String {
        if !told.is_empty() {
            self.robots.insert(number, told.to_owned());
        }
        self.robots.get(&number).cloned().unwrap_or_else(|| format!("robot {number:016x}"))
    }

    fn persons(&mut self, message: &PersonForecastsV1, stamp: Stamp) -> Result<(), RecordingError> {
        for (person, topic) in message.persons().iter().zip(content::person_topics(message.persons())) {
            if !person.name().is_empty() {
                self.persons.insert(PersonId(person.person), person.name().to_owned());
            }
            for ahead_s in ahead_s() {
                let places = content::of_person(message, person, ahead_s, stamp.header());
                self.say(&format!("person/{topic}{}", content::horizon(ahead_s)), Kept::Last, stamp, &places)?;
            }
        }
        Ok(())
    }

    /// Takes the map and the names of persons from the daemon's moment, and draws the forecast that waited for the map.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Write`], [`RecordingError::Cdr`].
    pub fn tell(&mut self, moment: &Moment) -> Result<(), RecordingError> {
        self.persons.extend(moment.names.clone());
        if self.map.as_ref().is_some_and(|(fingerprint, _)| *fingerprint == moment.map_fingerprint) {
            return Ok(());
        }
        match SemanticMap::from_json(&moment.scene.to_string()) {
            Ok(map) => self.map = Some((moment.map_fingerprint.clone(), partitions(&map, moment.grounding.level))),
            Err(error) => tracing::warn!(%error, "the daemon told a map that is none; markers are left out"),
        }
        self.draw()
    }

    fn draw(&mut self) -> Result<(), RecordingError> {
        let (Some((forecast, stamp)), Some((fingerprint, rooms))) = (&self.undrawn, &self.map) else { return Ok(()) };
        if self.scored.as_ref() != Some(fingerprint) {
            return Ok(());
        }
        let now = |id: &str| {
            let row = forecast.rooms().find(|(own, _)| *own == id);
            row.map_or(0.0, |(_, row)| probability_at(forecast.horizons_s(), row, 0.0))
        };
        let shown: Vec<_> = rooms.iter().map(|room| (room, now(&room.id))).collect();
        let (stamp, drawn) = (*stamp, markers::markers(&shown, &stamp.header()));
        self.undrawn = None;
        self.say("markers", Kept::Last, stamp, &drawn)
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

#[cfg(test)]
mod tests {
    use roomcast_core::grounding::{Grounding, GroundingOptions};
    use roomcast_core::pipeline::{Pipeline, PipelineOptions};
    use roomcast_core::scorer::table::TableModel;
    use roomcast_ipc::raw::{DecisionV1, PersonForecastV1, RoomScoresV1, action, narration_kind};
    use roomcast_ipc::text;
    use roomcast_ros2::types::decode;

    use super::*;

    const NOW: Received = Received { unix_ns: UnixNs(1_700_000_000_000_000_000), monotonic_ns: BootNs(50_000_000_000) };

    fn map() -> SemanticMap {
        SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap()
    }

    /// The moment of a daemon on this map.
    fn moment() -> Moment {
        let options = GroundingOptions::default();
        let grounding = Grounding::new(&map(), &options).unwrap();
        let pipeline = Pipeline::new(TableModel::new(7), grounding, PipelineOptions::default()).unwrap();
        Moment { names: [(PersonId(4), "Ben".to_owned())].into(), ..Moment::of(&pipeline, &map(), &options, None) }
    }

    fn scores(sequence: u64, map_fingerprint: [u8; 32]) -> Recorded {
        Recorded::RoomScores(Box::new(RoomScoresV1 { epoch: 3, sequence, map_fingerprint, ..Default::default() }))
    }

    fn forecast(sequence: u64) -> Recorded {
        let (computed_ns, room_count, horizon_count) = (NOW.monotonic_ns.0 - 7, 2, 1);
        let mut forecast =
            ForecastV1 { epoch: 3, sequence, computed_ns, room_count, horizon_count, ..Default::default() };
        for (room, id) in ["kitchen", "bathroom"].into_iter().enumerate() {
            forecast.id[room] = text::encode("id", id).unwrap();
            forecast.probability[room][0] = 0.5;
        }
        Recorded::Forecast(Box::new(forecast))
    }

    /// For each message: topic, type, times of receipt and origin, and bytes.
    fn messages(path: &Path) -> Vec<(String, String, u64, u64, Vec<u8>)> {
        let bytes = std::fs::read(path).unwrap();
        let messages = mcap::MessageStream::new(&bytes).unwrap().map(|message| {
            let message = message.unwrap();
            let schema = message.channel.schema.as_ref().unwrap();
            assert_eq!((schema.encoding.as_str(), message.channel.message_encoding.as_str()), ("ros2msg", "cdr"));
            let (topic, data) = (message.channel.topic.clone(), message.data.to_vec());
            (topic, schema.name.clone(), message.log_time, message.publish_time, data)
        });
        messages.collect()
    }

    #[test]
    fn messages_lie_on_the_bridges_topics_and_markers_wait_for_their_map() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("day.mcap");
        let mut recorder = Ros2Recorder::create(&path, "robo").unwrap();
        let fingerprint = map().fingerprint();
        let narration =
            NarrationV1 { person: 4, ..NarrationV1::new(narration_kind::ACTION, "[Grab] <mug> (1)").unwrap() };
        let narration = Recorded::Narration(Box::new(narration));
        let mut persons = PersonForecastsV1 {
            computed_ns: NOW.monotonic_ns.0 - 5,
            room_count: 1,
            horizon_count: 1,
            person_count: 1,
            ..Default::default()
        };
        persons.id[0] = text::encode("id", "kitchen").unwrap();
        persons.person[0] =
            PersonForecastV1 { person: 9, name: text::encode("name", "Ada").unwrap(), ..Default::default() };
        let robot = sequence::source_of_name("robo");
        let decision =
            DecisionV1 { robot, action: action::GO, to: text::encode("to", "kitchen").unwrap(), ..Default::default() };
        recorder.write(&narration, NOW).unwrap();
        recorder.write(&scores(1, fingerprint), NOW).unwrap();
        recorder.write(&forecast(1), NOW).unwrap();
        recorder.tell(&moment()).unwrap();
        recorder.write(&narration, NOW).unwrap();
        recorder.write(&Recorded::PersonForecasts(Box::new(persons)), NOW).unwrap();
        recorder.write(&scores(3, [1; 32]), NOW).unwrap();
        recorder.write(&forecast(3), NOW).unwrap();
        recorder.write(&Recorded::Decision(Box::new(decision)), NOW).unwrap();
        recorder.write(&Recorded::Decision(Box::new(DecisionV1 { robot: 5, ..decision })), NOW).unwrap();
        assert_eq!(recorder.written(), 14);
        recorder.finish().unwrap();

        let written = messages(&path);
        let topics: Vec<_> = written.iter().map(|message| message.0.trim_start_matches("/roomcast/")).collect();
        let rooms = ["rooms", "rooms/in_60s", "rooms/in_600s"];
        let mut expected = vec!["narration"];
        expected.extend(rooms);
        expected.extend(["markers", "narration", "person/ada", "person/ada/in_60s", "person/ada/in_600s"]);
        expected.extend(rooms);
        expected.extend(["decision", "decision"]);
        assert_eq!(topics, expected, "no markers of another map");
        let said = |at: usize| decode::<Text>(&written[at].4).unwrap().data;
        assert_eq!(said(0), "They grab the mug.");
        assert_eq!(said(5), "Ben: They grab the mug.", "the daemon told the name meanwhile");
        assert_eq!(
            (said(12), said(13)),
            ("robo goes to kitchen".into(), "robot 0000000000000005 goes to kitchen".into())
        );
        let made = |at: usize| (NOW.unix_ns.0 - written[at].2, NOW.unix_ns.0 - written[at].3);
        assert_eq!((made(0), made(1), made(6)), ((0, 0), (0, 7), (0, 5)));
        let drawn: MarkerArray = decode(&written[4].4).unwrap();
        assert!(!drawn.markers.is_empty() && drawn.markers[0].header == Header::of_unix_ns(NOW.unix_ns.0 - 7, "map"));
        assert_eq!(written[6].1, "vision_msgs/msg/Classification");

        let refused = super::super::read(&path).unwrap_err().to_string();
        assert!(refused.contains("\"ros2\", and only those of the profile \"roomcast\" are read"), "{refused}");
        assert!(matches!(Ros2Recorder::create(&path, ""), Err(RecordingError::Exists { .. })));
    }

    #[test]
    fn channels_say_what_rosbag2_asks_of_them() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("day.mcap");
        Ros2Recorder::create(&path, "").unwrap().finish().unwrap();
        let summary = mcap::Summary::read(&std::fs::read(&path).unwrap()).unwrap().unwrap();
        assert_eq!((summary.channels.len(), summary.metadata_indexes.len()), (7, 1));
        for channel in summary.channels.values() {
            let topic = channel.topic.as_str();
            let kept =
                topic.starts_with("/roomcast/rooms") || ["/roomcast/markers", "/roomcast/decision"].contains(&topic);
            let qualities = &channel.metadata["offered_qos_profiles"];
            assert_eq!(qualities.contains("durability: 1"), kept, "{}", channel.topic);
            assert!(qualities.starts_with("- history: 1\n  depth: ") && qualities.contains("  reliability: 1\n"));
            assert!(channel.metadata["topic_type_hash"].starts_with("RIHS01_"));
        }
    }
}
