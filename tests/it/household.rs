//! The first hours of the household with real processes and the real model, 480 times faster than real time. `services/src/daemon/played.rs` plays
//! the whole day without processes.

use std::io::Write as _;
use std::process::Stdio;
use std::time::{Duration, Instant};

use roomcast_ipc::raw::{DecisionV1, PersonForecastsV1, RobotReportV1, RoomScoresV1};
use roomcast_ipc::{Node, Publisher, Subscriber, clock};

use crate::eventually::eventually;
use crate::household_day::{BEGIN_MIN, House, Robot, configuration, live};
use crate::processes::includes;
use crate::world::World;

const SPEED: f64 = 480.0;
const NARRATORS: [&str; 2] = ["sensors", "camera"];
const MINUTE: Duration = Duration::from_millis(125);
const END_MIN: u32 = BEGIN_MIN + 90;

struct Processes {
    world: World,
    /// Lines that each narrator was given.
    told: [u64; 2],
    /// The first decision, until the robot follows it.
    first: Option<DecisionV1>,
    forecasts: Subscriber<PersonForecastsV1>,
    scores: Subscriber<RoomScoresV1>,
    decisions: Subscriber<DecisionV1>,
    reports: Publisher<RobotReportV1>,
    newest: (Box<PersonForecastsV1>, Box<RoomScoresV1>),
    _node: Node,
}

impl Processes {
    fn start() -> Self {
        let mut world = World::new("household");
        let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/household.json");
        let config = world.path("roomcast.toml");
        std::fs::write(&config, configuration(scene, world.state().to_str().unwrap(), SPEED)).unwrap();
        let node = world.domain.open("household").unwrap();
        let (forecasts, scores) = (node.subscriber().unwrap(), node.subscriber::<RoomScoresV1>().unwrap());
        let decisions = node.subscriber::<DecisionV1>().unwrap();
        let [sensors, camera] = NARRATORS.map(|name| ["narrate", "-", "--name", name]);
        for arguments in [&["daemon"][..], &["planner"], &sensors, &camera] {
            let mut command = world.command(arguments);
            command.arg("--config").arg(&config).stdin(Stdio::piped());
            world.spawn(command);
            if arguments == ["daemon"] {
                eventually("the daemon publishes", || scores.newest().unwrap());
            }
        }
        Self {
            told: [0; 2],
            first: Some(eventually("the planner decides", || decisions.receive().unwrap())),
            forecasts,
            scores,
            decisions,
            reports: node.publisher().unwrap(),
            newest: Default::default(),
            _node: node,
            world,
        }
    }

    /// Takes in the newest forecasts and scores.
    fn hear(&mut self) {
        if let Some(newest) = self.forecasts.newest().unwrap() {
            *self.newest.0 = newest;
        }
        if let Some(newest) = self.scores.newest().unwrap() {
            *self.newest.1 = newest;
        }
    }
}

impl House for Processes {
    fn narrate(&mut self, narrator: &'static str, line: String) {
        let number = NARRATORS.iter().position(|name| *name == narrator).unwrap();
        self.told[number] += 1;
        let process = &mut self.world.children[2 + number].child;
        writeln!(process.stdin.as_mut().unwrap(), "{line}").unwrap();
    }

    fn restart(&mut self) {}

    fn pass(&mut self, minute: u32, robot: &mut Robot) {
        // On a busy machine the minute waits for the narration before it.
        eventually("the forecast knows the narration", || {
            self.hear();
            let is_included = |(name, told): (&&str, &u64)| *told == 0 || includes(&self.newest.1, name, *told);
            let is_known = NARRATORS.iter().zip(&self.told).all(is_included);
            (is_known && self.newest.0.sequence >= self.newest.1.sequence).then_some(())
        });
        let begin = Instant::now();
        while begin.elapsed() < MINUTE {
            let at_min = f64::from(minute) + begin.elapsed().div_duration_f64(MINUTE);
            let others = std::iter::from_fn(|| self.decisions.receive().unwrap());
            let decided: Vec<_> = self.first.take().into_iter().chain(others).collect();
            for report in robot.act(at_min, &decided, (clock::monotonic_ns(), clock::unix_ns())) {
                self.reports.send(&report).unwrap();
            }
            self.reports.tick().unwrap();
            self.forecasts.wait(MINUTE / 10).unwrap();
            self.hear();
        }
        self.world.assert_alive();
    }

    fn newest(&self) -> (&PersonForecastsV1, &RoomScoresV1) {
        (&self.newest.0, &self.newest.1)
    }
}

#[test]
fn real_processes_find_two_residents_in_the_first_hours_of_a_day() {
    live(&mut Processes::start(), END_MIN);
}
