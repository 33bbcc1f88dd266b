//! `docs/limits.md` is written from the constants that enforce each limit, and compared with them here.
//! `ROOMCAST_WRITE_LIMITS=1 cargo test --release --locked --workspace --features full --test it limits` writes it.

use std::fmt::Display;
use std::fmt::Write;
use std::path::Path;

use roomcast_core::narration::history::{KEPT_NS, OBSERVATIONS_MAX};
use roomcast_core::narration::{self, DAY_MINUTES_MAX, PERSONS_MAX, PROGRAM_BYTES_MAX, SENTENCE_BYTES_MAX, STEPS_MAX};
use roomcast_core::pipeline::SOURCES_MAX;
use roomcast_core::{grounding, guess, habits, prepared, prompt, semantic_map};
use roomcast_ipc::{
    DecisionV1, MAX_HORIZONS, MAX_ITEMS, MAX_PERSONS, MAX_ROOMS, MAX_SOURCES, Message, NAME_BYTES, NarrationV1,
    RoomScoresV1, question, sequence,
};
use roomcast_llama::{SEQUENCES_MAX, THREADS_MAX};
use roomcast_services::config::{self, Config};
use roomcast_services::daemon::{
    self, ANSWERS_REMEMBERED, FORMER_SOURCES_MAX, HELD_S, QUESTION_NAME_BYTES_MAX, SOURCES_OF_A_PORT,
};
use roomcast_services::mqtt::{link, look};
use roomcast_services::narrator::Faults;
use roomcast_services::{mqtt, recording, reporter, sensor_log};
use roomcast_simulation::trace::DAYS_MAX;

const HEAD: &str = "# Limits

What Roomcast accepts at most, and what happens beyond it. `tests/it/limits.rs` writes this page; the numbers in its tables are the constants of
the code. Limits of configured values are in `roomcast config`, those of `roomcast-zenoh` in `fleet.md`. A source counts once for each of its
starts.
";

/// Limits whose constants are of the program, or private.
const FOOT: &str = "
## By hand

These numbers are written by hand, and no test compares them with the code:

- A line of a sensor log has at most 8192 bytes. A longer one is reported and skipped.
- The home gives at most 10 000 persons a name. A change that would make more is refused.
- `roomcast model pull` fetches at most 64 GiB. A larger file is refused.
- An answer of Home Assistant has at most 64 MiB, and all questions of one connection take at most 60 s. Beyond that the command ends with an error.
- The ports of `metrics` and `view` each serve 16 connections at a time, with 16 KiB before the body and 5 s for each (`metrics.md`).
";

fn page() -> String {
    let intake = Config::default().daemon.intake;
    let mut page = HEAD.to_owned();
    let mut table = |title: &str, rows: &[(&str, &dyn Display, &str)]| {
        write!(page, "\n## {title}\n\n| what | at most | more |\n| --- | --- | --- |\n").unwrap();
        for (what, most, more) in rows {
            writeln!(page, "| {what} | {most} | {more} |").unwrap();
        }
    };
    table(
        "Maps",
        &[
            ("bytes of a scene file", &semantic_map::MAX_FILE_BYTES, "is refused"),
            ("items", &semantic_map::MAX_ITEMS, "is refused"),
            ("rooms", &semantic_map::MAX_ROOMS, "is refused"),
            ("corners of all footprints of a map", &semantic_map::MAX_CORNERS, "is refused"),
            ("pixels of a robot's map", &semantic_map::import::MAX_PIXELS, "is refused"),
            ("pixels of the rectangles around its rooms", &semantic_map::import::MAX_ROOM_PIXELS, "is refused"),
            ("bytes of an id or a label", &semantic_map::MAX_TEXT_BYTES, "is refused"),
            ("labels times partitions", &grounding::MAX_WEIGHTS, "is refused"),
            (
                "edges of footprints that are looked at to place items: for each item those of every footprint whose box it meets",
                &grounding::MAX_LOOKS,
                "is refused",
            ),
        ],
    );
    table(
        "Narration",
        &[
            ("bytes of a sentence", &SENTENCE_BYTES_MAX, "is refused by narrator and daemon"),
            ("bytes of an action's line", &narration::LINE_BYTES_MAX, "is refused"),
            ("bytes of an activity program", &PROGRAM_BYTES_MAX, "is refused"),
            ("steps of an activity program", &STEPS_MAX, "is refused"),
            ("minutes of a day of activities", &DAY_MINUTES_MAX, "is refused"),
            ("days of `roomcast-lab habits`", &DAYS_MAX, "is refused"),
            ("bytes of a binding sequence", &prompt::BINDING_BYTES_MAX, "is refused"),
            ("observations of a person's window", &OBSERVATIONS_MAX, "is refused in the configuration"),
            ("bytes of a line of narration, as JSON too", &narration::line::LINE_BYTES_MAX, "is reported and skipped"),
            ("narrators at once", &NarrationV1::SERVICE.publishers, "cannot join"),
            ("narrations a second of a narrator, by default", &intake.rate_per_s, "is dropped and counted"),
            ("narrations at once of a narrator, by default", &intake.burst, "is dropped and counted"),
            ("sources of a narrator", &SOURCES_OF_A_PORT, "its longest silent one is dropped"),
            ("sources in all", &SOURCES_MAX, "one whose process has ended is dropped"),
            (
                "dropped sources whose owner is remembered",
                &FORMER_SOURCES_MAX,
                "the oldest of the narrator with most are forgotten",
            ),
            (
                "persons",
                &PERSONS_MAX,
                "a visitor goes first; without visitors, the narrator that named most persons loses the one silent longest",
            ),
            ("unknown persons that one event counts", &narration::forms::COUNT_MAX, "is refused"),
            (
                "events that the daemon can explain to their narrators",
                &daemon::UNDERSTOOD_MAX,
                "the oldest is forgotten",
            ),
            ("numbers that a source skips at once", &sequence::JUMP_MAX, "is dropped and counted"),
            ("seconds that what a relayed narrator said above its rate is waited for", &HELD_S, "counts as missed"),
            (
                "seconds that a narrator keeps its places in a window",
                &(KEPT_NS / 1_000_000_000),
                "the oldest goes first",
            ),
            ("narrators named in the configuration", &config::KNOWN_NARRATORS_MAX, "is refused"),
        ],
    );
    table(
        "Prepared answers",
        &[
            ("answers kept at once, of all persons", &prepared::ANSWERS_MAX, "no further one is prepared"),
            ("bytes of a sentence that is guessed", &guess::SENTENCE_BYTES_MAX, "is not learned for guesses"),
            ("forms of sentences", &guess::FORMS_MAX, "learning for guesses begins again"),
            ("counts of what follows what, and of things", &guess::COUNTS_MAX, "learning for guesses begins again"),
        ],
    );
    let options = Config::default().habits.options();
    table(
        "Habits",
        &[
            ("persons of whom something is learned", &habits::PERSONS_MAX, "whoever was learned least of gives way"),
            ("names of things", &options.names_max, "the one seen longest ago gives way"),
            ("contexts, of 28 bytes", &options.contexts_max, "the least useful gives way"),
            ("blocks of four counts, of 28 bytes", &options.blocks_max, "the least useful gives way"),
            ("bytes of the file", &habits::BYTES_MAX, "is set aside"),
            ("bytes of an import", &daemon::IMPORT_BYTES_MAX, "is refused"),
        ],
    );
    table(
        "Messages",
        &[
            ("bytes of a name", &NAME_BYTES, "is refused; of items and labels, cut"),
            ("rooms", &MAX_ROOMS, "is refused with the map"),
            ("sources that scores name", &MAX_SOURCES, "each narrator's newest are named"),
            ("persons with scores of their own", &MAX_PERSONS, "those observed last are sent"),
            ("items with scores", &MAX_ITEMS, "the best are sent"),
            ("horizons of a forecast", &MAX_HORIZONS, "-"),
            ("bytes of a question", &question::QUESTION_BYTES_MAX, "is refused"),
            ("bytes of the name of a question that asks for a change", &QUESTION_NAME_BYTES_MAX, "is refused"),
            ("answers of a service that are remembered", &ANSWERS_REMEMBERED, "the oldest is forgotten"),
            ("bytes of an answer in shared memory", &question::ANSWER_BYTES_MAX, "lies in a file of the root path"),
            (
                "files of long answers of a service",
                &question::ANSWER_FILES_MAX,
                "the oldest is removed, and asked for again",
            ),
            (
                "subscribers of scores, which narrators, planners, drivers of robots, bridges, metrics, view, top and recorders are",
                &RoomScoresV1::SERVICE.subscribers,
                "cannot join",
            ),
            ("robots", &DecisionV1::SERVICE.publishers, "cannot join"),
        ],
    );
    table(
        "Models and the decoder",
        &[
            ("paths in one decoder call", &SEQUENCES_MAX, "is refused in the configuration"),
            ("threads of one decoder call", &THREADS_MAX, "is refused in the configuration"),
        ],
    );
    table(
        "Files and MQTT",
        &[
            ("bytes of the configuration", &config::FILE_BYTES_MAX, "is refused"),
            ("bytes of a sensor log", &sensor_log::FILE_BYTES_MAX, "is refused"),
            ("malformed lines of it that are told of by number", &Faults::TOLD, "is counted"),
            ("bytes of a line of `roomcast report`", &reporter::LINE_BYTES_MAX, "is reported and skipped"),
            ("bytes of a recording, unpacked", &recording::FILE_BYTES_MAX, "is refused"),
            ("bytes of a record or chunk of a recording", &recording::RECORD_BYTES_MAX, "is refused"),
            ("rules for MQTT", &mqtt::RULES_MAX, "is refused"),
            ("bytes of a file of rules, credentials or certificates", &sensor_log::RULES_BYTES_MAX, "is refused"),
            ("topics that init and doctor look at", &look::TOPICS_MAX, "is passed over"),
            ("bytes that init and doctor keep of them", &look::BYTES_MAX, "the topic is noted without them"),
            ("lines of rules for MQTT that wait for silence", &mqtt::WAITING_MAX, "are not said"),
            ("bytes of these lines", &mqtt::WAITING_BYTES_MAX, "are not said"),
            ("topics that are remembered", &mqtt::TOPICS_MAX, "is not remembered"),
            ("bytes of a packet", &mqtt::PACKET_BYTES_MAX, "the broker drops it"),
            ("bytes of a payload", &mqtt::PAYLOAD_BYTES_MAX, "is dropped and counted, with its topic in the log"),
            ("messages that the broker sends ahead", &mqtt::MESSAGES_AHEAD_MAX, "wait at the broker"),
            ("bytes of what it sends further ahead all the same", &mqtt::HELD_BYTES_MAX, "the oldest is said at once"),
            ("messages of bridge or robot that wait to be sent", &link::SAYING_MAX, "wait until there is room"),
            ("bytes that wait to be read by bridge or robot", &link::HEARING_BYTES_MAX, "the oldest give way"),
            (
                "bytes of what topics of the bridge begin with",
                &config::TOPIC_BYTES_MAX,
                "is refused in the configuration",
            ),
            ("horizons that the bridge tells of", &config::BRIDGE_HORIZONS_MAX, "is refused in the configuration"),
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
