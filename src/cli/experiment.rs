//! `roomcast experiment`: the paper's tables and figures, and the project's own.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::Subcommand;

use super::choice::{CorrectionArgs, choice};
use super::{CommandResult, Failure, count, model, ranges};
use crate::exit_code;
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::{Method, Tokenisation};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_lab::experiment::baselines::Statistics;
use roomcast_lab::experiment::losses::Summary;
use roomcast_lab::experiment::prediction::{self, NamedProgram, Report};
use roomcast_lab::experiment::{ExperimentError, Progress, ScoreSource, ScoresError};
use roomcast_lab::simulation::binding::ItemChoice;
use roomcast_llama::{CacheType, LlamaModel, LlamaOptions};
use roomcast_services::setup;

mod habits;
mod study;

pub(super) use habits::days;

/// Arguments of `roomcast experiment`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    experiment: Experiment,
}

#[derive(Debug, Subcommand)]
enum Experiment {
    /// How well the next object and room are forecast, next to baselines on the same cases.
    Forecast(ForecastArgs),
    /// The paper's Table I: disturbance by prompt.
    Table1(study::Table1Args),
    /// The paper's Table II: disturbance, time of coverage and failure by policy.
    Table2(study::StudyArgs),
    /// What the scores depend on: models, prompts, tokenisation, correction, windows.
    Ablation(study::AblationArgs),
    /// Disturbance against coverage for every policy and weight, with the clairvoyant bound.
    Pareto(study::ParetoArgs),
    /// How well the forecast says where the person will be, by horizon.
    Horizon(study::StudyArgs),
    /// How well a home is learned, day by day: every forecast is made first and learned from then.
    Habits(habits::HabitsArgs),
}

/// What all experiments share: model, window and cache.
#[derive(Debug, Clone, clap::Args)]
struct ModelArgs {
    /// A GGUF model; the embedded household model when left out.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Observations in the history window, the paper's n_h, exactly, 1 to 1000; the daemon's default window when left out.
    #[arg(long, value_name = "N", value_parser = ranges::observations())]
    history: Option<usize>,
    /// How labels are scored; all methods agree up to rounding.
    #[arg(long, value_parser = choice::<Method>(), default_value_t)]
    method: Method,
    /// How prompt and labels are cut into tokens.
    #[arg(long, value_parser = choice::<Tokenisation>(), default_value_t)]
    tokenisation: Tokenisation,
    #[command(flatten)]
    correction: CorrectionArgs,
    /// Threads of one decoder call, at most 256; 0 chooses all cores but one.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = ranges::threads())]
    threads: usize,
    /// How the key-value cache is stored. In single precision, unlike in the running system, results depend less on the processor.
    #[arg(long, value_parser = choice::<CacheType>(), default_value_t = CacheType::F32)]
    kv_cache: CacheType,
    /// Where scores are kept for the next run; below the user's cache folder when left out.
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Keep no scores.
    #[arg(long, conflicts_with = "cache")]
    no_cache: bool,
    /// Seed of every draw: the same seed gives the same table.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = ranges::any())]
    seed: u64,
}

impl ModelArgs {
    fn limits(&self) -> HistoryLimits {
        self.history.map_or_else(HistoryLimits::default, HistoryLimits::exact)
    }

    fn cache(&self) -> Option<PathBuf> {
        if self.no_cache {
            return None;
        }
        self.cache.clone().or_else(|| {
            let folder = |name, below: &str| {
                std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute()).map(|path| path.join(below))
            };
            Some(folder("XDG_CACHE_HOME", "").or_else(|| folder("HOME", ".cache"))?.join("roomcast/scores"))
        })
    }

    /// The product's scorer for a map's labels.
    fn source(&self, grounding: &Grounding) -> Result<ScoreSource<LlamaModel>, ExperimentError> {
        let default = LlamaOptions::default();
        let threads = if self.threads == 0 { default.threads } else { self.threads };
        let model = model::load(self.model.as_deref(), &LlamaOptions { threads, cache: self.kv_cache, ..default })
            .map_err(|failure| ExperimentError::Model(failure.error))?;
        let labels = grounding.label_texts();
        // Scores of another arithmetic are others.
        let folder = self.cache().map(|folder| match self.kv_cache {
            CacheType::F32 => folder,
            other => folder.join(format!("{other:?}").to_lowercase()),
        });
        Ok(ScoreSource::new(model, &labels, self.method, self.tokenisation, self.correction.into(), folder.as_deref())?)
    }
}

/// Arguments of `roomcast experiment forecast`.
#[derive(Debug, clap::Args)]
struct ForecastArgs {
    /// A folder of activity programs (VirtualHome) or of days (HOMER+), or one such file.
    #[arg(long, value_name = "DIR")]
    programs: PathBuf,
    /// A scene file, or the name of a shipped scene; may be repeated.
    #[arg(long, value_name = "FILE", required = true)]
    scene: Vec<PathBuf>,
    /// Programs that the baselines are fitted on; the statistics of the embedded model's training split when left out.
    #[arg(long, value_name = "DIR")]
    fit: Option<PathBuf>,
    /// Take only the programs of a split that a training manifest lists, such as models/manifest.json.
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
    /// Which split of the manifest.
    #[arg(long, value_name = "NAME", default_value = "test", requires = "manifest")]
    split: String,
    /// Which of a label's items an object of a program means.
    #[arg(long, value_parser = choice::<ItemChoice>(), default_value_t)]
    items: ItemChoice,
    /// The binding sequence: default, p0 to p5, or a text of your own.
    #[arg(long, value_name = "TEXT", default_value = "default")]
    binding: BindingSequence,
    #[command(flatten)]
    model: ModelArgs,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl From<ExperimentError> for Failure {
    fn from(error: ExperimentError) -> Self {
        let code = match &error {
            ExperimentError::Scores(ScoresError::Score(_)) | ExperimentError::Model(_) => exit_code::MODEL,
            ExperimentError::Scores(ScoresError::Cache { .. }) | ExperimentError::BelowBound { .. } => {
                exit_code::FAILURE
            }
            #[cfg(feature = "optimum")]
            ExperimentError::Solver(_) | ExperimentError::SolversDisagree { .. } => exit_code::FAILURE,
            _ => exit_code::INPUT,
        };
        Self::new(code, error)
    }
}

/// Runs the experiment that was named.
///
/// # Errors
/// When an input or the model cannot be used.
pub fn run(args: &Args) -> CommandResult {
    match &args.experiment {
        Experiment::Forecast(args) => run_forecast(args),
        Experiment::Table1(args) => study::run_table1(args),
        Experiment::Table2(args) => study::run_table2(args),
        Experiment::Ablation(args) => study::run_ablation(args),
        Experiment::Pareto(args) => study::run_pareto(args),
        Experiment::Horizon(args) => study::run_horizon(args),
        Experiment::Habits(args) => habits::run(args),
    }
}

fn run_forecast(args: &ForecastArgs) -> CommandResult {
    let (mut programs, faults) = prediction::load_programs(&args.programs)?;
    report_faults(&faults);
    if let Some(manifest) = &args.manifest {
        programs = split(programs, manifest, &args.split)?;
    }
    let statistics = match &args.fit {
        Some(folder) => {
            let (fitted, faults) = prediction::load_programs(folder)?;
            report_faults(&faults);
            Statistics::fit(fitted.iter().map(|named| &named.program))
        }
        None => Statistics::from_json(roomcast_services::embedded::STATISTICS)
            .map_err(|e| Failure::new(exit_code::FAILURE, e))?,
    };
    let maps = maps(&args.scene)?;
    let options = prediction::Options {
        history: args.model.limits(),
        binding: args.binding.clone(),
        items: args.items,
        seed: args.model.seed,
    };
    let progress = Progress::new("programs", programs.len() * maps.len());
    let open = |grounding: &Grounding| args.model.source(grounding);
    let report = prediction::run(&maps, &programs, &statistics, &options, &progress, open)?;
    drop(progress);
    if args.json {
        return super::print_json(&report);
    }
    print_forecast(&report)
}

/// Results go by the names of scenes, so no two may have the same.
fn maps(paths: &[PathBuf]) -> Result<Vec<(SemanticMap, Grounding)>, Failure> {
    let mut maps: Vec<(SemanticMap, Grounding)> = Vec::with_capacity(paths.len());
    for path in paths {
        let map = setup::load_map(Some(path))?;
        if maps.iter().any(|(other, _)| other.name() == map.name()) {
            let fault = format!(
                "{}: another of the scenes has its name, {:?}, too, and results go by it: change one's \"name\", or give it once",
                path.display(),
                map.name()
            );
            return Err(Failure::new(exit_code::INPUT, fault));
        }
        let grounding =
            Grounding::new(&map, &GroundingOptions::default()).map_err(|e| Failure::new(exit_code::INPUT, e))?;
        maps.push((map, grounding));
    }
    Ok(maps)
}

/// Files that cannot be read are no reason to throw the others away, but are never passed over in silence.
fn report_faults(faults: &[String]) {
    for fault in faults.iter().take(10) {
        eprintln!("roomcast: skipped: {fault}");
    }
    if faults.len() > 10 {
        eprintln!("roomcast: skipped {} more files", faults.len() - 10);
    }
}

#[derive(serde::Deserialize)]
struct Manifest {
    splits: std::collections::BTreeMap<String, Split>,
}

#[derive(serde::Deserialize)]
struct Split {
    files: Vec<PathBuf>,
}

fn split(programs: Vec<NamedProgram>, manifest: &Path, name: &str) -> Result<Vec<NamedProgram>, Failure> {
    let failed = |error: String| Failure::new(exit_code::INPUT, format!("{}: {error}", manifest.display()));
    let text = std::fs::read_to_string(manifest).map_err(|e| failed(e.to_string()))?;
    let parsed: Manifest = serde_json::from_str(&text).map_err(|e| failed(e.to_string()))?;
    let known = || parsed.splits.keys().cloned().collect::<Vec<_>>().join(", ");
    let split = parsed.splits.get(name).ok_or_else(|| failed(format!("no split `{name}`: there are {}", known())))?;
    let files: std::collections::HashSet<&Path> = split.files.iter().map(PathBuf::as_path).collect();
    // The manifest's paths are relative to the data's root: the ends of the programs' paths.
    let listed = |path: &Path| {
        let parts: Vec<_> = path.components().collect();
        (0..parts.len()).any(|from| files.contains(parts[from..].iter().collect::<PathBuf>().as_path()))
    };
    let chosen: Vec<_> = programs.into_iter().filter(|program| listed(&program.path)).collect();
    if chosen.is_empty() {
        return Err(failed(format!("none of the programs given is in the split `{name}`")));
    }
    Ok(chosen)
}

fn print_forecast(report: &Report) -> CommandResult {
    let mut table =
        super::table(&["scene", "target", "predictor", "cases", "nll (nats)", "top-1", "top-5", "mrr", "brier", "ece"]);
    let mut differences =
        super::table(&["scene", "target", "model less", "nll (nats)", "top-1", "top-5", "mrr", "brier"]);
    let mut activities =
        super::table(&["scene", "target", "predictor", "nll (nats)", "top-1", "mrr", "model less: nll (nats)", "mrr"]);
    let mut rows: Vec<_> = report.rows.iter().collect();
    rows.sort_by(|a, b| (&a.scene, a.target).cmp(&(&b.scene, b.target)));
    for row in rows {
        let target =
            serde_json::to_value(row.target).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default();
        let named = [row.scene.clone(), target, row.predictor.to_owned()];
        // Resampling one program gives the same cases again and again: no interval at all, and not one without width.
        let with = |value: f64, [low, high]: [f64; 2]| match report.programs {
            0 | 1 => format!("{value:.3}"),
            _ => format!("{value:.3} [{low:.3}, {high:.3}]"),
        };
        let figures = |s: &Summary| {
            [
                with(s.nll_nats, s.ci95.nll_nats),
                with(s.top1, s.ci95.top1),
                with(s.top5, s.ci95.top5),
                with(s.mrr, s.ci95.mrr),
                with(s.brier, s.ci95.brier),
            ]
        };
        if let Some(less) = &row.model_less_this {
            differences.add_row(named.iter().cloned().chain(figures(less)));
        }
        let (s, less) = (&row.macro_average, row.model_less_this_by_activity.as_ref());
        let difference = |value: fn(&Summary) -> (f64, [f64; 2])| {
            less.map_or_else(String::new, |less| {
                let (value, interval) = value(less);
                with(value, interval)
            })
        };
        activities.add_row(named.iter().cloned().chain([
            with(s.nll_nats, s.ci95.nll_nats),
            with(s.top1, s.ci95.top1),
            with(s.mrr, s.ci95.mrr),
            difference(|less| (less.nll_nats, less.ci95.nll_nats)),
            difference(|less| (less.mrr, less.ci95.mrr)),
        ]));
        let s = &row.summary;
        let ece = with(s.ece, s.ci95.ece);
        table.add_row(named.into_iter().chain([s.cases.to_string()]).chain(figures(s)).chain([ece]));
    }
    let counted = report.rows.first().map_or(0, |row| row.macro_average.cases);
    let mut text = format!(
        "{table}\n\nOn the same cases, resampled together, the model less each of them:\n{differences}\n\n\
         Where each of {counted} activities (programs of one title) counts alike, and the difference over all cases with intervals over \
         activities:\n{activities}\n"
    );
    let _ = writeln!(
        text,
        "{} in {}; {:.1} % of the next objects are in the maps; scored by {}; {}; {} computed, the others from the cache",
        count(report.cases, "case"),
        count(report.programs, "program"),
        100.0 * report.bound_share,
        report.correction,
        if report.programs > 1 {
            "95 % intervals by bootstrap over programs"
        } else {
            "intervals need several programs"
        },
        count(report.computed, "score")
    );
    let missing: Vec<_> = report.unbound.iter().take(12).map(|(name, n)| format!("{name} ({n})")).collect();
    if !missing.is_empty() {
        let _ = writeln!(text, "not in the maps: {}", missing.join(", "));
    }
    super::print(&text)
}
