//! Commands for a vacuum, and reports about it. Pure: time is an argument.
//!
//! There is one open command at a time. The robot's state confirms it, and a lost command is repeated. A command to clean has failed after
//! three tries. A command that ends work is repeated until it is followed: no other participant calls a robot out of a person's room. Work
//! is finished when a robot that was seen at work has left it by itself and will not continue. A robot in an error, one that does not start
//! and one that never ends are reported as failed, with the reason in words.

use std::collections::BTreeMap;

use roomcast_core::ids::BootNs;
use roomcast_ipc::raw::{DecisionV1, NOTE_TEXT_BYTES, action, decision_flags};

use super::dialect::{Order, Sensed, Status};
use super::rooms::segment_of;
use crate::config::{OnPause, RobotConfig, RobotKind};
use crate::reporter::{Kind, Report};

/// Tries of a command before it has failed, or before the log says that a command to end work is not followed.
const TRIES: u32 = 3;
/// A robot that leaves its work has finished if its state does not change for this time.
const SETTLE_NS: u64 = 3_000_000_000;
const UNHEARD: &str = "nothing was heard of the robot yet";
const UNTOLD: &str = "the robot has told of no segments; name them in [robot.segments]";
/// The least change of the battery for a report. At the dock it is smaller, since a planner may wait there for a full battery.
const BATTERY_STEP: f64 = 0.05;
const BATTERY_STEP_DOCKED: f64 = 0.01;
/// Levels are reported in hundredths, and their differences are not exact.
const BATTERY_EXACT: f64 = 1e-9;
/// The longest interval of reports from a robot at work: the planner treats a silent one as lost.
const TELL_NS: u64 = 30_000_000_000;

/// An output of the driver.
#[derive(Debug, Clone, PartialEq)]
pub enum Act {
    /// A command for the robot.
    Order(Order),
    /// A report for the planner.
    Report(Report),
}

#[derive(Debug, Clone, PartialEq)]
struct Work {
    decision: u64,
    room: String,
    asked_ns: BootNs,
    /// The decision is older than this driver: an earlier one may have carried it out.
    is_earlier: bool,
}

#[derive(Debug, Clone, PartialEq)]
enum State {
    /// There is no open command or work.
    Free,
    /// A command is open, and the robot's state does not show it yet. `differed`: its state was another one, then or since.
    Ordered { order: Order, since_ns: BootNs, tries: u32, differed: bool },
    /// The robot works for a decision. `left_ns`: the time since which it does not any more.
    Working { since_ns: BootNs, left_ns: Option<BootNs>, paused_ns: Option<BootNs> },
}

/// Follows the decisions for one robot.
#[derive(Debug)]
pub struct Driver {
    number: u64,
    kind: RobotKind,
    obeys: bool,
    on_pause: OnPause,
    start_ns: u64,
    least_ns: u64,
    most_ns: u64,
    configured: BTreeMap<String, String>,
    /// The last list with a segment; empty if the robot has sent no other, `None` before the first.
    segments: Option<BTreeMap<String, String>>,
    rooms: Vec<String>,
    connected: bool,
    /// The robot is connected, as far as it says.
    online: bool,
    /// The last reported activity.
    said: Option<Status>,
    /// The same while the robot is connected, else `None`.
    status: Option<Status>,
    /// The last known status, also over a time without a broker: a robot that stood at its dock all along has not come there.
    seen: Option<Status>,
    resumes: bool,
    battery: Option<f64>,
    fault: String,
    is_heard: bool,
    /// The time of the first look.
    began_ns: Option<BootNs>,
    /// The robot has cleaned since its first message, so an earlier driver may have sent it.
    is_new: bool,
    /// If a robot with a battery at this level or less leaves its work, it has to charge; `None` if the robot itself says so.
    recharge_at: Option<f64>,
    /// The last decision ends work, and the robot's state is unknown.
    is_to_end: bool,
    decided: Option<(u64, u64)>,
    wish: Option<Work>,
    state: State,
    /// A robot that charges in the middle of its work must not continue by itself: the remaining commands for that, and the time of the
    /// next.
    forgets: Option<(u32, BootNs)>,
    told_ns: BootNs,
    told_battery: Option<f64>,
    outcome: Option<Report>,
}

fn nanoseconds(seconds: f64) -> u64 {
    (seconds * 1e9) as u64
}

impl Driver {
    /// A driver of the robot with this number in decisions.
    #[must_use]
    pub fn new(config: &RobotConfig, number: u64) -> Self {
        Self {
            number,
            kind: config.kind,
            obeys: config.obey,
            on_pause: config.on_pause,
            start_ns: nanoseconds(config.start_s),
            least_ns: nanoseconds(config.least_s),
            most_ns: nanoseconds(config.most_s),
            configured: config.segments.clone(),
            segments: None,
            rooms: Vec::new(),
            connected: true,
            online: true,
            said: None,
            status: None,
            seen: None,
            resumes: false,
            battery: None,
            fault: String::new(),
            is_heard: false,
            began_ns: None,
            is_new: true,
            recharge_at: (config.kind == RobotKind::HomeAssistant).then_some(config.recharge_at),
            is_to_end: false,
            decided: None,
            wish: None,
            state: State::Free,
            forgets: None,
            told_ns: BootNs(0),
            told_battery: None,
            outcome: None,
        }
    }

    pub(crate) fn know_rooms<'a>(&mut self, rooms: impl Iterator<Item = &'a str> + Clone) {
        if !rooms.clone().eq(self.rooms.iter().map(String::as_str)) {
            self.rooms = rooms.map(str::to_owned).collect();
        }
    }

    pub(crate) fn is_heard(&self) -> bool {
        self.is_heard
    }

    pub(crate) fn knows_segments(&self) -> bool {
        self.kind == RobotKind::HomeAssistant || self.segments.as_ref().is_some_and(|segments| !segments.is_empty())
    }

    /// The segment of each room, or the reason why there is none.
    pub fn plan(&self) -> impl Iterator<Item = (&str, Result<String, String>)> {
        self.rooms.iter().map(|room| (room.as_str(), self.segment(room)))
    }

    fn segment(&self, room: &str) -> Result<String, String> {
        match self.kind {
            RobotKind::Valetudo if !self.is_heard && !self.configured.contains_key(room) => Err(UNHEARD.to_owned()),
            RobotKind::Valetudo => match (&self.segments, self.configured.get(room)) {
                (None, None) => Err(UNTOLD.to_owned()),
                (segments, _) => {
                    let none = BTreeMap::new();
                    segment_of(room, &self.rooms, &self.configured, segments.as_ref().unwrap_or(&none))
                }
            },
            // Its automation knows rooms by their ids.
            RobotKind::HomeAssistant => Ok(self.configured.get(room).map_or(room, String::as_str).to_owned()),
        }
    }

    /// Takes a checked decision.
    #[must_use]
    pub fn decide(&mut self, decision: &DecisionV1, now_ns: BootNs) -> Vec<Act> {
        self.began_ns.get_or_insert(now_ns);
        let own = (decision.epoch, decision.sequence);
        let is_order = decision.robot == self.number && !decision.has(decision_flags::ELSEWHERE);
        if !is_order || self.decided == Some(own) {
            return Vec::new();
        }
        self.decided = Some(own);
        let mut acts = Vec::new();
        let is_cancelled = self.wish.as_ref().is_some_and(|work| work.decision == decision.cancels);
        match decision.action {
            action::GO => self.go(decision, now_ns, &mut acts),
            action::PAUSE => self.stop_work(now_ns, &mut acts),
            // To wait in another room: its work is over, and this robot waits at its dock.
            _ if !decision.to().is_empty() && decision.to() != decision.from() => self.stop_work(now_ns, &mut acts),
            // Work in the same room is also over if the decision cancels it.
            _ if is_cancelled => self.stop_work(now_ns, &mut acts),
            // To stay in place without work.
            _ => {}
        }
        self.step(now_ns, &mut acts);
        acts
    }

    fn go(&mut self, decision: &DecisionV1, now_ns: BootNs, acts: &mut Vec<Act>) {
        self.is_to_end = false;
        let (sequence, room) = (decision.sequence, decision.to().to_owned());
        let is_ending = self.is_ending();
        if let Some(work) = self.wish.as_mut().filter(|work| work.room == room && !is_ending) {
            // The same again, for example from a restarted planner.
            work.decision = sequence;
            if matches!(self.state, State::Working { .. }) {
                self.report(Kind::Started, "", acts);
            }
            return;
        }
        if decision.has(decision_flags::OWED) {
            let known = self.outcome.take().filter(|outcome| outcome.room.as_ref() == Some(&room));
            let unknown =
                || Report { room: Some(room.clone()), ..note(Kind::Failed, "what became of it is not known") };
            let owed = Report { decision: Some(sequence), ..known.unwrap_or_else(unknown) };
            return self.say(owed, acts);
        }
        if self.wish.is_some() && self.state != State::Free {
            self.order(Order::Stop, now_ns, acts);
        }
        let is_earlier = self.began_ns.is_some_and(|began_ns| decision.decided_ns < began_ns.0);
        self.wish = Some(Work { decision: sequence, room, asked_ns: now_ns, is_earlier });
    }

    /// Ends the current work: a person has come, or the robot must wait.
    fn stop_work(&mut self, now_ns: BootNs, acts: &mut Vec<Act>) {
        self.wish = None;
        let is_ordered = matches!(self.state, State::Ordered { .. });
        // A robot with a command to clean may begin at any moment, whatever its state, and a disconnected one continues.
        let begins = is_ordered && !self.is_ending();
        let is_cut_off = self.status.is_none() && matches!(self.state, State::Working { .. });
        let works = self.status == Some(Status::Cleaning) || begins || is_cut_off;
        let moves = works || is_ordered || matches!(self.status, Some(Status::Paused | Status::Idle));
        match self.on_pause {
            OnPause::Pause if works => self.order(Order::Pause, now_ns, acts),
            OnPause::Return if moves => self.order(Order::Home, now_ns, acts),
            // A command to end work stays open until it is followed.
            _ if self.is_ending() => {}
            _ => self.state = State::Free,
        }
        // The robot's next message shows whether there is work to end.
        self.is_to_end = self.status.is_none() && self.state == State::Free;
    }

    fn is_ending(&self) -> bool {
        matches!(&self.state, State::Ordered { order, .. } if !matches!(order, Order::Clean { .. }))
    }

    fn order(&mut self, order: Order, now_ns: BootNs, acts: &mut Vec<Act>) {
        acts.push(Act::Order(order.clone()));
        // Without obedience, commands are only shown, and have no reply.
        if self.obeys {
            // Before the first status, the state cannot differ.
            let differed = self.status.is_some() && !self.is_as_ordered(&order);
            self.state = State::Ordered { order, since_ns: now_ns, tries: 1, differed };
        } else {
            (self.state, self.wish) = (State::Free, None);
        }
    }

    /// Updates whether the broker is connected. While it is not, the robot's state is unknown; the next connection delivers it again.
    #[must_use]
    pub fn link(&mut self, is_connected: bool, now_ns: BootNs) -> Vec<Act> {
        let mut acts = Vec::new();
        if self.connected == is_connected {
            return acts;
        }
        self.connected = is_connected;
        // Home Assistant sends a state when it changes, and a broker may have lost it: the last one is valid until the next.
        let is_said_once = self.kind == RobotKind::HomeAssistant;
        if is_connected && is_said_once {
            self.status = self.said;
        }
        if !is_connected {
            (self.online, self.status) = (true, None);
            self.said = self.said.filter(|_| is_said_once);
        } else if self.is_ending()
            && let State::Ordered { since_ns, .. } = &mut self.state
        {
            // A silent robot gets the command again soon, and a working one as soon as it reports that.
            *since_ns = now_ns.saturating_sub(self.start_ns.saturating_sub(SETTLE_NS));
        }
        self.step(now_ns, &mut acts);
        acts
    }

    /// Takes a message of the robot.
    #[must_use]
    pub fn sense(&mut self, sensed: Sensed, now_ns: BootNs) -> Vec<Act> {
        let mut acts = Vec::new();
        self.is_heard = true;
        let says_status = matches!(sensed, Sensed::Status(_));
        match sensed {
            Sensed::Status(status) => {
                self.said = Some(status);
                // The broker stores a status of Valetudo even if the robot is off, so Valetudo reports separately that it is connected.
                self.online |= self.kind == RobotKind::HomeAssistant;
            }
            Sensed::Resumes(resumes) => self.resumes = resumes,
            Sensed::Fault(fault) => self.fault = fault,
            // Valetudo sends an empty list while it has no map, for example after it restarts.
            Sensed::Segments(segments) if segments.is_empty() => {
                self.segments.get_or_insert_default();
            }
            Sensed::Segments(segments) => self.segments = Some(segments),
            Sensed::Online(online) => self.online = online,
            Sensed::Battery(battery) => self.battery = Some(battery),
        }
        if !self.online {
            self.seen = None;
        }
        let before = std::mem::replace(&mut self.status, self.said.filter(|_| self.online));
        if says_status || before != self.status {
            self.look_at_status(before, now_ns, &mut acts);
        }
        let step = if self.status == Some(Status::Docked) { BATTERY_STEP_DOCKED } else { BATTERY_STEP };
        let is_news =
            |battery: f64| self.told_battery.is_none_or(|told| (told - battery).abs() >= step - BATTERY_EXACT);
        if self.online && self.battery.is_some_and(is_news) {
            self.tell(now_ns, &mut acts);
        }
        self.step(now_ns, &mut acts);
        acts
    }

    /// The robot has sent its state, or is connected again with the earlier one.
    fn look_at_status(&mut self, before: Option<Status>, now_ns: BootNs, acts: &mut Vec<Act>) {
        let Some(status) = self.status else { return };
        self.is_new &= status == Status::Cleaning;
        let seen = self.seen.replace(status);
        self.look_at_change(before, now_ns, acts);
        if std::mem::take(&mut self.is_to_end) {
            self.stop_work(now_ns, acts);
        }
        if status == Status::Docked && seen != Some(status) && !matches!(self.state, State::Working { .. }) {
            self.say(Report { battery: self.battery, ..Report::new(Kind::Docked) }, acts);
        }
    }

    /// Handles the passing of time.
    #[must_use]
    pub fn tick(&mut self, now_ns: BootNs) -> Vec<Act> {
        self.began_ns.get_or_insert(now_ns);
        let mut acts = Vec::new();
        self.step(now_ns, &mut acts);
        // Only about work: an idle robot must not appear to be at its ordered work. Nor must one that is away.
        let works = matches!(self.state, State::Working { .. }) && self.status.is_some();
        if works && now_ns.since(self.told_ns) >= TELL_NS {
            self.tell(now_ns, &mut acts);
        }
        acts
    }

    fn tell(&mut self, now_ns: BootNs, acts: &mut Vec<Act>) {
        (self.told_ns, self.told_battery) = (now_ns, self.battery);
        let works = matches!(self.state, State::Working { .. });
        match (&self.wish, self.battery) {
            (_, Some(battery)) => self.say(Report { battery: Some(battery), ..Report::new(Kind::Battery) }, acts),
            (Some(work), None) if works => {
                self.say(Report { room: Some(work.room.clone()), ..Report::new(Kind::Position) }, acts)
            }
            _ => {}
        }
    }

    fn step(&mut self, now_ns: BootNs, acts: &mut Vec<Act>) {
        self.forget(now_ns, acts);
        match self.state.clone() {
            State::Free => self.start(now_ns, acts),
            State::Ordered { order, since_ns, tries, differed } => {
                self.look_at_order(order, (since_ns, tries), differed, now_ns, acts);
            }
            State::Working { since_ns, left_ns, paused_ns } => {
                self.look_at_work(since_ns, left_ns, paused_ns, now_ns, acts);
            }
        }
    }

    /// Tells a robot at its dock that it must not continue by itself. Home Assistant does not confirm that.
    fn forget(&mut self, now_ns: BootNs, acts: &mut Vec<Act>) {
        let Some((left, next_ns)) = self.forgets else { return };
        let means_to = self.resumes || self.kind == RobotKind::HomeAssistant;
        // A new order replaces the unfinished work.
        if left == 0 || matches!(self.state, State::Ordered { .. } | State::Working { .. }) && !self.is_ending() {
            self.forgets = None;
        } else if means_to && self.status == Some(Status::Docked) && now_ns >= next_ns {
            acts.push(Act::Order(Order::Stop));
            self.forgets = Some((left - 1, now_ns.saturating_add(self.start_ns)));
        }
    }

    fn start(&mut self, now_ns: BootNs, acts: &mut Vec<Act>) {
        let Some(work) = self.wish.clone() else { return };
        let is_new = self.is_new && self.obeys && work.is_earlier;
        self.is_new &= self.status.is_none();
        match self.status {
            // Its activity is known soon after the connection.
            None if self.obeys => {}
            // A restarted driver finds the robot at its ordered work.
            Some(Status::Cleaning) if is_new => self.begin(now_ns, acts),
            Some(Status::Error) => self.end(Kind::Failed, &self.trouble(), acts),
            // Another person or program has sent it out.
            Some(Status::Cleaning | Status::Manual) => self.order(Order::Stop, now_ns, acts),
            _ => match self.segment(&work.room) {
                Ok(segment) => self.order(Order::Clean { segment, room: work.room }, now_ns, acts),
                // The segments are known soon after the connection.
                Err(_)
                    if self.segments.as_ref().is_none_or(BTreeMap::is_empty)
                        && now_ns.since(work.asked_ns) < self.start_ns => {}
                Err(why) => self.end(Kind::Blocked, &why, acts),
            },
        }
    }

    fn trouble(&self) -> String {
        let fault = if self.fault.is_empty() { "it does not say which" } else { &self.fault };
        format!("the robot has an error: {fault}")
    }

    /// Handles a new state of the robot. If it begins work that should end, the command is repeated at once: it may have missed it at its
    /// dock.
    fn look_at_change(&mut self, before: Option<Status>, now_ns: BootNs, acts: &mut Vec<Act>) {
        let State::Ordered { order, since_ns, tries, differed } = self.state.clone() else { return };
        let begins = self.status == Some(Status::Cleaning) && before != self.status;
        let again = self.is_ending() && begins;
        if again {
            acts.push(Act::Order(order.clone()));
        }
        // A robot without a known state has received none of the earlier commands.
        let told = if before.is_none() { 1 } else { tries.saturating_add(1) };
        let (since_ns, tries) = if again { (now_ns, told) } else { (since_ns, tries) };
        let differed = differed || !self.is_as_ordered(&order);
        self.state = State::Ordered { order, since_ns, tries, differed };
    }

    /// Whether the robot's state is the result of a command.
    fn is_as_ordered(&self, order: &Order) -> bool {
        match order {
            Order::Clean { .. } => self.status == Some(Status::Cleaning),
            Order::Stop => !matches!(self.status, Some(Status::Cleaning | Status::Manual) | None),
            Order::Pause => !matches!(self.status, Some(Status::Cleaning) | None),
            Order::Home => matches!(self.status, Some(Status::Returning | Status::Docked)),
        }
    }

    fn look_at_order(
        &mut self,
        order: Order,
        (since_ns, tries): (BootNs, u32),
        differed: bool,
        now_ns: BootNs,
        acts: &mut Vec<Act>,
    ) {
        let cleans = matches!(order, Order::Clean { .. });
        if self.status == Some(Status::Error) {
            self.state = State::Free;
            if cleans {
                self.end(Kind::Failed, &self.trouble(), acts);
            }
            return self.start(now_ns, acts);
        }
        let (is_so, is_late) = (self.is_as_ordered(&order), now_ns.since(since_ns) >= self.start_ns);
        // The same state before the command is no reply: a robot at its dock may be about to leave it. If it stays, the command is
        // repeated, and then it counts as having no work to end.
        if is_so && (differed || is_late && tries >= TRIES) {
            if cleans {
                return self.begin(now_ns, acts);
            }
            self.state = State::Free;
            return self.start(now_ns, acts);
        }
        if !is_late {
            return;
        }
        if tries < TRIES {
            acts.push(Act::Order(order.clone()));
            self.state = State::Ordered { order, since_ns: now_ns, tries: tries + 1, differed };
            return;
        }
        let why = self.why_not_followed(cleans);
        if cleans {
            self.end(Kind::Failed, why, acts);
            // The robot must not begin if it receives the command late, for example when it is connected again.
            return if self.status.is_some() {
                acts.push(Act::Order(Order::Stop));
            } else {
                self.order(Order::Stop, now_ns, acts);
            };
        }
        // A standing robot need not go home before it goes to work.
        if self.wish.is_some() && self.is_as_ordered(&Order::Stop) {
            self.state = State::Free;
            return self.start(now_ns, acts);
        }
        if self.wish.is_some() {
            self.end(Kind::Failed, why, acts);
        } else if tries == TRIES {
            tracing::error!(?order, why, "what ends the robot's work is not followed, and is told again until it is");
        }
        let hears = self.connected && self.online;
        if hears {
            acts.push(Act::Order(order.clone()));
        }
        let since_ns = if hears { now_ns } else { since_ns };
        self.state = State::Ordered { order, since_ns, tries: TRIES + 1, differed };
    }

    fn why_not_followed(&self, cleans: bool) -> &'static str {
        match (self.connected, self.status) {
            (false, _) => "the broker is away",
            (true, None) => "the robot is not connected",
            (true, Some(_)) if cleans => "the robot does not do what it is told",
            (true, Some(_)) => "the robot does not stop when it is told to",
        }
    }

    fn begin(&mut self, now_ns: BootNs, acts: &mut Vec<Act>) {
        self.state = State::Working { since_ns: now_ns, left_ns: None, paused_ns: None };
        self.told_ns = now_ns;
        self.report(Kind::Started, "", acts);
    }

    fn look_at_work(
        &mut self,
        since_ns: BootNs,
        left_ns: Option<BootNs>,
        paused_ns: Option<BootNs>,
        now_ns: BootNs,
        acts: &mut Vec<Act>,
    ) {
        let (mut left, mut paused) = (None, None);
        match self.status {
            Some(Status::Error) => return self.end(Kind::Failed, &self.trouble(), acts),
            Some(Status::Returning | Status::Docked | Status::Idle) => left = Some(left_ns.unwrap_or(now_ns)),
            Some(Status::Paused | Status::Manual) => paused = Some(paused_ns.unwrap_or(now_ns)),
            Some(Status::Cleaning) | None => {}
        }
        self.state = State::Working { since_ns, left_ns: left, paused_ns: paused };
        let for_ns = |since: Option<BootNs>| since.map(|since_ns| now_ns.since(since_ns));
        if for_ns(left).is_some_and(|left_ns| left_ns >= SETTLE_NS) {
            let is_empty = self.recharge_at.zip(self.battery).is_some_and(|(at, battery)| battery <= at);
            if self.resumes || is_empty {
                self.forgets = Some((TRIES, now_ns));
                return self.end(Kind::Failed, "the robot has to charge before it can go on", acts);
            }
            let worked_ns = left.unwrap_or(now_ns).since(since_ns);
            if worked_ns < self.least_ns {
                let why = format!(
                    "the robot left after {} s: somebody has called it home, or robot.least_s is too long",
                    worked_ns / 1_000_000_000
                );
                return self.end(Kind::Cancelled, &why, acts);
            }
            return self.end(Kind::Finished, "", acts);
        }
        if for_ns(paused).is_some_and(|paused_ns| paused_ns >= self.most_ns.min(10 * self.start_ns)) {
            return self.end(Kind::Cancelled, "somebody has paused the robot", acts);
        }
        if now_ns.since(since_ns) >= self.most_ns {
            self.end(Kind::Failed, "the robot is at it for longer than it may take", acts);
            self.order(Order::Home, now_ns, acts);
        }
    }

    fn end(&mut self, kind: Kind, why: &str, acts: &mut Vec<Act>) {
        let had_begun = matches!(self.state, State::Working { .. });
        self.report(kind, why, acts);
        self.outcome = self.wish.take().map(|work| Report { room: Some(work.room), ..note(kind, why) });
        self.state = State::Free;
        // Its arrival at the dock was not reported while it counted as working. A robot that never left the dock does not arrive there.
        if had_begun && self.status == Some(Status::Docked) {
            self.say(Report { battery: self.battery, ..Report::new(Kind::Docked) }, acts);
        }
    }

    fn report(&self, kind: Kind, why: &str, acts: &mut Vec<Act>) {
        let Some(work) = &self.wish else { return };
        let report = Report { room: Some(work.room.clone()), decision: Some(work.decision), ..note(kind, why) };
        self.say(Report { battery: self.battery, ..report }, acts);
    }

    /// Without obedience there are no reports, since nothing was done.
    fn say(&self, report: Report, acts: &mut Vec<Act>) {
        if self.obeys {
            acts.push(Act::Report(report));
        }
    }
}

fn note(kind: Kind, why: &str) -> Report {
    let mut end = why.len().min(NOTE_TEXT_BYTES);
    while !why.is_char_boundary(end) {
        end -= 1;
    }
    let why: String = why[..end].chars().map(|c| if roomcast_core::text::is_hidden(c) { ' ' } else { c }).collect();
    Report { note: (!why.is_empty()).then_some(why), ..Report::new(kind) }
}

#[cfg(test)]
mod tests;
