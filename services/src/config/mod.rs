//! The configuration: one TOML file for daemon, planner and narrator. `default.toml` in this folder is the manual: every key with its
//! default, its limits and its cost.

use std::fmt;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use roomcast_ipc::own_file::require_own_folder;
use roomcast_ipc::raw::NAME_BYTES;
use roomcast_ipc::{Domain, IpcError};
use rustix::fs::Access;
use rustix::io::Errno;
use serde::{Deserialize, Serialize};

use roomcast_core::forecast::ForecastOptions;
use roomcast_core::grounding::GroundingOptions;
use roomcast_core::narration::history::{HistoryLimits, OBSERVATIONS_MAX, PERSONS_MAX};
use roomcast_core::narration::{check_name, same_but_for_accents};
use roomcast_core::parsing::{keyed, toml_says};
use roomcast_core::pipeline::PipelineOptions;
use roomcast_core::prepared::ANSWERS_MAX;
use roomcast_core::prompt::{BINDING_BYTES_MAX, BindingSequence};
use roomcast_core::scorer::certified::Effort;
use roomcast_core::scorer::correction::{Continuation, PRIOR_WEIGHTS};
use roomcast_core::scorer::{Method, Tokenisation};
use roomcast_core::text::{count, excerpt, read_text_at_most};
use roomcast_llama::{CacheType, LlamaOptions, SEQUENCES_MAX, THREADS_MAX};

use crate::embedded;

mod house;
mod sections;

pub use house::{OnlyWhen, QUIET_MAX, QuietHours, RoomNeeds, WhileAsleep, clock_time, is_room, weekday_name};
pub use sections::{
    BridgeConfig, DaemonConfig, Forced, HabitsConfig, IntakeLimits, KnownNarrator, May, MetricsConfig, MqttConfig,
    NarratorConfig, OnPause, PersonsConfig, PlannerConfig, Reports, RobotConfig, RobotKind,
};

/// The commented default configuration, as a file to start from.
pub const DEFAULT_TOML: &str = include_str!("default.toml");

/// Most bytes of a configuration file.
pub const FILE_BYTES_MAX: u64 = 1 << 20;
/// Longest step under `effort = "deadline"`, in milliseconds.
pub const DEADLINE_MS_MAX: u64 = 60_000;
/// Longest time that daemon and planner poll after a message, in microseconds.
pub const SPIN_US_MAX: u64 = 10_000_000;
/// Longest time between two heartbeats, in milliseconds: views and bridges treat a daemon as gone after 1.5 s of silence, which is at least
/// three heartbeats.
const HEARTBEAT_MS_MAX: u64 = 500;

/// Most entries of `[[daemon.narrator]]`.
pub const KNOWN_NARRATORS_MAX: usize = 64;

/// Most bytes of the prefix of topics.
pub const TOPIC_BYTES_MAX: usize = 64;
/// Most bytes of a sensor's topic, which contains the robot's topic.
const SENSOR_TOPIC_BYTES_MAX: usize = 256;
/// Most horizons of the bridge.
pub const BRIDGE_HORIZONS_MAX: usize = 8;

const NOT_PERSONS_MAX: usize = 256;

/// Least bytes of events: a few of the longest sentences fit.
const JOURNAL_BYTES_MIN: u64 = 8192;

/// A configuration that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("failed to read the configuration {path}: {source}{}", if source.kind() == std::io::ErrorKind::NotFound { "; `roomcast config > FILE` makes one" } else { "" })]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is larger than [`FILE_BYTES_MAX`].
    #[error("the configuration {path} has more than {FILE_BYTES_MAX} bytes: that is no configuration file")]
    TooLarge {
        /// The file.
        path: PathBuf,
    },
    /// The text is not TOML, or has an unknown key or a value of the wrong kind.
    #[error("the configuration {path} has {}:\n{}\nsee `roomcast config` for every key with its default", count(faults.len(), "fault"), faults.join("\n"))]
    Parse {
        /// The file.
        path: PathBuf,
        /// The faults, with line and column.
        faults: Vec<String>,
    },
    /// A value outside its limits.
    #[error("the configuration's {key} is {value}: {remedy}")]
    Value {
        /// The key, with its section.
        key: &'static str,
        /// The value.
        value: String,
        /// The allowed values.
        remedy: String,
    },
    /// Several of these faults.
    #[error("{} things are wrong:{}", .0.len(), .0.iter().map(|fault| format!("\n- {fault}")).collect::<String>())]
    Several(Vec<Self>),
    /// The section `[ipc]` does not name a domain.
    #[error("the configuration's section [ipc] cannot be used: {0}")]
    Domain(#[from] IpcError),
    /// A fault in a file.
    #[error("{path}: {fault}")]
    InFile {
        /// The file.
        path: PathBuf,
        /// The fault.
        fault: Box<Self>,
    },
}

struct Limit {
    key: &'static str,
    value: String,
    holds: bool,
    remedy: String,
}

fn within<T: PartialOrd + fmt::Display>(key: &'static str, value: T, range: RangeInclusive<T>) -> Limit {
    let remedy = format!("give {} to {}", range.start(), range.end());
    Limit { key, holds: range.contains(&value), value: value.to_string(), remedy }
}

/// A folder cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NoFolder {
    /// The reason.
    pub reason: String,
    /// The remedy; `None` if only another folder helps.
    pub remedy: Option<&'static str>,
}

/// The path, or its nearest parent that exists. An error gives the reason why it cannot be a folder.
fn there(path: &Path) -> Result<&Path, String> {
    if path.as_os_str().as_encoded_bytes().contains(&0) {
        return Err("no path has a NUL byte".to_owned());
    }
    // A path of one name is in the current folder. A dangling link is in the way, too.
    let above = path.ancestors().map(|path| if path.as_os_str().is_empty() { Path::new(".") } else { path });
    let there = above.into_iter().find(|path| path.symlink_metadata().is_ok()).unwrap_or(Path::new("/"));
    if there.is_dir() { Ok(there) } else { Err(format!("{} is no folder", there.display())) }
}

/// The reason why this user cannot use a folder; `None` if it exists or can be created.
#[must_use]
pub fn no_folder(path: &Path) -> Option<NoFolder> {
    let there = match there(path) {
        Ok(there) => there,
        Err(reason) => return Some(NoFolder { reason, remedy: None }),
    };
    let error = rustix::fs::access(there, Access::WRITE_OK | Access::EXEC_OK).err()?;
    let remedy = match error {
        Errno::ACCESS | Errno::PERM => {
            Some("run this as the user that the services run as, or give that user the folder")
        }
        Errno::ROFS => Some("mount its disk so that it can be written: mount -o remount,rw"),
        _ => None,
    };
    Some(NoFolder { reason: format!("cannot write into {}: {error}", there.display()), remedy })
}

fn folder_fault(key: &'static str, folder: &Path, fault: NoFolder) -> ConfigError {
    let remedy = format!("{}; {}", fault.reason, fault.remedy.unwrap_or("give another folder"));
    ConfigError::Value { key, value: folder.display().to_string(), remedy }
}

const SECONDS_MAX: f64 = 1e9;

/// The whole configuration; every section and key is optional.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The model.
    #[serde(deserialize_with = "keyed")]
    pub model: ModelConfig,
    /// The semantic map.
    #[serde(deserialize_with = "keyed")]
    pub scene: SceneConfig,
    /// The scoring of labels.
    #[serde(deserialize_with = "keyed")]
    pub scoring: ScoringConfig,
    /// The grounding of scores.
    #[serde(deserialize_with = "keyed")]
    pub grounding: GroundingOptions,
    /// The history window of each person.
    #[serde(deserialize_with = "keyed")]
    pub history: HistoryLimits,
    /// The domain of the processes.
    #[serde(deserialize_with = "keyed")]
    pub ipc: IpcConfig,
    /// The daemon.
    #[serde(deserialize_with = "keyed")]
    pub daemon: DaemonConfig,
    /// The residents.
    #[serde(deserialize_with = "keyed")]
    pub persons: PersonsConfig,
    /// The forecast's assumptions about a new person.
    #[serde(deserialize_with = "keyed")]
    pub forecast: ForecastOptions,
    /// Learning of habits.
    #[serde(deserialize_with = "keyed")]
    pub habits: HabitsConfig,
    /// The planner.
    #[serde(deserialize_with = "keyed")]
    pub planner: PlannerConfig,
    /// The narrator.
    #[serde(deserialize_with = "keyed")]
    pub narrator: NarratorConfig,
    /// Metrics for Prometheus.
    #[serde(deserialize_with = "keyed")]
    pub metrics: MetricsConfig,
    /// The MQTT broker.
    #[serde(deserialize_with = "keyed")]
    pub mqtt: MqttConfig,
    /// The publication over MQTT.
    #[serde(deserialize_with = "keyed")]
    pub bridge: BridgeConfig,
    /// The robot that `roomcast robot` drives.
    #[serde(deserialize_with = "keyed")]
    pub robot: RobotConfig,
}

/// The section `[ipc]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IpcConfig {
    /// The domain's root path; by default the user's own.
    pub root: Option<PathBuf>,
    /// The domain's name.
    pub domain: String,
    /// Time for which daemon and planner poll after a message before they sleep, in microseconds.
    pub spin_us: u64,
}

impl Default for IpcConfig {
    fn default() -> Self {
        Self { root: None, domain: Domain::DEFAULT_NAME.to_owned(), spin_us: 0 }
    }
}

impl IpcConfig {
    /// The domain of this section.
    ///
    /// # Errors
    /// If a domain cannot have the root path or name.
    pub fn domain(&self) -> Result<Domain, IpcError> {
        let root = self.root.clone().unwrap_or_else(Domain::default_root);
        Domain::new(root, &self.domain)
    }
}

/// The section `[model]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// A GGUF file; by default the embedded model.
    pub path: Option<PathBuf>,
    /// The required SHA-256 of the file, in hexadecimal; by default any.
    pub sha256: Option<String>,
    /// Threads of one decoder call; 0 means one per core of `cores`, or all cores but one if that is empty.
    pub threads: usize,
    /// Cores for the scorer, by number; any if empty.
    pub cores: Vec<usize>,
    /// Positions of prompt and labels together.
    pub context_tokens: u32,
    /// Paths of the label trie in one decoder call.
    pub sequences: u32,
    /// The type of the key-value cache.
    pub cache: CacheType,
    /// Lock the weights in memory.
    pub lock_memory: bool,
}

impl Default for ModelConfig {
    fn default() -> Self {
        let LlamaOptions { context_tokens, sequences, cache, lock_memory, .. } = LlamaOptions::default();
        Self { path: None, sha256: None, threads: 0, cores: Vec::new(), context_tokens, sequences, cache, lock_memory }
    }
}

impl ModelConfig {
    /// The options for loading.
    #[must_use]
    pub fn llama_options(&self) -> LlamaOptions {
        let default = LlamaOptions::default();
        LlamaOptions {
            threads: match (self.threads, self.cores.len()) {
                (0, 0) => default.threads,
                (0, cores) => cores,
                (threads, _) => threads,
            },
            context_tokens: self.context_tokens,
            sequences: self.sequences,
            cache: self.cache,
            lock_memory: self.lock_memory,
        }
    }
}

/// The section `[scene]`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SceneConfig {
    /// The scene file; by default the shipped studio flat.
    pub path: Option<PathBuf>,
}

/// The section `[scoring]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ScoringConfig {
    /// The name of a built-in binding sequence, or any text.
    pub binding: String,
    /// The method of scoring.
    pub method: Method,
    /// The tokenisation of prompt and label.
    pub tokenisation: Tokenisation,
    /// The competitors of a label's later tokens; by default as the model file recommends.
    pub continuation: Option<Continuation>,
    /// The prior weight, 0 to 1; by default as the model file recommends.
    pub prior: Option<f64>,
    /// When scoring stops.
    pub effort: Effort,
    /// Longest step under `effort = "deadline"`, in milliseconds.
    pub deadline_ms: u64,
    /// Number of likely next sentences to prefetch; 0 for none.
    pub prepare: usize,
    /// Share of one core for the prefetcher.
    pub prepare_share: f64,
    /// Whether to prefetch on battery power.
    pub prepare_on_battery: bool,
    /// Whether the embedded model helps to guess next sentences for another model.
    pub draft: bool,
}

impl Default for ScoringConfig {
    fn default() -> Self {
        Self {
            binding: "default".into(),
            method: Method::default(),
            tokenisation: Tokenisation::default(),
            continuation: None,
            prior: None,
            effort: Effort::default(),
            deadline_ms: PipelineOptions::default().deadline_ns / 1_000_000,
            prepare: 32,
            prepare_share: 0.25,
            prepare_on_battery: true,
            draft: true,
        }
    }
}

// Not `toml::from_str` in other crates: each would compile the parser of each section again, 300 kB in the program.
impl std::str::FromStr for Config {
    type Err = toml::de::Error;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        toml::from_str(text)
    }
}

/// Most faults of a text that an error names.
const FAULTS_MAX: usize = 20;

/// The faults of a text that is no configuration. The parser stops at its first one; without the lines of that fault it finds the next.
fn faults_of(mut text: String, first: toml::de::Error) -> Vec<String> {
    let mut faults = vec![toml_says(&first)];
    let mut last = first;
    // What a text means after a fault of TOML itself is a guess.
    let is_toml = text.parse::<toml::Table>().is_ok();
    while let Some(span) = last.span().filter(|_| is_toml && faults.len() < FAULTS_MAX) {
        without_lines(&mut text, span);
        match text.parse::<Config>() {
            Err(error) if error.span() != last.span() => {
                faults.push(toml_says(&error));
                last = error;
            }
            _ => break,
        }
    }
    faults
}

/// Empties the lines of a span, and with the head of a section the section. The other lines keep their numbers.
fn without_lines(text: &mut String, span: std::ops::Range<usize>) {
    let begin = text[..span.start].rfind('\n').map_or(0, |at| at + 1);
    let next = |from: usize, what: &str| text[from..].find(what).map_or(text.len(), |at| from + at);
    let end = match text[begin..].trim_start().starts_with('[') {
        true => next(span.start, "\n["),
        false => next(span.end.max(begin), "\n"),
    };
    let lines = text[begin..end].matches('\n').count();
    text.replace_range(begin..end, &"\n".repeat(lines));
}

impl Config {
    /// Reads and checks a configuration file. Relative paths in it start at its folder.
    ///
    /// # Errors
    /// When it cannot be read, has unknown keys, or a value outside its limits.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let config = Self::read(path)?;
        config.check().map_err(|fault| ConfigError::InFile { path: path.to_owned(), fault: Box::new(fault) })?;
        Ok(config)
    }

    /// As [`Self::load`], without the check of limits.
    ///
    /// # Errors
    /// When it cannot be read, or has unknown keys.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let read = |source| ConfigError::Read { path: path.to_owned(), source };
        let text = read_text_at_most(path, FILE_BYTES_MAX).map_err(|source| match source.kind() {
            std::io::ErrorKind::FileTooLarge => ConfigError::TooLarge { path: path.to_owned() },
            _ => read(source),
        })?;
        let mut config: Self = text
            .parse()
            .map_err(|error| ConfigError::Parse { path: path.to_owned(), faults: faults_of(text, error) })?;
        let file = std::path::absolute(path).map_err(read)?;
        config.begin_paths_at(file.parent().unwrap_or(Path::new("/")), sections::state_of_service());
        Ok(config)
    }

    /// Makes relative paths absolute, except `ipc.root`, which is never relative. A state directory in the file's folder is for a start by
    /// hand. A service has a directory from systemd, and may not write to the file's folder.
    fn begin_paths_at(&mut self, folder: &Path, state_of_service: Option<PathBuf>) {
        if let (Some(state), Some(of_service)) = (&mut self.daemon.state, state_of_service)
            && state.is_relative()
            && !state.as_os_str().is_empty()
        {
            *state = of_service;
        }
        // The name of a shipped scene is not a path.
        let is_shipped = |path: &Path| !folder.join(path).exists() && path.to_str().and_then(embedded::scene).is_some();
        let scene = Some(&mut self.scene.path).filter(|path| !path.as_deref().is_some_and(is_shipped));
        let MqttConfig { credentials, ca, rules, .. } = &mut self.mqtt;
        let others = [&mut self.model.path, &mut self.daemon.state, credentials, ca, rules];
        for path in scene.into_iter().chain(others).filter_map(Option::as_mut) {
            // The check rejects an empty path.
            if !path.as_os_str().is_empty() {
                *path = folder.join(&*path);
            }
        }
    }

    /// Checks every limit that the types do not enforce.
    ///
    /// # Errors
    /// All values outside their limits.
    pub fn check(&self) -> Result<(), ConfigError> {
        let mut faults = self.faults();
        match faults.len() {
            0 => Ok(()),
            1 => Err(faults.remove(0)),
            _ => Err(ConfigError::Several(faults)),
        }
    }

    /// All values outside their limits.
    #[must_use]
    pub fn faults(&self) -> Vec<ConfigError> {
        let limits = self.limits().into_iter().filter(|limit| !limit.holds);
        let value =
            |Limit { key, value, remedy, .. }| ConfigError::Value { key, value: excerpt(&value).into_owned(), remedy };
        let values = limits.map(value);
        let others = [self.binding().err(), self.ipc.domain().err().map(ConfigError::from)];
        values.chain(others.into_iter().flatten()).collect()
    }

    /// The fault of the domain's root path on this machine, as far as it can be seen. It does not check permission to create the path,
    /// since systemd creates it for a service.
    #[must_use]
    pub fn root_fault(&self) -> Option<ConfigError> {
        let root = self.ipc.root.as_ref()?;
        let reason = there(root).err()?;
        Some(folder_fault("ipc.root", root, NoFolder { reason, remedy: None }))
    }

    /// The fault of the state directory on this machine, as far as it can be seen.
    #[must_use]
    pub fn state_fault(&self) -> Option<ConfigError> {
        let folder = self.daemon.state_directory()?;
        if let Err(fault) = require_own_folder(&folder) {
            let (value, remedy) = (folder.display().to_string(), fault.to_string());
            return Some(ConfigError::Value { key: "daemon.state", value, remedy });
        }
        Some(folder_fault("daemon.state", &folder, no_folder(&folder)?))
    }

    /// Every limit, and whether it holds. One function has all, so that each limit of the configuration stands in one table.
    fn limits(&self) -> Vec<Limit> {
        let Self { model, scoring, history, daemon, persons, forecast, habits, planner, metrics, narrator, .. } = self;
        let (ipc, bridge, vacuum) = (&self.ipc, &self.bridge, &self.robot);
        let row = |key, value: &dyn fmt::Display, holds, remedy: &str| Limit {
            key,
            value: value.to_string(),
            holds,
            remedy: remedy.to_owned(),
        };
        let is_name = |name: &str| {
            !name.trim().is_empty() && name.len() <= NAME_BYTES && !name.contains(roomcast_core::text::is_hidden)
        };
        let is_topic_of = |topic: &str, bytes_max: usize| {
            let plain = !topic.starts_with('$')
                && !topic.contains(['+', '#'])
                && !topic.contains(roomcast_core::text::is_hidden);
            topic.len() <= bytes_max && plain && topic.split('/').all(|level| !level.is_empty())
        };
        let is_topic = |topic: &str| is_topic_of(topic, TOPIC_BYTES_MAX);
        let is_sensor = |topic: &str| is_topic_of(topic, SENSOR_TOPIC_BYTES_MAX);
        let topics =
            format!("an MQTT topic of 1 to {TOPIC_BYTES_MAX} bytes without wildcards, and without a slash at its ends");
        let ahead = format!("{:?}", bridge.horizons_s);
        let rises = |times: &[f64]| {
            times.iter().all(|time| (1.0..=86_400.0).contains(time)) && times.is_sorted_by(|one, next| one < next)
        };
        let is_sum = |sum: &String| sum.len() == 64 && sum.bytes().all(|digit| digit.is_ascii_hexdigit());
        let is_free = |directory: &PathBuf| !directory.as_os_str().is_empty();
        let cores = format!("{:?}", model.cores);
        let each_core_once = (1..).zip(&model.cores).all(|(next, core)| !model.cores[next..].contains(core));
        let sum = model.sha256.clone().unwrap_or_default();
        let effort = scoring.effort;
        let prior = scoring.prior.unwrap_or_default();
        let IntakeLimits { rate_per_s, burst } = daemon.intake;
        let residents = format!("{:?}", persons.residents);
        let not_persons = format!("{:?}", persons.not_persons);
        let is_one_of = |name: &str, names: &[String]| names.iter().any(|other| same_but_for_accents(other, name));
        // A number, or a name that `person rename` accepts.
        let is_person = |name: &String| name.trim().parse::<u32>().is_ok() || check_name(name).is_ok();
        // Each name is compared with each, so the number is limited first.
        let are_few = persons.residents.len() <= PERSONS_MAX && persons.not_persons.len() <= NOT_PERSONS_MAX;
        let each_name_once =
            !are_few || (1..).zip(&persons.residents).all(|(next, name)| !is_one_of(name, &persons.residents[next..]));
        let are_no_residents =
            !are_few || persons.not_persons.iter().all(|name| is_name(name) && !is_one_of(name, &persons.residents));
        let known = &daemon.narrator;
        let names = format!("{:?}", known.iter().map(|known| &known.name).collect::<Vec<_>>());
        let each_narrator_once = (1..)
            .zip(known)
            .all(|(next, one)| is_name(&one.name) && known[next..].iter().all(|other| one.name != other.name));
        let of_each = |value: &dyn Fn(&KnownNarrator) -> String| known.iter().map(value).collect::<Vec<_>>().join(", ");
        let (trust, share) = (of_each(&|known| known.trust.to_string()), of_each(&|known| known.share.to_string()));
        let rates = of_each(&|known| known.rate_per_s.map_or_else(String::new, |rate_per_s| rate_per_s.to_string()));
        let is_rate = |rate_per_s: f64| rate_per_s >= 0.0 && rate_per_s.is_finite();
        let (robot, name) = (format!("{:?}", planner.robot), format!("{:?}", narrator.name));
        let listen = metrics.listen.map(|address| address.to_string()).unwrap_or_default();
        let on_loopback = metrics.listen.is_none_or(|address| address.ip().is_loopback());
        let battery = format!("{:?}", vacuum.battery.as_deref().unwrap_or_default());
        let seconds = 0.0..=SECONDS_MAX;
        let round_s = planner.round_s.unwrap_or_default();
        let plain = format!("1 to {NAME_BYTES} bytes of text without control characters");
        let means = 1e-3..=SECONDS_MAX;
        let (low, ready) = (planner.battery_low, planner.battery_ready);
        let list = |values: Vec<Option<f64>>| format!("{:?}", values.into_iter().flatten().collect::<Vec<_>>());
        let needs = format!("{:?}", planner.room.iter().map(|room| &room.id).collect::<Vec<_>>());
        let each_room_once = (1..)
            .zip(&planner.room)
            .all(|(next, one)| is_name(&one.id) && planner.room[next..].iter().all(|other| one.id != other.id));
        let of_needs = |holds: &dyn Fn(&RoomNeeds) -> bool| planner.room.iter().all(holds);
        let every = list(planner.room.iter().map(|room| room.every_s).collect());
        let time = list(planner.room.iter().map(|room| room.time_s).collect());
        let priority = list(planner.room.iter().map(|room| Some(room.priority)).collect());
        let (resume, interrupt) = (planner.resume_at, planner.interrupt_at);
        #[rustfmt::skip]
        let limits = vec![
            row("model.threads", &model.threads, model.threads <= THREADS_MAX, &format!("give 0 (automatic) to {THREADS_MAX}")),
            within("model.context_tokens", model.context_tokens, 64..=1 << 20),
            within("model.sequences", model.sequences, 1..=SEQUENCES_MAX),
            row("model.cores", &cores, each_core_once, "name each core once"),
            row("model.sha256", &sum, model.sha256.as_ref().is_none_or(is_sum), "give 64 hexadecimal digits, as sha256sum prints them"),
            within("history.observations", history.observations, 1..=OBSERVATIONS_MAX),
            within("history.slack", history.slack, 0..=OBSERVATIONS_MAX),
            row("history.tokens", &history.tokens, history.tokens >= 16, "give 16 or more"),
            row("history.gap_s", &history.gap_s, history.gap_s as f64 <= SECONDS_MAX, &format!("give 0 (no limit) to {SECONDS_MAX}")),
            within("scoring.deadline_ms", scoring.deadline_ms, 1..=DEADLINE_MS_MAX),
            within("scoring.prior", prior, PRIOR_WEIGHTS),
            within("scoring.prepare", scoring.prepare, 0..=ANSWERS_MAX),
            within("scoring.prepare_share", scoring.prepare_share, 0.01..=1.0),
            row("scoring.effort", &effort, scoring.method.allows(effort), "give \"exact\", or scoring.method = \"trie\", which alone can end early"),
            within("ipc.spin_us", ipc.spin_us, 0..=SPIN_US_MAX),
            row("daemon.state", &"empty", daemon.state.as_ref().is_none_or(is_free), "give a directory, or leave the key out for no database"),
            row("daemon.journal_bytes", &daemon.journal_bytes, daemon.journal_bytes >= JOURNAL_BYTES_MIN, &format!("give {JOURNAL_BYTES_MIN} or more")),
            within("daemon.heartbeat_ms", daemon.heartbeat_ms, 10..=HEARTBEAT_MS_MAX),
            row("daemon.hang_s", &daemon.hang_s, daemon.hang_s >= 1, "give 1 or more"),
            row("daemon.intake.rate_per_s", &rate_per_s, is_rate(rate_per_s), "give 0 (no limit) or more"),
            row("daemon.intake.burst", &burst, burst >= 1.0 && burst.is_finite(), "give 1 or more"),
            row("daemon.narrator.name", &names, known.len() <= KNOWN_NARRATORS_MAX && each_narrator_once, &format!("give at most {KNOWN_NARRATORS_MAX} names, each once, of {plain}")),
            row("daemon.narrator.trust", &trust, known.iter().all(|known| (1..=100).contains(&known.trust)), "give 1 to 100"),
            row("daemon.narrator.share", &share, known.iter().all(|known| (1..=100).contains(&known.share)), "give 1 to 100"),
            row("daemon.narrator.rate_per_s", &rates, known.iter().all(|known| known.rate_per_s.is_none_or(is_rate)), "give 0 (no limit) or more"),
            row("persons.residents", &residents, persons.residents.len() <= PERSONS_MAX && persons.residents.iter().all(is_person) && each_name_once, &format!("give each name or number once, at most {PERSONS_MAX} (\"Zoë\" and \"Zoe\" are one); a name is {plain}, with a letter or digit, and no word such as \"they\"")),
            row("persons.not_persons", &not_persons, persons.not_persons.len() <= NOT_PERSONS_MAX && are_no_residents, &format!("give at most {NOT_PERSONS_MAX} names that no resident has, {plain}")),
            within("persons.visitor_s", persons.visitor_s, 1.0..=SECONDS_MAX),
            within("persons.asleep_s", persons.asleep_s, seconds.clone()),
            within("persons.guard_s", persons.guard_s, 0.0..=86_400.0),
            within("forecast.object_s", forecast.object_s, means.clone()),
            within("forecast.stay_s", forecast.stay_s, means.clone()),
            within("forecast.away_s", forecast.away_s, means.clone()),
            within("forecast.any_thing", forecast.any_thing, 0.0..=1.0),
            within("forecast.action_s", forecast.action_s, means.clone()),
            within("forecast.strength", forecast.strength, 0.001..=1e6),
            within("forecast.misplaced", forecast.misplaced, 1e-6..=1.0),
            within("forecast.mistaken", forecast.mistaken, 1e-6..=1.0),
            within("habits.half_life_days", habits.half_life_days, 0.0..=1e5),
            within("habits.save_s", habits.save_s, 1.0..=SECONDS_MAX),
            within("habits.coverage", habits.coverage, 0.5..=0.99),
            row("planner.robot", &robot, is_name(&planner.robot), &format!("give {plain}")),
            row("narrator.name", &name, is_name(&narrator.name), &format!("give {plain}")),
            within("planner.room_time_s", planner.room_time_s, seconds.clone()),
            within("planner.know_s", planner.know_s, 0.0..=86_400.0),
            row("planner.quiet", &planner.quiet.len(), planner.quiet.len() <= QUIET_MAX, &format!("give at most {QUIET_MAX} entries")),
            within("planner.min_absence_s", planner.min_absence_s, 0.0..=86_400.0),
            row("planner.min_absence_s", &planner.min_absence_s, planner.min_absence_s == 0.0 || planner.only_when.is_some(), "give planner.only_when too: it says what is to be empty for so long"),
            within("planner.min_absence_at", planner.min_absence_at, 0.0..=1.0),
            row("planner.room.id", &needs, planner.room.len() <= roomcast_ipc::raw::MAX_ROOMS && each_room_once, &format!("give at most {} rooms, each once, with ids of {plain}", roomcast_ipc::raw::MAX_ROOMS)),
            row("planner.room.every_s", &every, of_needs(&|room| room.every_s.is_none_or(|every_s| (1.0..=SECONDS_MAX).contains(&every_s))), &format!("give 1 to {SECONDS_MAX}, or leave the key out")),
            row("planner.room.priority", &priority, of_needs(&|room| (0.01..=100.0).contains(&room.priority)), "give 0.01 to 100"),
            row("planner.room.time_s", &time, of_needs(&|room| room.time_s.is_none_or(|time_s| (1.0..=SECONDS_MAX).contains(&time_s))), &format!("give 1 to {SECONDS_MAX}, or leave the key out")),
            row("planner.round_s", &round_s, planner.round_s.is_none_or(|round_s| (planner.room_time_s.max(f64::MIN_POSITIVE)..=SECONDS_MAX).contains(&round_s)), &format!("give planner.room_time_s to {SECONDS_MAX}, or leave the key out")),
            row("planner.deadline_ms", &planner.deadline_ms, planner.deadline_ms > daemon.heartbeat_ms, "give more than daemon.heartbeat_ms, or every score is stale before it is confirmed"),
            row("planner.interrupt_at", &interrupt, interrupt > 0.0 && interrupt <= 1.0, "give more than 0, at most 1"),
            within("planner.interrupt_after_s", planner.interrupt_after_s, seconds.clone()),
            row("planner.resume_at", &resume, (0.0..interrupt).contains(&resume), "give 0 or more, less than planner.interrupt_at"),
            within("planner.report_timeout_s", planner.report_timeout_s, 1.0..=SECONDS_MAX),
            within("planner.battery_low", low, 0.0..=1.0),
            row("planner.battery_ready", &ready, (low..=1.0).contains(&ready), "give planner.battery_low to 1"),
            within("planner.charge_timeout_s", planner.charge_timeout_s, 1.0..=SECONDS_MAX),
            row("metrics.listen", &listen, on_loopback, "give a loopback address, 127.0.0.1:PORT or [::1]:PORT: whoever else wants to see metrics needs a proxy"),
            row("bridge.topic", &format!("{:?}", bridge.topic), is_topic(&bridge.topic), &format!("give {topics}")),
            row("bridge.topic", &format!("{:?}", bridge.topic), bridge.topic != bridge.discovery, "give another one than bridge.discovery: Home Assistant speaks there itself"),
            row("bridge.discovery", &format!("{:?}", bridge.discovery), bridge.discovery.is_empty() || is_topic(&bridge.discovery), &format!("give {topics}, or \"\" for no discovery")),
            row("bridge.horizons_s", &ahead, bridge.horizons_s.len() <= BRIDGE_HORIZONS_MAX && rises(&bridge.horizons_s), &format!("give at most {BRIDGE_HORIZONS_MAX} times of 1 to 86400 s, rising")),
            within("bridge.soon_s", bridge.soon_s, 0.0..=86_400.0),
            row("bridge.soon_at", &bridge.soon_at, bridge.soon_at > 0.0 && bridge.soon_at <= 1.0, "give more than 0, at most 1"),
            row("bridge.soon_until", &bridge.soon_until, (0.0..=bridge.soon_at).contains(&bridge.soon_until), "give 0 to bridge.soon_at"),
            row("robot.topic", &format!("{:?}", vacuum.topic), is_topic(&vacuum.topic), &format!("give {topics}")),
            row("robot.battery", &battery, vacuum.battery.as_deref().is_none_or(is_sensor), &format!("give an MQTT topic of 1 to {SENSOR_TOPIC_BYTES_MAX} bytes without wildcards, and without a slash at its ends, or leave the key out")),
            within("robot.recharge_at", vacuum.recharge_at, 0.0..=1.0),
            within("robot.start_s", vacuum.start_s, 0.1..=3600.0),
            row("robot.least_s", &vacuum.least_s, (0.0..=vacuum.most_s).contains(&vacuum.least_s), "give 0 to robot.most_s"),
            within("robot.most_s", vacuum.most_s, 1.0..=86_400.0),
            row("robot.segments", &vacuum.segments.len(), vacuum.segments.len() <= roomcast_ipc::raw::MAX_ROOMS && vacuum.segments.iter().all(|(room, segment)| is_name(room) && is_name(segment)), &format!("give at most {} rooms, each with a segment of {plain}", roomcast_ipc::raw::MAX_ROOMS)),
            within("bridge.interval_s", bridge.interval_s, 0.1..=3600.0),
            within("narrator.linger_s", narrator.linger_s, seconds),
        ];
        limits
    }

    /// The binding sequence.
    ///
    /// # Errors
    /// When the text cannot be one.
    pub fn binding(&self) -> Result<BindingSequence, ConfigError> {
        self.scoring.binding.parse().map_err(|_| ConfigError::Value {
            key: "scoring.binding",
            value: excerpt(&format!("{:?}", self.scoring.binding)).into_owned(),
            remedy: format!(
                "give a built-in name (default, p0 to p5) or at most {BINDING_BYTES_MAX} bytes of text without control characters"
            ),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn the_manual_states_the_defaults() {
        assert_eq!(toml::from_str::<Config>(DEFAULT_TOML).unwrap(), Config::default());
    }

    #[test]
    fn the_home_on_the_page_of_wishes_is_a_configuration() {
        let page = include_str!("../../../docs/wishes.md");
        let (_, rest) = page.split_once("```toml\n").unwrap();
        let (text, _) = rest.split_once("```").unwrap();
        let config: Config = toml::from_str(text).unwrap();
        config.check().unwrap();
        assert_eq!((config.planner.quiet.len(), config.planner.room.len()), (2, 2));
    }

    #[test]
    fn of_two_entries_for_a_room_the_one_that_excludes_it_counts() {
        let room = |id: &str, exclude| format!("[[planner.room]]\nid = \"{id}\"\nexclude = {exclude}\n");
        let mut config: Config = [room("office", false), room("study", true), room("bed", true), room("bed-2", false)]
            .concat()
            .parse()
            .unwrap();
        // The planner resolves names by the map: both mean the study.
        "study".clone_into(&mut config.planner.room[0].id);
        let excludes = |id| config.planner.needs_of(id).map(|room| room.exclude);
        assert_eq!(["study", "bed-1", "bed-2", "hall"].map(excludes), [Some(true), Some(true), Some(false), None]);
    }

    #[test]
    fn rules_of_the_house_out_of_their_limits_are_refused() {
        for (toml, part) in [
            ("[planner]\nmin_absence_s = 60.0", "give planner.only_when too"),
            ("[planner]\nknow_s = -1.0", "planner.know_s is -1"),
            ("[[planner.room]]\nid = \"a\"\n[[planner.room]]\nid = \"a\"", "planner.room.id is [\"a\", \"a\"]"),
            ("[[planner.room]]\nid = \"a\"\nevery_s = 0.0", "planner.room.every_s is [0.0]"),
            ("[[planner.room]]\nid = \"a\"\npriority = 0.0", "planner.room.priority is [0.0]"),
            ("[[planner.room]]\nid = \"a\"\ntime_s = nan", "planner.room.time_s is [NaN]"),
        ] {
            let error = toml::from_str::<Config>(toml).unwrap().check().unwrap_err().to_string();
            assert!(error.contains(part), "{toml}: {error}");
        }
        let error = toml::from_str::<Config>("[planner]\nquiet = [\"10pm-7am\"]").unwrap_err().to_string();
        assert!(error.contains("quiet hours are \"10pm-7am\", expected such as"), "{error}");
    }

    /// The manual and the check state the same ranges.
    #[test]
    fn the_manual_states_the_ranges() {
        let (mut section, mut tried) = ("", 0);
        for line in DEFAULT_TOML.lines() {
            if let Some(name) = line.strip_prefix('[').and_then(|line| line.split(']').next()) {
                section = name;
            }
            let (Some((key, rest)), false) = (line.split_once(" = "), line.starts_with('#')) else { continue };
            let Some((value, comment)) = rest.split_once('#') else { continue };
            let words: Vec<&str> = comment.split([' ', ',', ';', ':']).collect();
            let range = words.windows(3).find_map(|words| {
                let [from, "to", to] = words else { return None };
                from.parse::<f64>().ok().zip(to.parse::<f64>().ok()).map(|ends| (format!("{from} to {to}"), ends.1))
            });
            let Some((range, to)) = range else { continue };
            let beyond = if value.contains('.') { format!("{:?}", to + 1.0) } else { format!("{}", to as u64 + 1) };
            let config: Config = toml::from_str(&format!("[{section}]\n{key} = {beyond}")).unwrap();
            let fault = config.check().unwrap_err().to_string();
            assert!(fault.contains(&format!("{section}.{key} is")) && fault.contains(&range), "{line}\n{fault}");
            tried += 1;
        }
        assert!(tried >= 10, "{tried}");
    }

    /// The manual states the limits of every rejected value next to its key.
    #[test]
    fn the_manual_states_every_limit() {
        let mut missing = Vec::new();
        for Limit { key, remedy, .. } in Config::default().limits() {
            let (section, name) = key.rsplit_once('.').unwrap();
            // A section that is one key has its comment next to its name.
            let own = DEFAULT_TOML.lines().find(|line| line.starts_with(&format!("[{key}]")));
            let of_section = [format!("\n[{section}]"), format!("\n# [[{section}]]")]
                .iter()
                .find_map(|head| DEFAULT_TOML.split_once(head))
                .map_or("", |(_, rest)| rest);
            let is_key =
                |line: &str| line.contains(" = ") && line.starts_with(|first: char| first.is_ascii_lowercase());
            let (mut comment, mut is_own) = (own.unwrap_or_default().to_owned(), false);
            for line in of_section.lines().skip(1).take_while(|line| !line.starts_with('[')) {
                let bare = line.trim_start_matches("# ");
                if is_key(bare) {
                    is_own = bare.starts_with(&format!("{name} = "));
                }
                if is_own {
                    comment.push_str(line);
                }
            }
            // 1 and 0 mean "all" and "none"; a billion seconds means no limit.
            let numbers =
                remedy.split([' ', ',', ';']).filter(|word| word.parse::<f64>().is_ok_and(|n| n > 1.0 && n < 1e9));
            missing.extend(
                numbers
                    .filter(|number| !comment.contains(*number))
                    .map(|number| format!("{key}: {number} of {remedy}")),
            );
        }
        assert_eq!(missing, [""; 0]);
    }

    #[test]
    fn a_value_of_the_wrong_kind_is_told_in_words() {
        let told = |toml: &str| toml_says(&toml::from_str::<Config>(toml).unwrap_err());
        assert!(told("[scoring]\nprepare = \"many\"").contains("the text \"many\", expected a whole number"));
        assert!(told("[daemon]\nhang_s = -1").contains("expected a whole number"));
        assert!(told("[scoring]\nprepare_share = \"all\"").contains("expected a number"));
    }

    #[test]
    fn all_faults_of_a_text_are_named_with_their_lines() {
        let faults = |toml: &str| faults_of(toml.to_owned(), toml.parse::<Config>().unwrap_err());
        let toml = "[planner]\nroomtime = 3\nroom_time_s = \"x\"\nonly_when = \"empty\"\n[scen]\nroomtime = 1\n\n[daemon]\nhang_s = [\n-1]\n";
        let named = faults(toml);
        let mut lines: Vec<&str> = named.iter().filter_map(|fault| fault.lines().next()).collect();
        lines.sort_unstable();
        let places = ["2, column 1", "3, column 15", "4, column 13", "5, column 2", "9, column 10"];
        assert_eq!(lines, places.map(|place| format!("at line {place}")), "{named:#?}");
        assert_eq!(faults("[daemon\nx = 1\n[scen]\n").len(), 1, "after a fault of TOML the rest is a guess");
        let many: String = (0..99).map(|key| format!("key-{key} = 1\n")).collect();
        assert_eq!(faults(&many).len(), FAULTS_MAX);
    }

    #[test]
    fn threads_follow_the_cores_unless_they_are_given() {
        let threads = |toml: &str| toml::from_str::<Config>(toml).unwrap().model.llama_options().threads;
        assert_eq!(threads("[model]\ncores = [1, 2, 5]"), 3);
        assert_eq!(threads("[model]\ncores = [1, 2, 5]\nthreads = 2"), 2);
        assert_eq!(threads(""), LlamaOptions::default().threads);
    }

    #[test]
    fn unknown_keys_and_values_out_of_limits_are_refused() {
        assert!(toml::from_str::<Config>("[model]\nthread = 2").is_err());
        let config: Config = toml::from_str("[model]\nsequences = 999").unwrap();
        assert!(config.check().unwrap_err().to_string().contains("model.sequences is 999"));
        let config: Config = toml::from_str("[scoring]\neffort = \"ranking\"\nmethod = \"independent\"").unwrap();
        assert!(config.check().unwrap_err().to_string().contains("scoring.effort is ranking"));
        let config: Config = toml::from_str("[metrics]\nlisten = \"0.0.0.0:9464\"").unwrap();
        assert!(config.check().unwrap_err().to_string().contains("metrics.listen is 0.0.0.0:9464"));
        for (toml, part) in [
            ("[scoring]\nprior = 1.5", "scoring.prior is 1.5"),
            ("[scoring]\nprior = nan", "scoring.prior is NaN"),
            ("[ipc]\ndomain = \"ABC\"", "ABC"),
            ("[ipc]\ndomain = \"\"", "[ipc]"),
            ("[ipc]\nroot = \"rel\"", "rel"),
            ("[planner]\nrobot = \"\"", "planner.robot is \"\""),
            ("[planner]\nround_s = 599.0", "planner.round_s is 599"),
            ("[planner]\nround_s = nan", "planner.round_s is NaN"),
            ("[planner]\ninterrupt_at = 0.0", "planner.interrupt_at is 0"),
            ("[planner]\nresume_at = 0.6", "planner.resume_at is 0.6"),
            ("[planner]\nbattery_ready = 0.1", "planner.battery_ready is 0.1"),
            ("[planner]\nbattery_low = nan", "planner.battery_low is NaN"),
            ("[planner]\nreport_timeout_s = 0.0", "planner.report_timeout_s is 0"),
            ("[narrator]\nname = \" \"", "narrator.name is \" \""),
            ("[narrator]\nlinger_s = nan", "narrator.linger_s is NaN"),
            ("[model]\ncores = [0, 1, 0]", "model.cores is [0, 1, 0]"),
            ("[daemon]\nstate = \"\"", "daemon.state is empty"),
            ("[daemon]\njournal_bytes = 1", "daemon.journal_bytes is 1"),
            (
                "[[daemon.narrator]]\nname = \"a\"\n[[daemon.narrator]]\nname = \"a\"",
                "daemon.narrator.name is [\"a\", \"a\"]",
            ),
            ("[[daemon.narrator]]\nname = \"a\"\nshare = 0", "daemon.narrator.share is 0"),
            ("[[daemon.narrator]]\nname = \"a\"\ntrust = 101", "daemon.narrator.trust is 101"),
            ("[[daemon.narrator]]\nname = \"a\"\nrate_per_s = -1.0", "daemon.narrator.rate_per_s is -1"),
            ("[persons]\nresidents = [\"ada\", \"Ada\"]", "persons.residents is [\"ada\", \"Ada\"]"),
            ("[persons]\nresidents = [\"Zoë\", \"zoe\"]", "persons.residents is [\"Zoë\", \"zoe\"]"),
            ("[persons]\nresidents = [\"ada\"]\nnot_persons = [\"Ada\"]", "persons.not_persons is [\"Ada\"]"),
            ("[persons]\nresidents = [\"Zoë\"]\nnot_persons = [\"Zoe\"]", "persons.not_persons is [\"Zoe\"]"),
            ("[forecast]\nobject_s = 0", "forecast.object_s is 0"),
            ("[forecast]\nmistaken = 2", "forecast.mistaken is 2"),
            ("[habits]\nhalf_life_days = nan", "habits.half_life_days is NaN"),
            ("[habits]\nsave_s = 0", "habits.save_s is 0"),
            ("[habits]\ncoverage = 1.0", "habits.coverage is 1"),
            ("[persons]\nasleep_s = -1", "persons.asleep_s is -1"),
            ("[persons]\nvisitor_s = 0", "persons.visitor_s is 0"),
            ("[bridge]\ntopic = \"a/#\"", "bridge.topic is \"a/#\""),
            ("[bridge]\ntopic = \"\"", "bridge.topic is \"\""),
            ("[bridge]\ntopic = \"homeassistant\"", "give another one than bridge.discovery"),
            ("[bridge]\ntopic = \"$SYS\"", "bridge.topic is \"$SYS\""),
            ("[bridge]\ntopic = \"a\\u0000\"", "bridge.topic is"),
            ("[bridge]\ndiscovery = \"/a\"", "bridge.discovery is \"/a\""),
            ("[bridge]\nhorizons_s = [600.0, 60.0]", "bridge.horizons_s is [600.0, 60.0]"),
            ("[bridge]\nsoon_at = nan", "bridge.soon_at is NaN"),
            ("[bridge]\nsoon_until = 0.6", "bridge.soon_until is 0.6"),
            ("[robot]\ntopic = \"a/+/b\"", "robot.topic is \"a/+/b\""),
            ("[robot]\nstart_s = 0", "robot.start_s is 0"),
            ("[robot]\nbattery = \"a/#\"", "robot.battery is \"a/#\""),
            ("[robot]\nrecharge_at = 1.5", "robot.recharge_at is 1.5"),
            ("[robot]\nleast_s = 8000.0", "robot.least_s is 8000"),
            ("[robot]\nmost_s = nan", "robot.most_s is NaN"),
            ("[robot.segments]\nkitchen = \"\"", "robot.segments is 1"),
            ("[bridge]\ninterval_s = 0.0", "bridge.interval_s is 0"),
            ("[history]\ngap_s = 1000000001", "history.gap_s is 1000000001"),
        ] {
            let error = toml::from_str::<Config>(toml).unwrap().check().unwrap_err().to_string();
            assert!(error.contains(part), "{toml}: {error}");
        }
        // A grandmother may live with a person of the same name.
        let namesakes = "[persons]\nresidents = [\"Grandma Edith\", \"Edith\"]";
        toml::from_str::<Config>(namesakes).unwrap().check().unwrap();
        let fits = "[model]\ncores = [1, 0]\n[daemon]\njournal_bytes = 8192\n[ipc]\ndomain = \"a-1\"";
        toml::from_str::<Config>(fits).unwrap().check().unwrap();
    }

    #[test]
    fn relative_paths_begin_at_the_configurations_folder() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("roomcast.toml");
        let text = "[model]\npath = \"m.gguf\"\n[scene]\npath = \"maps/home.json\"\n[daemon]\nstate = \"state\"\n\
            [mqtt]\ncredentials = \"/etc/secret\"\nca = \"ca.pem\"\nrules = \"../rules.toml\"\n";
        std::fs::write(&file, text).unwrap();
        let config = Config::load(&file).unwrap();
        let at = |name: &str| Some(folder.path().join(name));
        assert_eq!(
            [config.model.path, config.scene.path, config.daemon.state],
            ["m.gguf", "maps/home.json", "state"].map(at)
        );
        let MqttConfig { credentials, ca, rules, .. } = config.mqtt;
        assert_eq!([credentials, ca, rules], ["/etc/secret", "ca.pem", "../rules.toml"].map(at));
        // A bare name is a shipped scene, unless a file has that name.
        std::fs::write(&file, "[scene]\npath = \"studio\"\n").unwrap();
        assert_eq!(Config::load(&file).unwrap().scene.path, Some("studio".into()));
        std::fs::write(folder.path().join("studio"), "{}").unwrap();
        assert_eq!(Config::load(&file).unwrap().scene.path, at("studio"));
        std::fs::write(&file, "[daemon]\nstate = \"\"\n").unwrap();
        assert!(Config::load(&file).unwrap_err().to_string().contains("daemon.state is empty"));
    }

    /// One file serves a start by hand and the units, which may write only to their own folder.
    #[test]
    fn a_services_own_state_directory_goes_before_one_beside_the_file() {
        let state_of = |toml: &str, of_service: Option<&str>| {
            let mut config: Config = toml::from_str(toml).unwrap();
            config.begin_paths_at(Path::new("/etc/roomcast"), of_service.map(PathBuf::from));
            config.daemon.state
        };
        let (beside, own) = ("[daemon]\nstate = \"state\"", Some("/var/lib/roomcast"));
        assert_eq!(state_of(beside, None), Some("/etc/roomcast/state".into()));
        assert_eq!(state_of(beside, own), own.map(PathBuf::from));
        // An absolute folder is used as it is. Without one, `state_directory` returns systemd's.
        assert_eq!(state_of("[daemon]\nstate = \"/srv/roomcast\"", own), Some("/srv/roomcast".into()));
        assert_eq!(state_of("", own), None);
        assert_eq!(state_of("[daemon]\nstate = \"\"", own), Some("".into()));
    }

    /// The check of the file finds a folder that the daemon could not start with.
    #[test]
    fn a_folder_that_can_be_none_is_found() {
        let outer = tempfile::tempdir().unwrap();
        let at = |name: &str| outer.path().join(name);
        std::fs::write(at("file"), "").unwrap();
        std::os::unix::fs::symlink("nowhere", at("link")).unwrap();
        for good in ["", "new", "new/er", "../new"] {
            assert_eq!(no_folder(&at(good)), None, "{good}");
        }
        assert_eq!(no_folder(Path::new("beside/new")), None);
        for (wrong, named) in [("file", "file"), ("file/new", "file"), ("link", "link"), ("link/new", "link")] {
            let reason = format!("{} is no folder", at(named).display());
            assert_eq!(no_folder(&at(wrong)), Some(NoFolder { reason, remedy: None }), "{wrong}");
        }
        let config: Config = toml::from_str("[ipc]\nroot = \"/dev/null\"\n[daemon]\nstate = \"a\\u0000b\"").unwrap();
        let told = [config.root_fault(), config.state_fault()].map(|fault| fault.unwrap().to_string());
        assert_eq!(told[0], "the configuration's ipc.root is /dev/null: /dev/null is no folder; give another folder");
        assert!(told[1].contains("daemon.state is a\0b: no path has a NUL byte"), "{}", told[1]);
        let open = at("open");
        std::fs::create_dir(&open).unwrap();
        std::fs::set_permissions(&open, PermissionsExt::from_mode(0o1777)).unwrap();
        let mut config = Config::default();
        config.daemon.state = Some(open.clone());
        let fault = config.state_fault().unwrap().to_string();
        assert!(fault.ends_with(&format!("(mode 1777): run `chmod go-w {}`", open.display())), "{fault}");
        let none = Config::default();
        assert!(none.root_fault().is_none());
    }

    /// Too many residents are rejected before each name is compared with each.
    #[test]
    fn residents_whose_names_look_alike_are_told() {
        let mut persons =
            PersonsConfig { residents: vec!["Ada".to_owned(), "Bob".to_owned()], ..PersonsConfig::default() };
        assert_eq!(persons.odd_names(["Cem"]), Vec::<String>::new());
        // The first letter is Cyrillic.
        persons.residents.push("\u{410}da".to_owned());
        let told = persons.odd_names(["Cem"]);
        assert!(told.len() == 1 && told[0].contains("looks like \"Ada\""), "{told:?}");
    }

    #[test]
    fn residents_are_as_many_as_can_be_known() {
        let config = |residents: usize, others: usize| {
            let names = |of: &str, count| (0..count).map(|number| format!("{of}{number}")).collect();
            let mut config = Config::default();
            (config.persons.residents, config.persons.not_persons) = (names("ada", residents), names("rex", others));
            config
        };
        config(PERSONS_MAX, NOT_PERSONS_MAX).check().unwrap();
        let told = config(100_000, 0).check().unwrap_err().to_string();
        assert!(told.contains("once, at most 64 ") && told.len() < 2_000, "{told}");
        let told = config(1, 100_000).check().unwrap_err().to_string();
        assert!(told.contains("persons.not_persons") && told.contains("give at most 256 names"), "{told}");
        let mut twice = config(PERSONS_MAX, 0);
        twice.persons.residents[1] = "Ada0".to_owned();
        assert!(twice.check().unwrap_err().to_string().contains("once"));
    }

    /// If the wrong file is given, perhaps with a line of megabytes, the error does not contain it.
    #[test]
    fn an_error_does_not_repeat_the_file() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let long = "k".repeat(1 << 19);
        let names = format!("{:?}", vec!["x"; 1 << 15]);
        for text in [
            format!("{{\"rooms\": \"{long}\"}}"),
            format!("[model]\nthreads = \"{long}\""),
            format!("[model]\n{long} = 1"),
            format!("[persons]\nresidents = [\"{long}\"]"),
            format!("[persons]\nnot_persons = {names}\nresidents = [\"x\"]"),
            format!("[scoring]\nbinding = \"{long}\""),
        ] {
            std::fs::write(file.path(), &text).unwrap();
            let error = crate::logging::chain(&Config::load(file.path()).unwrap_err());
            assert!((40..4_000).contains(&error.len()), "{} {error}", &text[..30]);
        }
    }

    #[test]
    fn a_value_of_the_wrong_kind_is_told_once() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "[planner]\nroom_time_s = \"5\"").unwrap();
        let text = crate::logging::chain(&Config::load(file.path()).unwrap_err());
        assert_eq!(text.matches("the text \"5\", expected a number").count(), 1, "{text}");
        assert!(text.contains("expected a number") && !text.contains("f64"), "{text}");
    }

    #[test]
    fn a_fault_names_the_file_it_is_in() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "[model]\nthreads = 999").unwrap();
        let error = Config::load(file.path()).unwrap_err();
        let text = crate::logging::chain(&error);
        assert!(text.starts_with(&file.path().display().to_string()), "{text}");
        assert_eq!(text.matches("model.threads is 999").count(), 1, "{text}");
    }
}
