//! Days of a household with a robot, by seed: what people ask of a robot at home, and what each way to control it does.
//!
//! Two residents live by a daily plan with random times: work, errands, meals, naps. The planner gets their places at once, and a forecast from
//! other days of the same household. It does not know the plan of the day. A resident who lies in bed sleeps after 20 minutes.

use super::Fault;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use roomcast_core::grounding::PartitionLevel;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_core::semantic_map::{SceneError, SemanticMap};
use roomcast_ipc::raw::{
    ForecastV1, MAX_HORIZONS, PersonForecastsV1, RoomScoresV1, action, forecast_flags, person_flags, presence,
};
use roomcast_ipc::text;
use roomcast_services::config::{OnlyWhen, PlannerConfig, QuietHours, RoomNeeds, WhileAsleep};
use roomcast_services::daemon::Zone;
use roomcast_services::planner::Planner;

/// The rooms; the hall has a door to each other one.
pub const ROOMS: [&str; 6] = ["hall", "kitchen", "living-room", "bedroom", "bathroom", "study"];
const HALL: usize = 0;
const KITCHEN: usize = 1;
const LIVING: usize = 2;
const BED: usize = 3;
const BATH: usize = 4;
const STUDY: usize = 5;
const PERSONS: [&str; 2] = ["Mira", "Ben"];
const DAY: usize = 24 * 60;
const MINUTE_NS: u64 = 60_000_000_000;
const STAY: usize = 10;
const HORIZONS_MIN: [usize; 8] = [0, 5, 10, 20, 30, 60, 120, 240];
/// From lying down to sleep, in minutes.
const FALLS_ASLEEP: usize = 20;
/// The number of days that the forecast learns from.
const KNOWN_DAYS: usize = 60;

/// The minutes of one person: the room, none outside, and whether they sleep.
type Minutes = Vec<(Option<usize>, bool)>;

fn household(days: usize, seed: u64) -> [Minutes; 2] {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    std::array::from_fn(|person| (0..days).flat_map(|day| a_day(person, day % 7 >= 5, &mut rng)).collect())
}

fn a_day(person: usize, is_weekend: bool, rng: &mut ChaCha8Rng) -> Minutes {
    let mut places: Vec<Option<usize>> = Vec::with_capacity(DAY);
    let mut until = |minute: usize, place: Option<usize>| {
        places.extend(std::iter::repeat_n(place, minute.min(DAY).saturating_sub(places.len())));
    };
    let mut about =
        |hour: f64, spread_min: f64| (hour * 60.0 + (rng.random::<f64>() - 0.5) * 2.0 * spread_min).max(0.0) as usize;
    let wakes = about(if is_weekend { 8.5 } else { 6.75 }, 30.0);
    until(wakes, Some(BED));
    until(wakes + about(0.3, 8.0), Some(BATH));
    let breakfast = about(0.5, 15.0);
    until(wakes + 20 + breakfast, Some(KITCHEN));
    let leaves = about(if is_weekend { 10.5 } else { 8.5 }, 30.0);
    until(leaves, Some(LIVING));
    if is_weekend {
        // An errand of ten minutes, an hour in the study, and shopping.
        until(leaves + about(0.2, 5.0), None);
        until(about(12.0, 20.0), Some(STUDY));
        until(about(13.0, 15.0), Some(KITCHEN));
        until(about(14.5, 20.0), Some(if person == 0 { BED } else { LIVING }));
        until(about(16.5, 40.0), None);
    } else if person == 1 {
        // Ben works at home, and goes out for ten minutes twice.
        until(about(11.0, 30.0), Some(STUDY));
        until(about(11.25, 10.0), None);
        until(about(12.5, 20.0), Some(STUDY));
        until(about(13.1, 10.0), Some(KITCHEN));
        until(about(15.0, 30.0), Some(STUDY));
        until(about(15.3, 8.0), None);
        until(about(17.0, 20.0), Some(STUDY));
    } else {
        until(about(17.25, 40.0), None);
    }
    until(about(18.5, 15.0), Some(LIVING));
    until(about(19.5, 15.0), Some(KITCHEN));
    until(about(22.0, 30.0), Some(LIVING));
    until(about(22.4, 5.0), Some(BATH));
    until(DAY, Some(BED));
    let mut lies = 0;
    let minutes = places.into_iter().enumerate().map(|(minute, place)| {
        lies = if place == Some(BED) { lies + 1 } else { 0 };
        // Before the first minute the person slept already.
        let sleeps = place == Some(BED) && (lies >= FALLS_ASLEEP || minute < lies);
        (place, sleeps)
    });
    minutes.collect()
}

/// Probabilities from other days: each place, by hour of the day, place before, and time ahead.
struct Known {
    /// `[hour][place][horizon][place]`; the last place is outside.
    after: Vec<f32>,
}

const PLACES: usize = ROOMS.len() + 1;

fn place_of(room: Option<usize>) -> usize {
    room.unwrap_or(ROOMS.len())
}

impl Known {
    fn of(days: &Minutes) -> Self {
        let mut counts = vec![0.01_f32; 24 * PLACES * HORIZONS_MIN.len() * PLACES];
        for minute in 0..days.len() {
            for (horizon, ahead) in HORIZONS_MIN.iter().enumerate() {
                let Some(later) = days.get(minute + ahead) else { continue };
                let row = Self::row(minute / 60 % 24, place_of(days[minute].0), horizon);
                counts[row + place_of(later.0)] += 1.0;
            }
        }
        for row in counts.chunks_exact_mut(PLACES) {
            let sum: f32 = row.iter().sum();
            row.iter_mut().for_each(|count| *count /= sum);
        }
        Self { after: counts }
    }

    fn row(hour: usize, place: usize, horizon: usize) -> usize {
        ((hour * PLACES + place) * HORIZONS_MIN.len() + horizon) * PLACES
    }

    fn later(&self, minute: usize, place: usize, horizon: usize) -> &[f32] {
        let row = Self::row(minute / 60 % 24, place, horizon);
        &self.after[row..row + PLACES]
    }
}

/// A way to control the robot, by its name in tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::IntoStaticStr, strum::VariantArray)]
pub enum Way {
    #[strum(serialize = "fixed schedule, at 10:00")]
    Schedule,
    /// Goes when the house is empty, and returns when it is not.
    #[strum(serialize = "automation: the house is empty")]
    EmptyHouse,
    #[strum(serialize = "planner without rules")]
    Before,
    /// With quiet hours, sleep, a wait for residents, and each room once a day.
    #[strum(serialize = "planner with rules")]
    Rules,
    /// The same, and only in an empty house that stays empty.
    #[strum(serialize = "planner with rules, only in an empty house")]
    RulesEmptyHouse,
}

impl Way {
    fn config(self) -> Result<PlannerConfig, Fault> {
        let plain = PlannerConfig {
            room_time_s: (STAY * 60) as f64,
            round_s: Some((DAY * 60) as f64),
            interrupt_after_s: 0.0,
            ..PlannerConfig::default()
        };
        if self == Self::Before {
            return Ok(PlannerConfig { know_s: 0.0, while_asleep: WhileAsleep::Ignore, ..plain });
        }
        let needs = |id: &str| RoomNeeds {
            id: id.to_owned(),
            every_s: Some((DAY * 60) as f64 * 0.8),
            priority: 1.0,
            time_s: None,
            exclude: false,
        };
        let quiet = QuietHours::try_from("22:00-07:00".to_owned())?;
        let with_rules =
            PlannerConfig { quiet: vec![quiet], room: ROOMS.iter().map(|id| needs(id)).collect(), ..plain };
        Ok(match self {
            Self::RulesEmptyHouse => {
                let only_when = Some(OnlyWhen::HouseEmpty);
                PlannerConfig { only_when, min_absence_s: 1800.0, min_absence_at: 0.8, ..with_rules }
            }
            _ => with_rules,
        })
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct Sums {
    /// Minutes of work in a room with a person.
    pub near_people_min: usize,
    /// Minutes of work from 22:00 to 7:00.
    pub in_quiet_hours_min: usize,
    /// Minutes of work in a sleeper's room, or in a room next to it.
    pub near_sleeper_min: usize,
    /// Starts in an empty house less than half an hour before a person comes home.
    pub starts_in_short_absence: usize,
    /// The first order, before each resident was observed.
    pub orders_before_knowing: usize,
    /// Pairs of a room and a day without its cleaning.
    pub undone_room_days: usize,
    /// Pairs of a room and a day with it.
    pub done_room_days: usize,
}

/// The rooms of a robot that obeys at once and works for ten minutes in each.
#[derive(Debug, Default)]
struct Robot {
    work: Option<(usize, usize)>,
    todo: Vec<usize>,
}

/// Plays days in one way. The planner starts at three in the night of the first day, and sees a resident from their first move on.
pub fn play(way: Way, days: usize, seed: u64) -> Result<Sums, Fault> {
    const START: usize = 3 * 60;
    let lives = household(days, seed);
    let known: Vec<Known> = household(KNOWN_DAYS, seed ^ 0xABCD).iter().map(Known::of).collect();
    let map = map()?;
    let fingerprint = map.fingerprint();
    let mut planner = Planner::new(&way.config()?, 1).with_map(map, PartitionLevel::Room);
    planner = planner.with_home(&PERSONS.map(str::to_owned), Zone::UTC);
    let seen_from = lives
        .each_ref()
        .map(|life| (START..life.len()).find(|minute| life[*minute].0 != life[START].0).unwrap_or(life.len()));
    let (mut sums, mut robot) = (Sums::default(), Robot::default());
    let mut done = vec![[false; ROOMS.len()]; days];
    let mut is_sent = false;
    for minute in START..days * DAY {
        let (day, of_day) = (minute / DAY, minute % DAY);
        let now: Vec<(Option<usize>, bool)> = lives.iter().map(|life| life[minute]).collect();
        let is_empty = now.iter().all(|(room, _)| room.is_none());
        if let Some((room, _)) = robot.work.take_if(|(_, left)| *left == 0) {
            done[day][room] = true;
        }
        let before = robot.work;
        match way {
            Way::Schedule => {
                if of_day == 10 * 60 {
                    robot.todo = (0..ROOMS.len()).rev().collect();
                }
            }
            Way::EmptyHouse => {
                if of_day == 0 {
                    robot.todo = (0..ROOMS.len()).rev().collect();
                }
                if !is_empty {
                    robot.todo.extend(robot.work.take().map(|(room, _)| room));
                }
            }
            _ => {
                let seen: Vec<bool> = seen_from.iter().map(|from| minute >= *from).collect();
                tell(&mut planner, (minute, fingerprint), &now, &seen, &known)?;
                let now_ns = minute as u64 * MINUTE_NS;
                if let Some(decision) = planner.decide(BootNs(now_ns), UnixNs(now_ns + MONDAY_NS))? {
                    match decision.action {
                        action::GO => {
                            robot.work = ROOMS.iter().position(|id| *id == decision.to()).map(|room| (room, STAY));
                            sums.orders_before_knowing += usize::from(!is_sent && seen.contains(&false));
                            is_sent = true;
                        }
                        _ => robot.work = None,
                    }
                }
            }
        }
        let may_start = match way {
            Way::Schedule => true,
            Way::EmptyHouse => is_empty,
            _ => false,
        };
        if may_start && robot.work.is_none() {
            robot.work = robot.todo.pop().map(|room| (room, STAY));
        }
        if let (None, Some(_), true) = (before, robot.work, is_empty) {
            let back = (minute..minute + 30)
                .any(|later| lives.iter().any(|life| life.get(later).is_some_and(|at| at.0.is_some())));
            sums.starts_in_short_absence += usize::from(back);
        }
        if let Some((room, left)) = &mut robot.work {
            *left -= 1;
            let is_beside = |other: usize| other == *room || other == HALL || *room == HALL;
            sums.near_people_min += usize::from(now.iter().any(|(place, _)| *place == Some(*room)));
            sums.in_quiet_hours_min += usize::from(!(7 * 60..22 * 60).contains(&of_day));
            sums.near_sleeper_min +=
                usize::from(now.iter().any(|(place, sleeps)| *sleeps && place.is_some_and(is_beside)));
        }
    }
    sums.done_room_days = done.iter().flatten().filter(|done| **done).count();
    sums.undone_room_days = days * ROOMS.len() - sums.done_room_days;
    Ok(sums)
}

/// Midnight before a Monday, after 1970.
const MONDAY_NS: u64 = 4 * DAY as u64 * MINUTE_NS;

fn map() -> Result<SemanticMap, SceneError> {
    let room = |(index, id): (usize, &&str)| {
        let x = 4 * index;
        serde_json::json!({"id": id, "label": id.replace('-', " "), "box": {"min_m": [x, 0, 0], "max_m": [x + 4, 4, 3]}})
    };
    let rooms: Vec<_> = ROOMS.iter().enumerate().map(room).collect();
    let door =
        |id: &&str| serde_json::json!({"id": format!("door-{id}"), "rooms": ["hall", id], "position_m": [0, 0, 1]});
    let doors: Vec<_> = ROOMS[1..].iter().map(door).collect();
    let scene = serde_json::json!({"format": "roomcast-scene", "version": 1, "name": "household", "items": [], "rooms": rooms, "doors": doors});
    SemanticMap::from_json(&scene.to_string())
}

fn tell(
    planner: &mut Planner,
    (minute, map_fingerprint): (usize, [u8; 32]),
    now: &[(Option<usize>, bool)],
    seen: &[bool],
    known: &[Known],
) -> Result<(), Fault> {
    let at_ns = minute as u64 * MINUTE_NS;
    let mut scores = RoomScoresV1 { epoch: 1, map_fingerprint, ..Default::default() };
    let mut each = Box::new(PersonForecastsV1 { epoch: 1, ..Default::default() });
    let mut whole = Box::new(ForecastV1 { epoch: 1, ..Default::default() });
    [scores.sequence, each.sequence, whole.sequence] = [minute as u64; 3];
    [scores.computed_ns, each.computed_ns, whole.computed_ns] = [at_ns; 3];
    [scores.published_ns, each.published_ns, whole.published_ns] = [at_ns; 3];
    [scores.room_count, each.room_count, whole.room_count] = [ROOMS.len() as u32; 3];
    [each.horizon_count, whole.horizon_count] = [HORIZONS_MIN.len() as u32; 2];
    for (room, id) in ROOMS.iter().enumerate() {
        scores.room[room].id = text::encode("id", id)?;
        (each.id[room], whole.id[room]) = (scores.room[room].id, scores.room[room].id);
    }
    for (horizon, ahead) in HORIZONS_MIN.iter().enumerate() {
        (each.horizon_s[horizon], whole.horizon_s[horizon]) = ((ahead * 60) as f32, (ahead * 60) as f32);
    }
    let mut free = [[1.0_f32; MAX_HORIZONS]; ROOMS.len()];
    let mut out = [1.0_f32; MAX_HORIZONS];
    let mut count = 0;
    for (person, (place, sleeps)) in now.iter().enumerate().filter(|(person, _)| seen[*person]) {
        let own = &mut each.person[count];
        (own.person, own.name) = (person as u32 + 1, text::encode("name", PERSONS[person])?);
        own.presence = if place.is_some() { presence::PRESENT } else { presence::AWAY };
        own.flags = if *sleeps { person_flags::ASLEEP } else { 0 };
        for horizon in 0..HORIZONS_MIN.len() {
            let later = known[person].later(minute, place_of(*place), horizon);
            own.elsewhere[horizon] = later[ROOMS.len()];
            out[horizon] *= later[ROOMS.len()];
            for room in 0..ROOMS.len() {
                own.probability[room][horizon] = later[room];
                free[room][horizon] *= 1.0 - later[room];
            }
        }
        count += 1;
    }
    (each.persons, each.person_count) = (count as u32, count as u32);
    whole.flags = match count {
        0 => forecast_flags::NOT_KNOWN,
        1 => forecast_flags::RESIDENT_UNKNOWN,
        _ if now.iter().all(|(room, _)| room.is_none()) => forecast_flags::NOBODY_HOME,
        _ => 0,
    };
    for (room, free) in free.iter().enumerate().take(ROOMS.len()) {
        for (told, free) in whole.probability[room].iter_mut().zip(free).take(HORIZONS_MIN.len()) {
            *told = if count == 0 { 1.0 / ROOMS.len() as f32 } else { 1.0 - free };
        }
        scores.room[room].probability = f64::from(whole.probability[room][0]);
    }
    whole.elsewhere = if count == 0 { [0.0; MAX_HORIZONS] } else { out };
    // All messages are dated now.
    let taken = [
        planner.take(&scores, BootNs(at_ns)).is_ok(),
        planner.take_forecast(&whole, BootNs(at_ns)).is_ok(),
        planner.take_persons(&each, BootNs(at_ns)).is_ok(),
    ];
    debug_assert_eq!(taken, [true; 3]);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn with_rules_no_minute_of_noise_falls_into_quiet_hours_or_near_a_sleeper() {
        for seed in 0..6 {
            for way in [Way::Rules, Way::RulesEmptyHouse] {
                let sums = play(way, 7, seed).unwrap();
                let noise = [sums.in_quiet_hours_min, sums.near_sleeper_min, sums.orders_before_knowing];
                assert_eq!(noise, [0; 3], "{way:?}, seed {seed}: {sums:?}");
            }
        }
    }

    #[test]
    fn without_rules_the_robot_works_in_the_night_before_it_knows_anybody() {
        let sums = play(Way::Before, 7, 1).unwrap();
        assert!(
            sums.in_quiet_hours_min > 0 && sums.near_sleeper_min > 0 && sums.orders_before_knowing == 1,
            "{sums:?}"
        );
    }

    #[test]
    fn rules_cost_few_rooms() {
        let (mut rules, mut before) = (0, 0);
        for seed in 0..4 {
            rules += play(Way::Rules, 7, seed).unwrap().undone_room_days;
            before += play(Way::Before, 7, seed).unwrap().undone_room_days;
        }
        assert!(rules <= before + 4 * 7, "{rules} and {before} room days undone");
    }
}
