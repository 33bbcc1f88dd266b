//! Two robots and one person through a day, with the bridge and without: how often a robot enters a room in which the other one is, how long
//! robots and person are in one room, and how much gets done.
//!
//! Both fleets go through the same day at once: real daemons and planners, each robot in a domain of its own, all told the same. Those of
//! the one hear of one another by their bridges and a router, those of the other do not. The day is played `ROOMCAST_DAY_SPEED` times
//! faster (by default 480: two minutes), and every time of the configuration is as many times shorter. What planners have as constants is
//! not: one that waits looks again after five seconds, which are 40 minutes of the day at this speed, and 10 at a quarter of it:
//!
//!     ROOMCAST_DAY_SPEED=120 cargo test --release --manifest-path zenoh/Cargo.toml --target-dir target --test it day -- --nocapture

use std::path::Path;
use std::time::{Duration, Instant};

use roomcast_ipc::{
    ALL_PERSONS, DecisionV1, NarrationV1, Node, Publisher, RoomScoresV1, Subscriber, action, narration_kind, sequence,
    text,
};

use crate::support::{NO_ROUTER, Robot, eventually, free_port, python, router, skipped};

const ROBOTS: [&str; 2] = ["robot-1", "robot-2"];
const ROOMS: [&str; 4] = ["kitchen", "living-room", "bedroom", "bathroom"];
const OUT: &str = "out";
/// Minutes of the day.
const BEGIN_MIN: f64 = 390.0;
const END_MIN: f64 = 1350.0;
const CLEANING_MIN: f64 = 20.0;
/// The second robot begins half a stay after the first, so that they do not choose in step by themselves.
const LATER_MIN: f64 = CLEANING_MIN / 2.0;
/// A stay that was this much of a whole one has done its room.
const WHOLE: f64 = 0.95;

/// When, what is narrated of her, and where she is from then on.
const DAY: [(f64, &str, &str); 24] = [
    (392.0, "Ada gets up from the bed.", "bedroom"),
    (400.0, "Ada walks to the bathroom.", "bathroom"),
    (404.0, "Ada turns on the shower.", "bathroom"),
    (420.0, "Ada walks to the kitchen.", "kitchen"),
    (421.0, "Ada opens the fridge.", "kitchen"),
    (470.0, "Ada walks to the living room.", "living-room"),
    (472.0, "Ada turns on the computer.", "living-room"),
    (570.0, "Ada walks to the kitchen.", "kitchen"),
    (571.0, "Ada switches on the coffee maker.", "kitchen"),
    (585.0, "Ada walks to the living room.", "living-room"),
    (720.0, "Ada walks to the kitchen.", "kitchen"),
    (722.0, "Ada opens the fridge.", "kitchen"),
    (780.0, "Ada leaves the house.", OUT),
    (870.0, "Ada comes home.", "living-room"),
    (871.0, "Ada sits down on the sofa.", "living-room"),
    (960.0, "Ada walks to the kitchen.", "kitchen"),
    (975.0, "Ada walks to the living room.", "living-room"),
    (1080.0, "Ada walks to the kitchen.", "kitchen"),
    (1082.0, "Ada switches on the stove.", "kitchen"),
    (1140.0, "Ada walks to the living room.", "living-room"),
    (1142.0, "Ada turns on the television.", "living-room"),
    (1290.0, "Ada walks to the bathroom.", "bathroom"),
    (1310.0, "Ada walks to the bedroom.", "bedroom"),
    (1312.0, "Ada lies down on the bed.", "bedroom"),
];

fn person_at(minute: f64) -> &'static str {
    DAY.iter().rev().find(|(from, ..)| minute >= *from).map_or("bedroom", |(.., room)| room)
}

/// From a minute on a robot is in a room, or at its dock, and works there or waits.
struct Told {
    from_min: f64,
    place: Option<String>,
    works: bool,
}

/// A robot's daemon and planner, and what the test hears of them and tells them.
struct Body {
    robot: Robot,
    decisions: Subscriber<DecisionV1>,
    narration: Publisher<NarrationV1>,
    told: u64,
    /// What it was told to do, in this order.
    told_to: Vec<Told>,
    _node: Node,
}

impl Body {
    fn start(name: &str, way: &str, speed: f64) -> Self {
        let seconds = |real_s: f64| real_s / speed;
        let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/household.json");
        let config = format!(
            "[scene]\npath = {scene:?}\n[model]\nthreads = 1\n[history]\ngap_s = {}\n[persons]\nresidents = [\"ada\"]\nasleep_s = {}\n\
             [forecast]\nobject_s = {}\nstay_s = {}\naction_s = {}\naway_s = {}\n\
             [planner]\nrobot = {name:?}\navoid_robots = true\nroom_time_s = {}\ninterrupt_after_s = {}\n",
            seconds(3600.0).ceil(),
            seconds(1200.0),
            seconds(40.0),
            seconds(120.0),
            seconds(2.0),
            seconds(4.0 * 3600.0),
            seconds(60.0 * CLEANING_MIN),
            seconds(60.0),
        );
        let mut robot = Robot::start_with(name, way, &config, "[peers]\nhear = true");
        // It begins with the day.
        robot.planner.kill();
        let node = robot.domain.open("day").unwrap();
        let scores = node.subscriber::<RoomScoresV1>().unwrap();
        eventually("the daemon lives", || scores.newest().unwrap());
        let (decisions, narration) = (node.subscriber().unwrap(), node.publisher().unwrap());
        Self {
            robot,
            decisions,
            narration,
            told: 0,
            told_to: vec![Told { from_min: BEGIN_MIN, place: None, works: false }],
            _node: node,
        }
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

    /// Does at once what its own planner says.
    fn act(&mut self, name: &str, minute: f64) {
        while let Some(decision) = self.decisions.receive().unwrap() {
            if decision.robot != sequence::source_of_name(name) {
                continue;
            }
            let place = match decision.action {
                action::PAUSE => None,
                // Where nothing is said it waits where it is.
                _ if decision.to().is_empty() => self.place(minute).map(str::to_owned),
                _ => Some(decision.to().to_owned()),
            };
            self.told_to.push(Told { from_min: minute, place, works: decision.action == action::GO });
        }
        self.narration.tick().unwrap();
    }

    fn place(&self, minute: f64) -> Option<&str> {
        let last = self.told_to.iter().rev().find(|told| told.from_min <= minute);
        last.and_then(|told| told.place.as_deref())
    }

    /// The rooms that it entered, and when.
    fn entered(&self) -> impl Iterator<Item = (f64, &str)> {
        let pairs = self.told_to.windows(2).filter(|pair| pair[0].place != pair[1].place);
        pairs.filter_map(|pair| Some((pair[1].from_min, pair[1].place.as_deref()?)))
    }

    /// Its work, with the minutes that each room had of it.
    fn work(&self) -> impl Iterator<Item = (f64, &str)> {
        let ends = self.told_to.iter().skip(1).map(|told| told.from_min).chain([END_MIN]);
        let stays = self.told_to.iter().zip(ends).filter(|(told, _)| told.works);
        stays.filter_map(|(told, end)| Some((end - told.from_min, told.place.as_deref()?)))
    }
}

/// What came of a day.
#[derive(Debug, Default)]
struct Outcome {
    /// Rooms that a robot entered while the other one was in them, and the minutes that they shared.
    entered_twice: usize,
    shared_min: f64,
    /// Minutes of a robot in a room with the person.
    disturbance_min: f64,
    /// Minutes of robots at work, and stays that did their room, of each room.
    working_min: f64,
    done_of_room: [usize; ROOMS.len()],
}

impl Outcome {
    fn of(robots: &[Body; 2]) -> Self {
        let mut outcome = Self::default();
        for (body, other) in [(&robots[0], &robots[1]), (&robots[1], &robots[0])] {
            outcome.entered_twice += body.entered().filter(|(from, room)| other.place(*from) == Some(*room)).count();
            for (minutes, room) in body.work() {
                outcome.working_min += minutes;
                let whole = usize::from(minutes >= WHOLE * CLEANING_MIN);
                outcome.done_of_room[ROOMS.iter().position(|own| *own == room).unwrap()] += whole;
            }
        }
        let mut times: Vec<f64> = DAY.iter().map(|(from, ..)| *from).chain([END_MIN]).collect();
        times.extend(robots.iter().flat_map(|body| body.told_to.iter().map(|told| told.from_min)));
        times.sort_by(f64::total_cmp);
        for pair in times.windows(2) {
            let (from, length) = (pair[0], pair[1] - pair[0]);
            let places = [0, 1].map(|robot| robots[robot].place(from));
            let with_her = places.iter().filter(|place| **place == Some(person_at(from))).count();
            outcome.disturbance_min += length * with_her as f64;
            if places[0].is_some() && places[0] == places[1] {
                outcome.shared_min += length;
            }
        }
        outcome
    }
}

#[test]
fn two_robots_share_a_day_with_one_person_with_the_bridge_and_without() {
    let Some(python) = python() else { return skipped(NO_ROUTER) };
    let speed: f64 = std::env::var("ROOMCAST_DAY_SPEED").map_or(480.0, |text| text.parse().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let _router = router(folder.path(), &python, port);
    let way = format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"");
    let mut fleets = [true, false].map(|bridged| {
        ROBOTS.map(|name| {
            let mut body = Body::start(name, &way, speed);
            if !bridged {
                body.robot.bridge.kill();
            }
            body
        })
    });
    let begin = Instant::now();
    let minute = || BEGIN_MIN + begin.elapsed().as_secs_f64() * speed / 60.0;
    let (mut next, mut begun) = (0, [false; 2]);
    while minute() < END_MIN {
        let now_min = minute();
        if let Some((_, said, _)) = DAY.get(next).filter(|(from, ..)| *from <= now_min) {
            fleets.iter_mut().flatten().for_each(|body| body.tell(said));
            next += 1;
        }
        for robot in 0..2 {
            if !begun[robot] && now_min >= BEGIN_MIN + LATER_MIN * robot as f64 {
                fleets.iter_mut().for_each(|fleet| fleet[robot].robot.planner.restart());
                begun[robot] = true;
            }
            fleets.iter_mut().for_each(|fleet| fleet[robot].act(ROBOTS[robot], now_min));
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    let [with, without] = fleets.each_ref().map(Outcome::of);
    for (name, outcome) in [("with the bridge", &with), ("without", &without)] {
        let Outcome { entered_twice, shared_min, disturbance_min, working_min, done_of_room } = outcome;
        let done: usize = done_of_room.iter().sum();
        eprintln!(
            "{name}: {entered_twice} rooms entered while the other robot was in them, {shared_min:.1} minutes of both in one room, \
             {disturbance_min:.1} of robots beside the person; {done} rooms done ({ROOMS:?}: {done_of_room:?}) in {working_min:.0} \
             minutes of work"
        );
    }
    let day_min = END_MIN - BEGIN_MIN;
    assert!(with.shared_min <= 0.01 * day_min, "with the bridge two robots were in one room: {with:?}");
    assert!(
        with.entered_twice <= without.entered_twice && without.shared_min > with.shared_min,
        "{with:?} {without:?}"
    );
    assert!(with.done_of_room.iter().all(|done| *done > 0), "a room was never done: {with:?}");
}
