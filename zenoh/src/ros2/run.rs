//! Publishes the robot's services to ROS 2 nodes, each on a topic of a standard type.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use roomcast_core::grounding::{Partition, partitions};
use roomcast_core::semantic_map::{SceneError, SemanticMap, Storeys};
use roomcast_ipc::raw::{ForecastV1, PersonForecastsV1, RoomScoresV1, probability_at};
use roomcast_ipc::{Domain, IpcError, Subscriber, clock};
use roomcast_ros2::content::{diagnostics, horizon, of_person, of_rooms, person_topics};
use roomcast_ros2::markers::markers;
use roomcast_ros2::types::{CostmapFilterInfo, Header, Message, Text};

use super::mask::{self, Grid, MapError, Mask, StoreyError};
use super::node::{Kept, Node};
use crate::config::Ros2;
use crate::inward::Inlet;
use crate::limiter::Limiter;
use crate::link::Link;
use crate::stop::Stop;

const TICK: Duration = Duration::from_millis(100);
/// Period of diagnostics, and shortest period of markers.
const SECOND: Duration = Duration::from_secs(1);
/// The node's name.
const NAME: &str = "roomcast";

/// Why the ROS 2 part ends.
#[derive(Debug, thiserror::Error)]
pub enum Ros2Error {
    /// The scene.
    #[error("ros2.scene: {0}")]
    Scene(#[source] Box<SceneError>),
    /// The Nav2 map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The map's storey.
    #[error(transparent)]
    Storey(#[from] StoreyError),
    /// A service of the robot.
    #[error(transparent)]
    Ipc(#[from] IpcError),
}

/// The places of rooms.
#[derive(Debug)]
pub struct Places {
    rooms: Vec<Partition>,
    mask: Option<Mask>,
}

impl Places {
    /// Reads the scene and the map.
    ///
    /// # Errors
    ///
    /// [`Ros2Error`] if one of them is unusable.
    pub fn load(config: &Ros2) -> Result<Self, Ros2Error> {
        let Some(path) = &config.scene else { return Ok(Self { rooms: Vec::new(), mask: None }) };
        let scene = SemanticMap::load(path).map_err(|error| Ros2Error::Scene(Box::new(error)))?;
        let rooms = partitions(&scene, config.level);
        let grid = config.map.as_deref().map(Grid::load).transpose()?;
        let storeys = Storeys::of(&scene);
        let mask = match grid {
            Some(grid) => Some(Mask::new(grid, &rooms, &storeys, mask::storey(&storeys, config.floor_m)?)),
            None => None,
        };
        Ok(Self { rooms, mask })
    }
}

/// The node of the present session, and a limit for its log.
struct RosPublisher<'a> {
    config: &'a Ros2,
    link: &'a Link,
    inlet: Option<(usize, Inlet)>,
    node: Option<(u64, Node)>,
    log: Limiter,
}

impl RosPublisher<'_> {
    /// Makes a new node for every new session; returns whether it did.
    fn renew(&mut self) -> bool {
        let session = self.link.session();
        let stands = session.as_ref().map(|(number, _)| *number);
        if self.node.as_ref().map(|(number, _)| *number) == stands {
            return false;
        }
        self.node = None;
        let Some((number, session)) = session else { return false };
        let made = Node::new(session, self.config.domain, NAME).and_then(|mut node| {
            if let Some((narrator, inlet)) = self.inlet.clone() {
                let topic = format!("{}/narration", self.config.prefix);
                node.hear::<Text>(&topic, move |sample| inlet.take(narrator, sample.payload()))?;
            }
            Ok(node)
        });
        match made {
            Ok(node) => self.node = Some((number, node)),
            Err(error) => self.complain(&error),
        }
        self.node.is_some()
    }

    fn complain(&mut self, error: &zenoh::Error) {
        if let Some(not_told) = self.log.pass("ros2", clock::monotonic_ns()) {
            tracing::warn!(%error, not_told, "ROS 2 does not hear this");
        }
    }

    fn topic(&self, name: &str) -> String {
        if name.starts_with('/') { name.to_owned() } else { format!("{}/{name}", self.config.prefix) }
    }

    fn keep(&mut self, begin: &str, topics: &BTreeSet<String>) {
        if let Some((_, node)) = &mut self.node {
            node.keep(begin, topics);
        }
    }

    fn say<M: Message + serde::Serialize>(&mut self, topic: &str, kept: Kept, message: &M) {
        let topic = self.topic(topic);
        let said = self.node.as_mut().map(|(_, node)| node.publish(&topic, kept, message));
        if let Some(Err(error)) = said {
            self.complain(&error);
        }
    }

    /// The forecast of each person, a topic per horizon.
    fn tell_persons(&mut self, message: &PersonForecastsV1, horizons_s: &[f64], now_ns: u64) {
        let mut topics = BTreeSet::new();
        for (person, name) in message.persons().iter().zip(person_topics(message.persons())) {
            for ahead_s in horizons_s {
                let header = self.header(now_ns.saturating_sub(message.computed_ns));
                let topic = self.topic(&format!("person/{name}{}", horizon(*ahead_s)));
                self.say(&topic, Kept::Last, &of_person(message, person, *ahead_s, header));
                topics.insert(topic);
            }
        }
        // The number of persons in a message is bounded. A forgotten person, or one of those observed longest ago, has no topic.
        self.keep(&self.topic("person/"), &topics);
    }

    /// Draws the rooms as they are probably occupied now.
    fn mark(&mut self, places: &Places, forecast: &ForecastV1, now_ns: u64) {
        let age_ns = now_ns.saturating_sub(forecast.computed_ns);
        let occupied = |room: &Partition| {
            let row = forecast.rooms().find(|(id, _)| *id == room.id);
            row.map_or(0.0, |(_, row)| probability_at(forecast.horizons_s(), row, age_ns as f64 / 1e9))
        };
        let shown: Vec<_> = places.rooms.iter().map(|room| (room, occupied(room))).collect();
        let header = self.header(0);
        self.say("markers", Kept::Last, &markers(&shown, &header));
    }

    fn header(&self, age_ns: u64) -> Header {
        Header::of_unix_ns(clock::unix_ns().saturating_sub(age_ns), &self.config.frame)
    }
}

/// Publishes until asked to stop. `inlet` takes narration, if ROS 2 may narrate.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened or is lost.
pub fn run(
    config: &Ros2,
    places: &Places,
    domain: &Domain,
    link: &Link,
    inlet: Option<(usize, Inlet)>,
    stop: &Stop,
) -> Result<(), IpcError> {
    let node = domain.open("roomcast-ros2")?;
    let scores: Subscriber<RoomScoresV1> = node.subscriber()?;
    let persons: Subscriber<PersonForecastsV1> = node.subscriber()?;
    let forecasts: Subscriber<ForecastV1> = node.subscriber()?;
    let mut publisher = RosPublisher { config, link, inlet, node: None, log: Limiter::default() };
    let mut rooms = None::<Box<RoomScoresV1>>;
    let mut forecast = None::<Box<ForecastV1>>;
    let mut said = None::<(u64, u64)>;
    let mut of_persons = None::<(u64, u64)>;
    let horizons_s: Vec<f64> = [0.0].into_iter().chain(config.horizons_s.iter().copied()).collect();
    let mut values = Vec::<i8>::new();
    let mut drawn = None::<(Vec<i8>, Instant)>;
    let (mut told, mut marked) = (None::<Instant>, None::<Instant>);
    while !stop.requested() {
        scores.wait(TICK)?;
        if publisher.renew() {
            // The last session's messages for late subscribers are gone.
            (said, of_persons, drawn, marked) = (None, None, None, None);
            if places.mask.is_some() {
                let header = publisher.header(0);
                publisher.say("keepout_info", Kept::Last, &filter(config, header));
            }
        }
        rooms = scores.newest()?.map(Box::new).or(rooms);
        let now_ns = clock::monotonic_ns();
        forecast = forecasts.newest()?.map(Box::new).or(forecast);
        if let Some(forecast) = &forecast
            && said != Some((forecast.epoch, forecast.computed_ns))
        {
            said = Some((forecast.epoch, forecast.computed_ns));
            for ahead_s in &horizons_s {
                let header = publisher.header(now_ns.saturating_sub(forecast.computed_ns));
                publisher.say(
                    &format!("rooms{}", horizon(*ahead_s)),
                    Kept::Last,
                    &of_rooms(forecast, *ahead_s, header),
                );
            }
            values = likely(forecast, &places.rooms, config.horizon_s).map(mask::value).collect();
        }
        if let Some(message) = persons.newest()?
            && of_persons != Some((message.epoch, message.computed_ns))
        {
            of_persons = Some((message.epoch, message.computed_ns));
            publisher.tell_persons(&message, &horizons_s, now_ns);
        }
        if let Some(mask) = &places.mask
            && !values.is_empty()
            && drawn
                .as_ref()
                .is_none_or(|(before, at)| *before != values && at.elapsed().as_secs_f64() >= config.mask_s)
        {
            drawn = Some((values.clone(), Instant::now()));
            let header = publisher.header(0);
            publisher.say("keepout_mask", Kept::Last, &mask.draw(&values, header));
        }
        if let Some(forecast) = &forecast
            && !places.rooms.is_empty()
            && marked.is_none_or(|marked| marked.elapsed() >= SECOND)
        {
            marked = Some(Instant::now());
            publisher.mark(places, forecast, now_ns);
        }
        if told.is_none_or(|told| told.elapsed() >= SECOND) {
            told = Some(Instant::now());
            let header = publisher.header(0);
            publisher.say("/diagnostics", Kept::Not, &diagnostics(rooms.as_deref(), now_ns, header));
        }
    }
    Ok(())
}

fn filter(config: &Ros2, header: Header) -> CostmapFilterInfo {
    let filter_mask_topic = format!("{}/keepout_mask", config.prefix);
    CostmapFilterInfo { header, r#type: 0, filter_mask_topic, base: 0.0, multiplier: 1.0 }
}

/// For each room of the scene, the highest probability within a horizon that it is occupied.
fn likely<'a>(forecast: &'a ForecastV1, rooms: &'a [Partition], horizon_s: f64) -> impl Iterator<Item = f64> + 'a {
    let within = forecast.horizons_s().iter().take_while(|at| f64::from(**at) <= horizon_s).count().max(1);
    rooms.iter().map(move |room| {
        let row = forecast.rooms().filter(|(id, _)| *id == room.id).flat_map(|(_, row)| row.iter().take(within));
        row.fold(0.0, |most, probability| f64::from(*probability).max(most))
    })
}
