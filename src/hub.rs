//! Fetches GGUF models from a model hub (Hugging Face, or a server with its protocol) into a folder of the user.
//!
//! The server is untrusted. It is asked once, and its answer is used as checked. The file's name comes from the user's request, never from the
//! server. The bytes go into a private file, which gets its final name only after its SHA-256 matches.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, SeekFrom, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Component, Path, PathBuf};
use std::time::Duration;

use sha2::{Digest, Sha256};
use ureq::http::{HeaderMap, Response, StatusCode, Uri};

use roomcast_llama::file_sha256;
use roomcast_llama::gguf::{GgufError, Header};

pub const ENDPOINT_DEFAULT: &str = "https://huggingface.co";

pub const SIZE_MAX_BYTES: u64 = 64 << 30;

const REDIRECTS_MAX: usize = 5;

/// Timeout to connect, to begin an answer, and between two parts of it.
const PATIENCE: Duration = Duration::from_secs(30);

/// This rate for the largest file gives the longest transfer. A transfer that stands still for [`PATIENCE`] fails; the next try continues it.
const BYTES_PER_SECOND_MIN: u64 = 32 << 10;

#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HubError {
    /// An invalid repository, file name, checksum or address.
    #[error(
        "{given:?} is no {expected}; for example: roomcast model pull HuggingFaceTB/SmolLM2-135M-Instruct-GGUF smollm2-135m-instruct-q8_0.gguf"
    )]
    Name { given: String, expected: &'static str },
    /// The connection ended too early. The received bytes are kept.
    #[error(
        "the transfer from {endpoint} broke off after {here} of {size_bytes} bytes: {why}; run the command again to continue"
    )]
    CutOff { endpoint: String, here: u64, size_bytes: u64, why: String },
    #[error(
        "failed to reach {endpoint}: {reason}; without a network use the embedded household model, which every command does when no --model is given"
    )]
    Unreachable { endpoint: String, reason: String },
    #[error("{endpoint} answered {status} for {file} of {repository}: {remedy}")]
    Refused { endpoint: String, status: u16, repository: String, file: String, remedy: &'static str },
    /// The hub's answer is invalid or not allowed.
    #[error(
        "{endpoint} does not answer as a model hub does: {reason}; check the address given by --endpoint or HF_ENDPOINT"
    )]
    Protocol { endpoint: String, reason: String },
    /// The hub states no SHA-256 and the user gave none.
    #[error(
        "{endpoint} states no SHA-256 for {file}, so what arrives cannot be checked: give the one that its publisher states by --sha256"
    )]
    NoChecksum { endpoint: String, file: String },
    /// The hub has another file. It is not kept.
    #[error("{file} has SHA-256 {found}, expected {wanted}: {remedy}")]
    Checksum {
        file: String,
        /// The checksum of the received file, or the one that the hub states in advance.
        found: String,
        wanted: String,
        remedy: &'static str,
    },
    #[error("another process is downloading this file to {0}: wait for it")]
    Locked(PathBuf),
    /// The folder belongs to another user, or others may write to it.
    #[error(
        "{0} belongs to another user or may be written by others: choose another folder by --cache, or make it private (chmod 700)"
    )]
    Shared(PathBuf),
    #[error(
        "failed to use {path}: {error}; check that there is room and that it may be written, or choose another folder by --cache"
    )]
    Cache { path: PathBuf, error: std::io::Error },
    /// The file is complete but not a usable model. It is not kept.
    #[error(transparent)]
    Model(#[from] GgufError),
}

#[derive(Debug, Clone, Default)]
pub struct Hub {
    /// The hub's address, `https://` or loopback; [`ENDPOINT_DEFAULT`] by default.
    pub endpoint: Option<String>,
    /// The folder of models; `roomcast/models` in the user's cache by default.
    pub cache: Option<PathBuf>,
    /// A token for the endpoint. It is never sent to a redirect's target.
    pub token: Option<String>,
}

#[derive(Debug, Clone, Copy)]
pub struct Request<'a> {
    /// `owner/name` on the hub.
    pub repository: &'a str,
    pub file: &'a str,
    /// The required SHA-256 as 64 hexadecimal digits; by default the one that the hub states.
    pub sha256: Option<&'a str>,
}

#[derive(Debug)]
pub struct Pulled {
    pub path: PathBuf,
    pub sha256: String,
    /// Whether the user gave the checksum, not the hub.
    pub pinned: bool,
    pub header: Header,
}

fn is_name(name: &str) -> bool {
    !name.is_empty()
        && !name.starts_with('.')
        && name.len() <= 128
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"._-".contains(&byte))
}

/// 64 hexadecimal digits, in lower case.
fn checksum(text: &str) -> Option<String> {
    (text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit())).then(|| text.to_ascii_lowercase())
}

/// Whether this address may be used: TLS, or a server on this machine.
fn is_private(address: &Uri) -> bool {
    let is_loopback = |host: &str| {
        let host = host.trim_start_matches('[').trim_end_matches(']');
        host == "localhost" || host.parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback())
    };
    match address.scheme_str() {
        Some("https") => address.host().is_some(),
        Some("http") => address.host().is_some_and(is_loopback),
        _ => false,
    }
}

/// The address of a file, and the requested checksum. Names that could lead elsewhere are refused.
fn asked(endpoint: &str, request: &Request<'_>) -> Result<(Uri, Option<String>), HubError> {
    let &Request { repository, file, sha256 } = request;
    let name = |given: &str, expected| HubError::Name { given: given.into(), expected };
    if !repository.split_once('/').is_some_and(|(owner, name)| is_name(owner) && is_name(name)) {
        return Err(name(repository, "repository (owner/name)"));
    }
    let plain = Path::new(file).components().all(|part| matches!(part, Component::Normal(_)));
    if !plain || !file.split('/').all(is_name) {
        return Err(name(file, "file in a repository"));
    }
    let pinned = match sha256 {
        Some(text) => Some(checksum(text).ok_or_else(|| name(text, "SHA-256 (64 hexadecimal digits)"))?),
        None => None,
    };
    let url = format!("{endpoint}/{repository}/resolve/main/{file}").parse::<Uri>();
    let url = url.ok().filter(is_private);
    let url = url.ok_or_else(|| name(endpoint, "address of a hub (https://...; http only on this machine)"))?;
    Ok((url, pinned))
}

struct Answer {
    /// The SHA-256 that the endpoint states.
    stated: Option<String>,
    size_bytes: u64,
    /// The offset of the first byte.
    from: u64,
    /// The hub has nothing beyond the kept bytes (416).
    nothing_more: bool,
    body: Box<dyn Read>,
}

const BUFFER: usize = 1 << 16;

/// The kept part of a file until it is complete. Its name comes from no server, and only one process has it.
struct Partial {
    path: PathBuf,
    content: File,
    /// Of the kept bytes.
    hasher: Sha256,
    kept: u64,
}

impl Partial {
    /// Continues an interrupted download, or begins.
    fn open(path: PathBuf) -> Result<Self, HubError> {
        let mut content = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .custom_flags(rustix::fs::OFlags::NOFOLLOW.bits().cast_signed())
            .open(&path)
            .map_err(failed(&path))?;
        match content.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(HubError::Locked(path)),
            Err(TryLockError::Error(error)) => return Err(HubError::Cache { path, error }),
        }
        // The previous owner of the lock may have given the file its final name.
        if !is_at(&content, &path) {
            return Err(HubError::Locked(path));
        }
        let (mut hasher, mut kept, mut buffer) = (Sha256::new(), 0, vec![0; BUFFER]);
        loop {
            let length = content.read(&mut buffer).map_err(failed(&path))?;
            if length == 0 {
                return Ok(Self { path, content, hasher, kept });
            }
            hasher.update(&buffer[..length]);
            kept += length as u64;
        }
    }

    /// Whether the path still leads to this file: it may have been renamed or removed.
    fn is_there(&self) -> bool {
        is_at(&self.content, &self.path)
    }

    fn remove(&self) -> Result<(), HubError> {
        std::fs::remove_file(&self.path).map_err(failed(&self.path))
    }

    fn sha256(&self) -> String {
        hex::encode(self.hasher.clone().finalize())
    }

    /// Reads the answer's bytes, from the offset that it has.
    fn take_in(&mut self, answer: Answer, endpoint: &str, progress: &indicatif::ProgressBar) -> Result<(), HubError> {
        if answer.from == 0 {
            self.hasher = Sha256::new();
            self.content.set_len(0).map_err(failed(&self.path))?;
        }
        self.content.seek(SeekFrom::Start(answer.from)).map_err(failed(&self.path))?;
        progress.set_length(answer.size_bytes);
        progress.set_position(answer.from);
        let missing = answer.size_bytes - answer.from;
        let mut body = answer.body.take(missing);
        let cut_off = |arrived: u64, why: String| HubError::CutOff {
            endpoint: endpoint.into(),
            here: answer.from + arrived,
            size_bytes: answer.size_bytes,
            why,
        };
        let (mut arrived, mut buffer) = (0, vec![0; BUFFER]);
        loop {
            let length = match body.read(&mut buffer) {
                Ok(0) if arrived == missing => break,
                Ok(0) => return Err(cut_off(arrived, "the connection ended".to_owned())),
                Err(error) => return Err(cut_off(arrived, error.to_string())),
                Ok(length) => length,
            };
            self.content.write_all(&buffer[..length]).map_err(failed(&self.path))?;
            self.hasher.update(&buffer[..length]);
            arrived += length as u64;
            progress.inc(length as u64);
        }
        progress.finish_and_clear();
        Ok(())
    }

    /// Gives the file its final name. A rename replaces a link instead of following it.
    fn settle(self, path: &Path, folder: &Path) -> Result<(), HubError> {
        self.content.sync_all().map_err(failed(&self.path))?;
        std::fs::rename(&self.path, path).map_err(failed(path))?;
        File::open(folder).and_then(|folder| folder.sync_all()).map_err(failed(folder))
    }
}

/// An empty download leaves no file.
impl Drop for Partial {
    fn drop(&mut self) {
        if self.content.metadata().is_ok_and(|content| content.len() == 0) && self.is_there() {
            // If removing fails, the next try uses the file.
            let _removed = std::fs::remove_file(&self.path);
        }
    }
}

fn is_at(content: &File, path: &Path) -> bool {
    let same = |there: std::fs::Metadata| {
        content.metadata().is_ok_and(|ours| (ours.dev(), ours.ino()) == (there.dev(), there.ino()))
    };
    path.symlink_metadata().is_ok_and(same)
}

fn failed(path: &Path) -> impl Fn(std::io::Error) -> HubError + use<> {
    let path = path.to_owned();
    move |error| HubError::Cache { path: path.clone(), error }
}

impl Hub {
    /// Downloads a file, or continues an interrupted download, and checks it. Draws on `progress`, which may be hidden.
    ///
    /// # Errors
    ///
    /// [`HubError`]. The next call continues an interrupted download.
    pub fn pull(&self, request: &Request<'_>, progress: &indicatif::ProgressBar) -> Result<Pulled, HubError> {
        let &Request { repository, file, sha256 } = request;
        let endpoint = self.endpoint.as_deref().unwrap_or(ENDPOINT_DEFAULT).trim_end_matches('/');
        let (url, pinned) = asked(endpoint, request)?;
        let cache = self.cache.clone().or_else(cache_default);
        let cache = cache.ok_or_else(|| HubError::Cache {
            path: PathBuf::from("~/.cache"),
            error: std::io::Error::new(std::io::ErrorKind::NotFound, "there is no home folder"),
        })?;
        let path = cache.join(repository).join(file);
        let folder = path.parent().unwrap_or(&cache);
        private_folder(folder)?;
        let is_here = |wanted: &str| file_sha256(&path).is_ok_and(|found| hex::encode(found) == wanted);
        if let Some(wanted) = pinned.as_ref().filter(|wanted| is_here(wanted)) {
            let header = Header::read_download(&path)?;
            return Ok(Pulled { path, sha256: wanted.clone(), pinned: true, header });
        }

        // The name is ours: the server chooses neither name nor folder.
        let name = format!(".{}.part", hex::encode(Sha256::digest(format!("{url}\n{sha256:?}"))));
        let mut part = Partial::open(folder.join(name))?;
        let answer = self.ask(endpoint, &url, part.kept, request)?;
        // The kept part is at least as long as the file: it is complete, or it cannot be continued.
        if answer.nothing_more && pinned.as_ref().or(answer.stated.as_ref()) != Some(&part.sha256()) {
            part.remove()?;
            return Err(refused(endpoint, StatusCode::RANGE_NOT_SATISFIABLE, request));
        }
        let unlike =
            |found: String, wanted: String, remedy| HubError::Checksum { file: file.into(), found, wanted, remedy };
        let wanted = match (&pinned, &answer.stated) {
            (Some(pinned), Some(stated)) if pinned != stated => {
                part.remove()?;
                return Err(unlike(stated.clone(), pinned.clone(), "the hub has another file by this name"));
            }
            (Some(sum), _) | (None, Some(sum)) => sum.clone(),
            (None, None) => return Err(HubError::NoChecksum { endpoint: endpoint.into(), file: file.into() }),
        };
        if is_here(&wanted) {
            // The part is of no use.
            let header = Header::read_download(&path)?;
            part.remove()?;
            return Ok(Pulled { path, sha256: wanted, pinned: pinned.is_some(), header });
        }
        part.take_in(answer, endpoint, progress)?;
        let found = part.sha256();
        let checked = if found == wanted {
            Header::read_download(&part.path).map_err(HubError::Model)
        } else {
            let remedy = "it arrived damaged or was exchanged on the way; nothing of it is kept, run the command again";
            Err(unlike(found.clone(), wanted, remedy))
        };
        let header = match checked {
            Ok(header) => header,
            Err(error) => {
                part.remove()?;
                return Err(error);
            }
        };
        part.settle(&path, folder)?;
        Ok(Pulled { path, sha256: found, pinned: pinned.is_some(), header })
    }

    /// Asks once for the bytes from `kept` on. Redirects are followed, and only the endpoint's own answers describe the file.
    fn ask(&self, endpoint: &str, url: &Uri, kept: u64, request: &Request<'_>) -> Result<Answer, HubError> {
        let protocol = |reason: String| HubError::Protocol { endpoint: endpoint.into(), reason };
        let unreachable =
            |error: ureq::Error| HubError::Unreachable { endpoint: endpoint.into(), reason: error.to_string() };
        let patience = PATIENCE + Duration::from_secs(SIZE_MAX_BYTES / BYTES_PER_SECOND_MIN);
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .max_redirects(0)
            .max_redirects_will_error(false)
            .http_status_as_error(false)
            .timeout_resolve(Some(PATIENCE))
            .timeout_connect(Some(PATIENCE))
            .timeout_recv_response(Some(PATIENCE))
            .timeout_recv_body(Some(patience))
            .timeout_per_read(Some(PATIENCE))
            .build()
            .into();
        let mut address = url.clone();
        let mut stated = None;
        let mut linked_size = None;
        for _ in 0..=REDIRECTS_MAX {
            let is_endpoint = address.authority() == url.authority() && address.scheme() == url.scheme();
            let mut call =
                agent.get(address.clone()).header("User-Agent", concat!("roomcast/", env!("CARGO_PKG_VERSION")));
            if kept > 0 {
                call = call.header("Range", format!("bytes={kept}-"));
            }
            if let Some(token) = self.token.as_ref().filter(|_| is_endpoint) {
                call = call.header("Authorization", format!("Bearer {token}"));
            }
            let answer = call.call().map_err(unreachable)?;
            let header = |name: &str| text(answer.headers(), name);
            if is_endpoint {
                let tag = header("x-linked-etag").or_else(|| header("etag"));
                stated = tag.and_then(|tag| checksum(tag.trim_start_matches("W/").trim_matches('"'))).or(stated);
                linked_size = header("x-linked-size").and_then(|size| size.parse().ok()).or(linked_size);
            }
            let status = answer.status();
            if status.is_redirection() {
                let target = header("location").ok_or_else(|| protocol("a redirect to nowhere".into()))?;
                address = redirect(&address, target)
                    .ok_or_else(|| protocol(format!("a redirect to {target:?}, which is not allowed")))?;
                continue;
            }
            if status == StatusCode::RANGE_NOT_SATISFIABLE && kept > 0 {
                let body = Box::new(std::io::empty());
                return Ok(Answer { stated, size_bytes: kept, from: kept, nothing_more: true, body });
            }
            if !status.is_success() {
                return Err(refused(endpoint, status, request));
            }
            return body(answer, kept, stated, linked_size).map_err(protocol);
        }
        Err(protocol(format!("more than {REDIRECTS_MAX} redirects")))
    }
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

/// The target of a redirect: an absolute address or path, never from TLS to plain text.
fn redirect(from: &Uri, target: &str) -> Option<Uri> {
    let absolute = match target.strip_prefix('/') {
        Some(path) if !path.starts_with('/') => format!("{}://{}/{path}", from.scheme_str()?, from.authority()?),
        _ => target.to_owned(),
    };
    let target: Uri = absolute.parse().ok()?;
    let weaker = from.scheme_str() == Some("https") && target.scheme_str() != Some("https");
    (is_private(&target) && !weaker).then_some(target)
}

fn body(
    answer: Response<ureq::Body>,
    kept: u64,
    stated: Option<String>,
    linked_size: Option<u64>,
) -> Result<Answer, String> {
    let number = |name: &str| text(answer.headers(), name).and_then(|number| number.parse::<u64>().ok());
    let (from, size_bytes) = if answer.status() == StatusCode::PARTIAL_CONTENT {
        let range = text(answer.headers(), "content-range").and_then(|range| range.strip_prefix("bytes "));
        let range = range.and_then(|range| range.split_once('/'));
        let size = range.and_then(|(_, size)| size.parse().ok());
        let from = range.and_then(|(range, _)| range.split_once('-')).and_then(|(from, _)| from.parse::<u64>().ok());
        match (from, size) {
            (Some(from), Some(size)) if from == kept => (from, size),
            _ => return Err("a part of the file that was not asked for".into()),
        }
    } else {
        (0, number("content-length").or(linked_size).ok_or("the file's size is not stated")?)
    };
    if linked_size.is_some_and(|linked| linked != size_bytes) {
        return Err("two sizes of one file".into());
    }
    if size_bytes > SIZE_MAX_BYTES || from > size_bytes {
        return Err(format!("a file of {size_bytes} bytes, at most {SIZE_MAX_BYTES} are fetched"));
    }
    // The default limit is 10 MB. The size above bounds the read.
    let body = answer.into_body().into_with_config().limit(SIZE_MAX_BYTES).reader();
    Ok(Answer { stated, size_bytes, from, nothing_more: false, body: Box::new(body) })
}

fn refused(endpoint: &str, status: StatusCode, request: &Request<'_>) -> HubError {
    let remedy = match status.as_u16() {
        401 | 403 => {
            "the repository is private, gated, or does not exist; accept its terms on the hub and give a token by --token-file"
        }
        404 => "there is no such repository or file; file names are case-sensitive",
        416 => "what an interrupted download left is no beginning of this file and is gone; run the command again",
        429 => "too many requests; wait a while",
        _ => "try again later",
    };
    let (endpoint, repository, file) = (endpoint.to_owned(), request.repository.into(), request.file.into());
    HubError::Refused { endpoint, status: status.as_u16(), repository, file, remedy }
}

fn cache_default() -> Option<PathBuf> {
    let base = std::env::var_os("XDG_CACHE_HOME").map(PathBuf::from).filter(|path| path.is_absolute());
    let base = base.or_else(|| std::env::home_dir().map(|home| home.join(".cache")))?;
    Some(base.join("roomcast/models"))
}

/// Makes the folder if it is missing, and checks that no other user may put files there.
fn private_folder(folder: &Path) -> Result<(), HubError> {
    let failed = |error| HubError::Cache { path: folder.into(), error };
    std::fs::DirBuilder::new().recursive(true).mode(0o700).create(folder).map_err(failed)?;
    let about = folder.metadata().map_err(failed)?;
    if about.uid() != rustix::process::geteuid().as_raw() || about.mode() & 0o022 != 0 {
        return Err(HubError::Shared(folder.into()));
    }
    // A user with write access to a parent folder can rename this one, unless the parent has the sticky bit.
    let whole = folder.canonicalize().map_err(failed)?;
    for above in whole.ancestors().skip(1) {
        let mode = above.metadata().map_err(failed)?.mode();
        if mode & 0o002 != 0 && mode & 0o1000 == 0 {
            return Err(HubError::Shared(above.into()));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{BufRead, BufReader};
    use std::net::TcpListener;
    use std::sync::{Arc, Mutex};

    use indicatif::ProgressBar;
    use rand::seq::IndexedRandom;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// A hub on loopback. `answer` maps the request's path and the start of its range to head and body.
    struct Server {
        address: String,
        ranges: Arc<Mutex<Vec<u64>>>,
    }

    impl Server {
        fn answering(mut answer: impl FnMut(&str, u64, &str) -> (String, Vec<u8>) + Send + 'static) -> Self {
            let listener = TcpListener::bind("127.0.0.1:0").unwrap();
            let address = format!("http://{}", listener.local_addr().unwrap());
            let ranges = Arc::new(Mutex::new(Vec::new()));
            let (seen, base) = (Arc::clone(&ranges), address.clone());
            std::thread::spawn(move || {
                for stream in listener.incoming() {
                    let mut stream = stream.unwrap();
                    let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
                    let Some(Ok(request)) = lines.next() else { continue };
                    let headers: Vec<_> = lines.map_while(Result::ok).take_while(|line| !line.is_empty()).collect();
                    let range = headers.iter().find_map(|line| {
                        line.to_lowercase()
                            .strip_prefix("range: bytes=")
                            .map(|range| range.trim_end_matches('-').parse().unwrap())
                    });
                    let path = request.split(' ').nth(1).unwrap();
                    let from = range.unwrap_or(0);
                    if path == "/content" {
                        seen.lock().unwrap().push(from);
                    }
                    let (head, body) = answer(path, from, &base);
                    let _ = stream.write_all(format!("{head}\r\nConnection: close\r\n\r\n").as_bytes());
                    let _ = stream.write_all(&body);
                }
            });
            Self { address, ranges }
        }

        /// Answers as a real hub: a redirect with the checksum, then the content. `tag` is the stated checksum; the first transfer is cut after `cut`
        /// bytes.
        fn start(content: Vec<u8>, tag: String, mut cut: Option<usize>) -> Self {
            Self::answering(move |path, from, base| match path {
                "/someone/models/resolve/main/tiny.gguf" => (
                    format!(
                        "HTTP/1.1 302 Found\r\nLocation: {base}/content\r\nX-Linked-ETag: \"{tag}\"\r\nContent-Length: 0"
                    ),
                    Vec::new(),
                ),
                "/content" if from as usize >= content.len() => {
                    ("HTTP/1.1 416 Range Not Satisfiable\r\nContent-Length: 0".into(), Vec::new())
                }
                "/content" => {
                    let body = &content[from as usize..];
                    let head = match from {
                        0 => "HTTP/1.1 200 OK".to_owned(),
                        _ => format!(
                            "HTTP/1.1 206 Partial Content\r\nContent-Range: bytes {from}-{}/{}",
                            content.len() - 1,
                            content.len()
                        ),
                    };
                    let head = format!("{head}\r\nContent-Length: {}", body.len());
                    (head, body[..cut.take().unwrap_or(body.len())].to_vec())
                }
                _ => ("HTTP/1.1 404 Not Found\r\nContent-Length: 0".into(), Vec::new()),
            })
        }

        fn hub(&self, cache: &Path) -> Hub {
            Hub { endpoint: Some(self.address.clone()), cache: Some(cache.to_owned()), token: None }
        }
    }

    const TINY: Request<'static> = Request { repository: "someone/models", file: "tiny.gguf", sha256: None };

    fn pull(hub: &Hub, request: &Request<'_>) -> Result<Pulled, HubError> {
        hub.pull(request, &ProgressBar::hidden())
    }

    fn content() -> (Vec<u8>, String) {
        let content = include_bytes!("../tests/data/tiny.gguf").to_vec();
        let sum = hex::encode(Sha256::digest(&content));
        (content, sum)
    }

    fn files(folder: &Path) -> Vec<PathBuf> {
        let mut files = Vec::new();
        for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
            if entry.file_type().unwrap().is_dir() {
                files.extend(self::files(&entry.path()))
            } else {
                files.push(entry.path())
            }
        }
        files
    }

    #[test]
    fn a_model_arrives_and_is_checked() {
        let (content, sum) = content();
        let server = Server::start(content.clone(), sum.clone(), None);
        let cache = tempfile::tempdir().unwrap();
        let pulled = pull(&server.hub(cache.path()), &TINY).unwrap();
        assert_eq!(std::fs::read(&pulled.path).unwrap(), content);
        assert_eq!((pulled.sha256, pulled.pinned), (sum, false));
        assert_eq!(files(cache.path()), [cache.path().join("someone/models/tiny.gguf")]);
    }

    #[test]
    fn a_pinned_model_is_fetched_once() {
        let (content, sum) = content();
        let server = Server::start(content, sum.clone(), None);
        let cache = tempfile::tempdir().unwrap();
        let request = Request { sha256: Some(&sum), ..TINY };
        for _ in 0..2 {
            assert!(pull(&server.hub(cache.path()), &request).unwrap().pinned);
        }
        assert_eq!(*server.ranges.lock().unwrap(), [0]);
        let other = "0".repeat(64);
        let error = pull(&server.hub(cache.path()), &Request { sha256: Some(&other), ..TINY }).unwrap_err();
        assert!(matches!(error, HubError::Checksum { .. }), "{error}");
    }

    #[test]
    fn an_interrupted_download_is_continued() {
        let (content, sum) = content();
        let server = Server::start(content.clone(), sum, Some(100));
        let cache = tempfile::tempdir().unwrap();
        let hub = server.hub(cache.path());
        let error = pull(&hub, &TINY).unwrap_err().to_string();
        let here = format!("broke off after 100 of {} bytes: ", content.len());
        assert!(error.contains(&here) && error.ends_with("; run the command again to continue"), "{error}");
        let pulled = pull(&hub, &TINY).unwrap();
        assert_eq!(std::fs::read(&pulled.path).unwrap(), content);
        assert_eq!(*server.ranges.lock().unwrap(), [0, 100]);
    }

    /// A process that is killed between the last byte and the rename leaves such a file.
    #[test]
    fn a_download_that_is_whole_already_is_used() {
        let (content, sum) = content();
        for (rest, whole) in [(&content[100..], true), (&[7; 10_000][..], false)] {
            let server = Server::start(content.clone(), sum.clone(), Some(100));
            let cache = tempfile::tempdir().unwrap();
            let hub = server.hub(cache.path());
            pull(&hub, &TINY).unwrap_err();
            let part = files(cache.path()).pop().unwrap();
            OpenOptions::new().append(true).open(&part).unwrap().write_all(rest).unwrap();
            match pull(&hub, &TINY) {
                Ok(pulled) if whole => assert_eq!(std::fs::read(&pulled.path).unwrap(), content),
                Err(HubError::Refused { status: 416, .. }) if !whole => {}
                other => panic!("{other:?}"),
            }
            assert!(!part.exists());
        }
    }

    #[test]
    fn what_is_missing_is_named() {
        let (content, sum) = content();
        let server = Server::start(content, sum, None);
        let cache = tempfile::tempdir().unwrap();
        let error = pull(&server.hub(cache.path()), &Request { file: "Tiny.gguf", ..TINY }).unwrap_err().to_string();
        assert!(error.contains("404 for Tiny.gguf of someone/models"), "{error}");
        assert!(files(cache.path()).is_empty(), "nothing came, and nothing stays");
    }

    #[test]
    fn without_a_network_the_embedded_model_is_named() {
        // Bound and dropped: no server listens on this port.
        let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let cache = tempfile::tempdir().unwrap();
        let hub = Hub { endpoint: Some(format!("http://{address}")), cache: Some(cache.path().into()), token: None };
        let error = pull(&hub, &TINY).unwrap_err().to_string();
        assert!(error.contains("embedded household model"), "{error}");
    }

    #[test]
    fn names_cannot_leave_the_cache() {
        let hub = Hub::default();
        for (repository, file) in [
            ("someone", "a.gguf"),
            ("../x", "a.gguf"),
            ("a/b/c", "a.gguf"),
            ("a/b", "../a.gguf"),
            ("a/b", "/etc/passwd"),
            ("a/b", ""),
        ] {
            let error = pull(&hub, &Request { repository, file, sha256: None });
            assert!(matches!(error, Err(HubError::Name { .. })), "{repository} {file}");
        }
    }

    #[test]
    fn only_tls_leaves_this_machine() {
        for endpoint in ["http://example.com", "http://10.0.0.1", "ftp://example.com", "file:///etc", "example.com", ""]
        {
            let hub = Hub { endpoint: Some(endpoint.into()), cache: None, token: None };
            assert!(matches!(pull(&hub, &TINY), Err(HubError::Name { .. })), "{endpoint}");
        }
        let from = "https://hub.example/a".parse().unwrap();
        assert!(redirect(&from, "https://other.example/b").is_some());
        assert_eq!(redirect(&from, "/b").unwrap(), "https://hub.example/b");
        for target in ["http://hub.example/b", "http://127.0.0.1/b", "//other.example/b", "file:///etc/passwd", "b", ""]
        {
            assert!(redirect(&from, target).is_none(), "{target}");
        }
    }

    #[test]
    fn a_folder_that_others_may_write_to_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let cache = tempfile::tempdir().unwrap();
        let folder = cache.path().join("someone/models");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::set_permissions(&folder, PermissionsExt::from_mode(0o777)).unwrap();
        let hub = Hub { endpoint: Some("http://127.0.0.1:9".into()), cache: Some(cache.path().into()), token: None };
        assert!(matches!(pull(&hub, &TINY), Err(HubError::Shared(_))));
        // A folder is refused too if others may rename it.
        std::fs::set_permissions(&folder, PermissionsExt::from_mode(0o700)).unwrap();
        private_folder(&folder).unwrap();
        std::fs::set_permissions(cache.path().join("someone"), PermissionsExt::from_mode(0o777)).unwrap();
        assert!(matches!(private_folder(&folder), Err(HubError::Shared(_))));
    }

    #[test]
    fn nothing_is_kept_of_a_damaged_file() {
        let (mut content, sum) = content();
        let last = content.len() - 1;
        content[last] ^= 1;
        let server = Server::start(content, sum.clone(), None);
        let cache = tempfile::tempdir().unwrap();
        let Err(HubError::Checksum { wanted, .. }) = pull(&server.hub(cache.path()), &TINY) else {
            panic!("a damaged file must be refused");
        };
        assert_eq!(wanted, sum);
        assert!(files(cache.path()).is_empty());
    }

    /// Regression: the first release checked one answer and used the next, with a path as its tag. It could write any file of the user.
    #[test]
    fn a_second_answer_cannot_choose_the_path() {
        let outside = tempfile::tempdir().unwrap();
        let victim = outside.path().join("victim");
        std::fs::write(&victim, "precious").unwrap();
        let (content, sum) = content();
        let (tag, mut asked) = (victim.display().to_string(), 0);
        let server = Server::answering(move |path, _, base| {
            if path == "/content" {
                return (
                    format!("HTTP/1.1 200 OK\r\nETag: \"{tag}\"\r\nContent-Length: {}", content.len()),
                    content.clone(),
                );
            }
            asked += 1;
            let tag = if asked == 1 { &sum } else { &tag };
            (
                format!(
                    "HTTP/1.1 302 Found\r\nLocation: {base}/content\r\nX-Linked-ETag: \"{tag}\"\r\nX-Repo-Commit: {tag}\r\nContent-Length: 0"
                ),
                Vec::new(),
            )
        });
        let cache = tempfile::tempdir().unwrap();
        for _ in 0..2 {
            let _ = pull(&server.hub(cache.path()), &TINY);
            assert_eq!(std::fs::read_to_string(&victim).unwrap(), "precious");
        }
        assert_eq!(files(cache.path()).iter().filter(|path| path.extension().is_some_and(|e| e == "gguf")).count(), 1);
    }

    /// Hubs with false headers, by seed. No file outside the cache may change, and a file with its final name has the requested checksum.
    #[test]
    fn hostile_hubs_write_nothing_but_what_was_asked_for() {
        let outside = tempfile::tempdir().unwrap();
        let victim = outside.path().join("victim");
        std::fs::write(&victim, "precious").unwrap();
        let (good, sum) = content();
        let mut arrived = 0;
        for seed in 0..300 {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let (good, sum, path) = (good.clone(), sum.clone(), victim.display().to_string());
            let wanted = sum.clone();
            let server = Server::answering(move |_, from, base| {
                let one = |random: &mut ChaCha8Rng, texts: &[&str]| (*texts.choose(random).unwrap()).to_owned();
                let status = one(
                    &mut random,
                    &[
                        "200 OK",
                        "200 OK",
                        "206 Partial Content",
                        "302 Found",
                        "307 Moved",
                        "304 Same",
                        "404 No",
                        "416 No",
                        "500 No",
                        "999 ?",
                    ],
                );
                let mut head = format!("HTTP/1.1 {status}");
                let names = ["../../victim", &path, &sum, &sum, &sum, "", "/", "\"", &"a".repeat(70_000)];
                for header in ["ETag", "X-Linked-ETag", "X-Repo-Commit"] {
                    if random.random_bool(0.8) {
                        head += &format!("\r\n{header}: \"{}\"", one(&mut random, &names));
                    }
                }
                let here = format!("{base}/content");
                head += &format!(
                    "\r\nLocation: {}",
                    one(
                        &mut random,
                        &[&here, &here, "file:///etc/passwd", &path, "http://example.invalid/", "//x", "\u{1}"]
                    )
                );
                let whole = good.len().to_string();
                head += &format!(
                    "\r\nX-Linked-Size: {}",
                    one(&mut random, &[&whole, &whole, "18446744073709551615", "-1", "0"])
                );
                let range = format!("{from}-/{whole}");
                head += &format!(
                    "\r\nContent-Range: bytes {}",
                    one(&mut random, &[&range, "0-0/1", "5-4/9", "18446744073709551615-/18446744073709551615", "x"])
                );
                let mut body = good[(from as usize).min(good.len())..].to_vec();
                if random.random_bool(0.2) && !body.is_empty() {
                    let at = random.random_range(0..body.len());
                    body[at] ^= 1;
                }
                if random.random_bool(0.2) {
                    body.truncate(body.len() / 2);
                }
                head += &format!("\r\nContent-Length: {}", body.len());
                (head, body)
            });
            let cache = tempfile::tempdir().unwrap();
            for pin in [None, Some(wanted.as_str())] {
                let request = Request { sha256: pin, ..TINY };
                if let Ok(pulled) = pull(&server.hub(cache.path()), &request) {
                    arrived += 1;
                    assert_eq!(hex::encode(file_sha256(&pulled.path).unwrap()), wanted, "seed {seed}");
                }
                assert_eq!(std::fs::read_to_string(&victim).unwrap(), "precious", "seed {seed}");
                for path in files(cache.path()) {
                    let name = path.file_name().unwrap().to_str().unwrap();
                    assert!(
                        name == "tiny.gguf" || name.starts_with('.') && name.ends_with(".part"),
                        "seed {seed}: {path:?}"
                    );
                    assert!(name != "tiny.gguf" || hex::encode(file_sha256(&path).unwrap()) == wanted, "seed {seed}");
                }
            }
        }
        assert_eq!(files(outside.path()), [victim]);
        // The test is worthless unless some of its hubs are accepted.
        assert!(arrived > 10, "{arrived}");
    }
}
