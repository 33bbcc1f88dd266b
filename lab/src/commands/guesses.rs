//! `roomcast-lab guesses`: how often the next sentence is among the prefetched ones.

use std::path::PathBuf;

use super::{Manifest, ModelArgs, SplitArgs, maps};
use crate::experiment::guesses::{self, Hits, Report};
use crate::experiment::{Progress, prediction};
use roomcast_cli::{CommandResult, Failure, print, print_json};
use roomcast_core::guess::Counts;
use roomcast_core::prompt::BindingSequence;

#[derive(Debug, clap::Args)]
pub(super) struct GuessesArgs {
    /// A folder of activity programs (VirtualHome) or of days (HOMER+), or one such file.
    #[arg(long, value_name = "DIR")]
    programs: PathBuf,
    /// A scene file, the name of a shipped scene, or a VirtualHome graph (*_graph.json).
    #[arg(long, value_name = "FILE", default_value = "apartment-e0")]
    scene: PathBuf,
    #[command(flatten)]
    split: SplitArgs,
    /// The binding sequence: default, p0 to p5, or a text of your own.
    #[arg(long, value_name = "TEXT", default_value = "default")]
    binding: BindingSequence,
    #[command(flatten)]
    model: ModelArgs,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

const K: [usize; 4] = [8, 16, 32, 64];

pub(super) fn run(args: &GuessesArgs) -> CommandResult {
    let programs = prediction::load_programs(&args.programs)?;
    let programs = match &args.split.manifest {
        Some(manifest) => Manifest::read(manifest)?.split(programs, &args.split.split)?,
        None => programs,
    };
    let maps = maps(std::slice::from_ref(&args.scene))?;
    let Some((map, grounding)) = maps.first() else { return Ok(()) };
    let counts = Counts::from_json(roomcast_services::embedded::FORMS);
    let counts = counts.map_err(Failure::failed)?;
    let mut source = args.model.source(grounding)?;
    let progress = Progress::new("programs", programs.len());
    let told = (programs.as_slice(), &counts);
    let report =
        guesses::run(told, (map, grounding), &mut source, (args.model.limits(), &args.binding), &K, &progress)?;
    drop(progress);
    if args.json { print_json(&report) } else { print(&text(&report)) }
}

fn text(report: &Report) -> String {
    let row = |name: &str, hits: &Hits| {
        let shares: String = hits.shares().map(|share| format!("{:>8.1}", 100.0 * share)).collect();
        format!("{name:<24}{:>8}{shares}\n", hits.steps)
    };
    let header: String = report.k.iter().map(|k| format!("{k:>8}")).collect();
    let mut text =
        format!("Percent of the next sentences among the first K guesses\n\n{:<24}{:>8}{header}\n", "", "steps");
    text += &row("training programs alone", &report.seed);
    text += &row("and learning as it goes", &report.learning);
    text += "\nby action, learning:\n";
    let mut actions: Vec<_> = report.learning_by_action.iter().collect();
    actions.sort_by_key(|(name, hits)| (std::cmp::Reverse(hits.steps), *name));
    text.extend(actions.iter().map(|(name, hits)| row(name, hits)));
    text
}
