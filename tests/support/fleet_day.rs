//! A day of two robots and one person in four rooms: the narration, the configuration, and the count of the robots' work. Its first hours run with
//! real processes and bridges; the whole day runs without them.

use roomcast_ipc::raw::{DecisionV1, action};

pub(crate) const ROBOTS: [&str; 2] = ["robot-1", "robot-2"];
const ROOMS: [&str; 4] = ["kitchen", "living-room", "bedroom", "bathroom"];
const OUT: &str = "out";
pub(crate) const BEGIN_MIN: f64 = 390.0;
pub(crate) const END_MIN: f64 = 1350.0;
const CLEANING_MIN: f64 = 20.0;
/// The second robot begins half a stay after the first, so that the two do not choose at the same time.
pub(crate) const LATER_MIN: f64 = CLEANING_MIN / 2.0;
/// A stay that was this much of a whole one has done its room.
const WHOLE: f64 = 0.95;

/// Minute, sentence, and the person's room from then on.
pub(crate) const DAY: [(f64, &str, &str); 24] = [
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

/// The place of a robot from a minute on: a room, or its dock. It works there or waits.
struct Told {
    from_min: f64,
    place: Option<String>,
    works: bool,
}

/// The configuration of a robot's daemon and planner, with every time divided by `speed`.
pub(crate) fn configuration(robot: &str, scene: &str, speed: f64) -> String {
    let seconds = |real_s: f64| real_s / speed;
    format!(
        "[scene]\npath = {scene:?}\n[model]\nthreads = 1\n[history]\ngap_s = {}\n[persons]\nresidents = [\"ada\"]\nasleep_s = {}\n\
         [forecast]\nobject_s = {}\nstay_s = {}\naction_s = {}\naway_s = {}\n\
         [planner]\nrobot = {robot:?}\nknow_s = 0.0\navoid_robots = true\nroom_time_s = {}\ninterrupt_after_s = {}\n",
        seconds(3600.0).ceil(),
        seconds(1200.0),
        seconds(40.0),
        seconds(120.0),
        seconds(2.0),
        seconds(4.0 * 3600.0),
        seconds(60.0 * CLEANING_MIN),
        seconds(60.0),
    )
}

pub(crate) struct Track {
    told_to: Vec<Told>,
}

impl Track {
    pub(crate) fn new() -> Self {
        Self { told_to: vec![Told { from_min: BEGIN_MIN, place: None, works: false }] }
    }

    /// The robot obeys its planner at once.
    pub(crate) fn follow(&mut self, decision: &DecisionV1, minute: f64) {
        let place = match decision.action {
            action::PAUSE => None,
            // A decision without a room does not move the robot.
            _ if decision.to().is_empty() => self.place(minute).map(str::to_owned),
            _ => Some(decision.to().to_owned()),
        };
        self.told_to.push(Told { from_min: minute, place, works: decision.action == action::GO });
    }

    fn place(&self, minute: f64) -> Option<&str> {
        let last = self.told_to.iter().rev().find(|told| told.from_min <= minute);
        last.and_then(|told| told.place.as_deref())
    }

    fn entered(&self) -> impl Iterator<Item = (f64, &str)> {
        let pairs = self.told_to.windows(2).filter(|pair| pair[0].place != pair[1].place);
        pairs.filter_map(|pair| Some((pair[1].from_min, pair[1].place.as_deref()?)))
    }

    /// The stays at work, in minutes, with their rooms.
    fn work(&self, end_min: f64) -> impl Iterator<Item = (f64, &str)> {
        let ends = self.told_to.iter().skip(1).map(|told| told.from_min).chain([end_min]);
        let stays = self.told_to.iter().zip(ends).filter(|(told, _)| told.works);
        stays.filter_map(|(told, end)| Some((end - told.from_min, told.place.as_deref()?)))
    }
}

#[derive(Debug, Default)]
pub(crate) struct Outcome {
    /// Rooms that a robot entered while the other robot was there, and minutes with both in one room.
    entered_twice: usize,
    pub(crate) shared_min: f64,
    /// Minutes of a robot in a room with the person.
    disturbance_min: f64,
    /// Minutes of both robots at work, and complete stays in each room.
    pub(crate) working_min: f64,
    done_of_room: [usize; ROOMS.len()],
}

impl Outcome {
    pub(crate) fn of(robots: [&Track; 2], end_min: f64) -> Self {
        let mut outcome = Self::default();
        for (own, other) in [(robots[0], robots[1]), (robots[1], robots[0])] {
            outcome.entered_twice += own.entered().filter(|(from, room)| other.place(*from) == Some(*room)).count();
            for (minutes, room) in own.work(end_min) {
                outcome.working_min += minutes;
                let whole = usize::from(minutes >= WHOLE * CLEANING_MIN);
                outcome.done_of_room[ROOMS.iter().position(|id| *id == room).unwrap()] += whole;
            }
        }
        let mut times: Vec<f64> = DAY.iter().map(|(from, ..)| *from).chain([end_min]).collect();
        times.extend(robots.iter().flat_map(|own| own.told_to.iter().map(|told| told.from_min)));
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

    /// Compares a day with robots that know each other to a day without, both until this minute.
    pub(crate) fn check(with: &Self, without: &Self, day_min: f64) {
        println!("the robots know of each other: {with:?}\nthey do not: {without:?}\nrooms: {ROOMS:?}");
        assert!(with.shared_min <= 0.01 * day_min, "two robots were in one room: {with:?}");
        assert!(
            with.entered_twice <= without.entered_twice && without.shared_min > with.shared_min,
            "{with:?} {without:?}"
        );
        assert!(with.done_of_room.iter().all(|done| *done > 0), "a room was never done: {with:?}");
    }
}
