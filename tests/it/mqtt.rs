//! Real processes and a real broker. The bridge: its topics over restarts of daemon, broker and bridge, and after map changes. The robot: the real
//! planner drives a simulated Valetudo. `services/src/vacuum/driver/tests.rs` plays its day with a person.

use std::collections::BTreeMap;
use std::fs::File;
use std::process::Stdio;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use roomcast_ipc::raw::{DecisionV1, decision_flags};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Packet;
use rumqttc::v5::{Client, Event, MqttOptions};
use rustix::process::Signal;
use serde_json::Value;

use roomcast_cli::exit_code;

use crate::eventually::eventually;
use crate::fake_valetudo::FakeValetudo;
use crate::mosquitto::{ANYBODY, Mosquitto};
use crate::world::{Process, World};

/// Another program's entity with our node's name.
const FOREIGN: &str = "homeassistant/sensor/roomcast/foreign/config";
/// Another program's message below our topics.
const NEIGHBOUR: &str = "roomcast/persons/of_my_neighbour";
/// The bridge's list of its topics.
const LIST: &str = "roomcast/bridge/topics";
const STUDIO_ROOM: &str = "roomcast/rooms/main-room";

/// A private domain with a short publishing interval.
fn world(name: &str) -> World {
    let world = World::new(name);
    std::fs::write(world.path("roomcast.toml"), "[bridge]\ninterval_s = 0.1\n").unwrap();
    world
}

fn start_daemon(world: &mut World, state: &str, more: &[&str]) -> usize {
    let state = world.path(state);
    world.start(&[&["daemon", "--state", state.to_str().unwrap()], more].concat())
}

fn start_bridge(world: &mut World, port: u16) -> usize {
    let config = world.path("roomcast.toml");
    let broker = format!("mqtt://127.0.0.1:{port}");
    world.start(&["publish", "mqtt", "--config", config.to_str().unwrap(), "--mqtt", &broker])
}

fn narrate(world: &World, lines: &str) {
    assert_eq!(world.narrate("person", lines).0, 0);
}

/// The broker's retained messages, by topic. A marker message ends the list.
fn kept(port: u16) -> BTreeMap<String, String> {
    static NUMBER: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
    let name = format!("looker-{}", NUMBER.fetch_add(1, std::sync::atomic::Ordering::Relaxed));
    let mut options = MqttOptions::new(&name, "127.0.0.1", port);
    options.set_max_packet_size(Some(64 << 20));
    let (client, mut connection) = Client::new(options, 4);
    client.subscribe("#", QoS::AtLeastOnce).unwrap();
    client.publish(format!("marker/{name}"), QoS::AtLeastOnce, false, "").unwrap();
    let mut kept = BTreeMap::new();
    loop {
        if let Ok(Event::Incoming(Packet::Publish(message))) = connection.recv().unwrap() {
            let topic = String::from_utf8(message.topic.to_vec()).unwrap();
            if topic == format!("marker/{name}") {
                return kept;
            }
            if message.retain {
                kept.insert(topic, String::from_utf8(message.payload.to_vec()).unwrap());
            }
        }
    }
}

fn kept_with(port: u16, what: &str, holds: impl Fn(&BTreeMap<String, String>) -> bool) -> BTreeMap<String, String> {
    eventually(what, || Some(kept(port)).filter(&holds))
}

fn at(kept: &BTreeMap<String, String>, topic: &str) -> Value {
    kept.get(topic).map_or(Value::Null, |payload| serde_json::from_str(payload).unwrap())
}

fn config_of(entity: &str) -> String {
    let (component, object) = entity.split_once('.').unwrap();
    format!("homeassistant/{component}/roomcast/{object}/config")
}

fn is(kept: &BTreeMap<String, String>, topic: &str, value: &str) -> bool {
    kept.get(topic).is_some_and(|payload| payload == value)
}

#[test]
fn what_is_known_stands_at_the_broker_over_restarts_and_goes_with_its_rooms() {
    let Some((mut broker, port)) = Mosquitto::ready() else { return };
    broker.publish(&[
        (FOREIGN, r#"{"name": "somebody else's", "state_topic": "x"}"#.into(), true),
        // An earlier run left this room, which is in no map now.
        ("roomcast/rooms/attic", "{}".into(), true),
        (LIST, r#"{"origin": {"name": "roomcast"}, "node": "roomcast", "topics": ["rooms/attic"]}"#.into(), true),
        (NEIGHBOUR, "keep me".into(), true),
    ]);
    let mut world = world("bridge");
    let bridge = start_bridge(&mut world, port);
    let now = kept_with(port, "a bridge without a daemon says so", |kept| is(kept, "roomcast/daemon", "offline"));
    assert_eq!(at(&now, "roomcast/health")["daemon"], false);
    assert!(now.contains_key("roomcast/rooms/attic"), "which rooms there are is not known yet");
    let daemon = start_daemon(&mut world, "state", &[]);
    narrate(
        &world,
        "{\"text\": \"They walk to the kitchen.\", \"person\": \"ada\"}\n{\"text\": \"They open the fridge.\", \"person\": \"ada\"}\n",
    );
    world.start(&["planner"]);
    let second = world.start(&["planner", "--robot", "mop2"]);
    kept_with(port, "a robot by its name", |kept| at(kept, "roomcast/robots/mop2")["robot"] == "mop2");
    world.end(second, Signal::TERM);
    kept_with(port, "it goes with its planner", |kept| !kept.keys().any(|topic| topic.contains("mop2")));
    let now = kept_with(port, "rooms, persons and decisions", |kept| {
        at(kept, "roomcast/persons/ada")["likely"] == "kitchen" && at(kept, "roomcast/robots/robot")["action"] == "go"
    });
    assert!(at(&now, "roomcast/rooms/kitchen")["now"].as_f64().unwrap() > 0.5, "{now:?}");
    assert_eq!(at(&now, "roomcast/rooms/kitchen")["soon"], true);
    assert!(!at(&now, "roomcast/robots/robot")["reason"].as_str().unwrap().is_empty());
    for entity in
        ["sensor.main-room_now", "binary_sensor.kitchen_soon", "sensor.person_ada", "sensor.robot_robot_reason"]
    {
        let config = at(&now, &config_of(entity));
        assert!(now.contains_key(config["state_topic"].as_str().unwrap()), "{entity}: {config}");
    }
    broker.publish(&[("roomcast/persons/ada/place", "main room".into(), false)]);
    kept_with(port, "the selected place is believed", |kept| at(kept, "roomcast/persons/ada")["likely"] == "main-room");
    let now = kept_with(port, "what an earlier run left goes", |kept| !kept.contains_key("roomcast/rooms/attic"));
    assert!(now.contains_key(FOREIGN) && is(&now, NEIGHBOUR, "keep me"));

    // The bridge restores its messages when another program changes or deletes them.
    let lost = config_of("sensor.person_ada");
    broker.publish(&[("roomcast/status", "offline".into(), true), (&lost, String::new(), true)]);
    kept_with(port, "it is gone", |kept| is(kept, "roomcast/status", "offline") && !kept.contains_key(&lost));
    kept_with(port, "it is there again", |kept| is(kept, "roomcast/status", "online") && kept.contains_key(&lost));

    // Without the daemon, the bridge keeps its topics and reports the daemon as offline.
    world.end(daemon, Signal::KILL);
    let now = kept_with(port, "the daemon is gone", |kept| is(kept, "roomcast/daemon", "offline"));
    assert!(is(&now, "roomcast/status", "online") && now.contains_key(STUDIO_ROOM));

    // The new broker has no retained messages.
    broker.stop();
    broker = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY).unwrap();
    kept_with(port, "all of it is said again", |kept| {
        kept.contains_key(STUDIO_ROOM) && kept.contains_key(&config_of("sensor.person_ada"))
    });
    broker.publish(&[
        (FOREIGN, r#"{"name": "somebody else's", "state_topic": "x"}"#.into(), true),
        (NEIGHBOUR, "keep me".into(), true),
    ]);
    let broker = broker.restart();

    // The bridge is killed, and the next bridge finds another map.
    kept_with(port, "it is back", |kept| is(kept, "roomcast/status", "online"));
    world.end(bridge, Signal::KILL);
    let now = kept_with(port, "its will", |kept| is(kept, "roomcast/status", "offline"));
    assert!(now.contains_key(STUDIO_ROOM));
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/two_rooms.json");
    let daemon = start_daemon(&mut world, "other", &["--scene", scene]);
    let bridge = start_bridge(&mut world, port);
    let now = kept_with(port, "the rooms of the other map", |kept| {
        kept.contains_key("roomcast/rooms/living-room") && !kept.contains_key(STUDIO_ROOM)
    });
    let now = if now.keys().any(|topic| topic.contains("main-room") || topic.contains("person_ada")) {
        kept_with(port, "no entity of the former rooms and persons", |kept| {
            !kept.keys().any(|topic| topic.contains("main-room") || topic.contains("ada"))
        })
    } else {
        now
    };
    assert!(now.contains_key(&config_of("sensor.living-room_now")) && now.contains_key(FOREIGN));

    // The daemon restarts with the former map while the bridge runs.
    world.end(daemon, Signal::KILL);
    start_daemon(&mut world, "third", &[]);
    kept_with(port, "the room is gone", |kept| !kept.keys().any(|topic| topic.contains("living-room")));

    // On SIGTERM the bridge reports itself as offline. Its topics stay until `--remove`.
    assert_eq!(world.end(bridge, Signal::TERM), Some(0));
    let log = world.log(bridge);
    assert!(!log.contains("trying again"), "a farewell is no lost connection: {log}");
    let now = kept(port);
    assert!(is(&now, "roomcast/status", "offline") && now.contains_key("roomcast/rooms/kitchen"));
    let address = format!("mqtt://127.0.0.1:{port}");
    let removed = world.command(&["publish", "mqtt", "--remove", "--mqtt", &address]).output().unwrap();
    assert!(removed.status.success(), "{removed:?}");
    assert_eq!(kept(port).into_keys().collect::<Vec<_>>(), [FOREIGN, NEIGHBOUR]);
    drop(broker);
}

/// Times of the messages on each topic.
type Told = BTreeMap<String, Vec<Instant>>;

/// Notes the time of each message until the caller drops the table.
fn watch(port: u16, told: Arc<Mutex<Told>>) {
    std::thread::spawn(move || {
        let mut options = MqttOptions::new("watcher", "127.0.0.1", port);
        options.set_keep_alive(Duration::from_secs(5));
        let (client, mut connection) = Client::new(options, 4);
        client.subscribe("roomcast/#", QoS::AtLeastOnce).unwrap();
        while Arc::strong_count(&told) > 1 {
            if let Ok(Ok(Event::Incoming(Packet::Publish(message)))) =
                connection.recv_timeout(Duration::from_millis(50))
            {
                let topic = String::from_utf8(message.topic.to_vec()).unwrap();
                told.lock().unwrap().entry(topic).or_default().push(Instant::now());
            }
        }
    });
}

#[test]
fn nothing_is_told_faster_than_the_interval_however_much_happens() {
    const INTERVAL_S: f64 = 3.0;
    /// The greatest delay of one message relative to the next, on a loaded machine.
    const LATE_S: f64 = 2.4;
    let Some((_broker, port)) = Mosquitto::ready() else { return };
    let mut world = world("rate");
    let config = world.path("roomcast.toml");
    std::fs::write(config, format!("[bridge]\ninterval_s = {INTERVAL_S:?}\n")).unwrap();
    start_daemon(&mut world, "state", &[]);
    let told = Arc::new(Mutex::new(Told::new()));
    watch(port, Arc::clone(&told));
    start_bridge(&mut world, port);
    kept_with(port, "the bridge is at work", |kept| kept.contains_key("roomcast/rooms/kitchen"));
    for round in 0..5 {
        let places = ["fridge", "bed", "stove", "sofa", "sink"];
        let lines: Vec<_> = places.iter().map(|thing| format!("They walk to the {thing}.")).collect();
        narrate(&world, &format!("{}\nThey look at the mug {round}.\n", lines.join("\n")));
    }
    let twice = |told: &Told| told.get("roomcast/rooms/kitchen").is_some_and(|times| times.len() >= 2);
    let told = eventually("the kitchen is told of again", || Some(told.lock().unwrap().clone()).filter(twice));
    // The minimum gap holds for every two messages, not only on average: a burst before a silence is too fast.
    for (topic, told) in &told {
        for (first, times) in told.windows(2).enumerate() {
            let gap_s = (times[1] - times[0]).as_secs_f64();
            assert!(gap_s >= INTERVAL_S - LATE_S, "{topic}: message {} came {gap_s} s after the one before", first + 2);
        }
        for (first, start) in told.iter().enumerate() {
            for (more, time) in told.iter().enumerate().skip(first + 1) {
                let (gap_s, least_s) = ((*time - *start).as_secs_f64(), (more - first) as f64 * INTERVAL_S - LATE_S);
                assert!(gap_s >= least_s, "{topic}: {} messages within {gap_s} s", more - first + 1);
            }
        }
    }
}

#[test]
fn a_dry_run_prints_what_would_be_published_and_odd_names_are_safe() {
    let mut world = world("dry");
    start_daemon(&mut world, "state", &[]);
    narrate(&world, "{\"text\": \"They open the fridge.\", \"person\": \"<b>a/+#\"}\n");
    let output = world.command(&["publish", "mqtt", "--dry-run", "--once", "--topic", "my/home"]).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let topics: Vec<&str> = lines.iter().map(|line| line["topic"].as_str().unwrap()).collect();
    assert!(topics.contains(&"my/home/rooms/kitchen") && lines.iter().all(|line| line["retain"] == true), "{text}");
    assert!(topics.iter().all(|topic| !topic.contains(['+', '#', '<'])), "{topics:?}");
    let person = lines.iter().find(|line| line["topic"].as_str().unwrap().starts_with("my/home/persons/")).unwrap();
    let message: Value = serde_json::from_str(person["payload"].as_str().unwrap()).unwrap();
    assert_eq!(message["person"], "<b>a/+#");
    assert!(topics.iter().any(|topic| topic.starts_with("homeassistant/sensor/my_home_")), "{topics:?}");
}

#[test]
#[ignore = "full"]
fn a_wrong_set_up_is_one_clear_error() {
    let world = world("wrong");
    let run = |arguments: &[&str]| {
        let output = world.command(&[&["publish", "mqtt"], arguments].concat()).output().unwrap();
        (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
    };
    for (arguments, code, part) in [
        (&[][..], exit_code::CONFIG, "no broker is named"),
        (&["--mqtt", "http://x"], exit_code::USAGE, "is no broker"),
        (&["--mqtt", "mqtts://x"], exit_code::USAGE, "without a CA file"),
        (&["--mqtt", "mqtt://x", "--mqtt-credentials", "/nowhere"], exit_code::INPUT, "/nowhere"),
        (&["--mqtt", "mqtt://x", "--topic", "a/#"], exit_code::CONFIG, "bridge.topic"),
        (&["--once"], exit_code::USAGE, "--dry-run"),
        (&["--dry-run", "--once"], exit_code::IPC, "no daemon has published"),
    ] {
        let (got, said) = run(arguments);
        assert!(got == i32::from(code) && said.contains(part), "{arguments:?}: {got} {said}");
    }
    assert!(run(&["--mqtt", "mqtt://127.0.0.1:9", "--remove"]).1.contains("has not taken everything away"));
}

/// The simulated robot at the broker, in its own thread, with a faster clock.
struct Fake {
    robot: Arc<Mutex<FakeValetudo>>,
    stop: Arc<Mutex<bool>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

const SPEED: f64 = 60.0;
const FAKE: &str = "valetudo/fake";

impl Fake {
    fn start(port: u16, robot: FakeValetudo) -> Self {
        let (robot, stop) = (Arc::new(Mutex::new(robot)), Arc::new(Mutex::new(false)));
        let (own, own_stop) = (Arc::clone(&robot), Arc::clone(&stop));
        let live = move || {
            let mut options = MqttOptions::new("fake-robot", "127.0.0.1", port);
            options.set_keep_alive(Duration::from_secs(5));
            let (client, mut connection) = Client::new(options, 64);
            let (mut passed, mut connected) = (Instant::now(), false);
            while !*own_stop.lock().unwrap() {
                let event = connection.recv_timeout(Duration::from_millis(20));
                let mut robot = own.lock().unwrap();
                let (since, now) = (passed, Instant::now());
                passed = now;
                robot.pass((now - since).as_secs_f64() * SPEED);
                let mut again = false;
                match event {
                    Ok(Ok(Event::Incoming(Packet::ConnAck(_)))) => {
                        client.try_subscribe(format!("{FAKE}/+/+/set"), QoS::AtLeastOnce).unwrap();
                        (connected, again) = (true, true);
                    }
                    Ok(Ok(Event::Incoming(Packet::Publish(message)))) => {
                        let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
                        robot.hear(&text(&message.topic), &text(&message.payload));
                    }
                    Ok(Err(_)) => {
                        connected = false;
                        // Until the robot tries again.
                        std::thread::sleep(Duration::from_millis(50));
                    }
                    _ => {}
                }
                if connected {
                    for (topic, payload) in robot.say(again) {
                        let _full = client.try_publish(topic, QoS::AtLeastOnce, true, payload);
                    }
                }
            }
        };
        Self { robot, stop, thread: Some(std::thread::spawn(live)) }
    }

    fn look<T>(&self, at: impl Fn(&FakeValetudo) -> T) -> T {
        at(&self.robot.lock().unwrap())
    }
}

impl Drop for Fake {
    fn drop(&mut self) {
        *self.stop.lock().unwrap() = true;
        let _ended = self.thread.take().map(std::thread::JoinHandle::join);
    }
}

fn home_with_a_robot(world: &World) -> String {
    let config = world.path("robot.toml");
    let text = format!(
        "[planner]\nknow_s = 0.0\nroom_time_s = 10.0\nreports = \"always\"\nrepeat = false\npolicy = \"uncovered-first\"\n\
        [robot]\ntopic = \"{FAKE}\"\nstart_s = 1.0\nleast_s = 0.1\n[robot.segments]\nmain-room = \"1\"\nkitchen = \"2\"\nbathroom = \"3\"\n"
    );
    std::fs::write(&config, text).unwrap();
    config.to_str().unwrap().to_owned()
}

const SEGMENTS: [(&str, &str, f64); 3] = [("1", "Wohnen", 180.0), ("2", "Küche", 180.0), ("3", "Bad", 180.0)];

#[test]
#[ignore = "full"]
fn a_robot_over_a_real_broker_obeys_and_its_word_counts_over_lost_orders_an_error_and_a_restarted_broker() {
    let Some((mut broker, port)) = Mosquitto::ready() else { return };
    let mut world = world("robot");
    let config = home_with_a_robot(&world);
    let mut robot = FakeValetudo::new(FAKE, &SEGMENTS);
    robot.orders_ignored = 1;
    // The robot stays stuck until the test frees it.
    robot.sticks = Some(("2".to_owned(), 1e9));
    let fake = Fake::start(port, robot);
    start_daemon(&mut world, "state", &[]);
    let node = world.domain.open("test").unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    let broker_at = format!("mqtt://127.0.0.1:{port}");
    world.start(&["robot", "--obey", "--config", &config, "--mqtt", &broker_at]);
    world.start(&["planner", "--config", &config]);
    let mut told = Vec::new();
    let listen = |told: &mut Vec<DecisionV1>| {
        while let Some(decision) = decisions.receive().unwrap() {
            told.push(decision);
        }
    };
    // The broker stops during the first room and returns without retained messages.
    eventually("it is at work", || {
        listen(&mut told);
        fake.look(|robot| robot.job.is_some()).then_some(())
    });
    broker.stop();
    broker = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY).unwrap();
    // The order of the rooms is open; the decision after the stuck room gives the reason.
    let why = eventually("a decision says that it is stuck", || {
        listen(&mut told);
        told.iter().find(|decision| decision.reason().contains("Wheel lost floor contact")).copied()
    });
    assert!(why.reason().contains("could not do the kitchen"), "{}", why.reason());
    assert!(why.has(decision_flags::REPORTED));
    let cleaned = fake.look(|robot| robot.cleaned.len());
    assert_eq!(why.covered.count_ones() as usize, cleaned, "a room is done when the robot says so, and only then");
    fake.robot.lock().unwrap().free();
    let all = eventually("every other room is done", || {
        listen(&mut told);
        let last = told.last().filter(|decision| decision.covered.count_ones() >= 2).copied();
        last.filter(|_| fake.look(|robot| robot.cleaned.len() >= 2))
    });
    assert!(all.covered.count_ones() as usize <= fake.look(|robot| robot.cleaned.len()));
    assert!(fake.look(|robot| robot.orders_ignored == 0));
    drop(broker);
}

#[test]
fn without_obey_a_robot_is_told_nothing() {
    let Some((_broker, port)) = Mosquitto::ready() else { return };
    let mut world = world("rehearsal");
    let config = home_with_a_robot(&world);
    let fake = Fake::start(port, FakeValetudo::new(FAKE, &SEGMENTS));
    start_daemon(&mut world, "state", &[]);
    world.start(&["planner", "--config", &config]);
    let shown = world.path("shown");
    let broker_at = format!("mqtt://127.0.0.1:{port}");
    let mut command = world.command(&["robot", "--config", &config, "--mqtt", &broker_at]);
    let child = command.stdout(File::create(&shown).unwrap()).stderr(Stdio::null()).spawn().unwrap();
    world.children.push(Process { child, log: shown.clone() });
    let line = eventually("it says what it would do", || {
        std::fs::read_to_string(&shown)
            .unwrap()
            .lines()
            .next()
            .and_then(|line| serde_json::from_str::<Value>(line).ok())
    });
    assert_eq!(line["topic"], format!("{FAKE}/MapSegmentationCapability/clean/set"));
    assert!(fake.look(|robot| robot.orders.is_empty()));
}

/// Before the robot's first message, the driver reports the missing message, not missing segments.
#[test]
fn of_a_robot_that_has_not_spoken_it_is_said_where_it_is_listened_to_and_what_to_do() {
    let Some((_broker, port)) = Mosquitto::ready() else { return };
    let mut world = world("silent");
    let config = world.path("robot.toml");
    std::fs::write(&config, format!("[robot]\ntopic = \"{FAKE}\"\n")).unwrap();
    start_daemon(&mut world, "state", &[]);
    let broker_at = format!("mqtt://127.0.0.1:{port}");
    let driver = world.start(&["robot", "--config", config.to_str().unwrap(), "--mqtt", &broker_at]);
    let log = world.children[driver].log.clone();
    let said = |part: &str| {
        eventually(part, || Some(std::fs::read_to_string(&log).unwrap()).filter(|said| said.contains(part)))
    };
    let silent = said("nothing was heard of the robot yet");
    for part in [FAKE, &broker_at, "connect it to this broker"] {
        assert!(silent.contains(part), "{part} in {silent}");
    }
    assert!(!silent.contains("segment"), "{silent}");
    let _fake = Fake::start(port, FakeValetudo::new(FAKE, &SEGMENTS));
    said("the robot speaks");
    // The segments "Küche" and "Bad" match rooms of the included studio; it has no living room.
    let all = said("a room that the robot cannot do");
    assert!(all.contains("a room that the robot can do") && all.contains("no segment of the robot's map"), "{all}");
}
