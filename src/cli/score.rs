//! `roomcast score`: scores one narration in one scene, once.

use std::fmt::Write as _;
use std::path::PathBuf;

use serde_json::json;

use super::choice::{CorrectionArgs, choice};
use super::{CommandResult, Failure, count, model, ranges};
use crate::bar::bar;
use crate::columns::prose;
use roomcast_core::grounding::{Grounding, GroundingOptions, PartitionLevel};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::narration::{Action, Observation, Sentence};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::certified::Effort;
use roomcast_core::scorer::correction::Continuation;
use roomcast_core::scorer::{LanguageModel, Method, Tokenisation};
use roomcast_core::semantic_map::{PartitionId, SemanticMap};
use roomcast_llama::{CacheType, LlamaModel, LlamaOptions};
use roomcast_services::setup;

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The scene file, or the name of an included one; by default the studio flat.
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// The last actions, as sentences or VirtualHome actions; several stand on separate lines, or end with a full stop and a space.
    #[arg(value_name = "TEXT", conflicts_with = "program")]
    text: Option<String>,
    /// The same as TEXT.
    #[arg(long, value_name = "TEXT", conflicts_with_all = ["program", "text"])]
    narration: Option<String>,
    /// An activity program, or an included one's name; its first steps are the narration.
    #[arg(long, value_name = "FILE")]
    program: Option<PathBuf>,
    /// How many steps of the program were done; by default all.
    #[arg(long, value_name = "N", requires = "program", conflicts_with_all = ["text", "narration"], value_parser = ranges::whole(0..=usize::MAX))]
    steps: Option<usize>,
    /// The binding sequence: default, p0 to p5, or your own text.
    #[arg(long, value_name = "TEXT")]
    binding: Option<BindingSequence>,
    /// A GGUF model; by default the embedded household model.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// How labels are scored; all methods agree up to rounding.
    #[arg(long, value_parser = choice::<Method>(), default_value_t)]
    method: Method,
    /// How far the answer goes: exact, or until the ranking, the top partition, or the time is certain.
    #[arg(long, value_parser = choice::<Effort>(), default_value_t)]
    effort: Effort,
    /// The time for the answer under --effort deadline, in milliseconds, 1 to 60000; by default 5.
    #[arg(long, value_name = "MS", value_parser = ranges::deadline_ms())]
    deadline_ms: Option<u64>,
    /// How prompt and labels are cut into tokens.
    #[arg(long, value_parser = choice::<Tokenisation>(), default_value_t)]
    tokenisation: Tokenisation,
    #[command(flatten)]
    correction: CorrectionArgs,
    /// The level of a partition; by default a room.
    #[arg(long, value_parser = choice::<PartitionLevel>())]
    level: Option<PartitionLevel>,
    /// Do not score the rooms' names as labels.
    #[arg(long)]
    no_room_labels: bool,
    /// Observations in the history window, the paper's n_h, 1 to 1000.
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = ranges::observations())]
    history: usize,
    /// Threads of one decoder call, at most 256; 0 chooses all cores but one.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = ranges::threads())]
    threads: usize,
    /// How the key-value cache is stored.
    #[arg(long = "kv-cache", alias = "cache", value_parser = choice::<CacheType>(), default_value_t)]
    cache: CacheType,
    /// How many labels and items the tables show.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = ranges::whole(0..=usize::MAX))]
    pub(super) top: usize,
    /// Print everything as one JSON object.
    #[arg(long)]
    pub(super) json: bool,
}

pub fn run(args: &Args) -> CommandResult {
    let (pipeline, map) = scored(args)?;
    if args.json {
        super::print_json(&report(&pipeline, &map))
    } else {
        super::print(&tables(&pipeline, &map, args.top))
    }
}

impl Args {
    pub(super) fn grounding(&self) -> GroundingOptions {
        GroundingOptions { level: self.level.unwrap_or_default(), room_labels: !self.no_room_labels }
    }

    fn llama_options(&self) -> LlamaOptions {
        let default = LlamaOptions::default();
        LlamaOptions {
            threads: if self.threads == 0 { default.threads } else { self.threads },
            cache: self.cache,
            ..default
        }
    }

    pub(super) fn binding(&self) -> BindingSequence {
        self.binding.clone().unwrap_or_default()
    }
}

/// The pipeline after its one step, and its map.
pub(super) fn scored(args: &Args) -> Result<(Pipeline<LlamaModel>, SemanticMap), Failure> {
    let usage = |error: &str| Err(Failure::usage(error));
    if !args.method.allows(args.effort) {
        return usage("only --method trie can end early: leave out --method, or give --effort exact");
    }
    if args.deadline_ms.is_some() && args.effort != Effort::Deadline {
        return usage("--deadline-ms says nothing without --effort deadline: give both, or neither");
    }
    let map = setup::load_map(args.scene.as_deref())?;
    let grounding = Grounding::new(&map, &args.grounding())?;
    let observations = observations(args)?;
    let model = model::load(args.model.as_deref(), &args.llama_options())?;
    let options = PipelineOptions {
        binding: args.binding(),
        tokenisation: args.tokenisation,
        correction: args.correction.into(),
        method: args.method,
        effort: args.effort,
        deadline_ns: args.deadline_ms.map_or(PipelineOptions::default().deadline_ns, |ms| ms * 1_000_000),
        history: HistoryLimits::exact(args.history),
    };
    let mut pipeline = Pipeline::new(model, grounding, options).map_err(Failure::model)?;
    pipeline.step(observations).map_err(Failure::model)?;
    Ok((pipeline, map))
}

fn observations(args: &Args) -> Result<Vec<Observation>, Failure> {
    let mut sentences = Vec::new();
    if let Some(path) = &args.program {
        let program = setup::load_program(path)?;
        program.notes.iter().for_each(|note| super::tell(format_args!("roomcast: {note}")));
        let steps = args.steps.unwrap_or(program.steps.len());
        if steps > program.steps.len() {
            let (path, has) = (path.display(), program.steps.len());
            return Err(Failure::input(format!(
                "--steps {steps} is more than the program {path} has: give at most {has}"
            )));
        }
        for action in &program.steps[..steps] {
            sentences.push(Sentence::new(&action.sentence())?);
        }
    }
    let text = args.text.as_deref().or(args.narration.as_deref()).unwrap_or_default();
    for line in text.lines() {
        if line.trim_start().starts_with('[') {
            sentences.push(Sentence::new(&Action::parse(line)?.sentence())?);
            continue;
        }
        for sentence in line.split_inclusive(". ").filter(|sentence| !sentence.trim().is_empty()) {
            sentences.push(Sentence::new(sentence)?);
        }
    }
    Ok((0..).zip(sentences).map(|(sequence, sentence)| Observation::of(sequence, sentence)).collect())
}

/// All parts of the scores. Other programs rely on these keys.
pub(super) fn report<M: LanguageModel>(pipeline: &Pipeline<M>, map: &SemanticMap) -> serde_json::Value {
    let (scores, grounding, prepared) = (pipeline.scores(), pipeline.grounding(), pipeline.inside().prepared());
    let partition_id = |p: Option<PartitionId>| p.map(|p| grounding.partitions()[p.0 as usize].id.as_str());
    let labels: Vec<_> = (grounding.scored_labels().iter().zip(&scores.label_log_prob_nats).zip(prepared.tokens()))
        .map(|((label, log_prob_nats), tokens)| {
            json!({
                "label": label.text, "items": label.items.len(), "rooms": label.rooms.len(), "count": label.count,
                "log_prob_nats": log_prob_nats, "tokens": tokens,
                "pieces": tokens.iter().map(|&t| pipeline.inside().token_text(t)).collect::<Vec<_>>(),
            })
        })
        .collect();
    let item_scores = grounding.item_log_score_nats(&scores.label_log_prob_nats);
    let items: Vec<_> = (map.items().iter().zip(item_scores).zip(grounding.item_partition()))
        .map(|((item, log_score_nats), &partition)| {
            json!({"id": item.id, "label": map.labels()[item.label.0 as usize], "partition": partition_id(partition), "log_score_nats": log_score_nats})
        })
        .collect();
    let grounded = &scores.grounded;
    let partitions: Vec<_> = (grounding.partitions().iter())
        .zip(&grounded.partition_log_score_nats)
        .zip(&grounded.partition_probability)
        .zip(scores.lower_log_score_nats.iter().zip(&scores.upper_log_score_nats))
        .map(|(((partition, log_score_nats), probability), (lower, upper))| {
            json!({
                "id": partition.id, "label": partition.label, "log_score_nats": log_score_nats, "probability": probability,
                "lower_log_score_nats": lower, "upper_log_score_nats": upper,
            })
        })
        .collect();
    json!({
        "model": pipeline.inside().model(),
        "scene": {
            "name": map.name(), "fingerprint": hex::encode(map.fingerprint()),
            "items": map.items().len(), "labels": map.labels().len(), "rooms": map.rooms().len(),
            "unassigned": grounding.unassigned().iter().map(|(item, _)| &map.items()[item.0 as usize].id).collect::<Vec<_>>(),
        },
        "method": pipeline.inside().options().method,
        "effort": {"asked": pipeline.inside().options().effort, "reached": scores.reached},
        "tokenisation": pipeline.inside().options().tokenisation,
        "correction": prepared.correction(),
        "binding": pipeline.inside().options().binding.text(),
        "prompt_tokens": scores.prompt_tokens,
        "labels": labels,
        "items": items,
        "partitions": partitions,
        "label_mass": grounded.label_mass,
        "trust": scores.trust,
        "flags": warning(pipeline).map(|(flag, _)| flag).into_iter().collect::<Vec<_>>(),
        "decoded": {"calls": scores.stats.calls, "prompt_tokens": scores.stats.prompt_tokens_decoded, "tree_tokens": scores.stats.tree_tokens_decoded},
        "timing_ns": scores.timing,
    })
}

pub fn warning<M: LanguageModel>(pipeline: &Pipeline<M>) -> Option<(&'static str, String)> {
    match (&pipeline.inside().model().weakness, pipeline.scores().trust) {
        (Some(reason), _) => {
            Some(("model-weak", format!("MODEL_WEAK: these scores are noise. The model is weak: {reason}.")))
        }
        (None, trust) if trust < 1.0 => Some((
            "unfamiliar",
            format!(
                "UNFAMILIAR: the model does not know these words of the narration or of the map, so its scores say little. In a forecast they weigh {:.0} %.",
                100.0 * trust
            ),
        )),
        _ => None,
    }
}

fn tables<M: LanguageModel>(pipeline: &Pipeline<M>, map: &SemanticMap, top: usize) -> String {
    let (scores, grounding) = (pipeline.scores(), pipeline.grounding());
    let grounded = &scores.grounded;
    let mut table = super::table(&["partition", "probability", "", "ln score", "because of"]);
    let names = grounding.partition_names();
    let mut order: Vec<usize> = (0..names.len()).collect();
    order.sort_by(|&a, &b| grounded.partition_probability[b].total_cmp(&grounded.partition_probability[a]));
    for index in order {
        let behind = grounding.top_labels(PartitionId(index as u32), &scores.label_log_prob_nats, 4);
        let behind: Vec<_> = behind.iter().map(|&(l, _)| grounding.scored_labels()[l].text.as_str()).collect();
        let probability = grounded.partition_probability[index];
        table.add_row([
            names[index].clone(),
            format!("{:5.1} %", 100.0 * probability),
            bar(probability, 24),
            format!("{:.3}", grounded.partition_log_score_nats[index]),
            behind.join(", "),
        ]);
    }
    let warning = warning(pipeline).map(|(_, warning)| prose(&warning) + "\n\n").unwrap_or_default();
    let mut text = format!("{warning}{table}\n\n");
    let mut table = super::table(&["label", "probability", "ln probability", "items", "tokens"]);
    let mut order: Vec<usize> = (0..grounding.scored_labels().len()).collect();
    order.sort_by(|&a, &b| scores.label_log_prob_nats[b].total_cmp(&scores.label_log_prob_nats[a]));
    for &index in order.iter().take(top) {
        let label = &grounding.scored_labels()[index];
        let pieces: Vec<_> = pipeline.inside().prepared().tokens()[index]
            .iter()
            .map(|&t| format!("{:?}", pipeline.inside().token_text(t)))
            .collect();
        table.add_row([
            label.text.clone(),
            format!("{:5.2} %", 100.0 * scores.label_log_prob_nats[index].exp()),
            format!("{:.3}", scores.label_log_prob_nats[index]),
            (label.items.len() + label.rooms.len()).to_string(),
            pieces.join(" "),
        ]);
    }
    let _ = writeln!(text, "{table}\n");
    let timing = scores.timing;
    let told = format!(
        "{} and {} of {} by {}; {:.1} % of what could come next {}.\nScored by {}.",
        count(grounding.scored_labels().len(), "label"),
        count(map.items().len(), "item"),
        map.name(),
        pipeline.inside().model().name,
        100.0 * grounded.label_mass,
        match pipeline.inside().prepared().correction().continuation {
            Continuation::Free => "is a label",
            Continuation::Labels => "begins as a label does",
        },
        pipeline.inside().prepared().correction(),
    );
    let times = format!(
        "{}; {:.2} ms: tokenise {:.2}, prefix {:.2}, trie {:.2}, ground {:.3}.",
        count(scores.prompt_tokens, "prompt token"),
        timing.total_ns as f64 / 1e6,
        timing.tokenise_ns as f64 / 1e6,
        timing.prefix_ns as f64 / 1e6,
        timing.trie_ns as f64 / 1e6,
        timing.ground_ns as f64 / 1e6
    );
    let _ = writeln!(text, "{}", prose(&format!("{told}\n{times}")));
    text
}
