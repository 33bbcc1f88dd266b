//! Fetches GGUF models from a model hub (Hugging Face, or a server that speaks its protocol) into the user's cache.
//!
//! The client crate `hf-hub` does the protocol, the cache layout that other tools share, and resuming; here the answer is checked
//! before it is believed: names before they become paths, the SHA-256 that the hub states, and the header of the model.

use std::fs::File;
use std::io::Read;
use std::path::{Component, Path, PathBuf};

use hf_hub::api::Progress;
use hf_hub::api::sync::{ApiBuilder, ApiError};
use hf_hub::{Cache, Repo, RepoType};
use sha2::{Digest, Sha256};

use crate::gguf::{GgufError, Header};

/// The hub that is asked when no other is named.
pub const ENDPOINT_DEFAULT: &str = "https://huggingface.co";

/// Why a model could not be fetched.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// A repository or file name that is none.
    #[error(
        "{given:?} is no {expected}; for example: roomcast model pull HuggingFaceTB/SmolLM2-135M-Instruct-GGUF smollm2-135m-instruct-q8_0.gguf"
    )]
    Name {
        /// What was given.
        given: String,
        /// What was expected in its place.
        expected: &'static str,
    },
    /// The hub cannot be reached.
    #[error(
        "failed to reach {endpoint}: {reason}; without a network use the embedded household model, which every command does when no --model is given"
    )]
    Unreachable {
        /// The hub's address.
        endpoint: String,
        /// What the connection said.
        reason: String,
    },
    /// The hub refused.
    #[error("{endpoint} answered {status} for {file} of {repository}: {remedy}")]
    Refused {
        /// The hub's address.
        endpoint: String,
        /// HTTP status.
        status: u16,
        /// The repository asked for.
        repository: String,
        /// The file asked for.
        file: String,
        /// What to do about it.
        remedy: &'static str,
    },
    /// The hub's answer makes no sense.
    #[error(
        "{endpoint} does not answer as a model hub does: {reason}; check the address given by --endpoint or HF_ENDPOINT"
    )]
    Protocol {
        /// The hub's address.
        endpoint: String,
        /// What is wrong with the answer.
        reason: String,
    },
    /// The file that arrived is not the file that the hub described; it has been deleted.
    #[error(
        "{path} arrived damaged: its SHA-256 is {found}, the hub states {stated}; it has been deleted, run the command again"
    )]
    Checksum {
        /// Where the file was.
        path: PathBuf,
        /// The checksum of what arrived.
        found: String,
        /// The checksum that the hub stated.
        stated: String,
    },
    /// Another process downloads the same file.
    #[error("another process is downloading this file (lock {0}); wait for it, or delete the lock if there is none")]
    Locked(PathBuf),
    /// The cache cannot be written, or a file in it cannot be read.
    #[error(
        "failed to use the cache: {0}; check that there is room and that it may be written, or choose another by --cache"
    )]
    Cache(#[from] std::io::Error),
    /// The file arrived whole, but it is no model that can be used.
    #[error(transparent)]
    Model(#[from] GgufError),
}

/// Which hub, and which cache.
#[derive(Debug, Clone, Default)]
pub struct Hub {
    /// The hub's address, without a slash at the end; [`ENDPOINT_DEFAULT`] where none is given.
    pub endpoint: Option<String>,
    /// The cache's folder; the one that other tools of the hub share (`~/.cache/huggingface/hub`) where none is given.
    pub cache: Option<PathBuf>,
}

/// A model that is in the cache.
#[derive(Debug)]
pub struct Pulled {
    /// Its path in the cache.
    pub path: PathBuf,
    /// Its checksum in hexadecimal.
    pub sha256: String,
    /// Whether the hub stated a SHA-256 to compare with (it does for every file in large-file storage); it was equal.
    pub verified: bool,
    /// The model's header, checked.
    pub header: Header,
}

/// The SHA-256 of a file, in hexadecimal.
///
/// # Errors
///
/// The system's, where the file cannot be read.
pub fn sha256_of(path: &Path) -> std::io::Result<String> {
    let mut file = File::open(path)?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 16];
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(hex(&hasher.finalize())),
            length => hasher.update(&buffer[..length]),
        }
    }
}

/// Bytes in lower-case hexadecimal.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn is_name(name: &str) -> bool {
    !name.is_empty()
        && !name.starts_with('.')
        && name.len() <= 128
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"._-".contains(&byte))
}

impl Hub {
    /// Downloads `file` of `repository` (`owner/name`), or takes up an interrupted download, and checks what arrived.
    ///
    /// # Errors
    ///
    /// [`HubError`]; an interrupted download stays in the cache and is taken up by the next call.
    pub fn pull(&self, repository: &str, file: &str, progress: impl Progress) -> Result<Pulled, HubError> {
        if !repository.split_once('/').is_some_and(|(owner, name)| is_name(owner) && is_name(name)) {
            return Err(HubError::Name { given: repository.into(), expected: "repository (owner/name)" });
        }
        let plain = Path::new(file).components().all(|part| matches!(part, Component::Normal(_)));
        if !plain || !file.split('/').all(is_name) {
            return Err(HubError::Name { given: file.into(), expected: "file in a repository" });
        }
        let endpoint = self.endpoint.as_deref().unwrap_or(ENDPOINT_DEFAULT).trim_end_matches('/').to_owned();
        let cache = self.cache.clone().map_or_else(Cache::from_env, Cache::new);
        let fail = |error| explain(error, &endpoint, repository, file);

        let api = ApiBuilder::from_cache(cache).with_endpoint(endpoint.clone()).build().map_err(fail)?;
        let model = api.repo(Repo::new(repository.into(), RepoType::Model));
        // Both become file names in the cache, so they are checked before the client uses them.
        let about = api.metadata(&model.url(file)).map_err(fail)?;
        if !is_name(about.etag()) || !is_name(about.commit_hash()) {
            let reason = format!("the tag {:?} or the commit {:?} is no plain name", about.etag(), about.commit_hash());
            return Err(HubError::Protocol { endpoint, reason });
        }
        let path = model.download_with_progress(file, progress).map_err(fail)?;
        let sha256 = sha256_of(&path)?;
        let verified = about.etag().len() == 64 && about.etag().bytes().all(|byte| byte.is_ascii_hexdigit());
        if verified && !about.etag().eq_ignore_ascii_case(&sha256) {
            // The name in the snapshot is a link to the content; both go, so that the next call starts afresh.
            let content = path.canonicalize()?;
            std::fs::remove_file(&path)?;
            std::fs::remove_file(content)?;
            return Err(HubError::Checksum { path, found: sha256, stated: about.etag().into() });
        }
        let header = Header::read_language_model(&path)?;
        Ok(Pulled { path, sha256, verified, header })
    }
}

fn explain(error: ApiError, endpoint: &str, repository: &str, file: &str) -> HubError {
    let endpoint = endpoint.to_owned();
    match error {
        ApiError::RequestError(request) => match *request {
            ureq::Error::StatusCode(status) => {
                let remedy = match status {
                    401 | 403 => {
                        "the repository is private, gated, or does not exist; accept its terms on the hub and store a token with its own tool"
                    }
                    404 => "there is no such repository or file; file names are case-sensitive",
                    416 => "the interrupted download in the cache is longer than the file; delete the .part file there",
                    429 => "too many requests; wait a while",
                    _ => "try again later",
                };
                HubError::Refused { endpoint, status, repository: repository.into(), file: file.into(), remedy }
            }
            other => HubError::Unreachable { endpoint, reason: other.to_string() },
        },
        // The body's bytes come through the same kind of error as the cache's: an early end is the connection's.
        ApiError::IoError(error) => match error.kind() {
            std::io::ErrorKind::PermissionDenied
            | std::io::ErrorKind::StorageFull
            | std::io::ErrorKind::NotFound
            | std::io::ErrorKind::ReadOnlyFilesystem => HubError::Cache(error),
            _ => HubError::Unreachable { endpoint, reason: error.to_string() },
        },
        ApiError::LockAcquisition(lock) => HubError::Locked(lock),
        other => HubError::Protocol { endpoint, reason: other.to_string() },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{BufRead, BufReader, Write};
    use std::net::TcpListener;
    use std::sync::{Arc, Mutex};

    const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";

    /// A hub on loopback that holds one file, and answers as the real one does: a redirect that carries tag and commit, then the
    /// content by ranges.
    struct Server {
        address: String,
        ranges: Arc<Mutex<Vec<u64>>>,
    }

    impl Server {
        /// Serves `content`, states `tag` as its checksum, and cuts the first transfer of the content after `cut` bytes.
        fn start(content: Vec<u8>, tag: String, cut: Option<usize>) -> Self {
            let listener = TcpListener::bind("127.0.0.1:0").unwrap();
            let address = format!("http://{}", listener.local_addr().unwrap());
            let ranges = Arc::new(Mutex::new(Vec::new()));
            let (seen, base) = (Arc::clone(&ranges), address.clone());
            std::thread::spawn(move || {
                let mut cut = cut;
                for stream in listener.incoming() {
                    let mut stream = stream.unwrap();
                    let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
                    let request = lines.next().unwrap().unwrap();
                    let headers: Vec<_> = lines.map_while(Result::ok).take_while(|line| !line.is_empty()).collect();
                    let range = headers
                        .iter()
                        .find_map(|line| line.to_lowercase().strip_prefix("range: bytes=").map(String::from));
                    let head = match request.split(' ').nth(1).unwrap() {
                        "/someone/models/resolve/main/tiny.gguf" => format!(
                            "HTTP/1.1 302 Found\r\nLocation: {base}/content\r\nX-Linked-ETag: \"{tag}\"\r\nX-Repo-Commit: {COMMIT}\r\nContent-Length: 0"
                        ),
                        "/content" => {
                            let (from, to) = range.as_ref().unwrap().split_once('-').unwrap();
                            let from: usize = from.parse().unwrap();
                            let end = to.parse::<usize>().map_or(content.len(), |to| to + 1);
                            let mut body = &content[from..end];
                            let head = format!(
                                "HTTP/1.1 206 Partial Content\r\nContent-Range: bytes {from}-{}/{}\r\nContent-Length: {}",
                                end - 1,
                                content.len(),
                                body.len()
                            );
                            if to.is_empty() {
                                seen.lock().unwrap().push(from as u64);
                                body = &body[..cut.take().unwrap_or(body.len())];
                            }
                            stream.write_all(format!("{head}\r\nConnection: close\r\n\r\n").as_bytes()).unwrap();
                            stream.write_all(body).unwrap();
                            continue;
                        }
                        _ => "HTTP/1.1 404 Not Found\r\nContent-Length: 0".into(),
                    };
                    stream.write_all(format!("{head}\r\nConnection: close\r\n\r\n").as_bytes()).unwrap();
                }
            });
            Self { address, ranges }
        }

        fn hub(&self, cache: &Path) -> Hub {
            Hub { endpoint: Some(self.address.clone()), cache: Some(cache.to_owned()) }
        }
    }

    fn content() -> (Vec<u8>, String) {
        let content = crate::gguf::tests::tiny(&["a", "b", "c"]);
        let sum = hex(&Sha256::digest(&content));
        (content, sum)
    }

    #[test]
    fn a_model_arrives_and_is_checked() {
        let (content, sum) = content();
        let server = Server::start(content.clone(), sum.clone(), None);
        let cache = tempfile::tempdir().unwrap();
        let pulled = server.hub(cache.path()).pull("someone/models", "tiny.gguf", ()).unwrap();
        assert_eq!(std::fs::read(&pulled.path).unwrap(), content);
        assert_eq!((pulled.sha256, pulled.verified), (sum, true));
        assert!(pulled.path.starts_with(cache.path()));
    }

    #[test]
    fn an_interrupted_download_is_taken_up() {
        let (content, sum) = content();
        let server = Server::start(content.clone(), sum, Some(100));
        let cache = tempfile::tempdir().unwrap();
        let hub = server.hub(cache.path());
        let error = hub.pull("someone/models", "tiny.gguf", ()).unwrap_err();
        assert!(matches!(error, HubError::Unreachable { .. }), "{error}");
        let pulled = hub.pull("someone/models", "tiny.gguf", ()).unwrap();
        assert_eq!(std::fs::read(&pulled.path).unwrap(), content);
        assert_eq!(*server.ranges.lock().unwrap(), [0, 100]);
    }

    #[test]
    fn a_damaged_file_is_deleted() {
        let (mut content, sum) = content();
        let last = content.len() - 1;
        content[last] ^= 1;
        let server = Server::start(content, sum.clone(), None);
        let cache = tempfile::tempdir().unwrap();
        let Err(HubError::Checksum { path, stated, .. }) =
            server.hub(cache.path()).pull("someone/models", "tiny.gguf", ())
        else {
            panic!("a damaged file must be refused");
        };
        assert_eq!(stated, sum);
        assert!(!path.exists() && std::fs::symlink_metadata(path).is_err());
    }

    #[test]
    fn what_is_missing_is_named() {
        let (content, sum) = content();
        let server = Server::start(content, sum, None);
        let cache = tempfile::tempdir().unwrap();
        let error = server.hub(cache.path()).pull("someone/models", "Tiny.gguf", ()).unwrap_err().to_string();
        assert!(error.contains("404 for Tiny.gguf of someone/models"), "{error}");
    }

    #[test]
    fn without_a_network_the_embedded_model_is_named() {
        // Bound and dropped: a port on which nobody listens.
        let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let cache = tempfile::tempdir().unwrap();
        let hub = Hub { endpoint: Some(format!("http://{address}")), cache: Some(cache.path().into()) };
        let error = hub.pull("someone/models", "tiny.gguf", ()).unwrap_err().to_string();
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
            assert!(matches!(hub.pull(repository, file, ()), Err(HubError::Name { .. })), "{repository} {file}");
        }
        let server = Server::start(content().0, "../../../../escape".into(), None);
        let cache = tempfile::tempdir().unwrap();
        let error = server.hub(cache.path()).pull("someone/models", "tiny.gguf", ()).unwrap_err();
        assert!(matches!(error, HubError::Protocol { .. }), "{error}");
    }
}
