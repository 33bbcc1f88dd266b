//! What ROS 2 topics say of rooms, persons and the daemon.

use roomcast_ipc::{PersonScoresV1, PersonV1, RoomScoresV1, sequence};

use crate::types::{Classification, DiagnosticArray, DiagnosticStatus, Header, KeyValue, ObjectHypothesis};

/// A daemon that was silent for so long is an error.
const SILENCE_NS: u64 = 2_000_000_000;

/// For each room, that somebody is there next.
#[must_use]
pub fn of_all(scores: &RoomScoresV1, header: Header) -> Classification {
    let rooms = scores.rooms().iter();
    let results = rooms.map(|room| ObjectHypothesis { class_id: room.id().to_owned(), score: room.probability });
    Classification { header, results: results.collect() }
}

/// For one person, where they are next; `elsewhere` is out of the map.
#[must_use]
pub fn of_one(message: &PersonScoresV1, person: &PersonV1, header: Header) -> Classification {
    let rooms = message.probabilities(person).map(|(id, score)| ObjectHypothesis { class_id: id.to_owned(), score });
    let elsewhere = ObjectHypothesis { class_id: "elsewhere".to_owned(), score: person.elsewhere };
    Classification { header, results: rooms.chain([elsewhere]).collect() }
}

/// A person's part of a topic: ROS 2 has small letters, digits and underscores there. Who has another name in them has a number behind.
#[must_use]
pub fn slug(person: &PersonV1) -> String {
    let name = person.name();
    let plain = |letter: char| letter.is_ascii_lowercase() || letter.is_ascii_digit();
    let lower = name.to_lowercase();
    if !name.is_empty() && lower.chars().all(plain) && lower == name.to_ascii_lowercase() {
        return format!("p_{lower}");
    }
    if name.is_empty() {
        return format!("number_{}", person.person);
    }
    let safe: String = lower.chars().map(|letter| if plain(letter) { letter } else { '_' }).collect();
    format!("p_{safe}_{:08x}", sequence::source_of_name(name) >> 32)
}

/// Whether the daemon scores, now.
#[must_use]
pub fn diagnostics(scores: Option<&RoomScoresV1>, now_ns: u64, header: Header) -> DiagnosticArray {
    let silence_ns = scores.map(|scores| scores.silence_ns(now_ns));
    let (level, message) = match silence_ns {
        None => (3, "no daemon has said anything yet"),
        Some(silence_ns) if silence_ns > SILENCE_NS => (2, "the daemon is silent"),
        Some(_) => (0, "rooms are scored"),
    };
    let mut values = Vec::new();
    let mut add = |key: &str, value: String| values.push(KeyValue { key: key.to_owned(), value });
    if let (Some(scores), Some(silence_ns)) = (scores, silence_ns) {
        add("silence_s", format!("{:.3}", silence_ns as f64 / 1e9));
        add("scores_age_s", format!("{:.3}", scores.age_ns(now_ns) as f64 / 1e9));
        add("persons", scores.persons.to_string());
        add("window", scores.window.to_string());
        add("label_mass", format!("{:.6}", scores.label_mass));
    }
    let name = "roomcast: daemon".to_owned();
    let status = DiagnosticStatus { level, name, message: message.to_owned(), hardware_id: String::new(), values };
    DiagnosticArray { header, status: vec![status] }
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::text;

    use super::*;

    fn person(name: &str) -> PersonV1 {
        PersonV1 { person: 7, name: text::encode("name", name).unwrap(), ..Default::default() }
    }

    #[test]
    fn every_person_has_a_topic_that_ros2_takes() {
        assert_eq!(slug(&person("Ada")), "p_ada");
        assert_eq!(slug(&person("")), "number_7");
        let names = ["José", "Jos_", "Ada B", "ada-b", "🙂", "7/x"];
        let slugs: Vec<_> = names.iter().map(|name| slug(&person(name))).collect();
        for (index, one) in slugs.iter().enumerate() {
            assert!(
                one.bytes().all(|byte| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'_'),
                "{one}"
            );
            assert!(!slugs[..index].contains(one), "{slugs:?}");
        }
    }

    #[test]
    fn a_silent_daemon_is_an_error_and_none_at_all_is_stale() {
        let level =
            |scores: Option<&RoomScoresV1>| diagnostics(scores, 10_000_000_000, Header::default()).status[0].level;
        let scores = |published_ns| RoomScoresV1 { published_ns, ..Default::default() };
        assert_eq!((level(None), level(Some(&scores(1))), level(Some(&scores(9_900_000_000)))), (3, 2, 0));
    }
}
