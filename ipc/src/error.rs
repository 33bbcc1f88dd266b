//! What can go wrong between processes.

use std::fmt;
use std::path::PathBuf;

/// A message that says something which no honest sender says. It is counted and dropped; nothing else happens.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MessageError {
    /// The text does not fit.
    #[error("{field}: text of {bytes} bytes, at most {limit} fit; shorten it")]
    TextTooLong {
        /// Which field.
        field: &'static str,
        /// What was given.
        bytes: usize,
        /// What fits.
        limit: usize,
    },
    /// The text is empty where there must be one.
    #[error("{field}: empty")]
    Empty {
        /// Which field.
        field: &'static str,
    },
    /// The bytes are not UTF-8.
    #[error("{field}: not UTF-8 from byte {at} on")]
    NotUtf8 {
        /// Which field.
        field: &'static str,
        /// First bad byte.
        at: usize,
    },
    /// A control character, or one that makes text look like other text.
    #[error("{field}: control character U+{code_point:04X} at byte {at}")]
    ControlCharacter {
        /// Which field.
        field: &'static str,
        /// Where.
        at: usize,
        /// Which.
        code_point: u32,
    },
    /// Bytes after the end of the text are not zero.
    #[error("{field}: bytes after the end of the text are not zero")]
    Untidy {
        /// Which field.
        field: &'static str,
    },
    /// A list of names holds the same name twice.
    #[error("{field}: the same one twice")]
    Twice {
        /// Which field.
        field: &'static str,
    },
    /// A number outside what the field allows.
    #[error("{field}: {value}, allowed is {allowed}")]
    OutOfRange {
        /// Which field.
        field: &'static str,
        /// What was given.
        value: f64,
        /// In words.
        allowed: &'static str,
    },
}

/// An error of iceoryx2's or of the system, below one of this crate's.
pub type Cause = Box<dyn std::error::Error + Send + Sync>;

/// A service, port or domain that cannot be used. Its `Debug` is the text for people, so that `fn main() -> Result<(), Error>` shows the remedy.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum IpcError {
    /// The domain's name cannot be part of a file name.
    #[error("domain name {name:?}: use 1 to {limit} characters of a-z, 0-9 and '-'")]
    BadDomainName {
        /// What was given.
        name: String,
        /// Most characters.
        limit: usize,
    },
    /// The domain's root path is not usable.
    #[error("domain root {}: {problem}", path.display())]
    BadRoot {
        /// Which path.
        path: PathBuf,
        /// What is wrong, and the remedy.
        problem: String,
        /// The system's error, if one is the reason.
        #[source]
        cause: Option<Cause>,
    },
    /// Another user has made a file of the domain's name in shared memory.
    #[error(
        "{} belongs to user {owner}, who could read and write it: have it removed, or use another domain name", file.display()
    )]
    ForeignSharedMemory {
        /// The file.
        file: PathBuf,
        /// Its owner's user id.
        owner: u32,
    },
    /// There is not enough shared memory left.
    #[error(
        "/dev/shm has {free_bytes} bytes free, {needed_bytes} are needed: remove what fills it, or mount it larger"
    )]
    SharedMemoryFull {
        /// What is left, in bytes.
        free_bytes: u64,
        /// What is needed, in bytes.
        needed_bytes: u64,
    },
    /// Files, of which shared memory is made, may not become large enough.
    #[error(
        "files may have at most {limit_bytes} bytes here, and shared memory takes up to {needed_bytes}: raise the limit (ulimit -f, LimitFSIZE=)"
    )]
    FilesLimited {
        /// The limit, in bytes.
        limit_bytes: u64,
        /// What is needed, in bytes.
        needed_bytes: u64,
    },
    /// The node, a participant's entry in the domain, could not be made.
    #[error("cannot join the domain at {}: {cause}; is {} writable and has /dev/shm space left?", root.display(), root.display())]
    Join {
        /// The domain's root path.
        root: PathBuf,
        /// iceoryx2's error.
        #[source]
        cause: Cause,
    },
    /// The service exists with other message types.
    #[error(
        "service {service}: it carries {theirs}, this program speaks {ours}; stop the program of the other version, or use one version throughout"
    )]
    TypeMismatch {
        /// Service name.
        service: &'static str,
        /// Type and size that the running service has.
        theirs: String,
        /// Type and size that this program has.
        ours: String,
    },
    /// The service was made by another version of iceoryx2.
    #[error(
        "service {service}: made with iceoryx2 {theirs}, this program has iceoryx2 {ours}; every participant of a domain must have exactly the same version"
    )]
    VersionMismatch {
        /// Service name.
        service: &'static str,
        /// What could be found out about the other side.
        theirs: String,
        /// [`crate::ICEORYX2_VERSION`].
        ours: &'static str,
    },
    /// Others hold all places.
    #[error(
        "{holder} {} here already, and {service} takes {limit} {role}{} in a domain: stop one first, or use another domain",
        if *.limit == 1 { "is" } else { "are" }, if *.limit == 1 { "" } else { "s" }
    )]
    Occupied {
        /// Service name.
        service: &'static str,
        /// Who, as far as known, by name and process.
        holder: String,
        /// "publisher", "subscriber", "server", "client".
        role: &'static str,
        /// How many places there are.
        limit: usize,
    },
    /// Another participant of this name is alive.
    #[error(
        "{holder} is here already, and there can be one of that name; stop it first, give this one another name, or use another domain"
    )]
    NameTaken {
        /// Name and process of the other.
        holder: String,
    },
    /// The service could not be opened within the time allowed for it.
    #[error("service {service}: cannot open it: {cause}; tried for {tried_ms} ms")]
    Open {
        /// Service name.
        service: &'static str,
        /// iceoryx2's error.
        #[source]
        cause: Cause,
        /// How long it was tried.
        tried_ms: u128,
    },
    /// The service could not be opened, and hardly a file more may be open in this process.
    #[error(
        "service {service}: cannot open it: {open} files are open in this process, of at most {limit}: raise the limit (ulimit -n, LimitNOFILE=)"
    )]
    TooManyFiles {
        /// Service name.
        service: &'static str,
        /// How many are open.
        open: u64,
        /// How many may be.
        limit: u64,
    },
    /// The service could not be opened, and hardly more address space is left to this process.
    #[error(
        "service {service}: cannot open it: this process has {used_bytes} bytes of address space, of at most {limit_bytes}: raise the limit (ulimit -v, LimitAS=)"
    )]
    TooLittleAddressSpace {
        /// Service name.
        service: &'static str,
        /// What the process has, in bytes.
        used_bytes: u64,
        /// What it may have, in bytes.
        limit_bytes: u64,
    },
    /// A port failed while in use.
    #[error("service {service}: {operation} failed: {cause}")]
    Port {
        /// Service name.
        service: &'static str,
        /// "send", "receive", "wait", "connect".
        operation: &'static str,
        /// iceoryx2's error, or the system's.
        #[source]
        cause: Cause,
    },
    /// What was to be sent is malformed.
    #[error("service {service}: refused to send: {source}")]
    Refused {
        /// Service name.
        service: &'static str,
        /// Why.
        #[source]
        source: MessageError,
    },
    /// The daemon has an answer and cannot give it.
    #[error("service {service}: {reason}")]
    NotGiven {
        /// Service name.
        service: &'static str,
        /// Why, and what to do.
        reason: String,
    },
    /// An argument that no message can have.
    #[error("{0}")]
    Argument(String),
    /// The daemon's scores do not contain an event.
    #[error(
        "narrator {narrator:?}: {problem}: of {sent} events {under_way} are under way, and the daemon dropped {dropped}; does the daemon run in this domain? Its log and its status say why it drops events"
    )]
    NotIncluded {
        /// The narrator's name.
        narrator: String,
        /// What is missing.
        problem: &'static str,
        /// Events that the daemon has not dealt with.
        under_way: u64,
        /// Events that the daemon dropped.
        dropped: u64,
        /// Events that were sent.
        sent: u64,
    },
    /// The answer cannot be read.
    #[error("service {service}: the answer cannot be read: {source}; use one version of Roomcast throughout")]
    Answer {
        /// Service name.
        service: &'static str,
        /// The fault.
        source: serde_json::Error,
    },
    /// Nobody answered.
    #[error(
        "no daemon of this domain has answered within {waited_ms} ms ({service}): start `roomcast daemon`, or give its --root and --domain"
    )]
    NoAnswer {
        /// Service name.
        service: &'static str,
        /// How long was waited.
        waited_ms: u128,
    },
}

impl fmt::Debug for IpcError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}
