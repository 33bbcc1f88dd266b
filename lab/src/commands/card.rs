//! `roomcast-lab card`: every table of the model card, in Markdown, each below the command that prints it alone.

use std::path::{Path, PathBuf};

use clap::Parser as _;

use super::{Args, BINDINGS};
use roomcast_cli::exit_code;
use roomcast_cli::{CommandResult, Failure, print};

#[derive(Debug, clap::Args)]
pub(super) struct CardArgs {
    /// The folder with virtualhome/ that the model was trained from.
    #[arg(long, value_name = "DIR")]
    shared: PathBuf,
    /// The project's folder, for models/manifest.json and training/unseen/.
    #[arg(long, value_name = "DIR", default_value = ".")]
    project: PathBuf,
    /// The routines as programs, from `training/routines.py --out`: the baselines of the development places count them together with
    /// VirtualHome's.
    #[arg(long, value_name = "DIR")]
    routines: Option<PathBuf>,
    /// The output of `training/run.py --folds`, for the table of folds, which is left out without it.
    #[arg(long, value_name = "DIR")]
    folds: Option<PathBuf>,
    /// Draw the curves of disturbance against coverage into folders below this one.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Only tables with this text in their title.
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
}

const GRAPHS: [&str; 3] = ["TestScene1", "TestScene2", "TestScene5"];
/// The graphs on which the planner was tried with the calibration split.
const CALIBRATION_GRAPHS: [&str; 2] = ["TestScene1", "TestScene5"];
/// Scenes other than homes, with their programs.
const WORKPLACES: [(&str, [&str; 3]); 2] = [
    ("ward", ["w0-medication-round", "w1-cleaning-and-fresh-beds", "w2-patients-morning"]),
    ("warehouse", ["g0-receiving-a-delivery", "g1-picking-and-packing", "g2-end-of-shift"]),
];
const DAYS: [&str; 3] = ["000", "001", "002"];
const PLACES: [&str; 4] = ["house", "ward", "warehouse", "office"];

/// In the paper, a person takes any thing of a kind, and the window is the whole narration.
const OF_THE_PAPER: [&str; 4] = ["--items", "uniform", "--history", "1000"];

/// A table's title, and the arguments of `roomcast-lab` that print it.
type Table = (String, Vec<String>);

/// Long, because it is a list: each table of the card, in the card's order.
fn tables(args: &CardArgs) -> Vec<Table> {
    let path = |folder: &Path, below: &str| folder.join(below).display().to_string();
    let shared = |below: &str| path(&args.shared, below);
    let project = |below: &str| path(&args.project, below);
    let programs = shared("virtualhome/programs");
    let manifest = project("models/manifest.json");
    let scenes = |names: &[&str]| -> Vec<String> {
        let graph = |name: &&str| ["--scene".to_owned(), shared(&format!("virtualhome/scenes/{name}_graph.json"))];
        names.iter().flat_map(graph).collect()
    };
    let mut tables: Vec<Table> = Vec::new();
    let mut add = |title: &str, command: &[&str], more: Vec<String>| {
        tables.push((title.to_owned(), command.iter().map(|word| (*word).to_owned()).chain(more).collect()));
    };
    let of_split =
        |split: &str| vec!["--manifest".to_owned(), manifest.clone(), "--split".to_owned(), split.to_owned()];
    let forecast = |programs: &str| vec!["--programs".to_owned(), programs.to_owned()];
    let of = |programs: &str| vec!["--program".to_owned(), programs.to_owned()];
    let both: Vec<&str> = BINDINGS.map(<&str>::from).to_vec();

    for split in ["test", "calibration"] {
        let more = [forecast(&programs), of_split(split), scenes(&GRAPHS)].concat();
        add(&format!("Next object and room, {split} split"), &["forecast"], more);
    }
    let places: Vec<(&str, Vec<String>)> = PLACES
        .iter()
        .map(|place| {
            let scene = vec!["--scene".to_owned(), project(&format!("training/unseen/{place}/map.json"))];
            (*place, [forecast(&project(&format!("training/unseen/{place}/programs"))), scene].concat())
        })
        .collect();
    for (place, asked) in &places {
        let counted = args.routines.as_ref().map_or_else(Vec::new, |routines| {
            let routines = routines.display().to_string();
            ["--fit", &programs, "--fit", &routines].map(str::to_owned).to_vec()
        });
        add(&format!("Development place: {place}"), &["forecast"], [asked.clone(), counted].concat());
    }
    for (continuation, prior) in [("free", "0"), ("free", "0.45"), ("labels", "0")] {
        for (place, asked) in &places {
            let title = format!("Corrections: continuation {continuation}, prior {prior}: {place}");
            add(&title, &["forecast", "--continuation", continuation, "--prior", prior], asked.clone());
        }
    }
    if let Some(folds) = &args.folds {
        let folds = vec!["--folds".to_owned(), folds.display().to_string()];
        add("Folds", &["folds"], [folds, forecast(&programs), scenes(&GRAPHS)].concat());
    }
    for (split, graphs) in [("calibration", &CALIBRATION_GRAPHS[..]), ("test", &GRAPHS[..])] {
        for items in &both {
            for (alike, more) in [("told apart", &[][..]), ("alike", &["--any-thing", "1"][..])] {
                let line = [&["horizon", "--items", items], more].concat();
                let title = format!("Like things {alike}, {split} split: {items}");
                add(&title, &line, [of(&programs), of_split(split), scenes(graphs)].concat());
            }
        }
    }
    add("Table II, seen activities", &["table2", "--setups"], Vec::new());
    let unseen = [of(&programs), of_split("test"), scenes(&GRAPHS)].concat();
    add("Table II, test split", &["table2", "--setups", "--restarts", "100"], unseen.clone());
    for items in &both {
        for (scene, programs) in WORKPLACES {
            let programs = programs.iter().flat_map(|name| of(name)).collect();
            let line = ["table2", "--items", items, "--restarts", "200", "--scene", scene, "--room-time", "25"];
            add(&format!("Table II, other places: {scene}: {items}"), &line, programs);
        }
        let days = ["HouseholdA", "HouseholdB"].into_iter().flat_map(|home| DAYS.map(|day| (home, day)));
        let days =
            days.flat_map(|(home, day)| of(&shared(&format!("homer_plus/{home}/scripts_test/{day}.txt")))).collect();
        let line = ["table2", "--items", items, "--restarts", "200", "--room-time", "300", "--room-time", "900"];
        add(&format!("Table II, other places: HOMER+ households: {items}"), &line, days);
    }
    add("Table I", &["table1"], Vec::new());
    add("Table I, in the paper's set-up", &["table1"], OF_THE_PAPER.map(str::to_owned).to_vec());
    let weights =
        |weights: &[&str]| weights.iter().flat_map(|weight| ["--weight".to_owned(), (*weight).to_owned()]).collect();
    let tried: Vec<String> = weights(&["0", "5", "10", "20", "30", "42", "60", "1000"]);
    for items in &both {
        let line = ["pareto", "--restarts", "40", "--items", items, "--longest-act", "10"];
        let asked = [of(&programs), of_split("calibration"), scenes(&CALIBRATION_GRAPHS), tried.clone()].concat();
        add(&format!("Disturbance against coverage, calibration split: {items}"), &line, asked);
    }
    for longest_act in ["10", "60"] {
        for items in &both {
            let line = ["pareto", "--restarts", "40", "--items", items, "--longest-act", longest_act];
            let title = format!("Disturbance against coverage, test split: {items}, acts up to {longest_act} s");
            let curves = args
                .out
                .as_ref()
                .map_or_else(Vec::new, |out| vec!["--out".to_owned(), path(out, &format!("{items}-{longest_act}"))]);
            add(&title, &line, [unseen.clone(), tried.clone(), curves].concat());
        }
    }
    tables
}

fn parsed((title, command): &Table) -> Result<Args, Failure> {
    let line = ["roomcast-lab".to_owned()].into_iter().chain(command.clone()).chain(["--markdown".to_owned()]);
    let parsed = Args::try_parse_from(line);
    // Only a title or a given folder can make these arguments wrong.
    parsed.map_err(|error| Failure::new(exit_code::FAILURE, format!("{title}: {error}")))
}

pub(super) fn run(args: &CardArgs) -> CommandResult {
    let mut tables = tables(args);
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
    // Parse all commands first: a whole run takes an hour.
    let commands = tables.iter().map(parsed).collect::<Result<Vec<_>, _>>()?;
    for ((title, command), parsed) in tables.iter().zip(&commands) {
        print(&format!("### {title}\n\n    roomcast-lab {} --markdown\n\n", command.join(" ")))?;
        super::run(parsed)?;
        print("\n")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_table_is_a_command_and_has_a_title_of_its_own() {
        let args = CardArgs {
            shared: "data".into(),
            project: ".".into(),
            routines: Some("routines".into()),
            folds: Some("folds".into()),
            out: Some("curves".into()),
            only: None,
        };
        let tables = tables(&args);
        for table in &tables {
            parsed(table).unwrap();
        }
        let titles: std::collections::BTreeSet<&str> = tables.iter().map(|(title, _)| title.as_str()).collect();
        assert_eq!(titles.len(), tables.len());
        let fewer = super::tables(&CardArgs { routines: None, folds: None, out: None, ..args });
        assert_eq!(fewer.len() + 1, tables.len());
    }
}
