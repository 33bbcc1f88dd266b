//! The daemon's forecast next to the filter that runs ahead: the loss of later places, on the same days.
//!
//! All reports go through the daemon's own [`Engine`], which learns habits from them, and through a tracker. The home is the included flat without
//! a captioner and a robot: both methods then have the same belief about now. The first half of the days teaches only.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::super::Fault;
use super::{Filter, Setup};
use crate::home_simulation::devices::{self, Extras, Report, Said};
use crate::home_simulation::plan::{Device, Plan};
use crate::home_simulation::recorded::Recorded;
use crate::home_simulation::{DAY_S, Truth, days};
use roomcast_core::grounding::GroundingOptions;
use roomcast_core::habits::HabitsOptions;
use roomcast_core::ids::{BootNs, PersonId, UnixNs};
use roomcast_core::narration::{Event, Observation as Narrated, RoomName, SensorReport};
use roomcast_core::pipeline::Pipeline;
use roomcast_core::scorer::table::TableModel;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::tracker::{Observation, SensorSpec};
use roomcast_services::config::PersonsConfig;
use roomcast_services::daemon::{Engine, Entry, HomeHabits, Memory, Persons, PersonsFile, Zone};
use roomcast_services::embedded;

/// Seconds ahead. The first is the belief about now.
const HORIZONS_S: [usize; 7] = [0, 10, 30, 60, 300, 900, 3_600];
/// Seconds between two forecasts.
const EVERY_S: usize = 300;
/// The first day is a Monday.
const BEGIN_S: f64 = 4.0 * DAY_S as f64;
const FLOOR: f64 = 1e-6;
/// Of the learned mixture, as in the habits' pool.
const SHARE: f64 = 0.0005;

/// What forecasts: the belief about now, which stays with a learned probability; the tracker that runs ahead without observations; the daemon; and both
/// with learned weights.
const METHODS: [&str; 4] = ["stays", "filter", "daemon", "filter and daemon"];
const FILTER: usize = 1;
const DAEMON: usize = 2;

/// A method's loss so many seconds ahead.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Row {
    pub residents: usize,
    pub without: Vec<String>,
    pub ahead_s: usize,
    pub method: &'static str,
    /// Mean of -ln P(true place) per person.
    pub log_loss_nats: f64,
    /// The same per room, of being occupied or free.
    pub occupied_nats: Option<f64>,
}

/// The sums of one horizon.
#[derive(Debug, Clone)]
struct Horizon {
    ahead_s: usize,
    cases: f64,
    loss: [f64; METHODS.len()],
    rooms: f64,
    rooms_loss: [Option<f64>; METHODS.len()],
    /// The filter's weight next to the daemon.
    weight: f64,
    /// Cases in which the person was in the same place then, and all cases.
    stayed: [f64; 2],
}

impl Horizon {
    fn new(ahead_s: usize) -> Self {
        let rooms_loss = [None, Some(0.0), Some(0.0), None];
        Self { ahead_s, cases: 0.0, loss: [0.0; 4], rooms: 0.0, rooms_loss, weight: 0.5, stayed: [1.0, 2.0] }
    }

    /// The probability of the true place by each method, which then learn: `belief` is that of being there now, and `is_here` says that it is the
    /// likeliest place now.
    fn case(
        &mut self,
        (belief, is_here): (f64, bool),
        places: usize,
        filter: f64,
        daemon: f64,
    ) -> [f64; METHODS.len()] {
        let share = self.stayed[0] / self.stayed[1];
        let all = [
            share * belief + (1.0 - share) / places as f64,
            filter,
            daemon,
            self.weight * filter + (1.0 - self.weight) * daemon,
        ];
        self.stayed[0] += f64::from(u8::from(is_here));
        self.stayed[1] += 1.0;
        // Outcomes that are closer together than their horizon are alike.
        let rate = (EVERY_S as f64 / self.ahead_s.max(1) as f64).min(1.0);
        let [own, other] =
            [(self.weight, filter), (1.0 - self.weight, daemon)].map(|(w, p)| w * p.max(FLOOR).powf(rate));
        self.weight = (1.0 - SHARE) * own / (own + other) + 0.5 * SHARE;
        all
    }

    fn rows(&self, setup: &Setup) -> impl Iterator<Item = Row> {
        let row = |method: usize| Row {
            residents: setup.residents,
            without: setup.without.iter().map(ToString::to_string).collect(),
            ahead_s: self.ahead_s,
            method: METHODS[method],
            log_loss_nats: self.loss[method] / self.cases.max(1.0),
            occupied_nats: self.rooms_loss[method].map(|loss| loss / self.rooms.max(1.0)),
        };
        (0..METHODS.len()).map(row)
    }
}

/// Plays one home. Each horizon and method has a row.
pub fn run(setup: &Setup) -> Result<Vec<Row>, Fault> {
    let mut random = ChaCha8Rng::seed_from_u64(setup.seed);
    let map = SemanticMap::from_json(embedded::scene("flat").ok_or("the flat ships")?.text)?;
    let pipeline = Pipeline::of(&map, TableModel::new(setup.seed))?;
    let mut plan = Recorded::new(&map, pipeline.grounding())?.plan;
    let ids = pipeline.grounding().partitions().iter().map(|own| RoomName::new(&own.id));
    let ids: Vec<RoomName> = ids.collect::<Result<_, _>>()?;
    plan.bedrooms = vec![plan.room(roomcast_core::tracker::RoomUse::Bedroom); setup.residents];
    let mut without = setup.without.clone();
    without.push(Device::Camera);
    let truth = days::written(&plan, setup.days, setup.visits, &mut random);
    let extras = Extras { pet: setup.pet, robot: false };
    let reports = devices::reports(&plan, &truth, &without, extras, &mut random);
    let mut filter = Filter::new(&plan, setup.tracker, setup.residents)?;
    let specs = plan.sensors(&without);
    for spec in &specs {
        filter.tracker.add_sensor(*spec)?;
    }
    let residents = (0..setup.residents).map(|own| own.to_string()).collect();
    let persons = Persons::new(PersonsConfig { residents, ..PersonsConfig::default() }, PersonsFile::default());
    let habits = HomeHabits::new(Memory::new(HabitsOptions::default()), Zone::UTC);
    let engine = Engine::new(pipeline, map, GroundingOptions::default(), 1)?.with_persons(persons).with_habits(habits);
    let horizons =
        play((&plan, &specs, &ids), (&truth, &reports), filter, Daemon { engine, sequence: 0 }, &mut random)?;
    Ok(horizons.iter().flat_map(|horizon| horizon.rows(setup)).collect())
}

struct Daemon {
    engine: Engine<TableModel>,
    sequence: u64,
}

fn clocks(at_s: f64) -> (BootNs, UnixNs) {
    let ns = ((BEGIN_S + at_s) * 1e9) as u64;
    (BootNs(ns), UnixNs(ns))
}

impl Daemon {
    fn hears(&mut self, spec: &SensorSpec, ids: &[RoomName], number: usize, on: bool, at_s: f64) -> Result<(), Fault> {
        let (boot_ns, unix_ns) = clocks(at_s);
        let room = |room: Option<usize>| room.map(|room| ids[room].clone());
        let report = SensorReport {
            kind: spec.kind,
            id: number.to_string().into(),
            room: room(spec.room),
            beyond: room(spec.beyond),
            on: Some(on),
            hold_s: None,
            false_alarms_per_day: None,
            only_on: false,
        };
        self.sequence += 1;
        let observation = Narrated {
            person: spec.person.map_or(PersonId::SOMEBODY, |person| PersonId(person as u32)),
            observed_ns: boot_ns,
            observed_unix_ns: unix_ns,
            source: 1,
            epoch: 1,
            ..Narrated::saying(self.sequence, Event::Sensor(Arc::new(report)))
        };
        self.engine.step([Entry::new(observation, boot_ns)], boot_ns, unix_ns)?;
        self.engine.tell_outcomes(|_| {});
        while self.engine.tidy() {}
        Ok(())
    }

    /// Per person, horizon and place, elsewhere last; and per horizon and room, the probability that it is occupied.
    fn forecast(&mut self, at_s: f64, persons: usize, rooms: usize) -> Forecasts {
        let (now_ns, _) = clocks(at_s);
        self.engine.person_scores(now_ns);
        let message = self.engine.person_forecasts(now_ns);
        let column = |ahead_s: usize| message.horizons_s().iter().position(|own| *own == ahead_s as f32).unwrap_or(0);
        let columns = HORIZONS_S.map(column);
        let of = |person: usize| {
            let own = message.persons().iter().find(|own| own.person == person as u32);
            let row = |at: usize| {
                let places = |room: usize| own.map_or(0.0, |own| f64::from(own.probability[room][at]));
                let out = own.map_or(0.0, |own| f64::from(own.elsewhere[at]));
                (0..rooms).map(places).chain([out]).collect::<Vec<f64>>()
            };
            columns.map(row)
        };
        let persons = (0..persons).map(of).collect();
        let house = self.engine.forecast(now_ns);
        let occupied = columns.map(|at| (0..rooms).map(|room| f64::from(house.probability[room][at])).collect());
        Forecasts { persons, occupied }
    }
}

struct Forecasts {
    persons: Vec<[Vec<f64>; HORIZONS_S.len()]>,
    occupied: [Vec<f64>; HORIZONS_S.len()],
}

fn play(
    (plan, specs, ids): (&Plan, &[SensorSpec], &[RoomName]),
    (truth, reports): (&Truth, &[Report]),
    mut filter: Filter,
    mut daemon: Daemon,
    random: &mut ChaCha8Rng,
) -> Result<Vec<Horizon>, Fault> {
    let (rooms, residents) = (plan.home.rooms(), truth.residents.len());
    let seconds = truth.residents.first().map_or(0, |life| life.len());
    let mut horizons = HORIZONS_S.map(Horizon::new).to_vec();
    let mut reports = reports.iter().peekable();
    let mut next = random.random_range(60..EVERY_S);
    for second in (0..seconds).step_by(60) {
        let now_s = second as f64;
        while let Some(report) = reports.next_if(|report| report.at_s <= now_s) {
            if let Said::Sensor(number, on) = report.said {
                filter.see(report.at_s, &Observation::Sensor { sensor: number, on: Some(on) });
                daemon.hears(&specs[number], ids, number, on, report.at_s)?;
            }
        }
        let (boot_ns, unix_ns) = clocks(now_s);
        daemon.engine.tick(boot_ns, unix_ns);
        if second < next || second + HORIZONS_S[HORIZONS_S.len() - 1] >= seconds {
            continue;
        }
        next += EVERY_S;
        filter.keep_time(now_s);
        filter.tracker.advance(now_s);
        let told = daemon.forecast(now_s, residents, rooms);
        let is_scored = 2 * second >= seconds;
        for (at, own) in horizons.iter_mut().enumerate() {
            let ahead = filter.tracker.forecast(own.ahead_s as f64);
            let later = second + own.ahead_s;
            for (person, life) in truth.residents.iter().enumerate() {
                let is_at = life.room[later].map(usize::from);
                let column = is_at.unwrap_or(rooms);
                let now = |column: usize| filter.tracker.probability(person, (column < rooms).then_some(column));
                let is_here = (0..=rooms).max_by(|a, b| now(*a).total_cmp(&now(*b))) == Some(column);
                let told = told.persons[person][at][column];
                let all = own.case((now(column), is_here), rooms + 1, ahead.probability(person, is_at), told);
                if is_scored {
                    own.cases += 1.0;
                    own.loss.iter_mut().zip(all).for_each(|(sum, p)| *sum -= p.max(FLOOR).ln());
                }
            }
            for room in (0..rooms).filter(|_| is_scored) {
                let is_occupied = truth.places(later).any(|place| place == Some(room));
                own.rooms += 1.0;
                for (method, p) in [(FILTER, ahead.occupied(room)), (DAEMON, told.occupied[at][room])] {
                    let p = if is_occupied { p } else { 1.0 - p };
                    own.rooms_loss[method].iter_mut().for_each(|sum| *sum -= p.max(FLOOR).ln());
                }
            }
        }
    }
    Ok(horizons)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::home_simulation::days::VISITS;
    use roomcast_core::tracker::Options;

    /// The published forecast is about as good as the filter that runs ahead, and better from a quarter of an hour on.
    #[test]
    fn the_daemon_forecasts_two_residents_from_the_joint_belief() {
        let (without, tracker) = (Vec::new(), Options::default());
        let setup =
            Setup { residents: 2, without, days: 14, seed: 3, pet: false, visits: VISITS, tracker, recorded: None };
        let rows = run(&setup).unwrap();
        let loss = |ahead_s: usize, method: usize| {
            rows.iter().find(|row| (row.ahead_s, row.method) == (ahead_s, METHODS[method])).unwrap().log_loss_nats
        };
        for ahead_s in HORIZONS_S {
            assert!(loss(ahead_s, DAEMON) < loss(ahead_s, FILTER) + 0.02, "{ahead_s} s: {rows:?}");
        }
        assert!(loss(900, DAEMON) < loss(900, FILTER) - 0.03 && loss(900, DAEMON) < loss(900, 0) - 0.03, "{rows:?}");
    }
}
