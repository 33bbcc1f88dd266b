//! `roomcast init` and `roomcast doctor` on a good home and on homes with one mistake each. Real brokers, real processes. Each finding has a cause, a
//! place and a remedy.

use std::io::{Read, Write};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, SystemTime};

use serde_json::Value;

use roomcast_cli::exit_code;

use crate::eventually::eventually;
use crate::mosquitto::{ANYBODY, Mosquitto, free_port};
use crate::skipped::skipped;
use crate::world::{Process, World};

const ROBOT: &str = "valetudo/rocky";
const AREAS: &str = r#"{"data": {"areas": [{"id": "kuche", "name": "Küche", "aliases": []},
    {"id": "wohnzimmer", "name": "Wohnzimmer", "aliases": []}]}}"#;
const ENTITIES: &str = r#"{"data": {"entities": [
    {"entity_id": "binary_sensor.fridge_door", "area_id": "kuche", "original_device_class": "door", "unique_id": "1"},
    {"entity_id": "switch.toaster", "area_id": "kuche", "unique_id": "2"},
    {"entity_id": "binary_sensor.living_room_motion", "area_id": "wohnzimmer", "original_device_class": "motion", "unique_id": "3"},
    {"entity_id": "light.ceiling", "area_id": "wohnzimmer", "unique_id": "4"},
    {"entity_id": "person.ada", "unique_id": "p-1"}]}}"#;
const PERSONS: &str = r#"{"data": {"items": [{"id": "p-1", "name": "Ada"}]}}"#;

/// The retained messages of Home Assistant and the robot.
fn kept() -> Vec<(String, String, bool)> {
    let states = [
        ("binary_sensor/fridge_door", "off"),
        ("switch/toaster", "off"),
        ("binary_sensor/living_room_motion", "on"),
        ("light/ceiling", "off"),
        ("person/ada", "home"),
    ];
    let states = states.map(|(object, state)| (format!("homeassistant/{object}/state"), state.to_owned(), true));
    let robot = [
        ("$state", "ready"),
        ("StatusStateAttribute/status", "docked"),
        ("StatusStateAttribute/error_description", "No error"),
        ("BatteryStateAttribute/level", "90"),
        ("MapData/segments", r#"{"16": "Küche", "17": "Wohnzimmer", "18": "Flur"}"#),
    ];
    let robot = robot.map(|(part, said)| (format!("{ROBOT}/{part}"), said.to_owned(), true));
    states.into_iter().chain(robot).collect()
}

/// A Valetudo map of rectangular rooms: number, name, and x, y, width and height in pixels of 5 cm.
fn robot_map(rooms: &[(&str, &str, [i32; 4])]) -> String {
    let block = |(number, name, [x, y, wide, high]): &(&str, &str, [i32; 4])| {
        let runs: Vec<i32> = (*y..y + high).flat_map(|row| [*x, row, *wide]).collect();
        serde_json::json!({"__class": "MapLayer", "type": "segment", "metaData": {"segmentId": number, "name": name, "active": false},
            "compressedPixels": runs})
    };
    let layers: Vec<_> = rooms.iter().map(block).collect();
    serde_json::json!({"__class": "ValetudoMap", "metaData": {"version": 2}, "size": {"x": 5120, "y": 5120}, "pixelSize": 5,
        "layers": layers, "entities": []})
    .to_string()
}

/// A robot's map: kitchen, living room and hall.
fn flat() -> String {
    robot_map(&[
        ("16", "Küche", [100, 100, 80, 80]),
        ("17", "Wohnzimmer", [184, 100, 100, 80]),
        ("18", "Flur", [100, 184, 184, 30]),
    ])
}

/// A home with its folder, broker and domain.
struct Home {
    world: World,
    port: u16,
    broker: Option<Mosquitto>,
}

impl Home {
    /// Home Assistant's folder, the robot's map, and a broker with the retained messages of both.
    fn new(name: &str) -> Option<Self> {
        let world = World::new(name);
        let storage = world.path("config/.storage");
        std::fs::create_dir_all(&storage).unwrap();
        for (file, text) in [("core.area_registry", AREAS), ("core.entity_registry", ENTITIES), ("person", PERSONS)] {
            std::fs::write(storage.join(file), text).unwrap();
        }
        std::fs::write(world.path("map.json"), flat()).unwrap();
        let (broker, port) = Mosquitto::ready()?;
        let home = Self { world, port, broker: Some(broker) };
        home.say(&kept());
        Some(home)
    }

    fn say(&self, messages: &[(String, String, bool)]) {
        let messages: Vec<_> =
            messages.iter().map(|(topic, said, keep)| (topic.as_str(), said.clone(), *keep)).collect();
        self.broker.as_ref().unwrap().publish(&messages);
    }

    fn folder(&self) -> &Path {
        self.world.directory.path()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.world.path(name)
    }

    fn at(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }

    fn url(&self) -> String {
        format!("mqtt://127.0.0.1:{}", self.port)
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
        command.args(arguments).env_remove("ROOMCAST_CONFIG").env("HOME", self.folder()).stdin(Stdio::null());
        command.env("ROOMCAST_ROOT", self.world.domain.root()).env("ROOMCAST_DOMAIN", self.world.domain.name());
        command
    }

    /// Runs `init`; options in `more` replace those of a good home.
    fn init(&self, more: &[&str]) -> Output {
        let has = |option: &str| more.contains(&option);
        let (config, url, map) = (self.at("config"), self.url(), self.at("map.json"));
        let mut all = vec!["init", "--yes"];
        for (option, value) in
            [("--home-assistant", &*config), ("--mqtt", &url), ("--valetudo", &map), ("--robot", ROBOT)]
        {
            if !has(option) {
                all.extend([option, value]);
            }
        }
        all.extend(more);
        let home = self.at("home");
        all.push(&home);
        self.command(&all).output().unwrap()
    }

    fn good(&self) {
        let output = self.init(&[]);
        assert!(output.status.success(), "{output:?}");
    }

    fn edit(&self, file: &str, from: &str, to: &str) {
        let path = self.path("home").join(file);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{file} has no {from}: {text}");
        std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
    }

    /// The exit code and the findings.
    fn doctor(&self) -> (i32, Vec<Value>) {
        let config = self.at("home/roomcast.toml");
        let output = self.command(&["doctor", "--json", "--wait", "1", "--config", &config]).output().unwrap();
        let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        let code = output.status.code().unwrap();
        assert_eq!(report["ok"] == true, code == 0, "{report:#}");
        (code, report["findings"].as_array().unwrap().clone())
    }

    fn start(&mut self, arguments: &[&str]) {
        self.world.spawn(self.command(arguments));
    }
}

fn finding<'a>(findings: &'a [Value], check: &str) -> &'a Value {
    findings.iter().find(|finding| finding["check"] == check).unwrap_or_else(|| panic!("no {check} in {findings:#?}"))
}

fn text<'a>(finding: &'a Value, key: &str) -> &'a str {
    finding[key].as_str().unwrap_or_default()
}

#[test]
#[ignore = "full"]
fn a_home_that_is_set_up_well_has_no_fault() {
    let Some(mut home) = Home::new("good") else { return };
    let output = home.init(&["--resident", "Ada"]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    for part in [
        "home.json: 3 rooms",
        "Rooms without things: 3; assumed in them",
        "home.rules.toml: 8 rules",
        "roomcast doctor --config",
        "roomcast robot --config",
    ] {
        assert!(said.contains(part), "{part} in {said}");
    }
    // The map has the robot's rooms and Home Assistant's devices, and the rules name those rooms.
    let map: Value = serde_json::from_str(&std::fs::read_to_string(home.path("home/home.json")).unwrap()).unwrap();
    let rooms: Vec<_> = map["rooms"].as_array().unwrap().iter().map(|room| text(room, "id")).collect();
    assert_eq!(rooms, ["kitchen-16", "living-room-17", "hallway-18"], "{map:#}");
    let things: Vec<_> = map["items"].as_array().unwrap().iter().map(|item| text(item, "id")).collect();
    assert!(things.contains(&"home-toaster") && things.contains(&"assumed-fridge"), "{things:?}");
    let rules = std::fs::read_to_string(home.path("home/home.rules.toml")).unwrap();
    assert!(rules.contains("room = \"living-room-17\"") && rules.contains("They open the fridge."), "{rules}");
    let (code, findings) = home.doctor();
    assert_eq!(code, 0, "{findings:#?}");
    for check in ["clock", "state", "things", "rules", "broker", "topics", "segments", "persons"] {
        assert_eq!(finding(&findings, check)["verdict"], "good", "{check}: {findings:#?}");
    }
    assert!(findings.iter().all(|finding| finding["check"] != "things of rules"), "{findings:#?}");
    assert!(text(finding(&findings, "services"), "found").contains("nothing runs yet"));
    // The home runs as it was set up: the narrator narrates a sensor and counts the rules that match.
    let config = home.at("home/roomcast.toml");
    home.start(&["daemon", "--config", &config]);
    home.start(&["narrate", "--mqtt", "--config", &config]);
    home.start(&["planner", "--config", &config]);
    let mut open = false;
    let findings = eventually("the daemon runs and two rules are counted", || {
        open = !open;
        let state = if open { "on" } else { "off" };
        home.say(&[("homeassistant/binary_sensor/fridge_door/state".to_owned(), state.to_owned(), true)]);
        let (_, findings) = home.doctor();
        // The narrator writes its counts periodically, and after a few minutes no rule counts as unused.
        let is_counted = |finding: &Value| {
            let found = text(finding, "found");
            let fitted =
                found.split_once(" rules of 8 fitted a message").and_then(|(count, _)| count.parse::<u32>().ok());
            finding["check"] == "rules that fit" && fitted.is_some_and(|count| count >= 2)
        };
        (finding(&findings, "daemon")["verdict"] == "good" && findings.iter().any(is_counted)).then_some(findings)
    });
    assert!(text(finding(&findings, "daemon"), "found").contains(" accepted"), "{findings:#?}");
    let services = text(finding(&findings, "services"), "found");
    assert!(["daemon", "narrator", "planner"].iter().all(|name| services.contains(name)), "{services}");
    assert_eq!(finding(&findings, "bridge")["verdict"], "limited");
    // After a day the doctor names the rules that never matched.
    let counts = std::fs::read_dir(home.path("home/state")).unwrap().map(|entry| entry.unwrap().path());
    let is_counts =
        |path: &PathBuf| path.extension().is_some_and(|end| end == "db") && path.to_string_lossy().contains("/rules-");
    let counts = counts.into_iter().find(is_counts).unwrap();
    let earlier =
        "UPDATE counted SET value = CAST(CAST(value AS INTEGER) - 86400 AS TEXT) WHERE field = 'since_unix_s'";
    assert_eq!(roomcast_database::Connection::open(counts).unwrap().execute(earlier, []).unwrap(), 1);
    let (_, findings) = home.doctor();
    let never = finding(&findings, "rules that fit");
    assert!(text(never, "found").contains("in 24.0 h no message ever fitted"), "{never}");
    assert!(text(never, "found").contains("homeassistant/switch/toaster/state is \"on\""), "{never}");
    assert!(!text(never, "found").contains("fridge_door/state is \"on\""), "{never}");
}

/// Without a robot's map, the rooms contain only Home Assistant's devices.
#[test]
fn rooms_with_devices_alone_get_furniture_on_request() {
    let Some(home) = Home::new("furnish") else { return };
    let config = home.at("config");
    let init = |folder: &str, more: &[&str]| {
        let folder = home.at(folder);
        let all = ["init", "--yes", "--home-assistant", &config, "--mqtt", "none", "--robot", "none", &folder];
        home.command(&[&all[..], more].concat()).output().unwrap()
    };
    let made = |folder: &str, more: &[&str]| {
        let output = init(folder, more);
        let said = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
        let map = std::fs::read_to_string(home.path(folder).join("home.json")).unwrap();
        let map: Value = serde_json::from_str(&map).unwrap();
        let things: Vec<_> = map["items"].as_array().unwrap().iter().map(|item| text(item, "id").to_owned()).collect();
        (things, said)
    };
    let (devices, said) = made("plain", &["--bare"]);
    assert!(devices.len() == 3 && !said.contains("--furnish"), "{devices:?} {said}");
    assert_eq!(made("without", &["--bare", "--valetudo", "none"]).0, devices);
    let (things, said) = made("typical", &[]);
    assert_eq!(things, devices);
    let note = "Rooms with one or two kinds of things alone: kitchen, living room. `--furnish sparse` assumes";
    assert!(said.contains(note), "{said}");
    let (things, said) = made("sparse", &["--furnish", "sparse"]);
    assert!(said.contains("with one or two kinds alone: 2; assumed in them"), "{said}");
    let has = |thing: &str| things.iter().any(|own| own == thing);
    assert!(devices.iter().all(|device| has(device)) && has("assumed-stove") && has("assumed-sofa"), "{things:?}");
    assert!(!has("assumed-fridge"), "the kitchen has a fridge of its own: {things:?}");
    let unused = init("names", &["--names", "/nowhere/names.toml"]);
    let said = String::from_utf8(unused.stderr).unwrap();
    assert!(said.contains("--names names the segments of a robot's map, and there is none"), "{said}");
    let both = init("both", &["--bare", "--furnish", "sparse"]);
    assert_eq!(both.status.code(), Some(i32::from(exit_code::USAGE)), "{both:?}");
}

/// Three areas match rooms by name. For the fourth there are two candidates, and the output names them.
#[test]
fn areas_are_the_rooms_that_bear_their_names() {
    let Some(home) = Home::new("kinds") else { return };
    let areas = r#"{"data": {"areas": [{"id": "bad_unten", "name": "Bad unten"}, {"id": "bad_oben", "name": "Bad oben"}, {"id": "buero", "name": "Office"},
        {"id": "gang", "name": "Gang"}]}}"#;
    let sensor = |area: &str| serde_json::json!({"entity_id": format!("binary_sensor.{area}_motion"), "area_id": area, "original_device_class": "motion", "unique_id": area});
    let entities = ["bad_unten", "bad_oben", "buero", "gang"].map(sensor);
    let storage = home.path("config/.storage");
    std::fs::write(storage.join("core.area_registry"), areas).unwrap();
    let entities = serde_json::json!({"data": {"entities": entities}}).to_string();
    std::fs::write(storage.join("core.entity_registry"), entities).unwrap();
    let names = ["Bad oben", "Bad unten", "Arbeitszimmer", "Flur", "Flur"];
    let layers: Vec<_> = (1..)
        .zip(names)
        .map(|(number, name)| {
            let runs: Vec<i32> = (100..160).flat_map(|row| [60 * number, row, 60]).collect();
            serde_json::json!({"type": "segment", "metaData": {"segmentId": number, "name": name}, "compressedPixels": runs})
        })
        .collect();
    std::fs::write(home.path("map.json"), serde_json::json!({"pixelSize": 5, "layers": layers}).to_string()).unwrap();
    let output = home.init(&[]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    let rules = std::fs::read_to_string(home.path("home/home.rules.toml")).unwrap();
    let rules: toml::Table = rules.parse().unwrap();
    let room = |area: &str| {
        let topic = format!("homeassistant/binary_sensor/{area}_motion/state");
        let own = rules["rule"].as_array().unwrap().iter().find(|rule| rule["topic"].as_str() == Some(&topic));
        Some(own?["room"].as_str().unwrap().to_owned())
    };
    let rooms = ["bad_unten", "bad_oben", "buero", "gang"].map(room);
    let known = ["bad-unten-2", "bad-oben-1", "home-office-3"].map(|id| Some(id.to_owned()));
    assert_eq!(rooms[..3], known);
    assert_eq!(rooms[3], None, "which hallway it is nobody knows: {said}");
    assert!(said.contains("1 rule of the area \"gang\"") && said.contains("hallway-4, hallway-5"), "{said}");
    let rules_file = home.path("home/home.rules.toml");
    let rules = std::fs::read_to_string(&rules_file).unwrap();
    assert!(rules.contains("# room = \"gang\"\n"), "{rules}");
    assert_eq!(finding(&home.doctor().1, "rules")["verdict"], "good");
    // If a rule names the area nevertheless, the doctor reports it.
    let sensor = "homeassistant/binary_sensor/gang_motion/state";
    let rule = format!("[[rule]]\ntopic = {sensor:?}\nwhen = \"on\"\npresence = \"present\"\nroom = \"gang\"\n");
    std::fs::write(&rules_file, rule).unwrap();
    let (_, findings) = home.doctor();
    assert!(text(finding(&findings, "rules"), "found").contains("names the room \"gang\""), "{findings:#?}");
}

/// A name, the mistake, the check that finds it, and its finding and remedy.
type Mistake = (&'static str, fn(&mut Home), &'static str, &'static str, &'static str);

/// A server that speaks no MQTT.
fn web_server() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let _read = stream.read(&mut [0; 1024]);
            let _written = stream.write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n");
        }
    });
    port
}

fn password(home: &mut Home, wrong: bool) -> bool {
    drop(home.broker.take());
    let folder = tempfile::tempdir().unwrap();
    let passwords = folder.path().join("passwords");
    let made = Command::new("mosquitto_passwd").args(["-b", "-c"]).arg(&passwords).args(["home", "secret"]).output();
    if !made.is_ok_and(|made| made.status.success()) {
        return false;
    }
    let access = format!("allow_anonymous false\npassword_file {}", passwords.display());
    // Without a password this broker sends no retained messages, so the test publishes none.
    home.broker = Mosquitto::start(home.port, folder, &access);
    let file = home.path("credentials");
    std::fs::write(&file, if wrong { "home\nsecrets\n" } else { "home\nsecret\n" }).unwrap();
    std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o644)).unwrap();
    home.edit("roomcast.toml", "[mqtt]\n", &format!("[mqtt]\ncredentials = {:?}\n", file.display().to_string()));
    true
}

static MISTAKES: [(&str, u8, &[Mistake]); 4] = [
    ("wrong", exit_code::CHECK, &WRONG),
    ("limited", exit_code::OK, &LIMITED),
    ("limited", exit_code::CHECK, &OPEN),
    ("wrong", exit_code::CONFIG, &CONFIGURATION),
];

/// Faults.
const WRONG: [Mistake; 19] = [
    (
        "the broker's port",
        |home| home.edit("roomcast.toml", &home.port.to_string(), &free_port().to_string()),
        "broker",
        "no broker answers at 127.0.0.1:",
        "systemctl start mosquitto), or correct its address (mqtt.broker)",
    ),
    (
        "a web server for a broker",
        |home| home.edit("roomcast.toml", &home.port.to_string(), &web_server().to_string()),
        "broker",
        "is no MQTT 5 broker",
        "give the port of an MQTT 5 broker",
    ),
    (
        "the password",
        |home| assert!(password(home, true), "mosquitto_passwd is not there"),
        "broker",
        "refuses the login",
        "user name and password, a line each, into the file that mqtt.credentials names",
    ),
    (
        "a topic",
        |home| home.edit("home.rules.toml", "binary_sensor/living_room_motion/", "binary_sensor/livingroom_motion/"),
        "topics",
        "listens to homeassistant/binary_sensor/livingroom_motion/state, where nothing is said",
        "write topic = \"homeassistant/binary_sensor/living_room_motion/state\"",
    ),
    (
        "no state at the broker",
        |home| {
            drop(home.broker.take());
            home.broker = Mosquitto::start(home.port, tempfile::tempdir().unwrap(), ANYBODY);
            home.say(&kept()[5..]);
        },
        "topics",
        "nothing was said within 1 s under any topic of its 8 rules",
        "mqtt_statestream",
    ),
    (
        "a room in a rule",
        |home| home.edit("home.rules.toml", "\"living-room-17\"", "\"lving-rom-17\""),
        "rules",
        "names the room \"lving-rom-17\", which the map does not have",
        "write \"living-room-17\"",
    ),
    (
        "a map without things",
        |home| {
            let path = home.path("home/home.json");
            let mut map: Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
            map["items"] = Value::Array(Vec::new());
            std::fs::write(path, map.to_string()).unwrap();
        },
        "things",
        "nothing stands in any room",
        "--furnish typical",
    ),
    (
        "a map that is no JSON",
        |home| home.edit("home.json", "\"rooms\"", "rooms"),
        "scene",
        "home.json",
        "roomcast scene check FILE names every fault",
    ),
    (
        "a model that is not there",
        |home| home.edit("roomcast.toml", "[scene]", "[model]\npath = \"/nowhere/model.gguf\"\n\n[scene]"),
        "model",
        "/nowhere/model.gguf",
        "without model.path the embedded household model is used",
    ),
    (
        "no daemon",
        |home| {
            let config = home.at("home/roomcast.toml");
            home.start(&["planner", "--config", &config]);
            let node = home.world.domain.open("test").unwrap();
            eventually("the planner joins", || {
                node.participants().unwrap().into_iter().find(|name| name.starts_with("roomcast-planner"))
            });
        },
        "daemon",
        "planner runs, and no daemon does",
        "roomcast daemon --config",
    ),
    (
        "rooms that are no segments",
        |home| {
            let segments = r#"{"1": "Room 1", "2": "Room 2", "3": "Room 3"}"#;
            home.say(&[(format!("{ROBOT}/MapData/segments"), segments.to_owned(), true)]);
        },
        "segments",
        "the robot cannot do kitchen-16, living-room-17, hallway-18",
        "[robot.segments]",
    ),
    (
        "another robot's topic",
        |home| home.edit("roomcast.toml", "valetudo/rocky", "valetudo/robot-1"),
        "robot",
        "no robot speaks under valetudo/robot-1",
        "set robot.topic = \"valetudo/rocky\", which is there",
    ),
    (
        "a robot that is stuck",
        |home| {
            let stuck = [
                ("StatusStateAttribute/status", "error"),
                ("StatusStateAttribute/error_description", "Wheel lost floor contact"),
            ];
            home.say(&stuck.map(|(part, said)| (format!("{ROBOT}/{part}"), said.to_owned(), true)));
        },
        "robot",
        "has an error: Wheel lost floor contact",
        "go and free it",
    ),
    (
        "a segment that there is not",
        |home| home.edit("roomcast.toml", "[robot]\n", "[robot]\nsegments = { kitchen-16 = \"99\" }\n"),
        "segments",
        "has \"kitchen-16\" = \"99\", and the robot has no such segment",
        "write one of 16 \"Küche\"",
    ),
    (
        "a robot of the other kind",
        |home| home.edit("roomcast.toml", "[robot]\n", "[robot]\nkind = \"home-assistant\"\n"),
        "robot",
        "no robot speaks under valetudo/rocky",
        "leave robot.kind out",
    ),
    (
        "states under another base topic",
        |home| {
            let rules = home.path("home/home.rules.toml");
            let text = std::fs::read_to_string(&rules).unwrap();
            std::fs::write(rules, text.replace("\"homeassistant/", "\"ha/")).unwrap();
        },
        "topics",
        "Home Assistant says its states under homeassistant/",
        "write homeassistant/ for ha/ in the topics of the rules",
    ),
    (
        "a state folder that is a file",
        |home| std::fs::write(home.path("home/state"), "").unwrap(),
        "state",
        "is no folder",
        "give another folder as daemon.state",
    ),
    (
        "rules that are not there",
        |home| std::fs::remove_file(home.path("home/home.rules.toml")).unwrap(),
        "rules",
        "home.rules.toml",
        "correct mqtt.rules in the configuration",
    ),
    (
        "the clock",
        |home| {
            let file = std::fs::File::options().append(true).open(home.path("home/home.json")).unwrap();
            file.set_modified(SystemTime::now() + Duration::from_secs(86_400)).unwrap();
        },
        "clock",
        "home.json was written",
        "timedatectl set-ntp true",
    ),
];

/// Limits.
const LIMITED: [Mistake; 4] = [
    (
        "a device that no rule names",
        |home| home.say(&[("homeassistant/light/desk/state".to_owned(), "on".to_owned(), true)]),
        "unnamed topics",
        "no rule reads 1 topic: homeassistant/light/desk/state",
        "write rules for those that say what people do",
    ),
    (
        "a payload that is no JSON",
        |home| {
            home.edit(
                "home.rules.toml",
                "[[rule]]",
                "[[rule]]\ntopic = \"zigbee2mqtt/lamp\"\nfield = \"/state\"\nsay = \"the lamp is {value}\"\n\n[[rule]]",
            );
            home.say(&[("zigbee2mqtt/lamp".to_owned(), "ON \"now\"".to_owned(), true)]);
        },
        "payloads",
        "rule 1 reads zigbee2mqtt/lamp, but its last payload is no JSON: ON \"now\"",
        "leave `field` and pointers in braces out of the rule",
    ),
    (
        "a rule whose thing is not on the map",
        |home| home.edit("home.rules.toml", "They open the fridge.", "They open the mailbox."),
        "things of rules",
        "says \"They open the mailbox.\", and the map has no \"mailbox\"",
        "add the thing to the map",
    ),
    (
        "a resident by another name",
        |home| home.edit("roomcast.toml", "residents = [\"Ada\"]", "residents = [\"Adah\"]"),
        "persons",
        "the rules name Ada: not among persons.residents",
        "add who lives here to persons.residents",
    ),
];

/// A limit that fails the check.
const OPEN: [Mistake; 1] = [(
    "a password that everybody can read",
    |home| assert!(password(home, false), "mosquitto_passwd is not there"),
    "broker",
    "everybody on this machine can read its password",
    "chmod 600",
)];

/// Faults of the configuration itself.
const CONFIGURATION: [Mistake; 2] = [
    (
        "a configuration that is no TOML",
        |home| home.edit("roomcast.toml", "[mqtt]", "[mqtt"),
        "configuration",
        "roomcast.toml has 1 fault:\nat line",
        "roomcast config prints every key",
    ),
    (
        "a configuration that is not there",
        |home| std::fs::remove_file(home.path("home/roomcast.toml")).unwrap(),
        "configuration",
        "failed to read the configuration",
        "give --config the file that roomcast init has written",
    ),
];

#[test]
#[ignore = "full"]
fn the_doctor_finds_each_mistake() {
    let mistakes = || MISTAKES.iter().flat_map(|(verdict, code, all)| all.iter().map(move |one| (verdict, code, one)));
    // A check mostly waits, so several homes are checked in parallel.
    let (next, faults) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let work = |worker: usize| {
        while let Some((verdict, code, (name, make, check, found, remedy))) =
            mistakes().nth(next.fetch_add(1, Ordering::Relaxed))
        {
            let Some(mut home) = Home::new(&format!("doctor{worker}")) else { return };
            home.good();
            make(&mut home);
            let (ended, findings) = home.doctor();
            let finding = finding(&findings, check);
            let as_expected = finding["verdict"] == *verdict
                && text(finding, "found").contains(found)
                && text(finding, "remedy").contains(remedy)
                // `--replace` would overwrite files edited by hand.
                && !text(finding, "remedy").contains("--replace")
                && ended == i32::from(*code);
            if !as_expected {
                faults.lock().unwrap().push(format!("{name}: code {ended}, {finding:#}"));
            }
        }
    };
    std::thread::scope(|scope| {
        for worker in 0..4 {
            let work = &work;
            scope.spawn(move || work(worker));
        }
    });
    let faults = faults.into_inner().unwrap();
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

fn token(home: &Home) -> String {
    let path = home.path("token");
    std::fs::write(&path, "eyJ.token\n").unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
    path.display().to_string()
}

#[test]
#[ignore = "full"]
fn init_says_what_is_wrong_and_writes_nothing() {
    type Case = (&'static str, fn(&Home) -> Vec<String>, u8, &'static [&'static str]);
    let cases: [Case; 17] = [
        (
            "a robot without a broker",
            |_| vec!["--mqtt".into(), "none".into()],
            exit_code::USAGE,
            &["--robot is for a home with a broker, and there is none", "give --mqtt mqtt://HOST[:PORT]"],
        ),
        (
            "a login for no broker",
            |_| ["--mqtt", "none", "--robot", "none", "--mqtt-credentials", "login"].map(str::to_owned).to_vec(),
            exit_code::USAGE,
            &["--mqtt-credentials is for a home with a broker"],
        ),
        (
            "a login that is not there",
            |_| vec!["--mqtt-credentials".into(), "/nowhere/login".into()],
            exit_code::USAGE,
            &["failed to read /nowhere/login", "give --mqtt-credentials and --mqtt-ca files that are there"],
        ),
        (
            "nobody and somebody",
            |_| vec!["--resident".into(), "none, Mia".into()],
            exit_code::USAGE,
            &["none means nobody and stands alone"],
        ),
        (
            "an address without a token",
            |_| vec!["--home-assistant".into(), "http://127.0.0.1:1".into()],
            exit_code::USAGE,
            &["give --token-file FILE with a long-lived access token"],
        ),
        (
            "a folder without registries",
            |home| vec!["--home-assistant".into(), home.folder().display().to_string()],
            exit_code::INPUT,
            &["has no .storage/core.area_registry", "give the folder that configuration.yaml is in"],
        ),
        (
            "an address without http",
            |home| vec!["--home-assistant".into(), "127.0.0.1:8123".into(), "--token-file".into(), token(home)],
            exit_code::INPUT,
            &["127.0.0.1:8123 is neither a folder that is there nor an address", "such as http://HOST:8123"],
        ),
        (
            "a broker's password in its address",
            |_| vec!["--mqtt".into(), "mqtt://home:secret@127.0.0.1".into()],
            exit_code::USAGE,
            &["has a user name or a password in it", "--mqtt-credentials FILE"],
        ),
        (
            "a map that is packed",
            |home| {
                std::fs::write(home.path("map.json"), [0x1f, 0x8b, 8, 0, 0xff]).unwrap();
                Vec::new()
            },
            exit_code::INPUT,
            &["map.json: it is no text: unpack it"],
        ),
        (
            "a login without a password",
            |home| {
                let path = home.path("login");
                std::fs::write(&path, "robot\n").unwrap();
                vec!["--mqtt-credentials".into(), path.display().to_string()]
            },
            exit_code::USAGE,
            &["login is no file of credentials", "the password in the second"],
        ),
        (
            "a map that is no map",
            |home| {
                std::fs::write(home.path("map.json"), "[]").unwrap();
                Vec::new()
            },
            exit_code::INPUT,
            &["map.json", "expected a map as Valetudo exports it"],
        ),
        (
            "a map that is not there",
            |home| vec!["--valetudo".into(), home.at("nowhere.json")],
            exit_code::INPUT,
            &["nowhere.json", "No such file"],
        ),
        (
            "no map at the broker",
            |_| vec!["--valetudo".into(), "mqtt".into()],
            exit_code::INPUT,
            &["no map of valetudo/rocky is at the broker", "save http://ROBOT/api/v2/robot/state/map"],
        ),
        (
            "a map of a broker that there is not",
            |_| {
                vec![
                    "--mqtt".into(),
                    "none".into(),
                    "--robot".into(),
                    "none".into(),
                    "--valetudo".into(),
                    "mqtt".into(),
                ]
            },
            exit_code::USAGE,
            &["--valetudo mqtt is the map that the robot tells a broker, and there is none"],
        ),
        (
            "a name for no segment",
            |home| {
                std::fs::write(home.path("segments.toml"), "99 = \"kitchen\"\n").unwrap();
                vec!["--names".into(), home.at("segments.toml")]
            },
            exit_code::INPUT,
            &["names ", "segments.toml: name the segment \"99\", but the map has 16, 17, 18"],
        ),
        (
            "files that are there",
            |home| {
                std::fs::create_dir_all(home.path("home")).unwrap();
                std::fs::write(home.path("home/home.rules.toml"), "# mine\n").unwrap();
                Vec::new()
            },
            exit_code::FAILURE,
            &["home.rules.toml stay as they are: give another folder with --out"],
        ),
        (
            "a folder that is a file",
            |home| {
                std::fs::write(home.path("home"), "").unwrap();
                Vec::new()
            },
            exit_code::FAILURE,
            &["cannot make the folder", "or give another one"],
        ),
    ];
    for (name, make, code, parts) in cases {
        let Some(home) = Home::new("init") else { return };
        let more = make(&home);
        let output = home.init(&more.iter().map(String::as_str).collect::<Vec<_>>());
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(code)), "{name}: {said}");
        parts.iter().for_each(|part| assert!(said.contains(part), "{name}: {part} in {said}"));
        for file in ["home.json", "roomcast.toml"] {
            assert!(!home.path("home").join(file).exists(), "{name}: {file} was written");
        }
        let rules = std::fs::read_to_string(home.path("home/home.rules.toml"));
        assert!(rules.is_err() || rules.unwrap() == "# mine\n", "{name}: the rules were written");
    }
}

#[test]
fn init_finds_what_is_not_given() {
    let Some(home) = Home::new("found") else { return };
    // Home Assistant is in the user's folder, and the robot's map at the broker, compressed as by the robot.
    std::fs::rename(home.path("config"), home.path(".homeassistant")).unwrap();
    let mut packed = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::default());
    packed.write_all(flat().as_bytes()).unwrap();
    publish_bytes(home.port, &format!("{ROBOT}/MapData/map-data"), packed.finish().unwrap());
    let (url, folder) = (home.url(), home.at("home"));
    let output = home.command(&["init", "--mqtt", &url, &folder]).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    for part in ["found Home Assistant's configuration in", "found a robot under valetudo/rocky", "3 rooms"] {
        assert!(said.contains(part), "{part} in {said}");
    }
    let config = std::fs::read_to_string(home.path("home/roomcast.toml")).unwrap();
    assert!(config.contains("topic = \"valetudo/rocky\"") && config.contains("obey = false"), "{config}");
    // `init` uses the given robot. If it is silent, the output lists the robots that were heard.
    let typed = ["init", "--replace", "--mqtt", &url, "--robot", "valetudo/roky", &folder];
    let said = String::from_utf8(home.command(&typed).output().unwrap().stdout).unwrap();
    assert!(said.contains("nothing was heard of a robot under valetudo/roky; heard of: valetudo/rocky"), "{said}");
    // A vacuum of Home Assistant is set up even if no broker answers; the output says so.
    let of_home_assistant = "homeassistant/vacuum/dusty";
    let (nowhere, vacuum) = (format!("mqtt://127.0.0.1:{}", free_port()), home.at("vacuum"));
    let typed = ["init", "--mqtt", &nowhere, "--robot", of_home_assistant, &vacuum];
    let output = home.command(&typed).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && said.contains("no broker answers at 127.0.0.1"), "{said}");
    let config = std::fs::read_to_string(home.path("vacuum/roomcast.toml")).unwrap();
    let (_, table) = config.split_once("\n# [robot.segments]\n").expect(&config);
    let table: toml::Table = table.replace("# ", "").parse().unwrap();
    assert_eq!(table.keys().collect::<Vec<_>>(), ["kuche", "wohnzimmer"], "a line for each room: {config}");
    let config: toml::Table = config.parse().unwrap();
    assert_eq!(config["robot"]["kind"].as_str(), Some("home-assistant"));
    assert_eq!(config["robot"]["topic"].as_str(), Some(of_home_assistant));
    // Without Home Assistant the configuration has no rules, but a commented line for rules written by hand.
    let (map, by_hand) = (home.at("map.json"), home.at("by-hand"));
    let typed = ["init", "--home-assistant", "none", "--mqtt", &nowhere, "--valetudo", &map, &by_hand];
    assert!(home.command(&typed).output().unwrap().status.success());
    let config = std::fs::read_to_string(home.path("by-hand/roomcast.toml")).unwrap();
    let config: toml::Table = config.replace("\n# rules = ", "\nrules = ").parse().unwrap();
    let rules = config["mqtt"]["rules"].as_str().unwrap();
    assert_eq!(rules, "home.rules.toml");
    let typed = ["init", "--replace", "--mqtt", &nowhere, &vacuum];
    let said = String::from_utf8(home.command(&typed).output().unwrap().stdout).unwrap();
    assert!(said.contains("without it no robot is set up: give --robot PREFIX/IDENTIFIER"), "{said}");
    // `init` does not choose between two robots, and does not overwrite files without `--replace`.
    let again = home.command(&["init", "--mqtt", &url, &folder]).output().unwrap();
    assert_eq!(again.status.code(), Some(i32::from(exit_code::FAILURE)));
    home.say(&[("valetudo/other/StatusStateAttribute/status".to_owned(), "idle".to_owned(), true)]);
    let several = home.command(&["init", "--replace", "--mqtt", &url, &folder]).output().unwrap();
    let said = String::from_utf8(several.stderr).unwrap();
    assert_eq!(several.status.code(), Some(i32::from(exit_code::USAGE)), "{said}");
    assert!(said.contains("several robots") && said.contains("valetudo/other, valetudo/rocky"), "{said}");
    let none =
        home.command(&["init", "--home-assistant", "none", "--mqtt", "none", &home.at("empty")]).output().unwrap();
    let said = String::from_utf8(none.stderr).unwrap();
    assert!(said.contains("nothing tells of the home's rooms: give --home-assistant"), "{said}");
    assert!(!Path::new(&home.at("empty")).exists());
}

/// `config --check` connects to nothing, and prints all errors at once. Limited functions are remarks.
#[test]
fn a_check_of_the_configuration_names_what_the_map_does_not_have() {
    let Some(home) = Home::new("checks") else { return };
    home.good();
    let check = || {
        let mut command = home.command(&["config", "--check", &home.at("home/roomcast.toml")]);
        // These variables override the file, and the check would remark on them.
        command.env_remove("ROOMCAST_ROOT").env_remove("ROOMCAST_DOMAIN");
        let output = command.output().unwrap();
        (
            output.status.code().unwrap(),
            String::from_utf8(output.stdout).unwrap(),
            String::from_utf8(output.stderr).unwrap(),
        )
    };
    let (code, printed, remarks) = check();
    assert_eq!((code, remarks.as_str()), (i32::from(exit_code::OK), ""));
    assert_eq!(printed, format!("ok: {}\n", home.at("home/roomcast.toml")));
    home.edit("home.rules.toml", "They open the fridge.", "They open the mailbox.");
    home.edit("roomcast.toml", "residents = [\"Ada\"]", "residents = [\"Bea\"]");
    // A segment may have any of the map's names for the room.
    home.edit("roomcast.toml", "[robot]\n", "[robot]\nsegments = { Wohnzimmer = \"17\" }\n");
    let (code, _, remarks) = check();
    assert_eq!(code, i32::from(exit_code::OK), "{remarks}");
    for remark in ["and the map has no \"mailbox\"", "the rules name Ada: not among persons.residents"] {
        assert_eq!(remarks.matches(remark).count(), 1, "{remarks}");
    }
    home.edit("home.rules.toml", "\"living-room-17\"", "\"attic\"");
    home.edit("roomcast.toml", "{ Wohnzimmer =", "{ cellar =");
    home.edit("roomcast.toml", "[persons]", "[history]\nobservations = 0\n\n[persons]");
    home.edit("roomcast.toml", "residents = [\"Bea\"]", "residents = [\"?!\"]\nasleep_s = -1");
    home.edit("roomcast.toml", "mqtt://", "tcp://");
    let (code, _, said) = check();
    assert_eq!(code, i32::from(exit_code::CONFIG), "{said}");
    let faults = [
        "6 things are wrong",
        "history.observations is 0",
        "persons.residents is [\"?!\"]",
        "persons.asleep_s is -1",
        "names the room \"attic\", which the map does not have",
        "names the room \"cellar\", which the map does not have",
        "mqtt.broker: ",
    ];
    for fault in faults {
        assert_eq!(said.matches(fault).count(), 1, "{fault}: {said}");
    }
}

#[test]
fn a_dry_run_says_what_the_map_does_not_have() {
    let Some(mut home) = Home::new("dry") else { return };
    home.good();
    home.edit("home.rules.toml", "\"living-room-17\"", "\"attic\"");
    let (shown, config) = (home.path("shown"), home.at("home/roomcast.toml"));
    let mut command = home.command(&["narrate", "--mqtt", "--dry-run", "--config", &config]);
    command.stdout(std::fs::File::create(&shown).unwrap()).stderr(Stdio::null());
    home.world.children.push(Process { child: command.spawn().unwrap(), log: shown.clone() });
    let mut is_on = false;
    let beside = "\"on\":true,\"room\":\"attic\",\"sensor\":\"motion\"}\n    the map has no room \"attic\"; its rooms are kitchen-16, \
        living-room-17, hallway-18\n";
    eventually("the dry run names the room that the map lacks", || {
        is_on = !is_on;
        let state = if is_on { "on" } else { "off" };
        home.say(&[("homeassistant/binary_sensor/living_room_motion/state".to_owned(), state.to_owned(), true)]);
        std::fs::read_to_string(&shown).unwrap().contains(beside).then_some(())
    });
}

/// Without questions, the residents are Home Assistant's persons.
#[test]
fn residents_are_those_of_home_assistant_unless_they_are_given() {
    let Some(home) = Home::new("persons") else { return };
    let made = |more: &[&str]| {
        let output = home.init(&[&["--replace", "--mqtt", "none", "--robot", "none"], more].concat());
        let (said, error) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
        assert!(output.status.success(), "{said}{error}");
        (std::fs::read_to_string(home.path("home/roomcast.toml")).unwrap(), said)
    };
    let (config, said) = made(&[]);
    assert!(config.contains("\nresidents = [\"Ada\"]\n"), "{config}");
    assert!(said.contains("found Home Assistant's persons, who live here: Ada; --resident says otherwise"), "{said}");
    assert!(config.contains("\n# not_persons = [\"Rocky\"]\n"), "pets and robots are thought of: {config}");
    let (config, _) = made(&["--resident", "Mia, Jon ,", "--resident", " ,"]);
    assert!(config.contains("\nresidents = [\"Mia\", \"Jon\"]\n"), "{config}");
    let (config, _) = made(&["--resident", ","]);
    assert!(config.contains("\nresidents = [\"Ada\"]\n"), "no name is none that is given: {config}");
    let (config, _) = made(&["--resident", "none"]);
    assert!(!config.contains("\nresidents"), "{config}");
    // Persons with equal names do not stop the set-up.
    let twice = r#"{"data": {"items": [{"id": "p-1", "name": "Ada"}, {"id": "p-2", "name": "ada"}]}}"#;
    std::fs::write(home.path("config/.storage/person"), twice).unwrap();
    let (config, said) = made(&[]);
    assert!(!config.contains("\nresidents") && said.contains("Home Assistant's persons are no residents"), "{said}");
}

/// Handwritten rules are never lost.
#[test]
fn a_home_that_is_set_up_again_keeps_the_old_files_beside_the_new() {
    let Some(home) = Home::new("again") else { return };
    home.good();
    let rules = home.path("home/home.rules.toml");
    let made = std::fs::read_to_string(&rules).unwrap();
    for old in ["home.rules.toml.old", "home.rules.toml.old-2"] {
        std::fs::write(&rules, format!("# {old}\n")).unwrap();
        let output = home.init(&["--replace"]);
        let said = String::from_utf8(output.stdout).unwrap();
        assert!(
            output.status.success() && said.contains(&format!("is now {}", home.path("home").join(old).display())),
            "{said}"
        );
        assert_eq!(std::fs::read_to_string(home.path("home").join(old)).unwrap(), format!("# {old}\n"));
        assert_eq!(std::fs::read_to_string(&rules).unwrap(), made);
    }
    assert!(!home.path("home/home.json.old").exists(), "the map was the same");
}

#[test]
fn a_home_has_a_folder_by_default_and_leaves_areas_out() {
    let Some(home) = Home::new("out") else { return };
    let config = home.at("config");
    let all = ["init", "--yes", "--home-assistant", &config, "--mqtt", "none", "--robot", "none", "--leave-out"];
    let init = |more: &[&str]| home.command(&[&all[..], more].concat()).current_dir(home.folder()).output().unwrap();
    let output = init(&["Wohnzimmer"]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && said.contains("Areas left out: Wohnzimmer."), "{said}");
    let rooms = |folder: &str| {
        let map = std::fs::read_to_string(home.path(folder).join("home.json")).unwrap();
        serde_json::from_str::<Value>(&map).unwrap()["rooms"].as_array().unwrap().len()
    };
    assert_eq!(rooms("home"), 1);
    for (place, folder) in [(&["--out", "given"][..], "given"), (&["positional"], "positional")] {
        assert!(init(&[&["kuche"][..], place].concat()).status.success());
        assert_eq!(rooms(folder), 1);
    }
    let output = init(&["Attic", "--out", "other"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(i32::from(exit_code::INPUT)), "{said}");
    assert!(said.contains("has no area \"Attic\" to leave out; its areas are Küche, Wohnzimmer"), "{said}");
}

/// On a terminal, `init` asks again after a wrong answer and gives the error at once.
#[test]
fn init_asks_again_where_an_answer_leads_to_nothing() {
    if !Path::new("/usr/bin/script").exists() {
        skipped("script is not installed (apt-get install bsdutils)");
        return;
    }
    let Some(home) = Home::new("asked") else { return };
    let program = env!("CARGO_BIN_EXE_roomcast");
    let on_terminal = |answers: &[&str]| {
        let command = format!("stty -echo; {program} init {}", home.at("home"));
        let mut script = Command::new("/usr/bin/script");
        script.args(["--quiet", "--return", "--command", &command, "/dev/null"]).env("HOME", home.folder());
        script.env("ROOMCAST_ROOT", home.world.domain.root()).env("ROOMCAST_DOMAIN", home.world.domain.name());
        let mut child = script.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut input = child.stdin.take().unwrap();
        for answer in answers {
            writeln!(input, "{answer}").unwrap();
        }
        // Ctrl-D ends the terminal's input.
        input.write_all(b"\x04").unwrap();
        drop(input);
        let output = child.wait_with_output().unwrap();
        (output.status.code().unwrap(), String::from_utf8(output.stdout).unwrap().replace("\r\n", "\n"))
    };
    let (url, config, map) = (home.url(), home.at("config"), home.at("map.json"));
    let nobody = format!("mqtt://127.0.0.1:{}", free_port());
    let wrong = [
        "/nowhere",
        "http://",
        "http://127.0.0.1:1",
        "/nowhere/token",
        "none",
        &config,
        "broker",
        &nobody,
        &url,
        "valetudo/other",
        ROBOT,
        "/nowhere.json",
        &map,
        "Ada, ada",
        "Ada",
        "10pm-7am",
        "22:00-06:00; sat,sun 22:00-09:00",
        "nowhere",
        "floor",
    ];
    let (code, said) = on_terminal(&wrong);
    assert_eq!(code, 0, "{said}");
    // Texts are wrapped to the terminal's width, so white space is normalised.
    let words = said.split_whitespace().collect::<Vec<_>>().join(" ");
    for part in [
        "/nowhere is neither a folder that is there nor an address",
        "quiet hours are \"10pm-7am\", expected such as",
        "nowhere is none of room, beside, floor, house, ignore",
        "\"http://\" is no Home Assistant's address",
        "the token file /nowhere/token",
        "an address needs a token; give another one, a folder, or none",
        "\"broker\" is no broker",
        "no broker answers at 127.0.0.1",
        "nothing was heard of a robot under valetudo/other",
        "map /nowhere.json:",
        "give each name or number once",
        "home.json: 3 rooms",
    ] {
        assert!(words.contains(part), "{part} in {said}");
    }
    let config = std::fs::read_to_string(home.path("home/roomcast.toml")).unwrap();
    for part in [format!("broker = {url:?}"), format!("topic = {ROBOT:?}"), "residents = [\"Ada\"]".to_owned()] {
        assert!(config.contains(&part), "{part} in {config}");
    }
    // An invalid answer overwrites no file, and neither does the end of the input.
    let (code, said) = on_terminal(&["maybe"]);
    assert!(said.contains("answer yes or no") && said.contains("nothing was written"), "{said}");
    assert_eq!(code, i32::from(exit_code::INTERRUPTED), "{said}");
    let (code, said) = on_terminal(&["maybe", "no"]);
    assert!(said.contains("stay as they are"), "{said}");
    assert_eq!(code, i32::from(exit_code::FAILURE), "{said}");
}

fn publish_bytes(port: u16, topic: &str, payload: Vec<u8>) {
    use rumqttc::v5::mqttbytes::{QoS, v5::Packet};
    let (client, mut connection) =
        rumqttc::v5::Client::new(rumqttc::v5::MqttOptions::new("packer", "127.0.0.1", port), 4);
    client.publish(topic, QoS::AtLeastOnce, true, payload).unwrap();
    while !matches!(connection.recv().unwrap().unwrap(), rumqttc::v5::Event::Incoming(Packet::PubAck(_))) {}
}
