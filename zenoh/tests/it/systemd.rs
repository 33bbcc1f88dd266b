//! The bridge under the unit's command line: it reports to systemd that it is ready and alive, also without its router.

use std::any::Any;
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, NarrationV1, PersonForecastsV1, PersonScoresV1, RobotReportV1, RoomScoresV1,
};
use roomcast_ipc::{Domain, question};
use roomcast_zenoh::config::NARRATORS_MAX;

use crate::support::{PATIENCE, Process, bridge, free_port};

/// The value of a key in the unit.
fn of_unit(key: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../systemd/roomcast-zenoh.service");
    let unit = std::fs::read_to_string(path).unwrap();
    unit.lines().find_map(|line| line.strip_prefix(key)).unwrap().to_owned()
}

/// The unit's bridge with another configuration, and its notification socket.
struct Unit {
    domain: Domain,
    process: Process,
    socket: UnixDatagram,
    _folder: tempfile::TempDir,
}

impl Unit {
    /// `more` is the configuration besides router and domain; `files` limits the open files.
    fn start(name: &str, more: &str, files: &str) -> Self {
        let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("{name}-{}", std::process::id())).unwrap();
        let (config, notify) = (folder.path().join("zenoh.toml"), folder.path().join("notify"));
        let (root, own, port) = (domain.root(), domain.name(), free_port());
        let text =
            format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"\n[ipc]\nroot = {root:?}\ndomain = {own:?}\n{more}");
        std::fs::write(&config, text).unwrap();
        let socket = UnixDatagram::bind(&notify).unwrap();
        socket.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        let shipped = "/etc/roomcast/zenoh.toml";
        let start = of_unit("ExecStart=/usr/bin/roomcast-zenoh ");
        assert!(start.contains(shipped), "{start}");
        let start = start.replace(shipped, config.to_str().unwrap());
        let arguments: Vec<String> = start.split_whitespace().map(str::to_owned).collect();
        let limit = format!("ulimit -n {files} && exec \"$0\" \"$@\"");
        let process = Process::start(folder.path().join("log"), move || {
            let mut command = Command::new("sh");
            command.args(["-c", &limit]).arg(bridge().get_program()).args(&arguments).stdin(Stdio::null());
            command.env_remove("ROOMCAST_ZENOH_CONFIG");
            command.env("NOTIFY_SOCKET", &notify).env("WATCHDOG_USEC", "10000000");
            command
        });
        Self { domain, process, socket, _folder: folder }
    }

    /// Waits until the bridge sends a word to systemd, or has ended.
    fn says(&mut self, word: &str) -> bool {
        let start = Instant::now();
        let mut message = [0; 512];
        while start.elapsed() < PATIENCE && self.process.is_alive() {
            if let Ok(length) = self.socket.recv(&mut message)
                && String::from_utf8_lossy(&message[..length]).lines().any(|line| line == word)
            {
                return true;
            }
        }
        false
    }
}

impl Drop for Unit {
    fn drop(&mut self) {
        self.process.kill();
        self.domain.clean_up().unwrap();
    }
}

#[test]
fn the_units_bridge_says_that_it_lives_while_its_router_is_away() {
    let mut unit = Unit::start("unit", "", &of_unit("LimitNOFILE="));
    assert!(unit.says("READY=1"), "it says when it is ready");
    let start = Instant::now();
    (0..3).for_each(|_| assert!(unit.says("WATCHDOG=1"), "it says again and again that it lives"));
    assert!(start.elapsed() < Duration::from_secs(10), "three times before the watchdog would restart it");
}

/// A restart does not help, so the log names the setting.
#[test]
fn a_scene_that_is_not_there_is_told_with_its_cause_and_is_of_the_configuration() {
    let ros2 = format!("[ros2]\nconnect = \"tcp/127.0.0.1:{}\"\nscene = \"gone.json\"\n", free_port());
    let mut unit = Unit::start("scene", &ros2, &of_unit("LimitNOFILE="));
    assert_eq!(unit.process.wait(), 2);
    let said = unit.process.said();
    let told = said.lines().find(|line| line.contains("ros2.scene")).unwrap_or_default();
    assert!(told.contains("gone.json") && told.contains("No such file or directory"), "{said}");
    assert_eq!(
        told.matches("No such file").count() + told.matches("gone.json").count(),
        2,
        "each is said once: {told}"
    );
}

/// The largest configuration that the manual permits.
fn largest(folder: &Path) -> String {
    let map = folder.join("map.yaml");
    std::fs::write(folder.join("map.pgm"), b"P5\n160 160\n255\n").unwrap();
    std::fs::write(&map, "image: map.pgm\nresolution: 0.1\norigin: [-1.0, -1.0, 0.0]\n").unwrap();
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes/flat.json");
    let narrators: String =
        (0..NARRATORS_MAX).map(|number| format!("[[narrator]]\nname = \"hub-{number}\"\n")).collect();
    format!(
        "[habits]\nshare = true\n[ask]\nmoment = true\nmap_change = true\nperson = true\n[peers]\nhear = true\n\
         [ros2]\nconnect = \"tcp/127.0.0.1:{}\"\nnarration = true\nscene = {scene:?}\nmap = {map:?}\n{narrators}",
        free_port()
    )
}

/// The ports of a busy home: daemon, narrators, planners, robots and observers.
fn house(domain: &Domain) -> Vec<Box<dyn Any>> {
    let mut ports: Vec<Box<dyn Any>> = Vec::new();
    let daemon = domain.open("daemon").unwrap();
    ports.push(Box::new((daemon.publisher::<RoomScoresV1>().unwrap(), daemon.publisher::<ForecastV1>().unwrap())));
    ports.push(Box::new((
        daemon.publisher::<PersonScoresV1>().unwrap(),
        daemon.publisher::<PersonForecastsV1>().unwrap(),
    )));
    ports.push(Box::new((daemon.subscriber::<NarrationV1>().unwrap(), daemon.status_server().unwrap())));
    for service in [question::MOMENT, question::MAP_CHANGE, question::PERSON, question::HABITS] {
        ports.push(Box::new(daemon.answer_port(service).unwrap()));
    }
    for number in 0..2 {
        let node = domain.open(&format!("narrator-{number}")).unwrap();
        ports.push(Box::new((
            node.publisher::<NarrationV1>().unwrap(),
            node.subscriber::<RoomScoresV1>().unwrap(),
            node,
        )));
    }
    for number in 0..2 {
        let node = domain.open(&format!("planner-{number}")).unwrap();
        ports.push(Box::new((node.publisher::<DecisionV1>().unwrap(), node.subscriber::<RobotReportV1>().unwrap())));
        ports.push(Box::new((
            node.subscriber::<RoomScoresV1>().unwrap(),
            node.subscriber::<ForecastV1>().unwrap(),
            node,
        )));
    }
    for number in 0..6 {
        let node = domain.open(&format!("looks-{number}")).unwrap();
        ports.push(Box::new((node.subscriber::<RoomScoresV1>().unwrap(), node.subscriber::<DecisionV1>().unwrap())));
        ports.push(Box::new((
            node.subscriber::<ForecastV1>().unwrap(),
            node.subscriber::<PersonForecastsV1>().unwrap(),
        )));
        ports.push(Box::new((node.status_client().unwrap(), node)));
    }
    ports.push(Box::new(daemon));
    ports
}

/// One notification a second, for longer than the bridge tries to open a port.
const SIGNS_OF_LIFE: usize = 12;

/// The largest permitted configuration starts under the unit's limit. Above the limit, the error says so.
#[test]
fn the_largest_configuration_starts_under_the_units_limit_of_files() {
    let folder = tempfile::tempdir().unwrap();
    let more = largest(folder.path());
    let mut unit = Unit::start("largest", &more, &of_unit("LimitNOFILE="));
    let _house = house(&unit.domain);
    for _ in 0..SIGNS_OF_LIFE {
        assert!(unit.says("WATCHDOG=1"), "{}", unit.process.said());
    }
    let limit: usize = of_unit("LimitNOFILE=").parse().unwrap();
    let open = std::fs::read_dir(format!("/proc/{}/fd", unit.process.id())).unwrap().count();
    assert!(open * 2 < limit, "{open} of {limit} are open: hardly more may join");

    let mut unit = Unit::start("fewer", &more, "96");
    assert_eq!(unit.process.wait(), 1);
    let said = unit.process.said();
    assert!(said.contains("files are open in this process, of at most 96: raise the limit"), "{said}");
}

#[test]
fn completions_offer_every_command() {
    for shell in ["bash", "zsh", "fish"] {
        let output = bridge().args(["completions", shell]).output().unwrap();
        let script = String::from_utf8(output.stdout).unwrap();
        for offered in ["robot", "hub", "watch", "config", "router", "completions", "input", "domain"] {
            assert!(output.status.success() && script.contains(offered), "{shell}: {offered} is missing");
        }
    }
}
