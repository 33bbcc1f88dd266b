//! The planner: keeps the robot's state, applies a policy when the robot is free, and publishes decisions with their reason.
//!
//! Stale scores, unconfirmed for longer than the deadline, are not used. The fallback is to **stay where the robot is**, or to keep
//! pausing: no other choice is sure to avoid all persons. Such a decision is flagged and published once, and the next one follows as soon
//! as scores are fresh again.
//!
//! Work goes in rounds. A round has a deadline, so that the remaining stays decrease and no plan can postpone a room for ever. A room that
//! is undone at the deadline is part of the next round. If the configuration gives the length of rounds, a completed round continues to its
//! deadline, and the robot stays away from persons. Otherwise the next round begins at once.
//!
//! A robot that reports ends its stays itself: a room is done when the robot says so, and is tried again after the others if it failed. The
//! clock ends the stays of a silent robot. The robot's work ends when a person enters its room.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, NAME_BYTES, PersonForecastsV1, REASON_TEXT_BYTES, RoomScoresV1, RoomV1, action,
    decision_flags, score_flags,
};
use roomcast_ipc::{sequence, text};

use crate::config::{Config, Forced, PlannerConfig, is_room};
use crate::daemon::Zone;
use crate::setup;
use crate::slug::room_name;
use roomcast_core::grounding::PartitionLevel;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_core::policy::{Choice, Policy, PolicyError, PolicyName, RobotState};
use roomcast_core::semantic_map::SemanticMap;

mod choice;
mod facts;
mod interruption;
mod look;
mod order;
mod orders;
mod others;
mod outlook;
mod phase;
mod places;
mod reports;
mod robot;
mod round;
pub mod rules;
mod run;
mod state;

pub use orders::Orders;
pub use reports::ReportFault;
pub use run::run;
pub use state::KeptRound;

use facts::{Known, Near, People};
use interruption::Interruption;
use others::Others;
use outlook::{Forecast, Outlook};
use phase::{Pause, Phase, Step};
use places::Places;
use robot::{Robot, Work};
use round::{Round, nanoseconds};
use rules::{Facts, Now, Reason, allowed, holds};

/// The longest interval between renewals of connections. A participant of this crate wakes the planner when it joins. The interval is
/// longer than the daemon's usual heartbeat, so that an idle planner wakes for scores, and not once more just before them.
const TICK: Duration = Duration::from_millis(300);
/// The longest interval of decisions for a robot that waits or pauses: forecasts change with time, even without new scores.
const LOOK_AGAIN_NS: u64 = 5_000_000_000;
/// The least gain for another waiting room, as a share of a stay with a person.
const WORTH_MOVING: f64 = 0.005;
/// A message with a time further ahead is not of this boot's clock.
const AHEAD_NS: u64 = 1_000_000_000;
/// The shortest interval of new reasons for a robot that pauses.
const SAY_AGAIN_NS: u64 = 300_000_000_000;
/// Limit on the weight of an overdue room.
const WEIGHT_MAX: f64 = 100.0;
/// The number of past decisions that late reports can answer.
const DECISIONS: usize = 32;

/// The planner's state. Pure: time is an argument.
#[derive(Debug)]
pub struct Planner {
    config: PlannerConfig,
    policy: Box<dyn Policy>,
    rng: ChaCha8Rng,
    number: u64,
    name: [u8; NAME_BYTES],
    epoch: u64,
    sequence: u64,
    deadline_ns: u64,
    zone: Zone,
    /// The residents' names, if the planner waits for each.
    residents: Vec<String>,
    /// The planner expects persons' forecasts, and waits for the first.
    follows_persons: bool,
    scores: Option<RoomScoresV1>,
    forecast: Option<ForecastV1>,
    persons: Option<Box<PersonForecastsV1>>,
    /// The daemon's epoch, and the time of its first scores.
    daemon: Option<(u64, BootNs)>,
    /// The other robots, if their rooms are avoided.
    others: Option<Others>,
    places: Option<Places>,
    /// By room of the scores; empty without their map.
    near: Vec<Near>,
    round: Round,
    robot: Robot,
    interruption: Interruption,
    orders: Orders,
    /// The monotonic clock and the wall clock at one moment, in nanoseconds.
    clock: (BootNs, UnixNs),
    /// The round of an earlier planner, until scores give the rooms.
    kept: Option<KeptRound>,
    /// Whether the rooms of the rules were compared with the map.
    compared_rooms: bool,
    decisions: VecDeque<(u64, [u8; NAME_BYTES])>,
    /// Epoch and sequence of the scores of the last decision, and its time.
    decided: Option<(u64, u64)>,
    decided_ns: BootNs,
    /// The next decision's text about the work before it.
    notice: Notice,
    phase: Phase,
    /// The published reason of the present pause, and its time.
    said: (String, BootNs),
}

/// A message is dated in the future, as one of another boot. It would never be too old, and the daemon's messages would be older than it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("dated {ahead_s} s ahead of this machine's clock, so it is not of this boot's daemon")]
pub struct DatedAhead {
    ahead_s: u64,
}

impl DatedAhead {
    fn refuse(dated_ns: BootNs, now_ns: BootNs) -> Result<(), Self> {
        let ahead_ns = dated_ns.since(now_ns);
        if ahead_ns > AHEAD_NS { Err(Self { ahead_s: ahead_ns / 1_000_000_000 }) } else { Ok(()) }
    }
}

/// The end of the work before a decision.
#[derive(Debug, Default)]
struct Notice {
    /// The decision of this epoch that is cancelled, 0 for none.
    cancels: u64,
    flags: u32,
    why: String,
}

struct Verdict {
    /// The reason against work there.
    reason: Option<Reason>,
    /// The likely person there.
    by: Option<Reason>,
    /// A person asked for it.
    is_asked: bool,
}

/// A decision's reason: each sentence begins with a capital letter and stands once.
fn in_sentences(text: &str) -> String {
    let mut said: Vec<String> = Vec::new();
    for sentence in text.split_inclusive(". ").map(str::trim) {
        let mut letters = sentence.chars();
        let begun: String = letters.next().into_iter().flat_map(char::to_uppercase).chain(letters).collect();
        if !said.contains(&begun) {
            said.push(begun);
        }
    }
    // The policy's numbers come last. Sentences that do not fit are left out whole.
    let mut end = said.first().map_or(0, String::len);
    let fits = |sentence: &&String| {
        end += 1 + sentence.len();
        end <= REASON_TEXT_BYTES
    };
    let fitting = said.iter().skip(1).take_while(fits).count();
    said.truncate(1 + fitting);
    said.join(" ")
}

enum Next {
    Go { room: usize, reason: String, flags: u32 },
    Pause { why: Pause, reason: String },
}

impl Planner {
    /// A robot in no room, with nothing covered; `epoch` is random per start.
    #[must_use]
    pub fn new(config: &PlannerConfig, epoch: u64) -> Self {
        Self {
            config: config.clone(),
            policy: config.policy.policy(),
            rng: ChaCha8Rng::seed_from_u64(config.seed),
            number: sequence::source_of_name(&config.robot),
            name: text::encode_cut(&config.robot),
            epoch,
            sequence: 0,
            deadline_ns: config.deadline_ms.saturating_mul(1_000_000),
            zone: Zone::UTC,
            residents: Vec::new(),
            follows_persons: false,
            scores: None,
            forecast: None,
            persons: None,
            daemon: None,
            others: config.avoid_robots.then(|| Others::new(sequence::source_of_name(&config.robot))),
            places: None,
            near: Vec::new(),
            round: Round::new(config),
            robot: Robot::new(config),
            interruption: Interruption::new(config),
            orders: Orders::default(),
            clock: (BootNs(0), UnixNs(0)),
            kept: None,
            compared_rooms: false,
            decisions: VecDeque::new(),
            decided: None,
            decided_ns: BootNs(0),
            notice: Notice::default(),
            phase: Phase::Free,
            said: (String::new(), BootNs(0)),
        }
    }

    /// With the residents of the home and its time zone. The planner then expects persons' forecasts.
    #[must_use]
    pub fn with_home(mut self, residents: &[String], zone: Zone) -> Self {
        (self.residents, self.zone, self.follows_persons) = (residents.to_vec(), zone, true);
        self
    }

    /// With the orders that an earlier planner kept.
    #[must_use]
    pub fn with_orders(mut self, orders: Orders) -> Self {
        self.orders = orders;
        self
    }

    /// The orders, to be saved.
    #[must_use]
    pub fn orders(&self) -> &Orders {
        &self.orders
    }

    /// With the map for reports' positions and names of rooms; the daemon's scores are of the partitions at `level`.
    #[must_use]
    pub fn with_map(mut self, map: SemanticMap, level: PartitionLevel) -> Self {
        let places = Places::new(map, level);
        for (_, room) in self.config.named_rooms() {
            if let Some(id) = places.id(room) {
                id.clone_into(room);
            }
        }
        self.places = Some(places);
        self
    }

    /// With the round of an earlier planner, if the scores are of the same map.
    #[must_use]
    pub fn with_kept(mut self, kept: KeptRound) -> Self {
        self.kept = Some(kept);
        self
    }

    /// Takes a checked snapshot, unless it is older than the known one. If the daemon's map has changed, the rooms that remain keep their
    /// work, and new rooms are to be done. If another daemon has another map, all rooms are new.
    ///
    /// # Errors
    ///
    /// [`DatedAhead`]; nothing is taken then.
    pub fn take(&mut self, scores: &RoomScoresV1, now_ns: BootNs) -> Result<(), DatedAhead> {
        DatedAhead::refuse(BootNs(scores.published_ns.max(scores.computed_ns)), now_ns)?;
        if let Some(known) = &self.scores {
            if known.epoch == scores.epoch
                && (known.sequence, known.published_ns) > (scores.sequence, scores.published_ns)
            {
                return Ok(());
            }
            // A delayed snapshot of an earlier daemon.
            if known.epoch != scores.epoch && known.published_ns > scores.published_ns {
                return Ok(());
            }
        }
        let same_map = self.scores.as_ref().is_some_and(|known| {
            known.map_fingerprint == scores.map_fingerprint
                && known.rooms().iter().map(|room| room.id).eq(scores.rooms().iter().map(|room| room.id))
        });
        if !same_map {
            self.compared_rooms = false;
            let changed = self.scores.filter(|known| known.epoch == scores.epoch);
            self.move_rooms(changed.as_ref(), scores);
        }
        if let Some(places) = &mut self.places {
            places.see(scores);
            if !same_map || self.near.is_empty() {
                self.near = if places.fits(scores) { places.near(scores) } else { Vec::new() };
            }
        }
        self.scores = Some(*scores);
        if self.daemon.is_none_or(|(epoch, _)| epoch != scores.epoch) {
            self.daemon = Some((scores.epoch, now_ns));
        }
        if let Some(kept) = self.kept.take() {
            self.restore(&kept);
        }
        Ok(())
    }

    /// Changes the rooms: rooms of the same daemon's earlier map are followed, all else is forgotten.
    fn move_rooms(&mut self, former: Option<&RoomScoresV1>, scores: &RoomScoresV1) {
        let (old, new) = (former.map_or(&[][..], RoomScoresV1::rooms), scores.rooms());
        let before = |room: usize| new.get(room).and_then(|room| old.iter().position(|other| other.id == room.id));
        let after = |room: usize| old.get(room).and_then(|room| new.iter().position(|other| other.id == room.id));
        self.round.move_rooms(new.len(), before);
        self.interruption.move_rooms(new.len(), before);
        self.robot.move_rooms(after);
        if former.is_none() {
            self.round.end();
        }
    }

    /// Takes a checked forecast. It is used while its rooms are those of the scores.
    ///
    /// # Errors
    ///
    /// As [`Planner::take`].
    pub fn take_forecast(&mut self, forecast: &ForecastV1, now_ns: BootNs) -> Result<(), DatedAhead> {
        DatedAhead::refuse(BootNs(forecast.published_ns.max(forecast.computed_ns)), now_ns)?;
        self.forecast = Some(*forecast);
        Ok(())
    }

    /// Whether the newest scores contain narration that the newest forecast lacks.
    #[must_use]
    pub(crate) fn lacks_forecast(&self) -> bool {
        let belongs = |scores: &RoomScoresV1, forecast: &ForecastV1| {
            forecast.epoch == scores.epoch && forecast.sequence >= scores.sequence
        };
        self.scores.as_ref().is_some_and(|scores| {
            scores.sequence > 0 && !self.forecast.as_ref().is_some_and(|forecast| belongs(scores, forecast))
        })
    }

    /// Takes each person's checked forecast.
    ///
    /// # Errors
    ///
    /// As [`Planner::take`].
    pub fn take_persons(&mut self, forecasts: &PersonForecastsV1, now_ns: BootNs) -> Result<(), DatedAhead> {
        DatedAhead::refuse(BootNs(forecasts.published_ns.max(forecasts.computed_ns)), now_ns)?;
        **self.persons.get_or_insert_default() = *forecasts;
        Ok(())
    }

    /// The rooms in a person's room set, if the configuration avoids them. `None` if the sets are not known.
    fn avoided(&self, now_ns: BootNs) -> Option<Vec<bool>> {
        let Some(scores) = self.scores.as_ref().filter(|_| self.config.avoid_sets) else { return Some(Vec::new()) };
        outlook::in_sets(self.persons.as_deref(), scores, (now_ns, self.deadline_ns), self.stay_s())
    }

    /// Whether the configuration avoids room sets and the sets of the newest scores are missing.
    #[must_use]
    pub(crate) fn lacks_sets(&self, now_ns: BootNs) -> bool {
        self.scores.is_some() && self.avoided(now_ns).is_none()
    }

    /// Whether the persons' forecasts of a new daemon are still expected.
    #[must_use]
    pub(crate) fn expects_persons(&self, now_ns: BootNs) -> bool {
        let (Some(scores), Some((_, since_ns))) = (&self.scores, self.daemon) else { return false };
        let is_new = self.persons.as_ref().is_none_or(|persons| persons.epoch != scores.epoch);
        let waits = self.follows_persons && self.config.know_s > 0.0;
        waits && is_new && scores.sequence > 0 && now_ns < since_ns.saturating_add(self.deadline_ns)
    }

    pub(crate) fn take_other(&mut self, decision: &DecisionV1, now_ns: BootNs) {
        if let Some(others) = &mut self.others {
            others.hear(decision, now_ns);
        }
    }

    /// The rooms of rules and needs that the map lacks, once. These rules have no effect.
    pub(crate) fn rooms_not_on_the_map(&mut self) -> Vec<String> {
        let Some(scores) = self.scores.as_ref().filter(|_| !self.compared_rooms) else { return Vec::new() };
        self.compared_rooms = true;
        let named = self.config.named_rooms().map(|(_, own)| own.clone());
        named.filter(|own| !scores.rooms().iter().any(|room| is_room(own, room.id()))).collect()
    }

    /// A robot with a decision for a room that the map lacks, and that room; each robot once. Its room cannot be avoided.
    pub(crate) fn robot_of_another_map(&mut self) -> Option<(u64, String)> {
        self.others.as_mut()?.of_another_map(self.scores.as_ref()?)
    }

    /// Decides if the robot is free, or has to leave its room, and there is something new to say.
    ///
    /// # Errors
    ///
    /// [`PolicyError`] when the policy cannot use the scores; the robot stays.
    pub fn decide(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) -> Result<Option<DecisionV1>, PolicyError> {
        self.clock = (now_ns, now_unix_ns);
        self.look_at_work(now_ns);
        self.look_at_orders();
        self.wait_through_quiet_hours(now_ns);
        let stale = self.stale(now_ns);
        let Some(scores) = self.scores.filter(|_| stale == 0) else {
            self.interruption.look_away();
            return Ok(self.stop_by_the_clock(stale, now_ns).or_else(|| self.fall_back(stale)));
        };
        if self.expects_persons(now_ns) {
            return Ok(None);
        }
        let forecast = Forecast::usable(self.forecast.as_ref(), &scores, now_ns, self.deadline_ns);
        let known = outlook::what_is_known(&scores, forecast);
        let decision = self.decide_on(&scores, now_ns)?;
        Ok(decision.map(|decision| DecisionV1 { flags: decision.flags | known, ..decision }))
    }

    fn decide_on(&mut self, scores: &RoomScoresV1, now_ns: BootNs) -> Result<Option<DecisionV1>, PolicyError> {
        self.look_for_persons(scores, now_ns);
        self.look_for_robots(scores, now_ns);
        let _ended = self.look_at_rules(scores, now_ns, |_| true);
        if self.phase == Phase::Resumes {
            self.step(Step::Decide);
            if let Some(work) = self.robot.work.clone() {
                return Ok(Some(self.ask_again(&work, scores, now_ns)));
            }
        }
        if !self.is_to_decide(scores, now_ns) {
            return Ok(None);
        }
        self.step(Step::Decide);
        (self.decided, self.decided_ns) = (Some((scores.epoch, scores.sequence)), now_ns);
        if let Some(reason) = self.robot.why_it_charges() {
            return Ok(self.pause(Pause::Battery, &reason));
        }
        if let Some(reason) = self.robot.why_it_rests(now_ns) {
            return Ok(self.pause(Pause::Trouble, &reason));
        }
        let waiting = self.robot.work.clone();
        if waiting.is_some() && self.round.slots_left(now_ns) == Some(0) {
            return Ok(None);
        }
        if self.round.undone() == 0 && !self.config.repeat {
            return Ok(Some(self.finish()));
        }
        let (flags, ended) = self.turn_round(now_ns);
        self.round.began_ns.get_or_insert(now_ns);
        let forecast = Forecast::usable(self.forecast.as_ref(), scores, now_ns, self.deadline_ns);
        let outlook = Outlook::new(scores, forecast, self.stay_s(), self.round.slots_left(now_ns).unwrap_or(0));
        let here = forecast.map(|forecast| forecast.now());
        match self.next(&outlook, here.as_deref(), now_ns)? {
            Next::Pause { .. } if waiting.is_some() => Ok(None),
            Next::Pause { why, reason } => {
                // Rounds pass while a rule allows no room.
                let ended = if matches!(why, Pause::Rule(_)) { "" } else { &ended };
                Ok(self.pause(why, &format!("{ended}{reason}")))
            }
            Next::Go { room, reason, flags: forced } => {
                let idle = self.is_idle_in(room);
                let room = self.better_stay(idle, room, &outlook, now_ns).unwrap_or(room);
                if let Some(waiting) = waiting {
                    // A robot without work changes its room only for a person.
                    if idle && (room == waiting.room || !self.is_met(&waiting, scores, now_ns)) {
                        return Ok(None);
                    }
                    self.notice.cancels = self.own_decision(&waiting);
                }
                let likely = outlook.over_stay(room, self.stay_s()).filter(|_| self.plans());
                let likely = likely.or_else(|| outlook.likely.get(room).copied());
                let stay_ns = self.stay_in_ns(room);
                // The reason before it is about another room.
                let goes = format!("It goes to the {}: ", self.name_of(room));
                let goes = if self.notice.why.is_empty() { "" } else { &goes };
                let decision = self.go(room, stay_ns, &format!("{ended}{goes}{reason}"));
                let likely_now = here.as_ref().and_then(|here| here.get(room).copied());
                self.send_to(room, idle, likely_now, now_ns, decision.sequence);
                Ok(Some(DecisionV1 {
                    probability: likely.unwrap_or_default().clamp(0.0, 1.0),
                    // Without work the decision is a place only.
                    action: if idle { action::STAY } else { action::GO },
                    flags: decision.flags | flags | forced,
                    ..decision
                }))
            }
        }
    }

    fn step(&mut self, step: Step) {
        self.phase = self.phase.after(step);
    }

    /// The last decision of a planner that does not repeat its rounds.
    fn finish(&mut self) -> DecisionV1 {
        self.step(Step::Finish);
        self.round.end();
        // An interrupted robot does not wait in a person's room.
        let (action, to) = match self.notice.flags & decision_flags::INTERRUPTED {
            0 => (action::STAY, self.robot.room),
            _ => (action::PAUSE, None),
        };
        let decision = self.decision(to, "every room is covered");
        DecisionV1 { action, flags: decision.flags | decision_flags::COVERED, ..decision }
    }

    /// Begins the next round after a completed one, or at the deadline. Returns the decision's flag of a completed round, and the text about rooms
    /// that were left.
    fn turn_round(&mut self, now_ns: BootNs) -> (u32, String) {
        let (rooms, undone) = (self.round.covered().len(), self.round.undone());
        if undone == 0 {
            if !self.round.goes_on(now_ns) {
                self.round.begin_again();
                self.look_at_needs();
            }
            return (decision_flags::COVERED, String::new());
        }
        if self.round.slots_left(now_ns) != Some(0) {
            return (0, String::new());
        }
        let next = if self.config.repeat { "a round of all rooms begins" } else { "another round for them begins" };
        if self.config.repeat {
            self.round.begin_again();
            self.look_at_needs();
        } else {
            self.round.end();
        }
        (0, format!("the round's deadline came with {undone} of {rooms} rooms undone, {next}: "))
    }

    fn ask_again(&mut self, work: &Work, scores: &RoomScoresV1, now_ns: BootNs) -> DecisionV1 {
        // After its time the robot owes a report. It may have sent it while no planner was running.
        let left_ns = work.ends_ns.since(now_ns);
        let reason = match left_ns {
            0 => "asks what became of what it was sent to do before the planner's restart",
            _ => "goes on with what it was sent to do before the planner's restart",
        };
        let forecast = Forecast::usable(self.forecast.as_ref(), scores, now_ns, self.deadline_ns);
        let outlook = Outlook::new(scores, forecast, self.stay_s(), 0);
        let likely = outlook.over_stay(work.room, self.stay_s()).filter(|_| self.plans());
        let likely = likely.or_else(|| outlook.likely.get(work.room).copied()).unwrap_or_default().clamp(0.0, 1.0);
        let decision = self.go(work.room, left_ns, reason);
        let owed = if left_ns == 0 { decision_flags::OWED } else { 0 };
        let decision = DecisionV1 { probability: likely, flags: decision.flags | owed, ..decision };
        if let Some(work) = &mut self.robot.work {
            work.asked_by(decision.epoch, decision.sequence);
        }
        decision
    }

    /// Every room is covered and the planner said so. A new room on the map changes that.
    fn is_finished(&self) -> bool {
        self.phase == Phase::Finished && self.round.undone() == 0
    }

    /// The reason why the scores must not be used: bits of [`decision_flags`], 0 if they may.
    #[must_use]
    pub fn stale(&self, now_ns: BootNs) -> u32 {
        match &self.scores {
            None => decision_flags::NO_SCORES,
            Some(scores) if scores.silence_ns(now_ns.0) > self.deadline_ns => {
                decision_flags::STALE | decision_flags::DAEMON_SILENT
            }
            // The daemon is alive, but these scores lack the newest events.
            Some(scores) if scores.has(score_flags::SCORER_FAILED) && scores.age_ns(now_ns.0) > self.deadline_ns => {
                decision_flags::STALE
            }
            Some(_) => 0,
        }
    }

    /// Whether the clock has ended the work. For a robot that reports, it ends only waiting.
    fn is_over(&self, work: &Work, now_ns: BootNs) -> bool {
        now_ns >= work.ends_ns && (!self.robot.is_believed() || work.waits || self.round.stay_ns == 0)
    }

    /// Whether the robot has no work in hand.
    #[must_use]
    pub fn is_free(&self, now_ns: BootNs) -> bool {
        self.robot.work.as_ref().is_none_or(|work| self.is_over(work, now_ns))
    }

    /// The time until the next decision without news, at most one tick.
    #[must_use]
    pub fn idle(&self, now_ns: BootNs) -> Duration {
        const LEAST_NS: u64 = 1_000_000;
        let ends_ns = self.robot.work.as_ref().map(|work| work.ends_ns).filter(|_| self.round.stay_ns > 0);
        // Scores that become stale are noticed at once.
        let stale_ns = self
            .scores
            .as_ref()
            .map(|scores| BootNs(scores.published_ns).saturating_add(self.deadline_ns).saturating_add(LEAST_NS));
        let next_ns = ends_ns.into_iter().chain(stale_ns).filter(|next_ns| *next_ns > now_ns).min();
        next_ns.map_or(TICK, |next_ns| Duration::from_nanos(next_ns.since(now_ns).max(LEAST_NS)).min(TICK))
    }

    /// The room that the robot is in, by index in the scores' rooms.
    #[must_use]
    pub fn room(&self) -> Option<usize> {
        self.robot.room
    }

    fn plans(&self) -> bool {
        self.policy.name() == PolicyName::CoverageAware
    }

    /// Whether the policy goes to a completed room only to wait.
    fn plans_coverage(&self) -> bool {
        matches!(self.policy.name(), PolicyName::CoverageAware | PolicyName::UncoveredFirst)
    }

    fn stay_in_ns(&self, room: usize) -> u64 {
        let own = self.config.needs_of(self.id_of(room)).and_then(|needs| needs.time_s);
        own.filter(|_| self.round.stay_ns > 0).map_or(self.round.stay_ns, nanoseconds)
    }

    fn stay_in_s(&self, room: usize) -> f64 {
        self.stay_in_ns(room) as f64 / 1e9
    }

    fn stay_s(&self) -> f64 {
        self.round.stay_ns as f64 / 1e9
    }

    /// A room's name in reasons.
    fn name_of(&self, room: usize) -> String {
        let rooms = self.scores.as_ref().map_or(&[][..], RoomScoresV1::rooms);
        room_name(self.id_of(room), rooms.iter().map(RoomV1::id))
    }

    fn id_of(&self, room: usize) -> &str {
        let rooms = self.scores.as_ref().map_or(&[][..], RoomScoresV1::rooms);
        rooms.get(room).map_or("", |room| room.id())
    }

    /// The newest decision of this epoch for the work, 0 for none.
    fn own_decision(&self, work: &Work) -> u64 {
        let own = work.decisions.iter().rev().find(|(epoch, _)| *epoch == self.epoch);
        own.map_or(0, |(_, sequence)| *sequence)
    }

    /// The room of a decision, by epoch (0 for any) and sequence: the current one, or one of the last of this epoch.
    fn room_of_decision(&self, decision: (u64, u64)) -> Option<usize> {
        let in_hand = self.robot.work.as_ref().filter(|work| work.answers(decision));
        let past = || {
            let own = decision.0 == 0 || decision.0 == self.epoch;
            let (_, id) = self.decisions.iter().find(|(sequence, _)| own && *sequence == decision.1)?;
            self.scores.as_ref()?.rooms().iter().position(|room| room.id == *id)
        };
        in_hand.map(|work| work.room).or_else(past)
    }
}

#[cfg(test)]
mod tests;
