//! The person: an activity program carried out in a map, second by second.
//!
//! The person begins in the middle of a room, walks to the place of each action along straight lines through doors, and acts there for the
//! time in `src/narration/actions.toml`. An object in the hand needs no walk. Looking at, pointing at or listening to something is possible
//! from anywhere in its room. An action is skipped if the map lacks its first object. An action becomes observable when it is complete.

use std::collections::HashMap;

use super::binding::{Binder, Place, distance_m};
use super::homer::Day;
use roomcast_core::grounding::Grounding;
use roomcast_core::narration::{Action, ObjectRef, Program, Sentence, TextError};
use roomcast_core::semantic_map::{PartitionId, RoomId, SemanticMap};

/// Longest timeline, in time steps of a second: four days.
pub const STEPS_MAX: usize = 4 * 24 * 3600;

/// There is no timeline.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TimelineError {
    /// No action could be carried out.
    #[error("the timeline of `{title}` is empty: the scene `{scene}` has none of its objects ({missing})")]
    Empty {
        /// The activity.
        title: String,
        /// The map.
        scene: String,
        /// The missing objects.
        missing: String,
    },
    /// Longer than [`STEPS_MAX`].
    #[error("`{title}` takes {steps} s, more than {STEPS_MAX}: shorten it")]
    TooLong {
        /// The activity.
        title: String,
        /// Its length.
        steps: f64,
    },
    /// A map without rooms.
    #[error("the scene `{scene}` has no rooms: a person has nowhere to be")]
    NoRooms {
        /// The map.
        scene: String,
    },
    /// An object's name is not a text.
    #[error(transparent)]
    Sentence(#[from] TextError),
}

/// The person's pace.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PersonOptions {
    /// Walking speed in metres per second.
    pub speed_m_s: f64,
    /// Longest time of one action in seconds, without walking and stretching. A demonstration shows an act in seconds, as VirtualHome's
    /// animations do, however long it takes in life.
    pub action_s_max: f64,
    /// Stretches or shortens the timeline to this mean time of an action, with walking; `None` leaves it.
    pub mean_action_s: Option<f64>,
}

impl Default for PersonOptions {
    /// The paper's pace. The paper does not give T. Its naive policy shares 205.1 s with the person on average over three programs of 18,
    /// 16 and 42 actions in homes of three rooms. So T is 615 s on average, 24 s per action.
    fn default() -> Self {
        Self { speed_m_s: 1.0, action_s_max: 10.0, mean_action_s: Some(24.0) }
    }
}

/// A completed action.
#[derive(Debug, Clone, PartialEq)]
pub struct Done {
    /// The time in seconds when it was complete and so observable.
    pub at_s: f64,
    /// Its narration.
    pub sentence: Sentence,
}

/// A person's positions and completed actions.
#[derive(Debug, Clone, PartialEq)]
pub struct Timeline {
    /// The activity.
    pub title: String,
    /// The room at each time step of one second, as a partition of the grounding.
    pub rooms: Vec<PartitionId>,
    /// The position on the floor at each time step.
    pub positions_m: Vec<[f64; 2]>,
    /// Completed actions, by time.
    pub done: Vec<Done>,
    /// Actions that were skipped, as written.
    pub skipped: Vec<String>,
}

/// Actions that need their object in sight, not in reach.
const FROM_AFAR: [&str; 8] = ["lookat", "watch", "pointat", "turnto", "listen", "greet", "talk", "speak"];
/// The first object is in the hand after these actions.
const TAKES: [&str; 6] = ["grab", "pickup", "take", "hold", "carry", "bring"];
/// The first object is no longer in the hand after these actions.
const RELEASES: [&str; 10] =
    ["put", "putback", "putin", "putobjback", "drop", "release", "throw", "throwaway", "give", "puton"];
/// These actions are only the walk.
const WALKS: [&str; 7] = ["walk", "walktowards", "walkforward", "run", "enter", "leave", "crawl"];

struct Person<'a, 'b> {
    map: &'a SemanticMap,
    grounding: &'a Grounding,
    binder: &'b mut Binder<'a>,
    speed_m_s: f64,
    now_s: f64,
    at_m: [f64; 3],
    room: RoomId,
    held: HashMap<ObjectRef, ()>,
    /// (end, from, to, room) of straight walks and waits.
    legs: Vec<(f64, [f64; 3], [f64; 3], RoomId)>,
}

impl Person<'_, '_> {
    fn room_of(&self, place: &Place) -> RoomId {
        let rooms = place.partition.map(|p| &self.grounding.partitions()[p.0 as usize].rooms);
        rooms.and_then(|rooms| rooms.first().copied()).unwrap_or_else(|| nearest_room(self.map, place.position_m))
    }

    fn leg(&mut self, to_m: [f64; 3]) {
        self.now_s += distance_m(self.at_m, to_m) / self.speed_m_s;
        self.legs.push((self.now_s, self.at_m, to_m, self.room));
        self.at_m = to_m;
    }

    fn walk(&mut self, place: &Place) {
        let to = self.room_of(place);
        // Without a connecting door, the person goes in a straight line: a map need not list its doors.
        for next in self.map.path(self.room, to).unwrap_or_else(|| vec![self.room, to]).into_iter().skip(1) {
            let between = |door: &&roomcast_core::semantic_map::Door| {
                door.rooms == [self.room, next] || door.rooms == [next, self.room]
            };
            let door = self
                .map
                .doors()
                .iter()
                .filter(between)
                .min_by(|a, b| distance_m(a.position_m, self.at_m).total_cmp(&distance_m(b.position_m, self.at_m)));
            if let Some(door) = door {
                self.leg(door.position_m);
            }
            self.room = next;
        }
        self.leg(place.position_m);
    }

    fn wait(&mut self, duration_s: f64) {
        self.now_s += duration_s;
        self.legs.push((self.now_s, self.at_m, self.at_m, self.room));
    }

    /// Goes to the place of the action. `false` if the map lacks its first object.
    fn approach(&mut self, action: &Action) -> bool {
        let from_afar = FROM_AFAR.contains(&action.verb());
        for (index, object) in action.objects().iter().enumerate() {
            let Some(place) = self.binder.bind(object, self.at_m) else {
                if index == 0 {
                    return false;
                }
                continue;
            };
            if self.held.contains_key(object) || (from_afar && self.room_of(&place) == self.room) {
                continue;
            }
            self.walk(&place);
        }
        true
    }

    fn act(&mut self, action: &Action) {
        let Some(object) = action.objects().first() else { return };
        if TAKES.contains(&action.verb()) {
            self.held.insert(object.clone(), ());
        } else if RELEASES.contains(&action.verb()) {
            self.held.remove(object);
        }
    }
}

/// The room nearest to a point; the first of several.
fn nearest_room(map: &SemanticMap, position_m: [f64; 3]) -> RoomId {
    let far = |index: &usize| map.rooms()[*index].space.distance_m(&position_m);
    let nearest = (0..map.rooms().len()).min_by(|a, b| far(a).total_cmp(&far(b)));
    RoomId(nearest.and_then(|index| u32::try_from(index).ok()).unwrap_or(0))
}

/// The duration of an action, from the person's arrival.
#[derive(Debug, Clone, Copy)]
enum Lasts {
    /// Seconds.
    For(f64),
    /// Until this many seconds after the begin.
    Until(f64),
}

impl Timeline {
    /// Carries out a program. `binder` must have begun it; `start` draws the room in which the person begins.
    ///
    /// # Errors
    /// When nothing of the program can be done in the map, or it takes too long.
    pub fn of_program<'a>(
        program: &Program,
        map: &'a SemanticMap,
        grounding: &'a Grounding,
        binder: &mut Binder<'a>,
        options: &PersonOptions,
        start: u64,
    ) -> Result<Self, TimelineError> {
        let steps = program.steps.iter().map(|action| {
            let walks = WALKS.contains(&action.verb()) && !action.objects().is_empty();
            // A walk takes a moment even if the person is there already.
            let natural_s = if walks { 1.0 } else { action.entry().duration_s };
            (action, Lasts::For(natural_s.min(options.action_s_max)))
        });
        let person = person(map, grounding, binder, options, start)?;
        person.carry_out(steps, program.title.clone(), options.mean_action_s)
    }

    /// Carries out a household's day at its own times, from its first action on. An action begins when the previous one is complete, and
    /// its time includes the walk to it.
    ///
    /// # Errors
    /// As [`Timeline::of_program`].
    pub fn of_day<'a>(
        day: &Day,
        title: &str,
        map: &'a SemanticMap,
        grounding: &'a Grounding,
        binder: &mut Binder<'a>,
        options: &PersonOptions,
        start: u64,
    ) -> Result<Self, TimelineError> {
        let begin_min = day.actions.first().map_or(0.0, |action| action.done_min);
        let steps = day.actions.iter();
        let steps = steps.map(|timed| (&timed.action, Lasts::Until((timed.done_min - begin_min) * 60.0)));
        person(map, grounding, binder, options, start)?.carry_out(steps, title.to_owned(), None)
    }

    /// T: its length in time steps.
    #[must_use]
    pub fn len(&self) -> usize {
        self.rooms.len()
    }

    /// Always false: a timeline has at least one step.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rooms.is_empty()
    }

    /// The number of actions that are complete, and so observable, at `at_s`.
    #[must_use]
    pub fn done_by(&self, at_s: f64) -> usize {
        self.done.partition_point(|done| done.at_s <= at_s)
    }
}

fn person<'a, 'b>(
    map: &'a SemanticMap,
    grounding: &'a Grounding,
    binder: &'b mut Binder<'a>,
    options: &PersonOptions,
    start: u64,
) -> Result<Person<'a, 'b>, TimelineError> {
    if map.rooms().is_empty() {
        return Err(TimelineError::NoRooms { scene: map.name().to_owned() });
    }
    let room = (start % map.rooms().len() as u64) as u32;
    let at_m = map.rooms()[room as usize].space.centre_m();
    let held = HashMap::new();
    let speed_m_s = options.speed_m_s.max(0.01);
    Ok(Person { map, grounding, binder, speed_m_s, now_s: 0.0, at_m, room: RoomId(room), held, legs: Vec::new() })
}

impl Person<'_, '_> {
    /// Carries out the actions that the map allows, one after the other. With `mean_action_s`, it stretches them to that mean time, with
    /// walking.
    fn carry_out<'s>(
        mut self,
        steps: impl Iterator<Item = (&'s Action, Lasts)>,
        title: String,
        mean_action_s: Option<f64>,
    ) -> Result<Timeline, TimelineError> {
        let (mut done, mut skipped) = (Vec::new(), Vec::new());
        for (action, lasts) in steps {
            if !self.approach(action) {
                skipped.push(action.to_string());
                continue;
            }
            self.wait(match lasts {
                Lasts::For(seconds) => seconds,
                Lasts::Until(at_s) => (at_s - self.now_s).max(0.0),
            });
            self.act(action);
            done.push(Done { at_s: self.now_s, sentence: Sentence::new(&action.sentence())? });
        }
        let factor = match mean_action_s {
            Some(mean_s) if self.now_s > 0.0 => mean_s * done.len() as f64 / self.now_s,
            _ => 1.0,
        };
        self.finish(title, done, skipped, factor)
    }

    fn finish(
        self,
        title: String,
        mut done: Vec<Done>,
        skipped: Vec<String>,
        factor: f64,
    ) -> Result<Timeline, TimelineError> {
        let end_s = self.now_s * factor;
        if done.is_empty() || end_s < 1.0 {
            let missing = skipped.join(", ");
            return Err(TimelineError::Empty { title, scene: self.map.name().to_owned(), missing });
        }
        if end_s > STEPS_MAX as f64 {
            return Err(TimelineError::TooLong { title, steps: end_s });
        }
        done.iter_mut().for_each(|done| done.at_s *= factor);
        // A room is in one partition at the level of rooms, and in one at the level of groups.
        let partition = |room: RoomId| {
            let found = self.grounding.partitions().iter().position(|p| p.rooms.contains(&room));
            PartitionId(found.and_then(|index| u32::try_from(index).ok()).unwrap_or(0))
        };
        let steps = end_s.round() as usize;
        let (mut rooms, mut positions_m) = (Vec::with_capacity(steps), Vec::with_capacity(steps));
        let (mut leg, mut leg_from_s) = (0, 0.0);
        for step in 0..steps {
            // The middle of the step decides.
            let t_s = (step as f64 + 0.5) / factor;
            while leg + 1 < self.legs.len() && self.legs[leg].0 < t_s {
                leg_from_s = self.legs[leg].0;
                leg += 1;
            }
            let (until_s, from, to, room) = self.legs[leg];
            let share =
                if until_s > leg_from_s { ((t_s - leg_from_s) / (until_s - leg_from_s)).clamp(0.0, 1.0) } else { 1.0 };
            rooms.push(partition(room));
            positions_m.push([from[0] + share * (to[0] - from[0]), from[1] + share * (to[1] - from[1])]);
        }
        Ok(Timeline { title, rooms, positions_m, done, skipped })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::binding::ItemChoice;
    use roomcast_core::grounding::GroundingOptions;

    fn timeline(text: &str, options: &PersonOptions) -> Result<(Timeline, Vec<String>), TimelineError> {
        let map = SemanticMap::from_json(include_str!("../../scenes/apartment-e0.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let mut binder = Binder::new(&map, &grounding, ItemChoice::Uniform);
        binder.begin(1, "p");
        let program = Program::parse(text).unwrap();
        let timeline = Timeline::of_program(&program, &map, &grounding, &mut binder, options, 0)?;
        let mut visited: Vec<String> =
            timeline.rooms.iter().map(|p| grounding.partitions()[p.0 as usize].id.clone()).collect();
        visited.dedup();
        Ok((timeline, visited))
    }

    #[test]
    fn the_person_walks_through_doors_and_acts_observably() {
        let text =
            "T\nd\n\n[Walk] <bed> (1)\n[Sleep]\n[Walk] <fridge> (1)\n[Open] <fridge> (1)\n[Fold] <spaceship> (1)\n";
        let natural = PersonOptions { mean_action_s: None, ..PersonOptions::default() };
        let (timeline, visited) = timeline(text, &natural).unwrap();
        // From the kitchen, the start, to bed and back, both ways through the living room.
        assert_eq!(visited, ["kitchen", "living-room", "bedroom", "living-room", "kitchen"]);
        assert_eq!(timeline.done.len(), 4);
        assert_eq!(timeline.skipped, ["[fold] <spaceship> (1)"]);
        assert!(timeline.done.windows(2).all(|d| d[0].at_s < d[1].at_s));
        assert_eq!(timeline.done_by(timeline.done[1].at_s), 2);
        assert_eq!(timeline.done_by(timeline.done[1].at_s - 0.01), 1);
        let slept_s = timeline.done[1].at_s - timeline.done[0].at_s;
        assert!((slept_s - natural.action_s_max).abs() < 1e-9, "sleep is cut: {slept_s} s");
        let jumps = timeline.positions_m.windows(2).map(|p| (p[0][0] - p[1][0]).hypot(p[0][1] - p[1][1]));
        assert!(jumps.fold(0.0, f64::max) <= 1.01, "nobody walks faster than a metre per second");
    }

    #[test]
    fn the_default_pace_is_the_papers() {
        for (text, actions) in crate::PROGRAMS.map(|(_, text)| text).into_iter().zip([18, 16, 42]) {
            let (timeline, visited) = timeline(text, &PersonOptions::default()).unwrap();
            assert_eq!((timeline.done.len(), timeline.len()), (actions, 24 * actions));
            assert!(visited.len() > 4 && timeline.skipped.is_empty());
        }
    }

    #[test]
    fn what_is_held_is_carried_along() {
        let text = "T\nd\n\n[Grab] <book> (1)\n[Walk] <bed> (1)\n[Read] <book> (1)\n";
        let (timeline, _) = timeline(text, &PersonOptions::default()).unwrap();
        assert_eq!(timeline.rooms.last(), timeline.rooms.get(timeline.len() - 10));
    }

    #[test]
    fn an_activity_of_another_home_is_an_empty_timeline() {
        let error = timeline("Fly\nd\n\n[Grab] <spaceship> (1)\n", &PersonOptions::default()).unwrap_err().to_string();
        assert!(
            error.contains("`Fly` is empty") && error.contains("apartment-e0") && error.contains("spaceship"),
            "{error}"
        );
    }
}
