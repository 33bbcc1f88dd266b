//! The unit's own command line, as systemd starts it: the bridge says when it is ready and that it lives, also while its router is away.

#![expect(clippy::unwrap_used, reason = "a panic in a test is the report")]

use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::time::{Duration, Instant};

use roomcast_ipc::Domain;

mod support;

use support::{PATIENCE, Process, bridge, free_port};

/// The arguments of the unit, with another configuration.
fn arguments(config: &Path) -> Vec<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../systemd/roomcast-zenoh.service");
    let unit = std::fs::read_to_string(path).unwrap();
    let start = unit.lines().find_map(|line| line.strip_prefix("ExecStart=/usr/bin/roomcast-bridge ")).unwrap();
    let shipped = "/etc/roomcast/bridge.toml";
    assert!(start.contains(shipped), "{start}");
    start.split_whitespace().map(|argument| argument.replace(shipped, config.to_str().unwrap())).collect()
}

#[test]
fn the_units_bridge_says_that_it_lives_while_its_router_is_away() {
    let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
    let domain = Domain::new(folder.path().join("d"), &format!("unit-{}", std::process::id())).unwrap();
    let (config, notify) = (folder.path().join("bridge.toml"), folder.path().join("notify"));
    let (root, name, port) = (domain.root(), domain.name(), free_port());
    let text = format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"\n[ipc]\nroot = {root:?}\ndomain = {name:?}\n");
    std::fs::write(&config, text).unwrap();
    let socket = UnixDatagram::bind(&notify).unwrap();
    socket.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
    let arguments = arguments(&config);
    let mut unit = Process::start(folder.path().join("log"), move || {
        let mut command = bridge();
        command.args(&arguments).env("NOTIFY_SOCKET", &notify).env("WATCHDOG_USEC", "10000000");
        command
    });
    let hears = |word: &str| {
        let start = Instant::now();
        let mut message = [0; 512];
        while start.elapsed() < PATIENCE {
            if let Ok(length) = socket.recv(&mut message)
                && String::from_utf8_lossy(&message[..length]).lines().any(|line| line == word)
            {
                return true;
            }
        }
        false
    };
    assert!(hears("READY=1"), "it says when it is ready");
    let start = Instant::now();
    (0..3).for_each(|_| assert!(hears("WATCHDOG=1"), "it says again and again that it lives"));
    assert!(start.elapsed() < Duration::from_secs(10), "three times before the watchdog would restart it");
    assert!(unit.is_alive());
    unit.kill();
    domain.clean_up().unwrap();
}
