//! Domains: a root path, a name, and the nodes that join.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};
use std::{env, fs, io};

use iceoryx2::config::Config;
use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::node::NodeDetails;
use iceoryx2::prelude::{
    CallbackProgression, FileName, LogLevel, NodeBuilder, NodeName, NodeState, SemanticString, SignalHandlingMode,
};
use iceoryx2::service::internal::ServiceInternal;
use iceoryx2::service::ipc_threadsafe;
use iceoryx2::service::service_hash::ServiceHash;
use rustix::fs::{FlockOperation, Mode, OFlags};
use rustix::io::Errno;
use rustix::process::{Pid, geteuid, test_kill_process};
use serde::Deserialize;
use serde::de::value::{Error as ValueError, SeqDeserializer};

use crate::error::Cause;
use crate::{IpcError, clock};

mod guards;
mod node;

use guards::{LastOut, Only, Watch};
pub use node::Node;
use node::{refuse_too_little_memory, too_many_files};

/// iceoryx2's variant that is used throughout: shared memory, and ports that may move between threads.
pub(crate) type Flavour = ipc_threadsafe::Service;

/// Most characters of the prefix of file names. iceoryx2's longest file name must fit a Unix socket's address.
const PREFIX_LIMIT: usize = 25;
/// Most bytes of the root path, for the same reason.
const ROOT_LIMIT: usize = 40;
/// The longest time for opening a service: a participant that starts, stops or has just died is in the way for moments only.
const OPEN_FOR: Duration = Duration::from_secs(8);
/// Longer obstacles are searched for and removed.
const LIKELY_WITHIN: Duration = Duration::from_millis(200);
const SHARED_MEMORY: &str = "/dev/shm";
/// Shared memory that must be free before a participant joins or opens a port, more than the largest port takes. iceoryx2 maps memory
/// before the system provides it; touching a missing page ends the process by SIGBUS.
const FREE_BYTES: u64 = 8 << 20;
/// More files than one port opens.
const OPEN_BY_A_PORT_MAX: u64 = 32;
const FOLDERS: [&str; 2] = ["nodes", "services"];
/// iceoryx2's files of a participant in `nodes`, in addition to its folder.
const MONITOR_FILES: [&str; 3] = ["node_monitor", "node_monitor_owner_lock", "node_monitor_context"];
const COUNTER_FILE: &str = "global_mgmt";
const PORT_FILES: [&str; 4] = ["data", "connection", "event", "event_mgmt"];
/// The ending of the locked file of a participant with a unique name.
const ONLY_FILE: &str = ".only";
/// An incomplete participant is joining or leaving, or was killed while it did so. After this time it counts as killed.
const JOINED_WITHIN: Duration = Duration::from_secs(10);
/// An unfinished service is being created, or its creator was killed. After this time the creator counts as killed. The time is less than
/// [`OPEN_FOR`], so that other participants can open the service.
const MADE_WITHIN: Duration = Duration::from_secs(2);
/// Ended publishers whose messages a subscriber can still take: four times the most that are open at once.
const ENDED_PUBLISHERS: usize = 32;
/// The same for ended participants of a request: the most that are open at once.
const ENDED_CLIENTS: usize = 8;
/// The interval of the watch's looks.
const WATCH_EVERY: Duration = Duration::from_secs(1);

fn user() -> String {
    format!("{:x}", geteuid().as_raw())
}

fn name_limit() -> usize {
    PREFIX_LIMIT - user().len() - 2
}

/// A separate set of services: participants with the same root path and name see one another.
///
/// The root path holds sockets and service files and belongs to one user, mode 0700. Shared memory is in `/dev/shm` under the domain's name
/// and the user's number, mode 0600. That user id is the boundary: there are no access lists.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Domain {
    root: PathBuf,
    name: String,
}

fn own_root(variable: impl Fn(&str) -> Option<OsString>) -> PathBuf {
    let root = variable("XDG_RUNTIME_DIR").map(|base| Path::new(&base).join("roomcast"));
    root.filter(|root| root.is_absolute() && root.as_os_str().len() <= ROOT_LIMIT)
        .unwrap_or_else(|| PathBuf::from(format!("/tmp/roomcast-{}", geteuid().as_raw())))
}

impl Domain {
    /// The name of the default domain.
    pub const DEFAULT_NAME: &str = "roomcast";

    /// The domain `name` (`a-z`, `0-9`, `-`; 15 characters for every user, up to 22 with a short user number) at `root` (absolute, at most
    /// 40 bytes). The first participant creates the folder `root`; its parent folder must exist.
    ///
    /// # Errors
    ///
    /// [`IpcError::BadRoot`], also if the folder of `root` does not exist, and [`IpcError::BadDomainName`].
    pub fn new(root: impl Into<PathBuf>, name: &str) -> Result<Self, IpcError> {
        let root = root.into();
        if !root.is_absolute() || root.as_os_str().len() > ROOT_LIMIT {
            let problem =
                format!("give an absolute path of at most {ROOT_LIMIT} bytes (a Unix socket's address must hold it)");
            return Err(bad_root(&root, problem));
        }
        let plain = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'-';
        if name.is_empty() || name.len() > name_limit() || !name.bytes().all(plain) {
            return Err(IpcError::BadDomainName { name: name.to_owned(), limit: name_limit() });
        }
        let parent = root.parent().unwrap_or(&root);
        if !parent.is_dir() {
            return Err(missing(&root, parent));
        }
        Ok(Self { root, name: name.to_owned() })
    }

    /// The default domain of all commands: `ROOMCAST_ROOT` and `ROOMCAST_DOMAIN`, else [`Self::DEFAULT_NAME`] at [`Self::default_root`].
    ///
    /// # Errors
    ///
    /// As [`Self::new`], for what the environment says.
    pub fn default_for_user() -> Result<Self, IpcError> {
        Self::named_by(|variable| env::var_os(variable))
    }

    fn named_by(variable: impl Fn(&str) -> Option<OsString>) -> Result<Self, IpcError> {
        let root = variable("ROOMCAST_ROOT").filter(|root| !root.is_empty()).map(PathBuf::from);
        let name = variable("ROOMCAST_DOMAIN");
        let name = name.as_ref().map_or(Self::DEFAULT_NAME.into(), |name| name.to_string_lossy());
        Self::new(root.unwrap_or_else(|| own_root(variable)), &name)
    }

    /// As [`Self::default_for_user`].
    ///
    /// # Errors
    ///
    /// As [`Self::new`], for the environment's values.
    pub fn for_user() -> Result<Self, IpcError> {
        Self::default_for_user()
    }

    /// The default root path: in `$XDG_RUNTIME_DIR` if that is set and short enough, else `/tmp/roomcast-UID`.
    #[must_use]
    pub fn default_root() -> PathBuf {
        own_root(|variable| env::var_os(variable))
    }

    /// The root path.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Joins under `participant`, a name for people (at most 100 characters).
    ///
    /// Creates the root directory if it is missing, and cleans up after dead participants. It leaves signal handlers alone.
    ///
    /// # Errors
    ///
    /// [`IpcError::BadRoot`] if another user owns the root or may write to it, [`IpcError::ForeignSharedMemory`] if another user's files
    /// are in the way, [`IpcError::Join`] if iceoryx2 cannot create the node.
    pub fn open(&self, participant: &str) -> Result<Node, IpcError> {
        if !participant.chars().any(char::is_alphanumeric) {
            let text =
                format!("participant {participant:?}: give a name with a letter or digit, such as \"hall-camera\"");
            return Err(IpcError::Argument(text));
        }
        self.prepare_root()?;
        self.refuse_foreign_shared_memory()?;
        refuse_too_little_memory()?;
        // Joining fails on such memory, and the watch's first look comes later.
        self.remove_unmade_memory();
        // iceoryx2 logs to standard error, and returns the errors as well.
        iceoryx2::prelude::set_log_level(LogLevel::Fatal);
        let join = |cause: Cause| IpcError::Join { root: self.root.clone(), cause };
        let config = self.config()?;
        // iceoryx2's names are ASCII, people's may be anything.
        let shown: String =
            participant.chars().map(|c| if c.is_ascii_graphic() || c == ' ' { c } else { '?' }).collect();
        let name =
            NodeName::new(&shown).map_err(|error| join(format!("participant {participant:?}: {error:?}").into()))?;
        let watch = Watch::start(self).map_err(|error| join(error.into()))?;
        let node = NodeBuilder::new()
            .name(&name)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Flavour>()
            .map_err(|error| match too_many_files() {
                Some((open, limit)) => IpcError::TooManyFiles { service: "node", open, limit },
                None => join(error.into()),
            })?;
        self.close_to_others();
        Ok(Node {
            node,
            config,
            domain: self.clone(),
            unused: Mutex::default(),
            tell: None,
            _last: LastOut(self.clone()),
            _only: None,
            _watch: watch,
        })
    }

    /// Removes the remains of dead participants. If no participant is alive, it removes everything of the domain: its shared memory, its
    /// files in the root directory, and that directory unless it holds other files. Returns whether the domain is gone.
    ///
    /// # Errors
    ///
    /// [`IpcError::BadRoot`] when a file cannot be removed.
    pub fn clean_up(&self) -> Result<bool, IpcError> {
        if !self.root.exists() {
            return Ok(self.remove_shared_memory().is_ok());
        }
        let config = self.config()?;
        self.open("clean-up")?.clean_up_dead();
        if self.alive(&config) > 0 {
            return Ok(false);
        }
        self.remove_shared_memory()
            .and_then(|()| self.remove_files())
            .map_err(|error| self.bad_root_by("cannot remove what is left there", error))?;
        Ok(true)
    }

    /// Removes the remains of processes that were killed while they joined, opened a service, or cleaned up. iceoryx2 leaves them, and an
    /// unfinished service rejects all participants.
    ///
    /// A participant has a folder with its details, and a monitor that is created after it. iceoryx2 does not see a folder without a
    /// monitor. Without details, which are cleaned up last, it looks for the rest in its default root path instead of this one. A service's
    /// file is writable until it is finished. Each of these states is normal for moments, so files that changed within [`JOINED_WITHIN`]
    /// and [`MADE_WITHIN`] stay.
    fn repair(&self, config: &Config) {
        let prefix = self.prefix();
        let nodes = self.root.join("nodes");
        let mut participants = BTreeSet::new();
        for entry in fs::read_dir(&nodes).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            let monitored = name.strip_prefix(&prefix).and_then(|name| name.split_once('.'));
            let id = monitored.map_or(name.as_str(), |(id, _)| id);
            if id.bytes().all(|byte| byte.is_ascii_digit()) {
                participants.insert(id.to_owned());
            }
        }
        for id in &participants {
            let folder = nodes.join(id);
            let monitor = MONITOR_FILES.map(|suffix| nodes.join(format!("{prefix}{id}.{suffix}")));
            // An unfinished monitor is write-only. A process that is killed in this state has opened no service, and iceoryx2 takes it for
            // joining for ever.
            let made = |file: &PathBuf| fs::metadata(file).is_ok_and(|about| about.permissions().mode() & 0o400 != 0);
            let whole = folder.join(format!("{prefix}node.details")).exists() && monitor.iter().all(made);
            let youngest = monitor.iter().chain([&folder]).filter_map(|path| age(path)).min();
            let foreign = folder.exists() && !self.all_ours(&folder);
            if !whole && !foreign && youngest.is_some_and(|age| age >= JOINED_WITHIN) {
                self.remove_entry(id, config);
            }
        }
        self.repair_ports(&participants);
        for entry in fs::read_dir(self.root.join("services")).into_iter().flatten().flatten() {
            let unfinished = entry.metadata().is_ok_and(|about| !about.permissions().readonly());
            let ours = entry.file_name().to_string_lossy().starts_with(&prefix);
            if ours && unfinished && age(&entry.path()).is_some_and(|age| age >= MADE_WITHIN) {
                let _removed = fs::remove_file(entry.path());
            }
        }
        for entry in fs::read_dir(&self.root).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with(&prefix) && name.ends_with(ONLY_FILE) {
                let locked = fs::File::open(entry.path()).and_then(|file| Only::lock(file, entry.path()));
                // The lock means that the holder was killed; the drop removes the file. If locking fails, another process holds the file,
                // or it is gone.
                drop(locked);
            }
        }
    }

    /// Removes the files of ports without a participant: the process was killed after it created a file and before it recorded that.
    ///
    /// The numbers of a participant and of its ports hold the process id (iceoryx2's `UniqueSystemId`: from the lowest bits up 32 of
    /// seconds, of nanoseconds, of the process id, of a counter). No port outlives its participant's entry, which is cleaned up last. A
    /// connection has two participants and is of no use to one alone.
    fn repair_ports(&self, participants: &BTreeSet<String>) {
        let known: BTreeSet<u32> = participants.iter().filter_map(|id| process_of(id)).collect();
        let sockets = fs::read_dir(&self.root).into_iter().flatten().flatten().map(|entry| entry.path());
        for file in self.shared_memory().unwrap_or_default().into_iter().chain(sockets) {
            let Some(name) = file.file_name().map(|name| name.to_string_lossy().into_owned()) else { continue };
            let Some((stem, suffix)) = name.strip_prefix(&self.prefix()).and_then(|name| name.split_once('.')) else {
                continue;
            };
            let owners = processes_of(stem);
            let of_a_port = PORT_FILES.contains(&suffix) && !owners.is_empty();
            // A running process may take part in a domain of this name in another root.
            if of_a_port
                && owners.iter().any(|owner| !known.contains(owner) && !is_running(*owner))
                && age(&file).is_some_and(|age| age >= JOINED_WITHIN)
            {
                let _removed = fs::remove_file(file);
            }
        }
    }

    /// Whether the domain has no entry of a participant, dead or alive. If the folder cannot be read, it counts as having one.
    fn is_deserted(&self) -> bool {
        let (nodes, prefix) = (self.root.join("nodes"), self.prefix());
        let details = format!("{prefix}node.details");
        let of_somebody = |entry: io::Result<fs::DirEntry>| {
            entry.map_or(true, |entry| {
                entry.file_name().to_string_lossy().starts_with(&prefix) || entry.path().join(&details).exists()
            })
        };
        match fs::read_dir(nodes) {
            Ok(mut entries) => !entries.any(of_somebody),
            Err(error) => error.kind() == io::ErrorKind::NotFound,
        }
    }

    /// Removes shared memory that has been unfinished for [`MADE_WITHIN`]: without a size, or not readable, since its creator makes it
    /// readable last.
    fn remove_unmade_memory(&self) {
        for file in self.shared_memory().unwrap_or_default() {
            let Ok(about) = fs::symlink_metadata(&file) else { continue };
            let is_unmade = about.len() == 0 || about.permissions().mode() & 0o400 == 0;
            if about.is_file() && is_unmade && age(&file).is_some_and(|age| age >= MADE_WITHIN) {
                let _removed = fs::remove_file(file);
            }
        }
    }

    /// Takes a participant out of its services, then removes its entry. Only the entry says in which services it is, so without this order
    /// its places would stay taken for ever. iceoryx2 may leave such an entry: if it cannot leave one service, it still removes the
    /// monitor. The next [`Domain::repair`] removes the files of its ports.
    fn remove_entry(&self, id: &str, config: &Config) {
        let Some(_alone) = self.alone() else { return };
        let (nodes, prefix) = (self.root.join("nodes"), self.prefix());
        let folder = nodes.join(id);
        if let Some(participant) = id.parse().ok().and_then(participant_of) {
            let tag = config.global.node.service_tag_suffix.to_string();
            for file in fs::read_dir(&folder).into_iter().flatten().flatten() {
                let name = file.file_name().to_string_lossy().into_owned();
                let service = name.strip_prefix(&prefix).and_then(|name| name.strip_suffix(&tag));
                if let Some(service) = service.and_then(|service| ServiceHash::try_from(service).ok()) {
                    // An error means that the service has no complete file any more.
                    let _left = Flavour::__internal_remove_node_from_service(&participant, &service, config);
                }
            }
        }
        // Another participant may do the same at this moment, so errors are ignored.
        let _removed = fs::remove_dir_all(&folder);
        for suffix in MONITOR_FILES {
            let _removed = fs::remove_file(nodes.join(format!("{prefix}{id}.{suffix}")));
        }
    }

    /// The lock for taking other participants out of services. iceoryx2 uses the participant's entry as the lock, which may be gone. `None`
    /// while another process holds it.
    fn alone(&self) -> Option<fs::File> {
        let root = fs::File::open(&self.root).ok()?;
        rustix::fs::flock(&root, FlockOperation::NonBlockingLockExclusive).ok()?;
        Some(root)
    }

    fn all_ours(&self, folder: &Path) -> bool {
        let prefix = self.prefix();
        fs::read_dir(folder).is_ok_and(|mut files| {
            files.all(|file| file.is_ok_and(|file| file.file_name().to_string_lossy().starts_with(&prefix)))
        })
    }

    /// Removes the domain's files in the root, and then every empty folder. Other files stay.
    fn remove_files(&self) -> io::Result<()> {
        let gone = |result: io::Result<()>| match result {
            Err(error) if !matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::DirectoryNotEmpty) => {
                Err(error)
            }
            _ => Ok(()),
        };
        let folders = FOLDERS.map(|folder| self.root.join(folder));
        for folder in folders.iter().chain([&self.root]) {
            let Ok(files) = fs::read_dir(folder) else { continue };
            for file in files {
                let file = file?;
                let (path, name) = (file.path(), file.file_name());
                if name.to_string_lossy().starts_with(&self.prefix()) {
                    gone(fs::remove_file(path))?;
                } else if name.as_encoded_bytes().iter().all(u8::is_ascii_digit) && self.all_ours(&path) {
                    gone(fs::remove_dir_all(path))?;
                }
            }
            gone(fs::remove_dir(folder))?;
        }
        Ok(())
    }

    /// Includes this process's own participants.
    fn alive(&self, config: &Config) -> usize {
        let mut alive = 0;
        // If the list fails half-way, a participant counts as alive: a guess must not remove files.
        let listed = iceoryx2::node::Node::<Flavour>::list(config, |state| {
            alive += usize::from(!matches!(state, NodeState::Dead(_)));
            CallbackProgression::Continue
        });
        if listed.is_err() { alive.max(1) } else { alive }
    }

    /// The prefix of the names of all the domain's files: its name and the user's number in hexadecimal digits, `roomcast-3e8_`. It keeps
    /// domains of one name but different users apart. No domain's prefix begins another's, since a name has no underscore.
    #[must_use]
    pub fn prefix(&self) -> String {
        format!("{}-{}_", self.name, user())
    }

    fn shared_memory(&self) -> io::Result<Vec<PathBuf>> {
        let prefix = self.prefix();
        let entries = fs::read_dir(SHARED_MEMORY)?.collect::<io::Result<Vec<_>>>()?;
        let ours = entries.iter().filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix));
        Ok(ours.map(fs::DirEntry::path).collect())
    }

    /// Whether another process uses files of this domain's name. No process of this root does so at the time of the call, so it is in a
    /// domain of the same name in another root.
    fn is_used_elsewhere(&self) -> bool {
        let (prefix, own) = (self.prefix(), std::process::id());
        self.shared_memory().unwrap_or_default().iter().any(|file| {
            let name = file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
            let stem = name.strip_prefix(&prefix).and_then(|name| name.split_once('.')).map_or("", |(stem, _)| stem);
            processes_of(stem).into_iter().any(|process| process != own && is_running(process))
        })
    }

    fn remove_shared_memory(&self) -> io::Result<()> {
        if self.is_used_elsewhere() {
            return Ok(());
        }
        for file in self.shared_memory()? {
            match fs::remove_file(file) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        Ok(())
    }

    /// All users may create files in `/dev/shm`. Another user's file of this domain's name would let that user read and write the messages.
    fn refuse_foreign_shared_memory(&self) -> Result<(), IpcError> {
        // iceoryx2 reports a list that fails.
        for file in self.shared_memory().unwrap_or_default() {
            let owner = fs::symlink_metadata(&file).map(|about| about.uid());
            if let Ok(owner) = owner
                && owner != geteuid().as_raw()
            {
                return Err(IpcError::ForeignSharedMemory { file, owner });
            }
        }
        Ok(())
    }

    /// Makes the system provide every page of the domain's shared memory now. Otherwise memory could run out at the first touch of a page,
    /// during a publish.
    fn commit_shared_memory(&self) -> Result<(), IpcError> {
        for file in self.shared_memory().unwrap_or_default() {
            // The file is gone again, or is being created.
            let Some((open, about)) = open_own(&file, OFlags::WRONLY) else { continue };
            let bytes = about.len();
            if bytes > 0
                && let Err(Errno::NOSPC) = rustix::fs::fallocate(&open, rustix::fs::FallocateFlags::KEEP_SIZE, 0, bytes)
            {
                return Err(IpcError::SharedMemoryFull { free_bytes: 0, needed_bytes: bytes });
            }
        }
        Ok(())
    }

    /// iceoryx2 opens one file per domain, its counter of participants, to every user. This closes it to others.
    fn close_to_others(&self) {
        for file in self.shared_memory().unwrap_or_default() {
            let opened = open_own(&file, OFlags::RDONLY).or_else(|| open_own(&file, OFlags::WRONLY));
            if let Some((open, about)) = opened
                && about.permissions().mode() & 0o077 != 0
            {
                // The file may be gone already. If it cannot be closed, the root still keeps others out.
                let _closed = open.set_permissions(fs::Permissions::from_mode(0o600));
            }
        }
    }

    fn bad_root(&self, problem: String) -> IpcError {
        bad_root(&self.root, problem)
    }

    fn bad_root_by(&self, problem: &str, error: io::Error) -> IpcError {
        let problem = format!("{problem}: {error}; give another folder");
        IpcError::BadRoot { path: self.root.clone(), problem, cause: Some(error.into()) }
    }

    /// Creates the root, or refuses one that other users could put files into.
    fn prepare_root(&self) -> Result<(), IpcError> {
        use std::os::unix::fs::DirBuilderExt;

        let made = fs::DirBuilder::new().mode(0o700).create(&self.root);
        made.or_else(|error| match error.kind() {
            io::ErrorKind::AlreadyExists => Ok(()),
            io::ErrorKind::NotFound => Err(missing(&self.root, self.root.parent().unwrap_or(&self.root))),
            _ => Err(self.bad_root_by("cannot make it", error)),
        })?;
        let metadata =
            fs::symlink_metadata(&self.root).map_err(|error| self.bad_root_by("cannot look at it", error))?;
        if !metadata.is_dir() {
            return Err(self.bad_root("not a directory (a symbolic link does not count as one)".to_owned()));
        }
        if metadata.uid() != geteuid().as_raw() {
            let owner = metadata.uid();
            return Err(self.bad_root(format!(
                "belongs to user {owner}; all participants run as one user: run as that user, or use another root"
            )));
        }
        if metadata.mode() & 0o022 != 0 {
            let mode = metadata.mode() & 0o7777;
            return Err(self.bad_root(format!(
                "others may write there (mode {mode:o}): give a folder of your own, which is made; or chmod go-w this one, if it is yours alone"
            )));
        }
        Ok(())
    }

    fn config(&self) -> Result<Config, IpcError> {
        let mut config = Config::default();
        let root = iceoryx2::prelude::Path::new(self.root.as_os_str().as_encoded_bytes());
        let root = root.map_err(|error| self.bad_root(format!("iceoryx2 refuses it: {error:?}")))?;
        config.global.set_root_path(&root);
        let bad_name = |_| IpcError::BadDomainName { name: self.name.clone(), limit: name_limit() };
        config.global.prefix = FileName::new(self.prefix().as_bytes()).map_err(bad_name)?;
        // Each place takes 3.6 KB of a receiving port, which looks at all of them for each message. iceoryx2 has 128 places.
        config.defaults.publish_subscribe.subscriber_expired_connection_buffer = ENDED_PUBLISHERS;
        config.defaults.request_response.client_expired_connection_buffer = ENDED_CLIENTS;
        config.defaults.request_response.server_expired_connection_buffer = ENDED_CLIENTS;
        Ok(config)
    }
}

/// A participant by its number. iceoryx2 creates such an id only from a complete entry, so this deserialises its two halves.
fn participant_of(number: u128) -> Option<UniqueNodeId> {
    let halves = SeqDeserializer::<_, ValueError>::new([number as u64, (number >> 64) as u64].into_iter());
    UniqueNodeId::deserialize(SeqDeserializer::new(std::iter::once(halves))).ok()
}

/// The process in the number of a participant or port (iceoryx2's `UniqueSystemId`): above 64 bits of time.
pub(crate) fn process_in(number: u128) -> u32 {
    (number >> 64) as u32
}

/// The process in a number of a file's name. `None` for a small number, which counts something else: memory that grows has a file `PORT__0`
/// for its first segment.
fn process_of(number: &str) -> Option<u32> {
    Some(process_in(number.parse().ok()?)).filter(|process| *process != 0)
}

/// The processes in a port's file name. The service's hash between the numbers is skipped.
fn processes_of(stem: &str) -> Vec<u32> {
    stem.split('_').filter(|part| part.len() < 40).filter_map(process_of).collect()
}

/// Whether a process runs; if this cannot be read, it counts as running. A zombie does not run: a container's first process may never wait
/// for its children.
pub(crate) fn is_running(process: u32) -> bool {
    let has_ended = || {
        let stat = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
        // The state follows the process name, which may contain any characters.
        stat.rsplit_once(") ").is_some_and(|(_, state)| state.starts_with(['Z', 'X']))
    };
    let process = Pid::from_raw(process.cast_signed());
    process.is_none_or(|process| test_kill_process(process) != Err(Errno::SRCH)) && !has_ended()
}

/// Opens only a plain file of this user. Any user may put a pipe into shared memory, which would block the open, or a link to another
/// place.
fn open_own(file: &Path, access: OFlags) -> Option<(fs::File, fs::Metadata)> {
    let flags = access | OFlags::NONBLOCK | OFlags::NOFOLLOW | OFlags::CLOEXEC | OFlags::NOCTTY;
    let open = fs::File::from(rustix::fs::open(file, flags, Mode::empty()).ok()?);
    let about = open.metadata().ok()?;
    (about.is_file() && about.uid() == geteuid().as_raw()).then_some((open, about))
}

/// The time since a file, or the content of a folder, last changed; `None` if it is gone.
fn age(path: &Path) -> Option<Duration> {
    static AGES: Mutex<Ages> = Mutex::new(Ages::new());
    let changed = fs::symlink_metadata(path).and_then(|about| about.modified()).ok()?;
    let mut ages = AGES.lock().unwrap_or_else(PoisonError::into_inner);
    Some(ages.age(path, changed, SystemTime::now(), Duration::from_nanos(clock::monotonic_ns())))
}

/// Ages of files. Their dates are from the wall clock, which may be set. A date in the future, or from before the clock was set, says
/// nothing. Then the age counts from the time when this process first saw the file, or when the clock was set.
#[derive(Debug)]
struct Ages {
    /// The boot time since which the wall clock has not been set, and the difference between the two clocks.
    steady: Option<(Duration, i128)>,
    /// Files with a date in the future: the date, and the time when they were first seen.
    ahead: BTreeMap<PathBuf, (SystemTime, Duration)>,
}

impl Ages {
    /// A clock that moves by more than this was set.
    const STEP_NS: i128 = 500_000_000;
    /// A domain has fewer files.
    const FILES_MAX: usize = 4096;

    const fn new() -> Self {
        Self { steady: None, ahead: BTreeMap::new() }
    }

    fn age(&mut self, path: &Path, changed: SystemTime, wall: SystemTime, boot: Duration) -> Duration {
        let since_epoch = wall.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let between = since_epoch.as_nanos() as i128 - boot.as_nanos() as i128;
        let since = match self.steady {
            // Before the first look, the wall clock is assumed to be steady since boot.
            None => Duration::ZERO,
            Some((since, before)) if (between - before).abs() < Self::STEP_NS => since,
            Some(_) => boot,
        };
        // A clock that is corrected little by little is steady.
        self.steady = Some((since, between));
        match wall.duration_since(changed) {
            Ok(age) => {
                self.ahead.remove(path);
                age.min(boot.saturating_sub(since))
            }
            Err(_) => {
                if self.ahead.len() >= Self::FILES_MAX {
                    self.ahead.clear();
                }
                let seen = self.ahead.entry(path.to_owned()).or_insert((changed, boot));
                if seen.0 != changed {
                    *seen = (changed, boot);
                }
                boot.saturating_sub(seen.1)
            }
        }
    }
}

pub(crate) fn shown(details: &NodeDetails) -> String {
    format!("{} (process {})", details.name(), details.process_id().value())
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub(crate) participant: UniqueNodeId,
    pub(crate) port: u128,
}

#[derive(Debug)]
pub(crate) enum OpenFailure {
    Final(IpcError),
    Passing(IpcError),
}

fn bad_root(root: &Path, problem: String) -> IpcError {
    IpcError::BadRoot { path: root.to_owned(), problem, cause: None }
}

fn missing(root: &Path, parent: &Path) -> IpcError {
    let parent = parent.display();
    bad_root(
        root,
        format!("it does not exist, and neither does {parent}: give the root of the running daemon, or make {parent}"),
    )
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    /// The Python client's test has the same environments.
    #[test]
    fn the_environment_names_the_domain() {
        let named = |set: &[(&str, &str)]| {
            Domain::named_by(|name| set.iter().find(|(own, _)| *own == name).map(|(_, value)| value.into()))
        };
        let (root, name, base) = ("ROOMCAST_ROOT", "ROOMCAST_DOMAIN", "XDG_RUNTIME_DIR");
        let own = format!("/tmp/roomcast-{}", geteuid().as_raw());
        for (set, at, called) in [
            (&[(root, "/tmp/rc"), (name, "kitchen"), (base, "/run")][..], "/tmp/rc", "kitchen"),
            (&[(root, "/tmp/rc")], "/tmp/rc", "roomcast"),
            (&[(name, "kitchen"), (base, "/run")], "/run/roomcast", "kitchen"),
            (&[(root, ""), (base, "/run")], "/run/roomcast", "roomcast"),
            (&[(base, "relative")], &own, "roomcast"),
            (&[(base, "/a/base/that/no/address/of/a/socket/holds")], &own, "roomcast"),
            (&[], &own, "roomcast"),
        ] {
            assert_eq!(named(set).unwrap(), Domain::new(at, called).unwrap(), "{set:?}");
        }
        assert!(matches!(named(&[(root, "relative")]), Err(IpcError::BadRoot { .. })));
        for bad in ["", "Kitchen"] {
            assert!(matches!(named(&[(name, bad)]), Err(IpcError::BadDomainName { .. })), "{bad:?}");
        }
    }

    #[test]
    fn a_participant_is_found_by_its_number() {
        let number = (3 << 96) | (1234_u128 << 64) | (7 << 32) | 5;
        assert_eq!(participant_of(number).unwrap().value(), number);
    }

    /// Row "half-made memory dated an hour ahead" of the attacks, and clocks that are set while files are observed.
    #[test]
    fn ages_of_files_do_not_follow_the_wall_clock_alone() {
        let hour = Duration::from_secs(3600);
        let (file, start) = (Path::new("half-made"), SystemTime::UNIX_EPOCH + 1000 * hour);
        let second = |n: u64| Duration::from_secs(n);
        let mut ages = Ages::new();
        // At first only the dates count.
        assert_eq!(ages.age(file, start - second(7), start, hour), second(7));
        // The age of a file from the future counts from its first sight.
        for n in 0..4 {
            assert_eq!(ages.age(file, start + hour, start + second(n), hour + second(n)), second(n));
        }
        // Another future date counts as another file.
        assert_eq!(ages.age(file, start + 2 * hour, start + second(4), hour + second(4)), Duration::ZERO);
        // The clock is set an hour ahead: a new file is not an hour old.
        let ahead = start + hour;
        assert_eq!(ages.age(file, start + second(4), ahead + second(5), hour + second(5)), Duration::ZERO);
        assert_eq!(ages.age(file, start + second(4), ahead + second(8), hour + second(8)), second(3));
        // Newer files have their date's age again, and a clock that is corrected little by little counts as steady.
        assert_eq!(ages.age(file, ahead + second(8), ahead + second(10), hour + second(10)), second(2));
        assert_eq!(
            ages.age(file, ahead + second(8), ahead + second(20) + Duration::from_millis(300), hour + second(20)),
            Duration::from_millis(12_300)
        );
    }

    #[test]
    fn names_and_roots_that_cannot_work_are_refused() {
        for name in ["", "Room", "a_b", "a/b", "a very long name that does not fit"] {
            assert!(matches!(Domain::new("/tmp/roomcast-x", name), Err(IpcError::BadDomainName { .. })), "{name}");
        }
        // This length fits every user, and the user is in all names.
        let domain = Domain::new("/tmp/roomcast-x", "fifteen-letters").unwrap();
        assert_eq!(domain.prefix(), format!("fifteen-letters-{:x}_", geteuid().as_raw()));
        for root in ["relative", "/tmp/a-path-that-is-much-too-long-for-a-socket"] {
            assert!(matches!(Domain::new(root, "x"), Err(IpcError::BadRoot { .. })), "{root}");
        }
    }

    /// A joining participant is in no list at first. Two planners that started together both stayed, and one vacuum had two drivers.
    #[test]
    fn of_those_that_come_at_once_one_is_the_only_one() {
        let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(directory.path(), &format!("only-{}", std::process::id())).unwrap();
        let lock = || {
            let files = fs::read_dir(domain.root()).unwrap().map(|entry| entry.unwrap().path());
            files.filter(|path| path.to_string_lossy().ends_with(ONLY_FILE)).collect::<Vec<_>>()
        };
        let watcher = domain.open("watcher").unwrap();
        let (start, here) = (Barrier::new(4), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    start.wait();
                    for _ in 0..3 {
                        // On a slow or emulated machine, the others' turns take longer than one call waits.
                        let only = loop {
                            match domain.open("one").unwrap().be_the_only_one() {
                                Err(IpcError::NameTaken { .. }) => {}
                                only => break only.unwrap(),
                            }
                        };
                        assert_eq!(here.fetch_add(1, Ordering::SeqCst), 0, "another one is here");
                        // Cleaning up does not remove the lock.
                        watcher.clean_up_dead();
                        let [file] = &lock()[..] else { panic!("{:?}", lock()) };
                        let holder = fs::read_to_string(file).unwrap();
                        assert_eq!(holder, format!("one (process {})", std::process::id()));
                        assert_eq!(fs::metadata(file).unwrap().mode() & 0o777, 0o600);
                        here.fetch_sub(1, Ordering::SeqCst);
                        drop(only);
                    }
                });
            }
        });
        assert_eq!(lock(), Vec::<PathBuf>::new(), "the last one has removed it");
        // A killed participant's lock file is removed, and excludes no other participant until then.
        let left = domain.root().join(format!("{}0123456789abcdef{ONLY_FILE}", domain.prefix()));
        fs::write(&left, "one (process 1)").unwrap();
        watcher.clean_up_dead();
        assert!(!left.exists());
        let only = domain.open("one").unwrap().be_the_only_one().unwrap();
        let other = domain.open("another").unwrap().be_the_only_one().unwrap();
        let file = lock();
        drop((only, other));
        assert_eq!((file.len(), lock().len()), (2, 0));
        file.iter().for_each(|file| fs::write(file, "one (process 1)").unwrap());
        drop(domain.open("one").unwrap().be_the_only_one().unwrap());
        drop(watcher);
        domain.clean_up().unwrap();
    }

    #[test]
    fn a_root_in_a_folder_that_does_not_exist_is_refused_with_the_folders_name() {
        let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let is_told = |error: IpcError| {
            let error = error.to_string();
            assert!(error.contains("does not exist") && error.contains("typo: "), "{error}");
        };
        let folder = directory.path().join("typo");
        is_told(Domain::new(folder.join("d"), "nowhere").unwrap_err());
        fs::create_dir(&folder).unwrap();
        let domain = Domain::new(folder.join("d"), "nowhere").unwrap();
        fs::remove_dir(&folder).unwrap();
        is_told(domain.open("test").unwrap_err());
        Domain::new(directory.path().join("d"), "here").unwrap().open("test").unwrap();
    }

    #[test]
    fn errors_of_iceoryx2_and_of_the_system_are_the_source_of_the_error() {
        use std::error::Error;

        let error = IpcError::Port { service: "s", operation: "send", cause: "no memory".into() };
        assert_eq!(error.source().map(ToString::to_string).as_deref(), Some("no memory"));
        let file = tempfile::Builder::new().prefix("rc-").tempfile_in("/tmp").unwrap();
        let domain = Domain { root: file.path().join("d"), name: "in-a-file".to_owned() };
        let error = domain.open("test").unwrap_err();
        let cause = error.source().and_then(|cause| cause.downcast_ref::<io::Error>());
        assert_eq!(cause.map(io::Error::kind), Some(io::ErrorKind::NotADirectory), "{error}");
    }

    #[test]
    fn a_root_that_others_may_write_to_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        fs::set_permissions(directory.path(), fs::Permissions::from_mode(0o777)).unwrap();
        let domain = Domain::new(directory.path(), "open-door").unwrap();
        let error = domain.open("test").unwrap_err().to_string();
        assert!(error.contains("others may write"), "{error}");
    }
}
