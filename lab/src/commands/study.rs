//! `roomcast-lab table1 | table2 | ablation | pareto | horizon`: a robot among people, many times over.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::{LikeThingsArgs, ModelArgs, distinct, maps, report_faults};
use crate::experiment::Progress;
use crate::experiment::report::{Report, Table};
use crate::experiment::setups::{self, SetupRow};
use crate::experiment::tables::{self, DIFFERENCES, PAPER_TABLE1, PAPER_TABLE2, PaperRow};
use roomcast_cli::choice::{choice, policy};
use roomcast_cli::{CommandResult, Failure, count, print, print_json, ranges};
use roomcast_core::forecast::ForecastOptions;
use roomcast_core::grounding::{GroundedScores, Grounding};
use roomcast_core::narration::Sentence;
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::policy::{PolicyName, WEIGHT_DEFAULT_S, WEIGHT_DEFAULT_SLOTS, WEIGHT_DEFAULT_STAY};
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::Tokenisation;
use roomcast_core::scorer::correction::{Correction, CorrectionChoice};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_llama::LlamaModel;
use roomcast_simulation::binding::ItemChoice;
use roomcast_simulation::drawing;
use roomcast_simulation::study::{self, Activity, Decider, Figures, Home, Options};
use roomcast_simulation::timeline::{PersonOptions, TimelineError};
use roomcast_simulation::world::Disturbance;
use roomcast_simulation::{ScoreSource, StudyError};

mod activities;

use activities::{Named, tell_apart};

const PACE_S: f64 = 24.0;

/// Arguments of all simulations, with a robot or without.
#[derive(Debug, clap::Args)]
pub(super) struct StudyArgs {
    /// A scene file, the name of a shipped scene, or a VirtualHome graph (*_graph.json); may be repeated. By default the three apartments.
    #[arg(long, value_name = "FILE")]
    scene: Vec<PathBuf>,
    /// An activity program (VirtualHome), a day (HOMER+), a folder of either, or the name of a shipped program; may be repeated. By default
    /// the three shipped programs. An activity is skipped and reported if a scene lacks all its objects, or if it is in a folder and too
    /// short.
    #[arg(long, value_name = "FILE")]
    program: Vec<PathBuf>,
    /// The binding sequence: default, p0 to p5, or a text of your own.
    #[arg(long, value_name = "TEXT", default_value = "default")]
    binding: BindingSequence,
    /// The choice among a label's items for an object of a program.
    #[arg(long, value_parser = choice::<ItemChoice>(), default_value_t = Options::default().items)]
    items: ItemChoice,
    /// Seconds per action, to which programs are stretched; 0 leaves the durations of actions.toml.
    #[arg(long, value_name = "SECONDS", default_value_t = PACE_S, value_parser = ranges::act_s_or_none)]
    pace: f64,
    /// Longest time of one act before stretching, in seconds: a demonstration shows an act, it does not wait for its end.
    #[arg(long, value_name = "SECONDS", default_value_t = PersonOptions::default().action_s_max, value_parser = ranges::act_s)]
    longest_act: f64,
    /// The forecast's initial mean time from one object to the next, in seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = ForecastOptions::default().object_s, value_parser = ranges::act_s)]
    object_time: f64,
    /// The forecast's initial mean stay in a room, in seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = ForecastOptions::default().stay_s, value_parser = ranges::act_s)]
    stay_time: f64,
    #[command(flatten)]
    like_things: LikeThingsArgs,
    /// Of folders, take only the programs of a split that a training manifest lists, such as models/manifest.json.
    #[arg(long, value_name = "FILE", requires = "program")]
    manifest: Option<PathBuf>,
    /// Which split of the manifest.
    #[arg(long, value_name = "NAME", default_value = "test", requires = "manifest")]
    split: String,
    /// Carry out all programs at the same time, one person each.
    #[arg(long)]
    together: bool,
    #[command(flatten)]
    model: ModelArgs,
    /// Write CSV, SVG and report.html into this folder; PNG, too, in a build with the feature `png`.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Print the tables in Markdown, without the tables of single cells.
    #[arg(long, conflicts_with = "json")]
    markdown: bool,
}

/// Arguments of the robot.
#[derive(Debug, clap::Args)]
struct RobotArgs {
    /// T_r, the time the robot works in each room, in seconds; may be repeated.
    #[arg(long, value_name = "SECONDS", value_parser = ranges::room_time_s())]
    room_time: Vec<usize>,
    /// Restarts per cell and policy.
    #[arg(long, value_name = "N", default_value_t = Options::default().restarts, value_parser = ranges::some())]
    restarts: u64,
    /// When the robot disturbs: same-room, in-sight, or near:METRES.
    #[arg(long, value_name = "KIND", default_value = "same-room", value_parser = disturbance)]
    disturbance: Disturbance,
}

fn disturbance(text: &str) -> Result<Disturbance, String> {
    let near = |metres: &str| metres.parse().ok().filter(|m: &f64| m.is_finite() && *m > 0.0);
    match text {
        "same-room" => Ok(Disturbance::SameRoom),
        "in-sight" => Ok(Disturbance::InSight),
        _ => match text.strip_prefix("near:").and_then(near) {
            Some(metres) => Ok(Disturbance::Near(metres)),
            None => Err(format!("`{text}` is none of same-room, in-sight, near:METRES")),
        },
    }
}

#[derive(Debug, clap::Args)]
pub(super) struct Table1Args {
    /// The policy that uses the prompts' scores.
    #[arg(long, value_name = "POLICY", value_parser = policy(), default_value_t = PolicyName::InformedAvoidance)]
    policy: PolicyName,
    #[command(flatten)]
    robot: RobotArgs,
    #[command(flatten)]
    study: StudyArgs,
}

/// The arguments that `--setups` varies. An argument that requires it also lists them: clap drops a requirement if a given argument
/// excludes it.
const OF_ONE_SETUP: [&str; 3] = ["items", "longest_act", "history"];

#[derive(Debug, clap::Args)]
pub(super) struct Table2Args {
    /// Also under every set-up that the paper leaves open, with intervals and at the naive policy's share of failures: any thing of a kind
    /// or the nearest, acts up to 10, 20 and 60 s, a window of 16 observations or the whole narration.
    #[arg(long, conflicts_with_all = OF_ONE_SETUP)]
    setups: bool,
    /// With --setups, further models, such as trainings with other seeds; may be repeated. Intervals are over them, too.
    #[arg(long, value_name = "FILE", requires = "setups", conflicts_with_all = OF_ONE_SETUP)]
    also_model: Vec<PathBuf>,
    #[command(flatten)]
    robot: RobotArgs,
    #[command(flatten)]
    study: StudyArgs,
}

#[derive(Debug, clap::Args)]
pub(super) struct AblationArgs {
    /// Further models to compare; may be repeated.
    #[arg(long, value_name = "FILE")]
    also_model: Vec<PathBuf>,
    /// Binding sequences to compare; may be repeated. By default the default one and p0 to p5.
    #[arg(long, value_name = "TEXT")]
    prompt: Vec<BindingSequence>,
    /// Window lengths to compare; may be repeated.
    #[arg(long, value_name = "N", default_values_t = [1, 2, 4, 8, 16], value_parser = ranges::observations())]
    window: Vec<usize>,
    #[command(flatten)]
    robot: RobotArgs,
    #[command(flatten)]
    study: StudyArgs,
}

#[derive(Debug, clap::Args)]
pub(super) struct ParetoArgs {
    /// Weights of coverage-aware avoidance, in seconds of disturbance per failed coverage; may be repeated.
    #[arg(long, value_name = "SECONDS", default_values_t = [0.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 80.0, 100.0, 150.0, 200.0, 300.0, 1000.0], value_parser = ranges::time_s)]
    weight: Vec<f64>,
    #[command(flatten)]
    robot: RobotArgs,
    #[command(flatten)]
    study: StudyArgs,
}

type Pictures = Vec<(String, String)>;

struct Setup<'a> {
    args: &'a StudyArgs,
    scenes: Vec<(SemanticMap, Grounding)>,
    activities: Vec<Named>,
    /// Whether the paper's figures apply: places, activities, T_r, disturbance and pace are the paper's.
    is_of_the_paper: bool,
    /// Some activities come from folders: activities too short for every room are skipped.
    folders: bool,
    room_times_s: Vec<usize>,
    options: Options,
}

impl StudyArgs {
    /// Loads the given T_r, scenes and programs, or by default the paper's.
    fn setup(
        &self,
        robot: Option<&RobotArgs>,
        room_times_s: &[usize],
        scenes: &[&str],
        programs: &[&str],
    ) -> Result<Setup<'_>, Failure> {
        let or = |given: &[PathBuf], default: &[&str]| -> Vec<PathBuf> {
            if given.is_empty() { default.iter().map(PathBuf::from).collect() } else { given.to_vec() }
        };
        let is_papers = |given: &[PathBuf], default: &[&str]| {
            given.is_empty() || given.iter().map(PathBuf::as_path).eq(default.iter().map(Path::new))
        };
        let is_of_the_paper = is_papers(&self.scene, scenes) && is_papers(&self.program, programs);
        let scenes = maps(&or(&self.scene, scenes))?;
        let (mut activities, mut folders) = (Vec::new(), false);
        for path in or(&self.program, programs) {
            folders |= path.is_dir();
            activities.extend(self.load(&path)?);
        }
        tell_apart(&mut activities)?;
        let mean_action_s = (self.pace > 0.0).then_some(self.pace);
        let default = Options::default();
        let options = Options {
            history: self.model.limits(),
            items: self.items,
            person: PersonOptions { mean_action_s, action_s_max: self.longest_act, ..PersonOptions::default() },
            disturbance: robot.map_or(default.disturbance, |robot| robot.disturbance),
            forecast: ForecastOptions {
                object_s: self.object_time,
                stay_s: self.stay_time,
                ..self.like_things.options()
            },
            restarts: robot.map_or(default.restarts, |robot| robot.restarts),
            seed: self.model.seed,
        };
        let given_s = robot.map_or_else(Vec::new, |robot| distinct(robot.room_time.iter().copied()));
        let given_s = if given_s.is_empty() { room_times_s.to_vec() } else { given_s };
        let is_of_the_paper = is_of_the_paper
            && given_s == room_times_s
            && options.disturbance == default.disturbance
            && self.pace == PACE_S
            && !self.together;
        Ok(Setup { args: self, scenes, activities, is_of_the_paper, folders, room_times_s: given_s, options })
    }
}

impl Setup<'_> {
    fn homes(
        &self,
        sources: &mut [ScoreSource<LlamaModel>],
        binding: &BindingSequence,
        options: &Options,
    ) -> Result<Vec<Home<'_>>, Failure> {
        let at_once = if self.args.together { self.activities.len().max(1) } else { 1 };
        let room_time_s = self.room_times_s.iter().max().copied().unwrap_or(0);
        let (mut homes, mut skipped) = (Vec::new(), Vec::new());
        let progress = Progress::new("scoring", self.scenes.len());
        for ((map, grounding), source) in self.scenes.iter().zip(sources) {
            for group in self.activities.chunks(at_once) {
                let activities: Vec<_> = group.iter().map(|own| (own.drawn_by.clone(), &own.activity)).collect();
                match Home::new(map, grounding, &activities, source, binding, options) {
                    Ok(mut home) => {
                        home.program = group.iter().map(|own| own.name.as_str()).collect::<Vec<_>>().join(" + ");
                        let (program, steps) = (&home.program, home.cost().steps());
                        if self.folders && steps < room_time_s * map.rooms().len() {
                            skipped.push(format!(
                                "{program} in {}: its {steps} s leave no time to do every room for {room_time_s} s",
                                map.name()
                            ));
                        } else {
                            homes.push(home);
                        }
                    }
                    // A scene may lack all objects of an activity without effect on the others.
                    Err(StudyError::Timeline(error @ TimelineError::Empty { .. })) => skipped.push(error.to_string()),
                    Err(StudyError::Timeline(error)) if self.folders => skipped.push(error.to_string()),
                    Err(error) => return Err(error.into()),
                }
            }
            progress.step();
        }
        drop(progress);
        report_faults(&skipped);
        let mut lacking: Vec<&str> = homes.iter().flat_map(Home::skipped).collect();
        lacking.sort_unstable();
        lacking.dedup();
        if !lacking.is_empty() {
            roomcast_cli::tell(format_args!(
                "roomcast: left out {} of action because a scene lacks the object, such as {}",
                count(lacking.len(), "kind"),
                lacking.iter().take(5).copied().collect::<Vec<_>>().join(", ")
            ));
        }
        if homes.is_empty() {
            let text = "no activity fits any of the scenes: give others, or a shorter --room-time";
            return Err(Failure::input(text));
        }
        Ok(homes)
    }

    fn sources(&self, model: &ModelArgs) -> Result<Vec<ScoreSource<LlamaModel>>, Failure> {
        self.scenes.iter().map(|(_, grounding)| model.source(grounding)).collect()
    }

    fn run(&self, homes: &[Home<'_>], deciders: &[Decider]) -> Result<Vec<study::Cell>, Failure> {
        let progress = Progress::new("cells", homes.len() * self.room_times_s.len() * deciders.len());
        Ok(study::run(homes, &self.room_times_s, deciders, &self.options, || progress.step())?)
    }

    /// A decider's figures over all cells.
    fn pooled(&self, homes: &[Home<'_>], decider: Decider) -> Result<Figures, Failure> {
        Ok(study::figures(&self.run(homes, &[decider])?.iter().collect::<Vec<_>>(), None))
    }

    /// Notes for reports about the computation; `bindings` are its binding sequences.
    fn notes(&self, sources: &[ScoreSource<LlamaModel>], homes: &[Home<'_>], bindings: &str) -> Vec<String> {
        let rooms = homes.iter().map(|home| home.cost().rooms()).max().unwrap_or(0);
        let bound = match rooms > study::ROOMS_PROGRAMMED_MAX {
            true => format!(" of up to {} rooms", study::ROOMS_PROGRAMMED_MAX),
            false => String::new(),
        };
        let checked = match cfg!(feature = "optimum") {
            true => format!(", equal to HiGHS's of the mixed-integer program in every cell{bound}"),
            false => String::new(),
        };
        let closed_s =
            homes.iter().map(|home| home.cost().naive_disturbance()).sum::<f64>() / homes.len().max(1) as f64;
        vec![format!(
            "{}, T_r {:?} s, {}. In closed form the naive policy disturbs {closed_s:.1} s. The clairvoyant bound is the \
             optimum by dynamic programming{checked}.",
            self.origin(sources, homes, bindings),
            self.room_times_s,
            count(self.options.restarts as usize, "restart"),
        )]
    }

    fn origin(&self, sources: &[ScoreSource<LlamaModel>], homes: &[Home<'_>], bindings: &str) -> String {
        let computed: usize = sources.iter().map(ScoreSource::computed).sum();
        let model = sources.first().map(|source| source.model().name.clone()).unwrap_or_default();
        let horizon_s = homes.iter().map(|home| home.cost().steps()).sum::<usize>() as f64 / homes.len().max(1) as f64;
        let scores = sources.first().map(|source| source.correction().to_string()).unwrap_or_default();
        format!(
            "Model {model}, scored by {scores}, {bindings}, {} of home and activity, T {horizon_s:.0} s on average, seed {}; {computed} scores computed, the \
             others from the cache",
            count(homes.len(), "pair"),
            self.options.seed,
        )
    }

    /// The paper's rows, if the whole set-up is the paper's: the person also takes any thing of a kind, and the window is the whole
    /// narration.
    fn paper<'p>(&self, rows: &'p [PaperRow]) -> &'p [PaperRow] {
        let whole = |own: &Named| matches!(&own.activity, Activity::Program(program) if program.steps.len() <= self.options.history.observations);
        let same = self.options.items == ItemChoice::Uniform && self.activities.iter().all(whole);
        if same { self.of_the_paper(rows) } else { &[] }
    }

    /// The paper's rows, if the set-up is the paper's except for the parts that [`setups`] varies.
    fn of_the_paper<'p>(&self, rows: &'p [PaperRow]) -> &'p [PaperRow] {
        if self.is_of_the_paper { rows } else { &[] }
    }

    fn binding(&self) -> String {
        format!("binding \"{}\"", self.args.binding.text().trim_end())
    }

    fn finish(&self, report: &Report, json: serde_json::Value) -> CommandResult {
        if let Some(folder) = &self.args.out {
            report.write(folder)?;
        }
        if self.args.json {
            return print_json(&json);
        }
        if self.args.markdown {
            let shown = report.tables.iter().filter(|part| !CELLS.contains(&part.name.as_str()));
            let tables = shown.map(|part| format!("{}:\n\n{}\n\n", part.title, part.markdown()));
            return print(&format!("{}{}\n", tables.collect::<String>(), report.notes.join("\n")));
        }
        print(&report.text())
    }
}

const CELLS: [&str; 3] = ["table2", "pareto-cells", "domination"];

const APARTMENTS: [&str; 3] = ["apartment-e0", "apartment-e1", "apartment-e2"];
const PROGRAMS: [&str; 3] = ["p0-breakfast-and-television", "p1-laundry-and-to-bed", "p2-long-evening"];
const POLICIES: [Decider; 6] = [
    Decider::Policy(PolicyName::Naive),
    Decider::Policy(PolicyName::InformedAvoidance),
    Decider::Policy(PolicyName::GreedyAvoidance),
    Decider::Policy(PolicyName::UncoveredFirst),
    Decider::Policy(PolicyName::CoverageAware),
    Decider::Clairvoyant,
];

pub(super) fn run_table2(args: &Table2Args) -> CommandResult {
    let Table2Args { study, robot, .. } = args;
    let setup = study.setup(Some(robot), &[25, 50, 100], &APARTMENTS, &PROGRAMS)?;
    let mut sources = setup.sources(&study.model)?;
    let homes = setup.homes(&mut sources, &study.binding, &setup.options)?;
    let cells = setup.run(&homes, &POLICIES)?;
    let table = tables::table2(&cells, setup.paper(&PAPER_TABLE2));
    let mut notes = setup.notes(&sources, &homes, &setup.binding());
    notes.insert(0, tables::headline(&table.overall));
    notes.extend(setup.is_of_the_paper.then(|| DIFFERENCES.to_owned()));
    let mut pictures = match study.out {
        Some(_) => setup.pictures(&mut sources)?,
        None => Vec::new(),
    };
    let mut rows = Vec::new();
    if args.setups {
        drop((homes, sources));
        let models = std::iter::once(study.model.model.clone()).chain(args.also_model.iter().cloned().map(Some));
        let (found, curves) = setup.setups(&models.collect::<Vec<_>>())?;
        rows = found;
        pictures.extend(curves);
    }
    let mut report = tables::table2_report(&table, &cells, notes, pictures);
    if args.setups {
        report.tables.insert(1, setups::table(&rows, setup.of_the_paper(&PAPER_TABLE2)));
    }
    let mut json = json!(table);
    if let Some(object) = json.as_object_mut().filter(|_| args.setups) {
        object.insert("setups".into(), json!(rows));
    }
    setup.finish(&report, json)
}

/// Longest acts of the set-ups, in seconds.
const LONGEST_ACTS_S: [f64; 3] = [10.0, 20.0, 60.0];
/// Windows of the set-ups: the length of the model's training, and the whole narration.
const WINDOWS: [Option<usize>; 2] = [Some(16), None];
/// Longer than any narration.
const WHOLE: usize = 1000;
/// Weights of coverage-aware avoidance for its curve, in seconds.
const WEIGHTS_S: [f64; 12] = [0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0, 200.0, 1000.0];

fn refuse_binding(args: &StudyArgs, instead: &str) -> CommandResult {
    if args.binding == BindingSequence::default() {
        return Ok(());
    }
    Err(Failure::usage(format!("--binding has no effect here: {instead}")))
}

pub(super) fn run_table1(args: &Table1Args) -> CommandResult {
    refuse_binding(&args.study, "table1 scores with P0 to P5")?;
    let setup = args.study.setup(Some(&args.robot), &[25, 50], &APARTMENTS[..1], &PROGRAMS[2..])?;
    let mut sources = setup.sources(&args.study.model)?;
    let mut rows: Vec<Figures> = Vec::new();
    let mut notes = Vec::new();
    for name in ["p0", "p1", "p2", "p3", "p4", "p5"] {
        let Some(binding) = BindingSequence::built_in(name) else { continue };
        let homes = setup.homes(&mut sources, &binding, &setup.options)?;
        if notes.is_empty() {
            notes = setup.notes(&sources, &homes, "bindings P0 to P5");
            let figures = setup.pooled(&homes, Decider::Policy(PolicyName::Naive))?;
            rows.push(Figures { policy: "random".into(), ..figures });
        }
        rows.push(Figures { policy: name.into(), ..setup.pooled(&homes, Decider::Policy(args.policy))? });
    }
    notes.push(format!(
        "Rooms by {}, scored with each of the paper's prompts; random is the naive policy.",
        args.policy
    ));
    notes.extend(setup.is_of_the_paper.then(|| DIFFERENCES.to_owned()));
    // The paper's Table I uses informed avoidance.
    let paper = if args.policy == PolicyName::InformedAvoidance { setup.paper(&PAPER_TABLE1) } else { &[] };
    let report = Report {
        title: "Disturbance by prompt (the paper's Table I)".into(),
        notes,
        tables: vec![tables::table_of("table1", "By prompt, over T_r", &rows, paper)],
        figures: Vec::new(),
    };
    setup.finish(&report, json!({ "rows": rows, "paper": paper }))
}

pub(super) fn run_ablation(args: &AblationArgs) -> CommandResult {
    refuse_binding(&args.study, "give --prompt")?;
    if args.study.model.history.is_some() {
        return Err(Failure::usage("--history has no effect here: give --window"));
    }
    let setup = args.study.setup(Some(&args.robot), &[25, 50, 100], &APARTMENTS, &PROGRAMS)?;
    let prompts: Vec<BindingSequence> =
        if args.prompt.is_empty() { BindingSequence::all_built_in().collect() } else { args.prompt.clone() };
    let models = std::iter::once(args.study.model.model.clone()).chain(args.also_model.iter().cloned().map(Some));
    let deciders = [Decider::Policy(PolicyName::InformedAvoidance), Decider::Policy(PolicyName::CoverageAware)];
    let columns = "model, prompt, scores, window, policy, D_T mean (s), D_T std (s), t_c mean (s), F, regret (s)";
    let mut table = Table::new("ablation", "Models, prompts, ways of scoring and windows", columns.split(", "));
    let (mut rows, mut notes) = (Vec::new(), Vec::new());
    for model in models {
        let given: CorrectionChoice = args.study.model.correction.into();
        let mut corrected = true;
        let tokenisations = [Tokenisation::Joint, Tokenisation::Paper];
        let as_given = tokenisations.map(|tokenisation| (tokenisation, given, false));
        let plain = tokenisations.map(|tokenisation| (tokenisation, CorrectionChoice::EQUATION_1, true));
        for (tokenisation, correction, again) in as_given.into_iter().chain(plain) {
            if again && !corrected {
                // The first two rows were plain Equation 1 already.
                break;
            }
            let model_args = ModelArgs {
                model: model.clone(),
                tokenisation,
                correction: correction.into(),
                ..args.study.model.clone()
            };
            let mut sources = setup.sources(&model_args)?;
            let Some(source) = sources.first() else { continue };
            let (name, correction) = (source.model().name.clone(), source.correction());
            corrected &= correction != Correction::default();
            let way = format!("{tokenisation:?}").to_lowercase();
            let way = if correction == Correction::default() { way } else { format!("{way}, corrected") };
            for binding in &prompts {
                for window in &args.window {
                    let options = Options { history: HistoryLimits::exact(*window), ..setup.options.clone() };
                    let homes = setup.homes(&mut sources, binding, &options)?;
                    if notes.is_empty() {
                        notes = setup.notes(&sources, &homes, "bindings, windows and other models as in the table");
                    }
                    for decider in deciders {
                        let figures = setup.pooled(&homes, decider)?;
                        table.rows.push(vec![
                            name.clone(),
                            binding.name().to_owned(),
                            way.clone(),
                            window.to_string(),
                            figures.policy.clone(),
                            format!("{:.1}", figures.disturbance_mean),
                            format!("{:.1}", figures.disturbance_std),
                            figures.coverage_time_mean.map_or_else(|| "-".into(), |t| format!("{t:.1}")),
                            format!("{:.1} %", 100.0 * figures.failure_rate),
                            figures.regret_s.map_or_else(|| "-".into(), |r| format!("{r:.1}")),
                        ]);
                        rows.push(json!({
                            "model": name, "prompt": binding.name(), "tokenisation": tokenisation, "correction": correction, "window": window, "figures": figures,
                        }));
                    }
                    if !binding.uses_narration() {
                        break;
                    }
                }
            }
        }
    }
    let report = Report { title: "What the scores depend on".into(), notes, tables: vec![table], figures: Vec::new() };
    setup.finish(&report, json!({ "rows": rows }))
}

pub(super) fn run_pareto(args: &ParetoArgs) -> CommandResult {
    let setup = args.study.setup(Some(&args.robot), &[25, 50, 100], &APARTMENTS, &PROGRAMS)?;
    let mut sources = setup.sources(&args.study.model)?;
    let homes = setup.homes(&mut sources, &args.study.binding, &setup.options)?;
    let mut deciders = vec![
        Decider::Policy(PolicyName::Naive),
        Decider::Policy(PolicyName::InformedAvoidance),
        Decider::Policy(PolicyName::GreedyAvoidance),
        Decider::Policy(PolicyName::UncoveredFirst),
    ];
    deciders.extend(distinct(args.weight.iter().copied()).into_iter().map(Decider::CoverageAware));
    deciders.push(Decider::Clairvoyant);
    let cells = setup.run(&homes, &deciders)?;
    let table = tables::table2(&cells, setup.paper(&PAPER_TABLE2));
    let domination = tables::domination(&cells);
    let count = |verdict: &str| domination.iter().filter(|row| row.verdict == verdict).count();
    let mut notes = setup.notes(&sources, &homes, &setup.binding());
    notes.insert(
        0,
        format!(
            "Of {} points of the naive policy and of informed avoidance, one per cell, coverage-aware avoidance dominates {} with one \
             weight and {} more with two weights mixed; in {} the clairvoyant bound shows that nothing could; {} are not dominated. Its default weight is \
             the greatest of {WEIGHT_DEFAULT_S} s, {WEIGHT_DEFAULT_STAY} T_r, and {WEIGHT_DEFAULT_SLOTS} of the seconds of the next stays in \
             which somebody is expected to be about.",
            domination.len(),
            count("dominated"),
            count("dominated by mixing weights"),
            count("nothing could"),
            count("not dominated"),
        ),
    );
    let report = Report {
        title: "Disturbance against coverage".into(),
        notes,
        tables: vec![
            tables::table_of("pareto", "Over all scenes, programs and T_r", &table.overall, &table.paper),
            tables::domination_table(&domination),
            tables::table_of("pareto-cells", "By scene, program and T_r", &table.rows, &table.paper),
        ],
        figures: vec![("pareto".to_owned(), tables::front_chart(&cells).svg())],
    };
    setup.finish(&report, json!({ "rows": table.rows, "overall": table.overall, "domination": domination }))
}

pub(super) fn run_horizon(args: &StudyArgs) -> CommandResult {
    let setup = args.setup(None, &[], &APARTMENTS, &PROGRAMS)?;
    let mut sources = setup.sources(&args.model)?;
    let homes = setup.homes(&mut sources, &args.binding, &setup.options)?;
    let rows = study::horizons(&homes, setup.options.forecast, &[1, 5, 10, 20, 30, 45, 60, 90, 120, 180, 240, 300]);
    let (table, figures) = tables::horizon_report(&rows);
    let report = Report {
        title: "Where the person will be".into(),
        notes: vec![format!("{}.", setup.origin(&sources, &homes, &setup.binding()))],
        tables: vec![table],
        figures,
    };
    setup.finish(&report, json!({ "rows": rows }))
}

impl Setup<'_> {
    /// Every set-up that the paper leaves open, for every model.
    fn setups(&self, models: &[Option<PathBuf>]) -> Result<(Vec<SetupRow>, Pictures), Failure> {
        let deciders: Vec<Decider> = POLICIES
            .into_iter()
            .filter(|decider| *decider != Decider::Clairvoyant)
            .chain(WEIGHTS_S.map(Decider::CoverageAware))
            .collect();
        let (mut rows, mut curves) = (Vec::new(), Vec::new());
        for items in super::BINDINGS {
            for longest_act_s in LONGEST_ACTS_S {
                for window in WINDOWS {
                    let options = Options {
                        items,
                        history: HistoryLimits::exact(window.unwrap_or(WHOLE)),
                        person: PersonOptions { action_s_max: longest_act_s, ..self.options.person },
                        ..self.options.clone()
                    };
                    let mut cells = Vec::with_capacity(models.len());
                    for model in models {
                        let mut sources =
                            self.sources(&ModelArgs { model: model.clone(), ..self.args.model.clone() })?;
                        let homes = self.homes(&mut sources, &self.args.binding, &options)?;
                        cells.push(self.run(&homes, &deciders)?);
                    }
                    let setup = setups::Setup { items: items.into(), longest_act_s, window };
                    rows.extend(setups::rows(setup, &cells, self.options.seed));
                    curves.extend(cells.first().map(|cells| setups::curves(setup, cells)));
                }
            }
        }
        Ok((rows, curves))
    }

    /// The paper's Figure 3: each scene with the heat of its scores, half-way through the first program.
    fn pictures(&self, sources: &mut [ScoreSource<LlamaModel>]) -> Result<Pictures, Failure> {
        let Some(Named { activity: Activity::Program(program), .. }) = self.activities.first() else {
            return Ok(Vec::new());
        };
        let half = &program.steps[..program.steps.len().div_ceil(2)];
        let sentences: Vec<Sentence> = super::prediction::sentences(half)?;
        let mut pictures = Vec::new();
        for ((map, grounding), source) in self.scenes.iter().zip(sources) {
            let rows = source.score_steps(&sentences, self.options.history, &self.args.binding)?;
            let Some(last) = rows.last() else { continue };
            let mut grounded = GroundedScores::default();
            grounding.ground(last, &mut grounded)?;
            let caption = sentences.last().map_or("", Sentence::as_str);
            let items: Vec<f64> = grounding.item_log_score_nats(last).collect();
            let heat = drawing::Heat::new(&grounded.partition_probability, &items, caption);
            let svg = drawing::svg(map, grounding, Some(&heat)).map_err(Failure::failed)?;
            pictures.push((format!("grounding-{}", map.name()), svg));
        }
        Ok(pictures)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{Args as _, FromArgMatches as _};
    use roomcast_cli::exit_code;
    use roomcast_core::narration::Program;
    use roomcast_services::embedded;

    fn named(paths: &[&str]) -> Vec<Named> {
        let activity = Activity::Program(Program::parse(embedded::PROGRAMS[0].text).unwrap());
        let of = |path: &&str| {
            let name = Path::new(path).file_stem().unwrap().to_string_lossy().into_owned();
            Named { path: path.into(), name: name.clone(), drawn_by: name, activity: activity.clone() }
        };
        paths.iter().map(of).collect()
    }

    fn names(paths: &[&str]) -> Result<Vec<String>, Failure> {
        let mut activities = named(paths);
        tell_apart(&mut activities)?;
        Ok(activities.into_iter().map(|own| own.name).collect())
    }

    /// Results name activities: two with the same name would be merged.
    #[test]
    fn no_two_activities_are_called_the_same() {
        let days = ["d/HouseholdA/test/000.txt", "d/HouseholdA/test/001.txt", "d/HouseholdB/test/000.txt"];
        let told = names(&days).unwrap();
        assert_eq!(told, ["HouseholdA/test/000.txt", "001", "HouseholdB/test/000.txt"]);
        assert_eq!(names(&["a/x.txt", "b/y.txt"]).unwrap(), ["x", "y"]);
        assert_eq!(names(&["x", "x.txt", "x.day"]).unwrap(), ["x", "x.txt", "x.day"]);
        let paths: Vec<String> = ["", "a/", "b/", "a/b/", "b/a/", "b/b/", "/a/b/"]
            .iter()
            .flat_map(|folder| ["x.txt", "x.day", "x", "y.txt"].map(|file| format!("{folder}{file}")))
            .collect();
        let all: Vec<&str> = paths.iter().map(String::as_str).collect();
        for from in 0..all.len() {
            for to in from + 1..=all.len() {
                let told = names(&all[from..to]).unwrap();
                let different: std::collections::HashSet<_> = told.iter().collect();
                assert_eq!(different.len(), to - from, "{told:?}");
            }
        }
        let twice = names(&["a/x.txt", "b/y.txt", "a/x.txt"]).unwrap_err();
        assert_eq!((twice.code, twice.to_string().contains("a/x.txt twice")), (exit_code::USAGE, true), "{twice}");
    }

    fn parsed(line: &str) -> Table2Args {
        let command = Table2Args::augment_args(clap::Command::new("table2"));
        let matches = command.try_get_matches_from(["table2"].into_iter().chain(line.split_whitespace())).unwrap();
        Table2Args::from_arg_matches(&matches).unwrap()
    }

    /// The number of the paper's rows next to the results of this command line.
    fn rows_of_the_paper(line: &str) -> usize {
        let args = parsed(line);
        let setup = args.study.setup(Some(&args.robot), &[25, 50, 100], &APARTMENTS, &PROGRAMS).unwrap();
        setup.paper(&PAPER_TABLE2).len()
    }

    #[test]
    fn the_papers_figures_stand_beside_its_set_up_alone() {
        const PAPER: &str = "--items uniform --history 1000";
        assert_eq!(rows_of_the_paper(PAPER), PAPER_TABLE2.len());
        for same in ["--restarts 7", "--seed 3", "--room-time 25 --room-time 50 --room-time 100", "--longest-act 60"] {
            assert_eq!(rows_of_the_paper(&format!("{PAPER} {same}")), PAPER_TABLE2.len(), "{same}");
        }
        for other in [
            "--scene ward --program w0-medication-round",
            "--scene apartment-e0",
            "--program p2-long-evening",
            "--room-time 25",
            "--disturbance in-sight",
            "--pace 10",
            "--together",
        ] {
            assert_eq!(rows_of_the_paper(&format!("{PAPER} {other}")), 0, "{other}");
        }
        assert_eq!(rows_of_the_paper("--items uniform"), 0, "its window is the whole narration");
    }

    #[test]
    fn what_is_given_twice_counts_once() {
        let args = parsed("--room-time 50 --room-time 25 --room-time 50");
        let setup = args.study.setup(Some(&args.robot), &[], &APARTMENTS[..1], &PROGRAMS[..1]).unwrap();
        assert_eq!(setup.room_times_s, [50, 25]);
        assert_eq!(distinct([5.0, 2.0, 5.0]), [5.0, 2.0]);
    }
}
