//! `roomcast-lab card`: every table of the model card, in Markdown, each below the command that prints it alone.

use std::path::PathBuf;

use clap::Parser as _;

use super::{Args, BINDINGS};
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

/// A table's title, and the arguments of `roomcast-lab` that print it.
type Table = (String, Vec<String>);

/// The words of a command. A word that begins with the name of one of the folders, in capitals, is a path in it.
fn words(args: &CardArgs, command: &str) -> Vec<String> {
    let path = |word: &str| {
        let (name, below) = word.split_once('/').unwrap_or((word, ""));
        let folder = match name {
            "SHARED" => Some(&args.shared),
            "PROJECT" => Some(&args.project),
            "ROUTINES" => args.routines.as_ref(),
            "FOLDS" => args.folds.as_ref(),
            "OUT" => args.out.as_ref(),
            _ => None,
        };
        match folder {
            None => word.to_owned(),
            Some(folder) if below.is_empty() => folder.display().to_string(),
            Some(folder) => folder.join(below).display().to_string(),
        }
    };
    command.split_whitespace().map(path).collect()
}

fn tables(args: &CardArgs) -> Vec<Table> {
    let mut tables: Vec<Table> = Vec::new();
    let mut add = |title: String, command: String| tables.push((title, words(args, &command)));
    let each =
        |option: &str, values: &[&str]| values.iter().map(|value| format!(" --{option} {value}")).collect::<String>();
    let graphs = |numbers: &[u8]| -> String {
        numbers.iter().map(|n| format!(" --scene SHARED/virtualhome/scenes/TestScene{n}_graph.json")).collect()
    };
    // The planner was tried with the calibration split on the first and the last.
    let (scenes, calibration_scenes) = (graphs(&[1, 2, 5]), graphs(&[1, 5]));
    let programs = "SHARED/virtualhome/programs";
    let of_split = |split: &str| format!("{programs} --manifest PROJECT/models/manifest.json --split {split}");
    let both = BINDINGS.map(<&str>::from);
    let places = ["house", "ward", "warehouse", "office"];
    let of_place = |place: &str| {
        format!("--programs PROJECT/training/unseen/{place}/programs --scene PROJECT/training/unseen/{place}/map.json")
    };

    for split in ["test", "calibration"] {
        let command = format!("forecast --programs {}{scenes}", of_split(split));
        add(format!("Next object and room, {split} split"), command);
    }
    let counted = args.routines.as_ref().map_or_else(String::new, |_| each("fit", &[programs, "ROUTINES"]));
    for place in places {
        add(format!("Development place: {place}"), format!("forecast {}{counted}", of_place(place)));
    }
    for (continuation, prior) in [("free", "0"), ("free", "0.45"), ("labels", "0")] {
        for place in places {
            let command = format!("forecast --continuation {continuation} --prior {prior} {}", of_place(place));
            add(format!("Corrections: continuation {continuation}, prior {prior}: {place}"), command);
        }
    }
    if args.folds.is_some() {
        add("Folds".to_owned(), format!("folds --folds FOLDS --programs {programs}{scenes}"));
    }
    for (split, scenes) in [("calibration", &calibration_scenes), ("test", &scenes)] {
        for items in both {
            for (alike, more) in [("told apart", ""), ("alike", " --any-thing 1")] {
                let command = format!("horizon --items {items}{more} --program {}{scenes}", of_split(split));
                add(format!("Like things {alike}, {split} split: {items}"), command);
            }
        }
    }
    add("Table II, seen activities".to_owned(), "table2 --setups".to_owned());
    let unseen = format!("--program {}{scenes}", of_split("test"));
    add("Table II, test split".to_owned(), format!("table2 --setups --restarts 100 {unseen}"));
    let ward = ["w0-medication-round", "w1-cleaning-and-fresh-beds", "w2-patients-morning"];
    let warehouse = ["g0-receiving-a-delivery", "g1-picking-and-packing", "g2-end-of-shift"];
    let days: Vec<String> = ["HouseholdA", "HouseholdB"]
        .iter()
        .flat_map(|home| (0..3).map(move |day| format!("SHARED/homer_plus/{home}/scripts_test/00{day}.txt")))
        .collect();
    let days: Vec<&str> = days.iter().map(String::as_str).collect();
    for items in both {
        for (place, how, programs) in [
            ("ward", " --scene ward --room-time 25", &ward[..]),
            ("warehouse", " --scene warehouse --room-time 25", &warehouse[..]),
            ("HOMER+ households", " --room-time 300 --room-time 900", &days[..]),
        ] {
            let command = format!("table2 --items {items} --restarts 200{how}{}", each("program", programs));
            add(format!("Table II, other places: {place}: {items}"), command);
        }
    }
    add("Table I".to_owned(), "table1".to_owned());
    // In the paper, a person takes any thing of a kind, and the window is the whole narration.
    add("Table I, in the paper's set-up".to_owned(), "table1 --items uniform --history 1000".to_owned());
    let tried = each("weight", &["0", "5", "10", "20", "30", "42", "60", "1000"]);
    let pareto =
        |items: &str, longest_act: &str| format!("pareto --restarts 40 --items {items} --longest-act {longest_act}");
    for items in both {
        let asked = format!("--program {}{calibration_scenes}{tried}", of_split("calibration"));
        let title = format!("Disturbance against coverage, calibration split: {items}");
        add(title, format!("{} {asked}", pareto(items, "10")));
    }
    for longest_act in ["10", "60"] {
        for items in both {
            let title = format!("Disturbance against coverage, test split: {items}, acts up to {longest_act} s");
            let curves = args.out.as_ref().map_or_else(String::new, |_| format!(" --out OUT/{items}-{longest_act}"));
            add(title, format!("{} {unseen}{tried}{curves}", pareto(items, longest_act)));
        }
    }
    tables
}

fn parsed((title, command): &Table) -> Result<Args, Failure> {
    let line = ["roomcast-lab".to_owned()].into_iter().chain(command.clone()).chain(["--markdown".to_owned()]);
    let parsed = Args::try_parse_from(line);
    // Only a title or a given folder can make these arguments wrong.
    parsed.map_err(|error| Failure::failed(format!("{title}: {error}")))
}

pub(super) fn run(args: &CardArgs) -> CommandResult {
    let mut tables = tables(args);
    if let Some(only) = &args.only {
        let titles = tables.iter().map(|(title, _)| format!("\n  {title}")).collect::<String>();
        tables.retain(|(title, _)| title.contains(only));
        if tables.is_empty() {
            return Err(Failure::usage(format!("no table's title has {only:?} in it: there are{titles}")));
        }
    }
    // Parse all commands first: a whole run takes an hour.
    let commands = tables.iter().map(parsed).collect::<Result<Vec<_>, _>>()?;
    for ((title, command), parsed) in tables.iter().zip(&commands) {
        print(&format!("### {title}\n\n    roomcast-lab {} --markdown\n\n", command.join(" ")))?;
        parsed.experiment.run()?;
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
