//! Real processes on loopback: a router, robots with daemon, planner and bridge, hubs.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::Instant;

pub(crate) use crate::eventually::{PATIENCE, eventually};
pub(crate) use crate::skipped::skipped;
use roomcast_ipc::Domain;
use rustix::process::{Pid, Signal, kill_process};

pub const NO_ROUTER: &str = "PyPI's eclipse-zenoh is not installed for the tests (`make zenoh` does, with a network)";

/// The target directory.
pub fn target() -> PathBuf {
    PathBuf::from(env!("CARGO_BIN_EXE_roomcast-zenoh")).ancestors().nth(2).unwrap().to_owned()
}

/// Python with eclipse-zenoh, if installed.
pub fn python() -> Option<PathBuf> {
    let python =
        std::env::var_os("ROOMCAST_ZENOH_PYTHON").map_or_else(|| target().join("zenoh/bin/python"), PathBuf::from);
    let has = Command::new(&python).args(["-c", "import zenoh"]).stderr(Stdio::null()).status();
    has.is_ok_and(|status| status.success()).then_some(python)
}

/// The robot's program. `make zenoh` builds it first.
pub fn roomcast() -> PathBuf {
    let program = std::env::var_os("ROOMCAST_BINARY").map_or_else(|| target().join("release/roomcast"), PathBuf::from);
    assert!(program.exists(), "{} is not there: build it first (cargo build --release)", program.display());
    program
}

pub fn bridge() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast-zenoh"));
    command.env_remove("ROOMCAST_ZENOH_CONFIG").stdin(Stdio::null());
    command
}

pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A process that ends with its test.
pub struct Process {
    command: Box<dyn Fn() -> Command + Send>,
    child: Option<Child>,
    pub log: PathBuf,
}

impl Process {
    pub fn start(log: PathBuf, command: impl Fn() -> Command + Send + 'static) -> Self {
        let mut process = Self { command: Box::new(command), child: None, log };
        process.restart();
        process
    }

    /// Kills the process if it runs, and starts it again. Its log continues.
    pub fn restart(&mut self) {
        self.kill();
        let log = File::options().create(true).append(true).open(&self.log).unwrap();
        let mut command = (self.command)();
        self.child = Some(command.stdout(log.try_clone().unwrap()).stderr(log).spawn().unwrap());
    }

    pub fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            let _ended = child.kill();
            child.wait().unwrap();
        }
    }

    pub fn signal(&self, signal: Signal) {
        let child = self.child.as_ref().unwrap();
        kill_process(Pid::from_child(child), signal).unwrap();
    }

    pub fn id(&self) -> u32 {
        self.child.as_ref().unwrap().id()
    }

    pub fn is_alive(&mut self) -> bool {
        self.child.as_mut().is_some_and(|child| child.try_wait().unwrap().is_none())
    }

    pub fn wait(&mut self) -> i32 {
        let mut child = self.child.take().unwrap();
        eventually("the process ends", || child.try_wait().unwrap()).code().unwrap_or(-1)
    }

    pub fn said(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
        if std::thread::panicking() {
            eprintln!("--- {}\n{}", self.log.display(), self.said());
        }
    }
}

/// A router without rules, on a loopback port.
pub fn router(folder: &Path, python: &Path, port: u16) -> Process {
    let config = format!(
        "{{mode: \"router\", listen: {{endpoints: [\"tcp/127.0.0.1:{port}\"]}}, scouting: {{multicast: {{enabled: false}}, gossip: {{enabled: false}}}}}}"
    );
    router_of(folder, python, port, &config)
}

pub fn router_of(folder: &Path, python: &Path, port: u16, config: &str) -> Process {
    let file = folder.join("router.json5");
    std::fs::write(&file, config).unwrap();
    let python = python.to_owned();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/router.py");
    let process = Process::start(folder.join("router.log"), move || {
        let mut command = Command::new(&python);
        command.arg(&script).arg(&file).stdin(Stdio::piped());
        command
    });
    listens(port);
    process
}

pub fn listens(port: u16) {
    eventually("the router listens", || std::net::TcpStream::connect(("127.0.0.1", port)).ok());
}

/// A robot: its domain, with daemon, planner and bridge.
pub struct Robot {
    pub domain: Domain,
    pub daemon: Process,
    pub planner: Process,
    pub bridge: Process,
    _folder: tempfile::TempDir,
}

impl Robot {
    /// `way` is the bridge's section `[router]`.
    pub fn start(name: &str, way: &str, narrators: &[&str], more: &str) -> Self {
        Self::start_in(name, way, narrators, more, None)
    }

    /// Like [`Robot::start`], with another scene.
    pub fn start_in(name: &str, way: &str, narrators: &[&str], more: &str, scene: Option<&Path>) -> Self {
        let known: String = narrators
            .iter()
            .map(|narrator| format!("[[daemon.narrator]]\nname = {narrator:?}\nrelayed = true\nrate_per_s = 0.0\n"))
            .collect();
        let scene = scene.map_or_else(String::new, |scene| format!("[scene]\npath = {scene:?}\n"));
        let robot = format!(
            "{scene}[planner]\nrobot = {name:?}\nroom_time_s = 1.0\n[daemon]\njournal_bytes = 67108864\n[model]\nthreads = 1\n{known}"
        );
        let heard: String = narrators.iter().map(|narrator| format!("[[narrator]]\nname = {narrator:?}\n")).collect();
        Self::start_with(name, way, &robot, &format!("{more}\n{heard}"))
    }

    /// A robot with a ROS 2 connection only, and a map of 8 m by 8 m around the included flat.
    pub fn start_with_ros2(folder: &Path, port: u16) -> Self {
        std::fs::write(folder.join("map.pgm"), b"P5\n160 160\n255\n").unwrap();
        let map = folder.join("map.yaml");
        std::fs::write(&map, "image: map.pgm\nresolution: 0.1\norigin: [-1.0, -1.0, 0.0]\n").unwrap();
        let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes/flat.json");
        let more = format!(
            "[ros2]\nconnect = \"tcp/127.0.0.1:{port}\"\nnarration = true\nscene = {scene:?}\nmap = {map:?}\nmask_s = 0.1\n"
        );
        Self::start_in("robot-1", "", &[], &more, Some(&scene))
    }

    /// Like [`Robot::start`], with a configuration of daemon and planner.
    pub fn start_with(name: &str, way: &str, robot: &str, more: &str) -> Self {
        static DOMAINS: AtomicU32 = AtomicU32::new(0);
        let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
        let path = folder.path().to_owned();
        let number = DOMAINS.fetch_add(1, Ordering::Relaxed);
        let domain = Domain::new(path.join("d"), &format!("{name}-{}-{number}", std::process::id())).unwrap();
        std::fs::write(path.join("roomcast.toml"), robot).unwrap();
        let (root, own) = (domain.root().display(), domain.name());
        let config = format!(
            "{way}\n[robot]\nname = {name:?}\n[ipc]\nroot = \"{root}\"\ndomain = {own:?}\n[tell]\nrepeat_s = 3600.0\n{more}\n"
        );
        std::fs::write(path.join("zenoh.toml"), config).unwrap();
        let service = |role: &'static str, more: Vec<String>| {
            let (path, domain) = (path.clone(), domain.clone());
            move || {
                let mut command = Command::new(roomcast());
                command.arg(role).arg("--config").arg(path.join("roomcast.toml")).args(&more);
                command.arg("--root").arg(domain.root()).args(["--domain", domain.name()]).stdin(Stdio::null());
                command
            }
        };
        let state = vec!["--state".to_owned(), path.join("state").display().to_string()];
        let daemon = Process::start(path.join("daemon.log"), service("daemon", state));
        let planner = Process::start(path.join("planner.log"), service("planner", vec!["--know".into(), "0".into()]));
        let own = path.clone();
        let bridge = Process::start(path.join("bridge.log"), move || {
            let mut command = bridge();
            command.arg("robot").arg("--config").arg(own.join("zenoh.toml"));
            command
        });
        Self { domain, daemon, planner, bridge, _folder: folder }
    }
}

impl Drop for Robot {
    fn drop(&mut self) {
        for process in [&mut self.bridge, &mut self.planner, &mut self.daemon] {
            process.kill();
        }
        // Killed processes leave shared memory behind.
        let _left = self.domain.clean_up();
    }
}

/// An operator's `watch`, line by line.
pub struct Watch {
    child: Child,
    pub lines: Receiver<serde_json::Value>,
}

impl Watch {
    pub fn start(config: &Path) -> Self {
        let mut command = bridge();
        command.arg("watch").arg("--config").arg(config).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        let (to, lines) = channel();
        std::thread::spawn(move || {
            for line in out.lines().map_while(Result::ok) {
                if to.send(serde_json::from_str(&line).unwrap()).is_err() {
                    return;
                }
            }
        });
        Self { child, lines }
    }

    pub fn find(&self, what: &str, mut fits: impl FnMut(&serde_json::Value) -> bool) -> serde_json::Value {
        let start = Instant::now();
        loop {
            let left = PATIENCE.saturating_sub(start.elapsed());
            let line = self.lines.recv_timeout(left).unwrap_or_else(|_| panic!("not within {PATIENCE:?}: {what}"));
            if fits(&line) {
                return line;
            }
        }
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        let _ended = self.child.kill();
        let _waited = self.child.wait();
    }
}
