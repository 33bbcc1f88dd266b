//! What a vacuum is told, and what is said of it. Pure: time comes in as a number.
//!
//! One order is under way at a time, and it counts as heard when the robot's own state says so: an order that was lost is given again. To
//! clean has failed after three times. What ends work is given again until it is followed: nobody else calls a robot out of a person's room. Work is finished when a robot that was seen at work has left it by itself and means to do no more. A
//! robot in an error, one that does not start and one that never ends are reported as failed, with the reason in words.

use std::collections::BTreeMap;

use roomcast_core::ids::BootNs;
use roomcast_ipc::raw::{DecisionV1, NOTE_TEXT_BYTES, action, decision_flags};

use super::dialect::{Order, Sensed, Status};
use super::rooms::segment_of;
use crate::config::{OnPause, RobotConfig, RobotKind};
use crate::reporter::{Kind, Report};

/// How often an order is given before it has failed, or before it is said that one that ends work is not followed.
const TRIES: u32 = 3;
/// A robot that leaves its work has finished when it has said nothing else for so long.
const SETTLE_NS: u64 = 3_000_000_000;
/// Why a room has no segment before the robot has spoken.
const UNHEARD: &str = "nothing was heard of the robot yet";
/// Why a room has no segment before the robot has sent its list.
const UNTOLD: &str = "the robot has told of no segments; name them in [robot.segments]";
/// The battery is told when it has changed by so much; at the dock by less, since a planner waits there for one that may be full.
const BATTERY_STEP: f64 = 0.05;
const BATTERY_STEP_DOCKED: f64 = 0.01;
/// Shares are told in hundredths, whose differences are not exact.
const BATTERY_EXACT: f64 = 1e-9;
/// A robot at work is heard of at least so often: the planner takes one that is silent for lost.
const TELL_NS: u64 = 30_000_000_000;

/// What is to be done.
#[derive(Debug, Clone, PartialEq)]
pub enum Act {
    /// The robot is told this.
    Order(Order),
    /// The planner is told this.
    Report(Report),
}

/// A room that a decision asks for.
#[derive(Debug, Clone, PartialEq)]
struct Work {
    decision: u64,
    room: String,
    asked_ns: BootNs,
}

/// What the driver is about.
#[derive(Debug, Clone, PartialEq)]
enum State {
    /// Nothing is under way.
    Free,
    /// An order is given, and the robot's state does not show it yet. `differed`: its state was another than ordered, then or since.
    Ordered { order: Order, since_ns: BootNs, tries: u32, differed: bool },
    /// The robot is at work for a decision. `left_ns`: since when it is not any more.
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
    /// The last list with a segment; an empty one if the robot has sent no other, `None` before the first.
    segments: Option<BTreeMap<String, String>>,
    rooms: Vec<String>,
    /// The broker is connected.
    connected: bool,
    /// The robot is, as far as it says.
    online: bool,
    /// What the robot said last of what it does.
    said: Option<Status>,
    /// The same of one that is connected; none of another.
    status: Option<Status>,
    /// The last status there was, also over a time without a broker: a robot that stood at its dock all along has not come there.
    seen: Option<Status>,
    resumes: bool,
    battery: Option<f64>,
    fault: String,
    /// The robot has said something.
    is_heard: bool,
    /// What the robot is at, it may have been sent to do by a driver before this one: it has cleaned since it was first heard.
    is_new: bool,
    /// A battery of this or less says that a robot that leaves its work has to charge; none where the robot says it itself.
    recharge_at: Option<f64>,
    /// The last decision ends work, and nothing is known of the robot that may be at it.
    is_to_end: bool,
    /// The last decision's epoch and sequence.
    decided: Option<(u64, u64)>,
    /// What is to be done next, or is under way.
    wish: Option<Work>,
    state: State,
    /// A robot that charges in the middle of its work is not to go on by itself: how often it is told so still, and when next.
    forgets: Option<(u32, BootNs)>,
    told_ns: BootNs,
    told_battery: Option<f64>,
    /// What became of the last work.
    outcome: Option<Report>,
}

fn nanoseconds(seconds: f64) -> u64 {
    (seconds * 1e9) as u64
}

impl Driver {
    /// A driver of the robot that decisions name by this number.
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

    /// Takes the ids of the map's rooms.
    pub(crate) fn know_rooms<'a>(&mut self, rooms: impl Iterator<Item = &'a str> + Clone) {
        if !rooms.clone().eq(self.rooms.iter().map(String::as_str)) {
            self.rooms = rooms.map(str::to_owned).collect();
        }
    }

    /// Whether the robot has said anything.
    pub(crate) fn is_heard(&self) -> bool {
        self.is_heard
    }

    /// Whether it is known what each room is to the robot.
    pub(crate) fn knows_segments(&self) -> bool {
        self.kind == RobotKind::HomeAssistant || self.segments.as_ref().is_some_and(|segments| !segments.is_empty())
    }

    /// What each room is to the robot: its segment, or why there is none.
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
            // Work in the same room is over, too, if the decision cancels it.
            _ if is_cancelled => self.stop_work(now_ns, &mut acts),
            // To stay where it is, with nothing to do.
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
            // The same again, as from a planner that was started again.
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
        self.wish = Some(Work { decision: sequence, room, asked_ns: now_ns });
    }

    /// The work in hand ends: a person has come, or the robot is to wait.
    fn stop_work(&mut self, now_ns: BootNs, acts: &mut Vec<Act>) {
        self.wish = None;
        let is_ordered = matches!(self.state, State::Ordered { .. });
        // A robot that was told to clean may begin at any moment, whatever it has said so far, and one that is cut off goes on.
        let begins = is_ordered && !self.is_ending();
        let is_cut_off = self.status.is_none() && matches!(self.state, State::Working { .. });
        let works = self.status == Some(Status::Cleaning) || begins || is_cut_off;
        let moves = works || is_ordered || matches!(self.status, Some(Status::Paused | Status::Idle));
        match self.on_pause {
            OnPause::Pause if works => self.order(Order::Pause, now_ns, acts),
            OnPause::Return if moves => self.order(Order::Home, now_ns, acts),
            // What ends other work is followed until it has.
            _ if self.is_ending() => {}
            _ => self.state = State::Free,
        }
        // Whether there is anything to end shows when the robot speaks.
        self.is_to_end = self.status.is_none() && self.state == State::Free;
    }

    /// Whether an order that ends work is under way, before anything else is done.
    fn is_ending(&self) -> bool {
        matches!(&self.state, State::Ordered { order, .. } if !matches!(order, Order::Clean { .. }))
    }

    fn order(&mut self, order: Order, now_ns: BootNs, acts: &mut Vec<Act>) {
        acts.push(Act::Order(order.clone()));
        // Whoever only says what it would do waits for nothing.
        if self.obeys {
            // Of a robot of which nothing is known yet no state is another one.
            let differed = self.status.is_some() && !self.is_as_ordered(&order);
            self.state = State::Ordered { order, since_ns: now_ns, tries: 1, differed };
        } else {
            (self.state, self.wish) = (State::Free, None);
        }
    }

    /// Takes whether the broker is connected. While it is not, nothing is known of the robot; what it does is told again with the next
    /// connection.
    #[must_use]
    pub fn link(&mut self, is_connected: bool, now_ns: BootNs) -> Vec<Act> {
        let mut acts = Vec::new();
        if self.connected == is_connected {
            return acts;
        }
        self.connected = is_connected;
        // Home Assistant says a state when it changes, and a broker may have lost what it kept: what was said last holds until it says another.
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
            // A robot that says nothing is told again soon, and one that is at work as soon as it says so.
            *since_ns = now_ns.saturating_sub(self.start_ns.saturating_sub(SETTLE_NS));
        }
        self.step(now_ns, &mut acts);
        acts
    }

    /// Takes what the robot says.
    #[must_use]
    pub fn sense(&mut self, sensed: Sensed, now_ns: BootNs) -> Vec<Act> {
        let mut acts = Vec::new();
        self.is_heard = true;
        let says_status = matches!(sensed, Sensed::Status(_));
        match sensed {
            Sensed::Status(status) => {
                self.said = Some(status);
                // Of Valetudo the broker has kept a status, also of a robot that is off: it says by itself that it is connected.
                self.online |= self.kind == RobotKind::HomeAssistant;
            }
            Sensed::Resumes(resumes) => self.resumes = resumes,
            Sensed::Fault(fault) => self.fault = fault,
            // Valetudo sends an empty list while it has no map, for instance after it restarts.
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

    /// The robot has told its state, or is connected with the one that it told before.
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

    /// Takes that time has passed.
    #[must_use]
    pub fn tick(&mut self, now_ns: BootNs) -> Vec<Act> {
        let mut acts = Vec::new();
        self.step(now_ns, &mut acts);
        // Only of work: a robot that does nothing must not seem to be at what it was sent to do. Nor one that is away.
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

    /// Goes on as far as the robot's state allows.
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

    /// Tells a robot at its dock that it is not to go on by itself. Of Home Assistant's nobody knows whether it has heard.
    fn forget(&mut self, now_ns: BootNs, acts: &mut Vec<Act>) {
        let Some((left, next_ns)) = self.forgets else { return };
        let means_to = self.resumes || self.kind == RobotKind::HomeAssistant;
        // What it is sent to do next takes the place of what it has left.
        if left == 0 || matches!(self.state, State::Ordered { .. } | State::Working { .. }) && !self.is_ending() {
            self.forgets = None;
        } else if means_to && self.status == Some(Status::Docked) && now_ns >= next_ns {
            acts.push(Act::Order(Order::Stop));
            self.forgets = Some((left - 1, now_ns.saturating_add(self.start_ns)));
        }
    }

    /// Begins what is wished for.
    fn start(&mut self, now_ns: BootNs, acts: &mut Vec<Act>) {
        let Some(work) = self.wish.clone() else { return };
        let is_new = self.is_new && self.obeys;
        self.is_new &= self.status.is_none();
        match self.status {
            // What it does is known soon after the connection.
            None if self.obeys => {}
            // A driver that was started again finds the robot at what it was sent to do.
            Some(Status::Cleaning) if is_new => self.begin(now_ns, acts),
            Some(Status::Error) => self.end(Kind::Failed, &self.trouble(), acts),
            // Somebody else has sent it out.
            Some(Status::Cleaning | Status::Manual) => self.order(Order::Stop, now_ns, acts),
            _ => match self.segment(&work.room) {
                Ok(segment) => self.order(Order::Clean { segment, room: work.room }, now_ns, acts),
                // What segments there are is known soon after the connection.
                Err(_)
                    if self.segments.as_ref().is_none_or(BTreeMap::is_empty)
                        && now_ns.since(work.asked_ns) < self.start_ns => {}
                Err(why) => self.end(Kind::Blocked, &why, acts),
            },
        }
    }

    /// What is wrong, in words.
    fn trouble(&self) -> String {
        let fault = if self.fault.is_empty() { "it does not say which" } else { &self.fault };
        format!("the robot has an error: {fault}")
    }

    /// The robot has told its state. One that begins what it is to end is told again at once: it may not have heard it at its dock.
    fn look_at_change(&mut self, before: Option<Status>, now_ns: BootNs, acts: &mut Vec<Act>) {
        let State::Ordered { order, since_ns, tries, differed } = self.state.clone() else { return };
        let begins = self.status == Some(Status::Cleaning) && before != self.status;
        let again = self.is_ending() && begins;
        if again {
            acts.push(Act::Order(order.clone()));
        }
        // One of which nothing was known has heard none of those before.
        let told = if before.is_none() { 1 } else { tries.saturating_add(1) };
        let (since_ns, tries) = if again { (now_ns, told) } else { (since_ns, tries) };
        let differed = differed || !self.is_as_ordered(&order);
        self.state = State::Ordered { order, since_ns, tries, differed };
    }

    /// Whether the robot's state is what an order leads to.
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
        // A state that was so before the order is no answer: a robot at its dock may be about to leave it. One that stays so is told again,
        // and then taken for one that has nothing to end.
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
            // What it hears late is not to be begun, also where it hears it when it is back.
            return if self.status.is_some() {
                acts.push(Act::Order(Order::Stop));
            } else {
                self.order(Order::Stop, now_ns, acts);
            };
        }
        // A robot that stands need not go home before it goes to work.
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

    /// Why an order is not followed, in words.
    fn why_not_followed(&self, cleans: bool) -> &'static str {
        match (self.connected, self.status) {
            (false, _) => "the broker is away",
            (true, None) => "the robot is not connected",
            (true, Some(_)) if cleans => "the robot does not do what it is told",
            (true, Some(_)) => "the robot does not stop when it is told to",
        }
    }

    /// The robot is at work.
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

    /// The work is over, one way or the other.
    fn end(&mut self, kind: Kind, why: &str, acts: &mut Vec<Act>) {
        let had_begun = matches!(self.state, State::Working { .. });
        self.report(kind, why, acts);
        self.outcome = self.wish.take().map(|work| Report { room: Some(work.room), ..note(kind, why) });
        self.state = State::Free;
        // That it came to its dock was not told while it counted as at work. A robot that never left it does not come there.
        if had_begun && self.status == Some(Status::Docked) {
            self.say(Report { battery: self.battery, ..Report::new(Kind::Docked) }, acts);
        }
    }

    /// Reports what became of the work in hand.
    fn report(&self, kind: Kind, why: &str, acts: &mut Vec<Act>) {
        let Some(work) = &self.wish else { return };
        let report = Report { room: Some(work.room.clone()), decision: Some(work.decision), ..note(kind, why) };
        self.say(Report { battery: self.battery, ..report }, acts);
    }

    /// Whoever only says what it would do has no say in what is done.
    fn say(&self, report: Report, acts: &mut Vec<Act>) {
        if self.obeys {
            acts.push(Act::Report(report));
        }
    }
}

/// A report with its reason, cut to fit.
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
