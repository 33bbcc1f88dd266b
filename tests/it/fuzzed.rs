//! The fuzz targets of `fuzz/` for some seconds, over their corpus and seeded mutations of it. `ROOMCAST_FUZZ_RUNS=1000000` sets the mutations of
//! each target, `ROOMCAST_FUZZ_SEED` the seed.
//!
//! Damaged model files, too: truncated, with flipped bits and with extreme numbers. Each is loaded in its own process.

use std::panic::catch_unwind;
use std::path::Path;
use std::process::Command;

use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::correction::Correction;
use roomcast_core::scorer::{LabelScores, Method, Scorer, Tokenisation};
use roomcast_ipc::raw::{ByteImage, NarrationV1, PersonForecastsV1, PersonScoresV1, RoomScoresV1};
use roomcast_ipc::text;
use roomcast_llama::{LlamaModel, LlamaOptions};
use roomcast_services::embedded;
use roomcast_services::recording::{Received, Recorded, Recorder};

#[path = "../../fuzz/targets.rs"]
mod targets;

use roomcast_cli::exit_code;

use crate::number;

/// Mutations of each target by default; targets that write files get fewer.
const RUNS: u64 = 20_000;
const MODELS: usize = 12;

/// The corpus of a target, and files that the product ships or writes.
fn seeds(target: &str) -> Vec<Vec<u8>> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target);
    let files = std::fs::read_dir(&corpus).unwrap_or_else(|error| panic!("{}: {error}", corpus.display()));
    let mut files: Vec<_> = files.map(|file| file.unwrap().path()).collect();
    files.sort();
    let mut seeds: Vec<_> = files.iter().map(|file| std::fs::read(file).unwrap()).collect();
    match target {
        "configuration" => seeds.push(roomcast_services::config::DEFAULT_TOML.as_bytes().to_vec()),
        "program" => seeds.extend(embedded::PROGRAMS.iter().map(|program| program.text.as_bytes().to_vec())),
        "scene" => seeds.push(embedded::SCENES[0].text.as_bytes().to_vec()),
        "journal" => seeds.push(journal_bytes()),
        "message" => seeds.extend([narration(), scores(), persons(), person_forecasts()]),
        "recording" => seeds.push(recording()),
        "sensors" => seeds.push(include_bytes!("../data/sensors.tsv").to_vec()),
        _ => {}
    }
    assert!(!seeds.is_empty(), "{} is empty", corpus.display());
    seeds
}

/// A journal of an earlier version.
fn journal_bytes() -> Vec<u8> {
    let record = |letter: u8, payload: &[u8]| {
        let (length, checksum) = ((payload.len() as u32).to_le_bytes(), crc32fast::hash(payload).to_le_bytes());
        [b"RCJ".as_slice(), &[letter], &length, &checksum, payload].concat()
    };
    let name = [7_u64, 1, 3].map(u64::to_le_bytes).concat();
    let said = |rest: &[u8]| [&name, &[0; 36][..], rest].concat();
    let outcome = [&name, &[4, 0, 0, 0, 0][..], &[9; 8], &0.25_f32.to_le_bytes()].concat();
    [
        record(b'1', &said(b"They do thing 1.")),
        record(b'3', &said(&[&[1, 3][..], b"adaaway"].concat())),
        record(b'5', &outcome),
        record(b'B', &[&name, &[8, 0, 0, 0, 1 << 2, 3][..], b"Ada"].concat()),
        record(b'6', &[&name[..16], &[3; 16]].concat()),
    ]
    .concat()
}

fn recording() -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("seed.mcap");
    let mut recorder = Recorder::create(&path).unwrap();
    for sequence in 1..4 {
        let message = NarrationV1::new(1, "[Grab] <mug> (1)").unwrap();
        let message = NarrationV1 { source: 7, epoch: 1, sequence, ..message };
        let received = Received { unix_ns: UnixNs(sequence), monotonic_ns: BootNs(sequence) };
        recorder.write(&Recorded::Narration(Box::new(message)), received).unwrap();
    }
    recorder.finish().unwrap();
    std::fs::read(path).unwrap()
}

fn narration() -> Vec<u8> {
    let message = NarrationV1::new(1, "[Grab] <mug> (1)").unwrap();
    let message = NarrationV1 { source: 7, epoch: 1, sequence: 1, ..message };
    [vec![0], message.to_bytes()].concat()
}

fn scores() -> Vec<u8> {
    let mut scores = RoomScoresV1 { epoch: 3, sequence: 1, room_count: 2, label_mass: 0.8, ..Default::default() };
    for (room, (id, probability)) in scores.room.iter_mut().zip([("kitchen", 0.75), ("bathroom", 0.25)]) {
        room.id = text::encode("room id", id).unwrap();
        room.probability = probability;
    }
    [vec![1], scores.to_bytes()].concat()
}

fn persons() -> Vec<u8> {
    let mut scores =
        PersonScoresV1 { epoch: 3, sequence: 1, room_count: 1, persons: 1, person_count: 1, ..Default::default() };
    scores.id[0] = text::encode("room id", "kitchen").unwrap();
    scores.person[0].probability[0] = 1.0;
    [vec![4], scores.to_bytes()].concat()
}

fn person_forecasts() -> Vec<u8> {
    let mut forecasts =
        PersonForecastsV1 { room_count: 1, horizon_count: 2, person_count: 1, ..PersonForecastsV1::default() };
    forecasts.id[0] = text::encode("room id", "kitchen").unwrap();
    forecasts.horizon_s[1] = 5.0;
    forecasts.person[0].probability[0][..2].copy_from_slice(&[1.0, 0.5]);
    [vec![6], forecasts.to_bytes()].concat()
}

fn mutate(bytes: &mut Vec<u8>, seeds: &[Vec<u8>], rng: &mut ChaCha8Rng) {
    for _ in 0..rng.random_range(1..6) {
        let at = rng.random_range(0..=bytes.len());
        match rng.random_range(0..8) {
            0 if at < bytes.len() => bytes[at] ^= 1 << rng.random_range(0..8),
            1 if at < bytes.len() => bytes[at] = rng.random(),
            2 => bytes.truncate(at),
            3 => {
                let more: Vec<u8> = (0..rng.random_range(1..20)).map(|_| rng.random()).collect();
                bytes.splice(at..at, more);
            }
            4 => {
                let end = rng.random_range(at..=bytes.len());
                bytes.drain(at..end.min(at + 64));
            }
            5 => {
                // A part of this or of another seed.
                let other = seeds.choose(rng).unwrap();
                let from = rng.random_range(0..=other.len());
                let piece = other[from..other.len().min(from + 200)].to_vec();
                bytes.splice(at..at, piece);
            }
            6 => {
                let extreme = [0, 1, u64::MAX, 1 << 31, 1 << 63, f64::NAN.to_bits()].choose(rng).unwrap().to_le_bytes();
                let length = [1, 2, 4, 8].choose(rng).unwrap();
                let end = (at + length).min(bytes.len());
                bytes.splice(at..end, extreme[..*length].iter().copied());
            }
            _ => {
                let word: &[u8] = [
                    &b"-1"[..],
                    b"1e999",
                    b"nan",
                    b"\"\"",
                    b"[[",
                    b"{}",
                    b"null",
                    b"\xff\xfe",
                    "\u{202e}".as_bytes(),
                    b"\0",
                    b"RCJ1",
                    b"99999999999999999999",
                    b"\n",
                    b"<s>",
                    b"\\u0000",
                ]
                .choose(rng)
                .unwrap();
                bytes.splice(at..at, word.iter().copied());
            }
        }
    }
}

#[test]
fn no_target_fails_on_its_corpus_or_mutations_of_it() {
    let seed = number("ROOMCAST_FUZZ_SEED").unwrap_or(1);
    for &(name, target) in targets::ALL {
        let seeds = seeds(name);
        for bytes in &seeds {
            target(bytes);
        }
        let slow = if matches!(name, "gguf" | "scene") { 10 } else { 1 };
        let runs = number("ROOMCAST_FUZZ_RUNS").unwrap_or(RUNS) / slow;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for run in 0..runs {
            let mut bytes = seeds.choose(&mut rng).unwrap().clone();
            mutate(&mut bytes, &seeds, &mut rng);
            if catch_unwind(|| target(&bytes)).is_err() {
                let file = std::env::temp_dir().join(format!("roomcast-fuzz-{name}-{seed}-{run}"));
                std::fs::write(&file, &bytes).unwrap();
                panic!("{name}: mutation {run} of seed {seed} fails; its bytes are in {}", file.display());
            }
        }
        println!("{name}: {} files of the corpus and {runs} mutations", seeds.len());
    }
}

/// Exit code of a process that loads the model, or the signal that ended it.
fn load(model: &[u8], directory: &Path) -> Result<i32, String> {
    let file = directory.join("model.gguf");
    std::fs::write(&file, model).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_roomcast")).args(["model", "rehearse"]).arg(&file).output().unwrap();
    output.status.code().ok_or_else(|| format!("{}: {}", output.status, String::from_utf8_lossy(&output.stderr)))
}

#[test]
fn a_broken_model_file_ends_in_an_error() {
    let directory = tempfile::tempdir().unwrap();
    let whole = embedded::MODEL;
    assert_eq!(load(whole, directory.path()), Ok(0));
    let runs = number("ROOMCAST_FUZZ_MODELS").map_or(MODELS, |runs| usize::try_from(runs).unwrap());
    let mut rng = ChaCha8Rng::seed_from_u64(number("ROOMCAST_FUZZ_SEED").unwrap_or(1));
    // The header has metadata and tensor descriptions; the rest is weights.
    let header = whole.windows(24).position(|at| at.starts_with(b"output_norm.weight")).unwrap();
    let mut codes = std::collections::BTreeMap::new();
    for run in 0..runs {
        let mut model = whole.to_vec();
        let at = rng.random_range(0..header);
        match run % 3 {
            0 => model.truncate(rng.random_range(0..whole.len())),
            1 => model[at] ^= 1 << rng.random_range(0..8),
            _ => {
                let extreme: u32 = *[0, 1, 2, 255, i32::MAX as u32, u32::MAX].choose(&mut rng).unwrap();
                model[at..at + 4].copy_from_slice(&extreme.to_le_bytes());
            }
        }
        let code = load(&model, directory.path()).unwrap_or_else(|died| panic!("run {run}, at {at}: {died}"));
        if run % 3 == 0 {
            assert_eq!(code, i32::from(exit_code::MODEL), "a truncated file is refused");
        }
        *codes.entry(code).or_insert(0) += 1;
    }
    println!("{runs} damaged model files, by exit code: {codes:?}");
}

/// Key, offset and size of each number in a model file's metadata.
fn fields(model: &[u8]) -> Vec<(String, usize, usize)> {
    let number = |at: usize, size: usize| {
        let mut bytes = [0; 8];
        bytes[..size].copy_from_slice(&model[at..at + size]);
        usize::try_from(u64::from_le_bytes(bytes)).unwrap()
    };
    // Sizes by kind of value. A text (8) starts with its length, an array (9) with the kind and number of its elements.
    let size = |kind: usize| [1, 1, 2, 2, 4, 4, 4, 1, 0, 0, 8, 8, 8][kind];
    let mut fields = vec![("version".to_owned(), 4, 4), ("tensors".to_owned(), 8, 8), ("metadata".to_owned(), 16, 8)];
    let mut at = 24;
    for _ in 0..number(16, 8) {
        let length = number(at, 8);
        let key = String::from_utf8(model[at + 8..at + 8 + length].to_vec()).unwrap();
        at += 8 + length;
        let kind = number(at, 4);
        fields.push((format!("kind of {key}"), at, 4));
        at += 4;
        at += match kind {
            8 => 8 + number(at, 8),
            9 => {
                let (kind, count) = (number(at, 4), number(at + 4, 8));
                fields.push((format!("length of {key}"), at + 4, 8));
                let elements = match kind {
                    8 => (0..count).fold(0, |length, _| length + 8 + number(at + 12 + length, 8)),
                    kind => count * size(kind),
                };
                12 + elements
            }
            kind => {
                fields.push((key, at, size(kind)));
                size(kind)
            }
        };
    }
    fields
}

/// The attack: a GGUF file with one changed field. `model check` and `score` must end with an exit code, not by a signal. `ROOMCAST_FUZZ_MODELS` sets
/// the number of changed fields.
#[test]
#[ignore = "full"]
fn a_model_file_with_one_field_patched_ends_no_judge() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("patched.gguf");
    let whole = embedded::MODEL;
    let fields = fields(whole);
    assert!(fields.iter().any(|(key, ..)| key == "llama.block_count"), "{fields:?}");
    let runs = number("ROOMCAST_FUZZ_MODELS").map_or(20, |runs| usize::try_from(runs).unwrap());
    let mut rng = ChaCha8Rng::seed_from_u64(number("ROOMCAST_FUZZ_SEED").unwrap_or(1));
    let mut codes = std::collections::BTreeMap::new();
    for run in 0..runs {
        let (key, at, size) = fields.choose(&mut rng).unwrap();
        let extreme: u64 = *[0, 1, 2, 3, 255, 65_537, 1 << 31, u64::from(u32::MAX), u64::MAX].choose(&mut rng).unwrap();
        let mut model = whole.to_vec();
        model[*at..at + size].copy_from_slice(&extreme.to_le_bytes()[..*size]);
        std::fs::write(&file, model).unwrap();
        for arguments in [["model", "check"].as_slice(), &["score", "--narration", "They sit.", "--model"]] {
            let output = Command::new(env!("CARGO_BIN_EXE_roomcast")).args(arguments).arg(&file).output().unwrap();
            let said = String::from_utf8_lossy(&output.stderr);
            let code = output.status.code();
            let code = code
                .unwrap_or_else(|| panic!("run {run}, {key} = {extreme}, {arguments:?}: {}: {said}", output.status));
            assert!(code <= i32::from(exit_code::CHECK), "run {run}, {key} = {extreme}, {arguments:?}: {code}: {said}");
            *codes.entry((arguments[0], code)).or_insert(0) += 1;
        }
    }
    println!("{runs} patched fields, by command and exit code: {codes:?}");
}

/// The attack: a model file is truncated in place.
#[test]
fn a_model_file_that_is_cut_off_while_it_is_in_use_ends_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("model.gguf");
    std::fs::write(&file, embedded::MODEL).unwrap();
    let model = LlamaModel::load(&file, &LlamaOptions::default()).unwrap();
    std::fs::File::options().write(true).open(&file).unwrap().set_len(0).unwrap();
    let mut scorer = Scorer::new(model);
    let binding = BindingSequence::default();
    let prepared = scorer.prepare(&["mug"], &binding, Tokenisation::Joint, Correction::default()).unwrap();
    let mut scores = LabelScores::default();
    scorer.score(&prepared, "They walk to the kitchen.", Method::Trie, &mut scores).unwrap();
    assert!(scores.log_prob_nats.iter().all(|score| score.is_finite()));
}
