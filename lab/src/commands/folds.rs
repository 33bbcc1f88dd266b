//! `roomcast-lab folds | sealed`: forecasts about programs that the models were not trained on.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::{Value, json};

use super::{
    BINDINGS, Manifest, ModelArgs, SEALED, TRAINED, distinct, fitted, forecast_markdown, forecast_text, maps,
    report_faults,
};
use roomcast_cli::choice::choice;
use roomcast_cli::exit_code;
use roomcast_cli::{CommandResult, Failure, count, print, print_json};
use roomcast_core::forecast::ForecastOptions;
use roomcast_core::grounding::Grounding;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_lab::experiment::baselines::Statistics;
use roomcast_lab::experiment::prediction::{self, NamedProgram, Part, Report};
use roomcast_lab::experiment::{ExperimentError, Progress};
use roomcast_llama::LlamaModel;
use roomcast_services::state_file;
use roomcast_simulation::ScoreSource;
use roomcast_simulation::binding::ItemChoice;

/// Arguments of both commands.
#[derive(Debug, clap::Args)]
struct Asked {
    /// The folder of activity programs that the models were trained on in part.
    #[arg(long, value_name = "DIR")]
    programs: PathBuf,
    /// A scene file, the name of a shipped scene, or a VirtualHome graph (*_graph.json); may be repeated.
    #[arg(long, value_name = "FILE", required = true)]
    scene: Vec<PathBuf>,
    /// The choice among a label's items for an object of a program; may be repeated.
    #[arg(long, value_parser = choice::<ItemChoice>(), default_values_t = BINDINGS)]
    items: Vec<ItemChoice>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Print this experiment's tables in Markdown, as the model card has them.
    #[arg(long, conflicts_with = "json")]
    markdown: bool,
}

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
        let failed = |error: String| Failure::new(exit_code::INPUT, format!("{}: {error}", path.display()));
        let text = std::fs::read_to_string(&path).map_err(|e| failed(e.to_string()))?;
        let statistics = Statistics::from_json(&text).map_err(|e| failed(e.to_string()))?;
        Ok(Self { folder: folder.to_owned(), manifest, statistics })
    }

    fn model(&self) -> PathBuf {
        self.folder.join("household.gguf")
    }

    fn source(&self, model: &ModelArgs, grounding: &Grounding) -> Result<ScoreSource<LlamaModel>, ExperimentError> {
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

impl Asked {
    fn load(&self) -> Result<Vec<NamedProgram>, Failure> {
        let (programs, faults) = prediction::load_programs(&self.programs)?;
        report_faults(&faults);
        Ok(programs)
    }

    fn print(&self, reports: &[Report]) -> CommandResult {
        if self.json {
            return print_json(&reports);
        }
        let text = if self.markdown { forecast_markdown } else { forecast_text };
        print(&reports.iter().map(text).collect::<Vec<_>>().join("\n"))
    }

    fn measure(
        &self,
        trained: &[Trained],
        parts: &[Part],
        scenes: &[PathBuf],
        model: &ModelArgs,
    ) -> Result<Report, Failure> {
        self.measure_in(trained, parts, &maps(scenes)?, model)
    }

    fn measure_in(
        &self,
        trained: &[Trained],
        parts: &[Part],
        maps: &[(SemanticMap, Grounding)],
        model: &ModelArgs,
    ) -> Result<Report, Failure> {
        let options = prediction::Options {
            history: model.limits(),
            binding: BindingSequence::default(),
            items: distinct(&self.items),
            forecast: ForecastOptions::default(),
            seed: model.seed,
        };
        let programs: usize = parts.iter().map(|part| part.programs.len()).sum();
        let progress = Progress::new("programs", programs * maps.len() * options.items.len());
        let open = |part: usize, grounding: &Grounding| trained[part].source(model, grounding);
        Ok(prediction::run(maps, parts, &options, &progress, open)?)
    }
}

/// The folds give the models.
fn refuse_model(model: &ModelArgs, instead: &str) -> CommandResult {
    match model.model {
        Some(_) => Err(Failure::new(exit_code::USAGE, format!("--model has no effect here: give {instead}"))),
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
        return Err(Failure::new(exit_code::INPUT, fault));
    }
    let programs = args.asked.load()?;
    let trained = folders.iter().map(|folder| Trained::read(folder)).collect::<Result<Vec<_>, _>>()?;
    let parts = trained.iter().map(|fold| fold.part(&programs, "test")).collect::<Result<Vec<_>, _>>()?;
    let mut seen = std::collections::HashSet::new();
    for (fold, part) in trained.iter().zip(&parts) {
        if let Some(twice) = part.programs.iter().find(|program| !seen.insert(program.path.clone())) {
            return Err(fold.manifest.failed(format!("{} is held out by two folds", twice.path.display())));
        }
    }
    let report = args.asked.measure(&trained, &parts, &args.asked.scene, &args.model)?;
    args.asked.print(&[report])
}

fn folders(folder: &Path, file: &str) -> Result<Vec<PathBuf>, Failure> {
    let failed = |error: std::io::Error| Failure::new(exit_code::INPUT, format!("{}: {error}", folder.display()));
    let entries = std::fs::read_dir(folder).map_err(failed)?;
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
    let failed = |error: String| Failure::new(exit_code::INPUT, format!("{}: {error}", record.display()));
    let entries: Vec<Value> = match std::fs::read_to_string(record) {
        Ok(text) => serde_json::from_str(&text).map_err(|e| failed(e.to_string()))?,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Vec::new(),
        Err(error) => return Err(failed(error.to_string())),
    };
    if !entries.is_empty() {
        return Err(failed(
            "the sealed split was opened already; what was found is in this file, and it is not opened twice".into(),
        ));
    }
    let write = |entries: &[Value]| {
        let text = serde_json::to_string(entries).map_err(|e| failed(e.to_string()))?;
        let no_record =
            |error| failed(format!("what is found cannot be written down: {error}; name a file with --record"));
        state_file::write_out(record, (text + "\n").as_bytes()).map_err(no_record)
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
    let part = trained[0].part(&args.asked.load()?, SEALED)?;
    let mut opened = vec![(maps(&args.asked.scene)?, part.clone())];
    let statistics = fitted(&part.trained, &args.fit, &part.statistics)?;
    for place in folders(&args.places, "map.json")? {
        let (programs, faults) = prediction::load_programs(&place.join("programs"))?;
        report_faults(&faults);
        let part = Part { programs, statistics: statistics.clone(), ..part.clone() };
        opened.push((maps(&[place.join("map.json")])?, part));
    }
    for (_, grounding) in opened.iter().flat_map(|(maps, _)| maps) {
        trained[0].source(&args.model, grounding)?;
    }
    let sha256 = roomcast_llama::file_sha256(&trained[0].model()).map_err(|e| failed(e.to_string()))?;
    let now_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    let model = json!({ "sha256": hex::encode(sha256), "trained_by": trained[0].manifest.command });
    let entry = |reports: &[Report]| json!({ "opened_unix_s": now_s, "model": model, "reports": reports });
    // A command that is interrupted from here on has opened the split.
    write(&[entry(&[])])?;
    let reports = opened
        .iter()
        .map(|(maps, part)| args.asked.measure_in(&trained, std::slice::from_ref(part), maps, &args.model))
        .collect::<Result<Vec<_>, _>>()?;
    // Record the result before it is shown.
    write(&[entry(&reports)])?;
    args.asked.print(&reports)
}
