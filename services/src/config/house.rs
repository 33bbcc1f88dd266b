//! The rules of the house in `[planner]`: quiet hours, sleep, empty rooms, and the needs of each room.

use std::fmt;

/// Most entries of `planner.quiet`.
pub const QUIET_MAX: usize = 64;
const DAYS: [&str; 7] = ["mon", "tue", "wed", "thu", "fri", "sat", "sun"];
const DAY_S: f64 = 86_400.0;
const DAY_MIN: u32 = 24 * 60;
const EXPECTED: &str =
    "expected such as \"22:00-07:00\", \"sat,sun 22:00-09:00\" or \"mon-fri 13:00-15:00 in nursery, office\"";

/// Hours in which the robot is silent: `[DAYS ]HH:MM-HH:MM[ in ROOM, ROOM]`, in local time.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct QuietHours {
    /// The days when the hours begin; Monday first.
    days: [bool; 7],
    from_min: u32,
    to_min: u32,
    pub(super) rooms: Vec<String>,
}

impl QuietHours {
    /// The names or ids of the quiet rooms; empty for the whole house.
    #[must_use]
    pub fn rooms(&self) -> &[String] {
        &self.rooms
    }

    /// Whether the hours apply to a room.
    #[must_use]
    pub fn are_of(&self, room: &str) -> bool {
        self.rooms.is_empty() || self.rooms.iter().any(|own| is_room(own, room))
    }

    /// The end of the quiet hours that overlap a stay of `stay_s` seconds from `local_s` on. Times are seconds since 1970 in local time.
    #[must_use]
    pub fn meets(&self, local_s: f64, stay_s: f64) -> Option<f64> {
        let day = |at_s: f64| (at_s / DAY_S).floor() as i64;
        let length_min = (self.to_min + DAY_MIN - self.from_min - 1) % DAY_MIN + 1;
        let spans = (day(local_s) - 1..=day(local_s + stay_s)).filter(|day| self.days[weekday(*day)]).map(|day| {
            let from_s = day as f64 * DAY_S + f64::from(self.from_min) * 60.0;
            (from_s, from_s + f64::from(length_min) * 60.0)
        });
        let met = spans.filter(|(from_s, to_s)| *from_s < local_s + stay_s && *to_s > local_s || *from_s == local_s);
        met.map(|(_, to_s)| to_s).reduce(f64::max)
    }
}

/// Whether a room of the configuration is the room with this id: by the id, or by its words without the number that an import adds, so that
/// "Living room" is `living-room-12`.
#[must_use]
pub fn is_room(own: &str, id: &str) -> bool {
    let base = id.trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches(|c: char| !c.is_alphanumeric());
    let has_base = id.ends_with(|c: char| c.is_ascii_digit()) && !base.is_empty();
    own == id || is_same(own, id) || has_base && is_same(own, base)
}

/// Whether two texts have the same words in any case.
fn is_same(a: &str, b: &str) -> bool {
    fn words(text: &str) -> impl Iterator<Item = &str> {
        text.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty())
    }
    fn letters(word: &str) -> impl Iterator<Item = char> + '_ {
        word.chars().flat_map(char::to_lowercase)
    }
    words(a).count() == words(b).count() && words(a).zip(words(b)).all(|(a, b)| letters(a).eq(letters(b)))
}

/// The weekday of a day that is counted from 1 January 1970; 0 is Monday.
fn weekday(day: i64) -> usize {
    usize::try_from((day + 3).rem_euclid(7)).unwrap_or_default()
}

/// The name of a day that is counted from 1 January 1970.
#[must_use]
pub fn weekday_name(day: i64) -> &'static str {
    ["Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday", "Sunday"][weekday(day)]
}

/// The hour and minute of a local time, as a clock shows them.
#[must_use]
pub fn clock_time(local_s: f64) -> String {
    let minute = (local_s / 60.0).round().rem_euclid(f64::from(DAY_MIN)) as u32;
    format!("{:02}:{:02}", minute / 60, minute % 60)
}

fn minute(text: &str) -> Option<u32> {
    let (hour, minute) = text.trim().split_once(':')?;
    let number = |text: &str, most: u32| {
        let is_short = text.len() <= 2 && text.bytes().all(|digit| digit.is_ascii_digit());
        text.parse::<u32>().ok().filter(|number| is_short && *number <= most)
    };
    let at = number(hour, 24)? * 60 + number(minute, 59)?;
    (at <= DAY_MIN).then_some(at)
}

fn days(text: &str) -> Option<[bool; 7]> {
    let day = |name: &str| DAYS.iter().position(|day| day.eq_ignore_ascii_case(name.trim()));
    let mut days = [false; 7];
    for part in text.split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let (first, last) = (day(first)?, day(last)?);
        (0..=(last + 7 - first) % 7).for_each(|more| days[(first + more) % 7] = true);
    }
    Some(days)
}

impl TryFrom<String> for QuietHours {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let read = || {
            let (when, rooms) = text.trim().split_once(" in ").unwrap_or((text.trim(), ""));
            let (on, hours) = when.rsplit_once(' ').map_or((None, when), |(on, hours)| (Some(on), hours));
            let (from, to) = hours.split_once('-')?;
            let rooms: Vec<String> = rooms.split(',').map(|room| room.trim().to_owned()).collect();
            let is_all = rooms == [""];
            if !is_all && rooms.iter().any(String::is_empty) {
                return None;
            }
            let (from_min, to_min) = (minute(from)? % DAY_MIN, minute(to)? % DAY_MIN);
            // A whole day is 00:00-24:00. Other equal hours are a mistake.
            if from_min == to_min && from_min != 0 {
                return None;
            }
            Some(Self {
                days: on.map_or(Some([true; 7]), days)?,
                from_min,
                to_min,
                rooms: if is_all { Vec::new() } else { rooms },
            })
        };
        read().ok_or_else(|| format!("quiet hours are {text:?}, {EXPECTED}"))
    }
}

impl From<QuietHours> for String {
    fn from(hours: QuietHours) -> Self {
        hours.to_string()
    }
}

impl fmt::Display for QuietHours {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.days != [true; 7] {
            let days: Vec<&str> = DAYS.iter().zip(self.days).filter(|(_, on)| *on).map(|(day, _)| *day).collect();
            write!(f, "{} ", days.join(","))?;
        }
        let clock = |minute: u32| clock_time(f64::from(minute) * 60.0);
        write!(f, "{}-{}", clock(self.from_min), clock(self.to_min))?;
        if self.rooms.is_empty() { Ok(()) } else { write!(f, " in {}", self.rooms.join(", ")) }
    }
}

roomcast_core::choices! {
    /// The rooms in which the robot does not work while a person sleeps.
    #[derive(Default)]
    pub enum WhileAsleep {
        /// The sleeper's room.
        Room,
        /// The sleeper's room, and the rooms behind its doors.
        #[default]
        Beside,
        /// All rooms of the sleeper's floor.
        Floor,
        /// All rooms.
        House,
        /// None: sleep does not matter.
        Ignore,
    }
}

roomcast_core::choices! {
    /// The part of the house that must be empty before the robot works.
    pub enum OnlyWhen {
        /// The house.
        HouseEmpty,
        /// The room.
        RoomFree,
    }
}

/// An entry of `[[planner.room]]`: the needs of a room.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoomNeeds {
    /// The room's id or name.
    pub id: String,
    /// Seconds from one cleaning to the next; by default once a round.
    pub every_s: Option<f64>,
    /// The weight of leaving this room undone, relative to others.
    #[serde(default = "one")]
    pub priority: f64,
    /// Seconds of work in the room, in place of `planner.room_time_s`.
    pub time_s: Option<f64>,
    /// Whether the robot never works there on its own decision.
    #[serde(default)]
    pub exclude: bool,
}

fn one() -> f64 {
    1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR_S: f64 = 3_600.0;
    /// Midnight before a Monday.
    const MONDAY_S: f64 = 4.0 * DAY_S;

    fn hours(text: &str) -> QuietHours {
        QuietHours::try_from(text.to_owned()).unwrap()
    }

    #[test]
    fn quiet_hours_are_read_and_shown_in_one_form() {
        for (text, shown) in [
            ("22:00-07:00", "22:00-07:00"),
            ("sat,sun 22:00-9:30", "sat,sun 22:00-09:30"),
            ("Fri-Mon 0:00-24:00", "mon,fri,sat,sun 00:00-00:00"),
            ("mon-fri 13:00-15:00 in nursery, office", "mon,tue,wed,thu,fri 13:00-15:00 in nursery, office"),
        ] {
            assert_eq!(hours(text).to_string(), shown);
            assert_eq!(hours(shown), hours(text));
        }
        for wrong in [
            "",
            "22-7",
            "22:00",
            "25:00-07:00",
            "24:01-07:00",
            "22:60-07:00",
            "someday 22:00-07:00",
            "15:00-15:00",
            "22:00-07:00 in ,",
            "+2:00-07:00",
        ] {
            let told = QuietHours::try_from(wrong.to_owned()).unwrap_err();
            assert!(told.contains(wrong) && told.contains(EXPECTED), "{told}");
        }
    }

    #[test]
    fn stays_that_would_reach_into_quiet_hours_meet_them() {
        let night = hours("22:00-07:00");
        let at = |hour: f64| MONDAY_S + hour * HOUR_S;
        assert_eq!(night.meets(at(21.0), HOUR_S), None);
        assert_eq!(night.meets(at(21.0), HOUR_S + 1.0), Some(at(31.0)));
        assert_eq!(night.meets(at(22.0), 0.0), Some(at(31.0)));
        assert_eq!(night.meets(at(3.0), 0.0), Some(at(7.0)), "the night began the day before");
        assert_eq!(night.meets(at(7.0), HOUR_S), None);
        // A whole day.
        assert_eq!(hours("sun 00:00-00:00").meets(at(-1.0), 0.0), Some(at(0.0)));
        assert_eq!(hours("sun 00:00-00:00").meets(at(0.0), HOUR_S), None);
    }

    #[test]
    fn quiet_hours_of_a_weekday_begin_on_that_day() {
        let weekend = hours("sat,sun 22:00-09:00");
        let at = |day: f64, hour: f64| MONDAY_S + day * DAY_S + hour * HOUR_S;
        assert_eq!(weekend.meets(at(4.0, 23.0), 0.0), None, "Friday night");
        assert_eq!(weekend.meets(at(5.0, 23.0), 0.0), Some(at(6.0, 9.0)));
        assert_eq!(weekend.meets(at(7.0, 8.0), 0.0), Some(at(7.0, 9.0)), "Monday morning, since Sunday");
        assert_eq!(weekend.meets(at(1.0, 8.0), 0.0), None);
    }

    #[test]
    fn quiet_hours_of_rooms_are_of_no_other_room() {
        let nap = hours("13:00-15:00 in nursery");
        assert!(
            nap.are_of("nursery")
                && nap.are_of("nursery-17")
                && !nap.are_of("nursery-room")
                && !nap.are_of("kitchen")
                && hours("13:00-15:00").are_of("kitchen")
        );
    }

    #[test]
    fn a_clock_shows_hours_and_minutes() {
        assert_eq!([0.0, 25.5 * HOUR_S, -60.0].map(clock_time), ["00:00", "01:30", "23:59"]);
    }
}
