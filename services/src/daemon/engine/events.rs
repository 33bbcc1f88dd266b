//! An event in the order of the flow: who caused it, the joint filter, and the posterior shares that choose the persons who take it.

use super::super::journal::Move;
use super::super::person_question::{By, UnderstoodLine};
use super::super::persons::LATE_NS;
use super::super::sleep::{is_bed, sleeps};
use super::attribution::{HALF, Reason, Reporter, Understood, Weighed, Who, is_keyed, is_off};
use super::belief::Seen;
use super::records::Attributed;
use super::tracking::Said;
use super::{Engine, seconds};
use roomcast_core::ids::PersonId;
use roomcast_core::narration::{Event, Observation, Presence, Quota, SensorKind};
use roomcast_core::scorer::LanguageModel;
use smallvec::SmallVec;

/// A text names one room if its things have more than this share there.
const ONLY: f64 = 0.9;

impl<M: LanguageModel> Engine<M> {
    /// Takes in an event and gives the part of each person to `enter`. Gives whether the event reads the same in any company, and otherwise its
    /// moves, so that a restart does not read it again.
    pub(super) fn attribute(
        &mut self,
        observation: Observation,
        quota: Quota,
        reporter: Reporter,
        at_ns: Option<i64>,
        mut enter: impl FnMut(&mut Self, Observation),
    ) -> (bool, Vec<Move>) {
        let mut moves = self.records.no_moves();
        let by = if is_keyed(&observation) { By::Key } else { By::Fit };
        let (id, event) = (observation.id(), observation.event.clone());
        let mut understood = Understood { id, event, persons: SmallVec::new(), by, reason: None };
        let (who, event) =
            match self.attribution.read((&self.map, self.scoring.pipeline.grounding()), &observation, reporter) {
                Ok(read) => read,
                Err(reason) => {
                    understood.reason = Some(reason);
                    self.attribution.remember(understood);
                    return (false, moves);
                }
            };
        let is_sensor = matches!(event, Event::Sensor(_));
        let is_read_alone = who == Who::Key && event == observation.event && !is_sensor;
        self.attribution.note_near_miss(&observation, &event);
        understood.event = event.clone();
        understood.by = found_by(&who);
        let observed = observation.event.clone();
        let own = Observation { event, ..observation };
        if let Event::Present(Some(room)) = &own.event {
            let effect = "the person counts as present, in no room in particular, or in any room of this name";
            self.map.note_room(room.as_str(), self.scoring.pipeline.grounding(), effect);
        }
        let weighed = self.weigh(&own, &who, reporter, at_ns);
        let is_weighed = weighed == Weighed::Yes;
        if let Event::Empty(_) = own.event {
            if self.exclude(&own, reporter, at_ns) {
                moves.push(Move::of_a_room(&own, &observed));
            } else {
                understood.reason = Some(Reason::Guarded);
            }
            self.attribution.remember(understood);
            return (false, moves);
        }
        let mut take = |engine: &mut Self, own: Observation| match engine.take(own, quota, (reporter, false), at_ns) {
            Ok(own) => {
                understood.persons.push(own.person);
                if !is_read_alone {
                    moves.push(Move::of(&own, &observed));
                }
                enter(engine, own);
            }
            Err(reason) => understood.reason = Some(reason),
        };
        if who == Who::Key && !is_sensor {
            let person = own.name.as_deref().map_or(own.person, |name| self.attribution.persons.number_of(name));
            take(self, Observation { person, ..own });
            self.attribution.remember(understood);
            return (is_read_alone, moves);
        }
        // Before a person is known, the first one takes it.
        let is_of_known = || !self.attribution.persons.followed().is_empty();
        let is_unnamed = is_sensor || matches!(who, Who::Unknown(_)) && !own.by_fit && is_of_known();
        let is_of_anybody = is_weighed && is_of_anybody(&own.event, &who);
        let parts = match (weighed, &who) {
            (Weighed::Yes, Who::Unknown(count)) if is_unnamed => self.shares(&own, *count),
            (Weighed::Yes, _) if is_sensor => self.shares(&own, 1),
            (Weighed::Refused(_), _) if is_unnamed => Vec::new(),
            _ if is_sensor => Vec::new(),
            _ => self.each(own, &who, reporter),
        };
        if is_of_anybody {
            self.drop_idle(|person| parts.iter().any(|own| own.person == person));
        }
        let is_unclear = parts.is_empty() && !is_sensor && is_weighed;
        parts.into_iter().for_each(|own| take(self, own));
        if is_unclear {
            let is_repeated = self.belief.tracking.as_ref().is_some_and(|own| own.had_repeat());
            understood.reason = match who {
                Who::House if self.attribution.persons.everybody().is_empty() => None,
                Who::House => Some(Reason::Held),
                _ if is_repeated => Some(Reason::Repeated),
                _ => Some(Reason::Unclear),
            };
        } else if let (Weighed::Refused(reason), true) = (weighed, is_unnamed) {
            understood.reason = Some(reason);
        }
        if is_sensor && is_weighed && self.belief.tracking.as_ref().is_some_and(|own| own.had_robot()) {
            moves.push(Move::of_a_robot());
        }
        let is_noted = is_sensor && !matches!(weighed, Weighed::Refused(_));
        if (is_weighed || is_noted) && moves.is_empty() {
            // A restart weighs it again.
            moves.push(Move::of_nobody());
        }
        self.attribution.remember(understood);
        (is_read_alone, moves)
    }

    /// The part of each person in an event that has one person at most.
    fn each(&mut self, own: Observation, who: &Who, reporter: Reporter) -> Vec<Observation> {
        match who {
            Who::Key => Vec::new(),
            Who::Named(person, name) => vec![Observation { person: *person, name: Some(name.clone()), ..own }],
            Who::House => {
                let away = Observation { event: Event::Away, ..own };
                // Not those whom sensors hold.
                let tracking = self.belief.tracking.as_deref();
                let is_in =
                    |person| tracking.is_some_and(|own| own.follows(person) && own.probability(person, None) < 0.5);
                let persons = self.attribution.persons.everybody().into_iter().filter(|person| !is_in(*person));
                persons.map(|person| Observation { person, ..away.clone() }).collect()
            }
            Who::Unknown(_) if own.by_fit => vec![own],
            Who::Unknown(count) => {
                let persons = self.attribution.persons.unnamed(reporter.is_unknown).take((*count).into());
                let part = |person| Observation { person, by_fit: true, ..own.clone() };
                let parts: Vec<Observation> = persons.map(part).collect();
                self.note_attributed(&parts);
                parts
            }
        }
    }

    fn note_attributed(&mut self, parts: &[Observation]) {
        if let [only] = parts {
            self.records.attributed.push(Attributed { event: only.id(), person: only.person });
        }
    }

    /// How the events of a narrator's start were understood, from a sequence on.
    #[must_use]
    pub fn understood_lines(&mut self, source: u64, epoch: u64, from: u64) -> Vec<UnderstoodLine> {
        self.attribution.lines((&mut self.map, self.scoring.pipeline.grounding()), (source, epoch, from))
    }

    /// Why the filter does not take an event: its person is guarded, or a newer event counts.
    fn refusal(
        &mut self,
        own: &Observation,
        who_is: Option<PersonId>,
        reporter: Reporter,
        at_ns: i64,
    ) -> Option<Reason> {
        let persons = &self.attribution.persons;
        let is_guarded =
            || persons.is_guarded(who_is, at_ns) || who_is.is_some_and(|person| !persons.is_trusted(person));
        if reporter.is_unknown && is_guarded() {
            return Some(Reason::Guarded);
        }
        match (&own.event, who_is) {
            // A device's own reports have their order.
            (Event::Sensor(report), _) => {
                let grounding = self.scoring.pipeline.grounding();
                let mut rooms = [&report.room, &report.beyond].into_iter().flatten();
                if let Some(unknown) = rooms.find(|room| self.map.room(room.as_str(), grounding).is_none()) {
                    self.map.note_room(unknown.as_str(), grounding, "its sensors are ignored");
                    self.belief.sensors.lose((own.source, report), at_ns);
                    return Some(Reason::UnknownRoom);
                }
                let left = match self.belief.sensors.note((own.source, report), who_is, at_ns) {
                    Ok(left) => left?,
                    Err(reason) => return Some(reason),
                };
                if let Some(tracking) = &mut self.belief.tracking {
                    tracking.vacate(&left);
                }
                None
            }
            (_, Some(person)) => {
                let part = Observation { person, event: own.event.clone(), name: None, ..*own };
                self.attribution.persons.is_outdated(&part, at_ns).then_some(Reason::Outdated)
            }
            // What an unknown person did long ago says nothing about the present.
            (_, None) => {
                let is_late = self.belief.tracking.as_ref().is_some_and(|own| own.is_older(at_ns, LATE_NS));
                is_late.then_some(Reason::Outdated)
            }
        }
    }

    /// Weighs an event in the joint filter, which starts if the event needs it.
    fn weigh(&mut self, own: &Observation, who: &Who, reporter: Reporter, at_ns: Option<i64>) -> Weighed {
        let Some(at_ns) = at_ns else { return Weighed::NotNeeded };
        let who_is = match who {
            Who::Key => Some(own.name.as_deref().map_or(own.person, |name| self.attribution.persons.number_of(name))),
            Who::Named(person, _) => Some(*person),
            Who::Unknown(_) | Who::House => None,
        };
        if let Some(reason) = self.refusal(own, who_is, reporter, at_ns) {
            return Weighed::Refused(reason);
        }
        if let Some(person) = who_is {
            // The visit ends before the filter takes the event.
            self.end_visit(person, at_ns);
        }
        // The filter knows no rooms of a changed map before its first scores.
        if self.map.next_rooms.is_some() {
            return Weighed::NotNeeded;
        }
        let count = if let Who::Unknown(count) = who { *count } else { 0 };
        let fresh = if let Event::Sensor(report) = &own.event { Some((own.source, &**report)) } else { None };
        let is_shared = count > 1 || count == 1 && self.attribution.persons.are_several(reporter.is_unknown);
        if self.belief.tracking.is_none() && (is_shared || !self.belief.sensors.is_empty()) {
            self.start_tracking(fresh, at_ns);
        }
        if self.belief.tracking.is_none() {
            return Weighed::NotNeeded;
        }
        let reading = if reporter.is_unknown { None } else { self.reading(&own.event) };
        let mention = own.event.sentence().and_then(|text| self.map.matcher.last(text.as_str()));
        let grounding = self.scoring.pipeline.grounding();
        // In a home of one person, an action is that person's.
        let only = || {
            let persons = &self.attribution.persons;
            let is_action =
                count == 1 && matches!(own.event, Event::Did(_)) && !persons.are_several(reporter.is_unknown);
            let person = persons.followed().first().copied().filter(|_| is_action)?;
            let tracking = self.belief.tracking.as_deref()?;
            (tracking.probability(person, None) < 0.5).then_some(person)
        };
        let who_is = who_is.or_else(only);
        let row = mention.map(|found| {
            let fits = |room| {
                let share = found.share(grounding, room);
                if found.is_left { 1.0 - share } else { share }
            };
            (0..grounding.partitions().len()).map(fits).collect::<Vec<f64>>()
        });
        let room = match &own.event {
            Event::Did(_) => {
                let row = row.as_deref().unwrap_or_default();
                let all: f64 = row.iter().sum();
                row.iter().position(|share| *share > ONLY * all)
            }
            event => event.room().and_then(|room| self.map.room(room, grounding)),
        };
        let text = own.event.sentence().map_or("", |text| text.as_str());
        let is_on_bed =
            mention.is_some_and(|found| !found.is_left && is_bed(&grounding.scored_labels()[found.label].text));
        let is_lying = sleeps(text).unwrap_or(is_on_bed);
        let rooms = row.as_deref().or(reading.as_deref()).unwrap_or_default();
        // Without a list of residents, nothing limits the number of persons.
        let persons = &self.attribution.persons;
        let is_more = count > 1 && !persons.has_residents();
        let more = is_more.then(|| persons.unnamed(reporter.is_unknown).take(count.into()));
        let counted: Vec<PersonId> = more.into_iter().flatten().collect();
        let said = Said {
            event: &own.event,
            source: own.source,
            who: who_is,
            count,
            counted: &counted,
            rooms,
            is_named: row.is_some(),
            room,
            is_lying,
            is_unknown: reporter.is_unknown,
            robot: self.belief.restored_robot,
        };
        let home = (&self.map.map, grounding);
        let Some(tracking) = &mut self.belief.tracking else { return Weighed::NotNeeded };
        let mut is_taken = tracking.weigh(home, said, (at_ns, self.belief.local_ahead_s));
        if tracking.is_stale() {
            // A device or its person changed: the filter starts again.
            self.start_tracking(fresh, at_ns);
            let home = (&self.map.map, self.scoring.pipeline.grounding());
            let Some(tracking) = &mut self.belief.tracking else { return Weighed::NotNeeded };
            is_taken = tracking.weigh(home, said, (at_ns, self.belief.local_ahead_s));
        }
        if is_taken {
            self.note_bed(&own.event, who_is);
        }
        match own.event {
            _ if is_taken => Weighed::Yes,
            Event::Sensor(_) => Weighed::Refused(Reason::NoSensor),
            _ => Weighed::NotNeeded,
        }
    }

    /// A bed's sensor says that its person lies or is up.
    fn note_bed(&mut self, event: &Event, who_is: Option<PersonId>) {
        let Event::Sensor(report) = event else { return };
        let (SensorKind::Bed, Some(on), Some(tracking)) = (report.kind, report.on, &self.belief.tracking) else {
            return;
        };
        let lies = |person: &PersonId| who_is.map_or_else(|| tracking.share(*person) > HALF, |own| own == *person);
        for person in tracking.persons().iter().filter(|person| lies(person)) {
            if let Some(known) = self.attribution.persons.get_mut(*person) {
                known.on_bed = on;
            }
        }
    }

    /// Weighs an event of a former run, which has stored its persons, and whether a robot explained it.
    pub(super) fn weigh_again(
        &mut self,
        observation: &Observation,
        reporter: Reporter,
        at_ns: Option<i64>,
        moves: &[Move],
    ) {
        if let Ok((who, event)) =
            self.attribution.read((&self.map, self.scoring.pipeline.grounding()), observation, reporter)
        {
            let own = Observation { event, name: observation.name.clone(), ..*observation };
            self.belief.restored_robot = Some(moves.iter().any(Move::is_of_a_robot));
            let weighed = self.weigh(&own, &who, reporter, at_ns);
            self.belief.restored_robot = None;
            if weighed == Weighed::Yes && is_of_anybody(&own.event, &who) {
                self.drop_idle(|person| moves.iter().any(|own| own.person == person));
            }
        }
    }

    /// Removes persons that are gone, or that a number in an event added, from the filter if they have no part in an event that may be of any
    /// person. A restart does the same.
    fn drop_idle(&mut self, has_part: impl Fn(PersonId) -> bool) {
        let Some(tracking) = &mut self.belief.tracking else { return };
        let persons = &self.attribution.persons;
        let followed = persons.followed();
        let is_gone = |person| persons.get(person).is_none_or(|known| known.presence == Presence::Gone);
        let is_idle = |person: &PersonId| {
            is_gone(*person) && !followed.contains(person) && !has_part(*person) && !tracking.is_nobody(*person)
        };
        let idle: Vec<PersonId> = tracking.persons().iter().copied().filter(is_idle).collect();
        idle.into_iter().for_each(|person| tracking.remove(person));
    }

    /// The parts of an event without a name, after the filter weighed it: a person takes it with a posterior above [`HALF`]. If the filter believes
    /// that a person is out, or back, the presence changes.
    fn shares(&mut self, own: &Observation, count: u8) -> Vec<Observation> {
        /// A person is out above the first, and in below the second, whatever the event says.
        const OUT: (f64, f64) = (0.9, 0.1);
        /// The device belongs to the person.
        const SURE: f64 = 0.999;
        let Some(tracking) = &self.belief.tracking else { return Vec::new() };
        let grounding = self.scoring.pipeline.grounding();
        let room = match &own.event {
            Event::Sensor(report) if report.kind == SensorKind::Door || report.on != Some(true) => None,
            Event::Sensor(report) => report.room.as_ref(),
            Event::Present(room) => room.as_ref(),
            _ => None,
        };
        let place = room.and_then(|room| self.map.room(room.as_str(), grounding));
        let counted = tracking.room().filter(|_| count > 1);
        let is_counted = |person: PersonId| counted.is_some() && tracking.probability(person, counted) > 0.5;
        let part = |person: &PersonId| {
            let person = *person;
            let out = tracking.probability(person, None);
            let presence = self.attribution.persons.get(person).map_or(Presence::Unknown, |known| known.presence);
            let has_moved = match own.event {
                Event::Away => presence == Presence::Present && out > 0.5,
                Event::Present(None) => presence != Presence::Present && out < 0.5,
                _ => false,
            };
            let is_theirs = tracking.share(person) > HALF || is_counted(person) || count > 1 && has_moved;
            let is_here = place.is_some_and(|room| tracking.probability(person, Some(room)) > 0.5);
            let event = match &own.event {
                Event::Away | Event::Gone if is_theirs && out > 0.5 => own.event.clone(),
                Event::Sensor(report) if is_theirs && report.on == Some(false) && out > 0.5 => Event::Away,
                Event::Sensor(_) if out > OUT.0 && presence == Presence::Present => Event::Away,
                Event::Did(_) | Event::Present(_) if is_theirs && out < 0.5 => own.event.clone(),
                Event::Sensor(_) if is_theirs && is_here => Event::Present(room.cloned()),
                Event::Sensor(report) if presence != Presence::Present && report.on == Some(true) => {
                    // A phone knows its person.
                    let is_bound = tracking.share(person) > SURE;
                    if is_bound && out < 0.5 || is_theirs && out < OUT.1 { Event::Present(None) } else { return None }
                }
                _ => return None,
            };
            Some(Observation { person, name: None, by_fit: true, event, ..*own })
        };
        let followed = self.attribution.persons.followed();
        let persons = tracking.persons().iter().filter(|person| followed.contains(person) || count > 1);
        let parts: Vec<Observation> = persons.filter_map(part).collect();
        if let [only] = &parts[..]
            && only.event == own.event
        {
            self.note_attributed(&parts);
        }
        parts
    }

    /// Takes in again the part of one person that a former run read in an event, in any company. An empty room gives nothing.
    pub(super) fn retake(&mut self, own: Observation, reporter: Reporter, at_ns: Option<i64>) -> Option<Observation> {
        if own.person == PersonId::SOMEBODY {
            self.exclude(&own, reporter, at_ns);
            return None;
        }
        self.take(own, Quota::EARLIER, (reporter, true), at_ns).ok()
    }

    /// After such a silence a visitor was gone, although no step noticed it.
    fn end_visit(&mut self, person: PersonId, at_ns: i64) {
        if self.attribution.persons.has_expired(person, at_ns) {
            self.watch();
            self.attribution.persons.remove(person);
            self.drop_person(person);
        }
    }

    /// Takes in the part of one person, unless a later event says otherwise or the person is guarded. A part that a former run took in counts
    /// in any case.
    pub(super) fn take(
        &mut self,
        observation: Observation,
        quota: Quota,
        (reporter, was_taken): (Reporter, bool),
        at_ns: Option<i64>,
    ) -> Result<Observation, Reason> {
        if !was_taken
            && reporter.is_unknown
            && self.attribution.persons.is_guarded(Some(observation.person), at_ns.unwrap_or_default())
        {
            return Err(Reason::Guarded);
        }
        let at_ns = at_ns.map(|at_ns| self.attribution.persons.in_order(&observation, at_ns));
        let noted_ns = at_ns.unwrap_or_default();
        self.end_visit(observation.person, noted_ns);
        if !was_taken && at_ns.is_some_and(|at_ns| self.attribution.persons.is_outdated(&observation, at_ns)) {
            return Err(Reason::Outdated);
        }
        let did_ns = self.attribution.persons.get(observation.person).map_or(i64::MIN, |known| known.did_ns);
        let silent_s = seconds(noted_ns.saturating_sub(did_ns));
        let quota = (quota, !reporter.is_unknown);
        if let Some(dropped) = self.attribution.persons.note(&observation, quota, noted_ns) {
            self.drop_person(dropped);
        }
        self.scoring.rescore(observation.person);
        if let Some(tracking) = &mut self.belief.tracking {
            tracking.admit(observation.person);
        }
        let Some(at_ns) = at_ns else { return Ok(observation) };
        self.belief.see(Seen {
            name: observation.id(),
            person: observation.person,
            at_ns,
            event: observation.event.clone(),
            is_off: observation.by_fit && is_off(&observation.event),
            ends_window: self.scoring.pipeline.inside().options().history.is_gap(silent_s),
            is_read: !reporter.is_unknown && matches!(observation.event, Event::Did(_)),
            rooms: None,
        });
        Ok(observation)
    }

    /// Takes the event that a room is empty into the forecasts. Gives whether the daemon believes it.
    pub(super) fn exclude(&mut self, observation: &Observation, reporter: Reporter, at_ns: Option<i64>) -> bool {
        let Event::Empty(empty) = &observation.event else { return false };
        if reporter.is_unknown && self.attribution.persons.is_guarded(None, at_ns.unwrap_or_default()) {
            return false;
        }
        self.map.note_room(empty.as_str(), self.scoring.pipeline.grounding(), "nobody leaves it");
        // The belief has no rooms of a changed map yet.
        let (Some(at_ns), None) = (at_ns, &self.map.next_rooms) else { return true };
        // Earlier events come first.
        self.follow();
        if let Some(room) = self.map.room(empty.as_str(), self.scoring.pipeline.grounding()) {
            let name = observation.id();
            for (person, own) in &mut self.belief.followed {
                own.exclude(seconds(at_ns), room);
                self.home.next_is(name, *person, self.attribution.is_learned_of(*person));
                self.home.is_empty(*person, at_ns, room, own);
            }
        }
        true
    }
}

/// Whether an event that the filter weighs may be of any person.
fn is_of_anybody(event: &Event, who: &Who) -> bool {
    matches!(event, Event::Sensor(_)) || matches!(who, Who::Unknown(_))
}

/// How the person of an event was found.
fn found_by(who: &Who) -> By {
    match who {
        Who::Key => By::Key,
        Who::Named(..) => By::Name,
        Who::Unknown(_) => By::Fit,
        Who::House => By::House,
    }
}
