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
    DecisionV1, ForecastV1, NAME_BYTES, PersonForecastsV1, RoomScoresV1, action, decision_flags, score_flags,
};
use roomcast_ipc::{sequence, text};

use crate::config::{Config, Forced, PlannerConfig, is_room};
use crate::daemon::Zone;
use crate::setup;
use roomcast_core::grounding::PartitionLevel;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_core::policy::{Choice, Policy, PolicyError, PolicyName, RobotState};
use roomcast_core::semantic_map::SemanticMap;

mod facts;
mod interruption;
mod orders;
mod others;
mod outlook;
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
    standing: Standing,
}

#[derive(Debug, Clone, PartialEq)]
enum Standing {
    /// None that is still valid.
    Free,
    /// An earlier planner ordered the work in hand. This planner repeats the order, so that the robot knows its number.
    Resumes,
    /// To pause: the cause, the text and the time.
    Pauses(Pause, String, BootNs),
    /// The fallback, which is valid until scores are fresh.
    FellBack,
    /// To stay, because every room is covered.
    Finished,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Pause {
    Battery,
    /// A person has come into its room, and persons are in the others.
    Persons,
    /// It fails at each order.
    Trouble,
    /// No room is open to it.
    NoRoom,
    /// Rooms of persons' sets are avoided, and the sets of the scores have not come.
    NoSets,
    /// A rule of the house, by its kind.
    Rule(std::mem::Discriminant<Reason>),
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

fn sentences<'a>(reasons: impl Iterator<Item = &'a Reason>) -> Vec<String> {
    let mut said = Vec::new();
    for sentence in reasons.map(Reason::to_string) {
        if !said.contains(&sentence) {
            said.push(sentence);
        }
    }
    said
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
            standing: Standing::Free,
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
        self.places = Some(Places::new(map, level));
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
        self.persons = Some(Box::new(*forecasts));
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
        let named = self
            .config
            .quiet
            .iter()
            .flat_map(|hours| hours.rooms())
            .chain(self.config.room.iter().map(|room| &room.id));
        named.filter(|own| !scores.rooms().iter().any(|room| is_room(own, room.id()))).cloned().collect()
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
            let stopped = self.stop_by_the_clock(stale, now_ns, now_unix_ns);
            return Ok(stopped.or_else(|| self.fall_back(stale, now_ns, now_unix_ns)));
        };
        if self.expects_persons(now_ns) {
            return Ok(None);
        }
        let forecast = Forecast::usable(self.forecast.as_ref(), &scores, now_ns, self.deadline_ns);
        let known = outlook::what_is_known(&scores, forecast);
        let decision = self.decide_on(&scores, now_ns, now_unix_ns)?;
        Ok(decision.map(|decision| DecisionV1 { flags: decision.flags | known, ..decision }))
    }

    fn decide_on(
        &mut self,
        scores: &RoomScoresV1,
        now_ns: BootNs,
        now_unix_ns: UnixNs,
    ) -> Result<Option<DecisionV1>, PolicyError> {
        self.look_for_persons(scores, now_ns);
        self.look_for_robots(scores, now_ns);
        let _ended = self.look_at_rules(scores, now_ns, |_| true);
        if self.standing == Standing::Resumes {
            self.standing = Standing::Free;
            if let Some(work) = self.robot.work.clone() {
                return Ok(Some(self.ask_again(&work, scores, now_ns, now_unix_ns)));
            }
        }
        if !self.is_to_decide(scores, now_ns) {
            return Ok(None);
        }
        if matches!(self.standing, Standing::FellBack | Standing::Finished) {
            self.standing = Standing::Free;
        }
        (self.decided, self.decided_ns) = (Some((scores.epoch, scores.sequence)), now_ns);
        if let Some(reason) = self.robot.why_it_charges() {
            return Ok(self.pause(Pause::Battery, &reason, now_ns, now_unix_ns));
        }
        if let Some(reason) = self.robot.why_it_rests(now_ns) {
            return Ok(self.pause(Pause::Trouble, &reason, now_ns, now_unix_ns));
        }
        let waiting = self.robot.work.clone();
        if waiting.is_some() && self.round.slots_left(now_ns) == Some(0) {
            return Ok(None);
        }
        let (mut flags, mut ended) = (0, String::new());
        let (rooms, undone) = (self.round.covered().len(), self.round.undone());
        if undone == 0 {
            flags = decision_flags::COVERED;
            if !self.config.repeat {
                self.standing = Standing::Finished;
                self.round.end();
                // An interrupted robot does not wait in a person's room.
                let (action, to) = match self.notice.flags & decision_flags::INTERRUPTED {
                    0 => (action::STAY, self.robot.room),
                    _ => (action::PAUSE, None),
                };
                let decision = self.decision(now_ns, now_unix_ns, to, "every room is covered");
                return Ok(Some(DecisionV1 { action, flags: decision.flags | flags, ..decision }));
            }
            if !self.round.goes_on(now_ns) {
                self.round.begin_again();
                self.look_at_needs();
            }
        } else if self.round.slots_left(now_ns) == Some(0) {
            let next = if self.config.repeat { "a round of all rooms begins" } else { "another round for them begins" };
            ended = format!("the round's deadline came with {undone} of {rooms} rooms undone, {next}: ");
            if self.config.repeat {
                self.round.begin_again();
                self.look_at_needs();
            } else {
                self.round.end();
            }
        }
        self.round.began_ns.get_or_insert(now_ns);
        let forecast = Forecast::usable(self.forecast.as_ref(), scores, now_ns, self.deadline_ns);
        let outlook = Outlook::new(scores, forecast, self.stay_s(), self.round.slots_left(now_ns).unwrap_or(0));
        let here = forecast.map(|forecast| forecast.now());
        match self.next(&outlook, here.as_deref(), now_ns)? {
            Next::Pause { .. } if waiting.is_some() => Ok(None),
            Next::Pause { why, reason } => {
                // Rounds pass while a rule allows no room.
                let ended = if matches!(why, Pause::Rule(_)) { "" } else { &ended };
                Ok(self.pause(why, &format!("{ended}{reason}"), now_ns, now_unix_ns))
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
                let decision = self.go(room, stay_ns, &format!("{ended}{reason}"), now_ns, now_unix_ns);
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

    fn ask_again(&mut self, work: &Work, scores: &RoomScoresV1, now_ns: BootNs, now_unix_ns: UnixNs) -> DecisionV1 {
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
        let decision = self.go(work.room, left_ns, reason, now_ns, now_unix_ns);
        let owed = if left_ns == 0 { decision_flags::OWED } else { 0 };
        let decision = DecisionV1 { probability: likely, flags: decision.flags | owed, ..decision };
        if let Some(work) = &mut self.robot.work {
            work.asked_by(decision.epoch, decision.sequence);
        }
        decision
    }

    fn look_at_orders(&mut self) {
        let unix_s = self.clock.1.0 / 1_000_000_000;
        if self.orders.expire(unix_s) {
            self.ordered();
        }
        self.look_at_needs();
    }

    /// A person's order has come, or has expired: the next look decides again, and says so.
    fn ordered(&mut self) {
        self.decided = None;
        if self.standing != Standing::Resumes {
            self.standing = Standing::Free;
        }
    }

    /// Notes the rooms that need work now. Due rooms need it in any round, excluded and skipped rooms never.
    fn look_at_needs(&mut self) {
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

    fn cover(&mut self, room: usize, at_ns: BootNs) {
        self.round.cover(room);
        let (now_ns, unix_ns) = self.clock;
        let unix_ns = unix_ns.0.saturating_sub(now_ns.since(at_ns));
        let id = self.id_of(room).to_owned();
        self.orders.clean(&id, unix_ns / 1_000_000_000);
    }

    /// The weight of leaving each room undone, by its priority and the time overdue.
    fn weights(&self) -> Vec<f64> {
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

    fn local_s(&self) -> f64 {
        self.zone.local_s(self.clock.1)
    }

    fn facts<'a>(&'a self, scores: &'a RoomScoresV1, now_ns: BootNs) -> Facts<'a> {
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
            ..known.facts()
        }
    }

    /// The wait for residents does not pass in quiet hours: they sleep then, and no sensor observes them.
    fn wait_through_quiet_hours(&mut self, now_ns: BootNs) {
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
    fn unobserved(
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
    fn look_at_rules(
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
        let (id, cancels) = (self.id_of(work.room), self.own_decision(work));
        let why = if work.waits { String::new() } else { format!("The work in the {id} stops. {reason} ") };
        self.notice = Notice { cancels, flags: 0, why };
        self.robot.work = None;
        self.interruption.new_stay(None);
        self.ordered();
        Some(reason)
    }

    /// A hold and quiet hours end the work without fresh scores, too.
    fn stop_by_the_clock(&mut self, stale: u32, now_ns: BootNs, now_unix_ns: UnixNs) -> Option<DecisionV1> {
        let scores = self.scores?;
        let is_clock = |reason: &Reason| matches!(reason, Reason::Held { .. } | Reason::Quiet { .. });
        let reason = self.look_at_rules(&scores, now_ns, is_clock)?;
        let why = Pause::Rule(std::mem::discriminant(&reason));
        let decision = self.pause(why, &reason.to_string(), now_ns, now_unix_ns)?;
        Some(DecisionV1 { flags: decision.flags | stale, ..decision })
    }

    /// Ends work at the end of its time. By the clock it is done; a robot that owes a report has failed.
    fn look_at_work(&mut self, now_ns: BootNs) {
        if self.robot.give_up_charging(now_ns) {
            self.notice.why = "the robot has said nothing for so long that it counts as charged: ".to_owned();
            self.standing = Standing::Free;
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
            let id = self.id_of(work.room).to_owned();
            let (room, cancels) = (work.room, self.own_decision(work));
            self.robot.silent = true;
            self.round.fail(room, now_ns);
            self.robot.work = None;
            let why = format!("the robot says nothing of its work in the {id}, which is given up: ");
            self.notice = Notice { cancels, flags: 0, why };
        }
    }

    fn look_for_persons(&mut self, scores: &RoomScoresV1, now_ns: BootNs) {
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
            let (id, percent) = (self.id_of(room).to_owned(), 100.0 * likely.get(room).copied().unwrap_or_default());
            let why = format!("somebody came into {id} ({percent:.0} %), so its work there stops: ");
            let cancels = self.own_decision(&work);
            self.notice = Notice { cancels, flags: decision_flags::INTERRUPTED, why };
        }
    }

    /// Ends the work, or the wait, in a room where another robot has precedence.
    fn look_for_robots(&mut self, scores: &RoomScoresV1, now_ns: BootNs) {
        let Some(work) = self.robot.work.as_ref() else { return };
        let room = scores.rooms().get(work.room).map(|room| room.id);
        if !room.zip(self.others.as_ref()).is_some_and(|(room, others)| others.go_before(&room, work.waits, now_ns)) {
            return;
        }
        let (id, cancels) = (self.id_of(work.room).to_owned(), self.own_decision(work));
        let what = if work.waits { "it waits no longer there" } else { "its work there stops" };
        self.robot.work = None;
        let why = format!("another robot has the {id}, so {what}: ");
        self.notice = Notice { cancels, flags: 0, why };
    }

    /// Whether a person is likely in the room where the robot waits.
    fn is_met(&self, work: &Work, scores: &RoomScoresV1, now_ns: BootNs) -> bool {
        let forecast = Forecast::usable(self.forecast.as_ref(), scores, now_ns, self.deadline_ns);
        let likely = forecast.filter(|forecast| !forecast.knows_nobody()).map(|forecast| forecast.now());
        likely.is_some_and(|likely| likely.get(work.room).is_some_and(|likely| self.interruption.is_met(*likely)))
    }

    /// Whether the robot is free and something may have changed since the last decision.
    fn is_to_decide(&self, scores: &RoomScoresV1, now_ns: BootNs) -> bool {
        let pauses = matches!(self.standing, Standing::Pauses(..));
        let sets_came = matches!(self.standing, Standing::Pauses(Pause::NoSets, ..)) && !self.lacks_sets(now_ns);
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
    fn taken(&self, waiting_too: bool, now_ns: BootNs) -> Vec<bool> {
        let known = self.scores.as_ref().zip(self.others.as_ref());
        known.map_or_else(Vec::new, |(scores, others)| others.taken(scores, waiting_too, now_ns))
    }

    fn is_idle_in(&self, room: usize) -> bool {
        self.round.is_done(room) && self.plans_coverage()
    }

    fn next(&mut self, outlook: &Outlook, here: Option<&[f64]>, now_ns: BootNs) -> Result<Next, PolicyError> {
        let (occupied, empty) = (self.config.interrupt_at, self.config.resume_at);
        let Some(avoided) = self.avoided(now_ns) else {
            let reason = "it is not known which rooms are in somebody's set: no room is entered until it is".to_owned();
            return Ok(Next::Pause { why: Pause::NoSets, reason });
        };
        let mut closed = self.interruption.held().to_vec();
        closed.resize(closed.len().max(avoided.len()), false);
        closed.iter_mut().zip(&avoided).for_each(|(closed, avoided)| *closed |= avoided);
        let taken = self.taken(false, now_ns);
        closed.resize(closed.len().max(taken.len()), false);
        closed.iter_mut().zip(&taken).for_each(|(closed, taken)| *closed |= taken);
        let shared = self.taken(true, now_ns);
        let rules = self.verdicts(now_ns);
        if let Some((why, reason)) = self.why_none(&rules) {
            return Ok(Next::Pause { why, reason });
        }
        let is_open = |room: usize| taken.get(room) != Some(&true) && !self.round.rests(room, now_ns);
        let asked = rules.iter().position(|verdict| verdict.is_asked && verdict.reason.is_none());
        if let Some(room) = asked.filter(|room| is_open(*room)) {
            return Ok(Next::Go { room, reason: "A person asked for this room.".to_owned(), flags: 0 });
        }
        closed.resize(closed.len().max(rules.len()), false);
        closed.iter_mut().zip(&rules).for_each(|(closed, verdict)| *closed |= verdict.reason.is_some());
        let mut left = Vec::new();
        // Time is scarce only if every remaining stay is needed.
        let scarce = self.plans()
            && !outlook.has(decision_flags::NOT_KNOWN)
            && self.round.slots_left(now_ns).is_some_and(|slots| slots <= self.round.undone());
        loop {
            let Some(Choice { partition, reason }) = self.choose(&closed, outlook, now_ns)? else {
                let waits = self.why_waiting(&rules);
                let reason = if waits.is_empty() { self.why_nowhere(&left, avoided.contains(&true)) } else { waits };
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
            let interrupted = self.notice.flags & decision_flags::INTERRUPTED != 0
                || matches!(self.standing, Standing::Pauses(Pause::Persons, ..));
            if interrupted && here.and_then(|here| here.get(room)).is_some_and(|likely| *likely >= occupied) {
                let waits = self.why_waiting(&rules);
                let reason =
                    if waits.is_empty() { "somebody is likely in every other room too".to_owned() } else { waits };
                return Ok(Next::Pause { why: Pause::Persons, reason });
            }
            // Where rules leave no other room to wait in, the robot is not sent to the person instead.
            let by_rules = rules.iter().any(|verdict| verdict.reason.is_some());
            let is_taken = rules.get(room).is_some_and(|verdict| verdict.by.is_some());
            let waits_elsewhere =
                (0..rules.len()).any(|other| self.is_idle_in(other) && closed.get(other) != Some(&true));
            if by_rules && is_taken && !waits_elsewhere && self.config.forced == Forced::Skip {
                return Ok(Next::Pause { why: Pause::Persons, reason: self.why_waiting(&rules) });
            }
            let known = match outlook.flags {
                decision_flags::NOT_KNOWN => "nothing is known of anybody, so every room counts alike: ",
                decision_flags::NOBODY_HOME => "nobody is home: ",
                _ if outlook.misses_resident => "somebody who lives here was not observed yet: ",
                _ => "",
            };
            let left = self.why_left(&left);
            let waits = if self.is_idle_in(room) { self.why_waiting(&rules) } else { String::new() };
            let waits = if waits.is_empty() { waits } else { format!("{waits} ") };
            let (forced, flags) = match likely.filter(|likely| *likely > empty) {
                Some(likely) => {
                    let percent = 100.0 * likely;
                    let forced = format!("the deadline leaves no later time for this room ({percent:.0} % occupied): ");
                    (forced, decision_flags::DEADLINE)
                }
                None => (String::new(), 0),
            };
            return Ok(Next::Go { room, reason: format!("{waits}{known}{left}{forced}{reason}"), flags });
        }
    }

    /// The policy's choice: rooms that the robot could not do come after the others. None when no room is open.
    fn choose(&mut self, closed: &[bool], outlook: &Outlook, now_ns: BootNs) -> Result<Option<Choice>, PolicyError> {
        let close = |also: &dyn Fn(usize) -> bool| -> Vec<bool> {
            closed.iter().enumerate().map(|(room, closed)| *closed || also(room)).collect()
        };
        let later = close(&|room| self.round.has_failed(room));
        let now = close(&|room| self.round.rests(room, now_ns));
        let first = self.choose_open(&later, outlook)?;
        let works = first.as_ref().is_some_and(|choice| !self.round.is_done(choice.partition.0 as usize));
        if works || later == now { Ok(first) } else { self.choose_open(&now, outlook) }
    }

    fn choose_open(&mut self, closed: &[bool], outlook: &Outlook) -> Result<Option<Choice>, PolicyError> {
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
    fn better_stay(&self, idle: bool, chosen: usize, outlook: &Outlook, now_ns: BootNs) -> Option<usize> {
        let here = self.robot.room.filter(|here| idle && self.round.is_done(*here) && *here != chosen)?;
        let closed = |rooms: &[bool]| rooms.get(here).copied().unwrap_or(false);
        let open = !closed(self.interruption.held()) && !closed(&self.taken(true, now_ns));
        let (own, other) = (outlook.over_stay(here, self.stay_s())?, outlook.over_stay(chosen, self.stay_s())?);
        (open && own <= other + WORTH_MOVING).then_some(here)
    }

    fn verdicts(&self, now_ns: BootNs) -> Vec<Verdict> {
        let Some(scores) = &self.scores else { return Vec::new() };
        let facts = self.facts(scores, now_ns);
        let verdict = |room: usize| {
            let now = Now { local_s: self.local_s(), stay_s: self.stay_in_s(room).max(1.0) };
            let by = facts.staying.get(room).cloned().flatten();
            let id = self.id_of(room).to_owned();
            Verdict {
                reason: allowed(room, now, &facts).err(),
                by: by.map(|by| Reason::Occupied { by: Some(by), room: id }),
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
            let later = || is_taken(room).then(|| Reason::Occupied { by: None, room: self.id_of(room).to_owned() });
            (self.id_of(room).to_owned(), verdict.reason.or(verdict.by).or_else(later).map(|reason| reason.to_string()))
        };
        self.verdicts(now_ns).into_iter().enumerate().map(reason).collect()
    }

    fn why_none(&self, rules: &[Verdict]) -> Option<(Pause, String)> {
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
        let said = sentences(reasons.filter_map(|(_, verdict)| verdict.reason.as_ref()));
        Some((Pause::Rule(std::mem::discriminant(first)), said.join(" ")))
    }

    fn why_waiting(&self, rules: &[Verdict]) -> String {
        let to_do = rules.iter().enumerate().filter(|(room, _)| !self.round.is_done(*room));
        sentences(to_do.filter_map(|(_, verdict)| verdict.reason.as_ref().or(verdict.by.as_ref()))).join(" ")
    }

    fn why_nowhere(&self, left: &[usize], avoided: bool) -> String {
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

    fn why_left(&self, left: &[usize]) -> String {
        let ids: Vec<&str> = left.iter().map(|room| self.id_of(*room)).collect();
        if ids.is_empty() {
            return String::new();
        }
        format!("left to the next round, since somebody is likely there: {}; ", ids.join(", "))
    }

    /// The robot stays, since the scores are stale.
    fn fall_back(&mut self, stale: u32, now_ns: BootNs, now_unix_ns: UnixNs) -> Option<DecisionV1> {
        if self.robot.work.is_some() || self.is_finished() || self.standing == Standing::FellBack {
            return None;
        }
        // A robot that made way for a person does not stay next to that person.
        let (action, to, does) = match std::mem::replace(&mut self.standing, Standing::FellBack) {
            Standing::Pauses(..) => (action::PAUSE, None, "the robot had paused, and goes on pausing"),
            _ => (action::STAY, self.robot.room, "staying is safe"),
        };
        self.decided = None;
        let why = match stale {
            decision_flags::NO_SCORES => "no scores have arrived",
            decision_flags::STALE => "the scores lack narration that the scorer failed on",
            _ => "the daemon has been silent for longer than the deadline",
        };
        let decision = self.decision(now_ns, now_unix_ns, to, &format!("{why}: {does}"));
        Some(DecisionV1 { action, flags: decision.flags | decision_flags::FALLBACK | stale, ..decision })
    }

    fn pause(&mut self, why: Pause, reason: &str, now_ns: BootNs, now_unix_ns: UnixNs) -> Option<DecisionV1> {
        let said = Standing::Pauses(why, reason.to_owned(), now_ns);
        if let Standing::Pauses(before, words, said_ns) = &self.standing {
            let is_other = *before != why && [*before, why].iter().any(|why| matches!(why, Pause::Rule(_)));
            let is_timed = matches!(why, Pause::Rule(_) | Pause::Persons);
            let is_old = is_timed && words != reason && now_ns >= said_ns.saturating_add(SAY_AGAIN_NS);
            if !is_other && !is_old && self.notice.why.is_empty() {
                let (words, said_ns) = (words.clone(), *said_ns);
                self.standing = Standing::Pauses(why, words, said_ns);
                return None;
            }
        }
        self.standing = said;
        // The end of the earlier work may have the same reason.
        let reason = if self.notice.why.contains(reason) { "The robot waits." } else { reason };
        let decision = self.decision(now_ns, now_unix_ns, None, reason);
        Some(DecisionV1 { action: action::PAUSE, ..decision })
    }

    fn go(&mut self, room: usize, stay_ns: u64, reason: &str, now_ns: BootNs, now_unix_ns: UnixNs) -> DecisionV1 {
        let decision = self.decision(now_ns, now_unix_ns, Some(room), reason);
        if self.decisions.len() == DECISIONS {
            self.decisions.pop_front();
        }
        self.decisions.push_back((decision.sequence, decision.to));
        self.standing = Standing::Free;
        DecisionV1 { action: action::GO, stay_ns, ..decision }
    }

    /// The robot's new work, with the probability of a person in the room, if known.
    fn send_to(&mut self, room: usize, waits: bool, likely: Option<f64>, now_ns: BootNs, sequence: u64) {
        let ends_ns = now_ns.saturating_add(self.stay_in_ns(room)).max(BootNs(1));
        let decisions = vec![(self.epoch, sequence)];
        self.robot.work = Some(Work { room, decisions, began_ns: now_ns, ends_ns, waits, started: false });
        self.robot.be(Some(room), now_ns);
        self.interruption.new_stay(likely.map(|likely| (room, likely)));
    }

    fn decision(&mut self, now_ns: BootNs, now_unix_ns: UnixNs, to: Option<usize>, reason: &str) -> DecisionV1 {
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
            reason: text::encode_cut(&format!("{why}{reason}")),
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

    /// Every room is covered and the planner said so. A new room on the map changes that.
    fn is_finished(&self) -> bool {
        self.standing == Standing::Finished && self.round.undone() == 0
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
