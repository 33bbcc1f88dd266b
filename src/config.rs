//! The configuration: one TOML file, the same for daemon, planner and narrator. `default.toml` beside this file is the
//! manual: every key with its default, its limits and what it costs.

use std::path::{Path, PathBuf};

use roomcast_ipc::{Domain, IpcError};
use serde::{Deserialize, Serialize};

use crate::daemon::DaemonConfig;
use crate::grounding::GroundingOptions;
use crate::metrics::MetricsConfig;
use crate::narration::history::{HistoryLimits, OBSERVATIONS_MAX};
use crate::narrator::NarratorConfig;
use crate::planner::PlannerConfig;
use crate::prompt::BindingSequence;
use crate::scorer::certified::Effort;
use crate::scorer::correction::{Continuation, PRIOR_WEIGHTS};
use crate::scorer::llama::{CacheType, LlamaOptions, SEQUENCES_MAX, THREADS_MAX};
use crate::scorer::{Method, Tokenisation};

/// The commented default configuration, as a file to start from.
pub const DEFAULT_TOML: &str = include_str!("default.toml");

/// Most bytes of a configuration file.
pub const FILE_BYTES_MAX: u64 = 1 << 20;
/// Most milliseconds that a step may take under `effort = "deadline"`.
pub const DEADLINE_MS_MAX: u64 = 60_000;

/// Least bytes of the journal: either half holds a few of the longest sentences.
const JOURNAL_BYTES_MIN: u64 = 8192;

/// Most bytes of a name that messages carry whole.
const NAME_BYTES_MAX: usize = 48;

/// A configuration that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("failed to read the configuration {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is larger than [`FILE_BYTES_MAX`].
    #[error("the configuration {path} has more than {FILE_BYTES_MAX} bytes: that is no configuration file")]
    TooLarge {
        /// The file.
        path: PathBuf,
    },
    /// Not TOML, an unknown key, or a value of the wrong kind.
    #[error("the configuration {path} is malformed: {source}\nsee `roomcast config` for every key with its default")]
    Parse {
        /// The file.
        path: PathBuf,
        /// What, with line and column.
        source: Box<toml::de::Error>,
    },
    /// A value outside its limits.
    #[error("the configuration's {key} is {value}: {remedy}")]
    Value {
        /// The key, with its section.
        key: &'static str,
        /// What it holds.
        value: String,
        /// What it may hold.
        remedy: &'static str,
    },
    /// The section `[ipc]` names no domain.
    #[error("the configuration's section [ipc] cannot be used: {0}")]
    Domain(#[from] IpcError),
    /// One of the faults above, with the file that it is in.
    #[error("{path}: {fault}")]
    InFile {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        fault: Box<Self>,
    },
}

/// All of the configuration; every section and key may be left out.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The model.
    pub model: ModelConfig,
    /// The semantic map.
    pub scene: SceneConfig,
    /// How labels are scored.
    pub scoring: ScoringConfig,
    /// How scores are grounded.
    pub grounding: GroundingOptions,
    /// The history window of each person.
    pub history: HistoryLimits,
    /// Where the processes meet.
    pub ipc: IpcConfig,
    /// The daemon.
    pub daemon: DaemonConfig,
    /// The planner.
    pub planner: PlannerConfig,
    /// The narrator.
    pub narrator: NarratorConfig,
    /// Metrics for Prometheus.
    pub metrics: MetricsConfig,
}

/// The section `[ipc]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IpcConfig {
    /// The domain's root path; the user's own when empty.
    pub root: Option<PathBuf>,
    /// The domain's name.
    pub domain: String,
}

impl Default for IpcConfig {
    fn default() -> Self {
        Self { root: None, domain: Domain::default_for_user().name().to_owned() }
    }
}

impl IpcConfig {
    /// The domain that this section names.
    ///
    /// # Errors
    /// When root path or name cannot be a domain's.
    pub fn domain(&self) -> Result<Domain, IpcError> {
        let root = self.root.clone().unwrap_or_else(|| Domain::default_for_user().root().to_owned());
        Domain::new(root, &self.domain)
    }
}

/// The section `[model]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// A GGUF file; the embedded model when empty.
    pub path: Option<PathBuf>,
    /// The SHA-256 that the file must have, in hexadecimal; any when empty.
    pub sha256: Option<String>,
    /// Threads of one decoder call; 0 chooses one per core of `cores`, or without these all cores but one.
    pub threads: usize,
    /// Cores that the scorer runs on, by number; any when empty.
    pub cores: Vec<usize>,
    /// Positions of prompt and labels together.
    pub context_tokens: u32,
    /// Paths of the label trie that one decoder call may hold.
    pub sequences: u32,
    /// How the key-value cache is stored.
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
    /// The scene file; the shipped studio flat when empty.
    pub path: Option<PathBuf>,
}

/// The section `[scoring]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ScoringConfig {
    /// A built-in binding sequence's name, or any text.
    pub binding: String,
    /// How labels are scored.
    pub method: Method,
    /// How prompt and label are cut into tokens.
    pub tokenisation: Tokenisation,
    /// What a label's tokens after the first compete with; as the model file recommends when empty.
    pub continuation: Option<Continuation>,
    /// The prior weight, 0 to 1; as the model file recommends when empty.
    pub prior: Option<f64>,
    /// How far an answer goes.
    pub effort: Effort,
    /// The time that a step may take under `effort = "deadline"`, in milliseconds.
    pub deadline_ms: u64,
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
            deadline_ms: 5,
        }
    }
}

impl Config {
    /// Reads and checks a configuration file.
    ///
    /// # Errors
    /// When it cannot be read, has unknown keys, or a value outside its limits.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let read = |source| ConfigError::Read { path: path.to_owned(), source };
        if std::fs::metadata(path).map_err(read)?.len() > FILE_BYTES_MAX {
            return Err(ConfigError::TooLarge { path: path.to_owned() });
        }
        let text = std::fs::read_to_string(path).map_err(read)?;
        let config: Self = toml::from_str(&text)
            .map_err(|source| ConfigError::Parse { path: path.to_owned(), source: Box::new(source) })?;
        config.check().map_err(|fault| ConfigError::InFile { path: path.to_owned(), fault: Box::new(fault) })?;
        Ok(config)
    }

    /// Checks every limit that the types do not hold by themselves.
    ///
    /// # Errors
    /// The first value outside its limits.
    pub fn check(&self) -> Result<(), ConfigError> {
        let limit = |ok: bool, key, value: &dyn std::fmt::Display, remedy| {
            if ok { Ok(()) } else { Err(ConfigError::Value { key, value: value.to_string(), remedy }) }
        };
        let model = &self.model;
        limit(model.threads <= THREADS_MAX, "model.threads", &model.threads, "give 0 (automatic) to 256")?;
        limit(
            (64..=1 << 20).contains(&model.context_tokens),
            "model.context_tokens",
            &model.context_tokens,
            "give 64 to 1048576",
        )?;
        limit(
            (1..=SEQUENCES_MAX).contains(&model.sequences),
            "model.sequences",
            &model.sequences,
            "give 1 to 256, llama.cpp's limit",
        )?;
        limit(
            (1..).zip(&model.cores).all(|(next, core)| !model.cores[next..].contains(core)),
            "model.cores",
            &format!("{:?}", model.cores),
            "name each core once",
        )?;
        if let Some(sum) = &model.sha256 {
            limit(
                sum.len() == 64 && sum.bytes().all(|b| b.is_ascii_hexdigit()),
                "model.sha256",
                sum,
                "give 64 hexadecimal digits, as sha256sum prints them",
            )?;
        }
        limit(
            (1..=OBSERVATIONS_MAX).contains(&self.history.observations),
            "history.observations",
            &self.history.observations,
            "give 1 to 1000",
        )?;
        limit(self.history.slack <= 1000, "history.slack", &self.history.slack, "give 0 to 1000")?;
        limit(self.history.tokens >= 16, "history.tokens", &self.history.tokens, "give 16 or more")?;
        limit(
            (1..=DEADLINE_MS_MAX).contains(&self.scoring.deadline_ms),
            "scoring.deadline_ms",
            &self.scoring.deadline_ms,
            "give 1 to 60000",
        )?;
        let scoring = &self.scoring;
        limit(
            scoring.prior.is_none_or(|prior| PRIOR_WEIGHTS.contains(&prior)),
            "scoring.prior",
            &scoring.prior.unwrap_or_default(),
            "give 0 to 1",
        )?;
        limit(
            scoring.method.allows(scoring.effort),
            "scoring.effort",
            &format!("{:?}", scoring.effort).to_lowercase(),
            "give \"exact\", or scoring.method = \"trie\", which alone can end early",
        )?;
        self.binding()?;
        self.ipc.domain()?;
        let daemon = &self.daemon;
        limit(
            daemon.state.as_ref().is_none_or(|state| !state.as_os_str().is_empty()),
            "daemon.state",
            &"empty",
            "give a directory, or leave the key out for no journal",
        )?;
        limit(
            daemon.journal_bytes >= JOURNAL_BYTES_MIN,
            "daemon.journal_bytes",
            &daemon.journal_bytes,
            "give 8192 or more",
        )?;
        limit(
            (10..=60_000).contains(&daemon.heartbeat_ms),
            "daemon.heartbeat_ms",
            &daemon.heartbeat_ms,
            "give 10 to 60000",
        )?;
        limit(daemon.hang_s >= 1, "daemon.hang_s", &daemon.hang_s, "give 1 or more")?;
        let (rate_per_s, burst) = (daemon.intake.rate_per_s, daemon.intake.burst);
        limit(
            rate_per_s >= 0.0 && rate_per_s.is_finite(),
            "daemon.intake.rate_per_s",
            &rate_per_s,
            "give 0 (no limit) or more",
        )?;
        limit(burst >= 1.0 && burst.is_finite(), "daemon.intake.burst", &burst, "give 1 or more")?;
        for (key, name) in [("planner.robot", &self.planner.robot), ("narrator.name", &self.narrator.name)] {
            let fits = !name.trim().is_empty() && name.len() <= NAME_BYTES_MAX && !name.contains(char::is_control);
            limit(fits, key, &format!("{name:?}"), "give 1 to 48 bytes of text without control characters")?;
        }
        let planner = &self.planner;
        limit(
            (0.0..=1e9).contains(&planner.room_time_s),
            "planner.room_time_s",
            &planner.room_time_s,
            "give 0 to 1000000000",
        )?;
        limit(
            planner.deadline_ms > daemon.heartbeat_ms,
            "planner.deadline_ms",
            &planner.deadline_ms,
            "give more than daemon.heartbeat_ms, or every score is stale before it is confirmed",
        )?;
        if let Some(address) = self.metrics.listen {
            let remedy = "give a loopback address, 127.0.0.1:PORT or [::1]:PORT: whoever else wants to see metrics needs a proxy";
            limit(address.ip().is_loopback(), "metrics.listen", &address, remedy)?;
        }
        let linger_s = self.narrator.linger_s;
        limit((0.0..=1e9).contains(&linger_s), "narrator.linger_s", &linger_s, "give 0 to 1000000000")?;
        Ok(())
    }

    /// The binding sequence.
    ///
    /// # Errors
    /// When the text cannot be one.
    pub fn binding(&self) -> Result<BindingSequence, ConfigError> {
        self.scoring.binding.parse().map_err(|_| ConfigError::Value {
            key: "scoring.binding",
            value: format!("{:?}", self.scoring.binding),
            remedy: "give a built-in name (default, p0 to p5) or at most 1024 bytes of text without control characters",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_manual_states_the_defaults() {
        assert_eq!(toml::from_str::<Config>(DEFAULT_TOML).unwrap(), Config::default());
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
            ("[narrator]\nname = \" \"", "narrator.name is \" \""),
            ("[narrator]\nlinger_s = nan", "narrator.linger_s is NaN"),
            ("[model]\ncores = [0, 1, 0]", "model.cores is [0, 1, 0]"),
            ("[daemon]\nstate = \"\"", "daemon.state is empty"),
            ("[daemon]\njournal_bytes = 1", "daemon.journal_bytes is 1"),
        ] {
            let error = toml::from_str::<Config>(toml).unwrap().check().unwrap_err().to_string();
            assert!(error.contains(part), "{toml}: {error}");
        }
        let fits = "[model]\ncores = [1, 0]\n[daemon]\njournal_bytes = 8192\n[ipc]\ndomain = \"a-1\"";
        toml::from_str::<Config>(fits).unwrap().check().unwrap();
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
