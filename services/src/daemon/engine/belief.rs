//! Where each person is now: the forecasters by person, and the joint filter if it runs.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use roomcast_ipc::raw::MAX_ROOMS;

use super::attribution::Attribution;
use super::map_in_use::{MapInUse, rooms_alike};
use super::robots::Robots;
use super::tracking::{Sensors, Tracking};
use super::ways_out::ways_out;
use super::{HomeHabits, seconds};
use crate::daemon::persons::Persons;
use crate::daemon::sleep::{clauses, is_bed, may_be_done_lying, sleeps};
use roomcast_core::forecast::{ForecastOptions, Forecaster};
use roomcast_core::grounding::Grounding;
use roomcast_core::habits::Place as Whereabouts;
use roomcast_core::ids::{BootNs, EventId, PersonId};
use roomcast_core::narration::{Event, Presence, SensorReport};
use roomcast_core::pipeline::Pipeline;
use roomcast_core::places::Mention;
use roomcast_core::scorer::LanguageModel;

/// Most events with kept memory. Only a stall brings more at once.
const SEEN_KEPT: usize = 256;

/// A thing with a smaller share in the person's room is in another room.
const SAME_ROOM: f64 = 0.05;

/// An event of a person that the forecasts do not have yet.
#[derive(Debug)]
pub(super) struct Seen {
    pub(super) name: EventId,
    pub(super) person: PersonId,
    pub(super) at_ns: i64,
    pub(super) event: Event,
    /// A device turned off, and no key says that the person did it.
    pub(super) is_off: bool,
    /// The person's window of narration has ended before it, although no step may have noticed the silence.
    pub(super) ends_window: bool,
    /// The model's rooms count if the text names no place.
    pub(super) is_read: bool,
    /// These rooms: a likelihood for each.
    pub(super) rooms: Option<Arc<[f64]>>,
}

#[derive(Debug, Default)]
pub(super) struct Belief {
    /// The assumptions of a forecast about an unobserved person.
    pub(super) options: ForecastOptions,
    /// The forecasts by person. A person without a history is removed.
    pub(super) followed: BTreeMap<PersonId, Forecaster>,
    /// The same with the belief of the joint filter, while that runs.
    pub(super) told: BTreeMap<PersonId, Forecaster>,
    /// The joint filter. `None` before the first event that needs it.
    pub(super) tracking: Option<Box<Tracking>>,
    pub(super) sensors: Sensors,
    pub(super) robots: Robots,
    /// While an event of a former run is weighed: whether a robot was in the sensor's room.
    pub(super) restored_robot: Option<bool>,
    /// Local time minus the monotonic clock, in seconds.
    pub(super) local_ahead_s: f64,
    pub(super) seen: VecDeque<Seen>,
}

impl Belief {
    /// The part of a person in an event changes the forecasts with the next [`Belief::follow`].
    pub(super) fn see(&mut self, seen: Seen) {
        self.seen.push_back(seen);
    }

    /// The forecasts by person, with the joint filter's belief if it runs.
    pub(super) fn forecasters(&self) -> &BTreeMap<PersonId, Forecaster> {
        if self.tracking.is_some() { &self.told } else { &self.followed }
    }

    /// Updates forecasts and habits with the events since the last call.
    pub(super) fn follow<M: LanguageModel>(
        &mut self,
        (map, pipeline): (&mut MapInUse, &Pipeline<M>),
        attribution: &mut Attribution,
        home: &mut HomeHabits,
    ) {
        let grounding = pipeline.grounding();
        for seen in self.seen.drain(..) {
            let at_s = seconds(seen.at_ns);
            home.next_is(seen.name, seen.person, attribution.is_learned_of(seen.person));
            if seen.event == Event::Gone {
                self.followed.remove(&seen.person);
                home.is_in(seen.person, seen.at_ns, Some(Whereabouts::Elsewhere));
                continue;
            }
            let own = self.followed.entry(seen.person).or_insert_with(|| follower(grounding, self.options, seen.at_ns));
            if seen.ends_window {
                own.end_window();
            }
            match &seen.event {
                Event::Did(_) if seen.is_off => {}
                Event::Did(text) => {
                    let mention = map.matcher.last(text.as_str());
                    // The place before this action.
                    let was_on_bed = attribution.persons.get(seen.person).is_some_and(|known| known.on_bed);
                    let (mut near, mut rooms) = ([0.0; MAX_ROOMS], 0);
                    if was_on_bed {
                        rooms = fill(&mut near, own.at(at_s, 0.0));
                    }
                    // The model's scores after all events are for the time after them.
                    match &seen.rooms {
                        Some(rooms) => own.suppose(at_s, rooms),
                        None => own.observe(at_s, mention, grounding, &[]),
                    }
                    home.turned(seen.person, seen.at_ns, turned_to(mention), own);
                    let Some(known) = attribution.persons.get_mut(seen.person) else { continue };
                    for clause in clauses(text.as_str()) {
                        let is_all = clause.len() == text.as_str().len();
                        let found = if is_all { mention } else { map.matcher.last(clause) };
                        let row = |found: &Mention| grounding.weights().row(found.label);
                        let stays = |found: &Mention| {
                            let likeliest = (0..rooms).max_by(|a, b| near[*a].total_cmp(&near[*b]));
                            let is_here = likeliest.is_some_and(|room| row(found)[room] > SAME_ROOM);
                            known.on_bed && is_here && may_be_done_lying(clause)
                        };
                        let is_bed = |found: &Mention| is_bed(&grounding.scored_labels()[found.label].text);
                        let on_bed = found.map(|found| is_bed(&found) || stays(&found));
                        known.on_bed = sleeps(clause).or(on_bed).unwrap_or(known.on_bed && may_be_done_lying(clause));
                        if let Some(found) = found.filter(is_bed) {
                            rooms = fill(&mut near, row(&found).iter().copied());
                        }
                    }
                }
                Event::Present(named) => {
                    let name = named.as_ref().map_or("", |name| name.as_str());
                    let room = map.room(name, grounding);
                    let alike = |other| room.is_none() && rooms_alike(name, grounding).any(|one| one == other);
                    let was_here = room.is_none_or(|room| own.at(at_s, 0.0).nth(room).is_some_and(|p| p > 0.5));
                    if !was_here
                        && !self.sensors.has_on_bed(seen.person, named.as_ref())
                        && let Some(known) = attribution.persons.get_mut(seen.person)
                    {
                        // Persons who walk into another room are up.
                        known.on_bed = false;
                    }
                    // An event that is older than the belief changes neither belief nor habits.
                    if own.enter_any(at_s, |other| Some(other) == room || alike(other)) {
                        home.is_in(seen.person, seen.at_ns, room.map(Whereabouts::Room));
                    }
                }
                _ => {
                    own.leave(at_s);
                    home.is_in(seen.person, seen.at_ns, Some(Whereabouts::Elsewhere));
                }
            }
        }
        let histories = pipeline.inside().histories();
        self.followed.retain(|person, _| histories.get(*person).is_some());
    }

    /// Keeps the newest events that the forecasts do not have yet.
    pub(super) fn drop_unwatched(&mut self) {
        let excess = self.seen.len().saturating_sub(SEEN_KEPT);
        self.seen.drain(..excess);
    }

    /// Updates each person's forecast with their newest scores. Scores without the newest event do not predict the time after it.
    pub(super) fn expect<M: LanguageModel>(&mut self, pipeline: &Pipeline<M>) {
        for own in pipeline.persons().filter(|own| own.at_home && own.is_current) {
            if let Some(followed) = self.followed.get_mut(&own.person) {
                followed.expect_grounded(pipeline.grounding(), own.grounded, own.trust, own.number);
            }
        }
        self.seen.shrink_to(SEEN_KEPT);
    }

    /// Advances the joint filter, and gives each forecaster its belief. Before the first observed person, the persons of the filter have
    /// forecasters without a history.
    pub(super) fn track(&mut self, grounding: &Grounding, now_ns: BootNs) {
        let Some(tracking) = &mut self.tracking else { return };
        let at_ns = i64::try_from(now_ns.0).unwrap_or(i64::MAX);
        tracking.look(at_ns, self.local_ahead_s);
        self.told.retain(|person, _| self.followed.contains_key(person));
        if self.followed.is_empty() && tracking.is_sensed() {
            let new = follower(grounding, self.options, at_ns);
            for person in tracking.persons() {
                tracking.tell(*person, &new, self.told.entry(*person).or_insert_with(|| new.clone()));
            }
        }
        for (person, own) in &self.followed {
            let told = self.told.entry(*person).or_insert_with(|| own.clone());
            tracking.tell(*person, own, told);
        }
    }

    /// Starts the joint filter with the belief of the forecasters.
    pub(super) fn start_tracking(
        &mut self,
        (map, grounding): (&MapInUse, &Grounding),
        persons: &Persons,
        fresh: Option<(u64, &SensorReport)>,
        at_ns: i64,
    ) {
        let followed = persons.followed();
        if followed.is_empty() && self.sensors.is_empty() {
            return;
        }
        let is_lying = |person| persons.get(person).is_some_and(|known| known.on_bed);
        let of = (at_ns, self.local_ahead_s);
        let believed = (&self.followed, is_lying);
        let home = (&map.map, grounding);
        self.tracking = Tracking::new(home, followed.into_iter(), believed, (&self.sensors, fresh), of).map(Box::new);
        self.tell_robots(BootNs(at_ns.try_into().unwrap_or_default()));
    }

    /// The next person whose presence contradicts the filter, with the event that ends it.
    pub(super) fn crossed(&self, persons: &Persons) -> Option<(PersonId, Event)> {
        const OUT: f64 = 0.95;
        let tracking = self.tracking.as_deref()?;
        tracking.persons().iter().find_map(|person| {
            match (persons.get(*person)?.presence, tracking.out_now(*person)?) {
                (Presence::Present, out) if out > OUT => Some((*person, Event::Away)),
                (Presence::Away, out) if out < 1.0 - OUT => Some((*person, Event::Present(None))),
                _ => None,
            }
        })
    }

    pub(super) fn tell_robots(&mut self, now_ns: BootNs) {
        self.robots.told_ns = now_ns;
        if let Some(tracking) = &mut self.tracking {
            tracking.robots(&self.robots, i64::try_from(now_ns.0).unwrap_or(i64::MAX));
        }
    }

    pub(super) fn drop_person(&mut self, person: PersonId) {
        self.followed.remove(&person);
        self.told.remove(&person);
        if let Some(tracking) = &mut self.tracking {
            tracking.remove(person);
        }
    }
}

/// Fills the start of a row. Returns the number of values.
fn fill(row: &mut [f64], values: impl Iterator<Item = f64>) -> usize {
    row.iter_mut().zip(values).map(|(place, value)| *place = value).count()
}

/// The label, unless the person left it.
fn turned_to(mention: Option<Mention>) -> Option<usize> {
    mention.filter(|found| !found.is_left).map(|found| found.label)
}

fn follower(grounding: &Grounding, options: ForecastOptions, at_ns: i64) -> Forecaster {
    let mut own = Forecaster::new(grounding.partitions().len(), options, seconds(at_ns));
    own.come_in_by(&ways_out(grounding));
    own
}
