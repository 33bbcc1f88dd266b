//! `roomcast demo`: the whole system on this machine, three processes in a private domain, one activity in one apartment.

use std::collections::VecDeque;
use std::io::{self, IsTerminal, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use roomcast_ipc::{
    DecisionV1, Domain, IpcError, ItemScoresSubscriber, NarrationV1, Node, RoomScoresV1, Subscriber, decision_flags,
    score_flags,
};

use super::stage::Stage;
use super::{CommandResult, Failure, count, ranges, service};
use crate::bar::bar;
use crate::exit_code;
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::narration::{Action, ObjectRef};
use roomcast_core::policy::PolicyName;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_services::setup;
use roomcast_services::stop::Stop;

/// Loading the model is the slow part of the start.
const START_WITHIN: Duration = Duration::from_secs(120);
const ITEMS_WITHIN: Duration = Duration::from_millis(200);
const BAR_WIDTH: usize = 30;
const TOP_OBJECTS: usize = 5;

/// Arguments of `roomcast demo`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The scene file, or a shipped scene's name.
    #[arg(long, value_name = "FILE", default_value = "apartment-e0")]
    scene: PathBuf,
    /// The activity program, or a shipped one's name.
    #[arg(long, value_name = "FILE", default_value = "p0-breakfast-and-television")]
    program: PathBuf,
    /// A GGUF model; the embedded household model when left out.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// The robot's policy.
    #[arg(long, value_name = "POLICY", default_value_t = PolicyName::InformedAvoidance)]
    policy: PolicyName,
    /// Seed of the policy's random choices.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// How long the activity plays, in seconds; real time is sped up to fit.
    #[arg(long, value_name = "SECONDS", default_value_t = 24.0, value_parser = ranges::positive)]
    seconds: f64,
    /// T_r: seconds of the person's time that the robot spends in a room.
    #[arg(long, value_name = "SECONDS", default_value_t = 15.0, value_parser = ranges::positive)]
    room_time: f64,
}

/// Plays the activity and prints what happens, and a summary.
///
/// # Errors
///
/// When a process cannot be started or ends too early, with what it said.
pub fn run(args: &Args) -> CommandResult {
    let stop = service::stop()?;
    let map = setup::load_map(Some(&args.scene))?;
    let grounding = Grounding::new(&map, &GroundingOptions::default());
    let grounding = grounding.map_err(|error| Failure::new(exit_code::INPUT, error))?;
    let program = setup::load_program(&args.program)?;
    let real_s: f64 = program.steps.iter().map(|step| step.entry().duration_s).sum();
    let speed = real_s / args.seconds;

    let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp");
    let directory = directory.map_err(|error| Failure::new(exit_code::FAILURE, format!("cannot use /tmp: {error}")))?;
    let ipc = |error: IpcError| Failure::new(exit_code::IPC, error);
    let domain = Domain::new(directory.path().join("d"), &format!("demo-{}", std::process::id())).map_err(ipc)?;
    let mut stage = Stage::new(domain.clone(), directory.path());
    let node = domain.open("roomcast-demo").map_err(ipc)?;
    let mut show = Show::new(&node, &map, &grounding, speed).map_err(ipc)?;

    let scene = format!(
        "{}: {}, {}. {}, {}, {real_s:.0} s of a person's time played {speed:.1} times faster.",
        map.name(),
        count(map.items().len(), "item"),
        count(grounding.partitions().len(), "room"),
        program.title,
        count(program.steps.len(), "step")
    );
    let robot = format!("The robot works {:.0} s in a room, by the policy {}.\n", args.room_time, args.policy);
    show.say(&[scene, robot]);

    let mut daemon = vec!["--scene".into(), args.scene.clone().into_os_string()];
    if let Some(model) = &args.model {
        daemon.extend(["--model".into(), model.clone().into_os_string()]);
    }
    stage.start("daemon", &daemon)?;
    let result = play(args, &mut stage, &mut show, speed, &stop);
    show.close();
    // The ports go before the domain can be removed.
    let (summary, unheard) = (show.summary(args.policy), show.unheard);
    drop((show, node));
    drop(stage);
    if stop.requested() {
        return Err(Failure::new(exit_code::INTERRUPTED, "interrupted; everything is cleaned up"));
    }
    result?;
    // Whoever read has left: the show ends as well, and quietly.
    if unheard { Ok(()) } else { super::print(&format!("{summary}\n")) }
}

fn play(args: &Args, stage: &mut Stage, show: &mut Show<'_>, speed: f64, stop: &Stop) -> CommandResult {
    let start = Instant::now();
    while !stop.requested() && !show.unheard && show.scores_seen == 0 {
        stage.check()?;
        show.poll(Duration::from_millis(50)).map_err(|error| Failure::new(exit_code::IPC, error))?;
        if start.elapsed() > START_WITHIN {
            let within = START_WITHIN.as_secs();
            return Err(Failure::new(exit_code::FAILURE, format!("the daemon gave no scores within {within} s")));
        }
    }
    let (policy, seed) = (args.policy.to_string().into(), args.seed.to_string().into());
    let room_time = (args.room_time / speed).to_string().into();
    stage.start("planner", &["--policy".into(), policy, "--seed".into(), seed, "--room-time".into(), room_time])?;
    while !stop.requested() && !show.unheard && show.robot.is_empty() {
        stage.check()?;
        show.poll(Duration::from_millis(50)).map_err(|error| Failure::new(exit_code::IPC, error))?;
    }
    let program = args.program.clone().into_os_string();
    stage.start("narrate", &[program, "--speed".into(), speed.to_string().into(), "--name".into(), "person".into()])?;
    while !stop.requested() && !show.unheard && !stage.ended("narrate")? {
        show.poll(Duration::from_millis(50)).map_err(|error| Failure::new(exit_code::IPC, error))?;
    }
    // What the narrator's end was waiting for may still lie in the ports.
    show.poll(Duration::from_millis(50)).map_err(|error| Failure::new(exit_code::IPC, error))
}

/// A room and from when on, in monotonic nanoseconds.
type Stay = (Option<usize>, u64);

/// What is seen on the way, and how it is printed.
struct Show<'a> {
    narration: Subscriber<NarrationV1>,
    scores: Subscriber<RoomScoresV1>,
    items: ItemScoresSubscriber,
    decisions: Subscriber<DecisionV1>,
    grounding: &'a Grounding,
    map: &'a SemanticMap,
    names: Vec<String>,
    ids: Vec<String>,
    speed: f64,
    /// Standard output is closed.
    unheard: bool,
    scores_seen: u64,
    /// Narration that no scores contain yet, with the time of its observation.
    sentences: VecDeque<(u64, String)>,
    untold: VecDeque<DecisionV1>,
    decision: Option<DecisionV1>,
    top: Vec<(String, f64)>,
    /// Where the robot was.
    robot: Vec<Stay>,
    /// Where the person was: an action's room, from the end of the one before to its own end.
    person: Vec<(Option<usize>, u64, u64)>,
    begin_ns: u64,
    latency_ns: Option<Histogram<u64>>,
    /// Lines of the live panel that stand at the end of the terminal.
    panel: Option<usize>,
}

impl<'a> Show<'a> {
    fn new(node: &Node, map: &'a SemanticMap, grounding: &'a Grounding, speed: f64) -> Result<Self, IpcError> {
        Ok(Self {
            narration: node.subscriber()?,
            scores: node.subscriber()?,
            items: node.item_scores_subscriber()?,
            decisions: node.subscriber()?,
            grounding,
            map,
            names: grounding.partition_names(),
            ids: grounding.partitions().iter().map(|partition| partition.id.clone()).collect(),
            speed,
            unheard: false,
            scores_seen: 0,
            sentences: VecDeque::new(),
            untold: VecDeque::new(),
            decision: None,
            top: Vec::new(),
            robot: Vec::new(),
            person: Vec::new(),
            begin_ns: roomcast_ipc::clock::monotonic_ns(),
            latency_ns: Histogram::new_with_max(60_000_000_000, 3).ok(),
            panel: io::stdout().is_terminal().then_some(0),
        })
    }

    fn poll(&mut self, timeout: Duration) -> Result<(), IpcError> {
        self.scores.wait(timeout)?;
        while let Some(received) = self.scores.receive()? {
            let Ok(scores) = received else { continue };
            // The items' scores follow their rooms' within moments.
            let start = Instant::now();
            while !scores.has(score_flags::HEARTBEAT) && start.elapsed() < ITEMS_WITHIN {
                let Some(items) = self.items.newest()? else {
                    std::thread::sleep(Duration::from_millis(1));
                    continue;
                };
                self.top = top_labels(&items.items);
                if items.header.sequence >= scores.sequence {
                    break;
                }
            }
            // After the scores: what they contain was narrated before they were published.
            self.hear()?;
            self.scored(&scores);
        }
        self.hear()?;
        self.tell_decisions(u64::MAX);
        Ok(())
    }

    /// Takes what lies in the ports: first the decisions, so that whatever was narrated before them is there, too.
    fn hear(&mut self) -> Result<(), IpcError> {
        while let Some(received) = self.decisions.receive()? {
            self.untold.extend(received.ok());
        }
        while let Some(received) = self.narration.receive()? {
            let Ok(narration) = received else { continue };
            self.narrated(&narration);
        }
        Ok(())
    }

    /// Tells the decisions made before `until_ns`, but for those that narration comes before which waits for its scores: what is
    /// told is in the order of time.
    fn tell_decisions(&mut self, until_ns: u64) {
        let until_ns = self.sentences.front().map_or(until_ns, |(observed_ns, _)| until_ns.min(*observed_ns));
        while let Some(decision) = self.untold.front().copied().filter(|decision| decision.decided_ns < until_ns) {
            self.untold.pop_front();
            self.decided(&decision);
        }
    }

    fn narrated(&mut self, narration: &NarrationV1) {
        let action = Action::parse(narration.text()).ok();
        let sentence = action.as_ref().map_or_else(|| narration.text().to_owned(), Action::sentence);
        let here = self.person.last().map(|(room, ..)| *room);
        let place = action
            .as_ref()
            .and_then(|action| action.objects().iter().filter_map(|object| self.place(object)).next_back());
        // An action without a place happens where the person is.
        let room = place.or(here.flatten());
        let from_ns = self.person.last().map_or(self.begin_ns, |(.., until_ns)| *until_ns);
        self.person.push((room, from_ns, narration.observed_ns));
        self.sentences.push_back((narration.observed_ns, sentence));
    }

    /// The room of the map's first thing of that name, or the room itself.
    fn place(&self, object: &ObjectRef) -> Option<usize> {
        if let Some(room) = self.map.find_room(&object.name) {
            return self.grounding.partitions().iter().position(|partition| partition.rooms.contains(&room));
        }
        let item = self.map.items_of(self.map.find_label(&object.name)?).next()?;
        self.grounding.item_partition()[item.0 as usize].map(|partition| partition.0 as usize)
    }

    fn decided(&mut self, decision: &DecisionV1) {
        let room = self.ids.iter().position(|id| id == decision.to());
        if self.robot.is_empty() {
            self.begin_ns = decision.decided_ns;
        }
        self.robot.push((room, decision.decided_ns));
        self.decision = Some(*decision);
        let at_s = self.at_s(decision.decided_ns);
        let fallback = if decision.has(decision_flags::FALLBACK) { " (fallback)" } else { "" };
        let to = room.map_or("nowhere", |room| self.names[room].as_str());
        let from = self.ids.iter().position(|id| id == decision.from()).map(|room| self.names[room].as_str());
        let way = match from {
            Some(from) if from == to => format!("stays in the {to}"),
            Some(from) => format!("goes from the {from} to the {to}"),
            None => format!("begins in the {to}"),
        };
        self.say(&[format!("{at_s:6.1} s  robot {way}{fallback}: {}", decision.reason())]);
    }

    fn scored(&mut self, scores: &RoomScoresV1) {
        if scores.has(score_flags::HEARTBEAT) {
            return;
        }
        self.scores_seen += 1;
        if scores.observed_ns > 0
            && let Some(latency_ns) = &mut self.latency_ns
        {
            latency_ns.saturating_record(scores.published_ns.saturating_sub(scores.observed_ns));
        }
        // Nothing was observed when these scores were made: they are the first.
        let mut news = scores.observed_ns == 0;
        if news {
            self.say(&[format!("{:6.1} s  nothing is known of the person yet", 0.0)]);
        }
        // Everything that these scores include for the first time.
        while self.sentences.front().is_some_and(|(observed_ns, _)| *observed_ns <= scores.observed_ns) {
            let Some((observed_ns, sentence)) = self.sentences.pop_front() else { break };
            self.tell_decisions(observed_ns);
            let took_ms = scores.published_ns.saturating_sub(observed_ns) as f64 / 1e6;
            let at_s = self.at_s(observed_ns);
            self.say(&[format!("{at_s:6.1} s  {sentence}  (scored after {took_ms:.1} ms)")]);
            news = true;
        }
        if !news {
            return;
        }
        let panel = [self.rooms(scores), vec![self.objects()]].concat();
        if self.panel.is_some() {
            self.draw(&panel);
        } else {
            self.say(&panel);
        }
    }

    fn rooms(&self, scores: &RoomScoresV1) -> Vec<String> {
        let width = self.names.iter().map(String::len).max().unwrap_or(0);
        let robot = self.robot.last().and_then(|(room, _)| *room);
        let person = self.person.last().and_then(|(room, ..)| *room);
        let rows = self.names.iter().zip(scores.rooms()).enumerate().map(|(index, (name, room))| {
            let person = if person == Some(index) { " person" } else { "" };
            let robot = if robot == Some(index) { " robot" } else { "" };
            let percent = 100.0 * room.probability;
            let bar = bar(room.probability, BAR_WIDTH);
            let padding = " ".repeat(BAR_WIDTH - bar.chars().count().min(BAR_WIDTH));
            format!("          {name:width$} {percent:5.1} % {bar}{padding}{person}{robot}").trim_end().to_owned()
        });
        rows.collect()
    }

    fn objects(&self) -> String {
        let objects = self.top.iter().map(|(label, probability)| format!("{label} {:.1} %", 100.0 * probability));
        format!("          next object: {}", objects.collect::<Vec<_>>().join(", "))
    }

    /// Seconds of the person's time since the robot's first decision.
    fn at_s(&self, monotonic_ns: u64) -> f64 {
        monotonic_ns.saturating_sub(self.begin_ns) as f64 / 1e9 * self.speed
    }

    /// Prints lines above the live panel, if there is one.
    fn say(&mut self, lines: &[String]) {
        self.erase();
        let mut out = io::stdout().lock();
        for line in lines {
            // A closed pipe ends the show; the processes are ended by their own guard.
            self.unheard |= writeln!(out, "{line}").is_err();
        }
        self.unheard |= out.flush().is_err();
    }

    /// Draws the live panel: a line that the terminal would wrap could not be erased by counting lines, so it is cut.
    fn draw(&mut self, lines: &[String]) {
        let columns = crossterm::terminal::size().map_or(usize::MAX, |(columns, _)| usize::from(columns));
        self.say(&lines.iter().map(|line| cut(line, columns)).collect::<Vec<_>>());
        self.panel = self.panel.map(|_| lines.len());
    }

    fn erase(&mut self) {
        if let Some(lines) = self.panel.filter(|lines| *lines > 0) {
            self.unheard |= write!(io::stdout(), "\x1b[{lines}A\x1b[J").is_err();
            self.panel = Some(0);
        }
    }

    /// Leaves the panel where it stands.
    fn close(&mut self) {
        self.panel = self.panel.map(|_| 0);
    }

    fn summary(&self, policy: PolicyName) -> String {
        let end_ns = self.person.last().map_or(self.begin_ns, |(.., until_ns)| *until_ns);
        let seconds = |ns: u64| ns as f64 / 1e9 * self.speed;
        let shared_ns: u64 = self.person.iter().map(|stay| shared_with(stay, &self.robot, end_ns)).sum();
        let placed = self.person.iter().filter(|(room, ..)| room.is_some());
        let placed_ns: u64 = placed.map(|(_, from_ns, until_ns)| until_ns.saturating_sub(*from_ns)).sum();
        let naive_s = seconds(placed_ns) / self.names.len().max(1) as f64;
        let mut visited: Vec<_> = self.robot.iter().filter_map(|(room, _)| *room).collect();
        visited.sort_unstable();
        visited.dedup();
        let quantile =
            |q| self.latency_ns.as_ref().map_or(0.0, |latency_ns| latency_ns.value_at_quantile(q) as f64 / 1e6);
        format!(
            "\n{} events, {} decisions, {} of {} rooms visited in {}.\n\
             The robot shared a room with the person for {:.0} of {:.0} s under {policy}; a naive robot would have for {naive_s:.0} s on average.\n\
             From observation to published scores: median {:.1} ms, 90 % within {:.1} ms, worst {:.1} ms.",
            self.person.len(),
            self.robot.len(),
            visited.len(),
            self.names.len(),
            self.map.name(),
            seconds(shared_ns),
            seconds(end_ns.saturating_sub(self.begin_ns)),
            quantile(0.5),
            quantile(0.9),
            quantile(1.0),
        )
    }
}

/// How long the robot was in the person's room during one stay of the person, in nanoseconds.
fn shared_with(&(room, from_ns, until_ns): &(Option<usize>, u64, u64), robot: &[Stay], end_ns: u64) -> u64 {
    let ends = robot.iter().skip(1).map(|(_, from_ns)| *from_ns).chain([end_ns]);
    let overlaps = robot.iter().zip(ends).filter(|((robot, _), _)| robot.is_some() && *robot == room).map(
        |((_, robot_from_ns), robot_until_ns)| until_ns.min(robot_until_ns).saturating_sub(from_ns.max(*robot_from_ns)),
    );
    overlaps.sum()
}

/// As much of a line as fits into so many columns.
fn cut(line: &str, columns: usize) -> String {
    let mut line = line.to_owned();
    while ratatui::text::Line::raw(&line).width() > columns {
        line.pop();
    }
    line
}

/// The likeliest labels: an item's score is its label's, shared among the label's items.
fn top_labels(items: &[roomcast_ipc::ItemScoreV1]) -> Vec<(String, f64)> {
    let mut best = std::collections::BTreeMap::new();
    for item in items {
        let probability = item.log_score_nats.exp() * f64::from(item.label_items.max(1));
        best.insert(item.label(), probability);
    }
    let mut best: Vec<_> = best.into_iter().map(|(label, probability)| (label.to_owned(), probability)).collect();
    best.sort_by(|a, b| b.1.total_cmp(&a.1));
    best.truncate(TOP_OBJECTS);
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_cut_by_the_columns_that_they_take() {
        assert_eq!(cut("kitchen ███", 20), "kitchen ███");
        assert_eq!(cut("kitchen ███", 9), "kitchen █");
        assert_eq!(cut("厨房", 3), "厨");
    }

    #[test]
    fn shared_time_is_the_overlap_of_two_timelines() {
        let robot = [(Some(0), 10), (Some(1), 20), (Some(0), 30)];
        assert_eq!(shared_with(&(Some(0), 0, 15), &robot, 40), 5);
        assert_eq!(shared_with(&(Some(0), 5, 35), &robot, 40), 15);
        assert_eq!(shared_with(&(Some(1), 5, 100), &robot, 40), 10);
        assert_eq!(shared_with(&(Some(2), 0, 100), &robot, 40), 0);
        assert_eq!(shared_with(&(None, 0, 100), &[(None, 0)], 40), 0);
    }
}
