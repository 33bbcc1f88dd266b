//! strace makes the n-th system call of a kind fail in the real process: files, memory maps, sockets, threads. The process continues, or ends with an
//! error message and a documented exit code. It never hangs, panics or ends by a signal, and confirmed events stay.
//!
//! By default the test runs a few faults of each service. `ROOMCAST_SYSCALLS` sets the number, `ROOMCAST_SYSCALLS_SEED` the seed.
//! `ROOMCAST_SYSCALLS=300 cargo test --release --test it syscalls -- --include-ignored --nocapture` is the long run.

use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use roomcast_ipc::Domain;
use roomcast_ipc::raw::DecisionV1;
use roomcast_services::daemon::journal;
use rustix::process::{Pid, Signal, kill_process};

use crate::eventually::{eventually, waited};
use crate::mosquitto::{ANYBODY, Mosquitto, NO_BROKER, free_port};
use crate::number;
use crate::skipped::skipped;
use roomcast_cli::exit_code;

/// Includes the log's last second, and an open that is retried for 5 s.
const PATIENCE: Duration = Duration::from_secs(60);
const DEFAULT_FAULTS: u64 = 12;
const LINES: usize = 6;

/// The calls and their errors. `fcntl` is missing: most of its commands cannot fail on an open descriptor, and strace cannot select the others.
const CALLS: [(&str, &[&str]); 32] = [
    ("openat", &["EMFILE", "EACCES", "EIO", "ENOENT"]),
    ("read", &["EIO"]),
    ("pread64", &["EIO"]),
    ("write", &["ENOSPC", "EIO"]),
    ("writev", &["ENOSPC"]),
    ("pwrite64", &["ENOSPC"]),
    ("fsync", &["EIO"]),
    ("fdatasync", &["EIO"]),
    ("rename", &["EIO", "ENOSPC"]),
    ("unlink", &["EIO"]),
    ("mkdir", &["ENOSPC"]),
    ("ftruncate", &["ENOSPC"]),
    ("fallocate", &["ENOSPC"]),
    ("fchmod", &["EPERM"]),
    ("flock", &["ENOLCK"]),
    ("statx", &["EIO", "ENOENT"]),
    ("newfstatat", &["EIO"]),
    ("getdents64", &["EIO"]),
    ("mmap", &["ENOMEM"]),
    ("memfd_create", &["EMFILE"]),
    ("socket", &["EMFILE", "ENOBUFS"]),
    ("socketpair", &["EMFILE"]),
    ("bind", &["ENOMEM"]),
    ("listen", &["ENOBUFS"]),
    ("connect", &["ECONNREFUSED", "EAGAIN"]),
    ("accept4", &["EMFILE", "ECONNABORTED"]),
    ("sendto", &["ENOBUFS", "ECONNREFUSED"]),
    ("recvfrom", &["ENOMEM", "EINTR"]),
    ("epoll_create1", &["EMFILE"]),
    ("epoll_ctl", &["ENOMEM"]),
    ("poll", &["EINTR"]),
    ("clone3", &["EAGAIN"]),
];
/// Calls that may fail from then on until the process is asked to stop.
const LASTING: [&str; 6] = ["openat", "write", "fdatasync", "ftruncate", "socket", "accept4"];

#[derive(Debug, Clone, Copy)]
struct Fault {
    call: &'static str,
    error: &'static str,
    number: u64,
    lasting: bool,
}

impl Fault {
    fn expression(self) -> String {
        let then_on = if self.lasting { "+" } else { "" };
        format!("inject={}:error={}:when={}{then_on}", self.call, self.error, self.number)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Daemon,
    Planner,
    Narrator,
    Mqtt,
    Metrics,
}

enum Ended {
    /// The process did its work, and ended when it was asked to.
    WentOn,
    /// The process ended by itself with an error message.
    InWords,
    /// Rust's runtime or allocator had no memory and aborted the process; a program cannot avoid that.
    OutOfMemory,
}

/// The messages of such an abort.
const OUT_OF_MEMORY: [&str; 2] = ["memory allocation of", "failed to allocate an alternative stack"];
/// tokio's panic when it cannot write its wake-up counter. The kernel never refuses that write, but strace cannot tell the counter from a file.
const NO_FAULT_OF_A_KERNEL: &str = "failed to wake I/O driver";

/// A private domain for the process under test. It stays over all faults, so each fault meets the traces of the one before.
struct World {
    role: Role,
    directory: tempfile::TempDir,
    domain: Domain,
    helpers: Vec<Child>,
    broker: Option<Mosquitto>,
    said: usize,
    ended: usize,
    /// Lines that were confirmed, or accepted by the broker.
    confirmed: Vec<String>,
}

impl World {
    fn new(role: Role) -> Self {
        let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let name = format!("{role:?}").to_lowercase();
        let domain = Domain::new(directory.path().join("d"), &format!("{name}-{}", std::process::id())).unwrap();
        let text = format!(
            "[model]\nthreads = 1\n[daemon]\nstate = {:?}\nheartbeat_ms = 100\njournal_sync_ms = 20\n[habits]\nsave_s = 1.0\n\
             [planner]\nknow_s = 0.0\npolicy = \"greedy-avoidance\"\nroom_time_s = 0.02\n",
            directory.path().join("state"),
        );
        fs::write(directory.path().join("roomcast.toml"), text).unwrap();
        fs::write(directory.path().join("rules.toml"), "[[rule]]\ntopic = \"home/+\"\nsay = \"They {value}.\"\n")
            .unwrap();
        let mut world = Self {
            role,
            directory,
            domain,
            helpers: Vec::new(),
            broker: None,
            said: 0,
            ended: 0,
            confirmed: Vec::new(),
        };
        if role != Role::Daemon {
            let daemon = world.command(&[], &["daemon"]);
            world.start_helper(daemon, "daemon");
            world.wait_for_log("daemon", "ready: the first scores are out");
        }
        world
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    fn log(&self, name: &str) -> String {
        String::from_utf8_lossy(&fs::read(self.path(&format!("{name}.log"))).unwrap_or_default()).into_owned()
    }

    /// `prefix` is a program that runs the command, such as strace.
    fn command(&self, prefix: &[String], arguments: &[&str]) -> Command {
        let program = env!("CARGO_BIN_EXE_roomcast").to_owned();
        let words: Vec<_> = prefix.iter().cloned().chain([program]).collect();
        let mut command = Command::new(&words[0]);
        command.args(&words[1..]).args(arguments).arg("--root").arg(self.domain.root());
        command.args(["--domain", self.domain.name()]).arg("--config").arg(self.path("roomcast.toml"));
        command.stdin(Stdio::null());
        command
    }

    fn spawn(&self, mut command: Command, log: &str) -> Child {
        let out = File::create(self.path(&format!("{log}.out"))).unwrap();
        command.stdout(out).stderr(File::create(self.path(&format!("{log}.log"))).unwrap()).spawn().unwrap()
    }

    fn start_helper(&mut self, command: Command, log: &str) {
        let child = self.spawn(command, log);
        self.helpers.push(child);
    }

    fn wait_for_log(&self, log: &str, words: &str) {
        eventually(&format!("{log} says {words:?}"), || self.log(log).contains(words).then_some(()));
    }

    /// A broker that queues messages for offline sessions. `None` if mosquitto is not installed.
    fn start_broker(&mut self) -> Option<u16> {
        self.broker = Mosquitto::start(free_port(), tempfile::tempdir().unwrap(), ANYBODY);
        self.broker.as_ref().map(|broker| broker.port)
    }

    fn port(&self) -> u16 {
        self.broker.as_ref().unwrap().port
    }

    /// The journal's sentences and their number.
    fn kept(&self) -> HashMap<String, usize> {
        let mut kept = HashMap::new();
        let Ok(recovered) = journal::look(&self.path("state")) else { return kept };
        for observation in &recovered.observations {
            *kept.entry(observation.sentence().unwrap_or_default().to_owned()).or_insert(0) += 1;
        }
        kept
    }

    fn lines(&mut self) -> Vec<String> {
        let first = self.said;
        self.said += LINES;
        (first..self.said).map(|number| format!("They walk to the sofa {number}.")).collect()
    }

    fn narrate(&self, prefix: &[String], lines: &[String], linger_s: &str) -> Command {
        let file = self.path("lines.txt");
        fs::write(&file, lines.join("\n") + "\n").unwrap();
        self.command(
            prefix,
            &["narrate", file.to_str().unwrap(), "--name", "person", "--pace", "0", "--json", "--linger", linger_s],
        )
    }

    /// Notes the lines that the ended narrator reports as confirmed; returns whether all were.
    fn note_confirmed(&mut self, lines: &[String]) -> bool {
        let told = fs::read(self.path("narrator.out")).unwrap_or_default();
        let Ok(outcome) = serde_json::from_slice::<serde_json::Value>(&told) else { return false };
        let confirmed = usize::try_from(outcome["confirmed"].as_u64().unwrap()).unwrap();
        assert!(outcome["dropped"] == 0, "{outcome}");
        self.confirmed.extend_from_slice(&lines[..confirmed]);
        confirmed == lines.len()
    }

    /// One run of the process under test. `prefix` is the strace command; an error describes the failure.
    fn trial(&mut self, prefix: &[String], lasting: bool) -> Result<Ended, String> {
        match self.role {
            Role::Daemon => self.daemon(prefix, lasting),
            Role::Planner => self.planner(prefix, lasting),
            Role::Narrator => self.narrator(prefix, lasting),
            Role::Mqtt => self.mqtt(prefix, lasting),
            Role::Metrics => self.metrics(prefix, lasting),
        }
    }

    fn daemon(&mut self, prefix: &[String], lasting: bool) -> Result<Ended, String> {
        let mut child = self.spawn(self.command(prefix, &["daemon"]), "tested");
        let ready = |world: &mut Self| world.log("tested").contains("ready: the first scores are out");
        if let Some(status) = self.until("ready", &mut child, lasting, ready)? {
            return self.judge(prefix, status);
        }
        let lines = self.lines();
        let mut narrator = self.spawn(self.narrate(&[], &lines, if lasting { "1" } else { "60" }), "narrator");
        let ended = self.until("heard", &mut child, false, |_| narrator.try_wait().unwrap().is_some())?;
        if ended.is_some() {
            signal(&narrator, Signal::TERM);
        }
        narrator.wait().unwrap();
        let all = self.note_confirmed(&lines);
        if let Some(status) = ended {
            return self.judge(prefix, status);
        }
        let status = self.stop(child)?;
        let judged = self.judge(prefix, status)?;
        if !all && !lasting {
            return Err(format!("it goes on and hears nobody: {status}, {}", self.log("narrator")));
        }
        Ok(judged)
    }

    fn planner(&mut self, prefix: &[String], lasting: bool) -> Result<Ended, String> {
        let node = self.domain.open("test").unwrap();
        let decisions = node.subscriber::<DecisionV1>().unwrap();
        let mut child = self.spawn(self.command(prefix, &["planner"]), "tested");
        let mut heard = 0;
        let ended = self.until("three decisions", &mut child, lasting, |_| {
            // One decision may be left from the planner before.
            heard += std::iter::from_fn(|| decisions.receive().unwrap()).count();
            heard > 3
        })?;
        match ended {
            Some(status) => self.judge(prefix, status),
            None => self.stop(child).and_then(|status| self.judge(prefix, status)),
        }
    }

    fn narrator(&mut self, prefix: &[String], lasting: bool) -> Result<Ended, String> {
        let lines = self.lines();
        let linger_s = if lasting { "1" } else { "60" };
        let mut child = self.spawn(self.narrate(prefix, &lines, linger_s), "narrator");
        fs::rename(self.path("narrator.log"), self.path("tested.log")).unwrap();
        let ended = self.until("confirmed", &mut child, false, |_| false)?;
        let judged = self.judge(prefix, ended.unwrap())?;
        let all = self.note_confirmed(&lines);
        // The failed call may be the final output.
        if matches!(judged, Ended::WentOn) && !all {
            return Err("it ended well without all confirmed".to_owned());
        }
        Ok(judged)
    }

    fn mqtt(&mut self, prefix: &[String], lasting: bool) -> Result<Ended, String> {
        let (address, rules) = (format!("mqtt://127.0.0.1:{}", self.port()), self.path("rules.toml"));
        let arguments = ["narrate", "--mqtt", &address, "--rules", rules.to_str().unwrap(), "--linger", "5"];
        let mut child = self.spawn(self.command(prefix, &arguments), "tested");
        // The broker queues messages only after the narrator's first session.
        if self.confirmed.is_empty() {
            let met = |world: &mut Self| {
                let probe = world.lines();
                publish(world.port(), &probe[..1]);
                waited(Duration::from_millis(100), || (!world.kept().is_empty()).then_some(())).is_some()
            };
            if let Some(status) = self.until("met", &mut child, lasting, met)? {
                return self.judge(prefix, status);
            }
        }
        let lines = self.lines();
        // The broker queues them for the narrator's session, even when the narrator is away.
        publish(self.port(), &lines);
        self.confirmed.extend_from_slice(&lines);
        let heard = |world: &mut Self| {
            let kept = world.kept();
            lines.iter().all(|line| kept.contains_key(line))
        };
        match self.until("narrated", &mut child, lasting, heard)? {
            Some(status) => self.judge(prefix, status),
            None => self.stop(child).and_then(|status| self.judge(prefix, status)),
        }
    }

    fn metrics(&mut self, prefix: &[String], lasting: bool) -> Result<Ended, String> {
        let mut child = self.spawn(self.command(prefix, &["metrics", "--listen", "127.0.0.1:0"]), "tested");
        let mut scraped = 0;
        let ended = self.until("scraped twice", &mut child, lasting, |world| {
            let said = world.log("tested");
            let address = said.split("http://").nth(1).and_then(|rest| Some(rest.split_once("/metrics")?.0));
            scraped += usize::from(address.and_then(scrape).is_some_and(|text| text.contains("roomcast_daemon_up 1")));
            scraped >= 2
        })?;
        match ended {
            Some(status) => self.judge(prefix, status),
            None => self.stop(child).and_then(|status| self.judge(prefix, status)),
        }
    }

    /// Waits for a condition, or for the end of the process. After a lasting fault, a process may also just wait.
    fn until(
        &mut self,
        what: &str,
        child: &mut Child,
        lasting: bool,
        mut holds: impl FnMut(&mut Self) -> bool,
    ) -> Result<Option<ExitStatus>, String> {
        let patience = if lasting { Duration::from_secs(8) } else { PATIENCE };
        let seen = waited(patience, || match child.try_wait().unwrap() {
            None => holds(self).then_some(None),
            ended => Some(ended),
        });
        match seen {
            Some(ended) => Ok(ended),
            None if lasting => Ok(None),
            None => {
                let _gone = child.kill();
                let _reaped = child.wait();
                Err(format!("it is not {what} after {patience:?}"))
            }
        }
    }

    fn stop(&mut self, mut child: Child) -> Result<ExitStatus, String> {
        signal(&child, Signal::TERM);
        let ended = self.until("gone when asked to stop", &mut child, false, |_| false)?;
        Ok(ended.unwrap())
    }

    fn judge(&self, prefix: &[String], status: ExitStatus) -> Result<Ended, String> {
        let said = self.log("tested");
        let last = said.lines().last().unwrap_or_default();
        if status.signal() == Some(Signal::ABORT.as_raw()) && OUT_OF_MEMORY.iter().any(|words| said.contains(words)) {
            return Ok(Ended::OutOfMemory);
        }
        if let Some(signal) = status.signal() {
            return Err(format!("it ended by signal {signal}"));
        }
        if said.contains("panicked") && !said.contains(NO_FAULT_OF_A_KERNEL) {
            return Err(format!("it panicked, {status}"));
        }
        let code = u8::try_from(status.code().unwrap()).unwrap();
        let documented =
            [exit_code::OK, exit_code::FAILURE, exit_code::INPUT, exit_code::CONFIG, exit_code::MODEL, exit_code::IPC];
        if !documented.contains(&code) {
            return Err(format!("it ended with the exit code {code}"));
        }
        if code == exit_code::OK {
            return Ok(Ended::WentOn);
        }
        // If `write` fails, the error message may be lost, and the exit code suffices.
        let told = last.starts_with("roomcast: ") || prefix.iter().any(|word| word.starts_with("inject=write"));
        if told { Ok(Ended::InWords) } else { Err(format!("it ended with {code} and no error")) }
    }

    /// A run without a fault: no confirmed line is lost, and none is recorded twice.
    fn check(&mut self) {
        // Half-made shared memory is removed when it is two seconds old.
        std::thread::sleep(Duration::from_secs(3));
        let ended = self.trial(&[], false);
        if !matches!(ended, Ok(Ended::WentOn)) {
            panic!("after its faults, {:?} without one: {:?}\n{}", self.role, ended.err(), self.log("tested"));
        }
        if self.role != Role::Daemon {
            let daemon = &mut self.helpers[0];
            assert!(daemon.try_wait().unwrap().is_none(), "the daemon has ended: {}", self.log("daemon"));
        }
        let kept = self.kept();
        let lost: Vec<_> = self.confirmed.iter().filter(|line| !kept.contains_key(*line)).collect();
        assert!(lost.is_empty(), "{:?}: {} of {} are lost: {lost:?}", self.role, lost.len(), self.confirmed.len());
        // When a narrator ends, the broker resends unacknowledged messages, even if they have just been confirmed.
        let most = if self.role == Role::Mqtt { 1 + self.ended } else { 1 };
        let twice: Vec<_> = kept.iter().filter(|(_, count)| **count > most).collect();
        assert!(twice.is_empty(), "{:?}: {twice:?}", self.role);
    }
}

impl Drop for World {
    fn drop(&mut self) {
        for child in &mut self.helpers {
            let _gone = child.kill();
            let _reaped = child.wait();
        }
        let _left = self.domain.clean_up();
    }
}

fn signal(child: &Child, signal: Signal) {
    let _gone = kill_process(Pid::from_raw(child.id().cast_signed()).unwrap(), signal);
}

/// Publishes by MQTT 3.1.1 with quality of service 1, and waits for the broker's acknowledgement.
fn publish(port: u16, lines: &[String]) {
    let mut broker = TcpStream::connect(("127.0.0.1", port)).unwrap();
    broker.write_all(b"\x10\x10\x00\x04MQTT\x04\x02\x00\x3c\x00\x04test").unwrap();
    broker.read_exact(&mut [0; 4]).unwrap();
    for (line, number) in lines.iter().zip(1_u8..) {
        let said = line.trim_start_matches("They ").trim_end_matches('.');
        let (topic, length) = (b"home/a", u8::try_from(2 + 6 + 2 + said.len()).unwrap());
        let packet = [&[0x32, length, 0, 6], &topic[..], &[0, number], said.as_bytes()].concat();
        broker.write_all(&packet).unwrap();
        broker.read_exact(&mut [0; 4]).unwrap();
    }
}

fn scrape(address: &str) -> Option<String> {
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    stream.write_all(b"GET /metrics HTTP/1.0\r\nHost: localhost\r\n\r\n").ok()?;
    let mut text = String::new();
    stream.read_to_string(&mut text).ok()?;
    Some(text)
}

/// The strace command, with its log in `file`.
fn strace(file: &Path, expressions: &[String]) -> Vec<String> {
    let fixed = ["strace", "-D", "-f", "-qq", "--seccomp-bpf", "-o", file.to_str().unwrap()];
    let expressions = expressions.iter().flat_map(|expression| ["-e", expression]);
    fixed.into_iter().chain(expressions).map(str::to_owned).collect()
}

/// For each call: the number in the thread with the most of them, and the number in the dynamic loader before the program starts.
fn counted(log: &str) -> BTreeMap<&'static str, (u64, u64)> {
    let mut threads: BTreeMap<(&str, &'static str), u64> = BTreeMap::new();
    let mut loader = BTreeMap::new();
    let main = log.split_whitespace().next().unwrap_or_default();
    let mut begun = false;
    for line in log.lines() {
        let Some((thread, said)) = line.split_once(' ') else { continue };
        // Rust's runtime starts with this call.
        begun |= said.trim_start().starts_with("poll([{fd=0");
        let name = said.trim_start().split('(').next().unwrap_or_default();
        let Some(&(call, _)) = CALLS.iter().find(|(call, _)| *call == name) else { continue };
        *threads.entry((thread, call)).or_default() += 1;
        if !begun && thread == main {
            *loader.entry(call).or_default() += 1;
        }
    }
    let mut most: BTreeMap<&'static str, (u64, u64)> = BTreeMap::new();
    for ((_, call), count) in threads {
        let entry = most.entry(call).or_insert((0, loader.get(call).copied().unwrap_or_default()));
        entry.0 = entry.0.max(count);
    }
    most
}

fn may_trace() -> bool {
    let tried = Command::new("strace").args(["-qq", "-f", "--seccomp-bpf", "-o", "/dev/null", "true"]).output();
    match tried {
        Err(_) => skipped("strace is not installed (apt-get install strace)"),
        Ok(tried) if !tried.status.success() => skipped("strace may not trace here"),
        Ok(_) => return true,
    }
    false
}

fn whatever_fails(role: Role) {
    if !may_trace() {
        return;
    }
    let faults = number("ROOMCAST_SYSCALLS").unwrap_or(DEFAULT_FAULTS);
    let seed = number("ROOMCAST_SYSCALLS_SEED").unwrap_or(1);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut world = World::new(role);
    if role == Role::Mqtt && world.start_broker().is_none() {
        skipped(NO_BROKER);
        return;
    }
    // The calls without any fault. The loader's calls are not tested.
    let file = world.path("calls");
    let names: Vec<_> = CALLS.iter().map(|(call, _)| *call).collect();
    let plain = world.trial(&strace(&file, &[format!("trace={}", names.join(","))]), false);
    assert!(matches!(plain, Ok(Ended::WentOn)), "{:?}: {}", plain.err(), world.log("tested"));
    let counted = counted(&fs::read_to_string(&file).unwrap());
    let kinds: Vec<_> =
        CALLS.iter().filter(|(call, _)| counted.get(call).is_some_and(|(all, own)| all > own)).collect();

    let (mut injected, mut in_words, mut out_of_memory, mut wrong) = (0, 0, 0, Vec::new());
    for trial in 0..faults {
        let &(call, errors) = kinds[usize::try_from(trial).unwrap() % kinds.len()];
        let (most, loader) = counted[&call];
        let fault = Fault {
            call,
            error: errors[rng.random_range(0..errors.len())],
            number: rng.random_range(loader + 1..=most.min(loader + 400)),
            lasting: LASTING.contains(&call) && rng.random_bool(0.2),
        };
        let prefix = strace(&file, &[format!("trace={call}"), fault.expression()]);
        let start = Instant::now();
        match world.trial(&prefix, fault.lasting) {
            Ok(Ended::WentOn) => {}
            Ok(Ended::InWords) => (in_words, world.ended) = (in_words + 1, world.ended + 1),
            Ok(Ended::OutOfMemory) => (out_of_memory, world.ended) = (out_of_memory + 1, world.ended + 1),
            Err(error) => {
                println!("--- {role:?} {fault:?} after {:?}: {error}\n{}", start.elapsed(), world.log("tested"));
                wrong.push((fault, error));
            }
        }
        injected += u64::from(fs::read_to_string(&file).unwrap_or_default().contains("(INJECTED)"));
    }
    world.check();
    println!(
        "{role:?}: {faults} runs, {injected} with a fault, {in_words} ended with an error, {out_of_memory} by the runtime, {} wrong; {} kinds, seed {seed}",
        wrong.len(),
        kinds.len()
    );
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert!(injected > faults / 4, "too few faults were met");
}

#[test]
#[ignore = "full"]
fn whatever_fails_the_daemon_goes_on_or_says_why() {
    whatever_fails(Role::Daemon);
}

#[test]
#[ignore = "full"]
fn whatever_fails_the_planner_goes_on_or_says_why() {
    whatever_fails(Role::Planner);
}

#[test]
#[ignore = "full"]
fn whatever_fails_the_narrator_goes_on_or_says_why() {
    whatever_fails(Role::Narrator);
}

#[test]
#[ignore = "full"]
fn whatever_fails_the_narrator_of_a_broker_goes_on_or_says_why() {
    whatever_fails(Role::Mqtt);
}

#[test]
#[ignore = "full"]
fn whatever_fails_the_metrics_go_on_or_say_why() {
    whatever_fails(Role::Metrics);
}
