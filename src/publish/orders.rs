//! Orders of persons over MQTT: a switch that holds a robot, buttons that clean or skip a room, and corrections of persons' places. No I/O.

use std::collections::BTreeMap;

use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_ipc::raw::{RobotReportV1, narration_kind};
use roomcast_ipc::sequence;
use roomcast_services::narrator::{Item, Who};
use roomcast_services::reporter::{Kind, Report, Reporter};

use super::names::{AWAY, Named, of_room};

/// The last level of the topics.
const LEVELS: [&str; 3] = ["hold", "clean", "skip"];
const BYTES_MAX: usize = 1024;

pub(super) fn topic(base: &str, robot: &str, level: &str) -> String {
    format!("{base}/robots/{robot}/{level}")
}

/// The topic that corrects a person's place.
pub(super) fn place_topic(base: &str, person: &str) -> String {
    format!("{base}/persons/{person}/place")
}

/// A hold with a note or an end.
#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Hold {
    #[serde(default)]
    note: Option<String>,
    #[serde(default)]
    for_s: Option<f64>,
}

#[derive(Debug)]
pub(super) struct Orders {
    base: String,
    reporters: BTreeMap<String, Reporter>,
}

impl Orders {
    pub(super) fn new(base: &str) -> Self {
        Self { base: base.to_owned(), reporters: BTreeMap::new() }
    }

    pub(super) fn filters(&self) -> Vec<String> {
        LEVELS.map(|level| topic(&self.base, "+", level)).into_iter().chain([place_topic(&self.base, "+")]).collect()
    }

    pub(super) fn has(&self, topic: &str) -> bool {
        self.parts(topic).is_some() || self.person(topic).is_some()
    }

    /// The person of a topic that corrects a place.
    fn person<'a>(&self, topic: &'a str) -> Option<&'a str> {
        let person = topic.strip_prefix(&self.base)?.strip_prefix("/persons/")?.strip_suffix("/place")?;
        (!person.contains('/')).then_some(person)
    }

    /// The presence of a message that corrects the place of one of these persons, with the names of the rooms by id; `None` if it is another order.
    pub(super) fn correction(
        &self,
        topic: &str,
        payload: &[u8],
        persons: Vec<(String, Who)>,
        rooms: &[(String, String)],
    ) -> Option<Result<Item, String>> {
        let part = self.person(topic)?;
        let Some((_, who)) = persons.into_iter().find(|(own, _)| own == part) else {
            return Some(Err(format!("no person is known as {part}")));
        };
        let text = std::str::from_utf8(payload).unwrap_or_default().trim();
        let room = rooms.iter().find(|(id, shown)| [id, shown].iter().any(|own| *own == text) || of_room(id) == text);
        let place = match room {
            Some((id, _)) => format!("present in the {id}"),
            None if text == AWAY => AWAY.to_owned(),
            None => {
                let ids: Vec<&str> = rooms.iter().map(|(id, _)| id.as_str()).collect();
                return Some(Err(format!("the map has no room of this name; give {} or {AWAY}", ids.join(", "))));
            }
        };
        Some(Ok(Item::new(narration_kind::PRESENCE, place, who)))
    }

    /// The robot and the kind of order in a topic.
    fn parts<'a>(&self, topic: &'a str) -> Option<(&'a str, &'a str)> {
        let (robot, level) = topic.strip_prefix(&self.base)?.strip_prefix("/robots/")?.split_once('/')?;
        LEVELS.contains(&level).then_some((robot, level))
    }

    /// The order of a message to one of these robots, for one of these rooms.
    ///
    /// # Errors
    /// The fault and the remedy, in words.
    pub(super) fn read(
        &mut self,
        topic: &str,
        payload: &[u8],
        robots: &[Named],
        rooms: &[String],
        (now_ns, unix_ns): (BootNs, UnixNs),
    ) -> Result<RobotReportV1, String> {
        let (part, level) = self.parts(topic).ok_or("it is no topic of orders")?;
        let robot = robots.iter().find(|robot| robot.part == part);
        let name = &robot.ok_or_else(|| format!("no robot is known as {part}"))?.name;
        let text = std::str::from_utf8(payload).ok().filter(|text| text.len() <= BYTES_MAX).map(str::trim);
        let text = text.ok_or_else(|| format!("give at most {BYTES_MAX} bytes of text"))?;
        let of_room = |kind| {
            let id = rooms.iter().find(|id| *id == text || of_room(id) == text);
            let id = id.ok_or_else(|| format!("the map has no room of this id; it has {}", rooms.join(", ")))?;
            Ok::<_, String>(Report { room: Some(id.clone()), ..Report::new(kind) })
        };
        let report = match (level, text) {
            ("clean", _) => of_room(Kind::Clean)?,
            ("skip", _) => of_room(Kind::Skip)?,
            (_, "ON" | "on") => Report::new(Kind::Hold),
            (_, "OFF" | "off") => Report::new(Kind::Resume),
            (_, text) => {
                let hold: Hold = serde_json::from_str(text).map_err(|error| {
                    format!("{error}; give ON, OFF, or such as {{\"note\": \"meeting\", \"for_s\": 3600}}")
                })?;
                Report { note: hold.note, for_s: hold.for_s, ..Report::new(Kind::Hold) }
            }
        };
        if !self.reporters.contains_key(name) {
            let reporter = Reporter::new(name, sequence::random_epoch()).map_err(|error| error.to_string())?;
            self.reporters.insert(name.clone(), reporter);
        }
        let reporter = self.reporters.get_mut(name).ok_or("no robot of this name")?;
        reporter.message(&report, now_ns, unix_ns).map_err(|error| error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_ipc::raw::report_kind;

    #[test]
    fn messages_become_orders_to_the_robot_of_their_topic() {
        let mut orders = Orders::new("roomcast");
        let robots = [Named { part: "vacuum".to_owned(), name: "Vacuum".to_owned() }];
        let rooms = ["kitchen".to_owned(), "küche".to_owned()];
        let mut read = |topic: &str, payload: &str| {
            orders.read(topic, payload.as_bytes(), &robots, &rooms, (BootNs(5), UnixNs(1_000_000_000)))
        };
        let hold = read("roomcast/robots/vacuum/hold", "ON").unwrap();
        assert_eq!((hold.kind, hold.robot_name(), hold.until_unix_ns), (report_kind::HOLD, "Vacuum", 0));
        let hold = read("roomcast/robots/vacuum/hold", r#"{"note": "meeting", "for_s": 60}"#).unwrap();
        assert_eq!((hold.note(), hold.until_unix_ns, hold.sequence), ("meeting", 61_000_000_000, 2));
        assert_eq!(read("roomcast/robots/vacuum/hold", "OFF").unwrap().kind, report_kind::RESUME);
        let clean = read("roomcast/robots/vacuum/clean", &of_room("küche")).unwrap();
        assert_eq!((clean.kind, clean.room()), (report_kind::CLEAN, "küche"));
        assert_eq!(read("roomcast/robots/vacuum/skip", "kitchen").unwrap().kind, report_kind::SKIP);
        for (topic, payload, part) in [
            ("roomcast/robots/vacuum/hold", "maybe", "give ON, OFF"),
            ("roomcast/robots/vacuum/hold", r#"{"for_s": 0}"#, "1 to 1000000000 seconds"),
            ("roomcast/robots/vacuum/clean", "attic", "it has kitchen, küche"),
            ("roomcast/robots/mop/clean", "kitchen", "no robot is known as mop"),
        ] {
            let told = read(topic, payload).unwrap_err();
            assert!(told.contains(part), "{told}");
        }
    }

    #[test]
    fn places_become_presences_of_the_person_of_their_topic() {
        let orders = Orders::new("roomcast");
        let rooms = [("home-office-3".to_owned(), "home office".to_owned()), ("küche".to_owned(), "küche".to_owned())];
        let read = |topic: &str, payload: &str| {
            let persons = vec![("jon".to_owned(), "jon".parse().unwrap())];
            orders.correction(topic, payload.as_bytes(), persons, &rooms)
        };
        for (payload, text) in [
            ("home office", "present in the home-office-3"),
            ("home-office-3", "present in the home-office-3"),
            ("küche", "present in the küche"),
            ("away", "away"),
        ] {
            let item = read("roomcast/persons/jon/place", payload).unwrap().unwrap();
            assert_eq!((item.text.as_str(), item.person.name()), (text, "jon"));
        }
        let fault = read("roomcast/persons/jon/place", "attic").unwrap().unwrap_err();
        assert!(fault.contains("give home-office-3, küche or away"), "{fault}");
        let fault = read("roomcast/persons/eve/place", "away").unwrap().unwrap_err();
        assert!(fault.contains("no person is known as eve"), "{fault}");
        assert!(read("roomcast/robots/vacuum/hold", "ON").is_none() && !orders.has("roomcast/persons/a/b/place"));
        assert!(orders.has("roomcast/persons/jon/place") && !orders.has("roomcast/persons/jon"));
    }

    #[test]
    fn other_topics_are_no_orders() {
        let orders = Orders::new("roomcast");
        for topic in [
            "roomcast/robots/vacuum",
            "roomcast/robots/vacuum/order",
            "other/robots/vacuum/hold",
            "roomcast/robots/a/b/hold",
        ] {
            assert!(!orders.has(topic), "{topic}");
        }
        assert!(orders.has("roomcast/robots/vacuum/skip"));
    }
}
