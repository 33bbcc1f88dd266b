//! `roomcast-lab`: the paper's tables and figures, and the project's own.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use crate::experiment::baselines::Statistics;
use crate::experiment::losses::{Figure, Summary, shown};
use crate::experiment::prediction::{self, NamedProgram, Part, Report, Target};
use crate::experiment::report::Table;
use crate::experiment::{Progress, distinct};
use roomcast_cli::choice::{CorrectionArgs, choice};
use roomcast_cli::{
    CommandResult, Failure, count, ended, model, print, print_json, ranges, report_faults, report_first_faults,
    take_negative_numbers,
};
use roomcast_core::forecast::ForecastOptions;
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::{Method, Tokenisation};
use roomcast_core::semantic_map::{SemanticMap, import};
use roomcast_llama::{CacheType, LlamaModel, LlamaOptions};
use roomcast_services::setup;
use roomcast_simulation::ScoreSource;
use roomcast_simulation::binding::ItemChoice;

mod card;
mod familiarity;
mod folds;
mod guesses;
mod habits;
mod persons;
#[cfg(test)]
#[path = "../../tests/support/requirements.rs"]
mod requirements;
mod study;
mod wishes;

/// Reproduces the paper's tables and figures, and prints Roomcast's own.
#[derive(Debug, Parser)]
#[command(name = "roomcast-lab", version, propagate_version = true)]
pub struct Args {
    #[command(subcommand)]
    experiment: Experiment,
}

roomcast_cli::commands! {
    Experiment;
    /// How well the next object and room are forecast, next to baselines on the same cases.
    Forecast(ForecastArgs) run_forecast;
    /// Every table of the model card, in Markdown.
    Card(card::CardArgs) card::run;
    /// How much weight scores deserve after unknown words, and which texts are flagged.
    Familiarity(familiarity::FamiliarityArgs) familiarity::run;
    /// The forecast over folds: every activity by a model that was trained without it.
    Folds(folds::FoldsArgs) folds::run_folds;
    /// The forecast on the sealed split, once: the result is recorded before it is shown.
    Sealed(folds::SealedArgs) folds::run_sealed;
    /// The paper's Table I: disturbance by prompt.
    Table1(study::Table1Args) study::run_table1;
    /// The paper's Table II: disturbance, time of coverage and failure by policy.
    Table2(study::Table2Args) study::run_table2;
    /// What the scores depend on: models, prompts, tokenisation, correction, windows.
    Ablation(study::AblationArgs) study::run_ablation;
    /// Disturbance against coverage for every policy and weight, with the clairvoyant bound.
    Pareto(study::ParetoArgs) study::run_pareto;
    /// How well the forecast names the person's room, by horizon.
    Horizon(study::StudyArgs) study::run_horizon;
    /// How well a home is learned, day by day: every forecast comes before its lesson.
    Habits(habits::HabitsArgs) habits::run;
    /// How often the next sentence is among the prefetched ones.
    Guesses(guesses::GuessesArgs) guesses::run;
    /// How well the tracker finds each person, in simulated homes with sensors.
    Persons(persons::PersonsArgs) persons::run;
    /// What people ask of a robot at home: days of households, by each way to control it.
    Wishes(wishes::WishesArgs) wishes::run;
    /// Try a model file, for another process of this program that loads it afterwards.
    #[command(hide = true)]
    Model(Trial) rehearse;
}

#[derive(Debug, clap::Args)]
struct Trial {
    #[command(subcommand)]
    rehearse: Rehearse,
}

#[derive(Debug, Subcommand)]
enum Rehearse {
    /// Load a model and score one label.
    Rehearse {
        /// A GGUF file.
        file: PathBuf,
        /// How the key-value cache is stored.
        #[arg(long, value_parser = choice::<CacheType>(), default_value_t = CacheType::default())]
        kv_cache: CacheType,
    },
}

#[derive(Debug, Clone, clap::Args)]
struct ModelArgs {
    /// A GGUF model; by default the embedded household model.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Observations in the history window, the paper's n_h, exactly, 1 to 1000; the daemon's default window when left out.
    #[arg(long, value_name = "N", value_parser = ranges::observations())]
    history: Option<usize>,
    /// The method of scoring; all methods agree up to rounding.
    #[arg(long, value_parser = choice::<Method>(), default_value_t)]
    method: Method,
    /// The tokenisation of prompt and labels.
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
    /// Where scores are kept for the next run; by default below the user's cache folder.
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

    fn source(&self, grounding: &Grounding) -> Result<ScoreSource<LlamaModel>, Failure> {
        let default = LlamaOptions::default();
        let threads = if self.threads == 0 { default.threads } else { self.threads };
        let model = model::load(self.model.as_deref(), &LlamaOptions { threads, cache: self.kv_cache, ..default })
            .map_err(|failure| Failure::model(failure.error))?;
        let labels = grounding.label_texts();
        // Another arithmetic gives other scores, so it has its own cache.
        let folder = self.cache().map(|folder| match self.kv_cache {
            CacheType::F32 => folder,
            other => folder.join(format!("{other:?}").to_lowercase()),
        });
        Ok(ScoreSource::new(model, &labels, self.method, self.tokenisation, self.correction.into(), folder.as_deref())?)
    }
}

/// How the forecast distinguishes things of a kind.
#[derive(Debug, Clone, clap::Args)]
struct LikeThingsArgs {
    /// The part of a label that things of a kind share evenly in the forecast; the rest goes to near things and things in use. 1 is
    /// Equation 2.
    #[arg(long, value_name = "P", default_value_t = ForecastOptions::default().any_thing, value_parser = ranges::share)]
    any_thing: f64,
}

impl LikeThingsArgs {
    fn options(&self) -> ForecastOptions {
        ForecastOptions { any_thing: self.any_thing, ..ForecastOptions::default() }
    }
}

/// Arguments of all forecasts of next objects and rooms.
#[derive(Debug, clap::Args)]
struct Asked {
    /// A folder of activity programs (VirtualHome) or of days (HOMER+), or one such file.
    #[arg(long, value_name = "DIR")]
    programs: PathBuf,
    /// A scene file, the name of a shipped scene, or a VirtualHome graph (*_graph.json); may be repeated.
    #[arg(long, value_name = "FILE", required = true)]
    scene: Vec<PathBuf>,
    /// Which of a label's items an object of a program means; may be repeated.
    #[arg(long, value_parser = choice::<ItemChoice>(), default_values_t = BINDINGS)]
    items: Vec<ItemChoice>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Print this experiment's tables in Markdown, as the model card has them.
    #[arg(long, conflicts_with = "json")]
    markdown: bool,
}

impl Asked {
    /// `open` gives the source of scores for a part, by its number.
    fn measure(
        &self,
        maps: &[(SemanticMap, Grounding)],
        parts: &[Part],
        model: &ModelArgs,
        (binding, forecast): (BindingSequence, ForecastOptions),
        open: impl FnMut(usize, &Grounding) -> Result<ScoreSource<LlamaModel>, Failure>,
    ) -> Result<Report, Failure> {
        let items = distinct(self.items.iter().copied());
        let options = prediction::Options { history: model.limits(), binding, items, forecast, seed: model.seed };
        let programs: usize = parts.iter().map(|part| part.programs.len()).sum();
        let progress = Progress::new("programs", programs * maps.len() * options.items.len());
        prediction::run(maps, parts, &options, &progress, open)
    }

    fn print(&self, reports: &[Report]) -> CommandResult {
        if self.json {
            return print_json(&reports);
        }
        let text = if self.markdown { forecast_markdown } else { forecast_text };
        print(&reports.iter().map(text).collect::<Vec<_>>().join("\n"))
    }
}

/// A split of a training manifest.
#[derive(Debug, clap::Args)]
struct SplitArgs {
    /// Take only the programs of a split that a training manifest lists, such as models/manifest.json.
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
    /// Which split of the manifest.
    #[arg(long, value_name = "NAME", default_value = "test", requires = "manifest")]
    split: String,
}

#[derive(Debug, clap::Args)]
struct ForecastArgs {
    #[command(flatten)]
    asked: Asked,
    /// Programs that the baselines are counted on, may be repeated; by default the statistics of the embedded model's training split.
    #[arg(long, value_name = "DIR")]
    fit: Vec<PathBuf>,
    #[command(flatten)]
    split: SplitArgs,
    /// The binding sequence: default, p0 to p5, or a text of your own.
    #[arg(long, value_name = "TEXT", default_value = "default")]
    binding: BindingSequence,
    #[command(flatten)]
    like_things: LikeThingsArgs,
    #[command(flatten)]
    model: ModelArgs,
}

/// The bindings that are shown side by side: a person takes any thing of a kind, or the nearest.
const BINDINGS: [ItemChoice; 2] = [ItemChoice::Uniform, ItemChoice::Nearest];

fn commands() -> clap::Command {
    take_negative_numbers(Args::command())
}

/// Parses the command line, runs the experiment and returns the exit code.
pub fn main() -> ExitCode {
    match Args::from_arg_matches(&commands().get_matches()) {
        Ok(args) => ended("roomcast", args.experiment.run()),
        Err(error) => error.format(&mut commands()).exit(),
    }
}

fn rehearse(Trial { rehearse: Rehearse::Rehearse { file, kv_cache } }: &Trial) -> CommandResult {
    model::rehearse(file, *kv_cache)
}

fn run_forecast(args: &ForecastArgs) -> CommandResult {
    let programs = prediction::load_programs(&args.asked.programs)?;
    let (programs, trained) = match &args.split.manifest {
        Some(manifest) => {
            let manifest = Manifest::read(manifest)?;
            let trained = if args.model.model.is_none() { manifest.of_split(&programs, TRAINED)? } else { Vec::new() };
            (manifest.split(programs, &args.split.split)?, trained)
        }
        None => (programs, Vec::new()),
    };
    let statistics = fitted(&[], &args.fit, &embedded_statistics()?)?;
    let parts = [Part { programs, trained, statistics }];
    let how = (args.binding.clone(), args.like_things.options());
    let open = |_, grounding: &Grounding| args.model.source(grounding);
    let report = args.asked.measure(&maps(&args.asked.scene)?, &parts, &args.model, how, open)?;
    if args.asked.json { print_json(&report) } else { args.asked.print(&[report]) }
}

fn embedded_statistics() -> Result<Statistics, Failure> {
    Statistics::from_json(roomcast_services::embedded::STATISTICS).map_err(Failure::failed)
}

fn corrections(report: &Report) -> String {
    report.corrections.iter().map(ToString::to_string).collect::<Vec<_>>().join(", or ")
}

/// Counts of `own` programs and of folders, smoothed like `statistics`; without a folder `statistics` itself.
fn fitted(own: &[NamedProgram], folders: &[PathBuf], statistics: &Statistics) -> Result<Statistics, Failure> {
    if folders.is_empty() {
        return Ok(statistics.clone());
    }
    let mut programs = own.to_vec();
    for folder in folders {
        let more = prediction::load_programs(folder)?;
        programs.extend(more);
    }
    let counts = Statistics::fit(programs.iter().map(|named| &named.program));
    Ok(Statistics { kneser_ney: statistics.kneser_ney, ..counts })
}

/// Results name scenes, so no two may have the same name.
fn maps(paths: &[PathBuf]) -> Result<Vec<(SemanticMap, Grounding)>, Failure> {
    let mut maps: Vec<(SemanticMap, Grounding)> = Vec::with_capacity(paths.len());
    for path in paths {
        let map = load_map(path)?;
        if maps.iter().any(|(other, _)| other.name() == map.name()) {
            let fault = format!(
                "{}: another of the scenes has its name, {:?}, too, and results go by it: change one's \"name\", or give it once",
                path.display(),
                map.name()
            );
            return Err(Failure::input(fault));
        }
        let grounding = Grounding::new(&map, &GroundingOptions::default())?;
        maps.push((map, grounding));
    }
    Ok(maps)
}

const GRAPH: &str = "_graph.json";

fn in_file(path: &Path, error: impl std::fmt::Display) -> Failure {
    Failure::input(format!("{}: {error}", path.display()))
}

fn read(path: &Path) -> Result<String, Failure> {
    std::fs::read_to_string(path).map_err(|error| in_file(path, error))
}

fn load_map(path: &Path) -> Result<SemanticMap, Failure> {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let Some(name) = name.strip_suffix(GRAPH) else { return Ok(setup::load_map(Some(path))?) };
    Ok(import::virtualhome(&read(path)?, name, None).map_err(|error| in_file(path, error))?.map)
}

const TRAINED: &str = "train";
/// The split that only `roomcast-lab sealed` opens.
const SEALED: &str = "sealed";

#[derive(Debug, serde::Deserialize)]
struct Manifest {
    #[serde(skip)]
    path: PathBuf,
    splits: BTreeMap<String, Split>,
    #[serde(default)]
    command: String,
    /// Similar titles, by the name of their activity.
    #[serde(default)]
    activities: BTreeMap<String, Vec<String>>,
}

#[derive(Debug, serde::Deserialize)]
struct Split {
    files: Vec<PathBuf>,
}

impl Manifest {
    fn read(path: &Path) -> Result<Self, Failure> {
        let parsed: Self = serde_json::from_str(&read(path)?).map_err(|error| in_file(path, error))?;
        Ok(Self { path: path.to_owned(), ..parsed })
    }

    fn failed(&self, error: impl std::fmt::Display) -> Failure {
        in_file(&self.path, error)
    }

    /// The programs of a split, with their activities. Only `roomcast-lab sealed` may use the sealed one.
    fn split(&self, programs: Vec<NamedProgram>, name: &str) -> Result<Vec<NamedProgram>, Failure> {
        if name == SEALED {
            return Err(self.failed("the sealed split is opened once, by `roomcast-lab sealed`"));
        }
        let chosen = self.of_split(&programs, name)?;
        if chosen.is_empty() {
            return Err(self.failed(format!("none of the programs given is in the split `{name}`")));
        }
        Ok(chosen)
    }

    fn of_split(&self, programs: &[NamedProgram], name: &str) -> Result<Vec<NamedProgram>, Failure> {
        let known = || self.splits.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
        let split = self.splits.get(name);
        let split = split.ok_or_else(|| self.failed(format!("no split `{name}`: there are {}", known())))?;
        let files: HashSet<&Path> = split.files.iter().map(PathBuf::as_path).collect();
        let activity_of: HashMap<&str, &str> = self
            .activities
            .iter()
            .flat_map(|(activity, titles)| titles.iter().map(|title| (title.as_str(), activity.as_str())))
            .collect();
        // The manifest's paths are relative to the data's root, so they are suffixes of the programs' paths.
        let listed = |path: &Path| {
            let parts: Vec<_> = path.components().collect();
            (0..parts.len()).any(|from| files.contains(parts[from..].iter().collect::<PathBuf>().as_path()))
        };
        let chosen = programs.iter().filter(|program| listed(&program.path));
        let named = |program: &NamedProgram| {
            let activity = activity_of.get(program.activity.as_str()).map(|name| (*name).to_owned());
            NamedProgram { activity: activity.unwrap_or_else(|| program.activity.clone()), ..program.clone() }
        };
        Ok(chosen.map(named).collect())
    }
}

/// A table with these heads, with commas between them.
fn headed(heads: &str, rows: impl IntoIterator<Item = Vec<String>>) -> Table {
    Table { rows: rows.into_iter().collect(), ..Table::new("", "", heads.split(", ")) }
}

fn forecast_text(report: &Report) -> String {
    let mut rows: Vec<_> = report.rows.iter().collect();
    rows.sort_by(|a, b| (&a.scene, a.target, a.items).cmp(&(&b.scene, b.target, b.items)));
    let with = |figure: Figure| shown(figure, 3);
    let named = |row: &prediction::Row, cells: &[String]| -> Vec<String> {
        let things = row.items.unwrap_or("any").to_owned();
        let named = [row.scene.clone(), target_name(row.target), things, row.predictor.to_owned()];
        [&named, cells].concat()
    };
    let scores = |s: &Summary| [s.nll(), s.top1(), s.top5(), s.mrr(), s.brier()].map(with);
    let levels = rows.iter().map(|row| {
        let s = &row.summary;
        let calibration = [s.confidence(), s.ece()].map(with);
        named(row, &[&[s.cases.to_string()][..], &scores(s), &calibration].concat())
    });
    let heads = "scene, target, things, predictor, cases, nll (nats), top-1, top-5, mrr, brier, confidence, ece";
    let table = headed(heads, levels).text();
    let less = rows.iter().filter_map(|row| Some(named(row, &scores(row.model_less_this.as_ref()?))));
    let differences = headed("scene, target, things, model less, nll (nats), top-1, top-5, mrr, brier", less).text();
    let alike = rows.iter().map(|row| {
        let of_activities = |s: &Summary| [s.nll(), s.top1(), s.mrr(), s.ece()].map(with);
        let less = row.model_less_this_by_activity.as_ref().map(of_activities).unwrap_or_default();
        named(row, &[&of_activities(&row.macro_average)[..], &less[..3]].concat())
    });
    let heads = "scene, target, things, predictor, nll (nats), top-1, mrr, ece, model less: nll (nats), top-1, mrr";
    let activities = headed(heads, alike).text();
    let mut text = format!(
        "{table}\n\nOn the same cases, resampled together, the model less each of them:\n{differences}\n\n\
         Where each of {} counts alike, and the difference over all cases with intervals over activities:\n{activities}\n",
        activities_of(report)
    );
    if !report.nearness.is_empty() {
        let near = report.nearness.iter().map(|third| {
            let [from, to] = third.nearness;
            let (s, by) = (&third.model_less_kneser_ney_cache, &third.by_activity);
            let figures = [s.nll(), s.mrr(), by.nll(), by.mrr()].map(with);
            let named = [format!("{from:.2} to {to:.2}"), third.programs.to_string(), s.cases.to_string()];
            named.into_iter().chain(figures).collect()
        });
        let near = headed("nearness, programs, cases, nll (nats), mrr, over activities: nll (nats), mrr", near).text();
        let _ = writeln!(
            text,
            "\nThe model less Kneser-Ney with its cache, next object, by the share of objects that a program has in common with the most \
             similar one trained on:\n{near}\n"
        );
    }
    let _ = writeln!(
        text,
        "{} in {}{}; {:.1} % of the next objects are in the maps, and {} had the label of the last one and are no cases; scored by {}; {}; {} \
         computed, the others from the cache",
        count(report.cases, "case"),
        count(report.programs, "program"),
        left_out(report),
        100.0 * report.bound_share,
        report.same_label,
        corrections(report),
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
    text
}

fn activities_of(report: &Report) -> String {
    if report.activities == 1 { "1 activity".to_owned() } else { format!("{} activities", report.activities) }
}

fn left_out(report: &Report) -> String {
    match report.programs_without_case {
        0 => String::new(),
        without => format!(" ({without} more without a case)"),
    }
}

/// For a difference, the sign of each end matters most.
fn difference((value, interval): Figure) -> String {
    let end = |end: f64| if end != 0.0 && end.abs() < 0.005 { format!("{end:+.3}") } else { format!("{end:.2}") };
    match interval {
        None => end(value),
        Some([low, high]) => format!("{} [{}, {}]", end(value), end(low), end(high)),
    }
}

/// The tables of the model card: next object and next room, both bindings, and the differences from the baselines.
fn forecast_markdown(report: &Report) -> String {
    let find = |scene: &str, predictor: &str, target: Target, items: Option<&str>| {
        report.rows.iter().find(|row| {
            row.scene == scene
                && row.predictor == predictor
                && row.target == target
                && (row.items == items || target == Target::Object)
        })
    };
    let mut scenes: Vec<&str> = report.rows.iter().map(|row| row.scene.as_str()).collect();
    scenes.dedup();
    let predictors: Vec<&str> = report.rows.iter().map(|row| row.predictor).collect();
    let is_measured = |items: &&str| report.rows.iter().any(|row| row.items == Some(*items));
    let items: Vec<&str> = BINDINGS.map(<&str>::from).into_iter().filter(is_measured).collect();
    let mut header: Vec<String> =
        ["place", "predictor", "object: NLL", "MRR", "top-1", "confidence", "ECE"].map(str::to_owned).to_vec();
    let of_rooms = |items| ["room: NLL", "ECE", "changes found", "where to"].map(|name| format!("{name} ({items})"));
    header.extend(items.iter().flat_map(of_rooms));
    let (n, m) = (report.programs, report.activities);
    let order = "model, model-near, model-cache, model-kneser-ney-cache, kneser-ney, kneser-ney-cache, markov2, markov1, \
                 frequency, uniform, stay, no-narration";
    let [mut levels, mut programs, mut activities, mut alike, mut alike_less] = [const { Vec::new() }; 5];
    for scene in &scenes {
        for predictor in order.split(", ").filter(|name| predictors.contains(name)) {
            let figures =
                |of: fn(&prediction::Row) -> Option<Summary>, cell: fn(Figure) -> String| -> Option<Vec<String>> {
                    let object = of(find(scene, predictor, Target::Object, None)?)?;
                    let mut cells = vec![(*scene).to_owned(), predictor.to_owned()];
                    let of_object = [object.nll(), object.mrr(), object.top1(), object.confidence(), object.ece()];
                    cells.extend(of_object.map(cell));
                    for items in &items {
                        let room = of(find(scene, predictor, Target::Room, Some(items))?)?;
                        let change = of(find(scene, predictor, Target::RoomChange, Some(items))?)?;
                        let to = of(find(scene, predictor, Target::RoomIfChanged, Some(items))?)?;
                        cells.extend([room.nll(), room.ece(), change.top1(), to.top1()].map(cell));
                    }
                    Some(cells)
                };
            let level = |figure| shown(figure, 2);
            levels.extend(figures(|row| Some(row.summary), level));
            alike.extend(figures(|row| Some(row.macro_average), level));
            if ["model-near", "kneser-ney", "kneser-ney-cache", "frequency", "stay"].contains(&predictor) {
                programs.extend(figures(|row| row.model_less_this, difference));
                activities.extend(figures(|row| row.model_less_this_by_activity, difference));
                alike_less.extend(figures(|row| row.model_less_this_macro, difference));
            }
        }
    }
    let table = |second: &str, rows: Vec<Vec<String>>| {
        let mut header = header.clone();
        header[1] = second.to_owned();
        Table { header, rows, ..Table::default() }.markdown()
    };
    let (levels, programs) = (table("predictor", levels), table("model less", programs));
    let mut text = format!("{levels}\n\nThe model less each baseline, intervals over {n} programs:\n\n{programs}\n");
    if m > 1 {
        let (by_activity, alike) = (table("model less", activities), table("predictor", alike));
        let _ = writeln!(
            text,
            "\nThe same, intervals over {m} activities:\n\n{by_activity}\n\n\
             Means in which each of {m} activities counts alike:\n\n{alike}\n\n{}",
            table("model less", alike_less)
        );
    }
    if !report.nearness.is_empty() {
        let _ = writeln!(text, "\n{}", near_markdown(report));
    }
    let _ = writeln!(
        text,
        "\n{}, {}{}, {}; {:.1} % of the next objects are in the maps; {} with the label of the last one are no cases; {}.",
        count(report.cases, "case"),
        count(n, "program"),
        left_out(report),
        activities_of(report),
        100.0 * report.bound_share,
        report.same_label,
        corrections(report)
    );
    text
}

fn near_markdown(report: &Report) -> String {
    let row = |third: &prediction::Near| {
        let (s, by) = (&third.model_less_kneser_ney_cache, &third.by_activity);
        let [from, to] = third.nearness;
        let figures = [s.nll(), s.mrr(), by.nll(), by.mrr()].map(difference);
        [format!("{from:.2} to {to:.2}"), third.programs.to_string()].into_iter().chain(figures).collect()
    };
    let header = "objects in common with the nearest trained program, programs, NLL, MRR, over activities: NLL, MRR";
    let table = headed(header, report.nearness.iter().map(row)).markdown();
    format!("The model less Kneser-Ney with its cache, next object, by nearness:\n\n{table}")
}

fn target_name(target: Target) -> String {
    serde_json::to_value(target).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// clap notices a default of the wrong type only when it reads the option.
    #[test]
    fn defaults_of_each_experiment_have_the_types_of_their_options() {
        for name in Args::command().get_subcommands().map(|one| one.get_name().to_owned()) {
            // A missing argument is an error; a wrong type is a panic.
            let _read = Args::try_parse_from(["roomcast-lab", &name]);
        }
    }
}
