//! The learned part of a person's forecast, as data: for `habits show`, for `explain`, and for metrics.

use std::fmt;

use roomcast_core::habits::Shares;
use roomcast_core::ids::PersonId;
use roomcast_core::text::count;
use serde::{Deserialize, Serialize};

/// The name of elsewhere among the places of a set.
pub const ELSEWHERE: &str = "elsewhere";

/// The shares of the sources of a forecast at a horizon. They sum to one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HorizonLine {
    /// The horizon, in seconds.
    pub horizon_s: f64,
    /// The forecast without habits.
    pub shipped: f64,
    /// The length of stays, and the next place.
    pub leaving: f64,
    /// The place at this horizon after similar times before.
    pub later: f64,
    /// The smallest set of places with the promised coverage in the long run: ids of rooms, and [`ELSEWHERE`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub set: Vec<String>,
    /// This forecast's probability of the set; `None` if unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub set_probability: Option<f64>,
}

/// A possible next thing, and the sources of its probability.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ThingReason {
    /// Its label.
    pub label: String,
    /// The shares of the sources.
    #[serde(flatten)]
    pub shares: Shares,
}

/// A possible room of the next thing, and the sources of its probability.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RoomReason {
    /// Its id.
    pub room: String,
    /// The shares of the sources.
    #[serde(flatten)]
    pub shares: Shares,
}

/// The learned part of a person's present forecast.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PersonHabits {
    /// The person.
    pub person: PersonId,
    /// Observations that were learned from.
    pub observations: f64,
    /// The likeliest next things, the likeliest first.
    pub things: Vec<ThingReason>,
    /// The likeliest rooms of the next thing, the likeliest first.
    pub rooms: Vec<RoomReason>,
    /// The shares of the forecast at each horizon.
    pub forecast: Vec<HorizonLine>,
    /// The promised coverage of the sets, 0 to 1.
    #[serde(default)]
    pub coverage: f64,
}

/// Most things and rooms in a text.
const SHOWN: usize = 5;

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

fn ahead(seconds: f64) -> String {
    match seconds {
        s if s >= 3_600.0 => format!("{:.0} h", s / 3_600.0),
        s if s >= 60.0 => format!("{:.0} min", s / 60.0),
        s => format!("{s:.0} s"),
    }
}

/// "from 40 observations: 30 after the last object, 12 after the last two, 0 after the last three". The forecast of a room has no count after the last
/// object; recordings of earlier versions have one.
fn from(observations: &[f64], place: &str) -> String {
    let (all, after) = observations.split_first().unwrap_or((&0.0, &[]));
    let names = ["object", "two", "three"];
    let names = names.iter().skip(names.len().saturating_sub(after.len()));
    let after: Vec<_> = after.iter().zip(names).map(|(own, name)| format!("{own:.0} after the last {name}")).collect();
    format!("from {}{place}: {}", count(all.round() as usize, "observation"), after.join(", "))
}

/// The name of habit's part. Without an observation it is the prior: repetition, and the habits of other persons of the home.
fn habit(observations: &[f64]) -> &'static str {
    if observations.iter().all(|count| *count < 0.5) { "what habit begins with" } else { "habit" }
}

/// Writes the likeliest things or rooms under a title.
fn write_shares<'a>(
    f: &mut fmt::Formatter<'_>,
    title: &str,
    reasons: impl Iterator<Item = (&'a String, &'a Shares)>,
) -> fmt::Result {
    for (at, (name, Shares { probability, model, habit, things, hour, observations })) in
        reasons.take(SHOWN).enumerate()
    {
        if at == 0 {
            writeln!(f, "{title}")?;
        }
        let (p, model, name_of_habit) = (percent(*probability), percent(*model), self::habit(observations));
        write!(f, "    {name} {p}: language model {model}, {name_of_habit} {}, ", percent(*habit))?;
        things.iter().try_for_each(|things| write!(f, "the next thing {}, ", percent(*things)))?;
        let place = if things.is_some() { " in this room" } else { "" };
        writeln!(f, "hour {}; {}", percent(*hour), from(observations, place))?;
    }
    Ok(())
}

impl PersonHabits {
    /// Writes the places of a set to the end of the line. The coverage of the set holds only in the long run.
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
        let things = self.things.iter().map(|ThingReason { label, shares }| (label, shares));
        write_shares(f, "  Next thing:", things)?;
        write_shares(f, "  Its room:", self.rooms.iter().map(|RoomReason { room, shares }| (room, shares)))?;
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
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_says_where_a_probability_comes_from_and_from_how_much() {
        let observations = vec![40.0, 12.0, 3.0, 0.0];
        let shares = Shares { probability: 0.5, model: 0.25, habit: 0.5, things: None, hour: 0.25, observations };
        let of_room = Shares { things: Some(0.25), observations: vec![9.0, 2.0, 1.0], ..shares.clone() };
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
            things: vec![ThingReason { label: "mug".to_owned(), shares: shares.clone() }],
            rooms: vec![RoomReason { room: "hall".to_owned(), shares: of_room }],
            forecast: vec![line],
            coverage: 0.9,
        };
        let text = learned.to_string();
        for part in [
            "from 41 observations",
            "mug 50 %: language model 25 %, habit 50 %, hour 25 %; from 40 observations: 12 after the last object, ",
            "from 9 observations in this room: 2 after the last two, 1 after the last three\n",
            "In 15 min: forecast without habits 25 %",
            "; set for 90 % on the long run, 45 % by this forecast: kitchen, elsewhere",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        // At the first observation nothing that follows is learned; the chance of a repetition is the initial habit.
        let young = Shares { habit: 0.98, observations: vec![0.0; 4], ..shares };
        let things = vec![ThingReason { label: "mug".to_owned(), shares: young }];
        let young = PersonHabits { things, rooms: Vec::new(), ..learned.clone() };
        assert!(
            young.to_string().contains(", what habit begins with 98 %, ") && !young.to_string().contains(", habit ")
        );
        // An earlier recording does not contain the probability of the set.
        let mut older = learned.clone();
        older.forecast[0].set_probability = None;
        assert!(older.to_string().contains("; set for 90 % on the long run: kitchen, elsewhere"));
        let json = serde_json::to_string(&learned).unwrap();
        assert_eq!(serde_json::from_str::<PersonHabits>(&json).unwrap(), learned);
    }
}
