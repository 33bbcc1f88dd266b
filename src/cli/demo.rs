//! `roomcast demo`: the whole system on this machine, as processes in a private domain, with one activity in one apartment. The robot hears the
//! planner's decisions and reports over the real services.
//!
//! The person comes from the simulation, as in the experiments: the laboratory's timeline gives the person's places and observations, and its cost
//! function counts the time that the robot shared with the person. For comparison, the summary has figures of simulated robots in the same home.

use std::collections::VecDeque;
use std::ffi::OsString;
use std::io::{self, IsTerminal, PipeWriter, Write};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use roomcast_ipc::raw::{
    DecisionV1, NarrationV1, RobotReportV1, RoomScoresV1, action, decision_flags, report_kind, score_flags,
};
use roomcast_ipc::{IpcError, ItemScoresSubscriber, Node, Subscriber};
use roomcast_services::clock;

use super::demo_robot::DemoRobot;
use super::demo_story::{NAME, chart, reason, told};
use super::stage::Stage;
use super::{CommandResult, Failure, choice, count, demo_week, ranges, service, table};
use crate::bar::bar;
use crate::columns::{columns, cut, prose, wrapped};
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::ids::BootNs;
use roomcast_core::policy::PolicyName;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::correction::CorrectionChoice;
use roomcast_core::scorer::{Method, Tokenisation};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_llama::{CacheType, LlamaOptions};
use roomcast_services::config::Config;
use roomcast_services::setup;
use roomcast_services::stop::Stop;
use roomcast_simulation::study::{self, Activity, Decider, Home, Means, Options};
use roomcast_simulation::timeline::Timeline;
use roomcast_simulation::world::{Cost, Stay, check_room_time, tally};
use roomcast_simulation::{ScoreSource, StudyError};

/// Loading the model is the slow part of the start.
const START_WITHIN: Duration = Duration::from_secs(120);
const ITEMS_WITHIN: Duration = Duration::from_millis(200);
/// How long a person is in the robot's room before its work is interrupted, in the person's time.
const INTERRUPT_AFTER_S: f64 = 2.0;
const POLL: Duration = Duration::from_millis(50);
const BAR_WIDTH: usize = 30;
const TOP_OBJECTS: usize = 5;

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The scene file, or an included scene's name.
    #[arg(long, value_name = "FILE", default_value = "apartment-e0")]
    scene: PathBuf,
    /// The activity program, or an included one's name.
    #[arg(long, value_name = "FILE", default_value = "p0-breakfast-and-television")]
    program: PathBuf,
    /// A GGUF model; the embedded household model when left out.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// The robot's policy.
    #[arg(long, value_name = "POLICY", value_parser = choice::policy(), default_value_t = PolicyName::CoverageAware)]
    policy: PolicyName,
    /// Seed of every draw: of the robot's policy, of the person, and of the simulated robots.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = ranges::any())]
    seed: u64,
    /// How long the activity plays, in seconds; real time is sped up to fit.
    #[arg(long, value_name = "SECONDS", default_value_t = 24.0, value_parser = ranges::positive)]
    seconds: f64,
    /// T_r: seconds of the person's time that the robot spends in a room.
    #[arg(long, value_name = "SECONDS", default_value_t = 25, value_parser = ranges::room_time_s())]
    room_time: usize,
    /// End the robot's work when a person comes into its room. The simulated robots of the table stay.
    #[arg(long)]
    interrupt: bool,
    /// Show instead how the forecast improves during this many days of one home.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=60),
        conflicts_with_all = ["program", "policy", "seconds", "room_time", "interrupt"])]
    days: Option<u16>,
}

pub fn run(args: &Args) -> CommandResult {
    if let Some(days) = args.days {
        let mut config = Config::default();
        config.scene.path = Some(args.scene.clone());
        config.model.path.clone_from(&args.model);
        return demo_week::run(&config, usize::from(days), args.seed);
    }
    let stop = service::stop()?;
    let map = setup::load_map(Some(&args.scene))?;
    let grounding = Grounding::new(&map, &GroundingOptions::default())?;
    let plot = Plot::new(args, &map, &grounding)?;
    let horizon_s = plot.timeline.len();
    let speed = horizon_s as f64 / args.seconds;

    let mut stage = Stage::new("demo")?;
    let domain = stage.domain();
    let node = domain.open("roomcast-demo")?;
    let mut show = Show::new(&node, &grounding, &plot.timeline, speed)?;

    show.begin(args, &map);
    let mut daemon = vec!["--scene".into(), args.scene.clone().into_os_string()];
    if let Some(model) = &args.model {
        daemon.extend(["--model".into(), model.clone().into_os_string()]);
    }
    stage.start("daemon", &daemon)?;
    let robot = DemoRobot::start(&domain, Duration::from_secs_f64(args.room_time as f64 / speed))?;
    let result = play(args, &mut stage, &mut show, speed, &stop);
    let result = result.and(robot.end());
    show.panel = show.panel.map(|_| 0);
    // The ports must be dropped before the domain can be removed.
    let (summary, unheard) = (show.summary(args, &plot, map.name()), show.unheard);
    drop((show, node));
    drop(stage);
    if stop.requested() {
        return Err(Failure::interrupted("interrupted; everything is cleaned up"));
    }
    result?;
    // The reader of standard output has left: the show ends too, without an error.
    if unheard { Ok(()) } else { super::print(&format!("{summary}\n")) }
}

fn play(args: &Args, stage: &mut Stage, show: &mut Show<'_>, speed: f64, stop: &Stop) -> CommandResult {
    let start = Instant::now();
    while show.scores_seen == 0 && show.goes_on(stage, stop)? {
        if start.elapsed() > START_WITHIN {
            let within = START_WITHIN.as_secs();
            return Err(Failure::failed(format!("the daemon gave no scores within {within} s")));
        }
    }
    // The narrator must run before the person's time begins.
    let failed = |error: io::Error| Failure::failed(format!("cannot speak to the narrator: {error}"));
    let (reading, writing) = io::pipe().map_err(failed)?;
    stage.start_with(
        "narrate",
        &["-".into(), "--name".into(), "demo".into(), "--person".into(), NAME.into()],
        Stdio::from(reading),
        Stdio::null(),
    )?;
    let (policy, seed) = (args.policy.to_string().into(), args.seed.to_string().into());
    let real = |person_s: usize| (person_s as f64 / speed).to_string().into();
    // The experiments' robots enter by the policy's choice and do not leave early.
    let mut planner: Vec<OsString> = vec!["--policy".into(), policy, "--seed".into(), seed];
    planner.extend(["--room-time".into(), real(args.room_time), "--round".into(), real(show.timeline.len())]);
    planner.extend(["--reports", "always", "--forced", "enter", "--scene"].map(OsString::from));
    planner.push(args.scene.clone().into_os_string());
    planner.extend(["--interrupt".into(), args.interrupt.to_string().into()]);
    planner.extend(["--interrupt-after".into(), (INTERRUPT_AFTER_S / speed).to_string().into()]);
    stage.start("planner", &planner)?;
    while show.begin_ns.is_none() && show.goes_on(stage, stop)? {}
    act(stage, show, writing, stop)?;
    while !stage.ended("narrate")? && show.goes_on(stage, stop)? {}
    // The last narration may still be in the ports.
    Ok(show.poll(POLL)?)
}

/// Gives the narrator the person's actions at their times, until the end of the person's time.
fn act(stage: &mut Stage, show: &mut Show<'_>, mut input: PipeWriter, stop: &Stop) -> CommandResult {
    let timeline = show.timeline;
    let lines = timeline.done.iter().map(|done| (done.at_s, Some(done.sentence.as_str())));
    for (at_s, line) in lines.chain([(timeline.len() as f64, None)]) {
        loop {
            let wait_s = (at_s - show.now_s()) / show.speed;
            if wait_s <= 0.0 {
                break;
            }
            if stop.requested() || show.unheard {
                return Ok(());
            }
            stage.check()?;
            let wait = Duration::from_secs_f64(wait_s.min(0.05));
            show.poll(wait)?;
        }
        if let Some(line) = line
            && let Err(error) = writeln!(input, "{line}")
        {
            // If the narrator has ended, its own message is clearer.
            stage.check()?;
            return Err(Failure::failed(format!("cannot speak to the narrator: {error}")));
        }
    }
    Ok(())
}

/// The person's timeline, the cost function, and the results of simulated robots.
struct Plot {
    timeline: Timeline,
    cost: Cost,
    simulated: Vec<(PolicyName, Means)>,
    restarts: u64,
}

impl Plot {
    /// One cell of the experiments: this scene, program and T_r, with the experiments' options.
    fn new(args: &Args, map: &SemanticMap, grounding: &Grounding) -> Result<Self, Failure> {
        let program = setup::load_program(&args.program)?;
        program.notes.iter().for_each(|note| super::tell(format_args!("roomcast: {note}")));
        let options = Options { seed: args.seed, ..Options::default() };
        // In single precision, as the experiments score.
        let llama = LlamaOptions { cache: CacheType::F32, ..LlamaOptions::default() };
        let model = setup::load_model(args.model.as_deref(), &llama)?;
        let (method, tokenisation) = (Method::default(), Tokenisation::default());
        let labels = grounding.label_texts();
        let source = ScoreSource::new(model, &labels, method, tokenisation, CorrectionChoice::default(), None);
        let mut source = source?;
        let activity = Activity::Program(program);
        let activities = [(program_name(&args.program), &activity)];
        let home = Home::new(map, grounding, &activities, &mut source, &BindingSequence::default(), &options)?;
        let timeline = home.timelines().next().cloned();
        let timeline = timeline.ok_or_else(|| Failure::failed("the simulation has no person"))?;
        check_room_time(args.room_time, home.cost().steps()).map_err(StudyError::from)?;
        let known = home.knowledge(args.room_time, options.forecast);
        let mut simulated = Vec::new();
        for policy in [args.policy, PolicyName::CoverageAware, PolicyName::InformedAvoidance, PolicyName::Naive] {
            if simulated.iter().all(|(other, _)| *other != policy) {
                let runs = study::restarts(&home, args.room_time, &known, Decider::Policy(policy), &options);
                simulated.push((policy, Means::of(runs.map_err(StudyError::from)?.iter())));
            }
        }
        Ok(Self { timeline, cost: home.cost().clone(), simulated, restarts: options.restarts })
    }
}

/// The experiments' name of a program, which seeds their draws.
fn program_name(path: &Path) -> String {
    match setup::shipped_program(path) {
        Some(_) => path.display().to_string(),
        None => path.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
    }
}

struct Show<'a> {
    narration: Subscriber<NarrationV1>,
    scores: Subscriber<RoomScoresV1>,
    items: ItemScoresSubscriber,
    decisions: Subscriber<DecisionV1>,
    reports: Subscriber<RobotReportV1>,
    timeline: &'a Timeline,
    names: Vec<String>,
    ids: Vec<String>,
    speed: f64,
    /// Standard output is closed.
    unheard: bool,
    scores_seen: u64,
    /// Narration that no scores contain yet, with the time of its observation.
    sentences: VecDeque<(u64, String)>,
    untold: VecDeque<DecisionV1>,
    /// Decisions that the robot has reported as finished, with the times.
    finished: VecDeque<(u64, u64)>,
    decision: Option<DecisionV1>,
    top: Vec<(String, f64)>,
    /// The robot's stays, in the person's time.
    robot: Vec<Stay>,
    /// The person's next rooms, with the times in seconds of the person's time.
    moves: VecDeque<(usize, usize)>,
    person: Option<usize>,
    /// When the person's time began: at the robot's first decision.
    begin_ns: Option<BootNs>,
    latency_ns: Option<Histogram<u64>>,
    /// Lines of the live panel at the end of the terminal.
    panel: Option<usize>,
}

impl<'a> Show<'a> {
    fn new(node: &Node, grounding: &Grounding, timeline: &'a Timeline, speed: f64) -> Result<Self, IpcError> {
        let mut moves: VecDeque<_> = timeline.rooms.iter().map(|room| room.0 as usize).enumerate().collect();
        let mut before = None;
        moves.retain(|(_, room)| before.replace(*room) != Some(*room));
        Ok(Self {
            narration: node.subscriber()?,
            scores: node.subscriber()?,
            items: node.item_scores_subscriber()?,
            decisions: node.subscriber()?,
            reports: node.subscriber()?,
            timeline,
            names: grounding.partition_names(),
            ids: grounding.partitions().iter().map(|partition| partition.id.clone()).collect(),
            speed,
            unheard: false,
            scores_seen: 0,
            sentences: VecDeque::new(),
            untold: VecDeque::new(),
            finished: VecDeque::new(),
            decision: None,
            top: Vec::new(),
            robot: Vec::new(),
            moves,
            person: None,
            begin_ns: None,
            latency_ns: Histogram::new_with_max(60_000_000_000, 3).ok(),
            panel: io::stdout().is_terminal().then_some(0),
        })
    }

    fn begin(&mut self, args: &Args, map: &SemanticMap) {
        let title = self.timeline.title.trim_end_matches('.');
        let mut lines = vec![
            format!(
                "{NAME} and a robot in {}: {}, {}.",
                map.name(),
                count(self.names.len(), "room"),
                count(map.items().len(), "thing")
            ),
            format!(
                "{NAME}: {title}, {}, {} s of a person's time, played {:.0} times faster.",
                count(self.timeline.done.len(), "step"),
                self.timeline.len(),
                self.speed
            ),
            format!(
                "Robot: cleans each room for {} s and avoids {NAME}, by the policy {}.",
                args.room_time, args.policy
            ),
            "Below each event: how likely her next action is in each room, and with which thing.".to_owned(),
        ];
        if !self.timeline.skipped.is_empty() {
            lines.push(format!("Left out, because the map does not have it: {}.", self.timeline.skipped.join(", ")));
        }
        lines.push(String::new());
        self.say(&lines);
    }

    /// Shows what comes within a moment. Returns whether the show goes on after that.
    fn goes_on(&mut self, stage: &mut Stage, stop: &Stop) -> Result<bool, Failure> {
        stage.check()?;
        self.poll(POLL)?;
        Ok(!stop.requested() && !self.unheard)
    }

    fn poll(&mut self, timeout: Duration) -> Result<(), IpcError> {
        self.scores.wait(timeout)?;
        while let Some(scores) = self.scores.receive()? {
            // The items' scores follow the rooms' scores within moments.
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
            // After the scores: their events were narrated before they were published.
            self.hear()?;
            self.scored(&scores);
        }
        self.hear()?;
        self.tell(clock::monotonic_ns());
        Ok(())
    }

    /// Receives all waiting messages, decisions first: narration from before a decision is then there too.
    fn hear(&mut self) -> Result<(), IpcError> {
        while let Some(report) = self.reports.receive()? {
            if report.kind == report_kind::FINISHED {
                self.finished.push_back((report.decision_sequence, report.reported_ns));
            }
        }
        while let Some(decision) = self.decisions.receive()? {
            self.begin_ns.get_or_insert(BootNs(decision.decided_ns));
            // Decisions after the person's time do not belong to the show.
            if self.at_s(BootNs(decision.decided_ns)) < self.timeline.len() {
                self.untold.push_back(decision);
            }
        }
        while let Some(narration) = self.narration.receive()? {
            self.sentences.push_back((narration.observed_ns, narration.text().to_owned()));
        }
        Ok(())
    }

    /// Prints the decisions and the person's moves before `until_ns`, in the order of time. Those after a narration wait for its scores.
    fn tell(&mut self, until_ns: BootNs) {
        let until_ns = self.sentences.front().map_or(until_ns, |(observed_ns, _)| until_ns.min(BootNs(*observed_ns)));
        let Some(begin_ns) = self.begin_ns else { return };
        loop {
            let decision = self.untold.front().copied().filter(|decision| decision.decided_ns < until_ns.0);
            let at_ns = |(step, _): &(usize, usize)| begin_ns.saturating_add((*step as f64 / self.speed * 1e9) as u64);
            let entry = self.moves.front().copied().filter(|entry| at_ns(entry) < until_ns);
            match (decision, entry) {
                (Some(decision), entry) if entry.is_none_or(|entry| BootNs(decision.decided_ns) <= at_ns(&entry)) => {
                    self.untold.pop_front();
                    self.decided(&decision);
                }
                (_, Some((at_s, room))) => {
                    self.moves.pop_front();
                    self.person = Some(room);
                    self.say(&[format!("{at_s:6} s  {NAME} is now in the {}.", self.names[room])]);
                }
                _ => return,
            }
        }
    }

    fn decided(&mut self, decision: &DecisionV1) {
        // The robot reports the end of its work before its next decision.
        while let Some((sequence, at_ns)) =
            self.finished.front().copied().filter(|(_, at_ns)| *at_ns <= decision.decided_ns)
        {
            self.finished.pop_front();
            let before = self.decision.filter(|before| before.sequence == sequence);
            let room = before.and_then(|before| self.ids.iter().position(|id| id == before.to()));
            if let Some(room) = room {
                let at_s = self.at_s(BootNs(at_ns));
                self.say(&[format!("{at_s:6} s  Report: the {} is done.", self.names[room])]);
            }
        }
        let room = self.ids.iter().position(|id| id == decision.to());
        let at_s = self.at_s(BootNs(decision.decided_ns));
        self.robot.push(Stay { from_s: at_s, room, works: decision.action == action::GO });
        let before = self.decision.replace(*decision);
        if before.is_some_and(|before| (before.to(), before.reason()) == (decision.to(), decision.reason())) {
            return;
        }
        let fallback = if decision.has(decision_flags::FALLBACK) { " (fallback)" } else { "" };
        let from = self.ids.iter().any(|id| id == decision.from()).then(|| decision.from());
        let way = match (room.map(|room| self.names[room].as_str()), from) {
            (None, _) => "stays where it is".to_owned(),
            (Some(to), Some(from)) if from == decision.to() => format!("stays in the {to}"),
            (Some(to), Some(_)) => format!("goes to the {to}"),
            (Some(to), None) => format!("begins in the {to}"),
        };
        self.say(&[format!("{at_s:6} s  Robot {way}{fallback}. {}", reason(decision))]);
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
        // These are the first scores: they contain no event.
        let mut news = scores.observed_ns == 0;
        if news {
            self.say(&[format!("{:6} s  No event yet.", 0)]);
        }
        // All events that these scores contain for the first time.
        while self.sentences.front().is_some_and(|(observed_ns, _)| *observed_ns <= scores.observed_ns) {
            let Some((observed_ns, sentence)) = self.sentences.pop_front() else { break };
            self.tell(BootNs(observed_ns));
            let took_ms = scores.published_ns.saturating_sub(observed_ns) as f64 / 1e6;
            let at_s = self.at_s(BootNs(observed_ns));
            self.say(&[format!("{at_s:6} s  {}  (scored in {took_ms:.1} ms)", told(&sentence))]);
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
        let robot = self.robot.last().and_then(|stay| stay.room);
        let person = self.person;
        let rows = self.names.iter().zip(scores.rooms()).enumerate().map(|(index, (name, room))| {
            let person = if person == Some(index) { " Ada" } else { "" };
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
        format!("          next thing: {}", objects.collect::<Vec<_>>().join(", "))
    }

    /// A moment in the person's time, in whole seconds, as the simulation counts.
    fn at_s(&self, monotonic_ns: BootNs) -> usize {
        let since_ns = monotonic_ns.since(self.begin_ns.unwrap_or(monotonic_ns));
        (since_ns as f64 / 1e9 * self.speed).round() as usize
    }

    /// Seconds of the person's time until now.
    fn now_s(&self) -> f64 {
        let now_ns = clock::monotonic_ns();
        now_ns.since(self.begin_ns.unwrap_or(now_ns)) as f64 / 1e9 * self.speed
    }

    /// Prints lines above the live panel, if there is one.
    fn say(&mut self, lines: &[String]) {
        self.erase();
        let mut out = io::stdout().lock();
        let columns = columns();
        for line in lines {
            // A wrapped line continues below its text, not below the time.
            let indent = if line.starts_with(' ') { INDENT } else { 0 };
            // A closed pipe ends the show; a guard ends the processes.
            self.unheard |= writeln!(out, "{}", wrapped(line, columns, indent)).is_err();
        }
        self.unheard |= out.flush().is_err();
    }

    /// Draws the live panel. Lines are cut, because a line that the terminal wraps could not be erased by counting lines.
    fn draw(&mut self, lines: &[String]) {
        let columns = columns();
        self.say(&lines.iter().map(|line| cut(line, columns)).collect::<Vec<_>>());
        self.panel = self.panel.map(|_| lines.len());
    }

    fn erase(&mut self) {
        if let Some(lines) = self.panel.filter(|lines| *lines > 0) {
            self.unheard |= write!(io::stdout(), "\x1b[{lines}A\x1b[J").is_err();
            self.panel = Some(0);
        }
    }

    fn summary(&self, args: &Args, plot: &Plot, scene: &str) -> String {
        let (shared_s, covered_s) = tally(&plot.cost, args.room_time, &self.robot);
        let horizon_s = self.timeline.len();
        let quantile =
            |q| self.latency_ns.as_ref().map_or(0.0, |latency_ns| latency_ns.value_at_quantile(q) as f64 / 1e6);
        let done = covered_s
            .map_or_else(|| "not every room was done".to_owned(), |s| format!("every room was done after {s} s"));
        let figures = format!(
            "{}, {} in {scene}.\n\
             The robot shared a room with {NAME} for {shared_s:.0} of {horizon_s} s, and {done}.\n\
             From an event to published scores: median {:.1} ms, 90 % within {:.1} ms, worst {:.1} ms.",
            count(self.timeline.done.len(), "event"),
            count(self.robot.len(), "decision"),
            quantile(0.5),
            quantile(0.9),
            quantile(1.0),
        );
        let mut rows = table(&["robot", "shared (s)", "all done after (s)", "not all done"]);
        let dash = || "-".to_owned();
        rows.add_row([
            format!("this one: {}", args.policy),
            format!("{shared_s:.0}"),
            covered_s.map_or_else(dash, |s| s.to_string()),
            dash(),
        ]);
        for (policy, means) in &plot.simulated {
            rows.add_row([
                format!("simulated: {policy}"),
                format!("{:.1}", means.disturbance_s.0),
                means.coverage_s.map_or_else(dash, |(mean, _)| format!("{mean:.1}")),
                format!("{:.1} %", 100.0 * means.failure_rate),
            ]);
        }
        let source = format!(
            "Simulated: means over {} that begin in a random room, with the same person and seed; `roomcast-lab table2 --scene {} --program {} \
             --room-time {} --seed {}` gives the same.",
            count(plot.restarts as usize, "robot"),
            args.scene.display(),
            args.program.display(),
            args.room_time,
            args.seed,
        );
        let rooms: Vec<usize> = self.timeline.rooms.iter().map(|room| room.0 as usize).collect();
        let chart = chart(&self.names, &rooms, &self.robot, columns());
        format!("\n{}\n\n{rows}\n\n{}\n\n{chart}", prose(&figures), prose(&source))
    }
}

/// The indent of lines behind a time.
const INDENT: usize = 10;

/// The likeliest labels. A label's score is split among its items.
fn top_labels(items: &[roomcast_ipc::raw::ItemScoreV1]) -> Vec<(String, f64)> {
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
