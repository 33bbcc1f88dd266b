//! The decisions that a robot gets: go, pause, fall back.

use super::*;

impl Planner {
    /// The robot stays, since the scores are stale.
    pub(super) fn fall_back(&mut self, stale: u32) -> Option<DecisionV1> {
        let works = self.robot.work.as_ref().is_some_and(|work| !work.waits);
        if works || self.is_finished() || self.phase == Phase::FellBack {
            return None;
        }
        if let Some(waiting) = self.robot.work.take() {
            self.notice.cancels = self.own_decision(&waiting);
        }
        // A robot that made way for a person does not stay next to that person.
        let (action, to, does) = match self.phase {
            Phase::Pauses(_) => (action::PAUSE, None, "the robot had paused, and goes on pausing"),
            _ => (action::STAY, self.robot.room, "staying is safe"),
        };
        self.step(Step::FallBack);
        self.decided = None;
        let why = match stale {
            decision_flags::NO_SCORES => "no scores have arrived",
            decision_flags::STALE => "the scores lack narration that the scorer failed on",
            _ => "the daemon has been silent for longer than the deadline",
        };
        let decision = self.decision(to, &format!("{why}: {does}"));
        Some(DecisionV1 { action, flags: decision.flags | decision_flags::FALLBACK | stale, ..decision })
    }

    pub(super) fn pause(&mut self, why: Pause, reason: &str) -> Option<DecisionV1> {
        let ((words, said_ns), now_ns) = (&self.said, self.clock.0);
        let is_timed = matches!(why, Pause::Rule(_) | Pause::Persons);
        let is_old = is_timed && words != reason && now_ns >= said_ns.saturating_add(SAY_AGAIN_NS);
        let is_said = |before: Pause| {
            let is_other = before != why && [before, why].iter().any(|why| matches!(why, Pause::Rule(_)));
            !is_other && !is_old && self.notice.why.is_empty()
        };
        let is_said = matches!(self.phase, Phase::Pauses(before) if is_said(before));
        self.step(Step::Pause(why));
        if is_said {
            return None;
        }
        self.said = (reason.to_owned(), now_ns);
        let decision = self.decision(None, reason);
        Some(DecisionV1 { action: action::PAUSE, ..decision })
    }

    pub(super) fn go(&mut self, room: usize, stay_ns: u64, reason: &str) -> DecisionV1 {
        let decision = self.decision(Some(room), reason);
        if self.decisions.len() == DECISIONS {
            self.decisions.pop_front();
        }
        self.decisions.push_back((decision.sequence, decision.to));
        self.step(Step::Go);
        DecisionV1 { action: action::GO, stay_ns, ..decision }
    }

    /// The robot's new work, with the probability of a person in the room, if known.
    pub(super) fn send_to(&mut self, room: usize, waits: bool, likely: Option<f64>, now_ns: BootNs, sequence: u64) {
        let ends_ns = now_ns.saturating_add(self.stay_in_ns(room)).max(BootNs(1));
        let decisions = vec![(self.epoch, sequence)];
        self.robot.work = Some(Work { room, decisions, began_ns: now_ns, ends_ns, waits, started: false });
        self.robot.be(Some(room), now_ns);
        self.interruption.new_stay(likely.map(|likely| (room, likely)));
    }

    pub(super) fn decision(&mut self, to: Option<usize>, reason: &str) -> DecisionV1 {
        let (now_ns, now_unix_ns) = self.clock;
        self.sequence += 1;
        let Notice { cancels, flags, why } = std::mem::take(&mut self.notice);
        let covered = self.round.covered().iter().take(64).enumerate();
        let reported = if self.robot.is_believed() { decision_flags::REPORTED } else { 0 };
        let silent = if self.robot.silent { decision_flags::ROBOT_SILENT } else { 0 };
        let hold = self.orders.hold.as_ref();
        let held = if hold.is_some() { decision_flags::HELD } else { 0 };
        let mut decision = DecisionV1 {
            robot: self.number,
            epoch: self.epoch,
            sequence: self.sequence,
            decided_ns: now_ns.0,
            decided_unix_ns: now_unix_ns.0,
            covered: covered.fold(0, |bits, (room, covered)| bits | u64::from(*covered) << room),
            action: action::STAY,
            flags: flags | reported | silent | held,
            minor: 4,
            held_until_unix_ns: hold
                .and_then(|hold| hold.until_unix_s)
                .unwrap_or_default()
                .saturating_mul(1_000_000_000),
            cancels,
            policy: text::encode_cut(self.policy.name().as_str()),
            robot_name: self.name,
            reason: text::encode_cut(&in_sentences(&format!("{why}{reason}"))),
            ..Default::default()
        };
        if let Some(scores) = &self.scores {
            decision.scores_epoch = scores.epoch;
            decision.scores_sequence = scores.sequence;
            decision.scores_age_ns = scores.age_ns(now_ns.0);
            decision.observed_ns = scores.observed_ns;
            for (minutes, room) in decision.cleaned_min.iter_mut().zip(scores.rooms()) {
                let cleaned_s = self.orders.cleaned.get(room.id());
                // Whole minutes of the clock: the time does not move with each decision.
                let past = cleaned_s.map(|cleaned_s| {
                    (now_unix_ns.0 / 60_000_000_000).saturating_sub(*cleaned_s / 60).saturating_add(1)
                });
                *minutes = past.map_or(0, |past| u16::try_from(past).unwrap_or(u16::MAX));
            }
            let room = |index: Option<usize>| index.and_then(|index| scores.rooms().get(index));
            decision.from = room(self.robot.room).map_or([0; NAME_BYTES], |room| room.id);
            decision.to = room(to).map_or([0; NAME_BYTES], |room| room.id);
            decision.probability = room(to).map_or(0.0, |room| room.probability);
        }
        decision
    }
}
