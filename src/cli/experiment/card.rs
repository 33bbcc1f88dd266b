//! `roomcast experiment card`: every table of the model card, in Markdown, each below the command that prints it alone.

use std::path::{Path, PathBuf};

use clap::{Args as _, FromArgMatches as _};

use super::Args;
use crate::cli::{CommandResult, Failure, print};
use crate::exit_code;

/// Arguments of `roomcast experiment card`.
#[derive(Debug, clap::Args)]
pub(super) struct CardArgs {
    /// The folder with virtualhome/ that the model was trained from.
    #[arg(long, value_name = "DIR")]
    shared: PathBuf,
    /// The project's folder, for models/manifest.json and training/unseen/.
    #[arg(long, value_name = "DIR", default_value = ".")]
    project: PathBuf,
    /// The routines as programs, which `training/routines.py --out` writes: the baselines of the development places count them beside VirtualHome's.
    #[arg(long, value_name = "DIR")]
    routines: Option<PathBuf>,
    /// Only tables whose title has this in it.
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
}

const GRAPHS: [&str; 3] = ["TestScene1", "TestScene2", "TestScene5"];
/// Scenes that are no homes, with their programs.
const WORKPLACES: [(&str, [&str; 3]); 2] = [
    ("ward", ["w0-medication-round", "w1-cleaning-and-fresh-beds", "w2-patients-morning"]),
    ("warehouse", ["g0-receiving-a-delivery", "g1-picking-and-packing", "g2-end-of-shift"]),
];
/// Of each household of HOMER+.
const DAYS: [&str; 3] = ["000", "001", "002"];
const PLACES: [&str; 4] = ["house", "ward", "warehouse", "office"];

pub(super) fn run(args: &CardArgs) -> CommandResult {
    let path = |folder: &Path, below: &str| folder.join(below).display().to_string();
    let shared = |below: &str| path(&args.shared, below);
    let project = |below: &str| path(&args.project, below);
    let programs = shared("virtualhome/programs");
    let manifest = project("models/manifest.json");
    let graphs: Vec<String> = GRAPHS
        .iter()
        .flat_map(|name| ["--scene".to_owned(), shared(&format!("virtualhome/scenes/{name}_graph.json"))])
        .collect();
    let mut tables: Vec<(String, Vec<String>)> = Vec::new();
    let mut add = |title: &str, command: &[&str], more: Vec<String>| {
        tables.push((title.to_owned(), command.iter().map(|word| (*word).to_owned()).chain(more).collect()));
    };
    let held_out = || vec!["--manifest".to_owned(), manifest.clone(), "--split".to_owned(), "test".to_owned()];
    let forecast = |programs: &str| vec!["--programs".to_owned(), programs.to_owned()];
    add("Test split", &["forecast"], [forecast(&programs), held_out(), graphs.clone()].concat());
    for place in PLACES {
        let scene = vec!["--scene".to_owned(), project(&format!("training/unseen/{place}/map.json"))];
        let folder = project(&format!("training/unseen/{place}/programs"));
        let counted = args.routines.as_ref().map_or_else(Vec::new, |routines| {
            let routines = routines.display().to_string();
            ["--fit", &programs, "--fit", &routines].map(str::to_owned).to_vec()
        });
        add(&format!("Development place: {place}"), &["forecast"], [forecast(&folder), scene, counted].concat());
    }
    add("Table II, seen activities", &["table2", "--setups"], Vec::new());
    let of = |programs: &str| vec!["--program".to_owned(), programs.to_owned()];
    let unseen = [of(&programs), held_out(), graphs.clone()].concat();
    add("Table II, test split", &["table2", "--setups", "--restarts", "100"], unseen.clone());
    for (scene, programs) in WORKPLACES {
        let programs = programs.iter().flat_map(|name| of(name)).collect();
        let line = ["table2", "--restarts", "200", "--scene", scene, "--room-time", "25"];
        add(&format!("Table II, other places: {scene}"), &line, programs);
    }
    let days = ["HouseholdA", "HouseholdB"].into_iter().flat_map(|home| DAYS.map(|day| (home, day)));
    let days = days.flat_map(|(home, day)| of(&shared(&format!("homer_plus/{home}/scripts_test/{day}.txt")))).collect();
    let line = ["table2", "--restarts", "200", "--room-time", "300", "--room-time", "900"];
    add("Table II, other places: HOMER+ households", &line, days);
    add("Table I", &["table1"], Vec::new());
    let weights =
        |weights: &[&str]| weights.iter().flat_map(|weight| ["--weight".to_owned(), (*weight).to_owned()]).collect();
    for (items, longest_act) in [("uniform", "10"), ("nearest", "10"), ("uniform", "60"), ("nearest", "60")] {
        let line = ["pareto", "--restarts", "40", "--items", items, "--longest-act", longest_act];
        let title = format!("Disturbance against coverage, test split: {items}, acts up to {longest_act} s");
        add(&title, &line, [unseen.clone(), weights(&["0", "5", "10", "20", "30", "42", "60", "1000"])].concat());
    }
    if let Some(only) = &args.only {
        let titles = tables.iter().map(|(title, _)| format!("\n  {title}")).collect::<String>();
        tables.retain(|(title, _)| title.contains(only));
        if tables.is_empty() {
            return Err(Failure::new(
                exit_code::USAGE,
                format!("no table's title has {only:?} in it: there are{titles}"),
            ));
        }
    }
    for (title, command) in tables {
        print(&format!("### {title}\n\n    roomcast experiment {} --markdown\n\n", command.join(" ")))?;
        let line = ["experiment".to_owned()].into_iter().chain(command).chain(["--markdown".to_owned()]);
        let parsed = Args::augment_args(clap::Command::new("experiment")).try_get_matches_from(line);
        let parsed = parsed.and_then(|matches| Args::from_arg_matches(&matches));
        // A title and the folders that were given make no other arguments than these.
        super::run(&parsed.map_err(|error| Failure::new(exit_code::FAILURE, error))?)?;
        print("\n")?;
    }
    Ok(())
}
