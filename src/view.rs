//! Serves the page of `roomcast view`: the plan of the map, and the places of persons and robot, as JSON for the page in `view/`.
//!
//! Only loopback addresses are served, and only requests that name one: a foreign page in the browser must not read the places of people. Other users
//! of the machine need the key of this start. The page may load nothing from other hosts. Data reaches the page as JSON, never as markup.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::reasons::Reasons;
use hyper::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderName, HeaderValue};
use hyper::{Response, StatusCode};
use roomcast_core::ids::PersonId;
use roomcast_core::semantic_map::{SceneError, SemanticMap, Storey, Storeys};
use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, MAX_HORIZONS, NarrationV1, PersonForecastV1, PersonForecastsV1, PersonScoresV1, PersonV1,
    RobotReportV1, RoomScoresV1, RoomV1, action, presence,
};
use roomcast_ipc::{
    Domain, IpcError, ItemScores, ItemScoresSubscriber, Node, Presence, Subscriber, clock, question, sequence,
};
use roomcast_services::daemon::flag_words;
use roomcast_services::message_text::event_of;
use roomcast_services::moment::{Moment, MomentError};
use roomcast_services::recording::{Recorded, Recording};
use roomcast_services::stop::Stop;
use serde_json::{Value, json};

use crate::decided::{Decided, News};
use crate::flags::{decision_flag_names, forecast_flag_names, plain, score_flag_names};
use crate::http::{HttpError, Request, Server, refusal};
use crate::robot_place::Places;
use crate::top::who;

const PAGE: &str = include_str!("view/page.html");
const STYLE: &str = include_str!("view/page.css");
const SCRIPT: &str = include_str!("view/page.js");
/// The page may load only its own style, script and data.
const POLICY: &str = "default-src 'none'; style-src 'self'; script-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

const NARRATIONS: usize = 50;
/// The beginning of a presence event's text.
const PRESENT_IN: &str = "present in the ";
/// Silence after which the daemon counts as gone, in nanoseconds: some heartbeats.
const SILENCE_NS: u64 = 1_500_000_000;
/// Things' scores cost the daemon a little. The view stops asking for them this long after the last request of the page.
const LOOKED: Duration = Duration::from_secs(5);
const TICK: Duration = Duration::from_millis(200);
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
    /// The secret of those who may look; `None` lets every user of the machine look.
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

/// Serves the page of the running system until asked to stop. Among several robots it shows the configured one, `robot`. `ready` gets the address,
/// with the port that was chosen for port 0.
///
/// # Errors
/// [`ViewError`] for an address that is not loopback or is taken, and if a service is lost.
pub fn run(
    place: &Place,
    domain: &Domain,
    robot: &str,
    stop: &Stop,
    ready: impl FnOnce(SocketAddr),
) -> Result<(), ViewError> {
    let node = domain.open("roomcast-view")?;
    let scores: Subscriber<RoomScoresV1> = node.subscriber()?;
    let forecast: Subscriber<ForecastV1> = node.subscriber()?;
    let persons: Subscriber<PersonScoresV1> = node.subscriber()?;
    let forecasts: Subscriber<PersonForecastsV1> = node.subscriber()?;
    let narration: Subscriber<NarrationV1> = node.subscriber()?;
    let decisions: Subscriber<DecisionV1> = node.subscriber()?;
    // If this service has no free place, the robot's place is unknown.
    let mut reports: Option<Subscriber<RobotReportV1>> = node.subscriber().ok();
    let moments = node.question_port(question::MOMENT)?;
    let mut reasons = Reasons::new(&node)?;
    let picture = Picture { robot: Some(sequence::source_of_name(robot)), is_configured: true, ..Picture::default() };
    let shared = Arc::new(Mutex::new(Live { picture, ..Live::default() }));
    let (answered, key) = (Arc::clone(&shared), place.key.clone());
    let mut server = Server::start(place.address, stop, move |request| {
        let mut live = answered.lock().unwrap_or_else(PoisonError::into_inner);
        answer(request, key.as_deref(), &mut *live)
    })?;
    ready(server.address());
    let (mut things, mut asked) = (Things::default(), None::<Instant>);
    while !stop.requested() {
        scores.wait(TICK)?;
        let now_ns = clock::monotonic_ns();
        let mut live = shared.lock().unwrap_or_else(PoisonError::into_inner);
        let picture = &mut live.picture;
        // Malformed messages are skipped; `roomcast top` and the metrics count them.
        while let Some(message) = narration.receive()? {
            picture.narration(&message, told_ns(message.observed_ns, now_ns));
        }
        if let Some(message) = scores.newest()? {
            picture.scores(&message, now_ns);
        }
        if let Some(message) = forecast.newest()? {
            picture.forecast(&message);
        }
        if let Some(message) = persons.newest()? {
            picture.persons(&message);
        }
        if let Some(message) = forecasts.newest()? {
            picture.forecasts(&message, now_ns);
        }
        while let Some(report) = reports.as_mut().map(|reports| reports.receive()).transpose()?.flatten() {
            picture.report(&report);
        }
        while let Some(message) = decisions.receive()? {
            picture.decision(&message, told_ns(message.decided_ns, now_ns));
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
}

fn answer(request: Request<'_>, key: Option<&str>, shown: &mut impl Shown) -> Response<String> {
    let is_data = ["/state", "/plan"].contains(&request.uri.path());
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
    plan: Option<Plan>,
    /// When the page last asked.
    looked: Option<Instant>,
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
        state["map"] = plan.map(Plan::key).into();
        state["daemon"] = self.picture.daemon(now_ns);
        plan.iter().for_each(|plan| plan.name(&mut state));
        state
    }

    fn plan(&mut self) -> Option<Value> {
        self.plan.as_ref().map(|plan| plan.drawing.clone())
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

/// A map to draw, in its partitions. One map can have several plans.
#[derive(Debug)]
struct Plan {
    /// The map's fingerprint, hexadecimal.
    map: String,
    level: &'static str,
    /// The names of its partitions, by id.
    names: BTreeMap<String, String>,
    drawing: Value,
}

impl Plan {
    /// The page's key for the plan.
    fn key(&self) -> String {
        format!("{}-{}", self.map, self.level)
    }

    fn of_moment(moment: &Moment) -> Result<Self, MomentError> {
        let explained = SemanticMap::from_json(&moment.scene.to_string());
        Self::of_map(&explained.map_err(MomentError::Scene)?, moment).map_err(MomentError::Scene)
    }

    fn of_map(map: &SemanticMap, moment: &Moment) -> Result<Self, SceneError> {
        let metres = |value: f64| (value * 1e3).round() / 1e3;
        let point = |[x, y]: [f64; 2]| json!([metres(x), metres(y)]);
        let partitions = roomcast_core::grounding::partitions(map, moment.grounding.level);
        let names = roomcast_core::grounding::partition_names(&partitions);
        let storeys = Storeys::of(map);
        let room = |(partition, name): (&roomcast_core::grounding::Partition, &String)| {
            let rings = partition.spaces.iter().flat_map(|space| storeys.moved_space(space).rings());
            let rings: Vec<Vec<Value>> = rings.map(|ring| ring.into_iter().map(point).collect()).collect();
            json!({"id": partition.id, "name": name, "rings": rings})
        };
        let item = |item: &roomcast_core::semantic_map::Item| {
            let [x, y, _] = item.position_m;
            let at = storeys.moved(storeys.of_item(map, item), [x, y]);
            json!({"id": item.id, "label": map.labels()[item.label.0 as usize], "at": point(at)})
        };
        let doors = map.doors().iter().flat_map(|door| {
            // A door between storeys is drawn on both.
            let mut on = door.rooms.map(|room| storeys.of_space(&map.rooms()[room.0 as usize].space)).to_vec();
            on.dedup();
            let [x, y, _] = door.position_m;
            on.into_iter().map(|storey| point(storeys.moved(storey, [x, y]))).collect::<Vec<_>>()
        });
        let storey = |own: &Storey| json!({"name": own.name(), "at": point([own.min_m[0], own.max_m[1]])});
        let named = storeys.all().iter().filter(|_| storeys.all().len() > 1);
        let rooms: Vec<Value> = partitions.iter().zip(&names).map(room).collect();
        let names = partitions.iter().map(|partition| partition.id.clone()).zip(names);
        let mut plan = Self {
            map: moment.map_fingerprint.clone(),
            level: moment.grounding.level.into(),
            names: names.collect(),
            drawing: Value::Null,
        };
        plan.drawing = json!({
            "map": plan.key(), "name": map.name(),
            "rooms": rooms,
            "storeys": named.map(storey).collect::<Vec<_>>(), "doors": doors.collect::<Vec<_>>(), "items": map.items().iter().map(item).collect::<Vec<_>>(),
        });
        Ok(plan)
    }

    fn name(&self, state: &mut Value) {
        for room in state["rooms"].as_array_mut().into_iter().flatten() {
            if let Some(name) = room["id"].as_str().and_then(|id| self.names.get(id)) {
                room["name"] = name.as_str().into();
            }
        }
        for (part, name) in [("decision", "text"), ("decision", "reason")] {
            if let Some(text) = state[part][name].as_str() {
                state[part][name] = self.in_names(text).into();
            }
        }
        for told in state["narration"].as_array_mut().into_iter().flatten() {
            // A sentence is shown as the model reads it. Only presence has a room's id.
            if let Some(text) = told["text"].as_str().filter(|text| text.starts_with(PRESENT_IN)) {
                told["text"] = self.in_names(text).into();
            }
        }
    }

    /// Replaces rooms' ids by their names.
    fn in_names(&self, text: &str) -> String {
        let is_id = |character: char| character.is_alphanumeric() || character == '-' || character == '_';
        let (mut named, mut rest) = (String::with_capacity(text.len()), text);
        while !rest.is_empty() {
            let (word, after) = rest.split_at(rest.find(|character| !is_id(character)).unwrap_or(rest.len()));
            named.push_str(self.names.get(word).map_or(word, String::as_str));
            let (between, after) = after.split_at(after.find(is_id).unwrap_or(after.len()));
            named.push_str(between);
            rest = after;
        }
        named
    }
}

/// A probability with the digits that the page needs.
fn short(p: f64) -> f64 {
    (p * 1e4).round() / 1e4
}

fn row(row: &[f32]) -> Vec<f64> {
    row.iter().map(|p| short(f64::from(*p))).collect()
}

/// The newest messages.
#[derive(Debug, Default)]
struct Picture {
    scores: Option<(RoomScoresV1, u64)>,
    forecast: Option<Box<ForecastV1>>,
    persons: Option<Box<PersonScoresV1>>,
    forecasts: Option<Box<PersonForecastsV1>>,
    decision: Option<(DecisionV1, u64)>,
    /// The robot that is shown without its name: the configured one, or the first of a recording.
    robot: Option<u64>,
    /// Others are shown only before its first decision.
    is_configured: bool,
    decided: Decided,
    places: Places,
    /// The newest first: time, source, text.
    narration: VecDeque<(u64, String, String)>,
    items: BTreeMap<String, f64>,
    quality: Quality,
    /// By person: the observation with the largest effect on the belief.
    reasons: BTreeMap<u32, String>,
}

impl Picture {
    fn take(&mut self, message: &Recorded, taken_ns: u64) {
        match message {
            Recorded::Narration(message) => self.narration(message, taken_ns),
            Recorded::RoomScores(message) => self.scores(message, taken_ns),
            Recorded::PersonScores(message) => self.persons(message),
            Recorded::Forecast(message) => self.forecast(message),
            Recorded::PersonForecasts(message) => self.forecasts(message, taken_ns),
            Recorded::Decision(message) => self.decision(message, taken_ns),
            Recorded::RobotReport(message) => self.report(message),
        }
    }

    fn scores(&mut self, scores: &RoomScoresV1, taken_ns: u64) {
        self.scores = Some((*scores, taken_ns));
    }

    fn forecast(&mut self, forecast: &ForecastV1) {
        self.forecast = Some(Box::new(*forecast));
    }

    fn persons(&mut self, persons: &PersonScoresV1) {
        self.persons = Some(Box::new(*persons));
    }

    fn forecasts(&mut self, forecasts: &PersonForecastsV1, taken_ns: u64) {
        self.quality.take(forecasts, self.persons.as_deref(), taken_ns);
        self.forecasts = Some(Box::new(*forecasts));
    }

    fn report(&mut self, report: &RobotReportV1) {
        self.places.take(report, self.decision.as_ref().map(|(decision, _)| decision));
    }

    fn decision(&mut self, decision: &DecisionV1, taken_ns: u64) {
        let own = *self.robot.get_or_insert(decision.robot);
        let is_others = |known: &(DecisionV1, u64)| known.0.robot != own;
        let is_shown = decision.robot == own || !self.is_configured || self.decision.as_ref().is_none_or(is_others);
        if self.decided.take(decision) != News::None && is_shown {
            self.decision = Some((*decision, taken_ns));
        }
    }

    fn narration(&mut self, narration: &NarrationV1, taken_ns: u64) {
        self.narration.truncate(NARRATIONS - 1);
        // As the model reads it, or the raw text if it is not an observation.
        let event = event_of(narration.kind, narration.text());
        let text = event.map_or_else(|_| narration.text().to_owned(), |event| event.to_string());
        let source = match narration.person_name() {
            "" => narration.source_name().to_owned(),
            name => format!("{name} \u{b7} {}", narration.source_name()),
        };
        self.narration.push_front((taken_ns, source, text));
    }

    fn items(&mut self, items: &ItemScores) {
        let mass: f64 = items.items.iter().map(|item| item.log_score_nats.exp()).sum();
        let share = |log_nats: f64| if mass > 0.0 { short(log_nats.exp() / mass) } else { 0.0 };
        let items = items.items.iter().map(|item| (item.id().to_owned(), share(item.log_score_nats)));
        self.items = items.filter(|(_, share)| *share > 0.0).collect();
    }

    /// The fingerprint of the scores' map, hexadecimal.
    fn map(&self) -> Option<String> {
        self.scores.as_ref().map(|(scores, _)| hex::encode(scores.map_fingerprint))
    }

    /// Whether the scores have this plan's map and partitions.
    fn is_on(&self, plan: &Plan) -> bool {
        let Some((scores, _)) = &self.scores else { return false };
        let rooms = scores.rooms();
        hex::encode(scores.map_fingerprint) == plan.map
            && rooms.len() == plan.names.len()
            && rooms.iter().all(|room| plan.names.contains_key(room.id()))
    }

    fn daemon(&self, now_ns: u64) -> Value {
        let Some((scores, _)) = &self.scores else {
            return json!({"alarm": true, "text": "No daemon has been heard yet: start `roomcast daemon`."});
        };
        let silence_ns = scores.silence_ns(now_ns);
        if silence_ns > SILENCE_NS {
            let text =
                format!("The daemon has been silent for {:.0} s: what is shown is old.", silence_ns as f64 / 1e9);
            return json!({"alarm": true, "text": text});
        }
        let flags = score_flag_names(scores.flags & !roomcast_ipc::raw::score_flags::HEARTBEAT);
        let flags: Vec<_> = flags.into_iter().map(plain).collect();
        let flags = if flags.is_empty() { String::new() } else { format!(" ({})", flags.join(", ")) };
        json!({"alarm": false, "text": format!("The daemon is alive{flags}.")})
    }

    fn state(&self, now_ns: u64) -> Value {
        let seconds = |then_ns: u64| now_ns.saturating_sub(then_ns) as f64 / 1e9;
        let scores = self.scores.as_ref().map(|(scores, _)| scores);
        let forecast = self
            .forecast
            .as_deref()
            .filter(|own| scores.is_some_and(|of| (of.epoch, of.room_count) == (own.epoch, own.room_count)));
        let horizons = forecast.map_or(0, |own| (own.horizon_count as usize).min(MAX_HORIZONS));
        let rooms = scores.map_or(&[][..], |scores| scores.rooms()).iter().enumerate().map(|(place, room)| {
            let occupied =
                forecast.and_then(|own| own.room(place)).filter(|(id, _)| *id == room.id()).map(|(_, p)| row(p));
            json!({"id": room.id(), "name": room.id(), "next": short(room.probability), "occupied": occupied})
        });
        let said =
            self.narration.iter().map(|(at_ns, who, text)| json!({"age_s": seconds(*at_ns), "who": who, "text": text}));
        let decision = self.decision.as_ref().map(|(decision, taken_ns)| {
            let robot = match decision.robot_name() {
                name if self.robot != Some(decision.robot) && !name.is_empty() => format!("The robot {name}"),
                _ => "The robot".to_owned(),
            };
            let text = match decision.action {
                action::GO => format!("{robot} goes to {}.", decision.to()),
                action::PAUSE => format!("{robot} pauses where it disturbs nobody."),
                _ if !decision.to().is_empty() && decision.to() != decision.from() => {
                    format!("{robot} waits in {}, where nothing is to be done.", decision.to())
                }
                _ => format!("{robot} stays where it is."),
            };
            // The bits refer to the rooms of the scores behind the decision.
            let of = scores.filter(|scores| scores.epoch == decision.scores_epoch);
            let left = of.map(|scores| {
                let rooms = scores.rooms().iter().enumerate();
                rooms.filter(|(room, _)| decision.covered >> room & 1 == 0).map(|(_, room)| room.id()).collect::<Vec<_>>()
            });
            let place = self.places.of(decision.robot);
            let cleaned = of.map(|scores| {
                let rooms = scores.rooms().iter().zip(decision.cleaned_min).filter_map(|(room, minutes)| {
                    Some((room.id().to_owned(), f64::from(minutes.checked_sub(1)?) * 60.0 + seconds(*taken_ns)))
                });
                rooms.collect::<BTreeMap<_, _>>()
            });
            json!({
                "at": place.room(), "place": place.words(str::to_owned), "cleaned_s": cleaned,
                "to": decision.to(), "left": left, "text": text, "reason": decision.reason(), "policy": decision.policy(), "age_s": seconds(*taken_ns),
                "flags": decision_flag_names(decision.flags),
                "notes": decision_flag_names(decision.flags).into_iter().map(plain).collect::<Vec<_>>(),
            })
        });
        json!({
            "rooms": rooms.collect::<Vec<_>>(),
            "horizons_s": forecast.map_or(&[][..], |own| &own.horizon_s[..horizons]),
            "forecast_flags": forecast.map_or_else(Vec::new, |own| forecast_flag_names(own.flags)),
            "persons": self.person_cards(), "decision": decision, "narration": said.collect::<Vec<_>>(),
            "items": self.items, "quality": self.quality.curve(),
        })
    }

    fn person_cards(&self) -> Vec<Value> {
        let Some(persons) = self.persons.as_deref() else { return Vec::new() };
        let rooms = self.scores.as_ref().map_or(&[][..], |(scores, _)| scores.rooms());
        // Forecasts refer to rooms by position. While the map changes, the positions are of other rooms.
        let is_of_these = |own: &&PersonForecastsV1| own.rooms().eq(rooms.iter().map(RoomV1::id));
        let forecasts = self.forecasts.as_deref().filter(|own| own.epoch == persons.epoch).filter(is_of_these);
        let card = |person: &PersonV1| {
            let own =
                forecasts.and_then(|told| Some((told, told.persons().iter().find(|own| own.person == person.person)?)));
            let mut card = json!({
                "name": who(PersonId(person.person), person.name()), "presence": Presence::of(person.presence).word(),
                "flags": flag_words(person.flags).collect::<Vec<_>>(),
                "notes": flag_words(person.flags).map(plain).collect::<Vec<_>>(),
                "why": self.reasons.get(&person.person),
            });
            if let Some((told, own)) = own {
                let horizons = told.horizons_s().len();
                let rooms =
                    (0..told.rooms().len()).filter_map(|room| own.probability.get(room)?.get(..horizons).map(row));
                card["rooms"] = rooms.collect::<Vec<_>>().into();
                if own.set_coverage > 0.0 {
                    let ids: Vec<&str> = told.rooms().collect();
                    let set = |horizon: usize| -> Vec<&str> {
                        let holds = |room: usize| own.set_holds(horizon, room) == Some(true);
                        let out = (own.set_holds_elsewhere(horizon) == Some(true)).then_some("out of the house");
                        ids.iter().enumerate().filter(|(room, _)| holds(*room)).map(|(_, id)| *id).chain(out).collect()
                    };
                    card["sets"] = (0..horizons).map(set).collect::<Vec<_>>().into();
                    let has = (0..horizons).map(|horizon| own.set_probability(horizon).map(short));
                    card["set_has"] = has.collect::<Vec<_>>().into();
                    card["coverage"] = short(f64::from(own.set_coverage)).into();
                }
                card["elsewhere"] = own.elsewhere.get(..horizons).map(row).into();
                let likely = likeliest(told, own).filter(|(_, p)| *p >= 0.5 && person.presence <= presence::PRESENT);
                card["likely"] = likely.map(|(room, _)| room).into();
            }
            card
        };
        persons.persons().iter().map(card).collect()
    }
}

/// A person's most probable room now, and its probability.
fn likeliest(told: &PersonForecastsV1, own: &PersonForecastV1) -> Option<(usize, f32)> {
    let now = (0..told.rooms().len()).filter_map(|room| Some((room, *own.probability.get(room)?.first()?)));
    now.max_by(|a, b| a.1.total_cmp(&b.1))
}

/// The quality of forecasts: the probability that the forecast of 15 minutes before gave to the observed room. Unobserved rooms are not compared, or
/// the forecast would be its own judge.
#[derive(Debug, Default)]
struct Quality {
    /// Forecasts a minute apart, the newest last.
    samples: VecDeque<(u64, Box<PersonForecastsV1>)>,
    /// Per hour, the newest last: its number, the sum of probabilities, and their count.
    hours: VecDeque<(u64, f64, u64)>,
}

impl Quality {
    const AHEAD_S: f32 = 900.0;
    const AHEAD_NS: u64 = 900_000_000_000;
    const MINUTE_NS: u64 = 60_000_000_000;
    const HOUR_NS: u64 = 3_600_000_000_000;
    /// A week.
    const HOURS: usize = 168;
    /// Least probability of a room that counts as known.
    const KNOWN: f32 = 0.9;

    fn take(&mut self, now: &PersonForecastsV1, persons: Option<&PersonScoresV1>, taken_ns: u64) {
        if self.samples.back().is_some_and(|(then_ns, _)| taken_ns.saturating_sub(*then_ns) < Self::MINUTE_NS) {
            return;
        }
        let is_old = |then_ns: u64| taken_ns.saturating_sub(then_ns) >= Self::AHEAD_NS + Self::MINUTE_NS;
        while self.samples.front().is_some_and(|(then_ns, _)| is_old(*then_ns)) {
            self.samples.pop_front();
        }
        let before = self.samples.front().filter(|(then_ns, _)| taken_ns.saturating_sub(*then_ns) >= Self::AHEAD_NS);
        if let Some((_, before)) =
            before.filter(|(_, before)| before.room_count == now.room_count && before.id == now.id)
        {
            let observed = |person: &&PersonForecastV1| {
                let told = persons.filter(|told| told.epoch == now.epoch).map_or(&[][..], PersonScoresV1::persons);
                let own = told.iter().find(|own| own.person == person.person).filter(|own| own.observed_ns > 0);
                own.is_some_and(|own| now.computed_ns.saturating_sub(own.observed_ns) <= Self::MINUTE_NS)
            };
            let given = now.persons().iter().filter(observed).filter_map(|person| Self::given(before, now, person));
            let (sum, count) = given.fold((0.0, 0), |(sum, count), p| (sum + f64::from(p), count + 1));
            let hour = taken_ns / Self::HOUR_NS;
            match self.hours.back_mut() {
                _ if count == 0 => {}
                Some(last) if last.0 == hour => (last.1, last.2) = (last.1 + sum, last.2 + count),
                _ => self.hours.push_back((hour, sum, count)),
            }
            if self.hours.len() > Self::HOURS {
                self.hours.pop_front();
            }
        }
        self.samples.push_back((taken_ns, Box::new(*now)));
    }

    /// The probability that the earlier forecast gave to a person's present place.
    fn given(before: &PersonForecastsV1, now: &PersonForecastsV1, person: &PersonForecastV1) -> Option<f32> {
        let horizon = before.horizons_s().iter().position(|horizon_s| *horizon_s == Self::AHEAD_S)?;
        let then = before.persons().iter().find(|then| then.person == person.person)?;
        if person.elsewhere[0] >= Self::KNOWN {
            return then.elsewhere.get(horizon).copied();
        }
        let (room, _) = likeliest(now, person).filter(|(_, p)| *p >= Self::KNOWN)?;
        then.probability.get(room)?.get(horizon).copied()
    }

    fn curve(&self) -> Vec<Value> {
        self.hours.iter().map(|(_, sum, count)| json!({"p": short(sum / *count as f64), "n": count})).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_ipc::raw::narration_kind;
    use roomcast_ipc::text;
    use std::io::{Read, Write};

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
            let mut picture = Picture { robot: own, is_configured: own.is_some(), ..Picture::default() };
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

    #[test]
    fn a_forecast_is_compared_with_where_people_then_are() {
        let mut quality = Quality::default();
        let mut told =
            PersonForecastsV1 { epoch: 1, room_count: 2, person_count: 1, horizon_count: 2, ..Default::default() };
        told.horizon_s[1] = 900.0;
        told.person[0].probability[0][..2].copy_from_slice(&[0.95, 0.25]);
        told.person[0].probability[1][..2].copy_from_slice(&[0.05, 0.5]);
        let mut persons = PersonScoresV1 { epoch: 1, person_count: 1, ..Default::default() };
        for minute in 0..15 {
            quality.take(&told, Some(&persons), minute * Quality::MINUTE_NS);
            assert!(quality.curve().is_empty(), "{minute}");
        }
        let mut at = |quality: &mut Quality, minute: u64, told: &PersonForecastsV1, observed: u64| {
            persons.person[0].observed_ns = observed * Quality::MINUTE_NS;
            let mut told = *told;
            told.computed_ns = minute * Quality::MINUTE_NS;
            quality.take(&told, Some(&persons), minute * Quality::MINUTE_NS);
        };
        at(&mut quality, 15, &told, 15);
        // Unobserved beliefs and uncertain observations are not compared.
        at(&mut quality, 16, &told, 14);
        at(&mut quality, 17, &told, 0);
        told.person[0].probability[0][0] = 0.5;
        at(&mut quality, 18, &told, 18);
        told.person[0].elsewhere[0] = 1.0;
        at(&mut quality, 19, &told, 19);
        assert_eq!(quality.curve(), [json!({"p": 0.125, "n": 2})]);
        for minute in (0..200).flat_map(|hour| [20 + 60 * hour, 35 + 60 * hour]) {
            at(&mut quality, minute, &told, minute);
        }
        assert_eq!(quality.curve().len(), Quality::HOURS);
        assert!(quality.samples.len() <= 17);
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
        let (stop, (found, address)) = (Stop::new(), std::sync::mpsc::channel());
        let (own_stop, own_domain) = (stop.clone(), domain.clone());
        let any = Place { key: Some("k3y".to_owned()), ..Place::with_key("127.0.0.1:0".parse().unwrap()) };
        let thread = std::thread::spawn(move || {
            run(&any, &own_domain, "robot", &own_stop, |address| found.send(address).unwrap())
        });
        (address.recv_timeout(Duration::from_secs(60)).unwrap(), stop, thread)
    }

    fn got(address: SocketAddr, path: &str, host: &str, key: &str) -> String {
        let mut stream = std::net::TcpStream::connect(address).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nX-Roomcast-Key: {key}\r\n\r\n").unwrap();
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
        let ages = (0..600).find_map(|_| {
            // Late subscribers get earlier messages.
            narration.tick().unwrap();
            decisions.tick().unwrap();
            let answer = got(address, "/state", "localhost", "k3y");
            let state: Value = serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap();
            let ages = [&state["narration"][0]["age_s"], &state["decision"]["age_s"]].map(Value::as_f64);
            std::thread::sleep(Duration::from_millis(50));
            Some([ages[0]?, ages[1]?])
        });
        assert!(ages.unwrap().into_iter().all(|age_s| age_s >= least_s), "{ages:?}, at least {least_s}");
        stop.request();
        assert!(matches!(thread.join(), Ok(Ok(()))));
        drop((narration, decisions, node));
        let _left = domain.clean_up();
        // A message without a time counts as of now, and no message is dated ahead.
        assert_eq!([told_ns(0, 9), told_ns(5, 9), told_ns(12, 9)], [9, 5, 9]);
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
            assert!(get_with("/plan", "localhost", key).starts_with("HTTP/1.1 403"), "{key:?}");
        }
        stop.request();
        assert!(matches!(thread.join(), Ok(Ok(()))));
        let _left = domain.clean_up();
    }
}
