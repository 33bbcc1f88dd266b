//! Next things and next rooms: every sentence is forecast, then learned from.

use super::super::baselines::{Baselines, Statistics, staying};
use super::super::prediction::probabilities;
use super::chains::{Chain, ORDER_MAX};
use super::cleaning::Cleaning;
use super::horizon::Horizon;
use super::predictors::*;
use super::tally::Tally;
use super::{ACTIVITY_S, CHAINS, OBJECT, OBJECT_OR_SAME, Options, PREDICTORS, ROOM, ROOM_IF_CHANGED, bound};
use roomcast_cli::CommandResult;
use roomcast_core::forecast::Forecaster;
use roomcast_core::grounding::{GroundedScores, Grounding};
use roomcast_core::habits::{Habits, HabitsOptions, Place, Turn};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_simulation::binding::{Binder, ItemChoice};
use roomcast_simulation::trace::{Step, Trace};

#[derive(Clone, Default)]
struct Forecast {
    objects: Vec<f64>,
    rooms: Vec<f64>,
    /// Probabilities of another thing than the last, if the predictor has a separate forecast of them.
    another: Option<Vec<f64>>,
}

/// A case before its outcome.
struct Case {
    day: usize,
    unseen: bool,
    here: Option<usize>,
    last: Option<usize>,
    /// Whether a sentence mentioned something since.
    mentioned: bool,
    forecasts: Vec<Forecast>,
}

/// Probabilities given that the person leaves the present room.
fn without(p: &[f64], here: usize) -> Vec<f64> {
    let mut others: Vec<f64> = p.iter().enumerate().map(|(room, p)| if room == here { 0.0 } else { *p }).collect();
    let total: f64 = others.iter().sum();
    let even = 1.0 / (others.len() - 1).max(1) as f64;
    for (room, p) in others.iter_mut().enumerate() {
        *p = if room == here {
            0.0
        } else if total > 0.0 {
            *p / total
        } else {
            even
        };
    }
    others
}

pub(super) struct Watch<'a> {
    pub(super) trace: &'a Trace,
    grounding: &'a Grounding,
    pub(super) rooms: usize,
    labels: usize,
    pub(super) mixture: Habits,
    pub(super) without_model: Habits,
    /// Mixtures without some parts.
    pub(super) reduced: Vec<Habits>,
    pub(super) forecaster: Forecaster,
    baselines: Baselines,
    objects: Others,
    /// Chains over things that differ from the previous one.
    turns: Others,
    next_rooms: Others,
    pub(super) horizons: Vec<Horizon>,
    /// The last things, the latest first, and the last distinct things.
    context: Vec<u32>,
    turned: Vec<u32>,
    /// The last places, the latest first.
    pub(super) places: Vec<u32>,
    /// The person's place by the trace, and the last thing's room.
    here: Option<usize>,
    last_room: Option<usize>,
    /// Number of times that the next thing was in each of the two.
    right: [f64; 2],
    last_s: f64,
    cases: Vec<Case>,
    pub(super) tally: Tally,
    pub(super) cleaning: Cleaning,
    /// Index of the next place of the trace to report.
    told: usize,
    pub(super) out_since_s: Option<f64>,
}

impl<'a> Watch<'a> {
    pub(super) fn new(
        trace: &'a Trace,
        (map, grounding): (&SemanticMap, &'a Grounding),
        statistics: &Statistics,
        options: &Options,
    ) -> Self {
        let (labels, rooms) = (grounding.scored_labels().len(), grounding.partitions().len());
        let begins_s = trace.steps.first().map(|step| step.at_s).or(trace.places.first().map(|(from_s, _)| *from_s));
        let mut binder = Binder::new(map, grounding, ItemChoice::default());
        Self {
            trace,
            grounding,
            rooms,
            labels,
            mixture: bound(options.habits, grounding),
            without_model: bound(options.habits, grounding),
            reduced: (options.without.iter())
                .map(|(_, without)| bound(HabitsOptions { without: *without, ..options.habits }, grounding))
                .collect(),
            forecaster: Forecaster::new(rooms, options.forecast, begins_s.unwrap_or_default()),
            baselines: Baselines::new(statistics, &mut binder, grounding),
            objects: Others::new(),
            turns: Others::new(),
            next_rooms: Others::new(),
            horizons: Horizon::all(options.habits.coverage),
            context: Vec::new(),
            turned: Vec::new(),
            places: Vec::new(),
            here: None,
            last_room: None,
            right: [0.0; 2],
            last_s: f64::NEG_INFINITY,
            cases: Vec::new(),
            tally: Tally::new(PREDICTORS.len() + options.without.len()),
            cleaning: Cleaning::new(rooms, options.seed),
            told: 0,
            out_since_s: None,
        }
    }

    /// Scores and learns the pending cases of a sentence, then forecasts the next from the model's scores.
    pub(super) fn step(&mut self, step: &Step, scores: &[f64], grounded: &mut GroundedScores) -> CommandResult {
        // The cases keep their forecasts. The caches of an activity contain its first thing.
        if step.at_s - self.last_s > ACTIVITY_S {
            let Self { objects, turns, next_rooms, .. } = self;
            [objects, turns, next_rooms].into_iter().flat_map(|all| &mut all.chains).for_each(Chain::forget_cache);
        }
        if step.label.is_some() || step.room.is_some() {
            self.resolve(step);
        }
        if step.lacking {
            self.cases.clear();
        }
        self.last_s = step.at_s;
        let turn = Turn { person: PERSON, label: step.label, room: step.room, at_s: step.at_s };
        self.mixture.observe(&turn);
        self.without_model.observe(&turn);
        self.reduced.iter_mut().for_each(|habits| habits.observe(&turn));
        self.forecaster.observe(step.at_s, step.label.map(Into::into), self.grounding, &[]);
        // The sentence has the thing's room, and the whole trace has the person's place.
        let told = self.trace.place_at(step.at_s);
        if let Some((from_s, place)) = told {
            self.tell_place(place, from_s.max(step.at_s));
        }
        if let Some(label) = step.label {
            self.context.insert(0, label as u32);
            self.context.truncate(ORDER_MAX);
            if self.turned.first() != Some(&(label as u32)) {
                self.turned.insert(0, label as u32);
                self.turned.truncate(ORDER_MAX);
            }
        }
        self.last_room = step.room.or(self.last_room);
        // For an absent person the last room is used.
        self.here = told.map(|(_, place)| place).filter(|place| *place < self.rooms).or(step.room).or(self.here);

        self.grounding.ground(scores, grounded)?;
        let rooms = grounded.partition_probability.clone();
        let labels = probabilities(scores);
        self.forecaster.expect_next(self.grounding, scores, 1.0, 0);
        // The room of the next thing in the forecast without habits.
        let expected = self.forecaster.expected().map_or(rooms, <[f64]>::to_vec);
        let forecasts = self.forecasts(step.at_s, labels, expected);
        let last = self.context.first().map(|label| *label as usize).filter(|_| !step.lacking);
        self.cases.push(Case {
            day: self.trace.day(step.at_s),
            unseen: step.unseen,
            here: self.here,
            last,
            mentioned: false,
            forecasts,
        });
        Ok(())
    }

    /// The forecasts of all predictors; `labels` and `expected` are the model's.
    fn forecasts(&mut self, at_s: f64, labels: Vec<f64>, expected: Vec<f64>) -> Vec<Forecast> {
        let mut forecasts = vec![Forecast::default(); PREDICTORS.len() + self.reduced.len()];
        let of = |objects, rooms| Forecast { objects, rooms, another: None };
        let mixed = self.mixture.mix(PERSON, at_s, &labels).to_vec();
        forecasts[MIXTURE] = of(mixed, self.mixture.next_rooms(PERSON, at_s, &expected).to_vec());
        for (forecast, habits) in forecasts[PREDICTORS.len()..].iter_mut().zip(&mut self.reduced) {
            let mixed = habits.mix(PERSON, at_s, &labels).to_vec();
            *forecast = of(mixed, habits.next_rooms(PERSON, at_s, &expected).to_vec());
        }
        let even = (vec![1.0 / self.labels as f64; self.labels], vec![1.0 / self.rooms as f64; self.rooms]);
        let learned = self.without_model.mix(PERSON, at_s, &even.0).to_vec();
        forecasts[WITHOUT_MODEL] = of(learned, self.without_model.next_rooms(PERSON, at_s, &even.1).to_vec());
        forecasts[MODEL] = of(labels, expected);
        let stay = self.baselines.stay(self.stays_in(), self.rooms);
        forecasts[STAY] = of(self.labels_in(&stay), stay);
        let fitted = staying(self.stays_in(), self.next_rooms.stayed / self.next_rooms.turned, self.rooms);
        forecasts[PERSISTENCE] = of(self.labels_in(&fitted), fitted);
        for (index, (predictor, _)) in CHAINS.into_iter().enumerate() {
            let mut of_objects = self.objects.chains[index].predict(&self.context, self.labels);
            let mut of_rooms = self.next_rooms.chains[index].predict(&self.context, self.rooms);
            let mut another = self.turns.chains[index].predict(&self.turned, self.labels);
            [&mut of_objects, &mut of_rooms, &mut another].into_iter().for_each(|p| normalise(p));
            forecasts[predictor] = Forecast { objects: of_objects, rooms: of_rooms, another: Some(another) };
        }
        forecasts
    }

    /// The room of the predictors that expect no move: the person's place by the trace or the last thing's room, whichever was right more often.
    fn stays_in(&self) -> Option<usize> {
        if self.right[1] > self.right[0] { self.last_room } else { self.here }
    }

    fn labels_in(&self, rooms: &[f64]) -> Vec<f64> {
        let weights = self.grounding.weights();
        let mut labels = vec![0.0; self.labels];
        for (room, p) in rooms.iter().enumerate() {
            let total = weights.column(room).sum::<f64>();
            if total > 0.0 {
                labels.iter_mut().enumerate().for_each(|(label, sum)| *sum += p * weights[(label, room)] / total);
            }
        }
        normalise(&mut labels);
        labels
    }

    /// Scores and learns the pending forecasts of a mention.
    fn resolve(&mut self, step: &Step) {
        for mut case in std::mem::take(&mut self.cases) {
            // The cases before the first and the last thing of a new activity are new as well.
            let day = (case.day, case.unseen || step.unseen);
            let another = step.label.filter(|label| case.last != Some(*label));
            for (predictor, Forecast { objects, rooms, another: of_others }) in case.forecasts.iter().enumerate() {
                if let Some(label) = another {
                    let all = of_others.as_ref().unwrap_or(objects);
                    let others = case.last.map(|last| without(all, last));
                    self.tally.add(predictor, OBJECT, day, others.as_ref().unwrap_or(all), label);
                }
                if case.mentioned {
                    continue;
                }
                if let Some(label) = step.label {
                    self.tally.add(predictor, OBJECT_OR_SAME, day, objects, label);
                }
                let Some(room) = step.room else { continue };
                self.tally.add(predictor, ROOM, day, rooms, room);
                if let Some(here) = case.here.filter(|here| *here != room && self.rooms > 1) {
                    self.tally.add(predictor, ROOM_IF_CHANGED, day, &without(rooms, here), room);
                }
            }
            case.mentioned = true;
            if another.is_none() {
                self.cases.push(case);
            }
        }
        if let Some(label) = step.label {
            self.objects.chains.iter_mut().for_each(|chain| chain.learn(&self.context, label));
            if self.turned.first() != Some(&(label as u32)) {
                self.turns.chains.iter_mut().for_each(|chain| chain.learn(&self.turned, label));
            }
        }
        if let Some(room) = step.room {
            self.next_rooms.chains.iter_mut().for_each(|chain| chain.learn(&self.context, room));
            if let Some(stays_in) = self.stays_in() {
                self.next_rooms.turned += 1.0;
                self.next_rooms.stayed += f64::from(u8::from(stays_in == room));
            }
            for (right, guess) in self.right.iter_mut().zip([self.here, self.last_room]) {
                *right += f64::from(u8::from(guess == Some(room)));
            }
        }
    }

    /// Reports the person's places until now.
    pub(super) fn tell(&mut self, now_s: f64) {
        while let Some((from_s, place)) =
            self.trace.places.get(self.told).copied().filter(|(from_s, _)| *from_s <= now_s)
        {
            self.told += 1;
            self.tell_place(place, from_s);
            self.out_since_s = (place == self.rooms).then_some(from_s);
            self.places.insert(0, place as u32);
            self.places.truncate(ORDER_MAX);
        }
    }

    fn tell_place(&mut self, place: usize, from_s: f64) {
        let known = if place < self.rooms { Place::Room(place) } else { Place::Elsewhere };
        // All predictors get the same reports.
        if let Place::Room(room) = known {
            self.forecaster.enter(from_s, Some(room));
        }
        self.mixture.be(PERSON, known, from_s);
        self.without_model.be(PERSON, known, from_s);
        self.reduced.iter_mut().for_each(|habits| habits.be(PERSON, known, from_s));
    }
}
