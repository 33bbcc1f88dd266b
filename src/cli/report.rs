//! `roomcast report`: sends a robot's reports, and a person's orders, to the robot's planner.

use std::io::{self, BufRead, Read};
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use roomcast_core::grounding::{Partition, PartitionLevel, partition_named, partitions};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::text::did_you_mean;
use roomcast_ipc::raw::{DecisionV1, RobotReportV1, RoomScoresV1, RoomV1};
use roomcast_ipc::{IpcError, Node, Publisher, Subscriber, sequence};
use roomcast_services::clock;
use strum::{EnumMessage, VariantArray};

use super::{CommandResult, Failure, count, ranges, service};
use roomcast_services::config::Config;
use roomcast_services::participant::PLANNER;
use roomcast_services::reporter::{Kind, LINE_BYTES_MAX, Report, Reporter};
use roomcast_services::setup;
use roomcast_services::stop::Stop;

/// A report wakes a planner. After this time, longer than its sleep, a running one has received it.
const LINGER: Duration = Duration::from_millis(500);
/// Time in which a planner notices a new subscriber.
const NOTICED_WITHIN: Duration = Duration::from_secs(2);
const TICK: Duration = Duration::from_millis(50);
/// A running daemon repeats its scores within this time.
const HEARTBEAT: Duration = Duration::from_millis(1500);
const LINES: usize = 8;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// What the robot reports, or a person orders; `-` reads JSON lines from standard input, such as {"report": "finished", "room": "kitchen"}.
    #[arg(value_name = "KIND", value_parser = what())]
    what: What,
    /// The robot's name, in place of the configuration's planner.robot.
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// The report's room, by its id or its name in the map.
    #[arg(long, value_name = "ROOM")]
    room: Option<String>,
    /// How full the battery is, 0 to 1.
    #[arg(long, value_name = "SHARE", value_parser = ranges::share)]
    battery: Option<f64>,
    /// Where the robot is, in the map's metres: x,y,z.
    #[arg(long, value_name = "X,Y,Z", value_parser = position, allow_hyphen_values = true)]
    position: Option<[f64; 3]>,
    /// The sequence of the decision that the report answers.
    #[arg(long, value_name = "SEQUENCE", value_parser = clap::value_parser!(u64).range(1..))]
    decision: Option<u64>,
    /// The reason, in words.
    #[arg(long, value_name = "TEXT")]
    note: Option<String>,
    /// Seconds until a hold ends; without it, a resume ends it.
    #[arg(long = "for", value_name = "SECONDS", value_parser = ranges::positive)]
    for_s: Option<f64>,
    /// Seconds to wait for the robot's planner.
    #[arg(long, value_name = "SECONDS", default_value_t = 5.0, value_parser = ranges::time_s)]
    wait: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum What {
    One(Kind),
    Lines,
}

fn what() -> impl TypedValueParser<Value = What> {
    let kind = |kind: &Kind| {
        let value = PossibleValue::new(<&'static str>::from(*kind));
        value.help(kind.get_documentation().unwrap_or_default().trim_end_matches('.').to_owned())
    };
    let lines = PossibleValue::new("-").help("Reports as JSON lines on standard input");
    let known = Kind::VARIANTS.iter().map(kind).chain([lines]).collect::<Vec<_>>();
    PossibleValuesParser::new(known).try_map(|word| match word.as_str() {
        "-" => Ok(What::Lines),
        word => word.parse().map(What::One),
    })
}

fn position(text: &str) -> Result<[f64; 3], String> {
    let numbers: Option<Vec<f64>> =
        text.split(',').map(|number| number.trim().parse().ok().filter(|metres: &f64| metres.is_finite())).collect();
    let numbers = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
    numbers.ok_or_else(|| "give three numbers in metres, such as 1.5,2,0".to_owned())
}

impl Args {
    fn refuse_options_of_one_report(&self) -> CommandResult {
        let of_one = [
            ("--room", self.room.is_some()),
            ("--battery", self.battery.is_some()),
            ("--position", self.position.is_some()),
            ("--decision", self.decision.is_some()),
            ("--note", self.note.is_some()),
            ("--for", self.for_s.is_some()),
        ];
        match (self.what, of_one.iter().find(|(_, given)| *given)) {
            (What::Lines, Some((option, _))) => {
                let text = format!("{option} is for one report; with `-`, give it in the line");
                Err(Failure::usage(text))
            }
            _ => Ok(()),
        }
    }

    fn report(&self, kind: Kind) -> Report {
        Report {
            kind,
            room: self.room.clone(),
            battery: self.battery,
            position: self.position,
            decision: self.decision,
            note: self.note.clone(),
            for_s: self.for_s,
        }
    }
}

pub fn run(args: &Args) -> CommandResult {
    let stop = service::stop()?;
    let (config, domain) = args.service.load()?;
    let robot = args.robot.as_ref().unwrap_or(&config.planner.robot);
    let mut reporter =
        Reporter::new(robot, sequence::random_epoch()).map_err(|error| Failure::usage(format!("--robot: {error}")))?;
    args.refuse_options_of_one_report()?;
    // A malformed report is refused before any wait.
    let one = match args.what {
        What::One(kind) => {
            let message = reporter.message(&args.report(kind), clock::monotonic_ns(), clock::unix_ns());
            Some(message.map_err(Failure::input)?)
        }
        What::Lines => None,
    };
    let node = domain.open(&format!("roomcast-report {robot}"))?;
    let publisher = node.publisher::<RobotReportV1>()?;
    let mut rooms = Rooms::open(&node, &config)?;
    let (mut sent, mut refused) = (0, 0);
    match one {
        Some(message) => {
            rooms.check(message.room()).map_err(Failure::input)?;
            publisher.send(&message)?;
            sent = 1;
        }
        None => send_lines(&mut reporter, &publisher, &mut rooms, &stop, (&mut sent, &mut refused))?,
    }
    if stop.requested() {
        // A reader of a robot's reports goes on until it is stopped.
        let follows = args.what == What::Lines && !service::has_end(Path::new("-"));
        return if follows { Ok(()) } else { Err(service::interrupted(&format!("{} sent", count(sent, "report")))) };
    }
    if sent > 0 {
        let heard = wait(&publisher, robot, Duration::from_secs_f64(args.wait), &stop)?;
        let place = service::shown(&domain);
        match heard {
            Hearer::Planner => {}
            Hearer::Others => {
                super::tell(format_args!("roomcast: no planner of the robot `{robot}` runs in {place}; others listen"))
            }
            Hearer::OtherPlanner(other) => {
                let (other, name) = match other_name(&node, &other)? {
                    Some(name) => (format!("one of `{name}`"), format!("'{name}'")),
                    None => ("one of another robot".to_owned(), "with that one's name".to_owned()),
                };
                let text = format!(
                    "no planner of the robot `{robot}` runs in {place}, but {other}: give --robot {name}, or start \
                     `roomcast planner --robot '{robot}'`"
                );
                return Err(Failure::ipc(text));
            }
            Hearer::Nobody if stop.requested() => {
                let text = format!("nobody has heard {} yet", count(sent, "report"));
                return Err(service::interrupted(&text));
            }
            Hearer::Nobody => {
                let sent = count(sent, "report");
                let text = format!(
                    "nobody listens to {sent} of the robot `{robot}` in {place}: start `roomcast planner --robot {robot}`, or wait \
                     longer for it (--wait)"
                );
                return Err(Failure::ipc(text));
            }
        }
    }
    if refused > 0 {
        let text = format!("{} refused; the lines above say why", count(refused, "line"));
        return Err(Failure::input(text));
    }
    Ok(())
}

/// Sends a report for each line of standard input. A malformed line is reported, and the next one follows.
fn send_lines(
    reporter: &mut Reporter,
    publisher: &Publisher<RobotReportV1>,
    rooms: &mut Rooms,
    stop: &Stop,
    (sent, refused): (&mut usize, &mut usize),
) -> CommandResult {
    let lines = read_lines().map_err(Failure::failed)?;
    for number in 1_u64.. {
        let line = loop {
            if stop.requested() {
                return Ok(());
            }
            match lines.recv_timeout(TICK) {
                Ok(line) => break line,
                // Planners that join later get the last reports.
                Err(RecvTimeoutError::Timeout) => publisher.tick().map(drop)?,
                Err(RecvTimeoutError::Disconnected) => return Ok(()),
            }
        };
        let mut complain = |error: String| {
            super::tell(format_args!("roomcast: line {number}: {error}"));
            *refused += 1;
        };
        let mut message = |report: &Report| {
            reporter.message(report, clock::monotonic_ns(), clock::unix_ns()).map_err(|e| e.to_string())
        };
        let report = line.and_then(|line| match line.trim() {
            "" => Ok(None),
            line => Report::parse(line).map_err(|error| error.to_string()).map(Some),
        });
        // A malformed line is refused as a whole, with any room.
        let said = report.and_then(|report| report.map(|report| Ok((message(&report)?, report))).transpose());
        match said {
            Ok(None) => {}
            Ok(Some((whole, report))) => {
                let mut messages = vec![whole];
                if let Err(error) = rooms.check(whole.room()) {
                    messages.clear();
                    // The robot's place and its battery do not depend on the room's name.
                    for report in without_room(&report) {
                        messages.extend(message(&report).map_err(&mut complain));
                    }
                    if is_work(report.kind) || messages.is_empty() {
                        complain(error);
                    }
                }
                for message in messages {
                    publisher.send(&message)?;
                    *sent += 1;
                }
            }
            Err(error) => complain(error),
        }
    }
    Ok(())
}

fn is_work(kind: Kind) -> bool {
    match kind {
        Kind::Started | Kind::Finished | Kind::Failed | Kind::Blocked | Kind::Cancelled => true,
        Kind::Clean | Kind::Skip => true,
        Kind::Position | Kind::Docked | Kind::Battery | Kind::Hold | Kind::Resume => false,
    }
}

/// The parts of a report with an unknown room that stay valid: docked, position, battery.
fn without_room(report: &Report) -> Vec<Report> {
    let Report { kind, battery, position, .. } = *report;
    let placed = |kind| Report { battery, position, note: report.note.clone(), ..Report::new(kind) };
    if kind == Kind::Docked {
        vec![placed(kind)]
    } else if position.is_some() {
        vec![placed(Kind::Position)]
    } else if battery.is_some() {
        vec![placed(Kind::Battery)]
    } else {
        Vec::new()
    }
}

/// The rooms that a planner can know, if a daemon publishes them.
struct Rooms {
    scores: Subscriber<RoomScoresV1>,
    newest: Option<RoomScoresV1>,
    /// The planner's scene, for rooms by name.
    names: Option<Names>,
}

/// A scene and the rooms that are scored in it.
struct Names {
    map: SemanticMap,
    partitions: Vec<Partition>,
}

impl Names {
    fn new(map: SemanticMap, level: PartitionLevel) -> Self {
        let partitions = partitions(&map, level);
        Self { map, partitions }
    }

    /// The id of the room with this name; `None` if the room has several partitions.
    fn id(&self, name: &str) -> Option<&str> {
        partition_named(name, &self.map, &self.partitions).map(|own| own.id.as_str())
    }
}

impl Rooms {
    fn open(node: &Node, config: &Config) -> Result<Self, IpcError> {
        // The planner and the daemon report faults of the scene.
        let map = setup::load_map(config.scene.path.as_deref()).ok();
        let names = map.map(|map| Names::new(map, config.grounding.level));
        Ok(Self { scores: node.subscriber()?, newest: None, names })
    }

    /// Refuses a room that neither the daemon nor the scene has. Without a daemon, every room passes.
    fn check(&mut self, room: &str) -> Result<(), String> {
        if room.is_empty() {
            return Ok(());
        }
        if self.newest.is_none() {
            self.scores.wait(HEARTBEAT).map_err(|error| error.to_string())?;
        }
        self.newest = self.scores.newest().map_err(|error| error.to_string())?.or(self.newest);
        let Some(scores) = &self.newest else { return Ok(()) };
        let has = |id: &str| scores.rooms().iter().any(|own| own.id() == id);
        let is_named = || self.names.as_ref().and_then(|names| names.id(room)).is_some_and(has);
        if has(room) || is_named() {
            return Ok(());
        }
        let known = scores.rooms().iter().map(RoomV1::id).collect::<Vec<_>>().join(", ");
        if self.names.as_ref().is_some_and(|names| names.id(room).is_none() && names.map.find_room(room).is_some()) {
            return Err(format!("several rooms are called `{room}`, or it is in parts: give the id of one of {known}"));
        }
        let is_other = self.names.as_ref().is_none_or(|names| names.map.fingerprint() != scores.map_fingerprint);
        Err(no_room(room, &known, is_other))
    }
}

/// The error for an unknown room, with the remedy if the scene is not the daemon's map.
fn no_room(room: &str, known: &str, is_other_map: bool) -> String {
    let remedy = match is_other_map {
        true => {
            "; names other than these ids are known from the daemon's map: give --config FILE, the daemon's own, or --scene"
        }
        false => "",
    };
    format!("no room is called `{room}`: the rooms are {known}{}{remedy}", did_you_mean(room, known.split(", ")))
}

/// Standard input, line by line, from a thread that waits for it.
fn read_lines() -> io::Result<Receiver<Result<String, String>>> {
    let (tell, lines) = sync_channel(LINES);
    let read = move || {
        let mut input = io::stdin().lock();
        loop {
            let mut line = Vec::new();
            let read = input.by_ref().take(LINE_BYTES_MAX + 1).read_until(b'\n', &mut line);
            let said = match read {
                Ok(0) => return,
                Ok(bytes) if bytes as u64 > LINE_BYTES_MAX => {
                    // The rest of an overlong line is not a line.
                    if input.skip_until(b'\n').is_err() {
                        return;
                    }
                    Err(format!("more than {LINE_BYTES_MAX} bytes"))
                }
                Ok(_) => String::from_utf8(line).map_err(|_| "not UTF-8".to_owned()),
                Err(ref error) => Err(format!("standard input cannot be read: {error}")),
            };
            let ends = read.is_err();
            if tell.send(said).is_err() || ends {
                return;
            }
        }
    };
    std::thread::Builder::new().name("lines".to_owned()).spawn(read)?;
    Ok(lines)
}

enum Hearer {
    Planner,
    /// A planner of another robot, by its participant's name.
    OtherPlanner(String),
    Others,
    Nobody,
}

/// The name of a planner's robot; only its last decision may have the whole name.
fn other_name(node: &Node, planner: &str) -> Result<Option<String>, IpcError> {
    if let Some(name) = PLANNER.robot_name(planner) {
        return Ok(Some(name.to_owned()));
    }
    let decisions = node.subscriber::<DecisionV1>()?;
    // The planner must notice the subscriber before it sends its last decision.
    let until = Instant::now() + NOTICED_WITHIN;
    loop {
        while let Some(decision) = decisions.receive()? {
            if PLANNER.robot_of(planner) == Some(decision.robot) && !decision.robot_name().is_empty() {
                return Ok(Some(decision.robot_name().to_owned()));
            }
        }
        if Instant::now() >= until {
            return Ok(None);
        }
        decisions.wait(TICK)?;
    }
}

/// Waits for the robot's planner, and then until it can have received the reports.
fn wait(
    publisher: &Publisher<RobotReportV1>,
    robot: &str,
    patience: Duration,
    stop: &Stop,
) -> Result<Hearer, IpcError> {
    let start = Instant::now();
    let robot = sequence::source_of_name(robot);
    let is_there = || publisher.listeners().iter().any(|name| PLANNER.robot_of(name) == Some(robot));
    let other = || publisher.listeners().into_iter().find(|name| PLANNER.robot_of(name).is_some());
    while !is_there() && start.elapsed() < patience && !stop.requested() {
        std::thread::sleep(TICK);
        publisher.tick()?;
    }
    let heard = if is_there() {
        Hearer::Planner
    } else if let Some(other) = other() {
        Hearer::OtherPlanner(other)
    } else if publisher.subscribers() > 0 {
        Hearer::Others
    } else {
        return Ok(Hearer::Nobody);
    };
    let until = Instant::now() + LINGER;
    while Instant::now() < until {
        publisher.tick()?;
        std::thread::sleep(TICK);
    }
    Ok(heard)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rooms_are_named_as_in_the_planners_map() {
        for scene in [None, Some("studio")] {
            let map = setup::load_map(scene.map(Path::new)).unwrap();
            let (id, label) = (map.rooms()[0].id.clone(), map.rooms()[0].label.to_uppercase());
            let names = Names::new(map, PartitionLevel::default());
            assert_eq!((names.id(&label), names.id("nowhere")), (Some(id.as_str()), None), "{scene:?}");
        }
    }

    #[test]
    fn a_report_of_a_room_that_is_none_keeps_where_the_robot_is_and_its_battery() {
        let kept = |line: &str| {
            let left = without_room(&Report::parse(line).unwrap());
            left.iter().map(|report| (report.kind, report.battery, report.position.is_some())).collect::<Vec<_>>()
        };
        assert_eq!(kept(r#"{"report": "finished", "room": "x"}"#), []);
        assert_eq!(kept(r#"{"report": "finished", "room": "x", "battery": 0.5}"#), [(Kind::Battery, Some(0.5), false)]);
        let both = r#"{"report": "started", "room": "x", "battery": 0.5, "position": [1, 2, 0]}"#;
        assert_eq!(kept(both), [(Kind::Position, Some(0.5), true)]);
        assert_eq!(kept(r#"{"report": "docked", "room": "x"}"#), [(Kind::Docked, None, false)]);
    }

    #[test]
    fn a_position_is_three_numbers() {
        assert_eq!(position("1.5, -2,0"), Ok([1.5, -2.0, 0.0]));
        for text in ["", "1,2", "1,2,3,4", "1,2,x", "1,2,nan", "1,2,inf"] {
            assert!(position(text).is_err(), "{text}");
        }
    }
}
