//! The units, checked by systemd-analyze and run by a private systemd.

use std::collections::BTreeSet;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use roomcast_ipc::Domain;
use rustix::process::{Pid, Signal, kill_process};

use crate::eventually::{PATIENCE, eventually, waited};
use crate::skipped::skipped;

const UNITS: [&str; 9] = [
    "roomcast-daemon.service",
    "roomcast-planner.service",
    "roomcast-narrator.service",
    "roomcast-mqtt.service",
    "roomcast-publish.service",
    "roomcast-robot.service",
    "roomcast-metrics.service",
    "roomcast-view.service",
    "roomcast-zenoh.service",
];

/// These keys increase the delay between restarts. Older versions ignore them with a warning.
const SINCE_254: [&str; 2] = ["RestartSteps", "RestartMaxDelaySec"];

/// The units, with the path of the test's binary.
fn installed() -> Option<tempfile::TempDir> {
    if Command::new("systemd-analyze").arg("--version").output().is_err() {
        skipped("systemd-analyze is not installed (apt-get install systemd)");
        return None;
    }
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd");
    let directory = tempfile::tempdir().unwrap();
    for unit in UNITS.iter().chain(&["roomcast.target"]) {
        let text = std::fs::read_to_string(source.join(unit)).unwrap();
        // roomcast-zenoh is built separately.
        let text = text.replace("/usr/bin/roomcast-zenoh", "/usr/bin/roomcast");
        let text = text.replace("/usr/bin/roomcast", env!("CARGO_BIN_EXE_roomcast"));
        std::fs::write(directory.path().join(unit), text).unwrap();
    }
    Some(directory)
}

#[test]
fn systemd_finds_no_fault_with_the_units() {
    let Some(directory) = installed() else { return };
    let version = Command::new("systemd-analyze").arg("--version").output().unwrap().stdout;
    // "systemd 252 (252.38-1~deb12u1)"
    let version = String::from_utf8_lossy(&version).split_whitespace().nth(1).and_then(|word| word.parse().ok());
    let version: u32 = version.unwrap();
    for unit in UNITS.iter().chain(&["roomcast.target"]) {
        let mut verify = Command::new("systemd-analyze");
        verify.arg("verify").arg(directory.path().join(unit));
        let output = verify.env("SYSTEMD_UNIT_PATH", format!("{}:", directory.path().display())).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        let too_new = |line: &str| line.contains("Unknown key") && SINCE_254.iter().any(|key| line.contains(key));
        let faults: Vec<_> = said.lines().filter(|line| !(version < 254 && too_new(line))).collect();
        assert!(output.status.success() && !faults.concat().contains("roomcast"), "{unit}: {said}");
    }
}

#[test]
fn the_units_exposure_is_2_or_better() {
    let Some(directory) = installed() else { return };
    for unit in UNITS {
        let mut security = Command::new("systemd-analyze");
        security.args(["security", "--offline=true", "--threshold=20"]).arg(directory.path().join(unit));
        let output = security.output().unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        println!("{unit}: {}", said.lines().last().unwrap_or_default());
        assert!(output.status.success(), "{unit}: {said}{}", String::from_utf8_lossy(&output.stderr));
    }
}

#[test]
fn the_shipped_configuration_is_one() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd/roomcast.toml");
    roomcast_services::config::Config::load(&path).unwrap();
}

/// The values of a key in a unit.
fn values(unit: &str, key: &str) -> Vec<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd").join(unit);
    let text = std::fs::read_to_string(path).unwrap();
    let lines = text.lines().filter_map(|line| line.strip_prefix(key)?.strip_prefix('='));
    lines.flat_map(str::split_whitespace).map(str::to_owned).collect()
}

#[test]
fn the_target_starts_and_stops_the_three_in_order() {
    // systemd starts in the order of After= and stops in the reverse; PartOf= passes the target's stop on.
    let daemon = "roomcast-daemon.service".to_owned();
    // The metrics service is not part of the target; users enable it separately.
    for unit in [daemon.as_str(), "roomcast-planner.service", "roomcast-narrator.service"] {
        let target = "roomcast.target".to_owned();
        assert!(values("roomcast.target", "Wants").contains(&unit.to_owned()), "{unit}");
        assert!(values("roomcast.target", "After").contains(&unit.to_owned()), "{unit}");
        assert!(values(unit, "PartOf").contains(&target) && values(unit, "WantedBy").contains(&target), "{unit}");
        assert!(unit == daemon || values(unit, "After").contains(&daemon), "{unit} starts after the daemon");
        assert_eq!(values(unit, "Type"), ["notify"], "{unit} has started when it says so");
        assert_eq!(values(unit, "Restart"), ["always"], "{unit}");
    }
}

#[test]
fn whatever_hangs_is_noticed_by_a_watchdog() {
    for unit in UNITS {
        assert_eq!(values(unit, "WatchdogSec"), ["10s"], "{unit}");
        assert_eq!(
            values(unit, "NotifyAccess"),
            ["main"],
            "{unit}: the signs of life count that the process itself gives"
        );
    }
}

/// A key's duration in seconds.
fn seconds(unit: &str, section: &str, key: &str) -> Option<f64> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd").join(unit);
    let text = std::fs::read_to_string(path).unwrap();
    let section = text.split(&format!("[{section}]\n")).nth(1)?.split("\n[").next()?;
    let value = section.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix('='))?;
    let digits = value.trim_end_matches(char::is_alphabetic);
    let unit = match &value[digits.len()..] {
        "" | "s" => 1.0,
        "ms" => 1e-3,
        "min" => 60.0,
        other => panic!("{value}: what is {other}?"),
    };
    Some(digits.parse::<f64>().unwrap() * unit)
}

/// The times at which systemd starts a unit that always fails at once, until systemd gives up or `end`.
fn starts(unit: &str, grows: bool, end: f64) -> Vec<f64> {
    let limit = |key| seconds(unit, "Unit", key);
    let (interval, burst) = (limit("StartLimitIntervalSec").unwrap_or(10.0), limit("StartLimitBurst").unwrap_or(5.0));
    let delay = |key| seconds(unit, "Service", key);
    let first = delay("RestartSec").unwrap_or(0.1);
    let growth = if grows { delay("RestartSteps").zip(delay("RestartMaxDelaySec")) } else { None };
    let mut starts: Vec<f64> = Vec::new();
    let mut now = 0.0;
    while now < end {
        let recent = starts.iter().rev().take_while(|start| now - **start < interval).count();
        if interval > 0.0 && recent as f64 >= burst {
            break;
        }
        starts.push(now);
        // The delay grows from the first to the longest in equal ratios.
        let step = (starts.len() - 1) as f64;
        now += growth.map_or(first, |(steps, longest)| first * (longest / first).powf((step / steps).min(1.0)));
    }
    starts
}

#[test]
fn what_crashes_at_once_for_an_hour_is_back_soon_after_the_cause_has_gone() {
    const HOUR: f64 = 3600.0;
    for unit in UNITS {
        for grows in [false, true] {
            let starts = starts(unit, grows, HOUR);
            assert!(HOUR - starts.last().unwrap() <= 5.0, "{unit} is given up after {} starts", starts.len());
            assert!(starts.len() <= 7200, "{unit} is started {} times, more than twice a second", starts.len());
            assert!(
                ["roomcast-metrics.service", "roomcast-view.service"].contains(&unit) || starts[1] <= 0.5,
                "{unit} that crashes once is back before the planner's deadline of 2 s"
            );
        }
    }
}

/// A systemd in its own namespaces, with the shipped unit of the daemon. It ends with the test.
struct OwnSystemd {
    /// `unshare`, which kills systemd when it ends.
    child: Child,
    group: PathBuf,
    directory: tempfile::TempDir,
}

impl OwnSystemd {
    /// An error with the reason if this user or machine cannot run it.
    fn start() -> Result<Self, String> {
        let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let (units, source) = (directory.path().join("units"), Path::new(env!("CARGO_MANIFEST_DIR")));
        std::fs::create_dir(&units).unwrap();
        std::fs::copy(env!("CARGO_BIN_EXE_roomcast"), directory.path().join("roomcast")).unwrap();
        let unit = std::fs::read_to_string(source.join("systemd").join(UNITS[0])).unwrap();
        std::fs::write(units.join(UNITS[0]), unit.replace("/usr/bin/roomcast", "/mnt/roomcast")).unwrap();
        // No other unit of the machine may start.
        let alone = "[Unit]\nDefaultDependencies=no\n";
        for target in ["sysinit.target", "basic.target", "shutdown.target", "local-fs.target"] {
            std::fs::write(units.join(target), alone).unwrap();
        }
        std::fs::write(units.join("test.target"), format!("{alone}Wants={}\n", UNITS[0])).unwrap();
        let groups = ["/sys/fs/cgroup/systemd", "/sys/fs/cgroup"].map(Path::new);
        let groups = groups.into_iter().find(|path| path.exists()).ok_or("there are no control groups")?;
        let group = groups.join(format!("roomcast-test-{}", std::process::id()));
        std::fs::create_dir(&group).map_err(|error| format!("no control group can be made: {error}"))?;
        let log = std::fs::File::create(directory.path().join("log")).unwrap();
        // The shell joins the control group, and all its children inherit it.
        let start = "echo 0 > \"$1\"/cgroup.procs && shift && exec \"$@\"";
        let mut command = Command::new("sh");
        command.args(["-c", start, "sh"]).arg(&group).args([
            "unshare",
            "--kill-child=KILL",
            "-fpmCniu",
            "--mount-proc",
        ]);
        command.arg(source.join("tests/support/systemd.sh")).arg(directory.path());
        command.stdin(Stdio::null()).stdout(log.try_clone().unwrap()).stderr(log);
        let mut own = Self { child: command.spawn().unwrap(), group, directory };
        let is_loaded = waited(Duration::from_secs(20), || {
            let is_loaded = own.property("LoadState").is_some_and(|state| state == "loaded");
            (is_loaded || own.child.try_wait().unwrap().is_some()).then_some(is_loaded)
        });
        if is_loaded == Some(true) {
            return Ok(own);
        }
        Err(own.log().lines().last().unwrap_or("it does not start").to_owned())
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.directory.path().join("log")).unwrap()
    }

    /// The process of systemd.
    fn process(&self) -> Option<u32> {
        let of = self.child.id();
        let children = std::fs::read_to_string(format!("/proc/{of}/task/{of}/children")).ok()?;
        children.split_whitespace().next()?.parse().ok()
    }

    /// A property of the daemon's unit.
    fn property(&self, name: &str) -> Option<String> {
        let mut command = Command::new("nsenter");
        command.arg(format!("--target={}", self.process()?)).args(["--mount", "--pid", "--cgroup"]);
        let output = command.args(["systemctl", "show", "--value", "--property", name, UNITS[0]]).output().ok()?;
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    }

    fn until(&self, name: &str, holds: impl Fn(&str) -> bool) -> String {
        let mut newest = None;
        // During this time, systemd restarts the daemon.
        let value = waited(PATIENCE, || {
            newest = self.property(name);
            newest.clone().filter(|value| holds(value))
        });
        value.unwrap_or_else(|| panic!("{name} stays at {newest:?}: {}", self.log()))
    }
}

impl Drop for OwnSystemd {
    fn drop(&mut self) {
        let _gone = self.child.kill();
        let _reaped = self.child.wait();
        // Inner groups are removed first, when their processes have ended.
        let groups = self.group.to_str().unwrap();
        let remove = "for n in 1 2 3 4 5 6 7 8 9; do find \"$0\" -depth -type d -exec rmdir {} + 2>/dev/null && break; sleep 0.1; done";
        let _removed = Command::new("sh").args(["-c", remove, groups]).status();
    }
}

/// `ROOMCAST_RESTARTS=4800` is an hour of failures.
#[test]
#[ignore = "full"]
fn the_shipped_unit_under_a_real_systemd_is_back_when_the_cause_has_gone() {
    let restarts = std::env::var("ROOMCAST_RESTARTS").map_or(12, |text| text.parse::<u64>().unwrap());
    let systemd = match OwnSystemd::start() {
        Ok(systemd) => systemd,
        Err(why) => return skipped(format!("no systemd can be run in namespaces: {why}")),
    };
    // By default systemd gives up after five failures within ten seconds.
    let mut failed = 0;
    while failed < restarts {
        let more = |value: &str| value.parse().is_ok_and(|count: u64| count > failed);
        failed = systemd.until("NRestarts", more).parse().unwrap();
    }
    assert_ne!(systemd.property("ActiveState").as_deref(), Some("active"), "it cannot run with this configuration");
    let configuration = format!("/proc/{}/root/etc/roomcast/roomcast.toml", systemd.process().unwrap());
    std::fs::write(configuration, "").unwrap();
    systemd.until("ActiveState", |state| state == "active");
    println!("failed {failed} times, then ready");
}

/// A supervisor like systemd, for a `Type=notify` service with a watchdog.
struct Supervisor {
    directory: tempfile::TempDir,
    domain: Domain,
    socket: UnixDatagram,
    child: Option<Child>,
}

impl Supervisor {
    fn new() -> Self {
        let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(directory.path().join("d"), &format!("watchdog-{}", std::process::id())).unwrap();
        let socket = UnixDatagram::bind(directory.path().join("notify")).unwrap();
        socket.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        Self { directory, domain, socket, child: None }
    }

    fn start(&mut self) {
        let state = self.directory.path().join("state");
        self.start_service(&["daemon", "--state", state.to_str().unwrap()]);
    }

    fn start_service(&mut self, arguments: &[&str]) {
        self.start_under(&[], arguments);
    }

    fn start_under(&mut self, runner: &[&str], arguments: &[&str]) {
        let program = [runner, &[env!("CARGO_BIN_EXE_roomcast")]].concat();
        let mut command = Command::new(program[0]);
        command
            .args(&program[1..])
            .args(arguments)
            .args(["--domain", self.domain.name(), "--root"])
            .arg(self.domain.root());
        command.env_remove("ROOMCAST_CONFIG");
        command.env("NOTIFY_SOCKET", self.directory.path().join("notify")).env("WATCHDOG_USEC", "10000000");
        self.child = Some(command.stdin(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    }

    fn signal(&self, signal: Signal) {
        let process = Pid::from_raw(self.child.as_ref().unwrap().id().cast_signed()).unwrap();
        kill_process(process, signal).unwrap();
    }

    /// Whether the service sends `word` within `time`.
    fn hears(&self, word: &str, time: Duration) -> bool {
        let start = Instant::now();
        let mut message = [0; 512];
        while start.elapsed() < time {
            if let Ok(length) = self.socket.recv(&mut message)
                && String::from_utf8_lossy(&message[..length]).lines().any(|line| line == word)
            {
                return true;
            }
        }
        false
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        if let Some(mut child) = self.child.take() {
            let _gone = child.kill();
            let _reaped = child.wait();
        }
        let _left = self.domain.clean_up();
    }
}

#[test]
#[ignore = "full"]
fn a_hung_daemon_falls_silent_so_that_the_watchdog_restarts_it() {
    const PATIENCE: Duration = Duration::from_secs(60);
    let mut supervisor = Supervisor::new();
    supervisor.start();
    assert!(supervisor.hears("READY=1", PATIENCE), "it says when it is ready");
    assert!(supervisor.hears("WATCHDOG=1", PATIENCE), "it says that it lives");

    supervisor.signal(Signal::STOP);
    // Messages from before the stop are read first; then there is silence.
    while supervisor.hears("WATCHDOG=1", Duration::from_millis(150)) {}
    assert!(
        !supervisor.hears("WATCHDOG=1", Duration::from_secs(2)),
        "a daemon that stands still does not say that it lives"
    );

    // After WatchdogSec= systemd aborts the service and starts it again. A stopped process can still be killed.
    supervisor.signal(Signal::KILL);
    supervisor.child.take().unwrap().wait().unwrap();
    supervisor.start();
    assert!(supervisor.hears("READY=1", PATIENCE), "the next one takes its place");
}

/// The command of a unit, with changes for the test: a free port, files of the test, an absent broker. `None` for roomcast-zenoh, which is built
/// separately.
fn service_of(unit: &str, folder: &Path) -> Option<Vec<String>> {
    let words = values(unit, "ExecStart");
    if words[0] == "/usr/bin/roomcast-zenoh" {
        return None;
    }
    assert_eq!(words[0], "/usr/bin/roomcast", "{unit}");
    assert!(words.iter().all(|word| !word.contains("://")), "{unit}: what the home has stands in the configuration");
    let path = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    std::fs::write(path("rules"), "[[rule]]\ntopic = \"lamp\"\nsay = \"They switch the lamp on.\"\n").unwrap();
    let broker = || "mqtt://127.0.0.1:9".to_owned();
    let mut command = Vec::new();
    let mut words = words.into_iter().skip(1);
    while let Some(word) = words.next() {
        let instead = match word.as_str() {
            // The shipped configuration belongs to an installed system.
            "--config" => {
                words.next();
                continue;
            }
            "--fifo" => path("fifo"),
            "--mqtt" => {
                command.extend([word, broker(), "--rules".to_owned(), path("rules")]);
                continue;
            }
            _ => {
                command.push(word);
                continue;
            }
        };
        words.next();
        command.extend([word, instead]);
    }
    command.extend(match unit {
        "roomcast-daemon.service" => vec!["--state".to_owned(), path("state")],
        "roomcast-metrics.service" | "roomcast-view.service" => vec!["--listen".to_owned(), "127.0.0.1:0".to_owned()],
        "roomcast-publish.service" | "roomcast-robot.service" => vec!["--mqtt".to_owned(), broker()],
        _ => Vec::new(),
    });
    Some(command)
}

/// Every unit has a watchdog, so systemd kills a silent service after ten seconds. A service must report itself even without a broker or a daemon.
#[test]
#[ignore = "full"]
fn every_service_says_again_and_again_that_it_lives() {
    for unit in UNITS {
        let mut supervisor = Supervisor::new();
        let Some(command) = service_of(unit, supervisor.directory.path()) else { continue };
        supervisor.start_service(&command.iter().map(String::as_str).collect::<Vec<_>>());
        assert!(supervisor.hears("READY=1", Duration::from_secs(60)), "{unit}: {command:?} says when it is ready");
        for _ in 0..3 {
            assert!(supervisor.hears("WATCHDOG=1", Duration::from_secs(5)), "{unit}: {command:?} says that it lives");
        }
    }
}

/// The calls of a group and of the groups in it, from systemd.
fn calls_of(group: &str) -> BTreeSet<String> {
    let output = Command::new("systemd-analyze").args(["syscall-filter", "--no-pager", group]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    // The first line is the group itself; lines with a number sign are prose.
    let names = text.lines().skip(1).map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
    let (groups, calls): (Vec<&str>, Vec<&str>) = names.partition(|name| name.starts_with('@'));
    calls.into_iter().map(str::to_owned).chain(groups.into_iter().flat_map(calls_of)).collect()
}

/// The calls that a unit permits. As in systemd, the first line lists permitted calls, and each later line adds or removes some.
fn allowed(unit: &str) -> BTreeSet<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd").join(unit);
    let text = std::fs::read_to_string(path).unwrap();
    // systemd itself always permits these.
    let mut allowed = calls_of("@default");
    for line in text.lines().filter_map(|line| line.strip_prefix("SystemCallFilter=")) {
        let (takes_away, names) = line.strip_prefix('~').map_or((false, line), |names| (true, names));
        for name in names.split_whitespace() {
            let calls = if name.starts_with('@') { calls_of(name) } else { [name.to_owned()].into() };
            match takes_away {
                true => allowed.retain(|call| !calls.contains(call)),
                false => allowed.extend(calls),
            }
        }
    }
    allowed
}

/// A refused call fails with EPERM, and its function is lost: the scorer's cores, the prefetcher's priority.
#[test]
#[ignore = "full"]
fn every_service_makes_only_calls_that_its_unit_allows() {
    for tool in ["strace", "systemd-analyze"] {
        if Command::new(tool).arg("--version").output().is_err() {
            return skipped(format!("{tool} is not installed (apt-get install strace systemd)"));
        }
    }
    let own = rustix::thread::sched_getaffinity(None).unwrap();
    let core = (0..rustix::thread::CpuSet::MAX_CPU).find(|core| own.is_set(*core)).unwrap();
    for unit in UNITS {
        let mut supervisor = Supervisor::new();
        let folder = supervisor.directory.path().to_owned();
        let Some(mut command) = service_of(unit, &folder) else { continue };
        let (config, seen) = (folder.join("roomcast.toml"), folder.join("calls"));
        std::fs::write(&config, format!("[model]\ncores = [{core}]\n")).unwrap();
        command.extend(["--config".to_owned(), config.to_str().unwrap().to_owned()]);
        // With `-D` strace runs as another process, so that the service is this test's child.
        let runner = ["strace", "-D", "-f", "-qq", "-c", "-U", "name", "-o", seen.to_str().unwrap()];
        supervisor.start_under(&runner, &command.iter().map(String::as_str).collect::<Vec<_>>());
        if !supervisor.hears("READY=1", Duration::from_secs(60)) {
            return skipped("strace may not look at processes here");
        }
        assert!(supervisor.hears("WATCHDOG=1", Duration::from_secs(20)), "{unit}: {command:?} lives");
        supervisor.signal(Signal::TERM);
        supervisor.child.take().unwrap().wait().unwrap();
        // strace writes the list after the service has ended.
        let is_name = |word: &str| {
            !word.is_empty() && word.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'_')
        };
        let made: BTreeSet<String> = eventually("strace lists the calls", || {
            let text = std::fs::read_to_string(&seen).unwrap_or_default();
            // Between the column's head and its foot.
            let list = text.trim().strip_suffix("total").and_then(|all| all.trim().split_once('\n'));
            let (_, names) = list.filter(|(head, _)| *head == "syscall")?;
            Some(names.lines().map(str::trim).filter(|line| is_name(line)).map(str::to_owned).collect())
        });
        assert!(made.contains("execve") && made.len() > 20, "{unit}: {made:?}");
        if unit == UNITS[0] {
            assert!(made.contains("sched_setaffinity") && made.contains("setpriority"), "{made:?}");
        }
        let allowed = allowed(unit);
        // SQLite calls it for root alone; the units have users of their own.
        let is_of_root = |call: &&String| *call == "fchown" && rustix::process::geteuid().is_root();
        let refused: Vec<_> = made.difference(&allowed).filter(|call| !is_of_root(call)).collect();
        assert!(refused.is_empty(), "{unit} refuses {refused:?}");
    }
}

/// The sources of the package's documents. In the package they have the same paths.
fn packaged_documents() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let manifest: toml::Table = std::fs::read_to_string(root.join("Cargo.toml")).unwrap().parse().unwrap();
    let assets = manifest["package"]["metadata"]["deb"]["assets"].as_array().unwrap();
    let mut documents = Vec::new();
    for asset in assets {
        let [from, to] = [0, 1].map(|at| asset[at].as_str().unwrap());
        let Some(folder) = to.strip_prefix("usr/share/doc/roomcast/") else { continue };
        let (parent, pattern) = from.rsplit_once('/').map_or(("", from), |(parent, pattern)| (parent, pattern));
        assert_eq!(parent, folder.trim_end_matches('/'), "a document lies as in the source");
        let (before, after) = pattern.split_once('*').unwrap_or((pattern, ""));
        let names = std::fs::read_dir(root.join(parent)).unwrap().map(|entry| entry.unwrap().file_name());
        let names = names.map(|name| name.into_string().unwrap());
        let fits = |name: &String| match pattern.contains('*') {
            true => name.starts_with(before) && name.ends_with(after),
            false => name == pattern,
        };
        let count = documents.len();
        documents.extend(names.filter(fits).map(|name| Path::new(parent).join(name)));
        assert!(documents.len() > count, "{from} is no file");
    }
    documents
}

#[test]
fn links_of_packaged_documents_lead_to_packaged_files() {
    let documents = packaged_documents();
    let mut links = 0;
    for document in documents.iter().filter(|path| path.extension().is_some_and(|ending| ending == "md")) {
        let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(document)).unwrap();
        for link in text.split("](").skip(1).filter_map(|rest| rest.split([')', '#', ' ']).next()) {
            if link.is_empty() || link.contains("://") {
                continue;
            }
            let mut target = document.parent().unwrap().to_owned();
            for step in Path::new(link).components() {
                match step {
                    std::path::Component::ParentDir => assert!(target.pop(), "{link} in {}", document.display()),
                    step => target.push(step),
                }
            }
            links += 1;
            let is_there = documents.iter().any(|there| there.starts_with(&target));
            assert!(is_there, "{link} in {} leads nowhere in the package", document.display());
        }
    }
    assert!(links > 100, "{links}");
}
