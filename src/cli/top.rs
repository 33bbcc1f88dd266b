//! `roomcast top`: a live view of a running system. It may join and leave at any time.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use crossterm::event::{self, Event, KeyCode, KeyEventKind};
use roomcast_core::ids::{BootNs, PersonId};
use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, LEARNED_SHARE_S, NarrationV1, PersonForecastV1, PersonForecastsV1, PersonScoresV1,
    PersonV1, RoomScoresV1,
};
use roomcast_ipc::{
    Action, Domain, IpcError, ItemScoresSubscriber, NarrationKind, Node, Presence, StatusClient, Subscriber, sequence,
};
use roomcast_services::clock;
use serde_json::{Value, json};

use super::{CommandResult, Failure, ranges, service};
use crate::decided::{Decided, News};
use crate::flags::{decision_flag_names, forecast_flag_names, score_flag_names};
use crate::reasons::Reasons;
use crate::top::{POINT_NS, View, set_places};
use crate::view;
use roomcast_services::daemon::flag_words;
use roomcast_services::stop::Stop;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// Print each new snapshot as a line of JSON instead of drawing, and the newest one again when a robot's planner decides. This is the default if
    /// standard output is not a terminal.
    #[arg(long)]
    json: bool,
    /// Leave after this many snapshots, or with exit code 6 when no daemon is heard for 10 seconds.
    #[arg(long, value_name = "N", value_parser = ranges::any())]
    snapshots: Option<u64>,
}

/// Period of questions about the daemon's status, in nanoseconds.
const STATUS_NS: u64 = 1_000_000_000;
const STATUS_TIMEOUT: Duration = Duration::from_millis(50);
/// Silence until a warning. A running daemon repeats its scores much more often.
pub(super) const SILENCE: Duration = Duration::from_secs(10);
/// Longest time between two drawings.
const FRAME: Duration = Duration::from_millis(100);

pub fn run(args: &Args) -> CommandResult {
    let stop = service::stop()?;
    let (config, domain) = args.service.load()?;
    if args.json || !std::io::stdout().is_terminal() {
        return lines(&domain, &stop, args.snapshots, config.planner.robot);
    }
    let mut terminal = ratatui::try_init().map_err(Failure::failed)?;
    let shown = screen(&domain, &stop, args.snapshots, &config.planner.robot, &mut terminal);
    ratatui::restore();
    shown
}

pub(super) fn silence(domain: &Domain) -> String {
    let place = service::shown(domain);
    format!("no daemon is heard in {place} for {} s: start `roomcast daemon`", SILENCE.as_secs())
}

/// The end of a view that was asked to leave. Missing snapshots make it an interruption.
fn left(count: u64, limit: Option<u64>) -> CommandResult {
    match limit {
        Some(limit) if count < limit => Err(service::interrupted(&format!("{count} of {limit} snapshots came"))),
        _ => Ok(()),
    }
}

struct Drawn {
    ports: view::Ports,
    items: ItemScoresSubscriber,
    status: StatusClient,
    reasons: Reasons,
    /// Epoch and sequence of the newest scores, and how many snapshots came.
    taken: Option<(u64, u64)>,
    count: u64,
    point_ns: BootNs,
    status_ns: BootNs,
}

impl Drawn {
    fn new(domain: &Domain) -> Result<Self, IpcError> {
        let node = domain.open("roomcast-top")?;
        Ok(Self {
            ports: view::Ports::new(&node)?,
            items: node.item_scores_subscriber()?,
            status: node.status_client()?,
            reasons: Reasons::new(&node)?,
            taken: None,
            count: 0,
            point_ns: BootNs(0),
            status_ns: BootNs(0),
        })
    }

    /// Passes all news on to the view. Returns whether scores came.
    fn take(&mut self, view: &mut View) -> Result<bool, IpcError> {
        let (now_ns, ports) = (clock::monotonic_ns(), &self.ports);
        let mut has_scores = false;
        while let Some(message) = ports.narration.receive()? {
            view.narration(&message);
        }
        while let Some(message) = ports.scores.receive()? {
            view.scores(&message);
            has_scores = true;
            let name = Some((message.epoch, message.sequence));
            self.count += u64::from(self.taken != name);
            self.taken = name;
        }
        if let Some(message) = ports.forecasts.newest()? {
            view.forecasts(&message);
        }
        if let Some(message) = ports.forecast.newest()? {
            view.forecast_flags(message.flags);
        }
        if let Some(message) = ports.persons.newest()? {
            if let Some(reasons) = self.reasons.refresh(message.persons().iter().map(|person| person.person)) {
                view.reasons(reasons);
            }
            view.persons(&message);
        }
        if let Some(message) = self.items.newest()? {
            view.items(&message);
        }
        while let Some(report) = ports.reports.as_ref().map(Subscriber::receive).transpose()?.flatten() {
            view.report(&report);
        }
        while let Some(message) = ports.decisions.receive()? {
            view.decision(&message);
        }
        view.malformed(ports.narration.malformed() + ports.scores.malformed() + ports.decisions.malformed());
        if now_ns.since(self.status_ns) >= STATUS_NS {
            // A busy or absent daemon does not block the view: its last answer stays.
            if let Ok(answer) = self.status.ask(STATUS_TIMEOUT) {
                view.status(answer);
            }
            self.status_ns = now_ns;
        }
        if now_ns.since(self.point_ns) >= POINT_NS {
            view.point();
            self.point_ns = now_ns;
        }
        Ok(has_scores)
    }
}

fn screen(
    domain: &Domain,
    stop: &Stop,
    limit: Option<u64>,
    robot: &str,
    terminal: &mut ratatui::DefaultTerminal,
) -> CommandResult {
    let terminal_failure = |error: std::io::Error| Failure::failed(error);
    let mut ports = Drawn::new(domain)?;
    let mut view = View::of_robot(robot);
    let mut heard = Instant::now();
    while !stop.requested() {
        if !view.paused && ports.take(&mut view)? {
            heard = Instant::now();
        }
        terminal.draw(|frame| view.draw(frame, clock::monotonic_ns())).map_err(terminal_failure)?;
        if limit.is_some_and(|limit| ports.count >= limit) {
            return Ok(());
        }
        // While the view is paused, no messages are received.
        if view.paused {
            heard = Instant::now();
        } else if limit.is_some() && heard.elapsed() >= SILENCE {
            return Err(Failure::ipc(silence(domain)));
        }
        if !event::poll(FRAME).map_err(terminal_failure)? {
            continue;
        }
        if let Event::Key(key) = event::read().map_err(terminal_failure)?
            && key.kind == KeyEventKind::Press
        {
            let control = key.modifiers.contains(event::KeyModifiers::CONTROL);
            match key.code {
                KeyCode::Char('c') if control => break,
                KeyCode::Char('q') => return Ok(()),
                KeyCode::Esc if !view.help => return Ok(()),
                KeyCode::Char(' ') if !control => view.paused = !view.paused,
                KeyCode::Char('h' | '?') => view.help = !view.help,
                KeyCode::Esc => view.help = false,
                _ => {}
            }
        }
    }
    left(ports.count, limit)
}

/// One line of JSON per snapshot, without heartbeats. Without a daemon, a limited view ends with an error, and an unlimited one warns and waits.
fn lines(domain: &Domain, stop: &Stop, limit: Option<u64>, robot: String) -> CommandResult {
    let node = domain.open("roomcast-top")?;
    let scores = node.subscriber::<RoomScoresV1>()?;
    let mut others = Others::open(&node, robot)?;
    let mut taken = None::<RoomScoresV1>;
    let mut count = 0;
    let mut silent_from = Some(Instant::now());
    while !stop.requested() && limit.is_none_or(|limit| count < limit) {
        scores.wait(Duration::from_millis(250))?;
        others.receive()?;
        let Some(snapshot) = scores.newest()? else {
            if let Some(known) = taken.filter(|_| !others.decisions.is_empty()) {
                print_line(&known, &mut others)?;
            }
            if silent_from.is_some_and(|from| from.elapsed() >= SILENCE) {
                if limit.is_some() {
                    return Err(Failure::ipc(silence(domain)));
                }
                super::tell(format_args!("roomcast: {}; this waits for it", silence(domain)));
                silent_from = None;
            }
            continue;
        };
        silent_from = limit.map(|_| Instant::now());
        let is_new = taken.is_none_or(|taken| (taken.epoch, taken.sequence) != (snapshot.epoch, snapshot.sequence));
        taken = Some(snapshot);
        count += u64::from(is_new);
        if is_new {
            others.receive_behind(&snapshot)?;
        }
        if is_new || !others.decisions.is_empty() {
            print_line(&snapshot, &mut others)?;
        }
    }
    left(count, limit)
}

fn print_line(snapshot: &RoomScoresV1, others: &mut Others) -> CommandResult {
    let rooms: Vec<_> = (snapshot.rooms().iter())
        .map(|room| json!({"id": room.id(), "probability": room.probability, "log_score_nats": room.log_score_nats}))
        .collect();
    let mut line = json!({
        "epoch": format!("{:016x}", snapshot.epoch), "sequence": snapshot.sequence, "age_ns": snapshot.age_ns(clock::monotonic_ns().0),
        "rooms": rooms, "label_mass": snapshot.label_mass, "flags": score_flag_names(snapshot.flags),
        "model": hex::encode(snapshot.model_fingerprint), "map": hex::encode(snapshot.map_fingerprint),
        "timing_ns": {"wait": snapshot.wait_ns, "tokenise": snapshot.tokenise_ns, "prefix": snapshot.prefix_ns,
            "trie": snapshot.trie_ns, "ground": snapshot.ground_ns},
    });
    for (key, value) in others.since_the_last_line(snapshot) {
        line[key] = value;
    }
    super::print(&format!("{line}\n"))
}

/// Longest wait for the messages that follow scores.
const BEHIND: Duration = Duration::from_millis(200);

/// The services of a line, besides the room scores.
struct Ports {
    persons: Subscriber<PersonScoresV1>,
    forecast: Subscriber<ForecastV1>,
    forecasts: Subscriber<PersonForecastsV1>,
    narration: Subscriber<NarrationV1>,
    decisions: Subscriber<DecisionV1>,
}

/// The contents of a line, besides the room scores: the newest persons and forecasts, and the narration and decisions since the last line.
struct Others {
    ports: Ports,
    persons: Option<PersonScoresV1>,
    forecast: Option<ForecastV1>,
    forecasts: Option<PersonForecastsV1>,
    narration: Vec<Value>,
    decisions: Vec<DecisionV1>,
    decided: Decided,
    /// The name of the configured robot. Decisions have its number.
    robot: String,
    /// No messages followed the last scores.
    is_waited_for_in_vain: bool,
}

impl Others {
    fn open(node: &Node, robot: String) -> Result<Self, IpcError> {
        Ok(Self {
            ports: Ports {
                persons: node.subscriber()?,
                forecast: node.subscriber()?,
                forecasts: node.subscriber()?,
                narration: node.subscriber()?,
                decisions: node.subscriber()?,
            },
            persons: None,
            forecast: None,
            forecasts: None,
            narration: Vec::new(),
            decisions: Vec::new(),
            decided: Decided::default(),
            robot,
            is_waited_for_in_vain: false,
        })
    }

    fn receive(&mut self) -> Result<(), IpcError> {
        let Ports { persons, forecast, forecasts, narration, decisions } = &self.ports;
        self.persons = persons.newest()?.or(self.persons);
        self.forecast = forecast.newest()?.or(self.forecast);
        self.forecasts = forecasts.newest()?.or(self.forecasts);
        while let Some(message) = narration.receive()? {
            self.narration.push(narration_json(&message));
        }
        while let Some(message) = decisions.receive()? {
            if self.decided.take(&message) != News::None {
                self.decisions.push(message);
            }
        }
        Ok(())
    }

    /// Receives until the messages behind the scores have come: persons and forecasts, the persons' forecasts last. If a daemon publishes only
    /// scores, this waits only once.
    fn receive_behind(&mut self, scores: &RoomScoresV1) -> Result<(), IpcError> {
        let until = Instant::now() + BEHIND;
        loop {
            self.receive()?;
            let has_come = self
                .forecasts
                .as_ref()
                .is_some_and(|told| told.epoch == scores.epoch && told.sequence >= scores.sequence);
            let left = until.saturating_duration_since(Instant::now());
            if has_come || self.is_waited_for_in_vain || left.is_zero() {
                self.is_waited_for_in_vain = !has_come;
                return Ok(());
            }
            self.ports.forecasts.wait(left)?;
        }
    }

    /// Persons and forecasts of the scores' epoch and sequence, and the narration and decisions since the last line.
    fn since_the_last_line(&mut self, scores: &RoomScoresV1) -> [(&'static str, Value); 5] {
        let of = (scores.epoch, scores.sequence);
        let decisions = std::mem::take(&mut self.decisions);
        let decisions: Vec<_> = decisions.iter().map(|told| decision_json(told, scores, &self.robot)).collect();
        let persons = self.persons.as_ref().filter(|told| (told.epoch, told.sequence) == of);
        let forecast = self.forecast.as_ref().filter(|told| (told.epoch, told.sequence) == of);
        let forecasts = self.forecasts.as_ref().filter(|told| (told.epoch, told.sequence) == of);
        [
            ("persons", persons.map_or(Value::Null, persons_json)),
            ("forecast", forecast.map_or(Value::Null, forecast_json)),
            ("person_forecasts", forecasts.map_or(Value::Null, forecasts_json)),
            ("narration", std::mem::take(&mut self.narration).into()),
            ("decisions", decisions.into()),
        ]
    }
}

fn persons_json(told: &PersonScoresV1) -> Value {
    let person = |person: &PersonV1| {
        let rooms = told.probabilities(person).map(|(id, p)| json!({"id": id, "probability": p}));
        json!({
            "person": person.person, "name": person.name(), "presence": Presence::of(person.presence).word(),
            "since_ns": person.since_ns, "observed_ns": person.observed_ns, "elsewhere": person.elsewhere,
            "flags": flag_words(person.flags).collect::<Vec<_>>(), "rooms": rooms.collect::<Vec<_>>(),
        })
    };
    told.persons().iter().map(person).collect()
}

fn forecast_json(told: &ForecastV1) -> Value {
    let horizons = told.horizon_count as usize;
    let rooms = (0..told.room_count as usize).filter_map(|index| told.room(index));
    let rooms = rooms.map(|(id, row)| json!({"id": id, "probability": row}));
    json!({
        "horizon_s": told.horizon_s.get(..horizons), "elsewhere": told.elsewhere.get(..horizons),
        "flags": forecast_flag_names(told.flags), "rooms": rooms.collect::<Vec<_>>(),
    })
}

fn forecasts_json(told: &PersonForecastsV1) -> Value {
    let horizons = told.horizons_s().len();
    let person = |person: &PersonForecastV1| {
        let rooms = told.rooms().zip(&person.probability);
        let rooms = rooms.map(|(id, row)| json!({"id": id, "probability": row.get(..horizons)}));
        let sets = (0..horizons).map_while(|horizon| set_places(told, person, horizon));
        let learned = LEARNED_SHARE_S.iter().zip(&person.learned_share);
        let learned = learned.map(|(ahead_s, share)| json!({"horizon_s": ahead_s, "share": share}));
        json!({
            "person": person.person, "name": person.name(), "presence": Presence::of(person.presence).word(),
            "flags": flag_words(person.flags).collect::<Vec<_>>(), "elsewhere": person.elsewhere.get(..horizons),
            "rooms": rooms.collect::<Vec<_>>(),
            "set_coverage": person.set_coverage, "sets": sets.collect::<Vec<_>>(),
            "observations": person.observations, "learned_share": learned.collect::<Vec<_>>(),
        })
    };
    json!({
        "horizon_s": told.horizons_s(), "persons": told.persons().iter().map(person).collect::<Vec<_>>(),
    })
}

fn narration_json(told: &NarrationV1) -> Value {
    // Unknown values are null: somebody has no number, and a known person may have no name.
    let person = (told.person != PersonId::SOMEBODY.0).then_some(told.person);
    let kind = Some(NarrationKind::of(told.kind)).filter(|kind| !matches!(kind, NarrationKind::Unknown(_)));
    json!({
        "source": told.source_name(), "person": person, "name": given(told.person_name()), "kind": told.kind,
        "kind_name": kind.map(NarrationKind::word),
        "text": told.text(), "observed_ns": told.observed_ns,
    })
}

fn given(text: &str) -> Option<&str> {
    (!text.is_empty()).then_some(text)
}

/// A decision with the scores of its daemon. `robot` is the configured robot's name, which its planner may not send.
fn decision_json(told: &DecisionV1, scores: &RoomScoresV1, robot: &str) -> Value {
    let own = (sequence::source_of_name(robot) == told.robot).then_some(robot);
    let name = own.or(Some(told.robot_name())).filter(|name| !name.is_empty());
    let rooms = (told.scores_epoch == scores.epoch).then(|| scores.rooms().iter().take(64).enumerate());
    let covered = rooms.map(|rooms| {
        rooms.filter(|(room, _)| told.covered >> room & 1 == 1).map(|(_, room)| room.id()).collect::<Vec<_>>()
    });
    json!({
        "robot_name": name, "action_name": Action::of(told.action).word(), "covered": covered,
        "robot": format!("{:016x}", told.robot), "sequence": told.sequence, "action": told.action, "from": given(told.from()),
        "to": given(told.to()), "probability": told.probability, "policy": told.policy(), "reason": told.reason(),
        "cancels": Some(told.cancels).filter(|cancelled| *cancelled > 0), "flags": decision_flag_names(told.flags), "decided_ns": told.decided_ns,
    })
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::raw::action;
    use roomcast_ipc::text;

    use super::*;
    use crate::exit_code;

    #[test]
    fn whoever_leaves_before_what_was_wanted_has_been_interrupted() {
        let code = |count, limit| left(count, limit).map_or_else(|failure| failure.code, |()| exit_code::OK);
        assert_eq!([code(0, None), code(3, Some(3)), code(0, Some(0))], [exit_code::OK; 3]);
        assert_eq!([code(0, Some(1)), code(2, Some(3))], [exit_code::INTERRUPTED; 2]);
    }

    #[test]
    fn a_decision_is_told_by_names_beside_its_numbers() {
        let mut scores = RoomScoresV1 { epoch: 5, room_count: 3, ..Default::default() };
        for (room, id) in scores.room.iter_mut().zip(["hall", "kitchen", "office"]) {
            room.id = text::encode("id", id).unwrap();
        }
        let robot = sequence::source_of_name("dusty");
        let told = DecisionV1 { robot, action: action::PAUSE, covered: 0b101, scores_epoch: 5, ..Default::default() };
        let line = decision_json(&told, &scores, "dusty");
        assert_eq!((&line["robot_name"], &line["action_name"]), (&json!("dusty"), &json!("pause")));
        assert_eq!((&line["covered"], &line["action"]), (&json!(["hall", "office"]), &json!(action::PAUSE)));
        assert_eq!(line["robot"], json!(format!("{robot:016x}")));
        // Names of another robot, and of another daemon's rooms, are unknown.
        let other = decision_json(&DecisionV1 { scores_epoch: 6, ..told }, &scores, "rusty");
        assert_eq!((&other["robot_name"], &other["covered"]), (&Value::Null, &Value::Null));
    }

    /// A line waits for the messages of its scores, but only once for missing ones.
    #[test]
    fn what_comes_behind_scores_is_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("top-{}", std::process::id())).unwrap();
        let node = domain.open("daemon").unwrap();
        let forecasts = node.publisher::<PersonForecastsV1>().unwrap();
        let mut others = Others::open(&node, String::new()).unwrap();
        let scores = RoomScoresV1 { epoch: 5, sequence: 2, ..Default::default() };
        others.receive_behind(&scores).unwrap();
        assert!(others.forecasts.is_none() && others.is_waited_for_in_vain);
        // Not again: a thousand waits would take minutes.
        for _ in 0..1000 {
            others.receive_behind(&scores).unwrap();
        }
        let told = |sequence| PersonForecastsV1 { epoch: 5, sequence, ..Default::default() };
        forecasts.send(&told(2)).unwrap();
        others.receive_behind(&scores).unwrap();
        assert!(!others.is_waited_for_in_vain);
        let next = RoomScoresV1 { sequence: 3, ..scores };
        let line = std::thread::scope(|scope| {
            let line = scope.spawn(|| {
                others.receive_behind(&next).unwrap();
                others.since_the_last_line(&next)
            });
            // The forecasts come late, within the time that they have.
            std::thread::sleep(BEHIND / 4);
            forecasts.send(&told(3)).unwrap();
            line.join().unwrap()
        });
        assert!(line[2].0 == "person_forecasts" && line[2].1.is_object(), "{:?}", line[2]);
    }
}
