//! `roomcast-lab folds | sealed`: forecasts about programs that the models were not trained on.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::{Value, json};

use super::{Asked, Manifest, ModelArgs, SEALED, TRAINED, fitted, in_file, maps, read};
use crate::experiment::baselines::Statistics;
use crate::experiment::prediction::{self, NamedProgram, Part, Report};
use roomcast_cli::{CommandResult, Failure, count};
use roomcast_core::grounding::Grounding;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_llama::LlamaModel;
use roomcast_services::state_file;
use roomcast_simulation::ScoreSource;

/// Arguments of `roomcast-lab folds`. It uses only the models that were trained for it.
#[derive(Debug, clap::Args)]
#[command(mut_arg("model", |arg| arg.hide(true)))]
pub(super) struct FoldsArgs {
    /// The output of `training/run.py --folds`: a folder per fold, with model, manifest and statistics.
    #[arg(long, value_name = "DIR")]
    folds: PathBuf,
    #[command(flatten)]
    asked: Asked,
    #[command(flatten)]
    model: ModelArgs,
}

/// Arguments of `roomcast-lab sealed`. It uses only the models that were trained for it.
#[derive(Debug, clap::Args)]
#[command(mut_arg("model", |arg| arg.hide(true)))]
pub(super) struct SealedArgs {
    /// A folder with model, manifest and statistics, from `training/run.py --fold`.
    #[arg(long, value_name = "DIR")]
    trained: PathBuf,
    /// The record of the opening of the split; if the file has an entry, the command ends before it reads the split.
    #[arg(long, value_name = "FILE", default_value = "models/sealed.json")]
    record: PathBuf,
    /// Places that are opened together with the split: a folder for each, with map.json and programs/.
    #[arg(long, value_name = "DIR", default_value = "training/sealed")]
    places: PathBuf,
    /// Programs for the baselines of these places, in addition to the model's training programs; may be repeated. They must not contain the
    /// sealed ones: `training/routines.py --fold sealed` writes such programs.
    #[arg(long, value_name = "DIR")]
    fit: Vec<PathBuf>,
    #[command(flatten)]
    asked: Asked,
    #[command(flatten)]
    model: ModelArgs,
}

struct Trained {
    folder: PathBuf,
    manifest: Manifest,
    statistics: Statistics,
}

impl Trained {
    fn read(folder: &Path) -> Result<Self, Failure> {
        let manifest = Manifest::read(&folder.join("manifest.json"))?;
        let path = folder.join("household-statistics.json");
        let statistics = Statistics::from_json(&read(&path)?).map_err(|error| in_file(&path, error))?;
        Ok(Self { folder: folder.to_owned(), manifest, statistics })
    }

    fn model(&self) -> PathBuf {
        self.folder.join("household.gguf")
    }

    fn source(&self, model: &ModelArgs, grounding: &Grounding) -> Result<ScoreSource<LlamaModel>, Failure> {
        ModelArgs { model: Some(self.model()), ..model.clone() }.source(grounding)
    }

    fn part(&self, programs: &[NamedProgram], split: &str) -> Result<Part, Failure> {
        let asked = self.manifest.of_split(programs, split)?;
        if asked.is_empty() {
            return Err(self.manifest.failed(format!("none of the programs given is in the split `{split}`")));
        }
        let trained = self.manifest.of_split(programs, TRAINED)?;
        if let Some(both) = trained.iter().find(|known| asked.iter().any(|program| program.path == known.path)) {
            let fault =
                format!("{} is in the splits `{TRAINED}` and `{split}`, so it was not held out", both.path.display());
            return Err(self.manifest.failed(fault));
        }
        Ok(Part { programs: asked, trained, statistics: self.statistics.clone() })
    }
}

fn measure(
    asked: &Asked,
    trained: &[Trained],
    parts: &[Part],
    maps: &[(SemanticMap, Grounding)],
    model: &ModelArgs,
) -> Result<Report, Failure> {
    let open = |part: usize, grounding: &Grounding| trained[part].source(model, grounding);
    asked.measure(maps, parts, model, Default::default(), open)
}

/// The folds give the models.
fn refuse_model(model: &ModelArgs, instead: &str) -> CommandResult {
    match model.model {
        Some(_) => Err(Failure::usage(format!("--model has no effect here: give {instead}"))),
        None => Ok(()),
    }
}

pub(super) fn run_folds(args: &FoldsArgs) -> CommandResult {
    refuse_model(&args.model, "--folds")?;
    let folders = folders(&args.folds, "manifest.json")?;
    if folders.len() < 2 {
        let found = count(folders.len(), "finished fold");
        let folds = args.folds.display();
        let fault = format!(
            "{folds}: {found}, and it takes two at least: `python training/run.py --shared DATA --folds {folds}` trains them"
        );
        return Err(Failure::input(fault));
    }
    let programs = prediction::load_programs(&args.asked.programs)?;
    let trained = folders.iter().map(|folder| Trained::read(folder)).collect::<Result<Vec<_>, _>>()?;
    let parts = trained.iter().map(|fold| fold.part(&programs, "test")).collect::<Result<Vec<_>, _>>()?;
    let mut seen = std::collections::HashSet::new();
    for (fold, part) in trained.iter().zip(&parts) {
        if let Some(twice) = part.programs.iter().find(|program| !seen.insert(program.path.clone())) {
            return Err(fold.manifest.failed(format!("{} is held out by two folds", twice.path.display())));
        }
    }
    let report = measure(&args.asked, &trained, &parts, &maps(&args.asked.scene)?, &args.model)?;
    args.asked.print(&[report])
}

fn folders(folder: &Path, file: &str) -> Result<Vec<PathBuf>, Failure> {
    let entries = std::fs::read_dir(folder).map_err(|error| in_file(folder, error))?;
    let mut found: Vec<PathBuf> =
        entries.filter_map(|entry| Some(entry.ok()?.path())).filter(|path| path.join(file).is_file()).collect();
    found.sort();
    Ok(found)
}

/// An option in the command that trains a model only for the sealed split.
const ONLY_SEALED: &str = " --fold sealed";

pub(super) fn run_sealed(args: &SealedArgs) -> CommandResult {
    refuse_model(&args.model, "--trained")?;
    let record = &args.record;
    let failed = |error: &dyn std::fmt::Display| in_file(record, error);
    let entries: Vec<Value> = match std::fs::read_to_string(record) {
        Ok(text) => serde_json::from_str(&text).map_err(|error| failed(&error))?,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Vec::new(),
        Err(error) => return Err(failed(&error)),
    };
    if !entries.is_empty() {
        return Err(failed(
            &"the sealed split was opened already; what was found is in this file, and it is not opened twice",
        ));
    }
    let write = |entries: &[Value]| {
        state_file::write_out(record, format!("{}\n", json!(entries)).as_bytes()).map_err(|error| {
            failed(&format_args!("what is found cannot be written down: {error}; name a file with --record"))
        })
    };
    // Write before the split is read, since the result will be recorded in this file.
    write(&entries)?;
    let trained = [Trained::read(&args.trained)?];
    if !trained[0].manifest.command.contains(ONLY_SEALED) {
        let fault = format!(
            "this model was trained with {:?}, and the split is opened once: give one of `python training/run.py --shared DATA{ONLY_SEALED}`",
            trained[0].manifest.command
        );
        return Err(trained[0].manifest.failed(fault));
    }
    // Everything that may fail comes before the split is opened.
    let part = trained[0].part(&prediction::load_programs(&args.asked.programs)?, SEALED)?;
    let mut opened = vec![(maps(&args.asked.scene)?, part.clone())];
    let statistics = fitted(&part.trained, &args.fit, &part.statistics)?;
    for place in folders(&args.places, "map.json")? {
        let programs = prediction::load_programs(&place.join("programs"))?;
        let part = Part { programs, statistics: statistics.clone(), ..part.clone() };
        opened.push((maps(&[place.join("map.json")])?, part));
    }
    for (_, grounding) in opened.iter().flat_map(|(maps, _)| maps) {
        trained[0].source(&args.model, grounding)?;
    }
    let sha256 = roomcast_llama::file_sha256(&trained[0].model()).map_err(|error| failed(&error))?;
    let now_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    let model = json!({ "sha256": hex::encode(sha256), "trained_by": trained[0].manifest.command });
    let entry = |reports: &[Report]| json!({ "opened_unix_s": now_s, "model": model, "reports": reports });
    // A command that is interrupted from here on has opened the split.
    write(&[entry(&[])])?;
    let reports = opened
        .iter()
        .map(|(maps, part)| measure(&args.asked, &trained, std::slice::from_ref(part), maps, &args.model))
        .collect::<Result<Vec<_>, _>>()?;
    // Record the result before it is shown.
    write(&[entry(&reports)])?;
    args.asked.print(&reports)
}
