//! `roomcast model`: describes, checks and downloads model files.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::choice::choice;
use super::scene_files::write;
use super::{CommandResult, Failure, count, print};
#[cfg(feature = "whole")]
use crate::hub::{self, Hub, HubError, Request};
use roomcast_cli::model::{elsewhere, rehearse};
pub(super) use roomcast_cli::model::{load, try_configured};
use roomcast_core::prompt::{BindingSequence, write_prompt};
use roomcast_core::scorer::correction::{Continuation, Correction};
use roomcast_core::scorer::{LabelScores, LanguageModel, Method, Scorer, Token, Tokenisation, familiarity};
use roomcast_core::text::{read_text_at_most, visible};
use roomcast_llama::gguf::Header;
use roomcast_llama::{CacheType, LlamaModel, LlamaOptions};
use roomcast_services::embedded::{self, ModelFile};

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Show architecture, quantisation, vocabulary, context, checksum and licence of a model file.
    Info {
        /// A GGUF file; by default the embedded household model.
        file: Option<PathBuf>,
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
    /// Load a model, tokenise, score by every method, and compare with known scores.
    Check {
        /// A GGUF file; by default the embedded household model.
        file: Option<PathBuf>,
        /// Known scores to compare with, as --record writes them; for the embedded model, those in the binary.
        #[arg(long, value_name = "FILE")]
        case: Option<PathBuf>,
        /// Write this model's scores as a known case.
        #[arg(long, value_name = "FILE", conflicts_with = "case")]
        record: Option<PathBuf>,
        /// Print JSON.
        #[arg(long)]
        json: bool,
        /// In this process, which llama.cpp may end. The check starts itself with this option.
        #[arg(long, hide = true)]
        here: bool,
    },
    /// Load a model and score one label: the trial before a command loads a file.
    #[command(hide = true)]
    Rehearse {
        /// A GGUF file.
        file: PathBuf,
        /// How the key-value cache is stored.
        #[arg(long, value_parser = choice::<CacheType>(), default_value_t = CacheType::default())]
        kv_cache: CacheType,
    },
    #[cfg(feature = "whole")]
    /// Download a GGUF file from a model hub into the user's cache; an interrupted download is continued.
    Pull {
        /// The repository on the hub: owner/name.
        repository: String,
        /// The file in the repository.
        file: String,
        /// The hub's address.
        #[arg(long, env = "HF_ENDPOINT", default_value = hub::ENDPOINT_DEFAULT)]
        endpoint: String,
        /// The required SHA-256 of the file, 64 hexadecimal digits [default: the one that the hub states].
        #[arg(long, value_name = "DIGITS")]
        sha256: Option<String>,
        /// The folder of models [default: ~/.cache/roomcast/models].
        #[arg(long)]
        cache: Option<PathBuf>,
        /// A file with the token that the hub asks for; it is sent only to the hub.
        #[arg(long, env = "HF_TOKEN_PATH", value_name = "FILE")]
        token_file: Option<PathBuf>,
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
}

pub fn run(args: &Args) -> CommandResult {
    match &args.command {
        Command::Info { file, json } => info(file.as_deref(), *json),
        Command::Check { file: Some(file), case, record, json, here: false } => {
            elsewhere(check_arguments(file, case.as_deref(), record.as_deref(), *json), file)
        }
        Command::Check { file, case, record, json, here: _ } => {
            check(file.as_deref(), case.as_deref(), record.as_deref(), *json)
        }
        Command::Rehearse { file, kv_cache } => rehearse(file, *kv_cache),
        #[cfg(feature = "whole")]
        Command::Pull { repository, file, endpoint, sha256, cache, token_file, json } => {
            let token = token_file.as_deref().map(read_token).transpose()?;
            let hub = Hub { endpoint: Some(endpoint.clone()), cache: cache.clone(), token };
            pull(&hub, &Request { repository, file, sha256: sha256.as_deref() }, *json)
        }
    }
}

/// The description that `info` and `pull` share, for programs.
fn describe(path: &Path, header: &Header, sha256: &str) -> serde_json::Value {
    json!({
        "path": path,
        "name": header.text("general.name"),
        "description": header.text("general.description"),
        "licence": header.text("general.license"),
        "architecture": header.architecture(),
        "parameters": header.parameters(),
        "quantisation": header.quantisation().iter().map(|(kind, share)| json!({"type": kind, "share": share})).collect::<Vec<_>>(),
        "vocabulary": header.vocabulary_size(),
        "tokeniser": header.text("tokenizer.ggml.model"),
        "correction": recommended(header).map_or_else(|fault| json!({"fault": fault}), |correction| json!(correction)),
        "context_tokens": header.architecture_number("context_length"),
        "layers": header.architecture_number("block_count"),
        "width": header.architecture_number("embedding_length"),
        "size_bytes": header.size_bytes,
        "gguf_version": header.version,
        "sha256": sha256,
    })
}

fn recommended(header: &Header) -> Result<Correction, String> {
    Correction::recommended(|key| header.written(key))
}

/// The description for people: one line per property. Unstated properties are left out.
fn table(path: &Path, header: &Header, sha256: &str) -> String {
    let number = |name| header.architecture_number(name).map(|number| number.to_string());
    let text = |key| header.text(key).map(str::to_owned);
    let shares: Vec<_> =
        header.quantisation().iter().map(|(kind, share)| format!("{kind} {:.1} %", 100.0 * share)).collect();
    let scoring = match recommended(header) {
        Ok(Correction { continuation, prior }) => {
            let competitors = match continuation {
                Continuation::Free => "every token",
                Continuation::Labels => "other labels'",
            };
            format!("a label's tokens after the first compete with {competitors}; prior weight {prior}")
        }
        Err(fault) => format!("WRONG: {fault}"),
    };
    let rows = [
        ("file", Some(path.display().to_string())),
        ("name", text("general.name")),
        ("description", text("general.description")),
        ("licence", Some(text("general.license").unwrap_or_else(|| "not stated in the file".into()))),
        ("architecture", text("general.architecture")),
        ("parameters", Some(format!("{:.1} million", header.parameters() as f64 / 1e6))),
        ("quantisation", Some(shares.join(", "))),
        (
            "vocabulary",
            Some(format!(
                "{} tokens ({})",
                header.vocabulary_size(),
                header.text("tokenizer.ggml.model").unwrap_or("?")
            )),
        ),
        ("context", number("context_length").map(|tokens| format!("{tokens} tokens"))),
        ("scoring", Some(scoring)),
        ("layers", number("block_count")),
        ("width", number("embedding_length")),
        ("size", Some(format!("{:.1} MB", header.size_bytes as f64 / 1e6))),
        ("sha256", Some(sha256.to_owned())),
    ];
    // The file's texts are untrusted.
    let lines = rows.into_iter().filter_map(|(name, value)| Some(format!("{name:<14}{}\n", visible(&value?))));
    lines.collect()
}

/// The file to look at, and the value that keeps it alive if it is the embedded model.
fn open(file: Option<&Path>) -> Result<(PathBuf, Option<ModelFile>), Failure> {
    if let Some(file) = file {
        return Ok((file.to_owned(), None));
    }
    let embedded = ModelFile::create().map_err(Failure::model)?;
    Ok((embedded.path(), Some(embedded)))
}

fn info(file: Option<&Path>, as_json: bool) -> CommandResult {
    let (path, _embedded) = open(file)?;
    let header = Header::read_language_model(&path).map_err(Failure::model)?;
    let sha256 = roomcast_llama::file_sha256(&path).map(hex::encode).map_err(Failure::model)?;
    let shown = file.unwrap_or(Path::new(embedded::MODEL_NAME));
    print(&if as_json { format!("{:#}\n", describe(shown, &header, &sha256)) } else { table(shown, &header, &sha256) })
}

/// Known scores of a model: a regression test that travels with the model.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct KnownCase {
    /// Checksum of the model's file.
    model_sha256: String,
    /// Sentences, oldest first.
    narration: Vec<String>,
    /// A binding sequence, by name or as text.
    binding: String,
    /// Largest difference from a recorded score: machines round quantised products differently.
    tolerance_nats: f64,
    /// Labels with `ln s_c`, Equation 1.
    labels: Vec<KnownLabel>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct KnownLabel {
    label: String,
    log_prob_nats: f64,
}

impl KnownCase {
    /// A case for any model: a morning in a kitchen, with likely and unlikely labels, and labels of several tokens, which are decoded.
    fn unscored() -> Self {
        Self {
            model_sha256: String::new(),
            narration: familiarity::CHECK_NARRATION.map(str::to_owned).into(),
            binding: "default".into(),
            tolerance_nats: 0.05,
            labels: familiarity::CHECK_LABELS
                .map(|label| KnownLabel { label: label.into(), log_prob_nats: 0.0 })
                .into(),
        }
    }

    fn read(path: &Path) -> Result<Self, Failure> {
        let fail = |error: String| {
            let remedy = "give a file that `roomcast model check --record` wrote";
            Failure::input(format!("failed to read the known case {}: {error}; {remedy}", path.display()))
        };
        let text = read_text_at_most(path, KNOWN_BYTES_MAX).map_err(|error| fail(error.to_string()))?;
        serde_json::from_str(&text).map_err(|error| fail(error.to_string()))
    }

    fn embedded() -> Result<Self, Failure> {
        serde_json::from_str(embedded::MODEL_CHECK).map_err(Failure::model)
    }
}

#[derive(Debug, Serialize)]
struct Checked {
    check: &'static str,
    ok: bool,
    found: String,
}

impl Checked {
    fn new(check: &'static str, ok: bool, found: String) -> Self {
        Self { check, ok, found }
    }
}

/// Largest difference between two methods' scores of one label, in nats per token. Quantised kernels round activations, and sums in another order, as
/// in other batches, may round to the next step.
const METHODS_TOLERANCE_NATS_PER_TOKEN: f64 = 2e-2;
/// Far more than `--record` writes.
const KNOWN_BYTES_MAX: u64 = 16 << 20;

fn model_failure(error: impl std::fmt::Display) -> Failure {
    Failure::model(error.to_string())
}

fn check(file: Option<&Path>, case: Option<&Path>, record: Option<&Path>, as_json: bool) -> CommandResult {
    let (path, _embedded) = open(file)?;
    let known = match (case, file) {
        (Some(case), _) => Some(KnownCase::read(case)?),
        (None, None) if record.is_none() => Some(KnownCase::embedded()?),
        _ => None,
    };
    let mut case = known.clone().unwrap_or_else(KnownCase::unscored);
    // The known scores were computed in single precision.
    let options = LlamaOptions { cache: CacheType::F32, ..LlamaOptions::default() };
    let model = LlamaModel::load(&path, &options).map_err(model_failure)?;
    let about = model.info().clone();
    let sha256 = hex::encode(about.fingerprint);
    let loaded = format!("{}, {}, {} tokens of vocabulary", about.architecture, about.description, about.vocabulary);

    let mut scorer = Scorer::new(model);
    let labels: Vec<_> = case.labels.iter().map(|known| known.label.clone()).collect();
    let binding: BindingSequence = case.binding.parse().map_err(|error| Failure::input(format!("binding: {error}")))?;
    let Compared { scores, worst, needed, tokenises } = compared(&mut scorer, &case, &labels, &binding)?;
    let mass: f64 = scores[0].iter().map(|log_prob_nats| log_prob_nats.exp()).sum();
    // No label of the case begins another, so their scores add up to at most 1.
    let are_probabilities =
        scores.iter().flatten().all(|score| score.is_finite() && *score <= 1e-6) && mass <= 1.0 + 1e-6;
    let together = format!("{} labels, together {:.1} %", labels.len(), 100.0 * mass);
    let agree = format!("within {worst:.1e} nats per token, {METHODS_TOLERANCE_NATS_PER_TOKEN:.0e} allowed");
    let mut checked = vec![Checked::new("loads", true, loaded), tokenises];
    checked.extend(file.and_then(copy_of_embedded));
    checked.push(Checked::new("scores are probabilities", are_probabilities, together));
    checked.push(expects(mass, needed));
    checked.push(Checked::new("methods agree", worst <= METHODS_TOLERANCE_NATS_PER_TOKEN, agree));
    checked.extend(known.is_some().then(|| compare(&case, &sha256, &scores[0])));

    if let Some(record) = record {
        case.model_sha256 = sha256;
        for (known, score) in case.labels.iter_mut().zip(&scores[0]) {
            known.log_prob_nats = *score;
        }
        write(record, format!("{:#}\n", json!(case)).as_bytes())?;
    }
    let failed = checked.iter().filter(|checked| !checked.ok).count();
    if as_json {
        print(&format!("{:#}\n", json!({"model": about, "ok": failed == 0, "checks": checked})))?;
    } else {
        let lines =
            checked.iter().map(|c| format!("{:<6}{:<26}{}\n", if c.ok { "good" } else { "WRONG" }, c.check, c.found));
        print(&lines.collect::<String>())?;
    }
    if failed > 0 {
        let text = format!("{} failed: this model gives no scores to rely on", count(failed, "check"));
        return Err(Failure::check(text));
    }
    Ok(())
}

struct Compared {
    /// Equation 1 comes first, for the known scores.
    scores: Vec<Vec<f64>>,
    /// Largest difference between two methods, in nats per token.
    worst: f64,
    /// Least sum of all labels' probabilities that a working model reaches.
    needed: f64,
    tokenises: Checked,
}

/// Scores a case by equation 1, and with the correction that the file recommends.
fn compared(
    scorer: &mut Scorer<LlamaModel>,
    case: &KnownCase,
    labels: &[String],
    binding: &BindingSequence,
) -> Result<Compared, Failure> {
    let about = scorer.model().info().clone();
    let mut prompt = String::new();
    write_prompt(case.narration.iter().map(String::as_str), binding, false, &mut prompt);
    let mut by_all_methods = |correction| {
        let prepared = scorer.prepare(labels, binding, Tokenisation::Joint, correction).map_err(model_failure)?;
        let mut scores = Vec::new();
        for method in [Method::Trie, Method::SharedPrefix, Method::Independent] {
            let mut out = LabelScores::default();
            scorer.forget();
            scorer.score(&prepared, &prompt, method, &mut out).map_err(model_failure)?;
            scores.push(out.log_prob_nats);
        }
        let differences = scores[1..].iter().flat_map(|other| {
            let pairs = scores[0].iter().zip(other).zip(prepared.tokens());
            pairs.map(|((a, b), tokens)| (a - b).abs() / tokens.len() as f64)
        });
        Ok::<_, Failure>((differences.fold(0.0, f64::max), scores, prepared))
    };
    let (mut worst, mut scores, prepared) = by_all_methods(Correction::default())?;
    if about.correction != Correction::default() {
        let (other_worst, others, _) = by_all_methods(about.correction)?;
        worst = worst.max(other_worst);
        scores.extend(others);
    }
    let needed = familiarity::check_mass_min(prepared.tokens(), about.vocabulary);
    Ok(Compared { scores, worst, needed, tokenises: tokenises(scorer, labels, prepared.tokens()) })
}

fn check_arguments(file: &Path, case: Option<&Path>, record: Option<&Path>, json: bool) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = ["model", "check", "--here"].map(OsString::from).to_vec();
    for (option, given) in [("--case", case), ("--record", record)] {
        // In one word: a file's name may begin with a hyphen.
        arguments.extend(given.map(|given| [OsString::from(option), "=".into(), given.into()].into_iter().collect()));
    }
    arguments.extend(json.then(|| "--json".into()));
    arguments.extend(["--".into(), file.into()]);
    arguments
}

/// Checks whether the tokens of each label spell the label.
fn tokenises(scorer: &Scorer<LlamaModel>, labels: &[String], tokens: &[Vec<Token>]) -> Checked {
    let spelled = |tokens: &[Token]| tokens.iter().map(|&token| scorer.model().token_text(token)).collect::<String>();
    let misspelt: Vec<_> =
        labels.iter().zip(tokens).filter(|(label, tokens)| spelled(tokens).trim_start() != label.as_str()).collect();
    let count: usize = tokens.iter().map(Vec::len).sum();
    let found = match misspelt.first() {
        None => format!("{} labels, {:.1} tokens each", labels.len(), count as f64 / labels.len().max(1) as f64),
        Some((label, tokens)) => format!("the label {label:?} comes back as {:?}", spelled(tokens)),
    };
    Checked::new("tokenises", misspelt.is_empty(), found)
}

/// Checks whether the model expects such labels, by their total probability.
fn expects(mass: f64, needed: f64) -> Checked {
    let ok = mass >= needed;
    let remedy = if ok { "" } else { ": it does not know how such a sentence goes on; take another model" };
    Checked::new("labels are expected", ok, format!("{mass:.1e} in all, {needed:.0e} needed{remedy}"))
}

/// Whether the file is the embedded model with a few bytes changed: damage that scores may not show. `None` for another model.
fn copy_of_embedded(file: &Path) -> Option<Checked> {
    /// Another model of the same size differs nearly everywhere.
    const SHARE_MAX: f64 = 0.01;
    if std::fs::metadata(file).ok()?.len() != embedded::MODEL.len() as u64 {
        return None;
    }
    let bytes = std::fs::read(file).ok()?;
    let different = bytes.iter().zip(embedded::MODEL).filter(|(a, b)| a != b).count();
    let found = match different {
        0 => "of the embedded model, byte for byte".to_owned(),
        _ => format!("{different} bytes differ from the embedded model's: damaged on the way; copy it again"),
    };
    let is_copy = different as f64 <= SHARE_MAX * embedded::MODEL.len() as f64;
    is_copy.then(|| Checked::new("is a whole copy", different == 0, found))
}

fn compare(case: &KnownCase, sha256: &str, scores: &[f64]) -> Checked {
    let worst =
        case.labels.iter().zip(scores).map(|(known, score)| (known.log_prob_nats - score).abs()).fold(0.0, f64::max);
    let same_file = case.model_sha256 == sha256;
    let found = match same_file {
        true => format!("within {worst:.1e} nats of those recorded, {:.0e} allowed", case.tolerance_nats),
        false => format!("the case was recorded for the file {}, this is {sha256}", case.model_sha256),
    };
    Checked::new("known scores", same_file && worst <= case.tolerance_nats, found)
}

#[cfg(feature = "whole")]
fn read_token(path: &Path) -> Result<String, Failure> {
    let fault = |why: String| Failure::input(format!("failed to read the token file {}: {why}", path.display()));
    let token = std::fs::read_to_string(path).map_err(|error| fault(error.to_string()))?.trim().to_owned();
    let is_plain = !token.is_empty() && token.bytes().all(|byte| byte.is_ascii_graphic());
    if is_plain { Ok(token) } else { Err(fault("it holds no token on one line".to_owned())) }
}

#[cfg(feature = "whole")]
fn pull(hub: &Hub, request: &Request<'_>, as_json: bool) -> CommandResult {
    // Drawn on standard error, and only on a terminal.
    let style = indicatif::ProgressStyle::with_template("{wide_bar} {decimal_bytes}/{decimal_total_bytes} {eta}");
    let progress = indicatif::ProgressBar::new(0);
    let progress = style.map_or(progress.clone(), |style| progress.with_style(style));
    let pulled = hub.pull(request, &progress).map_err(|error| match error {
        HubError::Name { .. } => Failure::usage(error),
        HubError::Checksum { .. } | HubError::Model(_) => Failure::model(error),
        _ => Failure::failed(error),
    })?;
    if as_json {
        let mut description = describe(&pulled.path, &pulled.header, &pulled.sha256);
        description["verified"] = true.into();
        description["pinned"] = pulled.pinned.into();
        return print(&format!("{description:#}\n"));
    }
    let checked = if pulled.pinned {
        "the checksum is the one that you gave"
    } else {
        "the checksum is the one that the hub states; give it by --sha256 to be sure of the same file next time"
    };
    print(&format!(
        "{}\n{checked}; use the file by --model, or as model.path in the configuration\n",
        table(&pulled.path, &pulled.header, &pulled.sha256)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exit_code;

    /// The checking process gets the same options, for any file name.
    #[test]
    fn a_check_is_handed_on_as_it_was_asked_for() {
        use clap::{Args as _, FromArgMatches as _};
        let names = ["m.gguf", "-m.gguf", "--json", "--here", "a b"].map(Path::new);
        let one = |name| [None, Some(name)];
        for (file, other) in names.into_iter().flat_map(|file| names.map(|other| (file, other))) {
            for (case, record) in one(other).map(|case| (case, None)).into_iter().chain([(None, Some(other))]) {
                for asked_json in [false, true] {
                    let line = check_arguments(file, case, record, asked_json);
                    let command = Args::augment_args(clap::Command::new("model"));
                    let parsed = Args::from_arg_matches(&command.try_get_matches_from(line).unwrap()).unwrap();
                    let Command::Check { file: own, case: c, record: r, json, here: true } = parsed.command else {
                        panic!("{parsed:?}")
                    };
                    assert_eq!(
                        (own.as_deref(), c.as_deref(), r.as_deref(), json),
                        (Some(file), case, record, asked_json)
                    );
                }
            }
        }
    }

    /// Texts in a model file are untrusted.
    #[test]
    fn a_models_name_forges_no_row() {
        let mut bytes = embedded::MODEL.to_vec();
        let name = b"general.name";
        let at = bytes.windows(name.len()).position(|window| window == name).unwrap() + name.len() + 4;
        let length = u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
        let forged = b"\x1b]0;x\x07\nsha256";
        bytes[at + 8..at + 8 + length].fill(b' ');
        bytes[at + 8..at + 8 + length.min(forged.len())].copy_from_slice(&forged[..length.min(forged.len())]);
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), &bytes).unwrap();
        let header = Header::read_language_model(file.path()).unwrap();
        let table = table(file.path(), &header, "0");
        assert!(!table.contains('\u{1b}') && table.contains("\\u001b]0;x"), "{table}");
        assert_eq!(table.lines().filter(|line| line.starts_with("sha256")).count(), 1, "{table}");
    }

    /// Fails if the model was changed without its known scores: `roomcast model check --record models/household-check.json`.
    #[test]
    fn the_embedded_model_gives_its_known_scores() {
        if let Err(failure) = check(None, None, None, true) {
            panic!(
                "{failure}; after a change of the model run `roomcast model check --record models/household-check.json`"
            );
        }
    }

    #[test]
    fn a_model_that_expects_no_label_fails_its_check() {
        assert!(expects(0.2, 1e-2).ok && !expects(1e-9, 1e-3).ok && !expects(0.0, 1e-3).ok);
    }

    #[test]
    fn a_copy_with_one_flipped_byte_fails_its_check() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut copy = embedded::MODEL.to_vec();
        std::fs::write(file.path(), &copy).unwrap();
        check(Some(file.path()), None, None, true).unwrap();
        // A byte of a weight near the end, which hardly changes a score.
        let at = copy.len() - 1000;
        copy[at] ^= 1;
        std::fs::write(file.path(), &copy).unwrap();
        let failure = check(Some(file.path()), None, None, true).unwrap_err();
        assert_eq!(failure.code, exit_code::CHECK);
        assert!(copy_of_embedded(file.path()).unwrap().found.starts_with("1 bytes differ"));
    }

    #[test]
    fn a_damaged_file_is_a_model_failure_and_no_crash() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), &embedded::MODEL[..embedded::MODEL.len() / 2]).unwrap();
        let failure = check(Some(file.path()), None, None, false).unwrap_err();
        assert_eq!(failure.code, exit_code::MODEL);
        assert!(failure.to_string().contains("truncated"), "{failure}");
    }
}
