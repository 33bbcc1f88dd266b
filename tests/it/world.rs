use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};

use roomcast_ipc::raw::StatusResponseV1;
use roomcast_ipc::{Domain, Node};
use rustix::process::{Pid, Signal, kill_process};

use crate::eventually::{PATIENCE, eventually};

/// A private domain with its processes and logs; all are removed on drop.
pub(crate) struct World {
    pub(crate) directory: tempfile::TempDir,
    pub(crate) domain: Domain,
    pub(crate) children: Vec<Process>,
}

pub(crate) struct Process {
    pub(crate) child: Child,
    pub(crate) log: PathBuf,
}

/// A command without a domain.
pub(crate) fn roomcast(arguments: &[&str]) -> Command {
    // `ROOMCAST_BINARY` tests an installed program.
    let built = || env!("CARGO_BIN_EXE_roomcast").into();
    let mut command = Command::new(std::env::var_os("ROOMCAST_BINARY").unwrap_or_else(built));
    command.args(arguments).env_remove("ROOMCAST_CONFIG").stdin(Stdio::null());
    command
}

fn joined(mut command: Command, domain: &Domain) -> Command {
    command.arg("--root").arg(domain.root()).args(["--domain", domain.name()]);
    command
}

impl World {
    pub(crate) fn new(name: &str) -> Self {
        let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(directory.path().join("d"), &format!("{name}-{}", std::process::id())).unwrap();
        Self { directory, domain, children: Vec::new() }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    pub(crate) fn command(&self, arguments: &[&str]) -> Command {
        joined(roomcast(arguments), &self.domain)
    }

    /// Like [`Self::command`], started by another program such as `prlimit --nofile=20`.
    pub(crate) fn command_by(&self, runner: &[&str], arguments: &[&str]) -> Command {
        let mut command = Command::new(runner[0]);
        command.args(&runner[1..]).arg(roomcast(&[]).get_program()).args(arguments);
        command.env_remove("ROOMCAST_CONFIG").stdin(Stdio::null());
        joined(command, &self.domain)
    }

    /// Starts a process that runs until the end of the test; returns its number.
    pub(crate) fn start(&mut self, arguments: &[&str]) -> usize {
        self.spawn(self.command(arguments))
    }

    pub(crate) fn spawn(&mut self, mut command: Command) -> usize {
        let log = self.path(&format!("log-{}", self.children.len()));
        let child = command.stderr(File::create(&log).unwrap()).stdout(Stdio::null()).spawn().unwrap();
        self.children.push(Process { child, log });
        self.children.len() - 1
    }

    pub(crate) fn start_daemon(&mut self) -> usize {
        let state = self.state();
        self.start(&["daemon", "--state", state.to_str().unwrap()])
    }

    pub(crate) fn state(&self) -> PathBuf {
        self.directory.path().join("state")
    }

    /// Narrates lines, waits for the narrator's end, and returns its exit code and outcome.
    pub(crate) fn narrate(&self, name: &str, lines: &str) -> (i32, serde_json::Value) {
        let file = self.directory.path().join(format!("{name}.txt"));
        std::fs::write(&file, lines).unwrap();
        self.narrate_file(name, &file)
    }

    pub(crate) fn narrate_file(&self, name: &str, file: &Path) -> (i32, serde_json::Value) {
        let mut command = self.command(&["narrate", file.to_str().unwrap(), "--name", name, "--pace", "0", "--json"]);
        let output = command.args(["--linger", "100"]).output().unwrap();
        let mut outcome: serde_json::Value =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        // Another test checks `understood`.
        let understood = outcome.as_object_mut().and_then(|outcome| outcome.remove("understood"));
        assert!(understood.is_some_and(|understood| understood.is_array()));
        (output.status.code().unwrap(), outcome)
    }

    pub(crate) fn signal(&self, process: usize, signal: Signal) {
        kill_process(Pid::from_raw(self.children[process].child.id().cast_signed()).unwrap(), signal).unwrap();
    }

    pub(crate) fn wait(&mut self, process: usize) -> (ExitStatus, String) {
        let process = &mut self.children[process];
        let status = eventually("the process ends", || process.child.try_wait().unwrap());
        (status, std::fs::read_to_string(&process.log).unwrap())
    }

    pub(crate) fn end(&mut self, process: usize, signal: Signal) -> Option<i32> {
        self.signal(process, signal);
        self.wait(process).0.code()
    }

    /// Stops a service, which must end well; returns its log.
    pub(crate) fn stop(&mut self, process: usize) -> String {
        self.signal(process, Signal::TERM);
        let (status, log) = self.wait(process);
        assert!(status.success(), "{status}: {log}");
        log
    }

    pub(crate) fn log(&self, process: usize) -> String {
        std::fs::read_to_string(&self.children[process].log).unwrap()
    }

    pub(crate) fn assert_alive(&mut self) {
        for process in &mut self.children {
            if let Some(status) = process.child.try_wait().unwrap() {
                panic!("ended with {status}: {}", std::fs::read_to_string(&process.log).unwrap());
            }
        }
    }

    pub(crate) fn status(&self, node: &Node) -> StatusResponseV1 {
        node.status_client().unwrap().ask(PATIENCE).unwrap()
    }

    pub(crate) fn shared_memory_files(&self) -> Vec<String> {
        let prefix = self.domain.prefix();
        let names = std::fs::read_dir("/dev/shm").unwrap().map(|file| file.unwrap().file_name().into_string().unwrap());
        names.filter(|name| name.starts_with(&prefix)).collect()
    }
}

impl Drop for World {
    fn drop(&mut self) {
        for process in &mut self.children {
            let _gone = process.child.kill();
            let _reaped = process.child.wait();
            if std::thread::panicking() {
                eprintln!("--- {}", std::fs::read_to_string(&process.log).unwrap_or_default());
            }
        }
        let _left = self.domain.clean_up();
    }
}
