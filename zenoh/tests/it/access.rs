//! The access control that `roomcast-zenoh router` prints: logins, and each participant's rights to read and write.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DistinguishedName, DnType, IsCa, KeyPair};
use roomcast_zenoh::config::Router;
use roomcast_zenoh::link::client;
use zenoh::{Session, Wait};

use crate::support::{NO_ROUTER, Process, Robot, Watch, bridge, eventually, free_port, python, router_of, skipped};

type Authority = CertifiedIssuer<'static, KeyPair>;

fn authority() -> Authority {
    let mut params = CertificateParams::new(Vec::new()).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap()
}

/// Writes `NAME.pem` and `NAME.key`, signed by an authority.
fn certify(folder: &Path, authority: &Authority, name: &str) -> (PathBuf, PathBuf) {
    let key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
    params.distinguished_name = DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    let certificate = params.signed_by(&key, authority).unwrap();
    let files = (folder.join(format!("{name}.pem")), folder.join(format!("{name}.key")));
    std::fs::write(&files.0, certificate.pem()).unwrap();
    std::fs::write(&files.1, key.serialize_pem()).unwrap();
    files
}

struct World {
    folder: tempfile::TempDir,
    port: u16,
    authority: Authority,
    _router: Process,
}

impl World {
    fn new() -> Option<Self> {
        let python = python()?;
        let folder = tempfile::tempdir().unwrap();
        let (port, authority) = (free_port(), authority());
        std::fs::write(folder.path().join("ca.pem"), authority.as_ref().pem()).unwrap();
        certify(folder.path(), &authority, "router");
        for name in ["robot-1", "hall-camera", "operator", "stranger"] {
            certify(folder.path(), &authority, name);
        }
        let example = bridge().arg("router").output().unwrap().stdout;
        let example = String::from_utf8(example).unwrap();
        let example = example.replace("/etc/roomcast/zenoh", folder.path().to_str().unwrap());
        let example = example.replace("tls/0.0.0.0:7447", &format!("tls/localhost:{port}"));
        let router = router_of(folder.path(), &python, port, &example);
        Some(Self { folder, port, authority, _router: router })
    }

    fn way(&self, name: &str) -> Router {
        let file = |ending: &str| Some(self.folder.path().join(format!("{name}.{ending}")));
        let ca = Some(self.folder.path().join("ca.pem"));
        Router {
            connect: format!("tls/localhost:{}", self.port),
            ca,
            certificate: file("pem"),
            key: file("key"),
            insecure: false,
        }
    }

    fn section(&self, name: &str) -> String {
        let Router { connect, ca, certificate, key, .. } = self.way(name);
        let [ca, certificate, key] = [ca, certificate, key].map(Option::unwrap);
        format!("[router]\nconnect = {connect:?}\nca = {ca:?}\ncertificate = {certificate:?}\nkey = {key:?}\n")
    }

    fn open(&self, name: &str) -> Session {
        zenoh::open(client(&self.way(name)).unwrap()).wait().unwrap()
    }
}

fn heard(session: &Session, key: &str) -> Arc<Mutex<Vec<String>>> {
    let heard = Arc::<Mutex<Vec<String>>>::default();
    let own = Arc::clone(&heard);
    let take = move |sample: zenoh::sample::Sample| {
        own.lock().unwrap().push(format!("{} {}", sample.key_expr(), sample.payload().try_to_string().unwrap()));
    };
    session.declare_subscriber(key.to_owned()).callback(take).background().wait().unwrap();
    heard
}

#[test]
fn who_has_no_certificate_of_the_sites_authority_does_not_get_in() {
    let Some(world) = World::new() else { return skipped(NO_ROUTER) };
    let refused = |what: &str, config: zenoh::Config| {
        assert!(zenoh::open(config).wait().is_err(), "{what} got in");
    };
    let mut none = client(&world.way("robot-1")).unwrap();
    for key in ["connect_certificate", "connect_private_key"] {
        none.insert_json5(&format!("transport/link/tls/{key}"), "null").unwrap();
    }
    none.insert_json5("transport/link/tls/enable_mtls", "false").unwrap();
    refused("a client without a certificate", none);
    let mut plain = client(&world.way("robot-1")).unwrap();
    plain.insert_json5("connect/endpoints", &format!("[\"tcp/127.0.0.1:{}\"]", world.port)).unwrap();
    refused("a client without TLS", plain);
    // A certificate of another authority with the right name.
    let other = world.folder.path().join("other");
    std::fs::create_dir(&other).unwrap();
    let (certificate, key) = certify(&other, &authority(), "robot-1");
    let mut wrong = world.way("robot-1");
    (wrong.certificate, wrong.key) = (Some(certificate), Some(key));
    refused("a client with another authority's certificate", client(&wrong).unwrap());
    // The client must also refuse a router with another authority's certificate.
    let mut astray = world.way("robot-1");
    let ca = world.folder.path().join("other-ca.pem");
    std::fs::write(&ca, authority().as_ref().pem()).unwrap();
    astray.ca = Some(ca);
    refused("a client that knows another authority", client(&astray).unwrap());
    drop(world.open("robot-1"));
    assert!(!world.authority.as_ref().pem().is_empty());
}

#[test]
fn each_reads_and_writes_its_own_keys_alone() {
    let Some(world) = World::new() else { return skipped(NO_ROUTER) };
    let names = ["robot-1", "hall-camera", "operator", "stranger"];
    // Listeners and speakers are different sessions: a session's messages to itself pass no router.
    let [robot_ear, hub_ear, operator_ear, stranger_ear] = names.map(|name| world.open(name));
    let [robot, hub, operator, stranger] = names.map(|name| world.open(name));
    let by_operator = heard(&operator_ear, "roomcast/home/*/told/**");
    let by_robot = heard(&robot_ear, "roomcast/home/robot-1/narration/*");
    let by_hub = heard(&hub_ear, "roomcast/home/*/confirmed/hall-camera");
    let of_robots = "roomcast/home/*/told/**";
    let unheard = [(&stranger_ear, "roomcast/**"), (&hub_ear, of_robots), (&robot_ear, of_robots)];
    let unheard = unheard.map(|(session, key)| heard(session, key));
    let put = |session: &Session, key: &str, text: &str| session.put(key, text).wait().unwrap();
    // Forbidden writes: other participants' keys, and other participants' names.
    for (who, session, keys) in [
        (
            "robot-1",
            &robot,
            ["robot-2/told/decision", "robot-1/narration/hall-camera", "robot-2/confirmed/hall-camera"],
        ),
        ("hall-camera", &hub, ["robot-1/told/decision", "robot-1/narration/other", "robot-1/confirmed/hall-camera"]),
        (
            "operator",
            &operator,
            ["robot-1/told/habits", "robot-1/narration/hall-camera", "robot-1/confirmed/hall-camera"],
        ),
        (
            "stranger",
            &stranger,
            ["robot-1/told/decision", "robot-1/narration/hall-camera", "robot-1/confirmed/hall-camera"],
        ),
    ] {
        for key in keys {
            put(session, &format!("roomcast/home/{key}"), &format!("forged by {who}"));
        }
    }
    // A session's messages keep their order, so when the permitted ones arrive, the earlier ones have been judged.
    eventually("what is allowed arrives", || {
        put(&robot, "roomcast/home/robot-1/told/decision", "own");
        put(&robot, "roomcast/home/robot-1/told/habits", "own");
        put(&robot, "roomcast/home/robot-1/confirmed/hall-camera", "own");
        put(&hub, "roomcast/home/robot-1/narration/hall-camera", "own");
        let all = [&by_operator, &by_robot, &by_hub].map(|heard| heard.lock().unwrap().len());
        all.iter().all(|heard| *heard > 0).then_some(())
    });
    for heard in [&by_operator, &by_robot, &by_hub] {
        let heard = heard.lock().unwrap();
        assert!(heard.iter().all(|said| said.ends_with(" own")), "{heard:?}");
    }
    eventually("the operator hears of habits, where a robot shares them", || {
        let heard = by_operator.lock().unwrap();
        heard.iter().any(|said| said == "roomcast/home/robot-1/told/habits own").then_some(())
    });
    for heard in &unheard {
        assert!(heard.lock().unwrap().is_empty(), "{heard:?}");
    }
    let last = "roomcast/home/robot-1/told/scores";
    let _answers = robot
        .declare_queryable("roomcast/home/robot-1/told/**")
        .callback(move |query| query.reply(last, "kept").wait().unwrap())
        .wait()
        .unwrap();
    let answered = |session: &Session| {
        let replies = session.get("roomcast/home/*/told/**").timeout(std::time::Duration::from_secs(2)).wait().unwrap();
        replies.into_iter().filter(|reply| reply.result().is_ok()).count()
    };
    eventually("the operator's question is answered", || (answered(&operator) > 0).then_some(()));
    assert_eq!((answered(&stranger), answered(&hub)), (0, 0));
    // Only the operator sees liveliness.
    let _token = robot.liveliness().declare_token("roomcast/home/robot-1/alive").wait().unwrap();
    let there = |session: &Session| {
        let replies = session
            .liveliness()
            .get("roomcast/home/*/alive")
            .timeout(std::time::Duration::from_secs(2))
            .wait()
            .unwrap();
        replies.into_iter().filter(|reply| reply.result().is_ok()).count()
    };
    eventually("the operator sees the robot", || (there(&operator) > 0).then_some(()));
    assert_eq!(there(&stranger), 0);
}

#[test]
fn robot_hub_and_operator_work_under_the_example() {
    let Some(world) = World::new() else { return skipped(NO_ROUTER) };
    let _robot = Robot::start("robot-1", &world.section("robot-1"), &["hall-camera"], "");
    let file = world.folder.path().join("watch.toml");
    std::fs::write(&file, world.section("operator")).unwrap();
    let watch = Watch::start(&file);
    let spool = world.folder.path().join("spool");
    let config = world.folder.path().join("hub.toml");
    let text = format!(
        "{}[hub]\nname = \"hall-camera\"\nrobots = [\"robot-1\"]\nspool = {spool:?}\n",
        world.section("hall-camera")
    );
    std::fs::write(&config, text).unwrap();
    let input = world.folder.path().join("lines");
    std::fs::write(&input, "They walk to the kitchen.\nThey open the fridge.\n").unwrap();
    let (own, lines) = (config.clone(), input.clone());
    let mut hub = Process::start(world.folder.path().join("hub.log"), move || {
        let mut command = bridge();
        command.arg("hub").arg("--config").arg(&own).stdin(std::fs::File::open(&lines).unwrap());
        command
    });
    assert_eq!(hub.wait(), 0, "{}", hub.said());
    assert!(hub.said().contains(r#""confirmed":2"#), "{}", hub.said());
    watch.find("scores with what was narrated", |line| line["window"].as_u64() == Some(2));
    watch.find("the robot's liveliness or next status", |line| line["alive"] == true || line["silence_ns"].is_u64());
}
