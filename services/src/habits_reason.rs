//! What of a person's forecast was learned, in words and numbers: for `habits show`, for `explain`, and for metrics. Data alone.

use std::fmt;

use roomcast_core::habits::{RoomShares, Shares};
use roomcast_core::ids::PersonId;
use roomcast_core::text::count;
use roomcast_ipc::{LEARNED_SHARE_S, PersonForecastV1, PersonForecastsV1};
use serde::{Deserialize, Serialize};

/// Elsewhere among the places of a set.
pub const ELSEWHERE: &str = "elsewhere";

/// How much of a forecast comes from where; the shares sum to one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HorizonLine {
    /// How far ahead, in seconds.
    pub horizon_s: f64,
    /// Of the forecast without habits.
    pub shipped: f64,
    /// How long stays last, and where they lead.
    pub leaving: f64,
    /// Where the person was that much later at such times before.
    pub later: f64,
    /// The smallest set of places that holds the person then, with the promised coverage on the long run: ids of rooms, and [`ELSEWHERE`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub set: Vec<String>,
    /// What this forecast gives the places of the set together; none where it is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub set_probability: Option<f64>,
}

/// How much of a forecast that was published was learned, and its set: what a recording has of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PublishedLine {
    /// How far ahead, in seconds.
    pub horizon_s: f64,
    /// The share that was learned of this home.
    pub learned: f64,
    /// As [`HorizonLine::set`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub set: Vec<String>,
    /// As [`HorizonLine::set_probability`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub set_probability: Option<f64>,
}

/// A thing that somebody may turn to next, and why.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ThingReason {
    /// Its words.
    pub label: String,
    /// How much of its probability comes from where.
    #[serde(flatten)]
    pub shares: Shares,
}

/// A room in which the next thing may be, and why.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RoomReason {
    /// Its id.
    pub room: String,
    /// How much of its probability comes from where.
    #[serde(flatten)]
    pub shares: RoomShares,
}

/// What was learned of a person, in the present forecast.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PersonHabits {
    /// Who.
    pub person: PersonId,
    /// Observations that were learned from.
    pub observations: f64,
    /// The likeliest things to be turned to next, the likeliest first.
    pub things: Vec<ThingReason>,
    /// The rooms in which that may be, the likeliest first.
    pub rooms: Vec<RoomReason>,
    /// Where the person will be: of which forecast how much.
    pub forecast: Vec<HorizonLine>,
    /// The same as far as messages have it, where nothing else is known.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub published: Vec<PublishedLine>,
    /// The coverage that the sets promise, 0 to 1.
    #[serde(default)]
    pub coverage: f64,
}

#[cfg_attr(not(feature = "recording"), allow(dead_code, reason = "only recordings have it"))]
impl PersonHabits {
    /// What a published forecast says of it, of everybody of whom anything was learned.
    #[must_use]
    pub(crate) fn of_published(forecasts: &PersonForecastsV1) -> Vec<Self> {
        let learned = forecasts.persons().iter().filter(|own| own.set_coverage > 0.0 || own.observations > 0.0);
        learned.map(|own| Self::of_person(forecasts, own)).collect()
    }

    fn of_person(forecasts: &PersonForecastsV1, own: &PersonForecastV1) -> Self {
        let published = LEARNED_SHARE_S.into_iter().zip(own.learned_share).map(|(ahead_s, learned)| {
            let (mut set, mut set_probability) = (Vec::new(), None);
            if let Some(horizon) = forecasts.horizons_s().iter().position(|horizon_s| *horizon_s == ahead_s) {
                let rooms = forecasts.rooms().enumerate();
                let held = rooms.filter(|(room, _)| own.set_holds(horizon, *room) == Some(true));
                set.extend(held.map(|(_, id)| id.to_owned()));
                set.extend((own.set_holds_elsewhere(horizon) == Some(true)).then(|| ELSEWHERE.to_owned()));
                set_probability = own.set_probability(horizon);
            }
            PublishedLine { horizon_s: f64::from(ahead_s), learned: f64::from(learned), set, set_probability }
        });
        Self {
            person: PersonId(own.person),
            observations: f64::from(own.observations),
            published: published.collect(),
            coverage: f64::from(own.set_coverage),
            ..Self::default()
        }
    }
}

/// Things and rooms that a text has, at most.
const SHOWN: usize = 5;

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

/// Seconds in the largest unit that they fill.
fn ahead(seconds: f64) -> String {
    match seconds {
        s if s >= 3_600.0 => format!("{:.0} h", s / 3_600.0),
        s if s >= 60.0 => format!("{:.0} min", s / 60.0),
        s => format!("{s:.0} s"),
    }
}

/// "from 40 observations: 30 after the last object, 12 after the last two, 0 after the last three"
fn from(observations: &[f64; 4], place: &str) -> String {
    let [all, one, two, three] = observations;
    let all = count(all.round() as usize, "observation");
    format!(
        "from {all}{place}: {one:.0} after the last object, {two:.0} after the last two, {three:.0} after the last three"
    )
}

/// What habit's part is called. Without an observation it is what habit begins with: that things are turned to again, and what others of the home do.
fn habit(observations: &[f64; 4]) -> &'static str {
    if observations.iter().all(|count| *count < 0.5) { "what habit begins with" } else { "habit" }
}

impl PersonHabits {
    /// The places of a set, to the end of the line. It holds the person as often as it is set for on the long run alone.
    fn write_set(&self, f: &mut fmt::Formatter<'_>, set: &[String], probability: Option<f64>) -> fmt::Result {
        if !set.is_empty() {
            let own = probability.map_or_else(String::new, |p| format!(", {} by this forecast", percent(p)));
            write!(f, "; set for {} on the long run{own}: {}", percent(self.coverage), set.join(", "))?;
        }
        writeln!(f)
    }
}

impl fmt::Display for PersonHabits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let observations = count(self.observations.round() as usize, "observation");
        writeln!(f, "What was learned, from {observations}")?;
        if !self.things.is_empty() {
            writeln!(f, "  Next thing:")?;
        }
        for ThingReason { label, shares } in self.things.iter().take(SHOWN) {
            let Shares { probability, model, habit, hour, observations } = shares;
            writeln!(
                f,
                "    {label} {}: language model {}, {} {}, hour {}; {}",
                percent(*probability),
                percent(*model),
                self::habit(observations),
                percent(*habit),
                percent(*hour),
                from(observations, ""),
            )?;
        }
        if !self.rooms.is_empty() {
            writeln!(f, "  Its room:")?;
        }
        for RoomReason { room, shares } in self.rooms.iter().take(SHOWN) {
            let RoomShares { probability, model, habit, things, hour, observations } = shares;
            writeln!(
                f,
                "    {room} {}: language model {}, {} {}, the next thing {}, hour {}; {}",
                percent(*probability),
                percent(*model),
                self::habit(observations),
                percent(*habit),
                percent(*things),
                percent(*hour),
                from(observations, " in this room"),
            )?;
        }
        for line in &self.forecast {
            write!(
                f,
                "  In {}: forecast without habits {}, leaving {}, such times before {}",
                ahead(line.horizon_s),
                percent(line.shipped),
                percent(line.leaving),
                percent(line.later),
            )?;
            self.write_set(f, &line.set, line.set_probability)?;
        }
        for PublishedLine { horizon_s, learned, set, set_probability } in &self.published {
            write!(f, "  In {}: {} of the forecast was learned", ahead(*horizon_s), percent(*learned))?;
            self.write_set(f, set, *set_probability)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_published_forecast_says_what_of_it_was_learned() {
        let mut forecasts =
            PersonForecastsV1 { room_count: 2, horizon_count: 2, persons: 2, person_count: 2, ..Default::default() };
        (forecasts.horizon_s[0], forecasts.horizon_s[1]) = (60.0, 900.0);
        for (at, id) in ["kitchen", "bedroom"].into_iter().enumerate() {
            forecasts.id[at][..id.len()].copy_from_slice(id.as_bytes());
        }
        // Of the second person nothing was learned.
        let own = &mut forecasts.person[0];
        (own.person, own.set_coverage, own.observations) = (7, 0.9, 41.0);
        (own.room_set[0], own.room_set[1], own.set_elsewhere, own.learned_share) =
            (0b10, 0b01, 0b10, [0.25, 0.5, 0.75]);
        (own.probability[1][0], own.probability[0][1], own.elsewhere[1]) = (0.75, 0.25, 0.125);
        let learned = PersonHabits::of_published(&forecasts);
        assert_eq!(learned.len(), 1);
        assert_eq!(
            learned[0].to_string(),
            "What was learned, from 41 observations\n  \
            In 1 min: 25 % of the forecast was learned; set for 90 % on the long run, 75 % by this forecast: bedroom\n  \
            In 15 min: 50 % of the forecast was learned; set for 90 % on the long run, 38 % by this forecast: kitchen, elsewhere\n  \
            In 1 h: 75 % of the forecast was learned\n"
        );
    }

    #[test]
    fn a_text_says_where_a_probability_comes_from_and_from_how_much() {
        let shares =
            Shares { probability: 0.5, model: 0.25, habit: 0.5, hour: 0.25, observations: [40.0, 12.0, 3.0, 0.0] };
        let line = HorizonLine {
            horizon_s: 900.0,
            shipped: 0.25,
            leaving: 0.25,
            later: 0.5,
            set: vec!["kitchen".to_owned(), ELSEWHERE.to_owned()],
            set_probability: Some(0.45),
        };
        let learned = PersonHabits {
            person: PersonId(1),
            observations: 41.0,
            things: vec![ThingReason { label: "mug".to_owned(), shares }],
            forecast: vec![line],
            coverage: 0.9,
            ..PersonHabits::default()
        };
        let text = learned.to_string();
        for part in [
            "from 41 observations",
            "mug 50 %: language model 25 %, habit 50 %, hour 25 %; from 40 observations: 12 after the last object, ",
            "In 15 min: forecast without habits 25 %",
            "; set for 90 % on the long run, 45 % by this forecast: kitchen, elsewhere",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        // At the first observation nothing was learned of what follows; the chance of a repetition is what habit begins with.
        let young = Shares { habit: 0.98, observations: [0.0; 4], ..shares };
        let young =
            PersonHabits { things: vec![ThingReason { label: "mug".to_owned(), shares: young }], ..learned.clone() };
        assert!(
            young.to_string().contains(", what habit begins with 98 %, ") && !young.to_string().contains(", habit ")
        );
        // A recording of before does not say what the forecast gave the set.
        let mut older = learned.clone();
        older.forecast[0].set_probability = None;
        assert!(older.to_string().contains("; set for 90 % on the long run: kitchen, elsewhere"));
        let json = serde_json::to_string(&learned).unwrap();
        assert_eq!(serde_json::from_str::<PersonHabits>(&json).unwrap(), learned);
    }
}
