//! Imperfect devices that watch the truth and report.

use rand::RngExt;

use super::plan::{Device, Plan};
use super::{Act, DAY_S, Life, Truth, lognormal};
use roomcast_core::tracker::{RoomUse, SensorKind, SensorSpec};

#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    pub at_s: f64,
    pub said: Said,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Said {
    /// A sensor's state; the index is that in [`Plan::sensors`].
    Sensor(usize, bool),
    /// A caption: the person if it names one, and the likelihood of its text per room.
    Action(Option<usize>, Vec<f64>),
    Robot(Vec<usize>),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Extras {
    /// A cat in front of the motion sensors.
    pub pet: bool,
    /// A robot that drives each morning.
    pub robot: bool,
}

pub fn reports(
    plan: &Plan,
    truth: &Truth,
    without: &[Device],
    extras: Extras,
    random: &mut impl RngExt,
) -> Vec<Report> {
    let people: Vec<&Life> = truth.residents.iter().chain(&truth.visitors).collect();
    let seconds = people.iter().map(|life| life.len()).max().unwrap_or(0);
    let stirs: Vec<Vec<u8>> = people.iter().map(|life| stirs(life, random)).collect();
    let robot = if extras.robot { robot(plan, seconds, random) } else { vec![None; seconds] };
    let mut reports = Vec::new();
    for (number, spec) in plan.sensors(without).into_iter().enumerate() {
        let flips = match (spec.kind, spec.room, spec.person) {
            (SensorKind::Motion, Some(room), _) => motion(plan, room, (&people, &stirs), &robot, extras.pet, random),
            (SensorKind::Presence, Some(room), _) => presence(room, &people, random),
            (SensorKind::Bed, _, Some(person)) => bed(people[person], random),
            (SensorKind::Phone, _, Some(person)) => phone(people[person], random),
            (SensorKind::Door, ..) => door(&people, random),
            _ => plug(&spec, &people, seconds, random),
        };
        reports.push(Report { at_s: 0.0, said: Said::Sensor(number, flips.first().is_some_and(|flip| !flip.1)) });
        let mut on = flips.first().is_some_and(|flip| !flip.1);
        for (at_s, state) in flips {
            if state != on && at_s < seconds as f64 {
                on = state;
                reports.push(Report { at_s, said: Said::Sensor(number, on) });
            }
        }
    }
    if !without.contains(&Device::Camera) {
        captions(plan, truth, &mut reports, random);
    }
    let mut before = None;
    for (second, own) in robot.iter().enumerate() {
        if *own != before {
            let rooms = own.iter().map(|room| usize::from(*room)).collect();
            reports.push(Report { at_s: second as f64, said: Said::Robot(rooms) });
            before = *own;
        }
    }
    reports.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    reports
}

type Flips = Vec<(f64, bool)>;

/// Seconds in which a person moves: 0 still, 1 moves, 2 walks. A person in a blind spot of the room moves unseen.
fn stirs(life: &Life, random: &mut impl RngExt) -> Vec<u8> {
    let mut out = vec![0; life.len()];
    let mut at = 0;
    let mut blind = false;
    while at < life.len() {
        let (room, act) = (life.room[at], life.act[at]);
        if at > 0 && (life.room[at - 1] != room || life.act[at - 1] != act) {
            blind = random.random_bool(0.1);
        }
        match act {
            Act::Out => at += 1,
            Act::Walk => {
                out[at] = 2;
                at += 1;
            }
            _ => {
                let median = match act {
                    Act::Busy => 8.0,
                    Act::Sit => 120.0,
                    _ => 1_500.0,
                };
                let burst = random.random_range(1..5);
                for _ in 0..burst {
                    if at < life.len() && life.room[at] == room && life.act[at] == act {
                        out[at] = u8::from(!blind);
                        at += 1;
                    }
                }
                let gap = lognormal(random, median, 1.1) as usize;
                let mut passed = 0;
                while passed < gap && at < life.len() && life.room[at] == room && life.act[at] == act {
                    at += 1;
                    passed += 1;
                }
            }
        }
    }
    out
}

fn motion(
    plan: &Plan,
    room: usize,
    (people, stirs): (&[&Life], &[Vec<u8>]),
    robot: &[Option<u8>],
    pet: bool,
    random: &mut impl RngExt,
) -> Flips {
    let hold = random.random_range(25.0..95.0);
    let dead = random.random_range(2.0..8.0);
    // Some sensors have a noisy day: sunlight, a heater.
    let alarms = if random.random_bool(0.1) { 6.0 } else { 0.3 } + if pet { 5.0 } else { 0.0 };
    let alarm = alarms / DAY_S as f64;
    let mut flips = Vec::new();
    let (mut until, mut blind_until) = (f64::NEG_INFINITY, 0.0);
    for second in 0..robot.len() {
        let now = second as f64;
        let mut sees = random.random_bool(alarm);
        for (life, stirs) in people.iter().zip(stirs) {
            let Some(here) = life.room[second] else { continue };
            let chance = match (usize::from(here) == room, stirs[second]) {
                (_, 0) => continue,
                (true, 2) => 0.85,
                (true, _) => 0.7,
                // Through an open door.
                (false, 2) if plan.home.are_joined(usize::from(here), room) => 0.005,
                _ => continue,
            };
            sees |= random.random_bool(chance);
        }
        sees |= robot[second] == Some(room as u8) && random.random_bool(0.1);
        if until > 0.0 && now >= until {
            flips.push((now + 0.3, false));
            until = f64::NEG_INFINITY;
            blind_until = now + dead;
        }
        if sees && now >= blind_until {
            if until < 0.0 {
                flips.push((now + random.random_range(0.1..0.9), true));
            }
            until = now + hold;
        }
    }
    flips
}

fn presence(room: usize, people: &[&Life], random: &mut impl RngExt) -> Flips {
    let hold = random.random_range(10.0..30.0);
    let mut flips = Vec::new();
    let (mut on, mut seen, mut lost_until, mut ghost_until) = (false, f64::NEG_INFINITY, 0.0, 0.0);
    let seconds = people.first().map_or(0, |life| life.len());
    for second in 0..seconds {
        let now = second as f64;
        let is_in = people.iter().any(|life| life.room[second] == Some(room as u8));
        let walks = people.iter().any(|life| life.room[second] == Some(room as u8) && life.act[second] == Act::Walk);
        if is_in && !walks && random.random_bool(0.1 / 3_600.0) {
            lost_until = now + lognormal(random, 90.0, 0.8);
        }
        if random.random_bool(0.4 / DAY_S as f64) {
            ghost_until = now + lognormal(random, 180.0, 1.0);
        }
        let detects = is_in && (now >= lost_until || walks) || now < ghost_until;
        if detects && random.random_bool(0.6) {
            seen = now;
            if !on {
                flips.push((now + 0.8, true));
                on = true;
            }
        } else if on && now - seen > hold {
            flips.push((now, false));
            on = false;
        }
    }
    flips
}

fn bed(life: &Life, random: &mut impl RngExt) -> Flips {
    let mut flips = Vec::new();
    let (mut on, mut turn) = (false, 0.0);
    for second in 0..life.len() {
        let now = second as f64;
        let lies = life.act[second] == Act::Sleep;
        if lies && random.random_bool(0.3 / DAY_S as f64) {
            turn = now + lognormal(random, 120.0, 0.7);
        }
        let pressed = lies && now >= turn;
        if pressed != on {
            flips.push((now + random.random_range(1.0..8.0), pressed));
            on = pressed;
        }
    }
    monotone(flips)
}

fn phone(life: &Life, random: &mut impl RngExt) -> Flips {
    let mut flips = vec![(0.0, true)];
    let mut lost_until = 0.0;
    let mut forgotten = false;
    for second in 1..life.len() {
        let now = second as f64;
        let (was, is) = (life.room[second - 1].is_some(), life.room[second].is_some());
        if was && !is {
            forgotten = random.random_bool(0.02);
            if !forgotten {
                flips.push((now + random.random_range(50.0..420.0), false));
            }
        } else if !was && is && !forgotten {
            flips.push((now + random.random_range(5.0..240.0), true));
        } else if is && now > lost_until + 600.0 && random.random_bool(0.4 / DAY_S as f64) {
            lost_until = now + lognormal(random, 600.0, 0.8);
            flips.extend([(now, false), (lost_until, true)]);
        }
    }
    // A short errand: the phone left the network after its person came back.
    monotone(flips)
}

/// Flips in the order of their times, each state once.
fn monotone(mut flips: Flips) -> Flips {
    flips.sort_by(|a, b| a.0.total_cmp(&b.0));
    flips.dedup_by_key(|flip| flip.1);
    flips
}

fn door(people: &[&Life], random: &mut impl RngExt) -> Flips {
    let mut opens = Vec::new();
    let seconds = people.first().map_or(0, |life| life.len());
    for second in 1..seconds {
        let passes = people.iter().any(|life| life.room[second - 1].is_some() != life.room[second].is_some());
        let is_home = people.iter().any(|life| life.room[second].is_some());
        if passes && !random.random_bool(0.01) || is_home && random.random_bool(0.4 / DAY_S as f64) {
            opens.push((second as f64 - random.random_range(0.5..3.0), second as f64 + random.random_range(1.0..12.0)));
        }
    }
    let mut flips: Flips = Vec::new();
    for (from, to) in opens {
        match flips.last_mut() {
            Some(last) if last.0 >= from => last.0 = last.0.max(to),
            _ => flips.extend([(from, true), (to, false)]),
        }
    }
    flips
}

/// A coffee machine with a timer, which people in the kitchen use as well.
fn plug(spec: &SensorSpec, people: &[&Life], seconds: usize, random: &mut impl RngExt) -> Flips {
    let mut flips = Vec::new();
    let mut until = 0.0;
    for second in 0..seconds {
        let now = second as f64;
        let is_in = |life: &&Life| life.room[second].map(usize::from) == spec.room && life.act[second] == Act::Busy;
        let used = people.iter().any(is_in) && random.random_bool(1.0 / 1_500.0);
        if now >= until && (used || second % DAY_S == 23_400) {
            until = now + random.random_range(120.0..1_500.0);
            flips.extend([(now, true), (until, false)]);
        }
    }
    flips
}

/// A captioner in kitchen and living room: it names people, sometimes wrongly, and some of its texts name no room.
fn captions(plan: &Plan, truth: &Truth, reports: &mut Vec<Report>, random: &mut impl RngExt) {
    let rooms = plan.home.rooms();
    let seen: Vec<u8> = [RoomUse::Kitchen, RoomUse::Living].map(|usage| plan.room(usage)).to_vec();
    let residents = truth.residents.len();
    for (number, life) in truth.residents.iter().chain(&truth.visitors).enumerate() {
        for second in (0..life.len()).filter(|second| matches!(life.act[*second], Act::Busy | Act::Sit)) {
            let Some(here) = life.room[second].filter(|room| seen.contains(room)) else { continue };
            if !random.random_bool(1.0 / 900.0) {
                continue;
            }
            let named = (number < residents && random.random_bool(0.6)).then_some(number);
            let wrong = random.random_bool(0.05);
            let who = named.map(|own| if wrong { random.random_range(0..residents) } else { own });
            let mut list = vec![0.0; rooms];
            if random.random_bool(0.6) {
                let room = if random.random_bool(0.03) { random.random_range(0..rooms) } else { usize::from(here) };
                list[room] = 1.0;
            } else {
                // The language model's scores of a text that names no room.
                list.iter_mut().for_each(|own| *own = random.random_range(0.02..0.15));
                list[usize::from(here)] = random.random_range(0.2..0.9);
            }
            reports.push(Report { at_s: second as f64 + random.random_range(1.0..6.0), said: Said::Action(who, list) });
        }
    }
}

fn robot(plan: &Plan, seconds: usize, random: &mut impl RngExt) -> Vec<Option<u8>> {
    let mut out = vec![None; seconds];
    for day in 0..seconds / DAY_S {
        let mut at = day * DAY_S + random.random_range(9 * 3_600..11 * 3_600);
        for room in 0..plan.home.rooms() {
            let next = (at + random.random_range(400..900)).min(seconds);
            out[at.min(seconds)..next].fill(Some(room as u8));
            at = next;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::days;
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn reports_come_by_time_and_repeat_by_seed() {
        let plan = Plan::of_residents(2).unwrap();
        let run = || {
            let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
            let truth = days::written(&plan, 2, days::VISITS, &mut random);
            reports(&plan, &truth, &[], Extras { pet: true, robot: true }, &mut random)
        };
        let own = run();
        assert_eq!(own, run());
        assert!(own.len() > 500 && own.windows(2).all(|pair| pair[0].at_s <= pair[1].at_s));
        let flips =
            |number| own.iter().filter(move |report| matches!(report.said, Said::Sensor(own, _) if own == number));
        for sensor in 0..plan.sensors(&[]).len() {
            let states: Vec<&Said> = flips(sensor).map(|report| &report.said).collect();
            assert!(states.windows(2).all(|pair| pair[0] != pair[1]), "sensor {sensor} repeats itself");
        }
    }
}
