//! A real Home Assistant, a real broker and real processes: import over folder and API, narration of a sensor, publication, restarts, removal.
//!
//! `make test-home` installs Home Assistant and runs this. `ROOMCAST_HOME_ASSISTANT` names another installation's program. Without one the test is
//! skipped.

use std::fs::File;
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use roomcast_ipc::raw::{DecisionV1, NarrationV1, action, decision_flags};
use roomcast_ipc::{Domain, Subscriber};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};
use tungstenite::{Message, WebSocket};

use crate::eventually::{waited, within};
use crate::mosquitto::{Mosquitto, free_port};
use crate::skipped::skipped;

/// The first start of Home Assistant installs its dependencies.
const PATIENCE: Duration = Duration::from_secs(400);
const NO_HOME_ASSISTANT: &str = "Home Assistant is not installed (make test-home installs it)";

fn eventually<T>(what: &str, attempt: impl FnMut() -> Option<T>) -> T {
    within(PATIENCE, what, attempt)
}

fn program() -> Option<PathBuf> {
    let named = std::env::var_os("ROOMCAST_HOME_ASSISTANT").map(PathBuf::from);
    let own = Path::new(env!("CARGO_BIN_EXE_roomcast")).parent().unwrap().join("../home-assistant-3.11/bin/hass");
    named.or(Some(own)).filter(|program| program.exists())
}

/// The version that the program names, such as "2024.3.3".
fn version(program: &Path) -> String {
    String::from_utf8(Command::new(program).arg("--version").output().unwrap().stdout).unwrap()
}

/// The automations on a page of the documentation, as entries of one list.
fn automations(page: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs").join(page);
    let text = std::fs::read_to_string(path).unwrap();
    let blocks = text.split("```yaml\n").skip(1).map(|rest| rest.split("```").next().unwrap());
    let lists: Vec<&str> = blocks.filter_map(|block| block.strip_prefix("automation:\n")).collect();
    assert!(!lists.is_empty(), "{page} shows no automation");
    lists.concat()
}

fn terminate(child: &mut Child) {
    let _sent = kill_process(Pid::from_raw(child.id().cast_signed()).unwrap(), Signal::TERM);
    if waited(Duration::from_secs(60), || child.try_wait().unwrap()).is_none() {
        let _killed = child.kill();
        let _reaped = child.wait();
    }
}

/// A Home Assistant with its own folder.
struct HomeAssistant {
    program: PathBuf,
    folder: PathBuf,
    port: u16,
    child: Option<Child>,
}

/// The home's entities and their areas.
const ENTITIES: [(&str, &str); 10] = [
    ("binary_sensor.fridge_door", "kuche"),
    ("binary_sensor.kitchen_motion", "kuche"),
    ("switch.toaster", "kuche"),
    ("binary_sensor.front_door", "wohnzimmer"),
    ("binary_sensor.living_room_motion", "wohnzimmer"),
    ("light.ceiling", "wohnzimmer"),
    ("binary_sensor.bathroom_motion", "bathroom"),
    ("binary_sensor.bathroom_window", "bathroom"),
    ("binary_sensor.bedroom_motion", "schlafzimmer"),
    ("light.bedside", "schlafzimmer"),
];

impl HomeAssistant {
    fn new(program: PathBuf, folder: &Path, broker: u16) -> Self {
        let port = free_port();
        std::fs::create_dir_all(folder.join(".storage")).unwrap();
        let sensors = [
            ("Fridge door", "door"),
            ("Kitchen motion", "motion"),
            ("Front door", "door"),
            ("Living room motion", "motion"),
            ("Bathroom motion", "motion"),
            ("Bathroom window", "window"),
            ("Bedroom motion", "motion"),
        ];
        let slug = |name: &str| name.to_lowercase().replace(' ', "_");
        let switches: String = sensors.iter().map(|(name, _)| format!("  {}:\n", slug(name))).collect();
        let templates: String = sensors
            .iter()
            .map(|(name, class)| {
                let id = slug(name);
                format!(
                    "      - name: {name}\n        unique_id: {id}\n        device_class: {class}\n        state: \"{{{{ is_state('input_boolean.{id}', 'on') }}}}\"\n"
                )
            })
            .collect();
        let turned = "turn_on: {service: input_boolean.turn_on, target: {entity_id: input_boolean.spare}}, \
                      turn_off: {service: input_boolean.turn_off, target: {entity_id: input_boolean.spare}}";
        // Only 2024 and before know lights and switches from templates as platforms, and only later versions know them below `template`.
        let switched = if version(&program).starts_with("2024") {
            let own = |id: &str| format!("{id}: {{unique_id: {id}, {turned}}}");
            format!(
                "light:\n  - platform: template\n    lights: {{{}, {}}}\nswitch:\n  - platform: template\n    switches: {{{}}}\n",
                own("ceiling"),
                own("bedside"),
                own("toaster")
            )
        } else {
            let own = |id: &str| format!("{{name: {id}, unique_id: {id}, {turned}}}");
            format!("  - light: [{}, {}]\n  - switch: [{}]\n", own("ceiling"), own("bedside"), own("toaster"))
        };
        let text = format!(
            "homeassistant: {{name: Home, latitude: 50, longitude: 8, time_zone: UTC, country: DE, currency: EUR}}\n\
             http: {{server_host: 127.0.0.1, server_port: {port}}}\nconfig:\nlogger: {{default: warning}}\n\
             mqtt_statestream:\n  base_topic: homeassistant\nperson:\n  - {{name: Ada, id: ada}}\n\
             input_boolean:\n  spare:\n  heater:\n{switches}template:\n  - sensor:\n      - name: Bath temperature\n        unique_id: bath_temperature\n        \
             unit_of_measurement: \"°C\"\n        device_class: temperature\n        state: \"20\"\n  - binary_sensor:\n{templates}{switched}climate:\n  - {{platform: generic_thermostat, name: bathroom, heater: input_boolean.heater, target_sensor: sensor.bath_temperature, target_temp: 17}}\n\
             automation:\n{}{}",
            automations("publish.md"),
            automations("robot.md"),
        );
        std::fs::write(folder.join("configuration.yaml"), text).unwrap();
        let entry = json!({"version": 1, "minor_version": 1, "key": "core.config_entries", "data": {"entries": [{
            "entry_id": "broker", "version": 1, "minor_version": 1, "domain": "mqtt", "title": "broker", "options": {}, "source": "user",
            "data": {"broker": "127.0.0.1", "port": broker, "discovery": true, "discovery_prefix": "homeassistant"},
            "pref_disable_new_entities": false, "pref_disable_polling": false, "unique_id": null, "disabled_by": null}]}});
        std::fs::write(folder.join(".storage/core.config_entries"), entry.to_string()).unwrap();
        let added = Command::new(&program)
            .args(["--script", "auth", "-c"])
            .arg(folder)
            .args(["add", "tester", "a long password"])
            .output()
            .unwrap();
        assert!(added.status.success(), "{added:?}");
        Self { program, folder: folder.to_owned(), port, child: None }
    }

    fn url(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }

    fn start(&mut self) {
        let log = File::options().create(true).append(true).open(self.folder.join("log")).unwrap();
        let mut command = Command::new(&self.program);
        let path = std::env::var_os("PATH").unwrap_or_default();
        let own = self.program.parent().unwrap().to_owned();
        let paths = std::env::join_paths(std::iter::once(own).chain(std::env::split_paths(&path))).unwrap();
        command.arg("-c").arg(&self.folder).env("PATH", paths).stdin(Stdio::null());
        command.stdout(log.try_clone().unwrap()).stderr(log);
        self.child = Some(command.spawn().unwrap());
        eventually("Home Assistant listens", || TcpStream::connect(("127.0.0.1", self.port)).ok());
    }

    fn stop(&mut self) {
        if let Some(mut child) = self.child.take() {
            terminate(&mut child);
        }
    }

    fn post(&self, path: &str, body: &str) -> Value {
        let answer = ureq::post(&format!("{}{path}", self.url())).send(body).unwrap();
        serde_json::from_str(&answer.into_body().read_to_string().unwrap()).unwrap()
    }

    /// Logs in like a browser and creates a long-lived token.
    fn token(&self) -> String {
        let client = format!("{}/", self.url());
        let flow = json!({"client_id": client, "handler": ["homeassistant", null], "redirect_uri": client});
        let flow = eventually("the login begins", || {
            let answer = ureq::post(&format!("{}/auth/login_flow", self.url())).send(&flow.to_string()).ok()?;
            serde_json::from_str::<Value>(&answer.into_body().read_to_string().ok()?).ok()
        });
        let login = json!({"client_id": client, "username": "tester", "password": "a long password"});
        let done = self.post(&format!("/auth/login_flow/{}", flow["flow_id"].as_str().unwrap()), &login.to_string());
        let code = done["result"].as_str().unwrap();
        let form = [("grant_type", "authorization_code"), ("code", code), ("client_id", &client)];
        let answer = ureq::post(&format!("{client}auth/token")).send_form(form).unwrap();
        let short: Value = serde_json::from_str(&answer.into_body().read_to_string().unwrap()).unwrap();
        let mut talk = Talk::open(self, short["access_token"].as_str().unwrap());
        let question = json!({"type": "auth/long_lived_access_token", "client_name": "roomcast", "lifespan": 10});
        talk.ask(question).as_str().unwrap().to_owned()
    }
}

impl Drop for HomeAssistant {
    fn drop(&mut self) {
        self.stop();
        if std::thread::panicking() {
            eprintln!("--- {}", std::fs::read_to_string(self.folder.join("log")).unwrap_or_default());
        }
    }
}

/// A connection to Home Assistant's WebSocket API.
struct Talk {
    socket: WebSocket<TcpStream>,
    asked: u64,
    events: Vec<Value>,
}

impl Talk {
    fn open(home: &HomeAssistant, token: &str) -> Self {
        eventually("the API answers", || {
            let stream = TcpStream::connect(("127.0.0.1", home.port)).ok()?;
            stream.set_read_timeout(Some(Duration::from_secs(60))).ok()?;
            let url = format!("ws://127.0.0.1:{}/api/websocket", home.port);
            let (socket, _) = tungstenite::client(url.as_str(), stream).ok()?;
            let mut talk = Self { socket, asked: 0, events: Vec::new() };
            talk.hear();
            talk.say(&json!({"type": "auth", "access_token": token}));
            (talk.hear()["type"] == "auth_ok").then_some(talk)
        })
    }

    fn say(&mut self, message: &Value) {
        self.socket.send(Message::text(message.to_string())).unwrap();
    }

    fn hear(&mut self) -> Value {
        loop {
            if let Message::Text(text) = self.socket.read().unwrap() {
                return serde_json::from_str(&text).unwrap();
            }
        }
    }

    fn ask(&mut self, question: Value) -> Value {
        self.try_ask(question).unwrap()
    }

    /// The error is the question and the answer.
    fn try_ask(&mut self, mut question: Value) -> Result<Value, String> {
        self.asked += 1;
        question["id"] = self.asked.into();
        self.say(&question);
        loop {
            let mut answer = self.hear();
            if answer["type"] == "event" {
                self.events.push(answer["event"].take());
            } else if answer["id"] == self.asked {
                let is_done = answer["success"] == true;
                return if is_done { Ok(answer["result"].take()) } else { Err(format!("{question}: {answer}")) };
            }
        }
    }

    fn turn(&mut self, switch: &str, on: bool) {
        self.switch(&format!("input_boolean.{switch}"), on);
    }

    /// A Home Assistant that has just started does not know the service yet.
    fn switch(&mut self, entity: &str, on: bool) {
        let service = if on { "turn_on" } else { "turn_off" };
        let (domain, target) = (entity.split('.').next(), json!({ "entity_id": entity }));
        let _known =
            self.try_ask(json!({"type": "call_service", "domain": domain, "service": service, "target": target}));
    }

    fn state(&mut self, id: &str) -> Option<String> {
        let states = self.ask(json!({"type": "get_states"}));
        let found = states.as_array().unwrap().iter().find(|state| state["entity_id"] == id)?;
        Some(found["state"].as_str().unwrap().to_owned())
    }

    fn roomcast_entities(&mut self) -> Vec<String> {
        let states = self.ask(json!({"type": "get_states"}));
        let ids = states.as_array().unwrap().iter().map(|state| state["entity_id"].as_str().unwrap().to_owned());
        // The automations from the documentation belong to the home, whatever their names.
        ids.filter(|id| id.contains(".roomcast_") && !id.starts_with("automation.")).collect()
    }
}

struct Services {
    folder: PathBuf,
    domain: Domain,
    children: Vec<(&'static str, Child)>,
}

impl Services {
    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
        command.args(arguments).env("ROOMCAST_ROOT", self.domain.root()).env("ROOMCAST_DOMAIN", self.domain.name());
        command.env_remove("ROOMCAST_CONFIG").stdin(Stdio::null());
        command
    }

    fn config(&self) -> String {
        self.folder.join("home/roomcast.toml").display().to_string()
    }

    fn start(&mut self, name: &'static str, arguments: &[&str]) {
        let log = File::options().create(true).append(true).open(self.folder.join(name)).unwrap();
        let config = self.config();
        let mut command = self.command(&[arguments, &["--config", &config]].concat());
        self.children.push((name, command.stdout(Stdio::null()).stderr(log).spawn().unwrap()));
    }

    fn stop(&mut self, name: &str) {
        for (_, child) in self.children.iter_mut().filter(|(own, _)| *own == name) {
            terminate(child);
        }
        self.children.retain(|(own, _)| *own != name);
    }
}

impl Drop for Services {
    fn drop(&mut self) {
        for (name, child) in &mut self.children {
            terminate(child);
            if std::thread::panicking() {
                eprintln!("--- {name}\n{}", std::fs::read_to_string(self.folder.join(*name)).unwrap_or_default());
            }
        }
        let _left = self.domain.clean_up();
    }
}

/// A switched sensor is narrated, and the forecast appears in Home Assistant.
fn works(when: &str, home: &HomeAssistant, token: &str, heard: &Subscriber<NarrationV1>) {
    let mut talk = Talk::open(home, token);
    while heard.receive().unwrap().is_some() {}
    let mut open = false;
    eventually(&format!("a sensor is narrated {when}"), || {
        open = !open;
        talk.turn("fridge_door", open);
        let is_narrated = || heard.receive().unwrap().filter(|narration| narration.text() == "They open the fridge.");
        waited(Duration::from_millis(800), is_narrated)
    });
    eventually(&format!("the forecast is there {when}"), || {
        let state = talk.state("sensor.roomcast_kuche_now")?;
        state.parse::<f64>().ok()
    });
}

#[test]
#[ignore = "full"]
fn a_real_home_assistant_is_imported_narrated_told_and_left_clean() {
    let Some(program) = program() else {
        skipped(NO_HOME_ASSISTANT);
        return;
    };
    let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
    let folder = directory.path();
    let Some((mut broker, port)) = Mosquitto::ready() else { return };
    let mut home = HomeAssistant::new(program, &folder.join("config"), port);
    home.start();
    let token = home.token();
    let token_file = folder.join("token");
    std::fs::write(&token_file, format!("{token}\n")).unwrap();
    std::fs::set_permissions(&token_file, std::fs::Permissions::from_mode(0o600)).unwrap();

    // Areas and their entities, set as by the user interface.
    let mut talk = Talk::open(&home, &token);
    for area in ["Küche", "Wohnzimmer", "Bathroom", "Schlafzimmer"] {
        talk.ask(json!({"type": "config/area_registry/create", "name": area}));
    }
    eventually("all entities are there", || ENTITIES.iter().all(|(id, _)| talk.state(id).is_some()).then_some(()));
    for (id, area) in ENTITIES {
        talk.ask(json!({"type": "config/entity_registry/update", "entity_id": id, "area_id": area}));
    }

    // The import over the API equals the import of the folder, once Home Assistant has written it.
    let domain = Domain::new(folder.join("d"), &format!("home-{}", std::process::id() % 100_000)).unwrap();
    let mut services = Services { folder: folder.to_owned(), domain, children: Vec::new() };
    let import = |services: &Services, source: &str, name: &str, more: &[&str]| {
        let out = folder.join(format!("{name}.json")).display().to_string();
        let rules = folder.join(format!("{name}.rules.toml"));
        let _before = std::fs::remove_file(&rules);
        let common = ["scene", "import", "--format", "home-assistant", "--name", "home", source, "--out", &out];
        let output = services.command(&[&common[..], more].concat()).env_remove("ROOMCAST_ROOT").output().unwrap();
        if !output.status.success() {
            return Err(String::from_utf8(output.stderr).unwrap());
        }
        Ok((std::fs::read_to_string(out).unwrap(), std::fs::read_to_string(rules).unwrap_or_default()))
    };
    let (url, token_path) = (home.url(), token_file.display().to_string());
    let told = import(&services, &url, "told", &["--token-file", &token_path]).unwrap();
    assert!(told.0.contains("\"kuche\"") && told.0.contains("\"kitchen\""), "{}", told.0);
    for sentence in ["They open the fridge.", "They turn on the toaster.", "room = \"bathroom\"", "person = \"Ada\""] {
        assert!(told.1.contains(sentence), "{sentence} in {}", told.1);
    }
    let config = home.folder.display().to_string();
    eventually("the folder says the same", || {
        (import(&services, &config, "read", &[]) == Ok(told.clone())).then_some(())
    });
    let wrong = folder.join("wrong");
    std::fs::write(&wrong, "eyJ.no.token\n").unwrap();
    std::fs::set_permissions(&wrong, std::fs::Permissions::from_mode(0o600)).unwrap();
    let refused = import(&services, &url, "refused", &["--token-file", &wrong.display().to_string()]).unwrap_err();
    assert!(refused.contains("refuses the token"), "{refused}");

    // The newest Home Assistant writes its areas after minutes, and has closed this silent connection meanwhile.
    let mut talk = Talk::open(&home, &token);
    // Set-up and start follow the manual.
    let (target, at) = (folder.join("home").display().to_string(), format!("mqtt://127.0.0.1:{port}"));
    let init = [
        "init",
        "--yes",
        "--home-assistant",
        &url,
        "--token-file",
        &token_path,
        "--mqtt",
        &at,
        "--robot",
        "none",
        &target,
    ];
    let output = services.command(&init).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let config = services.config();
    // Home Assistant publishes a state only when it changes.
    [true, false].into_iter().for_each(|on| talk.turn("fridge_door", on));
    let checked = services.command(&["doctor", "--json", "--wait", "2", "--config", &config]).output().unwrap();
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stdout));
    services.start("daemon", &["daemon"]);
    services.start("narrator", &["narrate", "--mqtt"]);
    services.start("planner", &["planner", "--know", "0"]);
    services.start("bridge", &["publish", "mqtt"]);
    let node = services.domain.open("test").unwrap();
    let heard = node.subscriber::<NarrationV1>().unwrap();
    works("at first", &home, &token, &heard);
    let entities = talk.roomcast_entities();
    for id in [
        "sensor.roomcast_bathroom_now",
        "binary_sensor.roomcast_bathroom_soon",
        "binary_sensor.roomcast_daemon",
        "binary_sensor.roomcast_somebody",
    ] {
        assert!(entities.iter().any(|own| own == id), "{id} in {entities:?}");
    }

    // A person holds the robot by its switch, and its rooms have buttons.
    let hold = "switch.roomcast_robot_robot_hold";
    for id in [hold, "button.roomcast_robot_robot_clean_bathroom", "button.roomcast_robot_robot_skip_bathroom"] {
        eventually(&format!("{id} is there"), || talk.state(id));
    }
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    for is_held in [true, false] {
        talk.switch(hold, is_held);
        eventually(&format!("held: {is_held}"), || {
            let decision = decisions.newest().unwrap()?;
            (decision.has(decision_flags::HELD) == is_held).then_some(())
        });
    }

    // The automation in docs/publish.md warms the bathroom before a person enters.
    talk.turn("bathroom_motion", true);
    eventually("somebody is soon in the bathroom", || {
        (talk.state("binary_sensor.roomcast_bathroom_soon")? == "on").then_some(())
    });
    eventually("the bathroom is warmed", || {
        let states = talk.ask(json!({"type": "get_states"}));
        let climate =
            states.as_array().unwrap().iter().find(|state| state["entity_id"] == "climate.bathroom").unwrap().clone();
        (climate["attributes"]["temperature"] == 22.0).then_some(())
    });
    // The automation in docs/robot.md turns an order into a service call for the vacuum.
    let vacuum = json!({"name": "dusty", "unique_id": "dusty", "object_id": "dusty", "schema": "state", "command_topic": "dusty/command",
        "state_topic": "dusty/state", "send_command_topic": "dusty/send", "supported_features": ["start", "pause", "stop", "return_home", "send_command"]});
    let order = "roomcast/robots/robot/order";
    broker.publish(&[("homeassistant/vacuum/dusty/config", vacuum.to_string(), true)]);
    eventually("the vacuum is there", || talk.state("vacuum.dusty"));
    let mut ears = Talk::open(&home, &token);
    ears.ask(json!({"type": "subscribe_events", "event_type": "call_service"}));
    for (order_text, service) in [
        (json!({"order": "clean", "segment": "17", "room": "kuche"}), "send_command"),
        (json!({"order": "pause"}), "pause"),
        (json!({"order": "stop"}), "stop"),
        (json!({"order": "return"}), "return_to_base"),
    ] {
        broker.publish(&[(order, order_text.to_string(), false)]);
        let called = eventually(&format!("{order_text} is a service"), || {
            ears.ask(json!({"type": "get_config"}));
            let own = |event: &&Value| event["data"]["domain"] == "vacuum" && event["data"]["service"] == service;
            ears.events.iter().find(own).cloned()
        });
        let data = &called["data"]["service_data"];
        assert!(data["entity_id"].to_string().contains("vacuum.dusty"), "{called}");
        if service == "send_command" {
            assert_eq!((&data["command"], &data["params"]), (&json!("app_segment_clean"), &json!([17])), "{called}");
        }
    }

    // A pausing robot has no room, and Home Assistant shows the state as unknown, not as a text.
    let planner = node.publisher::<DecisionV1>().unwrap();
    let told = DecisionV1 { robot: 7, epoch: 1, sequence: 1, action: action::PAUSE, ..Default::default() };
    eventually("no room is unknown", || {
        planner.send(&told).unwrap();
        let robots = talk.ask(json!({"type": "get_states"}));
        let is_room =
            |id: &str| id.starts_with("sensor.roomcast_robot_robot_0000000000000007") && id.ends_with("_room");
        let mut all = robots.as_array().unwrap().iter();
        (all.find(|state| is_room(state["entity_id"].as_str().unwrap()))?["state"] == "unknown").then_some(())
    });
    drop(planner);

    broker = broker.restart();
    works("after the broker's restart", &home, &token, &heard);
    drop((talk, ears));
    home.stop();
    home.start();
    works("after Home Assistant's restart", &home, &token, &heard);
    services.stop("bridge");
    let mut talk = Talk::open(&home, &token);
    eventually("without the bridge nothing is known", || {
        (talk.state("sensor.roomcast_kuche_now")? == "unavailable").then_some(())
    });
    services.stop("daemon");
    services.start("daemon", &["daemon"]);
    services.start("bridge", &["publish", "mqtt"]);
    works("after the restart of daemon and bridge", &home, &token, &heard);

    services.stop("bridge");
    let removed = services.command(&["publish", "mqtt", "--remove", "--config", &config]).output().unwrap();
    assert!(removed.status.success(), "{removed:?}");
    eventually("no entity is left", || talk.roomcast_entities().is_empty().then_some(()));
    let registry = talk.ask(json!({"type": "config/entity_registry/list"}));
    let left: Vec<_> = registry
        .as_array()
        .unwrap()
        .iter()
        .filter(|entity| entity["platform"] == "mqtt" && entity["entity_id"].to_string().contains("roomcast"))
        .collect();
    assert!(left.is_empty(), "{left:?}");
    // Home Assistant logged no complaint about the published messages.
    let log = std::fs::read_to_string(home.folder.join("log")).unwrap();
    let is_of_roomcast = |line: &&str| line.contains("roomcast") || line.contains("Invalid");
    let complaints: Vec<&str> =
        log.lines().filter(|line| line.contains("components.mqtt")).filter(is_of_roomcast).collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
    drop(broker);
}
