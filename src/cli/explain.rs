//! `roomcast explain`: the chain behind the scores of one moment, as text, JSON and plan.

use std::path::PathBuf;

use super::{CommandResult, Failure, scene, score};
use crate::exit_code;
use crate::explanation::{self, Evidence, TokenReason};
use crate::semantic_map::drawing::{self, Heat};

/// Arguments of `roomcast explain`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    score: score::Args,
    /// Also draw the plan with the heat of every room and item; the ending, `.svg` or `.png`, decides the format.
    #[arg(long, value_name = "FILE")]
    plan: Option<PathBuf>,
}

/// Scores once and explains the result.
///
/// # Errors
/// When scene, program, text or model cannot be used, or the plan cannot be written.
pub fn run(args: &Args) -> CommandResult {
    let (pipeline, map) = score::scored(&args.score)?;
    let (scores, grounding) = (pipeline.scores(), pipeline.grounding());
    let narration: Vec<String> = pipeline
        .histories()
        .get(0)
        .map_or_else(Vec::new, |history| history.sentences().map(|sentence| sentence.to_owned()).collect());
    let evidence = Evidence {
        map: &map,
        grounding,
        label_log_prob_nats: &scores.label_log_prob_nats,
        scores: &scores.grounded,
        narration: &narration,
        binding: pipeline.options().binding.text(),
    };
    let explanation = explanation::explain(&evidence, args.score.top(), |label| {
        let pieces = pipeline.prepared().tokens()[label].iter().map(|&token| pipeline.token_text(token));
        let log_probs_nats = pipeline.token_log_prob_nats(label).unwrap_or_default();
        pieces.zip(log_probs_nats).map(|(piece, log_prob_nats)| TokenReason { piece, log_prob_nats }).collect()
    });
    if let Some(path) = &args.plan {
        let caption = narration.last().map_or("", String::as_str);
        let heat = Heat::new(&scores.grounded.partition_probability, &scores.grounded.item_log_score_nats, caption);
        let svg = drawing::svg(&map, grounding, Some(&heat)).map_err(|e| Failure::new(exit_code::FAILURE, e))?;
        scene::write_drawing(path, svg, 2.0)?;
    }
    if args.score.json() { super::print_json(&explanation) } else { scene::print(&explanation.to_string()) }
}
