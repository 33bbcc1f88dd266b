//! Errors between processes.

use std::fmt;
use std::path::PathBuf;

/// A malformed message. The receiver counts and drops it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MessageError {
    /// The text is too long.
    #[error("{field}: text of {bytes} bytes, at most {limit} fit; shorten it")]
    TextTooLong {
        /// The field.
        field: &'static str,
        /// The length of the text.
        bytes: usize,
        /// The greatest length.
        limit: usize,
    },
    /// The text is empty, and the field needs one.
    #[error("{field}: empty")]
    Empty {
        /// The field.
        field: &'static str,
    },
    /// The bytes are not UTF-8.
    #[error("{field}: not UTF-8 from byte {at} on")]
    NotUtf8 {
        /// The field.
        field: &'static str,
        /// The first bad byte.
        at: usize,
    },
    /// A control character, or a character that makes text look like other text.
    #[error("{field}: control character U+{code_point:04X} at byte {at}")]
    ControlCharacter {
        /// The field.
        field: &'static str,
        /// The byte where the character begins.
        at: usize,
        /// The character.
        code_point: u32,
    },
    /// Bytes after the end of the text are not zero.
    #[error("{field}: bytes after the end of the text are not zero")]
    Untidy {
        /// The field.
        field: &'static str,
    },
    /// A list of names holds the same name twice.
    #[error("{field}: the same one twice")]
    Twice {
        /// The field.
        field: &'static str,
    },
    /// A number outside what the field allows.
    #[error("{field}: {value}, allowed is {allowed}")]
    OutOfRange {
        /// The field.
        field: &'static str,
        /// The number.
        value: f64,
        /// The range that the field allows, in words.
        allowed: &'static str,
    },
}

/// The error of iceoryx2 or of the system that caused an [`IpcError`].
pub type Cause = Box<dyn std::error::Error + Send + Sync>;

/// A service, port or domain cannot be used. `Debug` prints the text for people, so `fn main() -> Result<(), Error>` shows the remedy.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum IpcError {
    /// The domain's name cannot be part of a file name.
    #[error("domain name {name:?}: use 1 to {limit} characters of a-z, 0-9 and '-'")]
    BadDomainName {
        /// The name.
        name: String,
        /// The most characters.
        limit: usize,
    },
    /// The domain's root path is not usable.
    #[error("domain root {}: {problem}", path.display())]
    BadRoot {
        /// The path.
        path: PathBuf,
        /// The problem, and the remedy.
        problem: String,
        /// The system's error, if one is the reason.
        #[source]
        cause: Option<Cause>,
    },
    /// Another user owns a file with this domain's prefix in shared memory.
    #[error(
        "{} belongs to user {owner}, who could read and write it: have it removed, or use another domain name", file.display()
    )]
    ForeignSharedMemory {
        /// The file.
        file: PathBuf,
        /// Its owner's user id.
        owner: u32,
    },
    /// Too little shared memory is free.
    #[error(
        "/dev/shm has {free_bytes} bytes free, {needed_bytes} are needed: remove what fills it, or mount it larger"
    )]
    SharedMemoryFull {
        /// Free shared memory, in bytes.
        free_bytes: u64,
        /// Needed shared memory, in bytes.
        needed_bytes: u64,
    },
    /// The limit on file sizes is too low for shared memory, which consists of files.
    #[error(
        "files may have at most {limit_bytes} bytes here, and shared memory takes up to {needed_bytes}: raise the limit (ulimit -f, LimitFSIZE=)"
    )]
    FilesLimited {
        /// The limit, in bytes.
        limit_bytes: u64,
        /// Needed file size, in bytes.
        needed_bytes: u64,
    },
    /// The node, a participant's entry in the domain, could not be created.
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
    /// Another version of iceoryx2 created the service.
    #[error(
        "service {service}: made with iceoryx2 {theirs}, this program has iceoryx2 {ours}; every participant of a domain must have exactly the same version"
    )]
    VersionMismatch {
        /// Service name.
        service: &'static str,
        /// The version of the other side, if it could be found.
        theirs: String,
        /// [`crate::ICEORYX2_VERSION`].
        ours: &'static str,
    },
    /// All places of the service are taken.
    #[error(
        "{holder} {} here already, and {service} takes {limit} {role}{} in a domain: stop one first, or use another domain",
        if *.limit == 1 { "is" } else { "are" }, if *.limit == 1 { "" } else { "s" }
    )]
    Occupied {
        /// Service name.
        service: &'static str,
        /// The participants that have the places, by name and process, as far as known.
        holder: String,
        /// `publisher`, `subscriber`, `server` or `client`.
        role: &'static str,
        /// The number of places.
        limit: usize,
    },
    /// Another live participant has this name.
    #[error(
        "{holder} is here already, and there can be one of that name; stop it first, give this one another name, or use another domain"
    )]
    NameTaken {
        /// Name and process of the other participant.
        holder: String,
    },
    /// The service could not be opened in time.
    #[error("service {service}: cannot open it: {cause}; tried for {tried_ms} ms")]
    Open {
        /// Service name.
        service: &'static str,
        /// iceoryx2's error.
        #[source]
        cause: Cause,
        /// The time spent on it.
        tried_ms: u128,
    },
    /// The service could not be opened, and this process is close to its limit of open files.
    #[error(
        "service {service}: cannot open it: {open} files are open in this process, of at most {limit}: raise the limit (ulimit -n, LimitNOFILE=)"
    )]
    TooManyFiles {
        /// Service name.
        service: &'static str,
        /// Open files.
        open: u64,
        /// The limit.
        limit: u64,
    },
    /// The service could not be opened, and this process is close to its limit of address space.
    #[error(
        "service {service}: cannot open it: this process has {used_bytes} bytes of address space, of at most {limit_bytes}: raise the limit (ulimit -v, LimitAS=)"
    )]
    TooLittleAddressSpace {
        /// Service name.
        service: &'static str,
        /// Address space of the process, in bytes.
        used_bytes: u64,
        /// The limit, in bytes.
        limit_bytes: u64,
    },
    /// A port failed while in use.
    #[error("service {service}: {operation} failed: {cause}")]
    Port {
        /// Service name.
        service: &'static str,
        /// The operation that failed, such as `send`, `receive`, `wait` or `connect`.
        operation: &'static str,
        /// The error of iceoryx2 or of the system.
        #[source]
        cause: Cause,
    },
    /// The program tried to send a malformed message.
    #[error("service {service}: refused to send: {source}")]
    Refused {
        /// Service name.
        service: &'static str,
        /// The fault.
        #[source]
        source: MessageError,
    },
    /// The daemon received the question and gave a reason instead of an answer.
    #[error("service {service}: {reason}")]
    NotGiven {
        /// Service name.
        service: &'static str,
        /// The reason, and the remedy.
        reason: String,
    },
    /// An argument that fits no message.
    #[error("{0}")]
    Argument(String),
    /// The daemon's scores do not contain an event.
    #[error(
        "narrator {narrator:?}: {problem}: of {sent} events {under_way} are under way, and the daemon dropped {dropped}; does the daemon run in this domain? Its log and its status say why it drops events"
    )]
    NotIncluded {
        /// The narrator's name.
        narrator: String,
        /// The missing part.
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
    /// No daemon answered.
    #[error(
        "no daemon of this domain has answered within {waited_ms} ms ({service}): start `roomcast daemon`, or give its --root and --domain"
    )]
    NoAnswer {
        /// Service name.
        service: &'static str,
        /// The time waited.
        waited_ms: u128,
    },
}

impl fmt::Debug for IpcError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}
