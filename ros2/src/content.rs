//! The content of ROS 2 topics about rooms, persons and the daemon.

use roomcast_core::narration::name_words;
use roomcast_ipc::raw::{ForecastV1, MAX_HORIZONS, PersonForecastV1, PersonForecastsV1, RoomScoresV1, probability_at};

use crate::types::{Classification, DiagnosticArray, DiagnosticStatus, Header, KeyValue, ObjectHypothesis};

/// A daemon that is silent for this long is an error.
const SILENCE_NS: u64 = 2_000_000_000;

/// The seconds ahead that have topics, if no others are configured.
pub const HORIZONS_S: [f64; 2] = [60.0, 600.0];

/// The end of a topic's name: "" for now, `/in_60s` for a minute ahead.
#[must_use]
pub fn horizon(ahead_s: f64) -> String {
    if ahead_s == 0.0 { String::new() } else { format!("/in_{}s", ahead_s.to_string().replace('.', "_")) }
}

/// For each room, the probability that people are in it so many seconds after the forecast was computed.
#[must_use]
pub fn of_rooms(forecast: &ForecastV1, ahead_s: f64, header: Header) -> Classification {
    let hypothesis = |(id, row): (&str, &[f32])| ObjectHypothesis {
        class_id: id.to_owned(),
        score: probability_at(forecast.horizons_s(), row, ahead_s),
    };
    Classification { header, results: forecast.rooms().map(hypothesis).collect() }
}

/// For each room, the probability that one person is in it so many seconds after the forecast was computed; `elsewhere` is out of the map.
#[must_use]
pub fn of_person(
    message: &PersonForecastsV1,
    person: &PersonForecastV1,
    ahead_s: f64,
    header: Header,
) -> Classification {
    let rows = message.rooms().zip(person.probability.iter()).chain([("elsewhere", &person.elsewhere)]);
    let hypothesis = |(id, row): (&str, &[f32; MAX_HORIZONS])| ObjectHypothesis {
        class_id: id.to_owned(),
        score: probability_at(message.horizons_s(), row, ahead_s),
    };
    Classification { header, results: rows.map(hypothesis).collect() }
}

/// The parts of topics that name the persons of a message, in its order: `ada`, `anne_marie`, and `person_3` for the person with the number
/// 3 and no name. If two persons have the same part, the second one's number follows it.
#[must_use]
pub fn person_topics(persons: &[PersonForecastV1]) -> Vec<String> {
    let mut topics: Vec<String> = Vec::new();
    for person in persons {
        let mut topic = topic_of(person);
        if topics.contains(&topic) {
            topic = format!("{topic}_{}", person.person);
        }
        while topics.contains(&topic) {
            topic.push_str("_2");
        }
        topics.push(topic);
    }
    topics
}

/// A name in lower-case letters, digits and single underscores, the only characters of ROS 2. A topic begins with a letter.
fn topic_of(person: &PersonForecastV1) -> String {
    let words = name_words(person.name());
    let plain = |letter: char| letter.is_ascii_lowercase() || letter.is_ascii_digit();
    let words: Vec<String> = words.iter().map(|word| word.chars().filter(|letter| plain(*letter)).collect()).collect();
    let name = words.iter().filter(|word| !word.is_empty()).cloned().collect::<Vec<_>>().join("_");
    // A name that lost letters may equal another one.
    let letters = person.name().chars().filter(|own| own.is_alphanumeric()).count();
    let has_lost = words.iter().map(String::len).sum::<usize>() < letters;
    match name.chars().next() {
        Some(_) if has_lost => format!("person_{name}_{}", person.person),
        Some(first) if first.is_ascii_lowercase() => name,
        Some(_) => format!("person_{name}"),
        None => format!("person_{}", person.person),
    }
}

/// Reports whether the daemon scores.
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

    fn person(number: u32, name: &str) -> PersonForecastV1 {
        PersonForecastV1 { person: number, name: text::encode("name", name).unwrap(), ..Default::default() }
    }

    #[test]
    fn the_topic_of_a_person_is_the_name_or_the_number() {
        for (name, topic) in [
            ("Ada", "ada"),
            ("person_3", "person_3"),
            ("", "person_7"),
            ("José", "jose"),
            ("Anne-Marie O'Neill", "anne_marie_o_neill"),
            ("7/x", "person_7_x"),
            ("🙂", "person_7"),
            ("Ana Иванова", "person_ana_7"),
            ("Анна", "person_7"),
        ] {
            assert_eq!(person_topics(&[person(7, name)]), [topic], "{name}");
        }
    }

    #[test]
    fn each_person_of_a_message_has_a_topic_that_ros2_takes() {
        let names = ["Ada B", "ada-b", "ada_b_9", "", "person 3", "Jos_"];
        let persons: Vec<_> = names.iter().zip([1, 9, 2, 3, 4, 5]).map(|(name, number)| person(number, name)).collect();
        let topics = person_topics(&persons);
        assert_eq!(topics, ["ada_b", "ada_b_9", "ada_b_9_2", "person_3", "person_3_4", "jos"]);
    }

    #[test]
    fn rooms_and_persons_have_the_forecast_of_a_horizon() {
        let mut rooms = ForecastV1 { room_count: 1, horizon_count: 2, ..Default::default() };
        rooms.horizon_s[..2].copy_from_slice(&[0.0, 100.0]);
        rooms.id[0] = text::encode("room id", "kitchen").unwrap();
        rooms.probability[0][..2].copy_from_slice(&[1.0, 0.5]);
        let scores = |found: Classification| found.results.into_iter().map(|result| (result.class_id, result.score));
        let kitchen = |score: f64| ("kitchen".to_owned(), score);
        assert!(scores(of_rooms(&rooms, 0.0, Header::default())).eq([kitchen(1.0)]));
        assert!(scores(of_rooms(&rooms, 50.0, Header::default())).eq([kitchen(0.75)]));
        let mut persons =
            PersonForecastsV1 { room_count: 1, horizon_count: 2, horizon_s: rooms.horizon_s, ..Default::default() };
        persons.id[0] = rooms.id[0];
        persons.person[0].probability[0] = rooms.probability[0];
        persons.person[0].elsewhere[..2].copy_from_slice(&[0.0, 0.5]);
        let found = scores(of_person(&persons, &persons.person[0], 100.0, Header::default()));
        assert!(found.eq([kitchen(0.5), ("elsewhere".to_owned(), 0.5)]));
        assert_eq!([0.0, 60.0, 0.5].map(horizon), ["", "/in_60s", "/in_0_5s"]);
    }

    #[test]
    fn a_silent_daemon_is_an_error_and_none_at_all_is_stale() {
        let level =
            |scores: Option<&RoomScoresV1>| diagnostics(scores, 10_000_000_000, Header::default()).status[0].level;
        let scores = |published_ns| RoomScoresV1 { published_ns, ..Default::default() };
        assert_eq!((level(None), level(Some(&scores(1))), level(Some(&scores(9_900_000_000)))), (3, 2, 0));
    }
}
