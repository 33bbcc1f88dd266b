//! Whole days with the daemon and the planner, without threads, ports and clock.

use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::time::Duration;

use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_ipc::Sender;
use roomcast_ipc::raw::{DecisionV1, ForecastV1, NarrationV1, PersonForecastsV1, RoomScoresV1};
use roomcast_llama::LlamaModel;

use super::{Cycle, Entry, Intake, Journal, Loaded, SentenceCost, Taken, Zone, journal, load, open_journal};
use crate::config::Config;
use crate::fleet_day::{self, Outcome, ROBOTS, Track};
use crate::household::{self, House, Robot, live};
use crate::narrator::{Account, Who, line_item};
use crate::planner::Planner;
use crate::setup;

/// The daemon's parts, with the real model and a real state database.
struct Daemon {
    cycle: Cycle<LlamaModel>,
    intake: Intake,
    journal: Journal,
    scores: Box<RoomScoresV1>,
    forecast: Box<ForecastV1>,
    persons: Box<PersonForecastsV1>,
}

impl Daemon {
    fn start(config: &Config, now_ns: BootNs, now_unix_ns: UnixNs) -> Self {
        let (journal, mut recovered) = open_journal(&config.daemon).unwrap();
        let journal = journal.unwrap();
        let handle = Some(journal.handle.clone());
        let Loaded { engine, token_counter, .. } =
            load(config, handle, &mut recovered, setup::configured_model, Arc::new(|| true)).unwrap();
        let mut cycle = Cycle::new(engine, config.daemon.heartbeat_ms * 1_000_000);
        let tokens_max = Arc::new(AtomicUsize::new(cycle.engine().sentence_tokens_max()));
        let mut intake = Intake::new(config.daemon.intake).with_cost(SentenceCost::new(token_counter, tokens_max));
        cycle.restore(recovered, &mut intake, now_ns, now_unix_ns);
        let (scores, forecast, persons) = Default::default();
        Self { cycle, intake, journal, scores, forecast, persons }
    }

    fn hear(&mut self, message: &NarrationV1, port: u64, now_ns: BootNs) {
        let Taken::Accepted { observation, .. } = self.intake.take(message, Sender::simulated(port), now_ns) else {
            panic!("not accepted: {}", message.text())
        };
        let record = self.journal.handle.append(&observation);
        self.cycle.enter(Entry::new(observation, now_ns), record);
    }

    /// Scores, and publishes in the order of the scoring thread. Returns whether a message was due.
    fn step(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) -> bool {
        let handle = &self.journal.handle;
        while self.cycle.step_due(now_ns) {
            self.cycle.step(now_ns, now_unix_ns).unwrap();
            let mut attributed = 0;
            self.cycle.engine_mut().tell_moved(|moved| attributed = handle.append(moved));
            self.cycle.engine_mut().tell_whose(|outcome| attributed = handle.append(outcome));
            self.cycle.rests_on(attributed);
            assert!(handle.wait_for(self.cycle.scored_record(), Duration::from_secs(60)), "the journal stands still");
        }
        let Some(scores) = self.cycle.message(now_ns, handle.written(), false) else { return false };
        *self.scores = *scores;
        let engine = self.cycle.engine_mut();
        *self.forecast = *engine.forecast(now_ns);
        *self.persons = *engine.person_forecasts(now_ns);
        engine.tell_gone(|gone| _ = handle.append(gone));
        engine.tell_expected(|outcome| {
            handle.append(outcome);
        });
        engine.tick(now_ns, now_unix_ns);
        while self.cycle.tidy() {}
        true
    }
}

const STEP_NS: u64 = 10_000_000_000;
const MINUTE_NS: u64 = 60_000_000_000;
const BEGIN_NS: u64 = 1_000 * MINUTE_NS;
/// The wall clock is ahead of the boot clock by this time.
const UNIX_NS: u64 = 1_790_000_000_000_000_000;

fn clocks(now_ns: u64) -> (BootNs, UnixNs) {
    (BootNs(now_ns), UnixNs(UNIX_NS + now_ns))
}

struct Brain {
    config: Config,
    /// `None` between a kill and the next start.
    daemon: Option<Daemon>,
    planner: Planner,
    folder: tempfile::TempDir,
}

impl Brain {
    fn start(configuration: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("roomcast.toml");
        std::fs::write(&file, format!("{configuration}[scoring]\nprepare = 0\n")).unwrap();
        let mut config = Config::load(&file).unwrap();
        config.daemon.state = Some(folder.path().join("state"));
        let (now_ns, unix_ns) = clocks(BEGIN_NS);
        let daemon = Some(Daemon::start(&config, now_ns, unix_ns));
        Self { daemon, planner: Self::planner(&config, 1), config, folder }
    }

    fn planner(config: &Config, epoch: u64) -> Planner {
        let map = setup::load_map(config.scene.path.as_deref()).unwrap();
        Planner::new(&config.planner, epoch)
            .with_home(&config.persons.residents, Zone::UTC)
            .with_map(map, config.grounding.level)
    }

    fn daemon(&mut self) -> &mut Daemon {
        self.daemon.as_mut().unwrap()
    }

    fn restart(&mut self, now_ns: u64) {
        self.daemon = None;
        let (now_ns, unix_ns) = clocks(now_ns);
        self.daemon = Some(Daemon::start(&self.config, now_ns, unix_ns));
        let kept = self.planner.kept("").unwrap();
        self.planner = Self::planner(&self.config, now_ns.0).with_kept(kept);
    }

    fn narrate(&mut self, account: &mut Account, port: u64, line: &str, now_ns: u64) {
        let (now_ns, unix_ns) = clocks(now_ns);
        let item = line_item(line, &Who::Somebody).unwrap();
        let message = account.next(&item, now_ns, unix_ns).unwrap();
        self.daemon().hear(&message, port, now_ns);
    }

    fn step(&mut self, now_ns: u64) -> Option<DecisionV1> {
        let (now_ns, unix_ns) = clocks(now_ns);
        let Self { daemon, planner, .. } = self;
        let daemon = daemon.as_mut().unwrap();
        if daemon.step(now_ns, unix_ns) {
            planner.take(&daemon.scores, now_ns).unwrap();
            planner.take_forecast(&daemon.forecast, now_ns).unwrap();
            planner.take_persons(&daemon.persons, now_ns).unwrap();
        }
        let decision = planner.decide(now_ns, unix_ns).unwrap();
        if let Some(decision) = &decision {
            daemon.cycle.engine_mut().see_decision(decision, now_ns);
        }
        decision
    }
}

const SCENE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/household.json");

struct Played {
    brain: Brain,
    narrators: [(&'static str, Account); 2],
    now_ns: u64,
}

impl House for Played {
    fn narrate(&mut self, narrator: &'static str, line: String) {
        let port = self.narrators.iter().position(|(name, _)| *name == narrator).unwrap();
        self.brain.narrate(&mut self.narrators[port].1, port as u64, &line, self.now_ns);
    }

    fn restart(&mut self) {
        self.brain.restart(self.now_ns);
    }

    fn pass(&mut self, minute: u32, robot: &mut Robot) {
        for step in 0..MINUTE_NS / STEP_NS {
            let decided: Vec<DecisionV1> = self.brain.step(self.now_ns).into_iter().collect();
            let at_min = f64::from(minute) + (step * STEP_NS) as f64 / MINUTE_NS as f64;
            let (now_ns, unix_ns) = clocks(self.now_ns);
            for report in robot.act(at_min, &decided, (now_ns.0, unix_ns.0)) {
                self.brain.planner.take_report(&report, now_ns).unwrap();
                self.brain.daemon().cycle.engine_mut().see_report(&report, now_ns);
            }
            self.now_ns += STEP_NS;
        }
        let scores = &self.brain.daemon().scores;
        for (name, account) in &mut self.narrators {
            account.confirm(scores);
            assert_eq!(account.under_way(), 0, "narration of {name} is not confirmed");
        }
    }

    fn newest(&self) -> (&PersonForecastsV1, &RoomScoresV1) {
        let daemon = self.brain.daemon.as_ref().unwrap();
        (&daemon.persons, &daemon.scores)
    }
}

#[test]
fn each_person_is_found_over_a_day_a_night_and_two_restarts() {
    let brain = Brain::start(&household::configuration(SCENE, "state", 1.0));
    let narrators = ["sensors", "camera"].map(|name| (name, Account::new(name, 1)));
    let mut house = Played { brain, narrators, now_ns: BEGIN_NS };
    live(&mut house, household::END_MIN);
    house.brain.daemon = None;
    let recovered = journal::look(&house.brain.folder.path().join("state")).unwrap();
    assert!(!recovered.settled.is_empty(), "no events went: {}", recovered.observations.len());
}

/// One day of two robots. If the bridge runs, each hears the other's decisions.
fn fleet_day(is_bridged: bool) -> Outcome {
    let mut robots = ROBOTS.map(|name| (Brain::start(&fleet_day::configuration(name, SCENE, 1.0)), Track::new()));
    let mut narrators = ROBOTS.map(|_| Account::new("sensors", 1));
    let mut next = 0;
    let steps = ((fleet_day::END_MIN - fleet_day::BEGIN_MIN) * 60.0) as u64 * 1_000_000_000 / STEP_NS;
    for step in 0..steps {
        let now_ns = BEGIN_NS + step * STEP_NS;
        let minute = fleet_day::BEGIN_MIN + (step * STEP_NS) as f64 / MINUTE_NS as f64;
        if let Some((_, said, _)) = fleet_day::DAY.get(next).filter(|(from, ..)| *from <= minute) {
            for ((brain, _), account) in robots.iter_mut().zip(&mut narrators) {
                brain.narrate(account, 0, said, now_ns);
            }
            next += 1;
        }
        for own in 0..robots.len() {
            // The planner of the second robot starts later.
            if own == 1 && minute < fleet_day::BEGIN_MIN + fleet_day::LATER_MIN {
                continue;
            }
            let Some(decision) = robots[own].0.step(now_ns) else { continue };
            robots[own].1.follow(&decision, minute);
            let (other, _) = &mut robots[1 - own];
            if is_bridged {
                other.planner.take_other(&decision, BootNs(now_ns));
                other.daemon().cycle.engine_mut().see_decision(&decision, BootNs(now_ns));
            }
        }
    }
    Outcome::of([&robots[0].1, &robots[1].1], fleet_day::END_MIN)
}

#[test]
fn two_robots_that_hear_each_other_share_no_room_with_each_other_over_a_day() {
    Outcome::check(&fleet_day(true), &fleet_day(false), fleet_day::END_MIN - fleet_day::BEGIN_MIN);
}
