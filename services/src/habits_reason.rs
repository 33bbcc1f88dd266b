//! What of a person's forecast was learned, in words and numbers: for `habits show`, for `explain`, and for metrics. Data alone.

use std::fmt;

use roomcast_core::habits::{RoomShares, Shares};
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
    /// That the person is still, or again, in the same place.
    pub persistence: f64,
    /// The hazard of leaving, and where to.
    pub leaving: f64,
    /// Where the person was that much later at such times before.
    pub later: f64,
    /// The smallest set of places that holds the person then, with the promised coverage: ids of rooms, and [`ELSEWHERE`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub set: Vec<String>,
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
    pub person: u32,
    /// Observations that were learned from; older ones count less.
    pub observations: f64,
    /// The likeliest things to be turned to next, the likeliest first.
    pub things: Vec<ThingReason>,
    /// The rooms in which that may be, the likeliest first.
    pub rooms: Vec<RoomReason>,
    /// Where the person will be: of which forecast how much.
    pub forecast: Vec<HorizonLine>,
    /// The coverage that the sets promise, 0 to 1.
    #[serde(default)]
    pub coverage: f64,
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

/// "from 40 (30 after the last thing, 12 after the last two, 0 after the last three)"
fn from(observations: &[f64; 4], first: &str) -> String {
    let [all, one, two, three] = observations;
    format!("from {all:.0} {first}, {one:.0} after the last thing, {two:.0} after two, {three:.0} after three")
}

impl fmt::Display for PersonHabits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "What was learned, from {:.0} observations", self.observations)?;
        if !self.things.is_empty() {
            writeln!(f, "  Next thing:")?;
        }
        for ThingReason { label, shares } in self.things.iter().take(SHOWN) {
            let Shares { probability, model, habit, recency, hour, staying, observations } = shares;
            writeln!(
                f,
                "    {label} {}: language model {}, habit {}, recency {}, hour {}, staying {}; {}",
                percent(*probability),
                percent(*model),
                percent(*habit),
                percent(*recency),
                percent(*hour),
                percent(*staying),
                from(observations, "at all"),
            )?;
        }
        if !self.rooms.is_empty() {
            writeln!(f, "  Its room:")?;
        }
        for RoomReason { room, shares } in self.rooms.iter().take(SHOWN) {
            let RoomShares { probability, model, habit, things, hour, staying, observations } = shares;
            writeln!(
                f,
                "    {room} {}: language model {}, habit {}, the next thing {}, hour {}, staying {}; {}",
                percent(*probability),
                percent(*model),
                percent(*habit),
                percent(*things),
                percent(*hour),
                percent(*staying),
                from(observations, "in this room"),
            )?;
        }
        for line in &self.forecast {
            write!(
                f,
                "  In {}: forecast without habits {}, staying {}, leaving {}, such times before {}",
                ahead(line.horizon_s),
                percent(line.shipped),
                percent(line.persistence),
                percent(line.leaving),
                percent(line.later),
            )?;
            if !line.set.is_empty() {
                write!(f, "; {} sure: {}", percent(self.coverage), line.set.join(", "))?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_says_where_a_probability_comes_from_and_from_how_much() {
        let shares = Shares {
            probability: 0.5,
            model: 0.25,
            habit: 0.5,
            recency: 0.125,
            hour: 0.125,
            staying: 0.0,
            observations: [40.0, 12.0, 3.0, 0.0],
        };
        let line = HorizonLine {
            horizon_s: 900.0,
            shipped: 0.25,
            persistence: 0.25,
            leaving: 0.25,
            later: 0.25,
            set: vec!["kitchen".to_owned(), ELSEWHERE.to_owned()],
        };
        let learned = PersonHabits {
            person: 1,
            observations: 41.0,
            things: vec![ThingReason { label: "mug".to_owned(), shares }],
            forecast: vec![line],
            coverage: 0.9,
            ..PersonHabits::default()
        };
        let text = learned.to_string();
        for part in [
            "from 41 observations",
            "mug 50 %: language model 25 %, habit 50 %, recency 12 %, hour 12 %, staying 0 %; from 40 at all, 12 after",
            "In 15 min: forecast without habits 25 %",
            "90 % sure: kitchen, elsewhere",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        let json = serde_json::to_string(&learned).unwrap();
        assert_eq!(serde_json::from_str::<PersonHabits>(&json).unwrap(), learned);
    }
}
