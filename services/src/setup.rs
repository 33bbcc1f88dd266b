//! Builds a ready pipeline from a configuration: model, map, labels.

use std::path::Path;

use sha2::{Digest, Sha256};

use crate::config::{Config, ConfigError};
use crate::embedded::{self, ModelFile};
use roomcast_core::grounding::{Grounding, GroundingError};
use roomcast_core::narration::{Program, TextError};
use roomcast_core::pipeline::{Pipeline, PipelineError, PipelineOptions};
use roomcast_core::scorer::correction::CorrectionChoice;
use roomcast_core::scorer::{LanguageModel, ModelError, Scorer, familiarity};
use roomcast_core::semantic_map::{SceneError, SemanticMap};
use roomcast_core::text::did_you_mean;
use roomcast_llama::{LlamaModel, LlamaOptions, file_sha256};

/// The service cannot become ready.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SetupError {
    /// The configuration failed.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The scene failed.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// Neither a file nor the name of an included scene.
    #[error(
        "there is no scene {path}: give a scene's file, or an included scene by its name, {}{}",
        embedded::scene_names(),
        did_you_mean(last(.path), embedded::SCENES.iter().map(|scene| scene.name))
    )]
    NoScene {
        /// The given path.
        path: String,
    },
    /// Neither a file nor the name of an included activity program.
    #[error(
        "there is no activity program {path}: give a program's file, or an included program by its name, {}{}",
        embedded::program_names(),
        did_you_mean(last(.path), embedded::PROGRAMS.iter().chain(&embedded::WORK_PROGRAMS).map(|program| program.name))
    )]
    NoProgram {
        /// The given path.
        path: String,
    },
    /// An activity program failed.
    #[error(transparent)]
    Program(#[from] TextError),
    /// The scene's grounding failed.
    #[error(transparent)]
    Grounding(#[from] GroundingError),
    /// The model failed.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The embedded model failed.
    #[error("failed to put the embedded model into an anonymous memory file: {0}; give a model file instead")]
    Embedded(std::io::Error),
    /// The pipeline failed.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The model is not the one that the configuration pins.
    #[error(
        "the model {path} has the SHA-256 {found}, but model.sha256 pins {pinned}: use the pinned file, or change the pin"
    )]
    Pin {
        /// The file.
        path: String,
        /// The SHA-256 of the file.
        found: String,
        /// The pinned SHA-256.
        pinned: String,
    },
}

/// The last part of a path: a shipped name in a configuration is made absolute before it is looked up.
fn last(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

/// Loads the model file at `path`, or the embedded one, and judges whether a file's scores are noise.
///
/// # Errors
/// When it cannot be loaded.
pub fn load_model(path: Option<&Path>, options: &LlamaOptions) -> Result<LlamaModel, SetupError> {
    let model = match path {
        Some(path) => {
            let mut scorer = Scorer::new(LlamaModel::load(path, options)?);
            let weakness = familiarity::weakness(&mut scorer).unwrap_or_else(|error| {
                tracing::warn!(%error, "the model cannot be checked for noise");
                None
            });
            scorer.into_model().judged(weakness)
        }
        None => {
            let file = ModelFile::create().map_err(SetupError::Embedded)?;
            LlamaModel::load(&file.path(), options).map_err(|error| match error {
                // This path has a meaning only in this process.
                ModelError::Load { reason, .. } => ModelError::Load { path: embedded::MODEL_NAME.to_owned(), reason },
                error => error,
            })?
        }
    };
    tracing::debug!(model = model.info().name, "loaded the model");
    Ok(model)
}

/// Loads the scene file at `path`, an included scene if `path` is its bare name, or by default the studio flat.
///
/// # Errors
/// When the file is missing or malformed.
pub fn load_map(path: Option<&Path>) -> Result<SemanticMap, SetupError> {
    let text = match path {
        None => Some(embedded::SCENES[0].text),
        Some(path) if !path.exists() => path.to_str().and_then(embedded::scene).map(|scene| scene.text),
        Some(_) => None,
    };
    let map = match (text, path) {
        (None, Some(path)) if matches!(path.try_exists(), Ok(false)) => {
            return Err(SetupError::NoScene { path: path.display().to_string() });
        }
        (None, Some(path)) => SemanticMap::load(path)?,
        (text, _) => SemanticMap::from_json(text.unwrap_or(embedded::SCENES[0].text))?,
    };
    tracing::debug!(map = map.name(), rooms = map.rooms().len(), items = map.items().len(), "loaded the map");
    Ok(map)
}

/// Loads the activity program at `path`, or an included program if `path` is its bare name.
///
/// # Errors
/// When the file is missing or malformed.
pub fn load_program(path: &Path) -> Result<Program, SetupError> {
    if let Some(shipped) = shipped_program(path) {
        return Ok(shipped?);
    }
    if matches!(path.try_exists(), Ok(false)) {
        return Err(SetupError::NoProgram { path: path.display().to_string() });
    }
    Ok(Program::load(path)?)
}

/// The included program with the bare name `path`, unless a file has that name.
///
/// # Errors
/// If the program is malformed; a test of the included programs excludes that.
pub fn shipped_program(path: &Path) -> Option<Result<Program, TextError>> {
    let shipped = path.to_str().filter(|_| !path.exists()).and_then(embedded::program)?;
    Some(Program::parse(shipped.text))
}

/// Sets up the pipeline and the map of a configuration.
///
/// # Errors
/// The first part that cannot be set up.
pub fn open(config: &Config) -> Result<(Pipeline<LlamaModel>, SemanticMap), SetupError> {
    let map = load_map(config.scene.path.as_deref())?;
    Ok((open_with(config, &map, configured_model)?, map))
}

/// Sets up the pipeline of a configuration with another map, and with the model that `model` loads ([`configured_model`]).
///
/// # Errors
/// The first part that cannot be set up.
pub fn open_with<M: LanguageModel>(
    config: &Config,
    map: &SemanticMap,
    model: impl FnOnce(&Config) -> Result<M, SetupError>,
) -> Result<Pipeline<M>, SetupError> {
    config.check()?;
    let grounding = Grounding::new(map, &config.grounding)?;
    Ok(Pipeline::new(model(config)?, grounding, pipeline_options(config)?)?)
}

/// The model of the configuration, or the embedded one.
///
/// # Errors
/// If it cannot be loaded, or does not match the pin.
pub fn configured_model(config: &Config) -> Result<LlamaModel, SetupError> {
    check_pin(config)?;
    let model = load_model(config.model.path.as_deref(), &config.model.llama_options())?;
    // The file may have been replaced between the check and the load.
    compare_pin(config, model.info().fingerprint)?;
    Ok(model)
}

/// Compares the model file with the pinned checksum before llama.cpp reads it.
///
/// # Errors
/// When it cannot be read, or is another file.
pub fn check_pin(config: &Config) -> Result<(), SetupError> {
    if config.model.sha256.is_none() {
        return Ok(());
    }
    let fingerprint = match &config.model.path {
        None => Ok(Sha256::digest(embedded::MODEL).into()),
        Some(path) => file_sha256(path)
            .map_err(|error| ModelError::Load { path: path.display().to_string(), reason: error.to_string() }),
    };
    compare_pin(config, fingerprint?)
}

fn compare_pin(config: &Config, fingerprint: [u8; 32]) -> Result<(), SetupError> {
    let Some(pinned) = &config.model.sha256 else { return Ok(()) };
    let path = config.model.path.as_ref().map_or_else(|| "(embedded)".to_owned(), |path| path.display().to_string());
    let found = hex::encode(fingerprint);
    if pinned.eq_ignore_ascii_case(&found) {
        Ok(())
    } else {
        Err(SetupError::Pin { path, found, pinned: pinned.clone() })
    }
}

/// The pipeline's options, from the configuration.
///
/// # Errors
/// When the binding sequence cannot be used.
pub(crate) fn pipeline_options(config: &Config) -> Result<PipelineOptions, ConfigError> {
    Ok(PipelineOptions {
        binding: config.binding()?,
        tokenisation: config.scoring.tokenisation,
        correction: CorrectionChoice { continuation: config.scoring.continuation, prior: config.scoring.prior },
        method: config.scoring.method,
        effort: config.scoring.effort,
        deadline_ns: config.scoring.deadline_ms.saturating_mul(1_000_000),
        history: config.history,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pin_is_held_against_what_was_loaded() {
        let mut config = Config::default();
        compare_pin(&config, [7; 32]).unwrap();
        config.model.sha256 = Some("07".repeat(32));
        compare_pin(&config, [7; 32]).unwrap();
        // As if the file was replaced after the check.
        let error = compare_pin(&config, [8; 32]).unwrap_err().to_string();
        assert!(
            error.contains("(embedded) has the SHA-256 0808") && error.contains("model.sha256 pins 0707"),
            "{error}"
        );
    }
}
