//! Written days: people with characters, appointments, meals at one table, errands alone and together, and visitors.

use rand::RngExt;

use super::plan::Plan;
use super::{Act, DAY_S, Life, Truth, lognormal, normal};
use roomcast_core::tracker::RoomUse;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Job {
    Outside,
    AtHome,
    Retired,
    School,
}

/// A resident's character; times are seconds since midnight.
#[derive(Debug, Clone, Copy)]
struct Character {
    job: Job,
    wakes: f64,
    sleeps: f64,
    leaves: f64,
    returns: f64,
    /// Share of free time that is spent out.
    goes_out: f64,
    bedroom: u8,
}

#[derive(Debug, Clone, Copy)]
enum What {
    Out(usize),
    Cook(usize),
    Eat(usize),
}

const HOUR: f64 = 3_600.0;
/// The usual share of days with guests.
pub const VISITS: f64 = 0.15;

/// Days of a home, a share of them with one or two guests.
pub fn written(plan: &Plan, days: usize, visits: f64, random: &mut impl RngExt) -> Truth {
    let characters: Vec<Character> =
        plan.bedrooms.iter().enumerate().map(|(number, room)| character(number, *room, random)).collect();
    let mut residents: Vec<Body<'_>> = characters.iter().map(|own| Body::new(plan, own.bedroom)).collect();
    let mut guests = vec![Life::default(), Life::default()];
    for day in 0..days {
        let agendas = agendas(&characters, day, random);
        for ((body, character), agenda) in residents.iter_mut().zip(&characters).zip(&agendas) {
            body.live(character, day * DAY_S, agenda, random);
        }
        let has_guests = random.random_bool(visits);
        let from = (normal(random, 15.0 * HOUR, 2.5 * HOUR).clamp(9.0 * HOUR, 20.0 * HOUR)) as usize;
        // Guests come if a resident opens the door.
        let is_home = |body: &Body<'_>| body.life.room.get(day * DAY_S + from).copied().flatten().is_some();
        let opens = residents.iter().any(is_home);
        let two = random.random_bool(0.4);
        for (number, guest) in guests.iter_mut().enumerate() {
            guest.stay(((day * DAY_S) + from).saturating_sub(guest.len()), None, Act::Out);
            if has_guests && opens && (number == 0 || two) {
                visit(plan, guest, random);
            }
        }
    }
    let seconds = days * DAY_S;
    let mut lives: Vec<Life> = residents.into_iter().map(|body| body.life).collect();
    for life in lives.iter_mut().chain(&mut guests) {
        life.fit(seconds);
    }
    Truth { residents: lives, visitors: guests }
}

fn character(number: usize, bedroom: u8, random: &mut impl RngExt) -> Character {
    let job = match number {
        0 => [Job::Outside, Job::AtHome, Job::Retired][random.random_range(0..3)],
        1 => [Job::Outside, Job::Outside, Job::AtHome, Job::Retired][random.random_range(0..4)],
        _ => Job::School,
    };
    let (wakes, leaves, returns) = match job {
        Job::Outside => (6.6, 7.9, 17.3),
        Job::School => (6.9, 7.6, 14.2),
        Job::AtHome => (7.3, 0.0, 0.0),
        Job::Retired => (7.8, 0.0, 0.0),
    };
    let shift = normal(random, 0.0, 0.4);
    Character {
        job,
        wakes: (wakes + shift) * HOUR,
        sleeps: normal(random, if job == Job::School { 21.3 } else { 22.8 }, 0.5) * HOUR,
        leaves: (leaves + shift) * HOUR,
        returns: (returns + normal(random, 0.0, 0.5)) * HOUR,
        goes_out: random.random_range(0.04..0.15),
        bedroom,
    }
}

fn agendas(characters: &[Character], day: usize, random: &mut impl RngExt) -> Vec<Vec<(usize, What)>> {
    let is_weekday = day % 7 < 5;
    let mut agendas: Vec<Vec<(usize, What)>> = vec![Vec::new(); characters.len()];
    for (own, agenda) in characters.iter().zip(&mut agendas) {
        if is_weekday && matches!(own.job, Job::Outside | Job::School) && !random.random_bool(0.05) {
            let leaves = normal(random, own.leaves, 700.0).max(5.0 * HOUR);
            let returns = normal(random, own.returns, 2_200.0).max(leaves + HOUR);
            agenda.push((leaves as usize, What::Out((returns - leaves) as usize)));
        } else {
            let lunch = normal(random, 12.5 * HOUR, 1_500.0).max(0.0) as usize;
            agenda.push((lunch, What::Cook(random.random_range(400..1_500))));
            agenda.push((lunch + 1_500, What::Eat(random.random_range(600..1_500))));
        }
    }
    if !is_weekday && random.random_bool(0.6) {
        // An outing together: they leave within seconds.
        let at = normal(random, 14.0 * HOUR, 1.5 * HOUR).max(9.0 * HOUR) as usize;
        let lasts = lognormal(random, 2.0 * HOUR, 0.5).min(5.0 * HOUR) as usize;
        for agenda in &mut agendas {
            agenda.push((at, What::Out(lasts)));
        }
    }
    let dinner = normal(random, 18.8 * HOUR, 1_300.0).max(16.0 * HOUR) as usize;
    let cook = random.random_range(0..characters.len().min(2));
    for (number, agenda) in agendas.iter_mut().enumerate() {
        if number == cook {
            agenda.push((dinner.saturating_sub(2_000), What::Cook(2_000)));
        }
        agenda.push((dinner + random.random_range(0..300), What::Eat(random.random_range(900..2_100))));
        agenda.sort_by_key(|(at, _)| *at);
    }
    agendas
}

struct Body<'a> {
    plan: &'a Plan,
    life: Life,
    at: u8,
    pace_s: usize,
}

impl<'a> Body<'a> {
    fn new(plan: &'a Plan, at: u8) -> Self {
        Self { plan, life: Life::default(), at, pace_s: 3 }
    }

    fn go(&mut self, to: u8, random: &mut impl RngExt) {
        while self.at != to {
            let Some(next) = self.plan.home.hop(usize::from(self.at), Some(usize::from(to))) else { break };
            // To the door of this room.
            self.life.stay(random.random_range(1..=self.pace_s), Some(self.at), Act::Walk);
            self.at = next as u8;
            self.life.stay(random.random_range(2..=self.pace_s + 1), Some(self.at), Act::Walk);
        }
    }

    fn stay(&mut self, seconds: usize, act: Act) {
        self.life.stay(seconds, Some(self.at), act);
    }

    fn out(&mut self, seconds: usize, random: &mut impl RngExt) {
        self.go(self.plan.hall, random);
        // Shoes and coat.
        self.stay(random.random_range(5..90), Act::Busy);
        self.life.stay(seconds, None, Act::Out);
        self.stay(random.random_range(5..60), Act::Busy);
    }

    fn pass(&mut self, until: usize, own: &Character, random: &mut impl RngExt) {
        while self.life.len() + 60 < until {
            let left = until - self.life.len();
            let hour = (self.life.len() % DAY_S) as f64 / HOUR;
            let draw: f64 = random.random_range(0.0..1.0);
            let room = |usage| self.plan.room(usage);
            let (to, median, act) = match draw {
                d if d < own.goes_out && (9.0..20.0).contains(&hour) && left > 1_800 => {
                    let lasts = lognormal(random, 2_700.0, 0.8).min(left as f64 - 600.0) as usize;
                    self.out(lasts, random);
                    continue;
                }
                d if d < 0.18 => (room(RoomUse::Bathroom), 240.0, Act::Busy),
                d if d < 0.36 => (room(RoomUse::Kitchen), 300.0, Act::Busy),
                d if d < 0.5 && own.job != Job::School => (room(RoomUse::Office), 2_400.0, Act::Sit),
                d if d < 0.55 => (own.bedroom, 400.0, Act::Busy),
                d if d < 0.62 || own.job == Job::School && d < 0.75 => (own.bedroom, 2_000.0, Act::Sit),
                d if d < 0.68 => (random.random_range(0..self.plan.home.rooms()) as u8, 60.0, Act::Busy),
                _ => (room(RoomUse::Living), 2_000.0, Act::Sit),
            };
            self.go(to, random);
            let working =
                own.job == Job::AtHome && (9.0..17.0).contains(&hour) && to == self.plan.room(RoomUse::Office);
            let lasts = lognormal(random, if working { 2.0 * median } else { median }, 0.8).max(20.0) as usize;
            self.stay(lasts.min(until.saturating_sub(self.life.len()).max(20)), act);
            if random.random_bool(0.4) && self.life.len() + 200 < until {
                // Something is fetched from another room.
                let back = self.at;
                self.go(random.random_range(0..self.plan.home.rooms()) as u8, random);
                self.stay(random.random_range(5..60), Act::Busy);
                self.go(back, random);
                let more = lognormal(random, 0.5 * median, 0.8) as usize;
                self.stay(more.min(until.saturating_sub(self.life.len()).max(20)), act);
            }
        }
    }

    fn sleep(&mut self, until: usize, bedroom: u8, random: &mut impl RngExt) {
        self.go(bedroom, random);
        self.stay(random.random_range(30..240), Act::Busy);
        while self.life.len() < until {
            let left = until - self.life.len();
            let next = lognormal(random, 7.0 * HOUR, 0.7) as usize;
            if next + 1_200 > left {
                self.stay(left, Act::Sleep);
                break;
            }
            self.stay(next, Act::Sleep);
            self.stay(random.random_range(3..15), Act::Busy);
            self.go(self.plan.room(RoomUse::Bathroom), random);
            self.stay(lognormal(random, 150.0, 0.4) as usize, Act::Busy);
            self.go(bedroom, random);
            self.stay(random.random_range(2..20), Act::Busy);
        }
    }

    fn live(&mut self, own: &Character, midnight: usize, agenda: &[(usize, What)], random: &mut impl RngExt) {
        self.pace_s = random.random_range(2..=5);
        let wakes = midnight + normal(random, own.wakes, 1_200.0).clamp(4.0 * HOUR, 11.0 * HOUR) as usize;
        self.sleep(wakes, own.bedroom, random);
        self.stay(random.random_range(20..200), Act::Busy);
        self.go(self.plan.room(RoomUse::Bathroom), random);
        self.stay(lognormal(random, 600.0, 0.4) as usize, Act::Busy);
        self.go(own.bedroom, random);
        self.stay(lognormal(random, 240.0, 0.5) as usize, Act::Busy);
        self.go(self.plan.room(RoomUse::Kitchen), random);
        self.stay(lognormal(random, 800.0, 0.4) as usize, Act::Busy);
        for (at, what) in agenda {
            let at = midnight + at;
            if self.life.len() > at + 1_800 {
                continue;
            }
            self.pass(at, own, random);
            match *what {
                What::Out(seconds) => self.out(seconds, random),
                What::Cook(seconds) => {
                    self.go(self.plan.room(RoomUse::Kitchen), random);
                    self.stay(seconds, Act::Busy);
                }
                What::Eat(seconds) => {
                    self.go(self.plan.room(RoomUse::Kitchen), random);
                    self.stay(seconds, Act::Sit);
                }
            }
        }
        let sleeps = midnight + normal(random, own.sleeps, 1_500.0).clamp(20.0 * HOUR, 23.8 * HOUR) as usize;
        self.pass(sleeps, own, random);
        self.go(self.plan.room(RoomUse::Bathroom), random);
        self.stay(lognormal(random, 360.0, 0.4) as usize, Act::Busy);
        self.go(own.bedroom, random);
        self.stay(random.random_range(60..600), Act::Busy);
        let end = midnight + DAY_S;
        if self.life.len() < end {
            self.stay(end - self.life.len(), Act::Sleep);
        }
    }
}

/// A guest comes in, sits in the living room, visits kitchen and bathroom, and leaves.
fn visit(plan: &Plan, guest: &mut Life, random: &mut impl RngExt) {
    let mut body = Body { plan, life: std::mem::take(guest), at: plan.hall, pace_s: 4 };
    body.stay(random.random_range(20..120), Act::Busy);
    let until = body.life.len() + lognormal(random, 5_400.0, 0.4) as usize;
    while body.life.len() < until {
        let (usage, median, act) = match random.random_range(0..10) {
            0 => (RoomUse::Bathroom, 200.0, Act::Busy),
            1 | 2 => (RoomUse::Kitchen, 500.0, Act::Busy),
            _ => (RoomUse::Living, 1_800.0, Act::Sit),
        };
        body.go(plan.room(usage), random);
        let lasts = lognormal(random, median, 0.6) as usize;
        body.stay(lasts, act);
    }
    body.go(plan.hall, random);
    body.stay(random.random_range(10..120), Act::Busy);
    *guest = body.life;
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn written_days_repeat_by_seed_and_walk_through_doors() {
        for residents in 1..=4 {
            let plan = Plan::of_residents(residents).unwrap();
            let days = |seed| written(&plan, 3, VISITS, &mut rand_chacha::ChaCha8Rng::seed_from_u64(seed));
            let truth = days(5);
            assert!(truth == days(5) && truth != days(6));
            assert_eq!(truth.residents.len(), residents);
            for life in truth.residents.iter().chain(&truth.visitors) {
                assert_eq!(life.len(), 3 * DAY_S);
                for pair in life.room.windows(2).filter(|pair| pair[0] != pair[1]) {
                    let is_way = match (pair[0], pair[1]) {
                        (Some(a), Some(b)) => plan.home.are_joined(usize::from(a), usize::from(b)),
                        (Some(room), None) | (None, Some(room)) => room == plan.hall,
                        (None, None) => true,
                    };
                    assert!(is_way, "{pair:?}");
                }
                let asleep = life.act.iter().filter(|act| **act == Act::Sleep).count();
                assert!(asleep < 2 * DAY_S, "{asleep}");
            }
        }
    }
}
