//! Serves the page of `roomcast view`: the plan of the map, and the places of persons and robot, as JSON for the page in `view/`.
//!
//! Only loopback addresses are served, and only requests that name one: a foreign page in the browser must not read the places of people. Other users
//! of the machine need the key of this start. The page may load nothing from other hosts. Data reaches the page as JSON, never as markup.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use hyper::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderName, HeaderValue};
use hyper::{Response, StatusCode};
use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, NarrationV1, PersonForecastsV1, PersonScoresV1, RobotReportV1, RoomScoresV1,
};
use roomcast_ipc::{Domain, IpcError, ItemScores, ItemScoresSubscriber, Node, Subscriber, clock, question, sequence};
use roomcast_services::daemon::{PersonDay, week};
use roomcast_services::moment::Moment;
use roomcast_services::recording::{Recorded, Recording};
use roomcast_services::stop::Stop;
use serde_json::{Value, json};

use crate::http::{HttpError, Request, Server, only_get, refusal};
use crate::reasons::Reasons;
use control::Control;
use picture::Picture;
use plan::Plan;

mod control;
mod picture;
mod plan;
mod quality;

const PAGE: &str = include_str!("view/page.html");
const STYLE: &str = include_str!("view/page.css");
const SCRIPT: &str = include_str!("view/page.js");
/// The page may load only its own style, script and data.
const POLICY: &str = "default-src 'none'; style-src 'self'; script-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Things' scores cost the daemon a little. The view stops asking for them this long after the last request of the page.
const LOOKED: Duration = Duration::from_secs(5);
const TICK: Duration = Duration::from_millis(200);
/// Interval between two looks into the state database.
const WEEK_EACH: Duration = Duration::from_secs(60);
/// Timeout of the daemon's map, and the pause before the next question.
const PATIENCE: Duration = Duration::from_secs(2);

#[derive(Debug, thiserror::Error)]
pub enum ViewError {
    #[error(transparent)]
    Http(#[from] HttpError),
    #[error(transparent)]
    Ipc(#[from] IpcError),
}

/// The header in which the page sends its key.
const KEY: HeaderName = HeaderName::from_static("x-roomcast-key");

#[derive(Debug, Clone)]
pub struct Place {
    /// A loopback address; port 0 takes a free one.
    pub address: SocketAddr,
    /// The secret of permitted viewers; `None` lets every user of the machine look.
    pub key: Option<String>,
}

impl Place {
    /// A place with a random key.
    #[must_use]
    pub fn with_key(address: SocketAddr) -> Self {
        let half = sequence::random_epoch;
        Self { address, key: Some(format!("{:016x}{:016x}", half(), half())) }
    }

    /// The address for a browser. The key stands after `#`, so that no log and no referrer has it.
    #[must_use]
    pub fn url(&self, address: SocketAddr) -> String {
        self.key.as_ref().map_or_else(|| format!("http://{address}/"), |key| format!("http://{address}/#{key}"))
    }
}

/// Serves the page of the running system until asked to stop. Among several robots it shows the configured one, `robot`. The last week is from the
/// database in the `state` directory. `ready` gets the address, with the port that was chosen for port 0.
///
/// # Errors
/// [`ViewError`] for an address that is not loopback or is taken, and if a service is lost.
pub fn run(
    place: &Place,
    domain: &Domain,
    robot: &str,
    state: Option<&Path>,
    stop: &Stop,
    ready: impl FnOnce(SocketAddr),
) -> Result<(), ViewError> {
    let node = domain.open("roomcast-view")?;
    let mut ports = Ports::new(&node)?;
    let moments = node.question_port(question::MOMENT)?;
    let mut reasons = Reasons::new(&node)?;
    let picture = Picture::of_robot(Some(sequence::source_of_name(robot)));
    // Orders need the key: another page in the browser could send them without it.
    let control = if place.key.is_some() { Control::new(robot) } else { None };
    let orders = control.is_some().then(|| node.publisher::<RobotReportV1>()).transpose()?;
    let shared = Arc::new(Mutex::new(Live { picture, control, ..Live::default() }));
    let (answered, key) = (Arc::clone(&shared), place.key.clone());
    let mut server = Server::start(place.address, stop, move |request| {
        let mut live = answered.lock().unwrap_or_else(PoisonError::into_inner);
        answer(request, key.as_deref(), &mut *live)
    })?;
    ready(server.address());
    let (mut things, mut asked, mut week_read) = (Things::default(), None::<Instant>, None::<Instant>);
    while !stop.requested() {
        ports.scores.wait(TICK)?;
        let mut live = shared.lock().unwrap_or_else(PoisonError::into_inner);
        ports.receive(&mut live.picture)?;
        if let (Some(control), Some(publisher)) = (&mut live.control, &orders) {
            for order in control.drain() {
                publisher.send(&order)?;
            }
            publisher.tick()?;
        }
        if let Some(message) = things.news()? {
            live.picture.items(&message);
        }
        let is_looked_at = live.looked.is_some_and(|looked| looked.elapsed() < LOOKED);
        let is_new = live.picture.scores.is_some() && live.fitting_plan().is_none();
        // Slow questions must not block readers.
        let persons = live.picture.persons.as_ref().filter(|_| is_looked_at);
        let persons: Vec<u32> =
            persons.map_or_else(Vec::new, |all| all.persons().iter().map(|person| person.person).collect());
        drop(live);
        things.follow(&node, is_looked_at);
        if !persons.is_empty()
            && let Some(told) = reasons.refresh(persons.into_iter())
        {
            shared.lock().unwrap_or_else(PoisonError::into_inner).picture.reasons.clone_from(told);
        }
        if let Some(state) = state.filter(|_| is_looked_at)
            && week_read.is_none_or(|read| read.elapsed() >= WEEK_EACH)
        {
            week_read = Some(Instant::now());
            // The daemon may not have made it yet, or this user may not read it.
            let days = week(state).inspect_err(|error| tracing::debug!(%error, "the state database cannot be read"));
            shared.lock().unwrap_or_else(PoisonError::into_inner).week = days.unwrap_or_default();
        }
        if is_new && asked.is_none_or(|asked| asked.elapsed() >= PATIENCE) {
            asked = Some(Instant::now());
            // A busy daemon is asked again later. Until then the page lists the rooms.
            let plan =
                moments.ask("{}", PATIENCE).ok().and_then(|text| Plan::of_moment(&Moment::from_json(&text).ok()?).ok());
            shared.lock().unwrap_or_else(PoisonError::into_inner).plan = plan;
        }
        server.look_after()?;
    }
    server.join();
    Ok(())
}

/// The services that the page and `roomcast top` show.
pub struct Ports {
    pub scores: Subscriber<RoomScoresV1>,
    pub forecast: Subscriber<ForecastV1>,
    pub persons: Subscriber<PersonScoresV1>,
    pub forecasts: Subscriber<PersonForecastsV1>,
    pub narration: Subscriber<NarrationV1>,
    pub decisions: Subscriber<DecisionV1>,
    /// If this service has no free place, the robot's place is unknown.
    pub reports: Option<Subscriber<RobotReportV1>>,
}

impl Ports {
    pub fn new(node: &Node) -> Result<Self, IpcError> {
        Ok(Self {
            scores: node.subscriber()?,
            forecast: node.subscriber()?,
            persons: node.subscriber()?,
            forecasts: node.subscriber()?,
            narration: node.subscriber()?,
            decisions: node.subscriber()?,
            reports: node.subscriber().ok(),
        })
    }

    /// Malformed messages are skipped; `roomcast top` and the metrics count them.
    fn receive(&mut self, picture: &mut Picture) -> Result<(), IpcError> {
        let now_ns = clock::monotonic_ns();
        while let Some(message) = self.narration.receive()? {
            picture.narration(&message, told_ns(message.observed_ns, now_ns));
        }
        if let Some(message) = self.scores.newest()? {
            picture.scores(&message, now_ns);
        }
        if let Some(message) = self.forecast.newest()? {
            picture.forecast(&message);
        }
        if let Some(message) = self.persons.newest()? {
            picture.persons(&message);
        }
        if let Some(message) = self.forecasts.newest()? {
            picture.forecasts(&message, now_ns);
        }
        while let Some(report) = self.reports.as_mut().map(|reports| reports.receive()).transpose()?.flatten() {
            picture.report(&report);
        }
        while let Some(message) = self.decisions.receive()? {
            picture.decision(&message, told_ns(message.decided_ns, now_ns));
        }
        Ok(())
    }
}

/// The time of a message that the service may have kept: its own time, or now if it has none or a later one.
fn told_ns(own_ns: u64, now_ns: u64) -> u64 {
    if own_ns == 0 { now_ns } else { own_ns.min(now_ns) }
}

/// The things' scores, which the daemon computes only for subscribers. If other subscribers have all places, the page shows none.
#[derive(Debug, Default)]
struct Things {
    scores: Option<ItemScoresSubscriber>,
    /// When there was no free place.
    refused: Option<Instant>,
}

impl Things {
    /// Subscribes while the page is open.
    fn follow(&mut self, node: &Node, is_looked_at: bool) {
        if !is_looked_at {
            *self = Self::default();
        } else if self.scores.is_none() && self.refused.is_none_or(|refused| refused.elapsed() >= PATIENCE) {
            self.refused = Some(Instant::now());
            self.scores = node.try_item_scores_subscriber().unwrap_or_else(|error| {
                tracing::warn!(%error, "the page shows no scores of things");
                None
            });
        }
    }

    fn news(&self) -> Result<Option<ItemScores>, IpcError> {
        Ok(self.scores.as_ref().map(ItemScoresSubscriber::newest).transpose()?.flatten())
    }
}

/// Serves the page of a recording until asked to stop.
///
/// # Errors
/// As [`run`].
pub fn run_recording(
    place: &Place,
    recording: Recording,
    stop: &Stop,
    ready: impl FnOnce(SocketAddr),
) -> Result<(), ViewError> {
    let (mut played, key) = (Played::new(recording), place.key.clone());
    let mut server = Server::start(place.address, stop, move |request| answer(request, key.as_deref(), &mut played))?;
    ready(server.address());
    while !stop.requested() {
        std::thread::sleep(TICK);
        server.look_after()?;
    }
    server.join();
    Ok(())
}

/// The source of the page's data.
trait Shown {
    /// The state; for a recording, at this many seconds from its beginning.
    fn state(&mut self, at_s: Option<f64>) -> Value;
    /// The plan of the map in use.
    fn plan(&mut self) -> Option<Value>;
    /// The rooms of the last seven days.
    fn week(&self) -> Vec<PersonDay> {
        Vec::new()
    }
    /// Takes a person's order for the robot.
    ///
    /// # Errors
    /// A sentence if the order is malformed, or if the page takes none.
    fn order(&mut self, _kind: &str, _room: Option<(&str, &str)>, _for_s: Option<&str>) -> Result<(), String> {
        Err("this page takes no orders: a recording has no robot, and without a key any page could send them"
            .to_owned())
    }
}

fn answer(request: Request<'_>, key: Option<&str>, shown: &mut impl Shown) -> Response<String> {
    let is_data = ["/state", "/plan", "/week", "/order"].contains(&request.uri.path());
    let given = request.headers.get(KEY).map(HeaderValue::as_bytes).unwrap_or_default();
    if is_data && key.is_some_and(|key| !is_same(key.as_bytes(), given)) {
        return refusal(
            StatusCode::FORBIDDEN,
            "open the address that `roomcast view` printed when it started: it has the key",
        );
    }
    let query = |key: &str| {
        let pairs = request.uri.query()?.split('&').filter_map(|pair| pair.split_once('='));
        pairs.filter(|(name, _)| *name == key).map(|(_, value)| value).next()
    };
    if request.changes {
        let Some(kind) = query("kind").filter(|_| request.uri.path() == "/order") else { return only_get() };
        return match shown.order(kind, query("room").map(|room| (room, query("map").unwrap_or_default())), query("for"))
        {
            Ok(()) => Response::new("{}".to_owned()),
            Err(why) => refusal(StatusCode::BAD_REQUEST, &why),
        };
    }
    let (kind, body) = match request.uri.path() {
        "/" => ("text/html; charset=utf-8", PAGE.to_owned()),
        "/page.css" => ("text/css; charset=utf-8", STYLE.to_owned()),
        "/page.js" => ("text/javascript; charset=utf-8", SCRIPT.to_owned()),
        "/state" => {
            let at_s = query("at").and_then(|at| at.parse().ok()).filter(|at: &f64| at.is_finite());
            ("application/json", shown.state(at_s).to_string())
        }
        "/plan" => match shown.plan() {
            Some(plan) => ("application/json", plan.to_string()),
            None => return refusal(StatusCode::NOT_FOUND, "the daemon has not told its map yet"),
        },
        "/week" => ("application/json", json!(shown.week()).to_string()),
        "/favicon.ico" => return refusal(StatusCode::NOT_FOUND, "no picture"),
        _ => return refusal(StatusCode::NOT_FOUND, "see /"),
    };
    let mut response = Response::new(body);
    for (name, value) in [
        (CONTENT_TYPE, kind),
        (CACHE_CONTROL, "no-store"),
        (CONTENT_SECURITY_POLICY, POLICY),
        (HeaderName::from_static("x-content-type-options"), "nosniff"),
        (HeaderName::from_static("referrer-policy"), "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Compares in constant time.
fn is_same(key: &[u8], given: &[u8]) -> bool {
    key.len() == given.len() && key.iter().zip(given).fold(0, |differs, (a, b)| differs | (a ^ b)) == 0
}

#[derive(Debug, Default)]
struct Live {
    picture: Picture,
    /// `None` if the page takes no orders.
    control: Option<Control>,
    plan: Option<Plan>,
    /// When the page last asked.
    looked: Option<Instant>,
    week: Vec<PersonDay>,
}

impl Live {
    /// The plan, if it matches the scores' map.
    fn fitting_plan(&self) -> Option<&Plan> {
        self.plan.as_ref().filter(|plan| self.picture.is_on(plan))
    }
}

impl Shown for Live {
    fn state(&mut self, _at_s: Option<f64>) -> Value {
        self.looked = Some(Instant::now());
        let now_ns = clock::monotonic_ns();
        let mut state = self.picture.state(now_ns);
        let plan = self.fitting_plan();
        (state["live"], state["forecasts"]) = (true.into(), true.into());
        state["control"] = self.control.is_some().into();
        state["map"] = plan.map(Plan::key).into();
        state["daemon"] = self.picture.daemon(now_ns);
        plan.iter().for_each(|plan| plan.name(&mut state));
        state
    }

    fn plan(&mut self) -> Option<Value> {
        self.plan.as_ref().map(|plan| plan.drawing.clone())
    }

    fn week(&self) -> Vec<PersonDay> {
        let name_of = |said: &str| self.plan.as_ref()?.name_of(said);
        self.week.iter().map(|day| day.named(name_of)).collect()
    }

    fn order(&mut self, kind: &str, room: Option<(&str, &str)>, for_s: Option<&str>) -> Result<(), String> {
        // The place of a room is that of the map on the page, which may have changed since.
        let map = self.fitting_plan().map(Plan::key);
        if room.is_some_and(|(_, of)| map.as_deref() != Some(of)) {
            return Err("the map has changed; choose the room again".to_owned());
        }
        let room = room.map(|(place, _)| place);
        let control = self.control.as_mut().ok_or("without a key this page takes no orders: leave out --no-key")?;
        control.take(kind, room, for_s, self.picture.scores.as_ref().map(|(scores, _)| scores))
    }
}

#[derive(Debug)]
struct Played {
    recording: Recording,
    picture: Picture,
    /// Messages that the picture contains.
    taken: usize,
    begin_ns: u64,
    length_s: f64,
    /// Whether the recording has forecasts, so that the page offers times ahead.
    has_forecasts: bool,
    plan: Option<Plan>,
}

impl Played {
    fn new(recording: Recording) -> Self {
        let begin_ns = recording.messages.first().map_or(0, |(time_ns, _)| *time_ns);
        let end_ns = recording.messages.last().map_or(0, |(time_ns, _)| *time_ns);
        let length_s = end_ns.saturating_sub(begin_ns) as f64 / 1e9;
        let is_forecast = |message: &Recorded| matches!(message, Recorded::Forecast(_) | Recorded::PersonForecasts(_));
        let has_forecasts = recording.messages.iter().any(|(_, message)| is_forecast(message));
        Self { recording, picture: Picture::default(), taken: 0, begin_ns, length_s, has_forecasts, plan: None }
    }

    fn play_to(&mut self, now_ns: u64) {
        if self
            .taken
            .checked_sub(1)
            .and_then(|last| self.recording.messages.get(last))
            .is_some_and(|last| last.0 > now_ns)
        {
            (self.picture, self.taken) = (Picture::default(), 0);
        }
        while let Some((time_ns, message)) =
            self.recording.messages.get(self.taken).filter(|(time_ns, _)| *time_ns <= now_ns)
        {
            self.picture.take(message, *time_ns);
            self.taken += 1;
        }
        if !self.plan.as_ref().is_some_and(|plan| self.picture.is_on(plan)) {
            let map = self.picture.map();
            let moments = self.recording.maps.iter().filter(|own| Some(&own.map_fingerprint) == map.as_ref());
            let mut plans = moments.filter_map(|moment| Plan::of_moment(moment).ok());
            self.plan = plans.find(|plan| self.picture.is_on(plan));
        }
    }
}

impl Shown for Played {
    fn state(&mut self, at_s: Option<f64>) -> Value {
        let at_s = at_s.unwrap_or(self.length_s).clamp(0.0, self.length_s);
        let now_ns = self.begin_ns.saturating_add((at_s * 1e9).round() as u64);
        self.play_to(now_ns);
        let mut state = self.picture.state(now_ns);
        (state["live"], state["forecasts"]) = (false.into(), self.has_forecasts.into());
        (state["at_s"], state["length_s"]) = (at_s.into(), self.length_s.into());
        state["map"] = self.plan.as_ref().map(Plan::key).into();
        state["daemon"] = json!({"alarm": false, "text": "A recording."});
        self.plan.iter().for_each(|plan| plan.name(&mut state));
        state
    }

    fn plan(&mut self) -> Option<Value> {
        self.plan.as_ref().map(|plan| plan.drawing.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eventually::eventually;
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::ids::UnixNs;
    use roomcast_core::narration::{Event, Observation};
    use roomcast_core::semantic_map::SemanticMap;
    use roomcast_ipc::raw::{action, narration_kind};
    use roomcast_ipc::text;
    use roomcast_services::daemon::Journal;
    use std::io::{Read, Write};
    use std::path::PathBuf;

    const HOSTILE: &str = "<img src=x onerror=alert(1)>";

    #[test]
    fn what_comes_from_the_system_is_never_markup() {
        for way in [
            "innerHTML",
            "outerHTML",
            "insertAdjacentHTML",
            "document.write",
            "eval(",
            "DOMParser",
            "createContextualFragment",
            "http://e",
            "https://",
        ] {
            assert!(!SCRIPT.contains(way), "{way}");
        }
        assert!(!PAGE.contains("https://") && !STYLE.contains("url("), "the page needs nothing from elsewhere");
        let mut picture = Picture::default();
        picture.narration(&NarrationV1::new(narration_kind::SENTENCE, &format!("They say {HOSTILE}")).unwrap(), 1);
        let state = picture.state(2).to_string();
        assert_eq!(
            serde_json::from_str::<Value>(&state).unwrap()["narration"][0]["text"],
            format!("They say {HOSTILE}.")
        );
    }

    fn moment(scene: &str) -> Moment {
        let map = SemanticMap::from_json(scene).unwrap();
        serde_json::from_value(json!({
            "version": 1, "epoch": "", "sequence": 0, "computed_unix_ns": 0, "model": "", "model_fingerprint": "",
            "map_fingerprint": hex::encode(map.fingerprint()), "grounding": GroundingOptions::default(), "binding_name": "", "binding": "",
            "narration": [], "included": [], "labels": [], "scene": serde_json::from_str::<Value>(scene).unwrap(),
        }))
        .unwrap()
    }

    const STUDIO: &str = include_str!("../scenes/studio.json");

    #[test]
    fn storeys_lie_beside_each_other_on_the_plan() {
        let room = |id: &str, floor_m: f64| json!({"id": id, "label": id, "box": {"min_m": [0.0, 0.0, floor_m], "max_m": [4.0, 4.0, floor_m + 2.5]}});
        let tub = json!({"id": "tub", "label": "bathtub", "position_m": [1.0, 1.0, 3.4], "box": {"min_m": [0.5, 0.5, 3.0], "max_m": [1.5, 1.5, 3.8]}});
        let scene = json!({"format": "roomcast-scene", "version": 1, "name": "house", "rooms": [room("hall", 0.0), room("bathroom", 3.0)],
            "doors": [{"id": "stairs", "rooms": ["hall", "bathroom"], "position_m": [2.0, 2.0, 3.0]}], "items": [tub]});
        let drawing = Plan::of_moment(&moment(&scene.to_string())).unwrap().drawing;
        let ring = |room: usize| drawing["rooms"][room]["rings"][0].clone();
        assert_eq!(ring(0), json!([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]));
        assert_eq!(ring(1), json!([[5.0, 0.0], [9.0, 0.0], [9.0, 4.0], [5.0, 4.0]]));
        assert_eq!(drawing["doors"], json!([[2.0, 2.0], [7.0, 2.0]]), "one on each");
        assert_eq!(drawing["items"][0]["at"], json!([6.0, 1.0]));
        let names = json!([{"name": "floor at 0 m", "at": [0.0, 4.0]}, {"name": "floor at 3 m", "at": [5.0, 4.0]}]);
        assert_eq!(drawing["storeys"], names);
        assert_eq!(Plan::of_moment(&moment(STUDIO)).unwrap().drawing["storeys"], json!([]));
    }

    #[test]
    fn a_plan_has_every_room_and_thing() {
        let plan = Plan::of_moment(&moment(STUDIO)).unwrap();
        let map = SemanticMap::from_json(STUDIO).unwrap();
        let rooms = plan.drawing["rooms"].as_array().unwrap();
        assert_eq!((rooms.len(), plan.names.len()), (map.rooms().len(), map.rooms().len()));
        assert!(rooms.iter().all(|room| room["rings"][0].as_array().unwrap().len() >= 4), "{rooms:?}");
        assert_eq!(plan.drawing["items"].as_array().unwrap().len(), map.items().len());
    }

    fn scores(sequence: u64, kitchen: f64) -> RoomScoresV1 {
        scores_of(&moment(STUDIO), sequence, &[("kitchen", kitchen), ("bathroom", 1.0 - kitchen)])
    }

    fn scores_of(moment: &Moment, sequence: u64, likely: &[(&str, f64)]) -> RoomScoresV1 {
        let plan = Plan::of_moment(moment).unwrap();
        let others =
            plan.names.keys().map(|id| (id.as_str(), 0.0)).filter(|(id, _)| likely.iter().all(|own| own.0 != *id));
        let mut scores = RoomScoresV1 { epoch: 1, sequence, ..Default::default() };
        scores.map_fingerprint.copy_from_slice(&hex::decode(&plan.map).unwrap());
        for (place, (id, probability)) in likely.iter().copied().chain(others).enumerate() {
            scores.room[place].id = text::encode("id", id).unwrap();
            scores.room[place].probability = probability;
            scores.room_count = place as u32 + 1;
        }
        scores
    }

    /// A restarted daemon may have the same map in other partitions.
    #[test]
    fn a_plan_is_of_the_partitions_that_are_scored() {
        let rooms = moment(include_str!("../scenes/apartment-e0.json"));
        let mut groups = rooms.clone();
        groups.grounding.level = roomcast_core::grounding::PartitionLevel::Group;
        let plans = [&rooms, &groups].map(|moment| Plan::of_moment(moment).unwrap());
        assert_ne!(plans[0].names, plans[1].names, "the scene has groups");
        assert_ne!(plans[0].key(), plans[1].key());
        let of_rooms = scores_of(&rooms, 1, &[]);
        let of_groups = RoomScoresV1 { epoch: 2, ..scores_of(&groups, 1, &[]) };
        let mut live = Live::default();
        for (scores, plan) in [(of_rooms, 0), (of_groups, 1)] {
            live.picture.scores(&scores, 1);
            for (index, moment) in [&rooms, &groups].into_iter().enumerate() {
                live.plan = Plan::of_moment(moment).ok();
                let key = if index == plan { json!(plans[plan].key()) } else { Value::Null };
                assert_eq!(live.state(None)["map"], key);
                assert_eq!(live.plan().unwrap()["map"], plans[index].key());
            }
        }
        // A recording of both daemons has a moment of each.
        let messages = [of_rooms, of_groups].map(|scores| Recorded::RoomScores(Box::new(scores)));
        let messages = [0, 1_000_000_000].into_iter().zip(messages).collect();
        let mut played = Played::new(Recording { messages, maps: vec![rooms, groups], ..Recording::default() });
        for (at_s, plan) in [(1.0, 1), (0.0, 0), (1.0, 1)] {
            assert_eq!(played.state(Some(at_s))["map"], plans[plan].key());
            assert_eq!(played.plan().unwrap()["map"], plans[plan].key());
        }
    }

    /// Scores and persons arrive separately: while the map changes, their rooms differ.
    #[test]
    fn persons_are_shown_in_the_rooms_that_are_scored() {
        let mut picture = Picture::default();
        picture.persons(&PersonScoresV1 { epoch: 1, person_count: 1, ..Default::default() });
        let forecasts = |ids: &[&str]| {
            let (room_count, person_count, horizon_count) = (ids.len() as u32, 1, 1);
            let mut told =
                PersonForecastsV1 { epoch: 1, room_count, person_count, horizon_count, ..Default::default() };
            ids.iter().zip(&mut told.id).for_each(|(id, own)| *own = text::encode("id", id).unwrap());
            told
        };
        let all: Vec<String> = scores(1, 0.5).rooms().iter().map(|room| room.id().to_owned()).collect();
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        let other: Vec<&str> = all.iter().rev().copied().collect();
        picture.scores(&scores(1, 0.5), 1);
        for (ids, shown) in [(&all[..], true), (&all[1..], false), (&other[..], false), (&[][..], false)] {
            picture.forecasts(&forecasts(ids), 1);
            let rooms = &picture.state(2)["persons"][0]["rooms"];
            assert_eq!(rooms.as_array().map(Vec::len), shown.then_some(all.len()), "{ids:?}");
        }
    }

    #[test]
    fn a_recording_is_shown_as_it_was_at_each_moment() {
        let said = NarrationV1::new(narration_kind::SENTENCE, "They open the fridge.").unwrap();
        let messages = vec![
            (1_000_000_000, Recorded::RoomScores(Box::new(scores(1, 0.25)))),
            (2_000_000_000, Recorded::Narration(Box::new(said))),
            (3_000_000_000, Recorded::RoomScores(Box::new(scores(2, 0.75)))),
        ];
        let mut played = Played::new(Recording { messages, maps: vec![moment(STUDIO)], ..Recording::default() });
        for (at_s, kitchen, told) in
            [(None, 0.75, 1), (Some(0.5), 0.25, 0), (Some(1.5), 0.25, 1), (Some(99.0), 0.75, 1), (Some(-1.0), 0.25, 0)]
        {
            let state = played.state(at_s);
            assert_eq!(state["rooms"][0]["next"], kitchen, "{at_s:?}");
            assert_eq!(state["rooms"][0]["name"], "kitchen");
            assert_eq!(state["narration"].as_array().unwrap().len(), told, "{at_s:?}");
            assert_eq!((&state["live"], &state["length_s"]), (&json!(false), &json!(2.0)));
            assert_eq!(state["map"], played.plan().unwrap()["map"]);
        }
    }

    /// Regression: a newly opened page showed the last decision of any robot as this one's.
    #[test]
    fn of_several_robots_the_configured_one_is_shown_and_others_by_their_names() {
        let of = |robot: &str, sequence: u64, to: &str| DecisionV1 {
            robot: sequence::source_of_name(robot),
            robot_name: text::encode_cut(robot),
            sequence,
            action: action::GO,
            to: text::encode("to", to).unwrap(),
            ..Default::default()
        };
        let shown = |own: Option<&str>, told: &[DecisionV1]| {
            let own = own.map(sequence::source_of_name);
            let mut picture = Picture::of_robot(own);
            (1..).zip(told).for_each(|(at_ns, decision)| picture.decision(decision, at_ns));
            picture.state(9)["decision"]["text"].as_str().unwrap_or_default().to_owned()
        };
        let (own, other) = (of("dusty", 1, "hall"), of("rusty", 1, "kitchen"));
        assert_eq!(shown(Some("dusty"), &[own, other, other]), "The robot goes to hall.");
        assert_eq!(shown(Some("dusty"), &[other]), "The robot rusty goes to kitchen.");
        assert_eq!(shown(Some("dusty"), &[other, own, of("rusty", 2, "office")]), "The robot goes to hall.");
        // A recording has no configuration.
        assert_eq!(shown(None, &[own]), "The robot goes to hall.");
        assert_eq!(shown(None, &[own, other]), "The robot rusty goes to kitchen.");
    }

    /// Imported rooms have a number in their ids, which people do not use.
    #[test]
    fn rooms_are_called_by_their_names_wherever_they_are_told() {
        let text = include_str!("../tests/data/two_rooms.json").replace("\"kitchen\"", "\"kitchen-3\"");
        let text = text.replace("\"label\": \"kitchen-3\"", "\"label\": \"kitchen\"");
        let plan = Plan::of_moment(&moment(&text)).unwrap();
        assert_eq!(plan.names.get("kitchen-3").map(String::as_str), Some("kitchen"), "{:?}", plan.names);
        let mut picture = Picture::default();
        let to = text::encode("to", "kitchen-3").unwrap();
        let reason = text::encode("reason", "somebody came into kitchen-3 (98 %), not kitchen-30").unwrap();
        picture.decision(&DecisionV1 { action: action::GO, to, reason, ..Default::default() }, 1);
        for (kind, said) in
            [(narration_kind::SENTENCE, "They say kitchen-3."), (narration_kind::PRESENCE, "present in the kitchen-3")]
        {
            picture.narration(&NarrationV1::new(kind, said).unwrap(), 1);
        }
        let mut state = picture.state(2);
        plan.name(&mut state);
        assert_eq!(state["decision"]["text"], "The robot goes to kitchen.");
        assert_eq!(state["decision"]["to"], "kitchen-3", "the plan marks it by its id");
        assert_eq!(state["decision"]["reason"], "somebody came into kitchen (98 %), not kitchen-30");
        assert_eq!(state["narration"][0]["text"], "present in the kitchen");
        assert_eq!(state["narration"][1]["text"], "They say kitchen-3.");
    }

    #[test]
    fn the_strip_has_a_stay_for_each_room_and_a_repeated_decision_prolongs_it() {
        let mut picture = Picture::default();
        picture.scores(&scores(1, 0.5), 1);
        let second = 1_000_000_000;
        for (sequence, (action, room)) in (1..).zip([
            (action::GO, "kitchen"),
            (action::STAY, "kitchen"),
            (action::STAY, "kitchen"),
            (action::GO, "bathroom"),
        ]) {
            let to = text::encode("to", room).unwrap();
            picture.decision(&DecisionV1 { sequence, action, to, ..Default::default() }, sequence * second);
        }
        let stays = picture.state(10 * second)["decision"]["stays"].clone();
        let stay =
            |room: &str, ago_s: f64, works: bool| json!({"room": room, "name": room, "ago_s": ago_s, "works": works});
        assert_eq!(
            stays,
            json!([stay("kitchen", 9.0, true), stay("kitchen", 8.0, false), stay("bathroom", 6.0, true)])
        );
    }

    #[test]
    fn a_decision_says_which_rooms_are_still_to_do() {
        let mut picture = Picture::default();
        picture.scores(&scores(1, 0.5), 1);
        let told = DecisionV1 { scores_epoch: 1, covered: 0b01, ..Default::default() };
        picture.decision(&told, 1);
        let left = picture.state(2)["decision"]["left"].clone();
        assert!(left[0] == "bathroom" && !left.as_array().unwrap().contains(&json!("kitchen")), "{left}");
        picture.decision(&DecisionV1 { sequence: 1, scores_epoch: 2, ..told }, 1);
        assert_eq!(picture.state(2)["decision"]["left"], Value::Null, "its bits are of other rooms");
    }

    #[test]
    fn a_recording_says_what_it_has() {
        let of = |messages| {
            Played::new(Recording { messages, maps: vec![moment(STUDIO)], ..Recording::default() }).state(None)
        };
        let scored = (1, Recorded::RoomScores(Box::new(scores(1, 0.25))));
        let state = of(vec![scored.clone()]);
        assert_eq!((&state["forecasts"], &state["length_s"]), (&json!(false), &json!(0.0)));
        assert_eq!(of(vec![scored, (9, Recorded::Forecast(Box::default()))])["forecasts"], true);
        assert_eq!(Live::default().state(None)["forecasts"], true);
    }

    /// If other subscribers have all places of the things' scores, the view goes on without them.
    #[test]
    fn the_page_does_without_scores_of_things_while_others_have_the_places() {
        let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("things-{}", std::process::id())).unwrap();
        let node = domain.open("test").unwrap();
        let mut others = Vec::new();
        while let Some(other) = node.try_item_scores_subscriber().unwrap() {
            others.push(other);
        }
        assert!(!others.is_empty());
        let mut things = Things::default();
        things.follow(&node, true);
        assert!(things.scores.is_none() && things.news().unwrap().is_none());
        others.pop();
        things.follow(&node, true);
        assert!(things.scores.is_none(), "it tries again after a while, and not at each turn");
        things.refused = None;
        things.follow(&node, true);
        assert!(things.scores.is_some());
        things.follow(&node, false);
        assert!(things.scores.is_none() && things.refused.is_none());
        drop((others, node));
        let _left = domain.clean_up();
    }

    fn viewed(domain: &Domain) -> (SocketAddr, Stop, std::thread::JoinHandle<Result<(), ViewError>>) {
        viewed_with(domain, None)
    }

    fn viewed_with(
        domain: &Domain,
        state: Option<PathBuf>,
    ) -> (SocketAddr, Stop, std::thread::JoinHandle<Result<(), ViewError>>) {
        let (stop, (found, address)) = (Stop::new(), std::sync::mpsc::channel());
        let (own_stop, own_domain) = (stop.clone(), domain.clone());
        let any = Place { key: Some("k3y".to_owned()), ..Place::with_key("127.0.0.1:0".parse().unwrap()) };
        let thread = std::thread::spawn(move || {
            run(&any, &own_domain, "robot", state.as_deref(), &own_stop, |address| found.send(address).unwrap())
        });
        (address.recv_timeout(Duration::from_secs(60)).unwrap(), stop, thread)
    }

    fn got(address: SocketAddr, path: &str, host: &str, key: &str) -> String {
        answered(address, &format!("GET {path}"), host, key)
    }

    fn answered(address: SocketAddr, what: &str, host: &str, key: &str) -> String {
        let mut stream = std::net::TcpStream::connect(address).unwrap();
        write!(stream, "{what} HTTP/1.1\r\nHost: {host}\r\nX-Roomcast-Key: {key}\r\n\r\n").unwrap();
        let mut text = String::new();
        stream.read_to_string(&mut text).unwrap();
        text
    }

    /// Regression: a person who had left hours before was "away, 2 s ago", because kept messages arrive when the view joins.
    #[test]
    fn what_was_said_before_the_view_began_is_as_old_as_it_is() {
        let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("kept-{}", std::process::id())).unwrap();
        let node = domain.open("test").unwrap();
        let (narration, decisions) = (node.publisher().unwrap(), node.publisher().unwrap());
        // As old as the machine's clock allows.
        let (then_ns, (epoch, sequence)) = (1, (1, 1));
        let said = NarrationV1::new(narration_kind::SENTENCE, "They open the fridge.").unwrap();
        narration.send(&NarrationV1 { source: 7, epoch, sequence, observed_ns: then_ns, ..said }).unwrap();
        let (robot, to) = (sequence::source_of_name("robot"), text::encode("to", "kitchen").unwrap());
        let action = action::GO;
        let decision = DecisionV1 { robot, epoch, sequence, decided_ns: then_ns, action, to, ..Default::default() };
        decisions.send(&decision).unwrap();
        let least_s = clock::monotonic_ns() as f64 / 1e9 - 1.0;
        let (address, stop, thread) = viewed(&domain);
        let ages = eventually("narration and decision have an age", || {
            // Late subscribers get earlier messages.
            narration.tick().unwrap();
            decisions.tick().unwrap();
            let answer = got(address, "/state", "localhost", "k3y");
            let state: Value = serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap();
            let ages = [&state["narration"][0]["age_s"], &state["decision"]["age_s"]].map(Value::as_f64);
            Some([ages[0]?, ages[1]?])
        });
        assert!(ages.into_iter().all(|age_s| age_s >= least_s), "{ages:?}, at least {least_s}");
        stop.request();
        assert!(matches!(thread.join(), Ok(Ok(()))));
        drop((narration, decisions, node));
        let _left = domain.clean_up();
        // A message without a time counts as of now, and no message is dated ahead.
        assert_eq!([told_ns(0, 9), told_ns(5, 9), told_ns(12, 9)], [9, 5, 9]);
    }

    #[test]
    fn orders_need_the_key_and_post() {
        let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("orders-{}", std::process::id())).unwrap();
        let node = domain.open("test").unwrap();
        let reports = node.subscriber::<RobotReportV1>().unwrap();
        let (address, stop, thread) = viewed(&domain);
        for (what, host, key, status) in [
            ("POST /order?kind=hold", "localhost", "", "403"),
            ("POST /order?kind=hold", "localhost", "other", "403"),
            ("POST /order?kind=hold", "evil.example", "k3y", "421"),
            ("GET /order?kind=hold", "localhost", "k3y", "404"),
            ("POST /state", "localhost", "k3y", "405"),
            ("POST /order?kind=finished", "localhost", "k3y", "400"),
            ("POST /order?kind=clean&room=0", "localhost", "k3y", "400"),
            ("POST /order?kind=hold&for=60", "localhost", "k3y", "200"),
        ] {
            let answer = answered(address, what, host, key);
            assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{what} {key:?}: {answer}");
        }
        let order = (0..600).find_map(|_| {
            reports.wait(Duration::from_millis(50)).unwrap();
            reports.receive().unwrap()
        });
        assert_eq!(order.map(|order| order.kind), Some(roomcast_ipc::raw::report_kind::HOLD));
        assert!(reports.receive().unwrap().is_none(), "the refused ones were not sent");
        stop.request();
        assert!(matches!(thread.join(), Ok(Ok(()))));
        drop((reports, node));
        let _left = domain.clean_up();
    }

    #[test]
    fn the_page_has_the_last_week_of_the_state_database() {
        let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let state = folder.path().join("state");
        let (journal, _) = Journal::open(&state, 1 << 20, Duration::from_secs(1)).unwrap();
        let (name, observed_unix_ns) = (Some("Ada".into()), UnixNs(clock::unix_ns()));
        let there = Observation::saying(1, Event::presence("present in the kitchen").unwrap());
        let number = journal.handle.append(&Observation { name, observed_unix_ns, ..there });
        assert!(journal.handle.wait_for(number, Duration::from_secs(60)));
        let domain = Domain::new(folder.path().join("d"), &format!("week-{}", std::process::id())).unwrap();
        let (address, stop, thread) = viewed_with(&domain, Some(state));
        eventually("the page has Ada's rooms", || {
            got(address, "/state", "localhost", "k3y");
            let week = got(address, "/week", "localhost", "k3y");
            week.contains(r#""person":"Ada","rooms":[["kitchen",1]]"#).then_some(())
        });
        stop.request();
        assert!(matches!(thread.join(), Ok(Ok(()))));
        let _left = domain.clean_up();
    }

    #[test]
    fn the_page_is_served_with_its_policy_to_this_machine_alone() {
        let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("view-{}", std::process::id())).unwrap();
        let (address, stop, thread) = viewed(&domain);
        let get_with = |path: &str, host: &str, key: &str| got(address, path, host, key);
        let get = |path: &str, host: &str| get_with(path, host, "k3y");
        let page = get_with("/", "localhost", "");
        assert!(page.starts_with("HTTP/1.1 200") && page.contains(POLICY) && page.contains("nosniff"), "{page}");
        for path in ["/page.css", "/page.js"] {
            assert!(get(path, "127.0.0.1:1").starts_with("HTTP/1.1 200"), "{path}");
        }
        let state = get("/state?at=nan", "localhost");
        assert!(state.contains("No daemon has been heard yet"), "{state}");
        for (path, host, status) in
            [("/state", "evil.example", "421"), ("/plan", "localhost", "404"), ("/../etc/passwd", "localhost", "404")]
        {
            assert!(get(path, host).starts_with(&format!("HTTP/1.1 {status}")), "{path} {host}");
        }
        for key in ["", "k3x", "k3", "k3yy"] {
            assert!(get_with("/state", "localhost", key).starts_with("HTTP/1.1 403"), "{key:?}");
            for path in ["/plan", "/week"] {
                assert!(get_with(path, "localhost", key).starts_with("HTTP/1.1 403"), "{key:?}");
            }
        }
        stop.request();
        assert!(matches!(thread.join(), Ok(Ok(()))));
        let _left = domain.clean_up();
    }
}
