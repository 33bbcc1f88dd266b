//! Model files that a user names. Another process tries each file before this process loads it, because llama.cpp may end its process.

use std::ffi::OsString;
use std::path::Path;
use std::process::{Command, Stdio};

use roomcast_core::prompt::{BindingSequence, write_prompt};
use roomcast_core::scorer::correction::Correction;
use roomcast_core::scorer::{LabelScores, Method, Scorer, Tokenisation};
use roomcast_llama::{CacheType, LlamaModel, LlamaOptions};
use roomcast_services::config::Config;
use roomcast_services::setup;

use rustix::process::{Signal, set_parent_process_death_signal};

use crate::{CommandResult, Failure, exit_code, print};

/// Loads the model file at `path`, or the embedded model. Another process tries the file first.
///
/// # Errors
///
/// When the other process dies or the file cannot be loaded.
pub fn load(path: Option<&Path>, options: &LlamaOptions) -> Result<LlamaModel, Failure> {
    if let Some(path) = path {
        try_elsewhere(path, options)?;
    }
    Ok(setup::load_model(path, options)?)
}

/// Lets another process try the model file of a configuration. A file with a pinned checksum needs no trial.
///
/// # Errors
///
/// When the other process dies or cannot load the model. The error is its message.
pub fn try_configured(config: &Config) -> CommandResult {
    match (&config.model.path, &config.model.sha256) {
        (Some(path), None) => try_elsewhere(path, &config.model.llama_options()),
        _ => Ok(()),
    }
}

fn try_elsewhere(file: &Path, options: &LlamaOptions) -> CommandResult {
    let cache = options.cache.to_string();
    let arguments = ["model", "rehearse", "--kv-cache", cache.as_str()].map(OsString::from);
    elsewhere(arguments.into_iter().chain(["--".into(), file.into()]), file)
}

/// Runs this program on a model file in another process. If llama.cpp ends that process, the caller gets an error.
pub fn elsewhere(arguments: impl IntoIterator<Item = OsString>, file: &Path) -> CommandResult {
    let own = std::env::current_exe();
    let tried = own.and_then(|own| Command::new(own).args(arguments).stdin(Stdio::null()).output());
    let tried = tried.map_err(|error| Failure::model(format!("cannot try the model {}: {error}", file.display())))?;
    print(&String::from_utf8_lossy(&tried.stdout))?;
    let said = String::from_utf8_lossy(&tried.stderr);
    match tried.status.code().and_then(|code| u8::try_from(code).ok()) {
        Some(exit_code::OK) => Ok(()),
        Some(code @ exit_code::FAILURE..=exit_code::CHECK) => {
            // The error is the last line, after the log.
            let said =
                said.strip_prefix("roomcast: ").or_else(|| Some(said.rsplit_once("\nroomcast: ")?.1)).unwrap_or(&said);
            Err(Failure::new(code, said.trim().to_owned()))
        }
        _ => {
            let said = said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or_default();
            Err(Failure::model(format!(
                "llama.cpp gave up on the model {} ({}; {said}): the file is damaged or unusable; get it again from its source",
                file.display(),
                tried.status
            )))
        }
    }
}

/// Exercises everything that llama.cpp does with a model. Ends with the process that started it.
pub fn rehearse(file: &Path, cache: CacheType) -> CommandResult {
    // Without this, a large model would be loaded to the end for a process that was stopped.
    let _ends_later = set_parent_process_death_signal(Some(Signal::TERM));
    let model_failure = |error: &dyn std::fmt::Display| Failure::model(error.to_string());
    let options = LlamaOptions { cache, ..LlamaOptions::default() };
    let model = LlamaModel::load(file, &options).map_err(|error| model_failure(&error))?;
    let binding = BindingSequence::default();
    let mut scorer = Scorer::new(model);
    let prepared = scorer.prepare(&["washing machine", "mug"], &binding, Tokenisation::Joint, Correction::default());
    let prepared = prepared.map_err(|error| model_failure(&error))?;
    let mut prompt = String::new();
    write_prompt(["They walk to the kitchen."], &binding, false, &mut prompt);
    let mut scores = LabelScores::default();
    scorer.score(&prepared, &prompt, Method::Trie, &mut scores).map_err(|error| model_failure(&error))
}
