//! The newest messages of the services, and the JSON messages that are published from them: for the home and for each room, person and robot.

use std::collections::{BTreeMap, BTreeSet};

use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, PersonForecastV1, PersonForecastsV1, RobotReportV1, RoomScoresV1, StatusResponseV1,
    decision_flags, forecast_flags, person_flags, presence,
};
use roomcast_ipc::{Action, Presence, sequence};
use serde_json::{Value, json};

use super::discovery::Discovery;
use super::names::{AWAY, Named, of_person, of_robot, of_room, unnamed_person, unnamed_robot};
use super::outbox::Picture;
use crate::flags::{decision_flag_names, forecast_flag_names};
use crate::robot_place::{Place, Places};
use roomcast_services::config::BridgeConfig;
use roomcast_services::narrator::Who;
use roomcast_services::participant::PLANNER;
use roomcast_services::planner::Planner;
use roomcast_services::slug::room_name;

/// Most robots: the configured one, and as many as `roomcast-zenoh` follows. If there are more, the one with the oldest decision is dropped.
pub(super) const ROBOTS_MAX: usize = 16;

/// The value of an availability topic.
pub(super) const ONLINE: &str = "online";
/// Its value when the bridge or the daemon is gone.
pub(super) const OFFLINE: &str = "offline";

#[derive(Debug, Default)]
pub(super) struct Known {
    scores: Option<Box<RoomScoresV1>>,
    forecast: Option<Box<ForecastV1>>,
    persons: Option<Box<PersonForecastsV1>>,
    decisions: BTreeMap<u64, DecisionV1>,
    /// The robots with planners in this domain.
    planners: BTreeSet<u64>,
    status: Option<StatusResponseV1>,
    /// When the last known event was narrated, in seconds of the wall clock.
    narrated_unix_s: Option<u64>,
    /// Rooms in which a person is expected soon, with hysteresis.
    soon: BTreeMap<String, bool>,
    /// A robot has decided for the first time.
    new_robot: bool,
    places: Places,
    /// By person: the observation with the largest effect on the belief about the place.
    reasons: BTreeMap<u32, String>,
    /// Judges which rooms may be cleaned now, by the rules of the house.
    advisor: Option<Planner>,
    /// By room: the reason if this is no good time, else `None`.
    advice: BTreeMap<String, Option<String>>,
}

impl Known {
    /// Adds a planner that knows the rules of the house but decides nothing.
    pub(super) fn with_advisor(mut self, advisor: Planner) -> Self {
        self.advisor = Some(advisor);
        self
    }

    pub(super) fn persons_known(&self) -> Vec<u32> {
        self.persons().map(|(_, person)| person.person).collect()
    }

    /// Each person's part of topics, and how a narrator names the person.
    pub(super) fn correctable(&self) -> Vec<(String, Who)> {
        let persons = self.persons().map(|(_, person)| person);
        let who = |person: &PersonForecastV1| match person.name() {
            "" => person.person.to_string().parse(),
            name => name.parse(),
        };
        persons.filter_map(|person| Some((of_person(person.person, person.name()), who(person).ok()?))).collect()
    }

    pub(super) fn take_reasons(&mut self, reasons: &BTreeMap<u32, String>) {
        self.reasons.clone_from(reasons);
    }

    pub(super) fn advise(&mut self, now_ns: BootNs, unix_ns: UnixNs, own: &str) {
        let Some(advisor) = &mut self.advisor else { return };
        if let (Some(scores), Some(forecast), Some(persons)) = (&self.scores, &self.forecast, &self.persons) {
            // A message that is dated ahead comes from another boot. Then there is no advice.
            let taken = [
                advisor.take(scores, now_ns).is_ok(),
                advisor.take_forecast(forecast, now_ns).is_ok(),
                advisor.take_persons(persons, now_ns).is_ok(),
            ];
            self.advice = if taken == [true; 3] { advisor.advise(now_ns, unix_ns) } else { BTreeMap::new() };
        }
        let held = self.decisions.get(&sequence::source_of_name(own)).filter(|decision| {
            let until = decision.held_until_unix_ns;
            decision.has(decision_flags::HELD) && (until == 0 || until > unix_ns.0)
        });
        if held.is_some() {
            self.advice.values_mut().for_each(|reason| *reason = Some("On hold.".to_owned()));
        }
    }

    /// The robots with their names for topics and people, including the configured one, `own`.
    pub(super) fn robots(&self, own: &str) -> Vec<Named> {
        let number = sequence::source_of_name(own);
        let others =
            self.decisions.values().filter(|decision| decision.robot != number && !decision.robot_name().is_empty());
        let named = |name: &str| Named { part: of_robot(0, Some(name)), name: name.to_owned() };
        others.map(|decision| named(decision.robot_name())).chain([named(own)]).collect()
    }

    pub(super) fn rooms(&self) -> Vec<String> {
        self.scores.iter().flat_map(|scores| scores.rooms()).map(|room| room.id().to_owned()).collect()
    }

    /// The rooms' ids with their names for people.
    pub(super) fn named_rooms(&self) -> Vec<(String, String)> {
        let rooms = self.rooms();
        rooms.iter().map(|room| (room.clone(), name_in(&rooms, room))).collect()
    }

    /// When any robot last cleaned a room, in Unix seconds.
    fn cleaned_unix_s(&self, id: &str) -> Option<u64> {
        let room = self.scores.as_ref()?.rooms().iter().position(|room| room.id() == id)?;
        self.decisions.values().filter_map(|decision| decision.cleaned_unix_s(room)).max()
    }

    pub(super) fn take_report(&mut self, report: &RobotReportV1) {
        self.places.take(report, self.decisions.get(&report.robot));
    }

    pub(super) fn take_scores(&mut self, scores: &RoomScoresV1) {
        if scores.observed_ns > 0 {
            let before_ns = scores.computed_ns.saturating_sub(scores.observed_ns);
            self.narrated_unix_s = Some(scores.computed_unix_ns.saturating_sub(before_ns) / 1_000_000_000);
        }
        self.scores = Some(Box::new(*scores));
    }

    pub(super) fn take_forecast(&mut self, forecast: &ForecastV1) {
        self.forecast = Some(Box::new(*forecast));
    }

    pub(super) fn take_persons(&mut self, persons: &PersonForecastsV1) {
        self.persons = Some(Box::new(*persons));
    }

    /// Handles a decision. The configured robot, `own`, is never dropped. Repetitions by a bridge are ignored if the robot's planner is in this
    /// domain: they may report the robot as gone.
    pub(super) fn take_decision(&mut self, decision: &DecisionV1, own: &str) {
        let own = sequence::source_of_name(own);
        let is_here = decision.robot == own || self.planners.contains(&decision.robot);
        if is_here && decision.has(decision_flags::ELSEWHERE) {
            return;
        }
        let before = self.decisions.insert(decision.robot, *decision);
        self.new_robot |= before.is_none();
        if self.decisions.len() > ROBOTS_MAX
            && let others = self.decisions.values().filter(|decision| decision.robot != own)
            && let Some(oldest) = others.min_by_key(|decision| decision.decided_ns).map(|decision| decision.robot)
        {
            self.decisions.remove(&oldest);
        }
    }

    /// Whether a robot has decided for the first time since the last call: its planner must be found before it can end.
    pub(super) fn take_new_robot(&mut self) -> bool {
        std::mem::take(&mut self.new_robot)
    }

    /// Handles the domain's participants: a robot is dropped when its planner ends. The configured robot, `own`, stays, and so does a robot whose
    /// planner was never in this domain.
    pub(super) fn take_planners(&mut self, participants: &[String], own: &str) {
        let planners = participants.iter().filter_map(|participant| PLANNER.robot_of(participant)).collect();
        let before = std::mem::replace(&mut self.planners, planners);
        let own = sequence::source_of_name(own);
        let gone = before.into_iter().filter(|robot| *robot != own && !self.planners.contains(robot));
        gone.for_each(|robot| _ = self.decisions.remove(&robot));
    }

    pub(super) fn take_status(&mut self, status: Option<StatusResponseV1>) {
        self.status = status.or(self.status);
    }

    /// Nanoseconds since the daemon's last sign of life; `None` before the first one.
    pub(super) fn silence_ns(&self, now_ns: BootNs) -> Option<u64> {
        self.scores.as_ref().map(|scores| scores.silence_ns(now_ns.0))
    }

    /// Whether all rooms and persons are known, so that other topics of an earlier run may be removed.
    pub(super) fn is_complete(&self) -> bool {
        self.scores.is_some() && self.forecast.is_some() && self.persons.is_some()
    }

    /// All retained messages. `robot` is the configured robot's name.
    pub(super) fn picture(&mut self, config: &BridgeConfig, robot: &str, alive: bool) -> Picture {
        let base = &config.topic;
        let mut picture = Picture::new();
        let mut put = |topic: String, value: &Value| picture.insert(format!("{base}/{topic}"), value.to_string());
        put("health".to_owned(), &self.health(alive));
        // Home Assistant warns about an invalid time, so an unknown one is not published.
        if let Some(seconds) = self.narrated_unix_s {
            put("narrated".to_owned(), &seconds.into());
        }
        let rooms = self.rooms();
        self.soon.retain(|room, _| rooms.contains(room));
        if self.is_complete() {
            put("home".to_owned(), &self.home());
        }
        for id in &rooms {
            let message = self.room(id, config);
            put(format!("rooms/{}", of_room(id)), &message);
        }
        let named =
            |person: &PersonForecastV1| Named { part: of_person(person.person, person.name()), name: name_of(person) };
        let persons: Vec<Named> = self.persons().map(|(_, person)| named(person)).collect();
        for ((all, person), Named { part, .. }) in self.persons().zip(&persons) {
            let mut told = person_message(all, person, config);
            told["why"] = self.reasons.get(&person.person).map(String::as_str).into();
            put(format!("persons/{part}"), &told);
        }
        let own = sequence::source_of_name(robot);
        let named = |number: u64, told: &str| {
            let known = if number == own { robot } else { told };
            let known = Some(known).filter(|known| !known.is_empty());
            let name = known.map_or_else(|| unnamed_robot(number), str::to_owned);
            Named { part: of_robot(number, known), name }
        };
        let mut robots: Vec<Named> =
            self.decisions.values().map(|decision| named(decision.robot, decision.robot_name())).collect();
        for (decision, Named { part, name }) in self.decisions.values().zip(&robots) {
            let place = self.places.of(decision.robot);
            put(format!("robots/{part}"), &decision_message(decision, name, &rooms, &place));
        }
        // The configured robot has a topic before its first decision and while its planner is away.
        if !self.decisions.contains_key(&own) {
            robots.push(named(own, robot));
        }
        picture.insert(format!("{base}/status"), ONLINE.to_owned());
        picture.insert(format!("{base}/daemon"), if alive { ONLINE } else { OFFLINE }.to_owned());
        if !config.discovery.is_empty() {
            let mut discovery = Discovery::new(config, self.map());
            discovery.home(self.narrated_unix_s.is_some());
            let is_cleaned = |room: &str| self.cleaned_unix_s(room).is_some();
            rooms.iter().for_each(|room| discovery.room(room, &name_in(&rooms, room), is_cleaned(room)));
            let shown = self.named_rooms();
            discovery.orders(&named(own, robot), &shown);
            persons.iter().for_each(|person| discovery.person(person, &shown));
            robots.iter().for_each(|robot| discovery.robot(robot));
            picture.extend(discovery.messages());
        }
        picture
    }

    fn map(&self) -> &str {
        self.status.as_ref().map_or("", |status| status.map())
    }

    fn persons(&self) -> impl Iterator<Item = (&PersonForecastsV1, &PersonForecastV1)> {
        self.persons.iter().flat_map(|all| all.persons().iter().map(move |person| (&**all, person)))
    }

    fn health(&self, alive: bool) -> Value {
        let flags = self.forecast.as_ref().map(|forecast| forecast_flag_names(forecast.flags));
        let mut health = json!({ "daemon": alive, "narrated_unix_s": self.narrated_unix_s, "forecast": flags });
        if let (Some(status), Some(health)) = (&self.status, health.as_object_mut()) {
            // The daemon's counters are unchecked.
            let refused = [status.malformed, status.limited, status.forged, status.costly];
            let refused = refused.into_iter().fold(0, u64::saturating_add);
            let more = json!({
                "version": status.version(),
                "map": status.map(),
                "model": status.model(),
                "started_unix_s": status.started_unix_ns / 1_000_000_000,
                "narrations": status.accepted,
                "refused": refused,
                "from_fast_clock": status.ahead,
                "clock_ahead_s": status.ahead_ns as f64 / 1e9,
                "failed_steps": status.failed_steps,
                "journal_failures": status.journal_failures,
                "narrators": status.sources,
                "persons": status.persons,
            });
            health.extend(more.as_object().into_iter().flatten().map(|(key, value)| (key.clone(), value.clone())));
        }
        health
    }

    fn home(&self) -> Value {
        let has = |flag| self.forecast.as_ref().is_some_and(|forecast| forecast.has(flag));
        let somebody = if has(forecast_flags::NOBODY_HOME) {
            Some(false)
        } else {
            (!has(forecast_flags::NOT_KNOWN)).then_some(true)
        };
        let persons = self.persons.as_ref().map_or(0, |all| all.persons);
        json!({ "somebody": somebody, "persons": persons })
    }

    fn room(&mut self, id: &str, config: &BridgeConfig) -> Value {
        let scores = self.scores.as_ref().and_then(|scores| scores.rooms().iter().find(|room| room.id() == id));
        let next = scores.map(|room| share(room.probability));
        let forecast = self.forecast.as_ref().filter(|forecast| !forecast.has(forecast_flags::NOT_KNOWN));
        let row = forecast.and_then(|forecast| {
            (0..).map_while(|index| forecast.room(index)).find(|(other, _)| *other == id).map(|(_, row)| row)
        });
        let horizons = forecast.map_or(&[][..], |forecast| &forecast.horizon_s);
        let at = |seconds: f64| row.and_then(|row| row.get(nearest(horizons, row.len(), seconds)?).copied());
        let ahead: BTreeMap<String, Option<f64>> =
            config.horizons_s.iter().map(|s| (s.to_string(), at(*s).map(f64::from).map(share))).collect();
        let within = row.into_iter().flatten().zip(horizons).filter(|(_, s)| f64::from(**s) <= config.soon_s);
        let most = within.map(|(p, _)| f64::from(*p)).reduce(f64::max);
        let before = self.soon.get(id).copied().unwrap_or(false);
        let soon = most.map(|most| most >= config.soon_at || before && most >= config.soon_until);
        self.soon.insert(id.to_owned(), soon.unwrap_or(false));
        let rooms = self.scores.iter().flat_map(|scores| scores.rooms()).map(|room| room.id());
        let name = room_name(id, rooms);
        let advice = self.advice.get(id);
        json!({
            "room": id, "name": name, "next": next, "now": at(0.0).map(f64::from).map(share), "at": ahead, "soon": soon,
            "good": advice.map(Option::is_none), "reason": advice.cloned().flatten(), "cleaned_unix_s": self.cleaned_unix_s(id),
        })
    }
}

/// A probability to the percent, so that smaller changes are not published.
fn share(probability: f64) -> f64 {
    (probability * 100.0).round() / 100.0
}

/// The horizon that is nearest to a time ahead.
fn nearest(horizons: &[f32], count: usize, seconds: f64) -> Option<usize> {
    let apart = |index: &usize| (f64::from(horizons.get(*index).copied().unwrap_or(f32::MAX)) - seconds).abs();
    (0..count.min(horizons.len())).min_by(|a, b| apart(a).total_cmp(&apart(b)))
}

/// The person's name, else the number.
fn name_of(person: &PersonForecastV1) -> String {
    match person.name() {
        "" => unnamed_person(person.person),
        name => name.to_owned(),
    }
}

/// A person's place at a horizon: the likeliest room, or "away". Null if it is unknown.
fn likely(all: &PersonForecastsV1, person: &PersonForecastV1, horizon: usize) -> Value {
    let elsewhere = person.elsewhere.get(horizon).copied().map_or(0.0, f64::from);
    let chance = |row: &[f32; roomcast_ipc::raw::MAX_HORIZONS]| row.get(horizon).copied().map_or(0.0, f64::from);
    let rooms = all.rooms().zip(person.probability.iter().map(chance));
    let best = rooms.reduce(|best, room| if room.1 > best.1 { room } else { best });
    let (place, probability) = match best {
        _ if person.presence == presence::UNKNOWN => (None, None),
        Some((room, probability)) if probability > elsewhere => (Some(room), Some(share(probability))),
        _ => (Some(AWAY), Some(share(elsewhere))),
    };
    let name = place.map(|place| if place == AWAY { AWAY.to_owned() } else { room_name(place, all.rooms()) });
    let mut told =
        json!({ "likely": place, "likely_name": name, "probability": probability, "away": share(elsewhere) });
    if let (Some(set), Some(told)) = (room_set(all, person, horizon), told.as_object_mut()) {
        told.insert("set".to_owned(), set);
    }
    told
}

/// The smallest set of rooms with the promised coverage; `None` if the daemon computes none.
fn room_set(all: &PersonForecastsV1, person: &PersonForecastV1, horizon: usize) -> Option<Value> {
    let held = |room: usize| person.set_holds(horizon, room);
    held(0)?;
    let rooms: Vec<&str> =
        (0..).zip(all.rooms()).filter(|(room, _)| held(*room) == Some(true)).map(|(_, id)| id).collect();
    let away = person.set_elsewhere >> horizon & 1 == 1;
    Some(json!({ "coverage": share(f64::from(person.set_coverage)), "rooms": rooms, "away": away }))
}

fn person_message(all: &PersonForecastsV1, person: &PersonForecastV1, config: &BridgeConfig) -> Value {
    let horizons = all.horizons_s();
    let at = |seconds: f64| nearest(horizons, horizons.len(), seconds).map(|horizon| likely(all, person, horizon));
    let ahead: BTreeMap<String, Option<Value>> = config.horizons_s.iter().map(|s| (s.to_string(), at(*s))).collect();
    let flag = |flag: u32| person.flags & flag != 0;
    let mut told = json!({
        "person": name_of(person),
        "presence": Presence::of(person.presence).word(),
        "asleep": flag(person_flags::ASLEEP),
        "visitor": flag(person_flags::VISITOR),
        "at": ahead,
    });
    if let (Some(Value::Object(now)), Some(told)) = (at(0.0), told.as_object_mut()) {
        told.extend(now);
    }
    told
}

fn name_in(rooms: &[String], id: &str) -> String {
    room_name(id, rooms.iter().map(String::as_str))
}

fn decision_message(decision: &DecisionV1, robot: &str, rooms: &[String], at: &Place) -> Value {
    let action = Action::of(decision.action).word();
    let flags = decision_flag_names(decision.flags);
    let place = |id: &str| (!id.is_empty()).then(|| id.to_owned());
    json!({
        "robot": robot,
        "action": action,
        "room": place(decision.to()),
        "room_name": place(decision.to()).map(|id| name_in(rooms, &id)),
        "from": place(decision.from()),
        "at": at.room(),
        "place": at.words(|id| name_in(rooms, id)),
        "reason": decision.reason(),
        "held_until_unix_s": (decision.held_until_unix_ns > 0).then_some(decision.held_until_unix_ns / 1_000_000_000),
        "probability": share(decision.probability),
        "policy": decision.policy(),
        "flags": flags,
        "decision": decision.sequence,
        "decided_unix_s": decision.decided_unix_ns / 1_000_000_000,
    })
}
