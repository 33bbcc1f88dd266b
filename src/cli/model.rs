//! `roomcast model`: what a model file is, whether it works here, and how to get another.

use std::io::Write;
use std::path::{Path, PathBuf};

use serde_json::json;

use super::{CommandResult, Failure};
use crate::exit_code;
use crate::gguf::Header;
use crate::hub::{self, Hub, HubError};

/// Arguments of `roomcast model`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Show architecture, quantisation, vocabulary, context, checksum and licence of a model file.
    Info {
        /// A GGUF file.
        file: PathBuf,
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
    /// Download a GGUF file from a model hub into the user's cache; an interrupted download is taken up.
    Pull {
        /// The repository on the hub: owner/name.
        repository: String,
        /// The file in the repository.
        file: String,
        /// The hub's address.
        #[arg(long, env = "HF_ENDPOINT", default_value = hub::ENDPOINT_DEFAULT)]
        endpoint: String,
        /// The cache's folder [default: the one that other tools of the hub share, ~/.cache/huggingface/hub].
        #[arg(long)]
        cache: Option<PathBuf>,
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
}

/// Runs the subcommand and prints on standard output.
pub fn run(args: &Args) -> CommandResult {
    match &args.command {
        Command::Info { file, json } => info(file, *json),
        Command::Pull { repository, file, endpoint, cache, json } => {
            let hub = Hub { endpoint: Some(endpoint.clone()), cache: cache.clone() };
            pull(&hub, repository, file, *json)
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
        "context_tokens": header.architecture_number("context_length"),
        "layers": header.architecture_number("block_count"),
        "width": header.architecture_number("embedding_length"),
        "size_bytes": header.size_bytes,
        "gguf_version": header.version,
        "sha256": sha256,
    })
}

/// The same for people: one line per property, those that the file does not state left out.
fn table(path: &Path, header: &Header, sha256: &str) -> String {
    let number = |name| header.architecture_number(name).map(|number| number.to_string());
    let text = |key| header.text(key).map(str::to_owned);
    let shares: Vec<_> =
        header.quantisation().iter().map(|(kind, share)| format!("{kind} {:.1} %", 100.0 * share)).collect();
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
        ("layers", number("block_count")),
        ("width", number("embedding_length")),
        ("size", Some(format!("{:.1} MB", header.size_bytes as f64 / 1e6))),
        ("sha256", Some(sha256.to_owned())),
    ];
    let lines = rows.into_iter().filter_map(|(name, value)| Some(format!("{name:<14}{}\n", value?)));
    lines.collect()
}

fn print(text: &str) -> CommandResult {
    std::io::stdout().write_all(text.as_bytes()).map_err(|error| Failure::new(exit_code::FAILURE, error))
}

fn info(file: &Path, as_json: bool) -> CommandResult {
    let header = Header::read_language_model(file).map_err(|error| Failure::new(exit_code::MODEL, error))?;
    let sha256 = hub::sha256_of(file).map_err(|error| Failure::new(exit_code::MODEL, error))?;
    print(&if as_json { format!("{:#}\n", describe(file, &header, &sha256)) } else { table(file, &header, &sha256) })
}

fn pull(hub: &Hub, repository: &str, file: &str, as_json: bool) -> CommandResult {
    // Drawn on standard error, and only where that is a terminal.
    let progress = indicatif::ProgressBar::new(0);
    let pulled = hub.pull(repository, file, progress).map_err(|error| {
        let code = match error {
            HubError::Name { .. } => exit_code::USAGE,
            HubError::Checksum { .. } | HubError::Model(_) => exit_code::MODEL,
            _ => exit_code::FAILURE,
        };
        Failure::new(code, error)
    })?;
    if as_json {
        let mut description = describe(&pulled.path, &pulled.header, &pulled.sha256);
        description["verified"] = pulled.verified.into();
        return print(&format!("{description:#}\n"));
    }
    let verified = if pulled.verified { "the hub's checksum was compared" } else { "the hub states no checksum" };
    print(&format!(
        "{}\n{verified}; use it by --model, or as model.path in the configuration\n",
        table(&pulled.path, &pulled.header, &pulled.sha256)
    ))
}
