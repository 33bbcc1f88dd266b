//! The rules of the house: whether the robot may work in a room now, and if not, why. Pure.

use std::fmt;

use crate::config::{OnlyWhen, PlannerConfig, clock_time, weekday_name};
use crate::slug::room_name;

/// A set of rooms by their places in the scores: bit i is room i.
pub type RoomSet = u64;

/// Whether a set contains a room.
#[must_use]
pub fn holds(set: RoomSet, room: usize) -> bool {
    room < 64 && set >> room & 1 == 1
}

/// A moment, and the stay that would begin then.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Now {
    /// Seconds since 1970 in local time.
    pub local_s: f64,
    /// The length of the stay from now on in seconds; 0 for work in progress.
    pub stay_s: f64,
}

/// An order of a person that the robot does not work.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hold {
    /// The reason in the person's words; may be empty.
    pub why: String,
    /// The end, in seconds since 1970; `None` until a person resumes.
    pub until_unix_s: Option<u64>,
}

/// A sleeping person.
#[derive(Debug, Clone, PartialEq)]
pub struct Sleeper {
    /// The person's name.
    pub name: String,
    /// The sleeper's likeliest room.
    pub room: usize,
    /// The rooms that stay silent.
    pub near: RoomSet,
}

/// A likely person in a room.
#[derive(Debug, Clone, PartialEq)]
pub struct Staying {
    /// The person's name.
    pub name: String,
    /// Seconds of the likely stay, within the forecast.
    pub for_s: f64,
    /// The forecast does not see them leave.
    pub is_open: bool,
}

/// The input of the rules at one moment.
#[derive(Debug, Clone, PartialEq)]
pub struct Facts<'a> {
    /// The rules.
    pub config: &'a PlannerConfig,
    /// The rooms' ids.
    pub ids: Vec<&'a str>,
    /// A person's order to hold, with the end in local time.
    pub hold: Option<(&'a Hold, Option<f64>)>,
    /// Rooms that a person asked for.
    pub asked: RoomSet,
    /// Rooms that a person skips today.
    pub skipped: RoomSet,
    /// The persons that the planner waits for, until this local time at most.
    pub unobserved: Option<(Vec<String>, f64)>,
    /// Persons who sleep.
    pub sleepers: Vec<Sleeper>,
    /// Persons who are likely at home.
    pub at_home: Vec<String>,
    /// Residents without an observation.
    pub missing: Vec<String>,
    /// The probability that the house is empty now, and all the time for `min_absence_s`.
    pub house_empty: (f64, f64),
    /// Per room the probability that it is empty now, and for all of a stay or `min_absence_s`.
    pub room_free: Vec<(f64, f64)>,
    /// Per room the likeliest person there now.
    pub staying: Vec<Option<Staying>>,
}

/// A reason against work in a room, as a sentence.
#[derive(Debug, Clone, PartialEq)]
pub enum Reason {
    /// A person holds the robot.
    Held {
        /// The reason in the person's words.
        why: String,
        /// The local time of the end.
        until_s: Option<f64>,
        /// The local time now.
        now_s: f64,
    },
    /// A person sleeps near.
    Asleep {
        /// The person.
        name: String,
        /// The sleeper's room.
        room: String,
    },
    /// The room is excluded.
    Excluded {
        /// The room.
        room: String,
    },
    /// A person skips the room today.
    Skipped {
        /// The room.
        room: String,
    },
    /// The hours are quiet.
    Quiet {
        /// The room, unless the hours are for the whole house.
        room: Option<String>,
        /// The local time of their end.
        until_s: f64,
    },
    /// Residents were not observed yet.
    Unobserved {
        /// Their names.
        names: Vec<String>,
        /// The local time when the planner continues without them.
        until_s: f64,
    },
    /// The house is not empty.
    HouseOccupied {
        /// The known persons at home.
        names: Vec<String>,
        /// Residents without an observation, if no known person is at home.
        missing: Vec<String>,
    },
    /// A person is in the room.
    Occupied {
        /// The person and the length of the stay; `None` if no single person is likely.
        by: Option<Staying>,
        /// The room.
        room: String,
    },
    /// House or room do not stay empty long enough.
    TooShort {
        /// The room; `None` for the house.
        room: Option<String>,
        /// The required seconds.
        for_s: f64,
        /// The probability of that.
        likely: f64,
    },
}

impl Reason {
    /// Whether the order to clean a room overrides this reason. It overrides no hold, and wakes no sleeper.
    #[must_use]
    pub fn yields(&self) -> bool {
        !matches!(self, Self::Held { .. } | Self::Asleep { .. })
    }

    /// Whether it also ends work that has begun.
    #[must_use]
    pub fn ends_work(&self) -> bool {
        matches!(self, Self::Held { .. } | Self::Asleep { .. } | Self::Quiet { .. } | Self::HouseOccupied { .. })
    }
}

/// A time after another: "until 14:30", "until Wednesday 14:30", "for 12 days".
fn until(until_s: f64, now_s: f64) -> String {
    let day = |at_s: f64| (at_s / 86_400.0).floor() as i64;
    match day(until_s) - day(now_s) {
        ..=0 => format!("until {}", clock_time(until_s)),
        1..=6 => format!("until {} {}", weekday_name(day(until_s)), clock_time(until_s)),
        days => format!("for {days} days"),
    }
}

/// Names as a list: "Mira", "Mira and Ben", "Mira, Ben and Cem".
fn listed(names: &[String]) -> String {
    match names {
        [] => "a person".to_owned(),
        [one] => one.clone(),
        [first @ .., last] => format!("{} and {last}", first.join(", ")),
    }
}

/// A time for people: "1 more minute", "20 more minutes", "2 more hours".
fn more(seconds: f64) -> String {
    let minutes = (seconds / 60.0).ceil().max(1.0);
    let (number, unit) = if minutes < 120.0 { (minutes, "minute") } else { ((minutes / 60.0).round(), "hour") };
    format!("{number} more {unit}{}", if number == 1.0 { "" } else { "s" })
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Held { why, until_s, now_s } => {
                f.write_str("On hold")?;
                until_s.iter().try_for_each(|until_s| write!(f, " {}", until(*until_s, *now_s)))?;
                if why.is_empty() { f.write_str(".") } else { write!(f, ": {}.", why.trim_end_matches('.')) }
            }
            Self::Asleep { name, room } => write!(f, "Waiting: {name} sleeps in the {room}."),
            Self::Excluded { room } => write!(f, "The {room} is excluded."),
            Self::Skipped { room } => write!(f, "The {room} is skipped today."),
            Self::Quiet { room: None, until_s } => write!(f, "Quiet hours until {}.", clock_time(*until_s)),
            Self::Quiet { room: Some(room), until_s } => {
                write!(f, "Quiet hours in the {room} until {}.", clock_time(*until_s))
            }
            Self::Unobserved { names, until_s } => {
                let was = if names.len() > 1 { "were" } else { "was" };
                write!(f, "Waiting: {} {was} not observed yet; until {} at most.", listed(names), clock_time(*until_s))
            }
            Self::HouseOccupied { names, missing } if names.is_empty() && !missing.is_empty() => {
                let was = if missing.len() > 1 { "were" } else { "was" };
                write!(f, "Waiting: {} may be at home, and {was} not observed yet.", listed(missing))
            }
            Self::HouseOccupied { names, .. } => {
                let is = if names.len() > 1 { "are" } else { "is" };
                write!(f, "Waiting: {} {is} at home.", listed(names))
            }
            Self::Occupied { by: Some(Staying { name, for_s, is_open }), room } => {
                let least = if *is_open { "at least " } else { "" };
                write!(f, "Waiting: {name} is likely in the {room} for {least}{}.", more(*for_s))
            }
            Self::Occupied { by: None, room } => write!(f, "Waiting: a person may be in the {room}."),
            Self::TooShort { room, for_s, likely } => {
                let place = room.as_ref().map_or_else(|| "house".to_owned(), Clone::clone);
                let (minutes, percent) = ((for_s / 60.0).ceil(), 100.0 * likely);
                write!(f, "Waiting: the {place} stays empty for {minutes} minutes with only {percent:.0} %.")
            }
        }
    }
}

/// Whether the robot may work in a room.
///
/// # Errors
/// The first reason against it.
pub fn allowed(room: usize, now: Now, facts: &Facts<'_>) -> Result<(), Reason> {
    let is_asked = holds(facts.asked, room);
    let begins = now.stay_s > 0.0;
    let is_against = |reason: &Reason| (!is_asked || !reason.yields()) && (begins || reason.ends_work());
    reasons(room, now, facts).find(is_against).map_or(Ok(()), Err)
}

/// All reasons against work in a room, the strongest first.
fn reasons<'a>(room: usize, now: Now, facts: &'a Facts<'_>) -> impl Iterator<Item = Reason> + 'a {
    let config = facts.config;
    let name = move || facts.name(room);
    let held = facts.hold.map(|(hold, until_s)| Reason::Held { why: hold.why.clone(), until_s, now_s: now.local_s });
    let sleeper = facts.sleepers.iter().find(|sleeper| holds(sleeper.near, room));
    let asleep = sleeper.map(|sleeper| Reason::Asleep { name: sleeper.name.clone(), room: facts.name(sleeper.room) });
    let needs = facts.ids.get(room).and_then(|id| config.needs_of(id));
    let excluded = needs.filter(|needs| needs.exclude).map(|_| Reason::Excluded { room: name() });
    let skipped = holds(facts.skipped, room).then(|| Reason::Skipped { room: name() });
    let hours = config.quiet.iter().filter(move |hours| hours.are_of(facts.ids.get(room).unwrap_or(&"")));
    let met = hours.filter_map(move |hours| Some((hours.meets(now.local_s, now.stay_s)?, hours.rooms().is_empty())));
    let quiet = met.max_by(|a, b| a.0.total_cmp(&b.0));
    let quiet = quiet.map(|(until_s, is_all)| Reason::Quiet { room: (!is_all).then(name), until_s });
    let unobserved = facts.unobserved.clone().map(|(names, until_s)| Reason::Unobserved { names, until_s });
    held.into_iter()
        .chain(asleep)
        .chain(excluded)
        .chain(skipped)
        .chain(quiet)
        .chain(unobserved)
        .chain(empty(room, now, facts))
}

impl Facts<'_> {
    /// A room's name for people.
    fn name(&self, room: usize) -> String {
        self.ids.get(room).map_or_else(String::new, |id| room_name(id, self.ids.iter().copied()))
    }
}

/// The reason against the room if house or room must be empty and are not.
fn empty(room: usize, at: Now, facts: &Facts<'_>) -> Option<Reason> {
    let PlannerConfig { only_when, min_absence_s, min_absence_at, resume_at, interrupt_at, .. } = *facts.config;
    // Work that has begun ends at a higher probability, so that doubt does not stop and start the robot.
    let occupied_at = if at.stay_s > 0.0 { resume_at } else { interrupt_at };
    let name = || facts.name(room);
    let (of_room, (now, later)) = match only_when? {
        OnlyWhen::HouseEmpty => (false, facts.house_empty),
        OnlyWhen::RoomFree => (true, facts.room_free.get(room).copied()?),
    };
    if now < 1.0 - occupied_at {
        return Some(if of_room {
            Reason::Occupied { by: facts.staying.get(room).cloned().flatten(), room: name() }
        } else {
            Reason::HouseOccupied { names: facts.at_home.clone(), missing: facts.missing.clone() }
        });
    }
    let too_short = || Reason::TooShort { room: of_room.then(name), for_s: min_absence_s, likely: later };
    (min_absence_s > 0.0 && later < min_absence_at).then(too_short)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{QuietHours, RoomNeeds};

    const HOUR_S: f64 = 3_600.0;

    /// A home of kitchen, bedroom and hall that is known, awake and empty.
    fn facts(config: &PlannerConfig) -> Facts<'_> {
        Facts {
            config,
            ids: vec!["kitchen", "bedroom", "hall"],
            hold: None,
            asked: 0,
            skipped: 0,
            unobserved: None,
            sleepers: Vec::new(),
            at_home: Vec::new(),
            missing: Vec::new(),
            house_empty: (1.0, 1.0),
            room_free: vec![(1.0, 1.0); 3],
            staying: vec![None; 3],
        }
    }

    fn at(hour: f64) -> Now {
        Now { local_s: hour * HOUR_S, stay_s: 600.0 }
    }

    /// The sentence against a room; empty if the robot may work there.
    fn said(room: usize, now: Now, facts: &Facts<'_>) -> String {
        allowed(room, now, facts).map_or_else(|reason| reason.to_string(), |()| String::new())
    }

    fn quiet(hours: &str) -> PlannerConfig {
        PlannerConfig { quiet: vec![QuietHours::try_from(hours.to_owned()).unwrap()], ..PlannerConfig::default() }
    }

    #[test]
    fn quiet_hours_end_work_and_stop_stays_that_would_reach_into_them() {
        let config = quiet("22:00-07:00");
        let facts = facts(&config);
        assert_eq!(said(0, at(21.9), &facts), "Quiet hours until 07:00.");
        assert_eq!(said(0, at(21.8), &facts), "");
        assert_eq!(said(0, Now { stay_s: 0.0, ..at(22.0) }, &facts), "Quiet hours until 07:00.");
        assert_eq!(said(0, Now { stay_s: 0.0, ..at(21.99) }, &facts), "", "it works on until they begin");
    }

    #[test]
    fn quiet_hours_of_a_room_are_of_that_room() {
        let config = quiet("13:00-15:00 in bedroom");
        let facts = facts(&config);
        assert_eq!(said(1, at(14.0), &facts), "Quiet hours in the bedroom until 15:00.");
        assert_eq!(said(0, at(14.0), &facts), "");
    }

    #[test]
    fn a_sleeper_keeps_the_rooms_nearby_silent_and_no_other() {
        let config = PlannerConfig::default();
        let sleeper = Sleeper { name: "Mira".to_owned(), room: 1, near: 0b110 };
        let facts = Facts { sleepers: vec![sleeper], ..facts(&config) };
        assert_eq!(
            [0, 1, 2].map(|room| said(room, at(9.0), &facts)),
            ["", "Waiting: Mira sleeps in the bedroom.", "Waiting: Mira sleeps in the bedroom."]
        );
        // She falls asleep while the robot works in the hall.
        assert!(allowed(2, Now { stay_s: 0.0, ..at(9.0) }, &facts).is_err());
        // The order to clean the room wakes no sleeper.
        assert!(allowed(2, at(9.0), &Facts { asked: 0b100, ..facts.clone() }).is_err());
    }

    #[test]
    fn a_hold_stops_every_room_and_says_why_and_until_when() {
        let config = PlannerConfig::default();
        let hold = |why: &str| Hold { why: why.to_owned(), until_unix_s: None };
        let (plain, meeting) = (hold(""), hold("meeting"));
        let with = |hold, until_s| Facts { hold: Some((hold, until_s)), asked: 0b001, ..facts(&config) };
        assert_eq!(said(0, at(9.0), &with(&plain, None)), "On hold.");
        assert_eq!(said(2, at(9.0), &with(&meeting, Some(15.5 * HOUR_S))), "On hold until 15:30: meeting.");
        let later = |days: f64| said(0, at(9.0), &with(&plain, Some((24.0 * days + 15.5) * HOUR_S)));
        assert_eq!(
            [1.0, 6.0, 30.0].map(later),
            ["On hold until Friday 15:30.", "On hold until Wednesday 15:30.", "On hold for 30 days."]
        );
        assert!(allowed(0, Now { stay_s: 0.0, ..at(9.0) }, &with(&plain, None)).is_err(), "it also ends work");
    }

    #[test]
    fn residents_who_were_not_observed_are_named() {
        let config = PlannerConfig::default();
        let names = ["Mira", "Ben", "Cem"].map(str::to_owned);
        let with = |count: usize| Facts { unobserved: Some((names[..count].to_vec(), 9.5 * HOUR_S)), ..facts(&config) };
        assert_eq!(said(0, at(9.0), &with(1)), "Waiting: Mira was not observed yet; until 09:30 at most.");
        assert_eq!(
            said(0, at(9.0), &with(3)),
            "Waiting: Mira, Ben and Cem were not observed yet; until 09:30 at most."
        );
        assert_eq!(said(0, Now { stay_s: 0.0, ..at(9.0) }, &with(1)), "", "work that has begun goes on");
    }

    #[test]
    fn an_empty_house_is_asked_for_now_and_for_long_enough() {
        let config = PlannerConfig {
            only_when: Some(OnlyWhen::HouseEmpty),
            min_absence_s: 1800.0,
            min_absence_at: 0.8,
            ..PlannerConfig::default()
        };
        let with = |house_empty| Facts { house_empty, at_home: vec!["Mira".to_owned()], ..facts(&config) };
        assert_eq!(said(0, at(9.0), &with((0.1, 0.1))), "Waiting: Mira is at home.");
        // She is out for ten minutes.
        assert_eq!(
            said(0, at(9.0), &with((0.95, 0.3))),
            "Waiting: the house stays empty for 30 minutes with only 30 %."
        );
        assert_eq!(said(0, at(9.0), &with((0.95, 0.9))), "");
        let works = Now { stay_s: 0.0, ..at(9.0) };
        assert_eq!(said(0, works, &with((0.95, 0.3))), "", "work goes on until somebody comes home");
        assert_eq!(said(0, works, &with((0.1, 0.1))), "Waiting: Mira is at home.");
        // The robot begins below 30 %, and ends above 60 %.
        assert_eq!(said(0, at(9.0), &with((0.5, 0.9))), "Waiting: Mira is at home.");
        assert_eq!(said(0, works, &with((0.5, 0.9))), "");
        let missing = Facts { at_home: Vec::new(), missing: vec!["Jon".to_owned()], ..with((0.1, 0.1)) };
        assert_eq!(said(0, at(9.0), &missing), "Waiting: Jon may be at home, and was not observed yet.");
    }

    #[test]
    fn an_occupied_room_says_by_which_person_and_for_how_long() {
        let config = PlannerConfig { only_when: Some(OnlyWhen::RoomFree), ..PlannerConfig::default() };
        let mut facts = facts(&config);
        facts.room_free[0] = (0.2, 0.1);
        assert_eq!(said(0, at(9.0), &facts), "Waiting: a person may be in the kitchen.");
        for (for_s, is_open, time) in [
            (1190.0, false, "20 more minutes"),
            (30.0, false, "1 more minute"),
            (7300.0, true, "at least 2 more hours"),
        ] {
            facts.staying[0] = Some(Staying { name: "Mira".to_owned(), for_s, is_open });
            assert_eq!(said(0, at(9.0), &facts), format!("Waiting: Mira is likely in the kitchen for {time}."));
        }
        assert_eq!(said(1, at(9.0), &facts), "");
    }

    #[test]
    fn excluded_and_skipped_rooms_are_done_only_for_a_person_who_asks() {
        let excluded =
            RoomNeeds { id: "kitchen".to_owned(), every_s: None, priority: 1.0, time_s: None, exclude: true };
        let config = PlannerConfig { room: vec![excluded], ..quiet("22:00-07:00") };
        let facts = Facts { skipped: 0b100, ..facts(&config) };
        assert_eq!(
            [0, 1, 2].map(|room| said(room, at(9.0), &facts)),
            ["The kitchen is excluded.", "", "The hall is skipped today."]
        );
        let asked = Facts { asked: 0b101, ..facts.clone() };
        assert_eq!([0, 1, 2].map(|room| said(room, at(23.0), &asked)), ["", "Quiet hours until 07:00.", ""]);
    }
}
