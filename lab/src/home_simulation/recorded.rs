//! Days from elsewhere: HOMER+ days, one household per resident, or activity programs one after another.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::plan::Plan;
use super::{Act, DAY_S, Life, lognormal};
use roomcast_core::grounding::Grounding;
use roomcast_core::narration::Program;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::tracker::{Home, RoomUse, TrackerError};
use roomcast_simulation::binding::{Binder, ItemChoice};
use roomcast_simulation::homer::Day;
use roomcast_simulation::timeline::{PersonOptions, Timeline, TimelineError};

/// A person who did not move for this long sits, in seconds.
const SITS_AFTER: usize = 240;

/// A home with days that were recorded or written elsewhere: a list of days for each resident.
#[derive(Debug, Clone, PartialEq)]
pub struct Recorded {
    pub plan: Plan,
    /// Per resident, days of 24 hours.
    pub residents: Vec<Vec<Life>>,
}

impl Recorded {
    /// A home without days, from a scene.
    pub fn new(map: &SemanticMap, grounding: &Grounding) -> Result<Self, TrackerError> {
        let partitions = grounding.partitions();
        let uses: Vec<RoomUse> = partitions.iter().map(|own| RoomUse::of(&own.label)).collect();
        let find = |usage| uses.iter().position(|own| *own == usage);
        let hall = find(RoomUse::Hall).or_else(|| find(RoomUse::Living)).unwrap_or(0);
        let mut exits = vec![0.0; uses.len()];
        if let Some(exit) = exits.get_mut(hall) {
            *exit = 1.0;
        }
        let home = Home::of(map, partitions, &exits)?;
        let names = partitions.iter().map(|own| own.label.clone()).collect();
        let plan = Plan { names, home, bedrooms: Vec::new(), hall: hall as u8 };
        Ok(Self { plan, residents: Vec::new() })
    }

    fn bedroom(&self) -> u8 {
        self.plan.room(RoomUse::Bedroom)
    }

    /// Adds a resident with HOMER+ days. A day is skipped if the scene has none of its objects.
    pub fn add_days(&mut self, days: &[Day], map: &SemanticMap, grounding: &Grounding) {
        let bedroom = self.bedroom();
        let mut lives = Vec::new();
        for (number, day) in days.iter().enumerate() {
            let mut binder = Binder::new(map, grounding, ItemChoice::First);
            binder.begin(number as u64, "persons");
            let start = u64::from(bedroom);
            let options = PersonOptions::default();
            let Ok(own) = Timeline::of_day(day, "day", map, grounding, &mut binder, &options, start) else { continue };
            let begins = day.actions.first().map_or(0.0, |action| action.done_min * 60.0) as usize;
            let mut life = Life::default();
            life.stay(begins.min(DAY_S), Some(bedroom), Act::Sleep);
            append(&mut life, &own);
            lives.push(life);
        }
        self.add(bedroom, lives);
    }

    /// Adds a resident with these days, each with its rest.
    fn add(&mut self, bedroom: u8, mut lives: Vec<Life>) {
        lives.iter_mut().for_each(|life| rest(life, &self.plan, bedroom));
        self.plan.bedrooms.push(bedroom);
        self.residents.push(lives);
    }

    /// Adds a resident with days of activity programs in random order and pauses.
    pub fn add_programs(
        &mut self,
        programs: &[Program],
        days: usize,
        map: &SemanticMap,
        grounding: &Grounding,
        seed: u64,
    ) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let bedroom = self.bedroom();
        let mut binder = Binder::new(map, grounding, ItemChoice::First);
        let mut play = |number: usize| -> Result<Timeline, TimelineError> {
            binder.begin(number as u64, "persons");
            let options = PersonOptions::default();
            Timeline::of_program(&programs[number], map, grounding, &mut binder, &options, u64::from(bedroom))
        };
        let mut lives = Vec::new();
        for _ in 0..days {
            let mut life = Life::default();
            life.stay(random.random_range(6 * 3_600..8 * 3_600), Some(bedroom), Act::Sleep);
            // Limit on the number of programs without an effect here.
            let mut tries = 0;
            while life.len() < 22 * 3_600 && tries < 1_000 && !programs.is_empty() {
                tries += 1;
                let Ok(own) = play(random.random_range(0..programs.len())) else { continue };
                if let Some(first) = own.rooms.first() {
                    walk(&mut life, &self.plan, first.0 as u8);
                }
                append(&mut life, &own);
                let here = life.room.last().copied().flatten();
                life.stay(lognormal(&mut random, 900.0, 0.8) as usize, here, Act::Sit);
            }
            lives.push(life);
        }
        self.add(bedroom, lives);
    }
}

/// Adds a timeline's rooms: a person at a changing position walks, and a person without a change for minutes sits.
fn append(life: &mut Life, own: &Timeline) {
    let mut rested = 0;
    for (second, room) in own.rooms.iter().enumerate() {
        let moved = second > 0 && own.positions_m[second] != own.positions_m[second - 1];
        rested = if moved { 0 } else { rested + 1 };
        let act = match rested {
            0 => Act::Walk,
            own if own > SITS_AFTER => Act::Sit,
            _ => Act::Busy,
        };
        life.stay(1, Some(room.0 as u8), act);
    }
}

fn walk(life: &mut Life, plan: &Plan, to: u8) {
    let mut at = life.room.last().copied().flatten().unwrap_or(plan.hall);
    while at != to {
        let Some(next) = plan.home.hop(usize::from(at), Some(usize::from(to))) else { break };
        at = next as u8;
        life.stay(4, Some(at), Act::Walk);
    }
}

fn rest(life: &mut Life, plan: &Plan, bedroom: u8) {
    if life.len() < DAY_S {
        walk(life, plan, bedroom);
        life.stay(120, Some(bedroom), Act::Busy);
        life.stay(DAY_S.saturating_sub(life.len()), Some(bedroom), Act::Sleep);
    }
    life.fit(DAY_S);
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;

    #[test]
    fn days_and_programs_fill_whole_days_in_the_rooms_of_a_scene() {
        let map = SemanticMap::from_json(include_str!("../../../scenes/apartment-e0.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let mut own = Recorded::new(&map, &grounding).unwrap();
        let day =
            "### wake\n\n[WALK] <bed> (1) [1]\n370.0\n[WALK] <fridge> (1) [2]\n380.0\n[OPEN] <fridge> (1) [3]\n600.0\n";
        own.add_days(&[Day::parse(day).unwrap()], &map, &grounding);
        let programs = roomcast_services::embedded::PROGRAMS.map(|own| Program::parse(own.text).unwrap());
        own.add_programs(&programs, 2, &map, &grounding, 1);
        assert_eq!(own.residents.iter().map(Vec::len).collect::<Vec<_>>(), [1, 2]);
        let kitchen = own.plan.room(RoomUse::Kitchen);
        for life in own.residents.iter().flatten() {
            assert_eq!(life.len(), DAY_S);
            assert!(life.room.contains(&Some(kitchen)) && life.act.contains(&Act::Walk));
        }
    }
}
