//! `docs/limits.md` is generated from the constants that enforce each limit, and compared with them here.
//! `ROOMCAST_WRITE_LIMITS=1 cargo test --release --locked --workspace --features full --test it limits` writes it.

use std::fmt::Display;
use std::fmt::Write;
use std::path::Path;

use roomcast_core::narration::history::{KEPT_NS, OBSERVATIONS_MAX};
use roomcast_core::narration::{self, PERSONS_MAX, PROGRAM_BYTES_MAX, SENTENCE_BYTES_MAX, STEPS_MAX};
use roomcast_core::pipeline::SOURCES_MAX;
use roomcast_core::{grounding, guess, habits, prepared, prompt, semantic_map};
use roomcast_ipc::raw::{
    DecisionV1, MAX_HORIZONS, MAX_ITEMS, MAX_PERSONS, MAX_ROOMS, MAX_SOURCES, Message, NAME_BYTES, NarrationV1,
    RoomScoresV1,
};
use roomcast_ipc::{question, sequence};
use roomcast_llama::{SEQUENCES_MAX, THREADS_MAX};
use roomcast_services::config::{self, Config};
use roomcast_services::daemon::{
    self, ANSWERS_REMEMBERED, FORMER_SOURCES_MAX, HELD_S, QUESTION_NAME_BYTES_MAX, SOURCES_OF_A_PORT,
};
use roomcast_services::mqtt::{link, look};
use roomcast_services::narrator::Faults;
use roomcast_services::{mqtt, recording, reporter, sensor_log};
use roomcast_simulation::homer::DAY_MINUTES_MAX;
use roomcast_simulation::trace::DAYS_MAX;

const HEAD: &str = "# Limits

What Roomcast accepts at most. `tests/it/limits.rs` writes the tables from the constants of the code. `roomcast config` states the limits of
configured values, and [fleet](fleet.md) those of `roomcast-zenoh`. A source is one start of a narrator.
";

/// Limits with constants in the program's crate, or with private ones.
const FOOT: &str = "
## Others

No test compares these with the code.

| limit | value | beyond it |
| --- | --- | --- |
| bytes of a line of a sensor log | 8 KiB | skipped and reported |
| persons with a name that the home gave | 1 000 | the change is refused |
| bytes that `roomcast model pull` fetches | 64 GiB | refused |
| bytes of an answer of Home Assistant | 64 MiB | the command ends with an error |
| seconds for all questions of one connection to Home Assistant | 60 | the command ends with an error |
| connections at a time to the port of `metrics` or `view` | 16 | [Metrics](metrics.md#limits) |
";

/// Whole KiB, MiB or GiB for bytes; other numbers with a space after every three digits.
fn readable(what: &str, value: &str) -> String {
    let Ok(number) = value.parse::<u64>() else { return value.to_owned() };
    if what.starts_with("bytes") {
        for (unit, bytes) in [("GiB", 1_u64 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)] {
            if number >= bytes && number.is_multiple_of(bytes) {
                return format!("{} {unit}", number / bytes);
            }
        }
    }
    let mut text = value.to_owned();
    for place in (1..value.len()).filter(|place| (value.len() - place).is_multiple_of(3)).rev() {
        text.insert(place, ' ');
    }
    text
}

fn page() -> String {
    let intake = Config::default().daemon.intake;
    let mut page = HEAD.to_owned();
    let mut table = |title: &str, rows: &[(&str, &dyn Display, &str)]| {
        write!(page, "\n## {title}\n\n| limit | value | beyond it |\n| --- | --- | --- |\n").unwrap();
        for (what, most, more) in rows {
            writeln!(page, "| {what} | {} | {more} |", readable(what, &most.to_string())).unwrap();
        }
    };
    table(
        "Maps",
        &[
            ("bytes of a map file", &semantic_map::MAX_FILE_BYTES, "refused"),
            ("items", &semantic_map::MAX_ITEMS, "refused"),
            ("rooms", &semantic_map::MAX_ROOMS, "refused"),
            ("corners of all outlines", &semantic_map::MAX_CORNERS, "refused"),
            ("pixels of a robot's map", &semantic_map::import::MAX_PIXELS, "refused"),
            ("pixels of the rectangles around its rooms", &semantic_map::import::MAX_ROOM_PIXELS, "refused"),
            ("bytes of an id or a label", &semantic_map::MAX_TEXT_BYTES, "refused"),
            ("labels times partitions", &grounding::MAX_WEIGHTS, "refused"),
            (
                "edges compared to place items: for each item, those of all outlines with a box around it",
                &grounding::MAX_LOOKS,
                "refused",
            ),
        ],
    );
    table(
        "Narration",
        &[
            ("bytes of a sentence", &SENTENCE_BYTES_MAX, "refused by narrator and daemon"),
            ("bytes of an action's line", &narration::LINE_BYTES_MAX, "refused"),
            ("bytes of an activity program", &PROGRAM_BYTES_MAX, "refused"),
            ("steps of an activity program", &STEPS_MAX, "refused"),
            ("minutes of a day of activities", &DAY_MINUTES_MAX, "refused"),
            ("days of `roomcast-lab habits`", &DAYS_MAX, "refused"),
            ("bytes of `scoring.binding`", &prompt::BINDING_BYTES_MAX, "refused"),
            ("events of a person's window", &OBSERVATIONS_MAX, "refused in the configuration"),
            ("bytes of a line of narration, also as JSON", &narration::line::LINE_BYTES_MAX, "skipped and reported"),
            ("narrators at once", &NarrationV1::SERVICE.publishers, "cannot join"),
            ("events of a narrator in a second, by default", &intake.rate_per_s, "dropped and counted"),
            ("events of a narrator at once, by default", &intake.burst, "dropped and counted"),
            ("sources of a narrator", &SOURCES_OF_A_PORT, "the one silent longest is dropped"),
            ("sources in all", &SOURCES_MAX, "one of an ended process is dropped"),
            (
                "dropped sources with a remembered owner",
                &FORMER_SOURCES_MAX,
                "the oldest of the narrator with most are forgotten",
            ),
            (
                "persons",
                &PERSONS_MAX,
                "first a visitor is dropped; without visitors, the narrator with most persons loses the one silent longest",
            ),
            ("unknown persons in one event", &narration::forms::COUNT_MAX, "refused"),
            ("sensors", &daemon::SENSORS_MAX, "the narrator with most loses the one silent longest"),
            ("events that the daemon can explain to narrators", &daemon::UNDERSTOOD_MAX, "the oldest is forgotten"),
            ("numbers that a source skips at once", &sequence::JUMP_MAX, "dropped and counted"),
            (
                "seconds that the daemon waits until a relayed narrator sends its events above the rate again",
                &HELD_S,
                "counted as missed",
            ),
            (
                "seconds that a narrator keeps its places in a window",
                &(KEPT_NS / 1_000_000_000),
                "the oldest event is dropped first",
            ),
            ("narrators named in the configuration", &config::KNOWN_NARRATORS_MAX, "refused"),
        ],
    );
    table(
        "Prefetched answers",
        &[
            ("answers at once, for all persons", &prepared::ANSWERS_MAX, "no further prefetch"),
            ("bytes of a sentence", &guess::SENTENCE_BYTES_MAX, "not prefetched"),
            ("forms of sentences", &guess::FORMS_MAX, "the learned sequences are dropped"),
            ("counts of sequences and things", &guess::COUNTS_MAX, "the learned sequences are dropped"),
        ],
    );
    let options = Config::default().habits.options();
    table(
        "Habits",
        &[
            ("persons with habits", &habits::PERSONS_MAX, "the person with the fewest events is dropped"),
            ("names of things", &options.names_max, "the one with the fewest counts gives way"),
            ("contexts", &options.contexts_max, "the least useful are dropped"),
            ("counts", &options.counts_max, "the least useful contexts are dropped"),
            ("bytes of the file", &habits::BYTES_MAX, "set aside"),
            ("bytes of an import", &daemon::IMPORT_BYTES_MAX, "refused"),
        ],
    );
    table(
        "Messages",
        &[
            ("bytes of a name", &NAME_BYTES, "refused; items, labels, narrators, planners and robots are cut"),
            ("rooms", &MAX_ROOMS, "refused with the map"),
            ("sources named in scores", &MAX_SOURCES, "the newest of each narrator are named"),
            ("persons with separate scores", &MAX_PERSONS, "those with the latest events are sent"),
            ("items with scores", &MAX_ITEMS, "the best are sent"),
            ("horizons of a forecast", &MAX_HORIZONS, "-"),
            ("bytes of a question", &question::QUESTION_BYTES_MAX, "refused"),
            ("bytes of the name of a question that changes something", &QUESTION_NAME_BYTES_MAX, "refused"),
            ("remembered answers of a service", &ANSWERS_REMEMBERED, "the oldest is forgotten"),
            ("bytes of an answer in shared memory", &question::ANSWER_BYTES_MAX, "written to a file in the root path"),
            (
                "files of long answers of a service",
                &question::ANSWER_FILES_MAX,
                "the oldest is removed, and asked for again",
            ),
            (
                "subscribers of scores: narrators, planners, robot drivers, publishers, bridges, metrics, view, top, recorders",
                &RoomScoresV1::SERVICE.subscribers,
                "cannot join",
            ),
            ("robots", &DecisionV1::SERVICE.publishers, "cannot join"),
        ],
    );
    table(
        "Models and the decoder",
        &[
            ("paths in one decoder call", &SEQUENCES_MAX, "refused in the configuration"),
            ("threads of one decoder call", &THREADS_MAX, "refused in the configuration"),
        ],
    );
    table(
        "Files and MQTT",
        &[
            ("bytes of the configuration", &config::FILE_BYTES_MAX, "refused"),
            ("bytes of a sensor log", &sensor_log::FILE_BYTES_MAX, "refused"),
            ("malformed lines reported by number", &Faults::TOLD, "counted"),
            ("bytes of a line of `roomcast report`", &reporter::LINE_BYTES_MAX, "skipped and reported"),
            ("bytes of a recording, unpacked", &recording::FILE_BYTES_MAX, "refused"),
            ("bytes of a record or chunk of a recording", &recording::RECORD_BYTES_MAX, "refused"),
            ("rules for MQTT", &mqtt::RULES_MAX, "refused"),
            ("bytes of a file of rules, credentials or certificates", &sensor_log::RULES_BYTES_MAX, "refused"),
            ("topics that `init` and `doctor` read", &look::TOPICS_MAX, "ignored"),
            ("bytes of payloads that they keep", &look::BYTES_MAX, "noted without the payload"),
            ("events that wait for `quiet_s`", &mqtt::WAITING_MAX, "dropped"),
            ("bytes of these events", &mqtt::WAITING_BYTES_MAX, "dropped"),
            (
                "topics whose last value the narrator remembers",
                &mqtt::TOPICS_MAX,
                "equal values of further topics are used again",
            ),
            ("bytes of a packet", &mqtt::PACKET_BYTES_MAX, "dropped by the broker"),
            ("bytes of a payload", &mqtt::PAYLOAD_BYTES_MAX, "dropped and counted; the log names the topic"),
            ("messages that the broker sends ahead", &mqtt::MESSAGES_AHEAD_MAX, "wait at the broker"),
            ("bytes that it sends further ahead all the same", &mqtt::HELD_BYTES_MAX, "the oldest is used at once"),
            ("messages that publisher or robot driver queue", &link::SAYING_MAX, "wait until there is room"),
            (
                "unread bytes of messages in publisher or robot driver",
                &link::HEARING_BYTES_MAX,
                "the oldest are dropped",
            ),
            ("bytes of `bridge.topic`", &config::TOPIC_BYTES_MAX, "refused in the configuration"),
            ("values in `bridge.horizons_s`", &config::BRIDGE_HORIZONS_MAX, "refused in the configuration"),
        ],
    );
    page.push_str(FOOT);
    page
}

#[test]
fn the_page_states_the_limits_of_the_code() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/limits.md");
    if std::env::var_os("ROOMCAST_WRITE_LIMITS").is_some() {
        std::fs::write(&path, page()).unwrap();
    }
    let written = std::fs::read_to_string(&path).unwrap();
    assert!(written == page(), "docs/limits.md differs from the code; write it again with ROOMCAST_WRITE_LIMITS=1");
}
