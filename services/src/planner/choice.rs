//! The next room: the policy's choice among the open rooms, and the reasons against the others.

use super::*;

impl Planner {
    pub(super) fn next(
        &mut self,
        outlook: &Outlook,
        here: Option<&[f64]>,
        now_ns: BootNs,
    ) -> Result<Next, PolicyError> {
        let (occupied, empty) = (self.config.interrupt_at, self.config.resume_at);
        let Some(avoided) = self.avoided(now_ns) else {
            let reason = "it is not known which rooms are in somebody's set: no room is entered until it is".to_owned();
            return Ok(Next::Pause { why: Pause::NoSets, reason });
        };
        let (taken, shared) = (self.taken(false, now_ns), self.taken(true, now_ns));
        let rules = self.verdicts(now_ns);
        if let Some((why, reason)) = self.why_none(&rules) {
            return Ok(Next::Pause { why, reason });
        }
        let is_open = |room: usize| taken.get(room) != Some(&true) && !self.round.rests(room, now_ns);
        let is_asked = |room: &usize| rules[*room].is_asked && rules[*room].reason.is_none() && is_open(*room);
        if let Some(room) = (0..rules.len()).find(is_asked) {
            return Ok(Next::Go { room, reason: "A person asked for this room.".to_owned(), flags: 0 });
        }
        let against: Vec<bool> = rules.iter().map(|verdict| verdict.reason.is_some()).collect();
        let mut closed = self.interruption.held().to_vec();
        for also in [&avoided, &taken, &against] {
            closed.resize(closed.len().max(also.len()), false);
            closed.iter_mut().zip(also).for_each(|(closed, also)| *closed |= also);
        }
        let mut left = Vec::new();
        // Time is scarce only if every remaining stay is needed.
        let scarce = self.plans()
            && !outlook.has(decision_flags::NOT_KNOWN)
            && self.round.slots_left(now_ns).is_some_and(|slots| slots <= self.round.undone());
        loop {
            let Some(Choice { partition, reason }) = self.choose(&closed, outlook, now_ns)? else {
                let reason = self.why_waiting(&rules, || self.why_nowhere(&left, avoided.contains(&true)));
                return Ok(Next::Pause { why: Pause::NoRoom, reason });
            };
            let room = partition.0 as usize;
            // Without work it waits in no room of another robot.
            if self.is_idle_in(room) && shared.get(room) == Some(&true) && closed.get(room) == Some(&false) {
                closed[room] = true;
                continue;
            }
            let likely = outlook.over_stay(room, self.stay_s()).filter(|_| scarce && !self.round.is_done(room));
            if likely.is_some_and(|likely| likely >= occupied) && self.config.forced == Forced::Skip {
                left.push(room);
                if let Some(closed) = closed.get_mut(room) {
                    *closed = true;
                }
                continue;
            }
            // A robot that made way for a person is not sent to another person.
            let interrupted =
                self.notice.flags & decision_flags::INTERRUPTED != 0 || self.phase == Phase::Pauses(Pause::Persons);
            if interrupted && here.and_then(|here| here.get(room)).is_some_and(|likely| *likely >= occupied) {
                let reason = self.why_waiting(&rules, || "somebody is likely in every other room too".to_owned());
                return Ok(Next::Pause { why: Pause::Persons, reason });
            }
            // If rules leave no other room to wait in, the robot is not sent to the person instead.
            let is_taken = rules.get(room).is_some_and(|verdict| verdict.by.is_some());
            let waits_elsewhere =
                (0..rules.len()).any(|other| self.is_idle_in(other) && closed.get(other) != Some(&true));
            if against.contains(&true) && is_taken && !waits_elsewhere && self.config.forced == Forced::Skip {
                return Ok(Next::Pause { why: Pause::Persons, reason: self.why_waiting(&rules, String::new) });
            }
            let forced = likely.filter(|likely| *likely > empty);
            let waits = if self.is_idle_in(room) { self.why_waiting(&rules, String::new) } else { String::new() };
            let why = self.why_go(&waits, outlook, &left, forced);
            let flags = if forced.is_some() { decision_flags::DEADLINE } else { 0 };
            return Ok(Next::Go { room, reason: format!("{why}{reason}"), flags });
        }
    }

    /// The text before the policy's reason.
    fn why_go(&self, waits: &str, outlook: &Outlook, left: &[usize], forced: Option<f64>) -> String {
        let known = match outlook.flags {
            decision_flags::NOT_KNOWN => "nothing is known of anybody, so every room counts alike: ",
            decision_flags::NOBODY_HOME => "nobody is home: ",
            _ if outlook.misses_resident => "somebody who lives here was not observed yet: ",
            _ => "",
        };
        let space = if waits.is_empty() { "" } else { " " };
        let forced = forced.map(|likely| {
            format!("the deadline leaves no later time for this room ({:.0} % occupied): ", 100.0 * likely)
        });
        format!("{waits}{space}{known}{}{}", self.why_left(left), forced.unwrap_or_default())
    }

    /// The policy's choice: rooms that the robot could not do come after the others. None when no room is open.
    pub(super) fn choose(
        &mut self,
        closed: &[bool],
        outlook: &Outlook,
        now_ns: BootNs,
    ) -> Result<Option<Choice>, PolicyError> {
        let close = |also: &dyn Fn(usize) -> bool| -> Vec<bool> {
            closed.iter().enumerate().map(|(room, closed)| *closed || also(room)).collect()
        };
        let later = close(&|room| self.round.has_failed(room));
        let now = close(&|room| self.round.rests(room, now_ns));
        let first = self.choose_open(&later, outlook)?;
        let works = first.as_ref().is_some_and(|choice| !self.round.is_done(choice.partition.0 as usize));
        if works || later == now { Ok(first) } else { self.choose_open(&now, outlook) }
    }

    pub(super) fn choose_open(&mut self, closed: &[bool], outlook: &Outlook) -> Result<Option<Choice>, PolicyError> {
        if !closed.is_empty() && !closed.contains(&false) {
            return Ok(None);
        }
        let (weights, rooms) = (self.weights(), outlook.likely.len().max(1));
        let share = |place: usize| self.stay_in_s(place % rooms) / self.stay_s();
        let own_s = || outlook.shared_s.iter().enumerate().map(|(place, shared_s)| shared_s * share(place)).collect();
        let own_s: Vec<f64> = if weights.is_empty() { Vec::new() } else { own_s() };
        let state = RobotState {
            covered: self.round.covered(),
            closed,
            room_time_s: self.stay_s(),
            expected_shared_s: if weights.is_empty() { &outlook.shared_s } else { &own_s },
            weights: &weights,
        };
        self.policy.choose(&state, &outlook.likely, &mut self.rng).map(Some)
    }

    /// The robot's room, if the robot has no work and gains nothing in another room.
    pub(super) fn better_stay(&self, idle: bool, chosen: usize, outlook: &Outlook, now_ns: BootNs) -> Option<usize> {
        let here = self.robot.room.filter(|here| idle && self.round.is_done(*here) && *here != chosen)?;
        let closed = |rooms: &[bool]| rooms.get(here).copied().unwrap_or(false);
        let open = !closed(self.interruption.held()) && !closed(&self.taken(true, now_ns));
        let (own, other) = (outlook.over_stay(here, self.stay_s())?, outlook.over_stay(chosen, self.stay_s())?);
        (open && own <= other + WORTH_MOVING).then_some(here)
    }

    pub(super) fn verdicts(&self, now_ns: BootNs) -> Vec<Verdict> {
        let Some(scores) = &self.scores else { return Vec::new() };
        let facts = self.facts(scores, now_ns);
        let verdict = |room: usize| {
            let now = Now { local_s: self.local_s(), stay_s: self.stay_in_s(room).max(1.0) };
            let by = facts.staying.get(room).cloned().flatten();
            Verdict {
                reason: allowed(room, now, &facts).err(),
                by: by.map(|by| Reason::Occupied { by: Some(by), room: self.name_of(room) }),
                is_asked: holds(facts.asked, room),
            }
        };
        (0..scores.rooms().len()).map(verdict).collect()
    }

    /// A planner that advises by the rules of the house, and decides nothing.
    #[must_use]
    pub fn for_advice(config: &Config) -> Self {
        let planner = Self::new(&config.planner, 1).with_home(&config.persons.residents, Zone::local());
        match setup::load_map(config.scene.path.as_deref()) {
            Ok(map) => planner.with_map(map, config.grounding.level),
            // The planner logs the fault.
            Err(_) => planner,
        }
    }

    /// For each room, by its id, the reason against cleaning it now; `None` for a good time. Empty while scores are stale.
    pub fn advise(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) -> BTreeMap<String, Option<String>> {
        self.clock = (now_ns, now_unix_ns);
        let Some(scores) = self.scores.filter(|_| self.stale(now_ns) == 0) else { return BTreeMap::new() };
        let forecast = Forecast::usable(self.forecast.as_ref(), &scores, now_ns, self.deadline_ns);
        let is_taken = |room: usize| {
            let free = |at_s: f64| forecast.map_or(1.0, |forecast| 1.0 - forecast.likely(room, at_s));
            let least = forecast.map_or(1.0, |forecast| forecast.least(self.stay_in_s(room), free));
            least < 1.0 - self.config.interrupt_at
        };
        let reason = |(room, verdict): (usize, Verdict)| {
            let later = || is_taken(room).then(|| Reason::Occupied { by: None, room: self.name_of(room) });
            (self.id_of(room).to_owned(), verdict.reason.or(verdict.by).or_else(later).map(|reason| reason.to_string()))
        };
        self.verdicts(now_ns).into_iter().enumerate().map(reason).collect()
    }

    pub(super) fn why_none(&self, rules: &[Verdict]) -> Option<(Pause, String)> {
        let is_done = |room: usize| self.plans_coverage() && self.round.is_done(room);
        let mut to_do =
            rules.iter().enumerate().filter(|(room, _)| !is_done(*room)).map(|(_, verdict)| verdict).peekable();
        let is_none = to_do.peek().is_some() && to_do.all(|verdict| verdict.reason.is_some());
        let is_shut = !rules.is_empty() && rules.iter().all(|verdict| verdict.reason.is_some());
        if !is_none && !is_shut {
            return None;
        }
        let first = rules.iter().enumerate().find(|(room, _)| is_shut || !is_done(*room))?.1.reason.as_ref()?;
        let reasons = rules.iter().enumerate().filter(|(room, _)| is_shut || !is_done(*room));
        let said: Vec<String> =
            reasons.filter_map(|(_, verdict)| verdict.reason.as_ref()).map(Reason::to_string).collect();
        Some((Pause::Rule(std::mem::discriminant(first)), said.join(" ")))
    }

    /// The reasons against the rooms to do, or the text `otherwise`.
    fn why_waiting(&self, rules: &[Verdict], otherwise: impl FnOnce() -> String) -> String {
        let to_do = rules.iter().enumerate().filter(|(room, _)| !self.round.is_done(*room));
        let said: Vec<String> = to_do
            .filter_map(|(_, verdict)| verdict.reason.as_ref().or(verdict.by.as_ref()))
            .map(Reason::to_string)
            .collect();
        if said.is_empty() { otherwise() } else { said.join(" ") }
    }

    pub(super) fn why_nowhere(&self, left: &[usize], avoided: bool) -> String {
        let held = self.interruption.held().contains(&true);
        let left = self.why_left(left);
        if avoided {
            format!("{left}somebody may be in each room that could be done now, by the room sets")
        } else if held {
            format!("{left}the rooms that are open to the robot are those that somebody is likely in")
        } else {
            format!("{left}no other room can be done now")
        }
    }

    pub(super) fn why_left(&self, left: &[usize]) -> String {
        let names: Vec<String> = left.iter().map(|room| self.name_of(*room)).collect();
        if names.is_empty() {
            return String::new();
        }
        format!("left to the next round, since somebody is likely there: {}; ", names.join(", "))
    }
}
