//! The newest messages, and the page's state from them.

use std::collections::{BTreeMap, VecDeque};

use roomcast_core::ids::PersonId;
use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, MAX_HORIZONS, NarrationV1, PersonForecastsV1, PersonScoresV1, PersonV1, RobotReportV1,
    RoomScoresV1, RoomV1, action, presence,
};
use roomcast_ipc::{ItemScores, Presence};
use roomcast_services::daemon::flag_words;
use roomcast_services::message_text::event_of;
use roomcast_services::recording::Recorded;
use serde_json::{Value, json};

use super::plan::Plan;
use super::quality::{Quality, likeliest, short};
use crate::decided::{Decided, News};
use crate::flags::{decision_flag_names, forecast_flag_names, plain, score_flag_names};
use crate::robot_place::Places;
use crate::top::who;

const NARRATIONS: usize = 50;
/// Stays of the robot on the page.
const STAYS: usize = 8;
/// Silence after which the daemon counts as gone, in nanoseconds: some heartbeats.
const SILENCE_NS: u64 = 1_500_000_000;

fn row(row: &[f32]) -> Vec<f64> {
    row.iter().map(|p| short(f64::from(*p))).collect()
}

fn seconds_between(then_ns: u64, now_ns: u64) -> f64 {
    now_ns.saturating_sub(then_ns) as f64 / 1e9
}

/// The newest messages.
#[derive(Debug, Default)]
pub(super) struct Picture {
    pub(super) scores: Option<(RoomScoresV1, u64)>,
    pub(super) forecast: Option<Box<ForecastV1>>,
    pub(super) persons: Option<Box<PersonScoresV1>>,
    forecasts: Option<Box<PersonForecastsV1>>,
    pub(super) decision: Option<(DecisionV1, u64)>,
    /// The robot that is shown without its name: the configured one, or the first of a recording.
    robot: Option<u64>,
    /// Others are shown only before its first decision.
    is_configured: bool,
    decided: Decided,
    /// The last stays of the shown robot: beginning, room, and whether it works there.
    stays: VecDeque<(u64, String, bool)>,
    places: Places,
    /// The newest first: time, source, text.
    narration: VecDeque<(u64, String, String)>,
    items: BTreeMap<String, f64>,
    quality: Quality,
    /// By person: the observation with the largest effect on the belief.
    pub(super) reasons: BTreeMap<u32, String>,
}

impl Picture {
    /// A picture of a configured robot; `None` takes the first robot of a recording.
    pub(super) fn of_robot(robot: Option<u64>) -> Self {
        Self { robot, is_configured: robot.is_some(), ..Self::default() }
    }

    pub(super) fn take(&mut self, message: &Recorded, taken_ns: u64) {
        match message {
            Recorded::Narration(message) => self.narration(message, taken_ns),
            Recorded::RoomScores(message) => self.scores(message, taken_ns),
            Recorded::PersonScores(message) => self.persons(message),
            Recorded::Forecast(message) => self.forecast(message),
            Recorded::PersonForecasts(message) => self.forecasts(message, taken_ns),
            Recorded::Decision(message) => self.decision(message, taken_ns),
            Recorded::RobotReport(message) => self.report(message),
        }
    }

    pub(super) fn scores(&mut self, scores: &RoomScoresV1, taken_ns: u64) {
        self.scores = Some((*scores, taken_ns));
    }

    pub(super) fn forecast(&mut self, forecast: &ForecastV1) {
        self.forecast = Some(Box::new(*forecast));
    }

    pub(super) fn persons(&mut self, persons: &PersonScoresV1) {
        self.persons = Some(Box::new(*persons));
    }

    pub(super) fn forecasts(&mut self, forecasts: &PersonForecastsV1, taken_ns: u64) {
        self.quality.take(forecasts, self.persons.as_deref(), taken_ns);
        self.forecasts = Some(Box::new(*forecasts));
    }

    pub(super) fn report(&mut self, report: &RobotReportV1) {
        self.places.take(report, self.decision.as_ref().map(|(decision, _)| decision));
    }

    pub(super) fn decision(&mut self, decision: &DecisionV1, taken_ns: u64) {
        let own = *self.robot.get_or_insert(decision.robot);
        let is_others = |known: &(DecisionV1, u64)| known.0.robot != own;
        let is_shown = decision.robot == own || !self.is_configured || self.decision.as_ref().is_none_or(is_others);
        if self.decided.take(decision) != News::None && is_shown {
            let works = decision.action == action::GO;
            let is_other = self.decision.as_ref().is_some_and(|(known, _)| known.robot != decision.robot);
            if is_other {
                self.stays.clear();
            }
            // A decision to stay prolongs the stay.
            let is_same = self.stays.back().is_some_and(|(_, room, worked)| room == decision.to() && *worked == works);
            if !is_same && !decision.to().is_empty() {
                self.stays.push_back((taken_ns, decision.to().to_owned(), works));
            }
            if self.stays.len() > STAYS {
                self.stays.pop_front();
            }
            self.decision = Some((*decision, taken_ns));
        }
    }

    pub(super) fn narration(&mut self, narration: &NarrationV1, taken_ns: u64) {
        self.narration.truncate(NARRATIONS - 1);
        // As the model reads it, or the raw text if it is not an observation.
        let event = event_of(narration.kind, narration.text());
        let text = event.map_or_else(|_| narration.text().to_owned(), |event| event.to_string());
        let source = match narration.person_name() {
            "" => narration.source_name().to_owned(),
            name => format!("{name} \u{b7} {}", narration.source_name()),
        };
        self.narration.push_front((taken_ns, source, text));
    }

    pub(super) fn items(&mut self, items: &ItemScores) {
        let mass: f64 = items.items.iter().map(|item| item.log_score_nats.exp()).sum();
        let share = |log_nats: f64| if mass > 0.0 { short(log_nats.exp() / mass) } else { 0.0 };
        let items = items.items.iter().map(|item| (item.id().to_owned(), share(item.log_score_nats)));
        self.items = items.filter(|(_, share)| *share > 0.0).collect();
    }

    /// The fingerprint of the scores' map, hexadecimal.
    pub(super) fn map(&self) -> Option<String> {
        self.scores.as_ref().map(|(scores, _)| hex::encode(scores.map_fingerprint))
    }

    /// Whether the scores have this plan's map and partitions.
    pub(super) fn is_on(&self, plan: &Plan) -> bool {
        let Some((scores, _)) = &self.scores else { return false };
        let rooms = scores.rooms();
        hex::encode(scores.map_fingerprint) == plan.map
            && rooms.len() == plan.names.len()
            && rooms.iter().all(|room| plan.names.contains_key(room.id()))
    }

    pub(super) fn daemon(&self, now_ns: u64) -> Value {
        let Some((scores, _)) = &self.scores else {
            return json!({"alarm": true, "text": "No daemon has been heard yet: start `roomcast daemon`."});
        };
        let silence_ns = scores.silence_ns(now_ns);
        if silence_ns > SILENCE_NS {
            let text =
                format!("The daemon has been silent for {:.0} s: what is shown is old.", silence_ns as f64 / 1e9);
            return json!({"alarm": true, "text": text});
        }
        let flags = score_flag_names(scores.flags & !roomcast_ipc::raw::score_flags::HEARTBEAT);
        let flags: Vec<_> = flags.into_iter().map(plain).collect();
        let flags = if flags.is_empty() { String::new() } else { format!(" ({})", flags.join(", ")) };
        json!({"alarm": false, "text": format!("The daemon is alive{flags}.")})
    }

    pub(super) fn state(&self, now_ns: u64) -> Value {
        let seconds = |then_ns: u64| seconds_between(then_ns, now_ns);
        let scores = self.scores.as_ref().map(|(scores, _)| scores);
        let forecast = self
            .forecast
            .as_deref()
            .filter(|own| scores.is_some_and(|of| (of.epoch, of.room_count) == (own.epoch, own.room_count)));
        let horizons = forecast.map_or(0, |own| (own.horizon_count as usize).min(MAX_HORIZONS));
        let rooms = scores.map_or(&[][..], |scores| scores.rooms()).iter().enumerate().map(|(place, room)| {
            let occupied =
                forecast.and_then(|own| own.room(place)).filter(|(id, _)| *id == room.id()).map(|(_, p)| row(p));
            json!({"id": room.id(), "name": room.id(), "next": short(room.probability), "occupied": occupied})
        });
        let said =
            self.narration.iter().map(|(at_ns, who, text)| json!({"age_s": seconds(*at_ns), "who": who, "text": text}));
        let decision =
            self.decision.as_ref().map(|(decision, taken_ns)| self.decision_card(decision, *taken_ns, now_ns));
        json!({
            "rooms": rooms.collect::<Vec<_>>(),
            "horizons_s": forecast.map_or(&[][..], |own| &own.horizon_s[..horizons]),
            "forecast_flags": forecast.map_or_else(Vec::new, |own| forecast_flag_names(own.flags)),
            "persons": self.person_cards(), "decision": decision, "narration": said.collect::<Vec<_>>(),
            "items": self.items, "quality": self.quality.curve(),
        })
    }

    /// The robot's decision, its last stays, and its remaining rooms.
    fn decision_card(&self, decision: &DecisionV1, taken_ns: u64, now_ns: u64) -> Value {
        let age_s = seconds_between(taken_ns, now_ns);
        let scores = self.scores.as_ref().map(|(scores, _)| scores);
        let robot = match decision.robot_name() {
            name if self.robot != Some(decision.robot) && !name.is_empty() => format!("The robot {name}"),
            _ => "The robot".to_owned(),
        };
        let text = match decision.action {
            action::GO => format!("{robot} goes to {}.", decision.to()),
            action::PAUSE => format!("{robot} pauses where it disturbs nobody."),
            _ if !decision.to().is_empty() && decision.to() != decision.from() => {
                format!("{robot} waits in {}, where nothing is to be done.", decision.to())
            }
            _ => format!("{robot} stays where it is."),
        };
        // The bits refer to the rooms of the scores behind the decision.
        let of = scores.filter(|scores| scores.epoch == decision.scores_epoch);
        let left = of.map(|scores| {
            let rooms = scores.rooms().iter().enumerate();
            rooms.filter(|(room, _)| decision.covered >> room & 1 == 0).map(|(_, room)| room.id()).collect::<Vec<_>>()
        });
        let place = self.places.of(decision.robot);
        let cleaned = of.map(|scores| {
            let rooms = scores.rooms().iter().zip(decision.cleaned_min).filter_map(|(room, minutes)| {
                Some((room.id().to_owned(), f64::from(minutes.checked_sub(1)?) * 60.0 + age_s))
            });
            rooms.collect::<BTreeMap<_, _>>()
        });
        json!({
            "at": place.room(), "place": place.words(str::to_owned), "cleaned_s": cleaned,
            "to": decision.to(), "stays": self.stays(now_ns), "left": left, "text": text, "reason": decision.reason(), "policy": decision.policy(), "age_s": age_s,
            "flags": decision_flag_names(decision.flags),
            "notes": decision_flag_names(decision.flags).into_iter().map(plain).collect::<Vec<_>>(),
        })
    }

    /// The robot's last stays, the newest last: room, seconds since its beginning, and whether the robot works there.
    fn stays(&self, now_ns: u64) -> Vec<Value> {
        let stay = |(at_ns, room, works): &(u64, String, bool)| json!({"room": room, "name": room, "ago_s": seconds_between(*at_ns, now_ns), "works": works});
        self.stays.iter().map(stay).collect()
    }

    fn person_cards(&self) -> Vec<Value> {
        let Some(persons) = self.persons.as_deref() else { return Vec::new() };
        let rooms = self.scores.as_ref().map_or(&[][..], |(scores, _)| scores.rooms());
        // Forecasts refer to rooms by position. While the map changes, the positions are of other rooms.
        let is_of_these = |own: &&PersonForecastsV1| own.rooms().eq(rooms.iter().map(RoomV1::id));
        let forecasts = self.forecasts.as_deref().filter(|own| own.epoch == persons.epoch).filter(is_of_these);
        let card = |person: &PersonV1| {
            let own =
                forecasts.and_then(|told| Some((told, told.persons().iter().find(|own| own.person == person.person)?)));
            let mut card = json!({
                "name": who(PersonId(person.person), person.name()), "presence": Presence::of(person.presence).word(),
                "flags": flag_words(person.flags).collect::<Vec<_>>(),
                "notes": flag_words(person.flags).map(plain).collect::<Vec<_>>(),
                "why": self.reasons.get(&person.person),
            });
            if let Some((told, own)) = own {
                let horizons = told.horizons_s().len();
                let rooms =
                    (0..told.rooms().len()).filter_map(|room| own.probability.get(room)?.get(..horizons).map(row));
                card["rooms"] = rooms.collect::<Vec<_>>().into();
                if own.set_coverage > 0.0 {
                    let ids: Vec<&str> = told.rooms().collect();
                    let set = |horizon: usize| -> Vec<&str> {
                        let holds = |room: usize| own.set_holds(horizon, room) == Some(true);
                        let out = (own.set_holds_elsewhere(horizon) == Some(true)).then_some("out of the house");
                        ids.iter().enumerate().filter(|(room, _)| holds(*room)).map(|(_, id)| *id).chain(out).collect()
                    };
                    card["sets"] = (0..horizons).map(set).collect::<Vec<_>>().into();
                    let has = (0..horizons).map(|horizon| own.set_probability(horizon).map(short));
                    card["set_has"] = has.collect::<Vec<_>>().into();
                    card["coverage"] = short(f64::from(own.set_coverage)).into();
                }
                card["elsewhere"] = own.elsewhere.get(..horizons).map(row).into();
                let likely = likeliest(told, own).filter(|(_, p)| *p >= 0.5 && person.presence <= presence::PRESENT);
                card["likely"] = likely.map(|(room, _)| room).into();
            }
            card
        };
        persons.persons().iter().map(card).collect()
    }
}
