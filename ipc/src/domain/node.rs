//! A participant: it joins a domain, and opens ports.

use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::sync::Mutex;
use std::time::{Duration, Instant};
use std::{fs, io};

use iceoryx2::config::Config;
use iceoryx2::node::NodeView;
use iceoryx2::prelude::{CallbackProgression, NodeState};
use iceoryx2::service::internal::ServiceInternal;
use iceoryx2::service::service_hash::ServiceHash;
use rustix::io::Errno;
use rustix::process::{Resource, getrlimit};

use super::{
    Domain, FOLDERS, FREE_BYTES, Flavour, JOINED_WITHIN, LIKELY_WITHIN, LastOut, MADE_WITHIN, ONLY_FILE,
    OPEN_BY_A_PORT_MAX, OPEN_FOR, Only, OpenFailure, Place, SHARED_MEMORY, Watch, age,
};
use crate::unused::Unused;
use crate::{IpcError, limits, sequence};

/// A participant's place in a domain. Ports still work after it is dropped.
#[derive(Debug)]
pub struct Node {
    pub(super) node: iceoryx2::node::Node<Flavour>,
    pub(super) config: Config,
    pub(super) domain: Domain,
    pub(super) unused: Mutex<Unused>,
    pub(super) tell: Option<fn(&IpcError)>,
    /// Dropped after the node has left.
    pub(super) _last: LastOut,
    pub(super) _only: Option<Only>,
    /// Dropped last, since leaving may also wait for memory.
    pub(super) _watch: Watch,
}

impl Node {
    /// Calls `tell` once for each port when another participant is in the way and this one waits. It may take 8 s until that becomes an
    /// error.
    #[must_use]
    pub fn telling_of_waits(self, tell: fn(&IpcError)) -> Self {
        Self { tell: Some(tell), ..self }
    }

    /// Makes this participant the only one of its name that has called this, while this node lives. If several call it at once, one
    /// succeeds.
    ///
    /// # Errors
    ///
    /// [`IpcError::NameTaken`] if the other does not leave within 8 s; [`IpcError::Join`] if its file in the root path cannot be locked.
    pub fn be_the_only_one(self) -> Result<Self, IpcError> {
        let name = self.node.name().to_string();
        let file = format!("{}{:016x}{ONLY_FILE}", self.domain.prefix(), sequence::source_of_name(&name));
        let path = self.domain.root.join(file);
        let failed = |error: io::Error| {
            let is_limit = error.raw_os_error() == Some(Errno::MFILE.raw_os_error());
            let remedy = if is_limit { ": raise the limit (ulimit -n, LimitNOFILE=)" } else { "" };
            let cause = format!("{} cannot be locked: {error}{remedy}", path.display());
            OpenFailure::Passing(IpcError::Join { root: self.domain.root.clone(), cause: cause.into() })
        };
        let only = self.retry(|| {
            // Each process that can open the file can lock it, so only its owner may.
            let file =
                fs::OpenOptions::new().read(true).write(true).create(true).truncate(false).mode(0o600).open(&path);
            match Only::lock(file.map_err(failed)?, path.clone()).map_err(failed)? {
                Some(mut only) => {
                    // For the error message of other participants. If the disk is full, they show only the name.
                    let shown = format!("{name} (process {})", std::process::id());
                    let _said = only.file.set_len(0).and_then(|()| only.file.write_all(shown.as_bytes()));
                    Ok(only)
                }
                None => {
                    let holder = fs::read_to_string(&path).ok().filter(|holder| !holder.is_empty());
                    let holder = holder.unwrap_or_else(|| name.clone());
                    Err(OpenFailure::Passing(IpcError::NameTaken { holder }))
                }
            }
        })?;
        Ok(Self { _only: Some(only), ..self })
    }

    /// The names of all live participants, this one included.
    ///
    /// # Errors
    ///
    /// [`IpcError::Join`] when they cannot be listed.
    pub fn participants(&self) -> Result<Vec<String>, IpcError> {
        let mut names = Vec::new();
        let listed = iceoryx2::node::Node::<Flavour>::list(&self.config, |state| {
            if let NodeState::Alive(other) = state
                && let Some(details) = other.details()
            {
                names.push(details.name().to_string());
            }
            CallbackProgression::Continue
        });
        listed.map_err(|error| IpcError::Join {
            root: self.domain.root.clone(),
            cause: format!("the participants cannot be listed: {error:?}").into(),
        })?;
        names.sort();
        Ok(names)
    }

    /// Removes the remains of dead participants. iceoryx2 does so when it opens something, and a long-running process calls this now and
    /// then.
    pub fn clean_up_dead(&self) {
        self.remove_dead_participants();
        self.remove_unused_services(false);
    }

    fn remove_dead_participants(&self) {
        self.domain.repair(&self.config);
        if self.node.try_cleanup_dead_nodes().failed_cleanups > 0 {
            let mut dead = Vec::new();
            // If the list fails half-way, it has still named some participants, and the next look goes on.
            let _listed = iceoryx2::node::Node::<Flavour>::list(&self.config, |state| {
                if let NodeState::Dead(node) = state {
                    dead.push(node.id().value());
                }
                CallbackProgression::Continue
            });
            for id in dead {
                // A participant that cleans up at this moment changes the folder. So an unchanged folder is abandoned.
                let folder = self.domain.root.join("nodes").join(id.to_string());
                if age(&folder).is_some_and(|age| age >= JOINED_WITHIN) && self.domain.all_ours(&folder) {
                    self.domain.remove_entry(&id.to_string(), &self.config);
                }
            }
        }
    }

    /// A look at every service takes about 3 ms of the processor. Without `always` there is one only after a change.
    fn remove_unused_services(&self, always: bool) {
        // If it is locked, another thread is looking.
        let Ok(mut unused) = self.unused.try_lock() else { return };
        let folders = FOLDERS.map(|folder| self.domain.root.join(folder));
        let changed = folders.each_ref().map(|folder| fs::metadata(folder).and_then(|about| about.modified()).ok());
        if !unused.is_due(changed) && !always {
            return;
        }
        let [_, services] = folders;
        let closed = unused.remove(&self.node, &services, &self.domain.prefix(), MADE_WITHIN, age);
        if closed.is_empty() {
            return;
        }
        for file in self.domain.shared_memory().unwrap_or_default() {
            if closed.iter().any(|ending| file.to_string_lossy().ends_with(ending)) {
                let _removed = fs::remove_file(file);
            }
        }
    }

    /// Frees a service's places of participants without an entry. iceoryx2 removes the port tag of a dead participant before
    /// its place. If the process that cleans up is killed in between, iceoryx2 skips the place without a tag
    /// (`PortCleanupAction::SkipPort`) and still removes the participant. The place would be taken for ever.
    pub(crate) fn free_places_of_nobody(&self, places: &[Place], service: &ServiceHash) {
        let Some(_alone) = self.domain.alone() else { return };
        // A participant's entry exists before it takes a place and until it gives the place up. So the participants listed now are all that
        // may hold any of these.
        let mut participants = Vec::new();
        let listed = iceoryx2::node::Node::<Flavour>::list(&self.config, |state| {
            participants.push(match state {
                NodeState::Alive(node) => *node.id(),
                NodeState::Dead(node) => *node.id(),
                NodeState::Inaccessible(id) | NodeState::Undefined(id) => id,
            });
            CallbackProgression::Continue
        });
        if listed.is_err() {
            return;
        }
        for Place { participant, port } in places.iter().filter(|place| !participants.contains(&place.participant)) {
            // This restores the tag. If any step fails, the next try to open the port repeats it.
            let folder = self.domain.root.join("nodes").join(participant.value().to_string());
            let tag = format!("{}{port}{}", self.domain.prefix(), self.config.global.node.port_tag_suffix);
            let _tagged = fs::create_dir(&folder).and_then(|()| fs::write(folder.join(tag), []));
            let _freed = Flavour::__internal_remove_node_from_service(participant, service, &self.config);
            let _removed = fs::remove_dir_all(&folder);
        }
    }

    pub(crate) fn domain(&self) -> &Domain {
        &self.domain
    }

    pub(crate) fn inner(&self) -> &iceoryx2::node::Node<Flavour> {
        &self.node
    }

    pub(crate) fn config(&self) -> &Config {
        &self.config
    }

    pub(crate) fn try_once<T>(&self, open: impl FnOnce() -> Result<T, OpenFailure>) -> Result<Option<T>, IpcError> {
        refuse_too_little_memory()?;
        match open() {
            Ok(port) => self.domain.commit_shared_memory().map(|()| Some(port)),
            Err(OpenFailure::Final(error)) => Err(error),
            Err(OpenFailure::Passing(_)) => {
                self.remove_dead_participants();
                Ok(None)
            }
        }
    }

    /// Repeats while the failure may pass.
    pub(crate) fn retry<T>(&self, mut open: impl FnMut() -> Result<T, OpenFailure>) -> Result<T, IpcError> {
        refuse_too_little_memory()?;
        let start = Instant::now();
        let mut pause = Duration::from_millis(2);
        let mut tell = self.tell;
        loop {
            match open() {
                Ok(port) => {
                    self.domain.commit_shared_memory()?;
                    return Ok(port);
                }
                Err(OpenFailure::Final(error)) => return Err(error),
                Err(OpenFailure::Passing(error)) if start.elapsed() > OPEN_FOR => {
                    return Err(match error {
                        IpcError::Open { service, cause, .. } => match (too_many_files(), limits::address_space()) {
                            (Some((open, limit)), _) => IpcError::TooManyFiles { service, open, limit },
                            (None, Some((used_bytes, limit_bytes))) => {
                                IpcError::TooLittleAddressSpace { service, used_bytes, limit_bytes }
                            }
                            (None, None) => IpcError::Open { service, cause, tried_ms: start.elapsed().as_millis() },
                        },
                        other => other,
                    });
                }
                Err(OpenFailure::Passing(error)) => {
                    self.remove_dead_participants();
                    if start.elapsed() >= LIKELY_WITHIN {
                        let is_of_another = matches!(error, IpcError::Occupied { .. } | IpcError::NameTaken { .. });
                        if let Some(tell) = tell.take_if(|_| is_of_another) {
                            tell(&error);
                        }
                        // This comes early, since a service without memory then takes longer.
                        self.domain.remove_unmade_memory();
                        self.remove_unused_services(true);
                    }
                    std::thread::sleep(pause);
                    pause = (pause * 2).min(Duration::from_millis(100));
                }
            }
        }
    }
}

/// Open files and their limit, if a port may not be able to open enough of them: iceoryx2 does not report that.
pub(super) fn too_many_files() -> Option<(u64, u64)> {
    let limit = getrlimit(Resource::Nofile).current?;
    let open = match fs::read_dir("/proc/self/fd") {
        Ok(files) => files.count() as u64,
        // The look itself needs a file, too.
        Err(error) if error.raw_os_error() == Some(Errno::MFILE.raw_os_error()) => limit,
        Err(_) => return None,
    };
    (open.saturating_add(OPEN_BY_A_PORT_MAX) > limit).then_some((open, limit))
}

/// Returns an error if iceoryx2 would end the process by a signal.
pub(super) fn refuse_too_little_memory() -> Result<(), IpcError> {
    if let Some(limit_bytes) = getrlimit(Resource::Fsize).current.filter(|bytes| *bytes < FREE_BYTES) {
        return Err(IpcError::FilesLimited { limit_bytes, needed_bytes: FREE_BYTES });
    }
    // If this fails, the file system is missing, and iceoryx2 reports that.
    let Ok(about) = rustix::fs::statvfs(SHARED_MEMORY) else { return Ok(()) };
    let free_bytes = about.f_bavail.saturating_mul(about.f_frsize);
    if free_bytes >= FREE_BYTES {
        return Ok(());
    }
    Err(IpcError::SharedMemoryFull { free_bytes, needed_bytes: FREE_BYTES })
}
