//! `roomcast-lab familiarity`: the weight of scores after unknown words.

use std::path::PathBuf;

use super::{Manifest, ModelArgs, maps};
use crate::experiment::familiarity::{self, Case, Losses, Replaced};
use crate::experiment::prediction;
use roomcast_cli::{CommandResult, Failure, print};

#[derive(Debug, clap::Args)]
pub(super) struct FamiliarityArgs {
    /// A folder of activity programs (VirtualHome).
    #[arg(long, value_name = "DIR")]
    programs: PathBuf,
    /// The training manifest with the splits.
    #[arg(long, value_name = "FILE", default_value = "models/manifest.json")]
    manifest: PathBuf,
    /// Which splits: the weights are fitted on the calibration split.
    #[arg(long, value_name = "NAME", default_values_t = ["calibration".to_owned(), "test".to_owned()])]
    split: Vec<String>,
    /// A scene file, the name of a shipped scene, or a VirtualHome graph (*_graph.json); may be repeated.
    #[arg(long, value_name = "FILE", required = true)]
    scene: Vec<PathBuf>,
    /// Further texts in sets.
    #[arg(long, value_name = "FILE", default_value = "training/unfamiliar.txt")]
    texts: PathBuf,
    #[command(flatten)]
    model: ModelArgs,
}

const EDGES: [f64; 9] = [0.0, 0.2, 0.26, 0.32, 0.36, 0.4, 0.45, 0.5, f64::INFINITY];

fn row(name: &str, cases: &[Case]) -> String {
    let losses = Losses::of(cases.iter());
    let best = losses.best();
    format!(
        "{name:<34}{:>7}{:>10.1}{:>10.4}{:>10.4}{:>10.4}{:>8.1}{:>10.4}\n",
        losses.cases,
        100.0 * losses.flagged,
        losses.by_weight_nats[0],
        losses.by_weight_nats[familiarity::WEIGHTS - 1],
        losses.product_nats,
        best as f64 / 10.0,
        losses.by_weight_nats[best]
    )
}

pub(super) fn run(args: &FamiliarityArgs) -> CommandResult {
    let programs = prediction::load_programs(&args.programs)?;
    let manifest = Manifest::read(&args.manifest)?;
    let sets = std::fs::read_to_string(&args.texts).map_err(|error| {
        Failure::input(format!("{}: {error}; give a file of sentences with --texts", args.texts.display()))
    })?;
    let head = |first: &str| {
        format!(
            "{first:<34}{:>7}{:>10}{:>10}{:>10}{:>10}{:>8}{:>10}\n",
            "cases", "flagged %", "weight 0", "weight 1", "product", "best", "its nats"
        )
    };
    let maps = maps(&args.scene)?;
    for split in &args.split {
        let programs = manifest.split(programs.clone(), split)?;
        let (mut text, mut all) = (head(&format!("Next room, nats: {split} split")), Vec::new());
        for replaced in [Replaced::Newest, Replaced::Nothing, Replaced::Things, Replaced::Everything] {
            let mut own = Vec::new();
            for (map, grounding) in &maps {
                let mut source = args.model.source(grounding)?;
                own.extend(familiarity::losses(
                    &programs,
                    (map, grounding),
                    &mut source,
                    args.model.limits(),
                    replaced,
                )?);
            }
            text += &row(&format!("replaced: {replaced:?}").to_lowercase(), &own);
            // The bins are by the whole window.
            all.extend(own.into_iter().filter(|_| replaced != Replaced::Newest));
        }
        for edges in EDGES.windows(2) {
            let is_in = |case: &&Case| (edges[0]..edges[1]).contains(&case.tokens_per_byte);
            let cases: Vec<Case> = all.iter().filter(is_in).copied().collect();
            if !cases.is_empty() {
                text += &row(&format!("tokens per byte {:.2} to {:.2}", edges[0], edges[1]), &cases);
            }
        }
        print(&format!("{text}\n"))?;
    }
    for (map, grounding) in &maps {
        let mut source = args.model.source(grounding)?;
        let mut text = format!(
            "{:<34}{:>7}{:>10}{:>10}{:>10}{:>10}\n",
            format!("Each sentence alone: {}", map.name()),
            "texts",
            "flagged %",
            "tok/byte",
            "likeliest",
            "forecast"
        );
        for (name, lines) in familiarity::sets(&sets) {
            let found = familiarity::texts(&lines, grounding, &mut source)?;
            let mean =
                |value: &dyn Fn(&familiarity::Text) -> f64| found.iter().map(value).sum::<f64>() / found.len() as f64;
            text += &format!(
                "{name:<34}{:>7}{:>10.1}{:>10.3}{:>10.3}{:>10.3}\n",
                found.len(),
                100.0 * mean(&|own| f64::from(u8::from(own.trust < 1.0))),
                mean(&|own| own.tokens_per_byte),
                mean(&|own| own.top),
                mean(&|own| own.forecast_top)
            );
        }
        print(&format!("{text}\n"))?;
    }
    Ok(())
}
