//! The changes before a decision: orders, rules, persons, other robots and the clock end work.

use super::*;

impl Planner {
    pub(super) fn look_at_orders(&mut self) {
        let unix_s = self.clock.1.0 / 1_000_000_000;
        if self.orders.expire(unix_s) {
            self.ordered();
        }
        self.look_at_needs();
    }

    /// A person's order has come, or has expired: the next look decides again, and says so.
    pub(super) fn ordered(&mut self) {
        self.decided = None;
        self.step(Step::Order);
    }

    /// Notes the rooms that need work now. Due rooms need it in any round, excluded and skipped rooms never.
    pub(super) fn look_at_needs(&mut self) {
        let Some(scores) = &self.scores else { return };
        let (config, orders) = (&self.config, &self.orders);
        if config.room.is_empty() && orders.skipped.is_empty() && orders.asked.is_empty() {
            return;
        }
        let unix_s = self.clock.1.0 / 1_000_000_000;
        for (room, id) in scores.rooms().iter().map(|room| room.id()).enumerate() {
            let needs = config.needs_of(id);
            if orders.asked.contains_key(id) {
                self.round.set_done(room, false);
            } else if orders.skipped.contains_key(id) || needs.is_some_and(|needs| needs.exclude) {
                self.round.set_done(room, true);
            } else if let Some(every_s) = needs.and_then(|needs| needs.every_s) {
                let last_s = orders.cleaned.get(id).copied();
                self.round.set_done(
                    room,
                    last_s.is_some_and(|last_s| last_s <= unix_s && (last_s as f64 + every_s) > unix_s as f64),
                );
            }
        }
    }

    pub(super) fn cover(&mut self, room: usize, at_ns: BootNs) {
        self.round.cover(room);
        let (now_ns, unix_ns) = self.clock;
        let unix_ns = unix_ns.0.saturating_sub(now_ns.since(at_ns));
        let id = self.id_of(room).to_owned();
        self.orders.clean(&id, unix_ns / 1_000_000_000);
    }

    /// The weight of leaving each room undone, by its priority and the time overdue.
    pub(super) fn weights(&self) -> Vec<f64> {
        let Some(scores) = self.scores.as_ref().filter(|_| !self.config.room.is_empty()) else { return Vec::new() };
        let unix_s = self.clock.1.0 as f64 / 1e9;
        let weight = |id: &str| {
            let Some(needs) = self.config.needs_of(id) else { return 1.0 };
            let last_s = self.orders.cleaned.get(id).map(|last_s| *last_s as f64);
            let overdue =
                needs.every_s.zip(last_s).map_or(0.0, |(every_s, last_s)| (unix_s - last_s - every_s) / every_s);
            (needs.priority * (1.0 + overdue.max(0.0))).min(WEIGHT_MAX)
        };
        scores.rooms().iter().map(|room| weight(room.id())).collect()
    }

    pub(super) fn local_s(&self) -> f64 {
        self.zone.local_s(self.clock.1)
    }

    pub(super) fn facts<'a>(&'a self, scores: &'a RoomScoresV1, now_ns: BootNs) -> Facts<'a> {
        let forecast = Forecast::usable(self.forecast.as_ref(), scores, now_ns, self.deadline_ns);
        let persons = People::usable(self.persons.as_deref(), scores, (now_ns, self.deadline_ns));
        let stays_s = (0..scores.rooms().len()).map(|room| self.stay_in_s(room)).collect();
        let known = Known { config: &self.config, scores, forecast, persons, near: &self.near, stays_s };
        let ids = || scores.rooms().iter().map(|room| room.id());
        let until = |hold: &rules::Hold| {
            hold.until_unix_s.map(|until_s| self.zone.local_s(UnixNs(until_s.saturating_mul(1_000_000_000))))
        };
        Facts {
            hold: self.orders.hold.as_ref().map(|hold| (hold, until(hold))),
            asked: orders::set_of(&self.orders.asked, ids()),
            skipped: orders::set_of(&self.orders.skipped, ids()),
            unobserved: self.unobserved(scores, forecast, persons, now_ns),
            missing: persons.map_or_else(Vec::new, |persons| persons.lacking(&self.residents)),
            ..known.facts()
        }
    }

    /// The wait for residents does not pass in quiet hours: they sleep then, and no sensor observes them.
    pub(super) fn wait_through_quiet_hours(&mut self, now_ns: BootNs) {
        let local_s = self.local_s();
        let is_quiet =
            self.config.quiet.iter().any(|hours| hours.rooms().is_empty() && hours.meets(local_s, 0.0).is_some());
        let know_ns = nanoseconds(self.config.know_s);
        if let Some((_, since_ns)) = &mut self.daemon
            && is_quiet
            && now_ns < since_ns.saturating_add(know_ns)
        {
            *since_ns = now_ns;
        }
    }

    /// The residents that the planner waits for, and the local time until which it waits at most.
    pub(super) fn unobserved(
        &self,
        scores: &RoomScoresV1,
        forecast: Option<Forecast<'_>>,
        persons: Option<People<'_>>,
        now_ns: BootNs,
    ) -> Option<(Vec<String>, f64)> {
        let (_, since_ns) = self.daemon?;
        let left_ns = since_ns.saturating_add(nanoseconds(self.config.know_s)).since(now_ns);
        let is_unsure = outlook::what_is_known(scores, forecast) == decision_flags::NOT_KNOWN
            || forecast.is_some_and(|forecast| forecast.misses_resident());
        let lacks_persons = self.follows_persons && persons.is_none();
        if left_ns == 0 || !(is_unsure || lacks_persons) {
            return None;
        }
        let names = persons.map_or_else(|| self.residents.clone(), |persons| persons.lacking(&self.residents));
        let names = if names.is_empty() { vec!["a resident".to_owned()] } else { names };
        Some((names, self.local_s() + left_ns as f64 / 1e9))
    }

    /// Ends work that one of the rules selected by `counts` no longer allows. A robot that a person started works on.
    pub(super) fn look_at_rules(
        &mut self,
        scores: &RoomScoresV1,
        now_ns: BootNs,
        counts: impl Fn(&Reason) -> bool,
    ) -> Option<Reason> {
        let work = self.robot.work.as_ref().filter(|work| !work.decisions.is_empty())?;
        let now = Now { local_s: self.local_s(), stay_s: 0.0 };
        let reason = allowed(work.room, now, &self.facts(scores, now_ns)).err().filter(counts)?;
        // A waiting robot makes no noise. A hold is confirmed all the same.
        if work.waits && !matches!(reason, Reason::Held { .. }) {
            return None;
        }
        let (name, cancels) = (self.name_of(work.room), self.own_decision(work));
        let why = if work.waits { String::new() } else { format!("The work in the {name} stops. {reason} ") };
        self.notice = Notice { cancels, flags: 0, why };
        self.robot.work = None;
        self.interruption.new_stay(None);
        self.ordered();
        Some(reason)
    }

    /// A hold and quiet hours end the work without fresh scores, too.
    pub(super) fn stop_by_the_clock(&mut self, stale: u32, now_ns: BootNs) -> Option<DecisionV1> {
        let scores = self.scores?;
        let is_clock = |reason: &Reason| matches!(reason, Reason::Held { .. } | Reason::Quiet { .. });
        let reason = self.look_at_rules(&scores, now_ns, is_clock)?;
        let why = Pause::Rule(std::mem::discriminant(&reason));
        let decision = self.pause(why, &reason.to_string())?;
        Some(DecisionV1 { flags: decision.flags | stale, ..decision })
    }

    /// Ends work at the end of its time. By the clock it is done; a robot with an overdue report has failed.
    pub(super) fn look_at_work(&mut self, now_ns: BootNs) {
        if self.robot.give_up_charging(now_ns) {
            self.notice.why = "The robot has said nothing for so long that it counts as charged. ".to_owned();
            self.step(Step::Charge);
        }
        let Some(work) = &self.robot.work else { return };
        if self.is_over(work, now_ns) {
            let (room, waits) = (work.room, work.waits);
            match self.robot.is_believed() {
                true => {}
                false if waits => self.round.cover(room),
                false => self.cover(room, now_ns),
            }
            self.robot.work = None;
        } else if self.robot.is_overdue(now_ns) {
            let name = self.name_of(work.room);
            let (room, cancels) = (work.room, self.own_decision(work));
            self.robot.silent = true;
            self.round.fail(room, now_ns);
            self.robot.work = None;
            let why = format!("The robot says nothing of its work in the {name}, which is given up. ");
            self.notice = Notice { cancels, flags: 0, why };
        }
    }

    pub(super) fn look_for_persons(&mut self, scores: &RoomScoresV1, now_ns: BootNs) {
        let forecast = Forecast::usable(self.forecast.as_ref(), scores, now_ns, self.deadline_ns);
        let Some(forecast) = forecast else { return self.interruption.look_away() };
        let works = self.robot.work.as_ref().filter(|work| !work.waits && self.round.stay_ns > 0);
        let room = works.map(|work| self.robot.room.filter(|_| work.started).unwrap_or(work.room));
        if forecast.knows_nobody() {
            return self.interruption.forget(room);
        }
        let likely = forecast.now();
        if !self.interruption.look(now_ns, &likely, room) {
            return;
        }
        if let (Some(work), Some(room)) = (self.robot.work.take(), room) {
            let (name, percent) = (self.name_of(room), 100.0 * likely.get(room).copied().unwrap_or_default());
            let why = format!("A person came into the {name} ({percent:.0} %), so the work there stops. ");
            let cancels = self.own_decision(&work);
            self.notice = Notice { cancels, flags: decision_flags::INTERRUPTED, why };
        }
    }

    /// Ends the work, or the wait, in a room where another robot has precedence.
    pub(super) fn look_for_robots(&mut self, scores: &RoomScoresV1, now_ns: BootNs) {
        let Some(work) = self.robot.work.as_ref() else { return };
        let room = scores.rooms().get(work.room).map(|room| room.id);
        if !room.zip(self.others.as_ref()).is_some_and(|(room, others)| others.go_before(&room, work.waits, now_ns)) {
            return;
        }
        let (name, cancels) = (self.name_of(work.room), self.own_decision(work));
        let what = if work.waits { "it waits no longer there" } else { "its work there stops" };
        self.robot.work = None;
        let why = format!("Another robot has the {name}, so {what}. ");
        self.notice = Notice { cancels, flags: 0, why };
    }

    /// Whether a person is likely in the room where the robot waits.
    pub(super) fn is_met(&self, work: &Work, scores: &RoomScoresV1, now_ns: BootNs) -> bool {
        let forecast = Forecast::usable(self.forecast.as_ref(), scores, now_ns, self.deadline_ns);
        let likely = forecast.filter(|forecast| !forecast.knows_nobody()).map(|forecast| forecast.now());
        likely.is_some_and(|likely| likely.get(work.room).is_some_and(|likely| self.interruption.is_met(*likely)))
    }

    /// Whether the robot is free and something may have changed since the last decision.
    pub(super) fn is_to_decide(&self, scores: &RoomScoresV1, now_ns: BootNs) -> bool {
        let pauses = matches!(self.phase, Phase::Pauses(_));
        let sets_came = self.phase == Phase::Pauses(Pause::NoSets) && !self.lacks_sets(now_ns);
        let news = sets_came || self.decided != Some((scores.epoch, scores.sequence));
        let again = news || now_ns >= self.decided_ns.saturating_add(LOOK_AGAIN_NS);
        match &self.robot.work {
            Some(work) => work.waits && again && (self.round.undone() > 0 || self.is_met(work, scores, now_ns)),
            // Work that a person started by hand may be interrupted.
            None if self.is_finished() => !self.notice.why.is_empty(),
            // A robot that is always free decides once per score, not as often as it looks.
            None if self.round.stay_ns == 0 => news,
            None if self.robot.charges || self.robot.rests(now_ns) => !pauses || !self.notice.why.is_empty(),
            None => !pauses || again,
        }
    }

    /// Rooms where other robots work, with `waiting_too` also wait, if the configuration avoids them.
    pub(super) fn taken(&self, waiting_too: bool, now_ns: BootNs) -> Vec<bool> {
        let known = self.scores.as_ref().zip(self.others.as_ref());
        known.map_or_else(Vec::new, |(scores, others)| others.taken(scores, waiting_too, now_ns))
    }

    pub(super) fn is_idle_in(&self, room: usize) -> bool {
        self.round.is_done(room) && self.plans_coverage()
    }
}
