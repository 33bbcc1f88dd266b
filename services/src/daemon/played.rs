//! Whole days on the daemon and the planner without threads, ports and clock.

use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::time::Duration;

use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_ipc::{DecisionV1, ForecastV1, NarrationV1, PersonForecastsV1, RobotReportV1, RoomScoresV1, Sender};
use roomcast_llama::LlamaModel;

use super::{Cycle, Entry, Intake, Journal, Loaded, SentenceCost, Taken, Zone, journal_options, load};
use crate::config::Config;
use crate::household::{BEGIN_MIN, END_MIN, House, Robot, configuration, live};
use crate::narrator::{Account, Who, line_item};
use crate::planner::Planner;
use crate::setup;

/// The daemon's parts, with the real model and a real journal.
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
        let Loaded { board, token_counter, .. } = load(config, setup::configured_model, Arc::new(|| true)).unwrap();
        let mut cycle = Cycle::new(board, config.daemon.heartbeat_ms * 1_000_000);
        let tokens_max = Arc::new(AtomicUsize::new(cycle.board().sentence_tokens_max()));
        let mut intake = Intake::new(config.daemon.intake).with_cost(SentenceCost::new(token_counter, tokens_max));
        let (journal, recovered) = Journal::open(&journal_options(&config.daemon).unwrap()).unwrap();
        cycle.restore(recovered, &mut intake, now_ns, now_unix_ns);
        let (scores, forecast, persons) = Default::default();
        Self { cycle, intake, journal, scores, forecast, persons }
    }

    fn hear(&mut self, message: &NarrationV1, port: u64, now_ns: BootNs) {
        let Taken::Accepted { observation, .. } = self.intake.take(message, Sender::simulated(port), now_ns) else {
            panic!("not accepted: {}", message.text())
        };
        let record = self.journal.append(&observation);
        self.cycle.enter(Entry::new(observation, now_ns), record);
    }

    /// Scores, and writes its messages where they are due, in the order of the scoring thread; gives whether they were due.
    fn step(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) -> bool {
        let handle = self.journal.handle();
        while self.cycle.step_due(now_ns) {
            self.cycle.step(now_ns, now_unix_ns).unwrap();
            let mut attributed = 0;
            self.cycle.board_mut().tell_moved(|moved| attributed = handle.keep_moved(moved));
            self.cycle.board_mut().tell_whose(|outcome| attributed = handle.append(outcome));
            self.cycle.rests_on(attributed);
            assert!(handle.wait_for(self.cycle.scored_record(), Duration::from_secs(60)), "the journal stands still");
        }
        let Some(scores) = self.cycle.message(now_ns, handle.written(), false) else { return false };
        *self.scores = *scores;
        let board = self.cycle.board_mut();
        *self.forecast = *board.forecast(now_ns);
        *self.persons = *board.person_forecasts(now_ns);
        board.tell_gone(|person| handle.see_off(person));
        board.tell_expected(|outcome| drop(handle.append(outcome)));
        board.tick(now_ns, now_unix_ns);
        while self.cycle.tidy() {}
        true
    }
}

/// A step of the day.
const STEP_NS: u64 = 10_000_000_000;
const MINUTE_NS: u64 = 60_000_000_000;

struct Played {
    config: Config,
    daemon: Daemon,
    planner: Planner,
    accounts: [(&'static str, Account); 2],
    now_ns: u64,
    /// The wall clock is so much ahead.
    unix_ns: u64,
    _folder: tempfile::TempDir,
}

fn planner(config: &Config, epoch: u64) -> Planner {
    let map = setup::load_map(config.scene.path.as_deref()).unwrap();
    Planner::new(&config.planner, epoch)
        .with_home(&config.persons.residents, Zone::UTC)
        .with_map(map, config.grounding.level)
}

impl Played {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/household.json");
        let state = folder.path().join("state");
        let text = configuration(scene, state.to_str().unwrap(), 1.0) + "[scoring]\nprepare = 0\n";
        let file = folder.path().join("roomcast.toml");
        std::fs::write(&file, text).unwrap();
        let config = Config::load(&file).unwrap();
        let (now_ns, unix_ns) = (1_000 * MINUTE_NS, 1_790_000_000_000_000_000);
        Self {
            daemon: Daemon::start(&config, BootNs(now_ns), UnixNs(unix_ns + now_ns)),
            planner: planner(&config, 1),
            accounts: ["sensors", "camera"].map(|name| (name, Account::new(name, 1))),
            config,
            now_ns,
            unix_ns,
            _folder: folder,
        }
    }

    fn now(&self) -> (BootNs, UnixNs) {
        (BootNs(self.now_ns), UnixNs(self.unix_ns + self.now_ns))
    }
}

impl House for Played {
    fn narrate(&mut self, narrator: &'static str, line: String) {
        let (now_ns, unix_ns) = self.now();
        let port = self.accounts.iter().position(|(name, _)| *name == narrator).unwrap();
        let item = line_item(&line, &Who::Somebody).unwrap();
        let message = self.accounts[port].1.next(&item, now_ns, unix_ns).unwrap();
        self.daemon.hear(&message, port as u64, now_ns);
    }

    fn restart(&mut self) {
        let (now_ns, unix_ns) = self.now();
        self.daemon = Daemon::start(&self.config, now_ns, unix_ns);
        let kept = self.planner.kept("").unwrap();
        self.planner = planner(&self.config, self.now_ns).with_kept(kept);
    }

    fn pass(&mut self, minute: u32, robot: &mut Robot) {
        for step in 0..MINUTE_NS / STEP_NS {
            let (now_ns, unix_ns) = self.now();
            if self.daemon.step(now_ns, unix_ns) {
                self.planner.take(&self.daemon.scores, now_ns).unwrap();
                self.planner.take_forecast(&self.daemon.forecast, now_ns).unwrap();
                self.planner.take_persons(&self.daemon.persons, now_ns).unwrap();
                self.accounts.iter_mut().for_each(|(_, account)| account.confirm(&self.daemon.scores));
            }
            let decided: Vec<DecisionV1> = self.planner.decide(now_ns, unix_ns).unwrap().into_iter().collect();
            let at_min = f64::from(minute) + (step * STEP_NS) as f64 / MINUTE_NS as f64;
            let reports: Vec<RobotReportV1> = robot.act(at_min, &decided, (now_ns.0, unix_ns.0));
            let board = self.daemon.cycle.board_mut();
            decided.iter().for_each(|decision| board.see_decision(decision, now_ns));
            for report in &reports {
                self.planner.take_report(report, now_ns).unwrap();
                board.see_report(report, now_ns);
            }
            self.now_ns += STEP_NS;
        }
        assert!(self.accounts.iter().all(|(_, account)| account.under_way() == 0), "narration is not confirmed");
    }

    fn newest(&self) -> (&PersonForecastsV1, &RoomScoresV1) {
        (&self.daemon.persons, &self.daemon.scores)
    }
}

#[test]
fn each_person_is_found_over_a_day_a_night_and_two_restarts() {
    let mut house = Played::start();
    live(&mut house, END_MIN);
    assert!(house.now_ns == (1_000 + u64::from(END_MIN - BEGIN_MIN)) * MINUTE_NS);
    let state = house.config.daemon.state_directory().unwrap();
    assert!(state.join("narration.journal.old").exists(), "the journal was never rotated");
}
