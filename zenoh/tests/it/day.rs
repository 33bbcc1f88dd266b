//! The first hours of a day of two robots with real daemons, planners and bridges, 480 times faster than real time. `services/src/daemon/played.rs`
//! plays the whole day without processes.

use std::time::{Duration, Instant};

use roomcast_ipc::raw::{ALL_PERSONS, DecisionV1, NarrationV1, RoomScoresV1, narration_kind};
use roomcast_ipc::{Node, Publisher, Subscriber, sequence, text};

use crate::fleet_day::{BEGIN_MIN, DAY, LATER_MIN, Outcome, ROBOTS, Track, configuration};
use crate::support::{NO_ROUTER, Robot, eventually, free_port, python, router, skipped};

const SPEED: f64 = 480.0;
const END_MIN: f64 = BEGIN_MIN + 100.0;

struct Body {
    robot: Robot,
    decisions: Subscriber<DecisionV1>,
    narration: Publisher<NarrationV1>,
    told: u64,
    track: Track,
    _node: Node,
}

impl Body {
    fn start(name: &str, way: &str) -> Self {
        let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/household.json");
        let mut robot = Robot::start_with(name, way, &configuration(name, scene, SPEED), "[peers]\nhear = true");
        // The planner starts with the day.
        robot.planner.kill();
        let node = robot.domain.open("day").unwrap();
        let scores = node.subscriber::<RoomScoresV1>().unwrap();
        eventually("the daemon lives", || scores.newest().unwrap());
        let (decisions, narration) = (node.subscriber().unwrap(), node.publisher().unwrap());
        Self { robot, decisions, narration, told: 0, track: Track::new(), _node: node }
    }

    fn tell(&mut self, said: &str) {
        self.told += 1;
        let message = NarrationV1 {
            source: sequence::source_of_name("sensors"),
            source_name: text::encode("source", "sensors").unwrap(),
            epoch: 1,
            sequence: self.told,
            person: ALL_PERSONS,
            ..NarrationV1::new(narration_kind::SENTENCE, said).unwrap()
        };
        self.narration.send(&message).unwrap();
    }

    fn act(&mut self, name: &str, minute: f64) {
        while let Some(decision) = self.decisions.receive().unwrap() {
            if decision.robot == sequence::source_of_name(name) {
                self.track.follow(&decision, minute);
            }
        }
        self.narration.tick().unwrap();
    }
}

#[test]
fn two_robots_with_bridges_enter_no_room_of_each_other() {
    let Some(python) = python() else { return skipped(NO_ROUTER) };
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let _router = router(folder.path(), &python, port);
    let way = format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"");
    let mut robots = ROBOTS.map(|name| Body::start(name, &way));
    let begin = Instant::now();
    let minute = || BEGIN_MIN + begin.elapsed().as_secs_f64() * SPEED / 60.0;
    let (mut next, mut begun) = (0, [false; 2]);
    while minute() < END_MIN {
        let now_min = minute();
        if let Some((_, said, _)) = DAY.get(next).filter(|(from, ..)| *from <= now_min) {
            robots.iter_mut().for_each(|body| body.tell(said));
            next += 1;
        }
        for (number, body) in robots.iter_mut().enumerate() {
            if !begun[number] && now_min >= BEGIN_MIN + LATER_MIN * number as f64 {
                body.robot.planner.restart();
                begun[number] = true;
            }
            body.act(ROBOTS[number], now_min);
        }
        // A step of the day.
        std::thread::sleep(Duration::from_millis(2));
    }
    let outcome = Outcome::of(robots.each_ref().map(|body| &body.track), END_MIN);
    println!("{outcome:?}");
    // While a message is on its way, two robots may choose one room.
    assert!(outcome.shared_min <= 1.0 && outcome.working_min > 0.0, "{outcome:?}");
}
