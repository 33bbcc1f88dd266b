//! Child processes in a private domain, for `demo` and `latency`.

use std::ffi::OsString;
use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use roomcast_ipc::Domain;
use rustix::process::{Pid, Signal, getppid, kill_process, set_parent_process_death_signal};
use tempfile::TempDir;

use super::{CommandResult, Failure};
use crate::exit_code;

/// After this time a process that was asked to end is killed.
const STOP_WITHIN: Duration = Duration::from_secs(5);

/// The process id of the parent, for a process on a stage.
const PARENT_VARIABLE: &str = "ROOMCAST_STAGE";

/// Ends this process together with its stage's parent, which may be killed without a chance to end it.
pub(super) fn leave_with_parent() -> io::Result<()> {
    let Some(parent) = std::env::var(PARENT_VARIABLE).ok().and_then(|text| text.parse().ok()).and_then(Pid::from_raw)
    else {
        return Ok(());
    };
    set_parent_process_death_signal(Some(Signal::TERM))?;
    // The parent may have been killed before that.
    if getppid() != Some(parent) {
        kill_process(rustix::process::getpid(), Signal::TERM)?;
    }
    Ok(())
}

/// `roomcast` commands as child processes. Dropping ends them and removes the domain.
pub(super) struct Stage {
    children: Vec<(&'static str, Child)>,
    domain: Domain,
    /// Has the domain, the processes' logs and their configuration.
    folder: TempDir,
    config: Option<PathBuf>,
}

impl Stage {
    /// An empty stage and its domain.
    pub(super) fn new(name: &str) -> Result<Self, Failure> {
        let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp");
        let folder = folder.map_err(|error| Failure::failed(format!("cannot use /tmp: {error}")))?;
        let domain = Domain::new(folder.path().join("d"), &format!("{name}-{}", std::process::id()))?;
        Ok(Self { children: Vec::new(), domain, folder, config: None })
    }

    pub(super) fn domain(&self) -> Domain {
        self.domain.clone()
    }

    pub(super) fn configure(&mut self, text: &str) -> CommandResult {
        let path = self.folder.path().join("config.toml");
        std::fs::write(&path, text)
            .map_err(|error| Failure::failed(format!("cannot write {}: {error}", path.display())))?;
        self.config = Some(path);
        Ok(())
    }

    /// Starts `roomcast COMMAND ARGUMENTS` in the domain.
    pub(super) fn start(&mut self, command: &'static str, arguments: &[OsString]) -> CommandResult {
        self.start_with(command, arguments, Stdio::null(), Stdio::null())
    }

    /// As [`Stage::start`], with standard input and output.
    pub(super) fn start_with(
        &mut self,
        command: &'static str,
        arguments: &[OsString],
        input: Stdio,
        output: Stdio,
    ) -> CommandResult {
        let failed = |error: io::Error| Failure::failed(format!("cannot start `roomcast {command}`: {error}"));
        let log = File::create(self.log(self.children.len())).map_err(failed)?;
        let child = Command::new(std::env::current_exe().map_err(failed)?)
            .arg(command)
            .args(arguments)
            .arg("--root")
            .arg(self.domain.root())
            .args(["--domain", self.domain.name()])
            .args(self.config.iter().flat_map(|path| ["--config".as_ref(), path.as_os_str()]))
            .env_remove("ROOMCAST_CONFIG")
            .env(PARENT_VARIABLE, std::process::id().to_string())
            .stdin(input)
            .stdout(output)
            .stderr(log)
            .spawn()
            .map_err(failed)?;
        self.children.push((command, child));
        Ok(())
    }

    fn log(&self, number: usize) -> PathBuf {
        self.folder.path().join(format!("log-{number}"))
    }

    /// Fails with the message of a process that has ended, unless it is the narrator and it succeeded.
    pub(super) fn check(&mut self) -> CommandResult {
        for number in 0..self.children.len() {
            let log = self.log(number);
            let (command, child) = &mut self.children[number];
            let Ok(Some(status)) = child.try_wait() else { continue };
            let command = *command;
            if matches!(command, "narrate" | "measured-end") && status.success() {
                continue;
            }
            let said = std::fs::read_to_string(log).unwrap_or_default();
            let last: Vec<&str> = said.lines().rev().take(5).collect();
            let said = last.into_iter().rev().collect::<Vec<_>>().join("\n");
            let code = status.code().and_then(|code| u8::try_from(code).ok()).filter(|code| *code > 0);
            let code = code.unwrap_or(exit_code::FAILURE);
            return Err(Failure::new(code, format!("`roomcast {command}` ended ({status}):\n{said}")));
        }
        Ok(())
    }

    /// Whether the process that runs `command` has ended well; fails as [`Stage::check`].
    pub(super) fn ended(&mut self, command: &str) -> Result<bool, Failure> {
        self.check()?;
        let child = self.children.iter_mut().find(|(name, _)| *name == command);
        Ok(child.is_some_and(|(_, child)| matches!(child.try_wait(), Ok(Some(_)))))
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        for (_, child) in self.children.iter().rev() {
            // A process that has ended needs no signal.
            let _gone = Pid::from_raw(child.id().cast_signed()).map(|pid| kill_process(pid, Signal::TERM));
        }
        let start = Instant::now();
        for (_, child) in &mut self.children {
            while matches!(child.try_wait(), Ok(None)) && start.elapsed() < STOP_WITHIN {
                std::thread::sleep(Duration::from_millis(10));
            }
            // Only a process that hangs is still alive.
            let _killed = child.kill();
            let _reaped = child.wait();
        }
        if let Err(error) = self.domain.clean_up() {
            super::tell(format_args!("roomcast: {error}"));
        }
    }
}
