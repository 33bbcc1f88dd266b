//! `roomcast doctor`: checks whether this machine can run Roomcast, and how well; and with a configuration, the home's set-up. Every finding that is
//! not good has a remedy.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use comfy_table::Table;
use roomcast_ipc::Domain;
use roomcast_ipc::raw::NarrationV1;
use rustix::process::{Resource, getrlimit};

mod finding;
mod home;
#[cfg(feature = "whole")]
mod home_mqtt;
#[cfg(feature = "whole")]
mod remarks;

use finding::{Finding, Place, Verdict};
#[cfg(feature = "whole")]
pub(super) use remarks::Remarks;

use super::scene::is_missing;
use super::{CommandResult, Failure, ranges, service};
use crate::columns::{columns, wrapped};
use crate::exit_code;
use roomcast_core::grounding::Grounding;
use roomcast_core::narration::{Observation, Program, Sentence};
use roomcast_core::scorer::LanguageModel;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::text::visible_lines;
use roomcast_llama::{CacheType, LlamaModel};
use roomcast_services::config::Config;
use roomcast_services::embedded;
use roomcast_services::logging::chain;
use roomcast_services::setup;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// A GGUF model to check in place of the configured one.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// A scene to check in place of the configured one.
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// Seconds to listen to the topics of the configuration's broker.
    #[arg(long, value_name = "SECONDS", default_value_t = 5.0, value_parser = ranges::time_s)]
    wait: f64,
    /// Print JSON, for a report to the developers.
    #[arg(long)]
    json: bool,
}

/// The names in a configuration file and its rules that do not exist: faults that prevent a run, and faults that only limit it.
pub(super) fn names(config: &Config, map: Option<&SemanticMap>, file: &Path) -> (Vec<String>, Vec<String>) {
    let grounding = map.and_then(|map| Grounding::new(map, &config.grounding).ok());
    let place = Place { config: file, wait: Duration::ZERO };
    let (mut wrong, mut limited) = (Vec::new(), Vec::new());
    for Finding { verdict, found, remedy, .. } in home::names(config, map.zip(grounding.as_ref()), &place) {
        let text = format!("{found}: {}", remedy.unwrap_or_default());
        match verdict {
            Verdict::Good => {}
            Verdict::Limited => limited.push(text),
            Verdict::Wrong => wrong.push(text),
        }
    }
    (wrong, limited)
}

/// Vector units that llama.cpp has kernels for: ggml's name, whether this processor has the unit, and whether a build without it counts as a fault.
fn vector_units() -> Vec<(&'static str, bool, bool)> {
    #[cfg(target_arch = "x86_64")]
    let units = vec![
        ("AVX2", std::is_x86_feature_detected!("avx2"), true),
        ("FMA", std::is_x86_feature_detected!("fma"), true),
        ("F16C", std::is_x86_feature_detected!("f16c"), true),
        ("AVX_VNNI", std::is_x86_feature_detected!("avxvnni"), false),
        ("AVX512", std::is_x86_feature_detected!("avx512f"), false),
        ("AVX512_VNNI", std::is_x86_feature_detected!("avx512vnni"), false),
    ];
    #[cfg(target_arch = "aarch64")]
    let units = vec![
        ("NEON", std::arch::is_aarch64_feature_detected!("neon"), true),
        ("DOTPROD", std::arch::is_aarch64_feature_detected!("dotprod"), true),
        ("MATMUL_INT8", std::arch::is_aarch64_feature_detected!("i8mm"), false),
        ("SVE", std::arch::is_aarch64_feature_detected!("sve"), false),
    ];
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    let units = Vec::new();
    units
}

fn processor() -> Finding {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let units: Vec<_> = vector_units().iter().filter(|unit| unit.1).map(|unit| unit.0).collect();
    let found = format!("{}, {cores} cores, {}", std::env::consts::ARCH, units.join(" "));
    if cores < 2 {
        let remedy = "with one core the model competes with everything else; give it two or more";
        return Finding::limited("processor", found, remedy);
    }
    Finding::good("processor", found)
}

fn llama_build() -> Finding {
    let check = "llama.cpp";
    let built = match roomcast_llama::build_features() {
        Ok(built) => built,
        Err(error) => return Finding::wrong(check, chain(&error), "build Roomcast again"),
    };
    let missing = |fault: bool| {
        let units =
            vector_units().into_iter().filter(|unit| unit.1 && unit.2 == fault && !built.iter().any(|b| b == unit.0));
        units.map(|unit| unit.0).collect::<Vec<_>>()
    };
    // A portable build has kernels for many processors. It reports the kernels that it chose for this one.
    let how = if cfg!(feature = "portable") { "portable, chosen here:" } else { "built with" };
    let found = format!("{how} {}", built.join(" "));
    let remedy = "build on this machine with -C target-cpu=native, as .cargo/config.toml in the source does; docs/packaging.md has portable ways";
    let (faults, limits) = (missing(true), missing(false));
    if !faults.is_empty() {
        let found = format!("{found}; without {}, which this processor has: several times slower", faults.join(" "));
        return Finding::wrong(check, found, remedy);
    }
    if !limits.is_empty() {
        return Finding::limited(
            check,
            format!("{found}; without {}, which this processor has", limits.join(" ")),
            remedy,
        );
    }
    Finding::good(check, found)
}

/// Bytes that iceoryx2's segments of all services take together, with room to spare.
const SHARED_MEMORY_BYTES_MIN: u64 = 64 << 20;

fn shared_memory() -> Finding {
    let check = "shared memory";
    let remedy = "mount a tmpfs of 64 MB or more on /dev/shm (docker run --shm-size=256m), or free some";
    match rustix::fs::statvfs("/dev/shm") {
        Ok(about) => {
            let megabytes = |blocks: u64| blocks.saturating_mul(about.f_frsize) as f64 / 1e6;
            let found =
                format!("/dev/shm: {:.0} of {:.0} MB free", megabytes(about.f_bavail), megabytes(about.f_blocks));
            if about.f_bavail.saturating_mul(about.f_frsize) < SHARED_MEMORY_BYTES_MIN {
                Finding::wrong(check, found, remedy)
            } else {
                Finding::good(check, found)
            }
        }
        Err(error) => Finding::wrong(check, format!("/dev/shm: {error}"), remedy),
    }
}

/// Joins the domain, which tests its root directory, and opens services in a private one, which disturbs no other process.
fn messages(domain: &Domain) -> Finding {
    let check = "messages";
    let root = match tempfile::tempdir() {
        Ok(root) => root,
        Err(error) => return Finding::wrong(check, error.to_string(), "make the folder for temporary files writable"),
    };
    let tried = domain.open("roomcast-doctor").and_then(|_| {
        // A separate root: cleaning up removes it with all its content.
        let private = Domain::new(root.path().join("ipc"), &format!("doctor-{}", std::process::id()))?;
        let node = private.open("roomcast-doctor")?;
        let (publisher, subscriber) = (node.publisher::<NarrationV1>()?, node.subscriber::<NarrationV1>()?);
        let connected = publisher.subscribers();
        drop((publisher, subscriber, node));
        private.clean_up()?;
        Ok(connected)
    });
    match tried {
        Ok(connected) if connected > 0 => Finding::good(
            check,
            format!("iceoryx2 {} opens services under {}", roomcast_ipc::ICEORYX2_VERSION, domain.root().display()),
        ),
        Ok(_) => Finding::wrong(
            check,
            "a subscriber is not seen by its publisher",
            "see whether /dev/shm is the same for all processes (PrivateTmp, containers)",
        ),
        Err(error) => Finding::wrong(
            check,
            chain(&error),
            "all participants run as one user, with the same root directory, which that user owns",
        ),
    }
}

fn open_files() -> Finding {
    let limit = getrlimit(Resource::Nofile).current;
    let found = limit.map_or("unlimited".into(), |limit| limit.to_string());
    match limit {
        Some(limit) if limit < 512 => {
            Finding::wrong("open files", found, "ulimit -n 4096, or LimitNOFILE=4096 in the unit")
        }
        _ => Finding::good("open files", found),
    }
}

fn locked_memory(wanted: bool, model_bytes: u64) -> Finding {
    let limit = getrlimit(Resource::Memlock).current;
    let found = limit.map_or("unlimited".into(), |limit| format!("{:.1} MB", limit as f64 / 1e6));
    match limit {
        Some(limit) if wanted && limit < model_bytes => Finding::wrong(
            "locked memory",
            format!("{found}, the model has {:.1} MB and model.lock_memory asks for it", model_bytes as f64 / 1e6),
            "LimitMEMLOCK=infinity in the unit, or model.lock_memory = false",
        ),
        _ => Finding::good("locked memory", found),
    }
}

/// Loads scene and model as the daemon does, each with a finding, and times events of an included program if both are good.
fn model_and_scene(config: &Config) -> (Vec<Finding>, Option<(SemanticMap, Grounding)>) {
    let (scene, map) = scene(config);
    let (model, loaded) = model(config);
    let mut findings = vec![scene, model];
    if let (Some((map, _)), Some(loaded)) = (&map, loaded) {
        findings.push(speed(config, map, loaded));
    }
    (findings, map)
}

fn shown(path: Option<&Path>, embedded: &str) -> String {
    path.map_or(embedded.to_owned(), |path| path.display().to_string())
}

fn scene(config: &Config) -> (Finding, Option<(SemanticMap, Grounding)>) {
    let path = config.scene.path.as_deref();
    let read = setup::load_map(path).and_then(|map| {
        let grounding = Grounding::new(&map, &config.grounding)?;
        Ok((map, grounding))
    });
    let (map, grounding) = match read {
        Ok(read) => read,
        Err(error) => {
            let remedy = "roomcast scene check FILE names every fault; without scene.path the included studio is used";
            return (Finding::wrong("scene", chain(&error), remedy), None);
        }
    };
    let found = format!(
        "{}: {}, {} of {}",
        shown(path, "studio (embedded)"),
        super::count(map.rooms().len(), "room"),
        super::count(map.items().len(), "item"),
        super::count(map.labels().len(), "label")
    );
    let finding = match grounding.unassigned().len() {
        0 => Finding::good("scene", found),
        outside => Finding::limited(
            "scene",
            format!("{found}; {} in no partition", super::count(outside, "item")),
            "roomcast scene check FILE lists them",
        ),
    };
    (finding, Some((map, grounding)))
}

fn model(config: &Config) -> (Finding, Option<LlamaModel>) {
    let remedy = "roomcast model check FILE; without model.path the embedded household model is used";
    if let Err(failure) = super::model::try_configured(config) {
        return (Finding::wrong("model", failure.to_string(), remedy), None);
    }
    let loading = Instant::now();
    match setup::configured_model(config) {
        Ok(model) => {
            let about = model.info();
            let found = format!(
                "{}: {}, {}, {}, loads in {:.0} ms",
                shown(config.model.path.as_deref(), embedded::MODEL_NAME),
                about.name,
                about.architecture,
                about.description,
                loading.elapsed().as_secs_f64() * 1e3
            );
            let finding = match &about.weakness {
                None => Finding::good("model", found),
                Some(reason) => Finding::wrong("model", format!("{found}; its scores are noise: {reason}"), remedy),
            };
            (finding, Some(model))
        }
        Err(error) => (Finding::wrong("model", chain(&error), remedy), None),
    }
}

/// The time of each event of an included program in milliseconds, sorted.
fn times_ms(config: &Config, map: &SemanticMap, model: LlamaModel) -> Result<Vec<f64>, Box<dyn std::error::Error>> {
    let mut pipeline = setup::open_with(config, map, |_| Ok(model))?;
    let sentences = Program::parse(embedded::PROGRAMS[0].text).map(|program| program.steps).unwrap_or_default();
    let sentences: Vec<_> = sentences.iter().filter_map(|action| Sentence::new(&action.sentence()).ok()).collect();
    let mut times_ms = Vec::new();
    for (sequence, sentence) in (1..).zip(sentences) {
        let scoring = Instant::now();
        pipeline.step([Observation::of(sequence, sentence)])?;
        times_ms.push(scoring.elapsed().as_secs_f64() * 1e3);
        while pipeline.idle().tidy() {}
    }
    times_ms.sort_by(f64::total_cmp);
    Ok(times_ms)
}

fn median(sorted: &[f64]) -> f64 {
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

/// The type of the key-value cache with which events take clearly less time, and its median. Single measurements on a busy machine differ by a fifth.
fn faster_cache(config: &Config, map: &SemanticMap, used: CacheType, median_ms: f64) -> Option<(CacheType, f64)> {
    let others = [CacheType::Q8, CacheType::F16, CacheType::Mixed].into_iter().filter(|other| *other != used);
    let measured = others.filter_map(|cache| {
        let mut config = config.clone();
        config.model.cache = cache;
        let model = setup::configured_model(&config).ok()?;
        Some((cache, median(&times_ms(&config, map, model).ok()?)))
    });
    let fastest = measured.min_by(|a, b| a.1.total_cmp(&b.1));
    fastest.filter(|(_, ms)| *ms < 0.8 * median_ms)
}

fn speed(config: &Config, map: &SemanticMap, model: LlamaModel) -> Finding {
    let cache = model.options().cache;
    let times_ms = match times_ms(config, map, model) {
        Ok(times_ms) => times_ms,
        Err(error) => return Finding::wrong("speed", chain(&*error), "roomcast model check FILE"),
    };
    let (median_ms, worst_ms) = (median(&times_ms), times_ms.last().copied().unwrap_or(f64::NAN));
    let mut found =
        format!("an event is scored in {median_ms:.1} ms (median of {}, worst {worst_ms:.1} ms)", times_ms.len());
    // A slow model would be measured for minutes.
    if median_ms < 200.0
        && let Some((faster, ms)) = faster_cache(config, map, cache, median_ms)
    {
        found.push_str(&format!("; with model.cache = \"{faster}\" in {ms:.1} ms"));
    }
    if median_ms > 1_000.0 {
        let remedy = "a smaller model or a smaller quantisation (Q4_0), more cores, a shorter history";
        return Finding::limited("speed", found, remedy);
    }
    Finding::good("speed", found)
}

pub fn run(args: &Args) -> CommandResult {
    let (mut config, domain) = match args.service.load() {
        Ok(loaded) => loaded,
        Err(failure) => {
            let remedy = match args.service.config_file().is_some_and(|path| !path.is_file()) {
                true => "give --config the file that roomcast init has written (roomcast.toml)",
                false => "correct the line that it names; roomcast config prints every key",
            };
            report(args, &[Finding::wrong("configuration", failure.to_string(), remedy)])?;
            return Err(Failure::new(failure.code, "the configuration cannot be used; nothing else was checked"));
        }
    };
    config.model.path = args.model.clone().or(config.model.path);
    config.scene.path = args.scene.clone().or(config.scene.path);
    let model_bytes = match &config.model.path {
        Some(path) => std::fs::metadata(path).map_or(0, |about| about.len()),
        None => embedded::MODEL.len() as u64,
    };
    let mut findings = vec![
        processor(),
        llama_build(),
        shared_memory(),
        messages(&domain),
        open_files(),
        locked_memory(config.model.lock_memory, model_bytes),
    ];
    let (found, map) = model_and_scene(&config);
    findings.extend(found);
    if let Some(path) = args.service.config_file() {
        let place = Place { config: path, wait: Duration::from_secs_f64(args.wait) };
        findings.extend(home::checks(&config, map.as_ref().map(|(map, grounding)| (map, grounding)), &domain, &place));
    }
    report(args, &findings)?;
    let wrong = findings.iter().filter(|finding| finding.verdict == Verdict::Wrong).count();
    // A missing map has one exit code in all commands.
    let is_missing = config.scene.path.as_deref().is_some_and(is_missing);
    let code = if is_missing { exit_code::INPUT } else { exit_code::CHECK };
    match wrong {
        0 => Ok(()),
        1 => Err(Failure::new(code, "one check failed; the report has the remedy")),
        wrong => Err(Failure::new(code, format!("{wrong} checks failed; the report has the remedies"))),
    }
}

const LINE: usize = 120;

fn report(args: &Args, findings: &[Finding]) -> CommandResult {
    if !args.json {
        return super::print_styled(&format!("{}\n", table(findings, columns().min(LINE))));
    }
    let ok = findings.iter().all(|finding| finding.verdict != Verdict::Wrong);
    super::print_json(&serde_json::json!({ "version": env!("CARGO_PKG_VERSION"), "ok": ok, "findings": findings }))
}

/// A table of at most `columns` columns, except for longer words. The table fits itself to a terminal, but a pipe has no width.
fn table(findings: &[Finding], columns: usize) -> Table {
    const BEFORE: usize = 28;
    let mut table = super::table(&["check", "", "found, and what to do"]);
    for finding in findings {
        let mark = match finding.verdict {
            Verdict::Good => "good",
            Verdict::Limited => "limited",
            Verdict::Wrong => "WRONG",
        };
        let mark = comfy_table::Cell::new(mark);
        #[cfg(feature = "whole")]
        let mark = mark.fg(match finding.verdict {
            Verdict::Good => comfy_table::Color::Green,
            Verdict::Limited => comfy_table::Color::Yellow,
            Verdict::Wrong => comfy_table::Color::Red,
        });
        // Parts of the text are untrusted, for instance a broker's topics.
        let found = visible_lines(&finding.found);
        let text = match &finding.remedy {
            Some(remedy) => format!("{found}\n-> {}", visible_lines(remedy)),
            None => found.into_owned(),
        };
        let text = wrapped(&text, columns.saturating_sub(BEFORE).max(BEFORE), 0);
        table.add_row([comfy_table::Cell::new(finding.check), mark, comfy_table::Cell::new(text)]);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_in_a_pipe_has_lines_of_120_columns() {
        let topics: Vec<String> = (0..60).map(|number| format!("homeassistant/light/lamp_{number}/state")).collect();
        let long = Finding::limited("unnamed topics", topics.join(", "), "write rules for these topics, or leave them");
        let shown = table(&[Finding::good("scene", "two rooms"), long], LINE).to_string();
        let longest = shown.lines().map(|line| line.trim_end().chars().count()).max();
        assert!(longest.is_some_and(|columns| columns <= LINE && columns > LINE / 2), "{longest:?}:\n{shown}");
        assert!(topics.iter().all(|topic| shown.contains(topic)), "no topic is broken:\n{shown}");
        assert!(shown.lines().count() > 20 && shown.contains("-> write rules"));
    }
}
