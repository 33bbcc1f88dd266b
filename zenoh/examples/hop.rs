//! The cost of one hop: a decision from shared memory through the bridge and a router, and the same bytes through zenoh only, in turns on one
//! machine. The sender is a separate process in both cases: the bridge, or this program started again.
//!
//! ```text
//! cargo run --release --manifest-path zenoh/Cargo.toml --example hop -- PORT PROGRAM [N]
//! ```
//!
//! `PORT` belongs to a router on this machine; `PROGRAM` is the path of `roomcast-zenoh`.

#![expect(clippy::unwrap_used, reason = "a measurement that cannot be made ends")]

use std::io::{Read, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use roomcast_ipc::raw::{DecisionV1, action};
use roomcast_ipc::{Domain, Publisher, clock, sequence, text};
use roomcast_zenoh::config::Router;
use roomcast_zenoh::link::client;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

const PATIENCE: Duration = Duration::from_secs(5);
const ALONE: &str = "hop/alone";
/// In place of `PROGRAM`: this process sends, with the given number of bytes.
const PUT: &str = "put";

fn open(port: &str) -> Session {
    let router = Router { connect: format!("tcp/127.0.0.1:{port}"), ..Router::default() };
    zenoh::open(client(&router).unwrap()).wait().unwrap()
}

/// Gives the time and the bytes of each message of a key.
fn inlet(session: &Session, key: &str) -> Receiver<(u64, Vec<u8>)> {
    let (to, heard) = channel();
    let take = move |sample: zenoh::sample::Sample| {
        let _ended = to.send((clock::monotonic_ns(), sample.payload().to_bytes().into_owned()));
    };
    session.declare_subscriber(key.to_owned()).callback(take).background().wait().unwrap();
    heard
}

fn percentile(times: &mut [Duration], share: f64) -> Duration {
    times.sort_unstable();
    times[((times.len() - 1) as f64 * share) as usize]
}

/// How long after it was decided the bridge put it.
fn within(message: &[u8]) -> u64 {
    let message: serde_json::Value = serde_json::from_slice(message).unwrap();
    message["age_ns"].as_u64().unwrap()
}

/// Publishes a decision, and says when it began to.
fn send(decisions: &Publisher<DecisionV1>, decision: DecisionV1, number: u64) -> u64 {
    let start_ns = clock::monotonic_ns();
    decisions.send(&DecisionV1 { sequence: number, decided_ns: start_ns, ..decision }).unwrap();
    start_ns
}

/// zenoh alone: for each byte of standard input it puts so many bytes, with the time in the first eight.
fn put(port: &str, bytes: usize) {
    let near = open(port);
    let publisher = near.declare_publisher(ALONE).congestion_control(CongestionControl::Drop).express(true);
    let publisher = publisher.wait().unwrap();
    let mut turn = [0];
    while std::io::stdin().read_exact(&mut turn).is_ok() {
        let mut payload = vec![b'x'; bytes];
        payload[..8].copy_from_slice(&clock::monotonic_ns().to_le_bytes());
        publisher.put(payload).wait().unwrap();
    }
}

fn start_bridge(program: &str, port: &str, folder: &Path, domain: &Domain) -> Child {
    let config = folder.join("zenoh.toml");
    let text = format!(
        "[router]\nconnect = \"tcp/127.0.0.1:{port}\"\n[ipc]\nroot = {:?}\ndomain = \"hop\"\n[tell]\nrepeat_s = 3600.0\n",
        domain.root()
    );
    std::fs::write(&config, text).unwrap();
    let mut bridge = Command::new(program);
    bridge.arg("robot").arg("--config").arg(&config).stderr(Stdio::null()).spawn().unwrap()
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let (port, program) = (arguments.next().unwrap(), arguments.next().unwrap());
    if program == PUT {
        return put(&port, arguments.next().unwrap().parse().unwrap());
    }
    let count = arguments.next().map_or(2000, |count| count.parse::<u64>().unwrap());
    let folder = tempfile::Builder::new().prefix("rch-").tempdir_in("/tmp").unwrap();
    let domain = Domain::new(folder.path().join("d"), "hop").unwrap();
    let mut bridge = start_bridge(&program, &port, folder.path(), &domain);
    let node = domain.open("hop").unwrap();
    let decisions = node.publisher::<DecisionV1>().unwrap();
    let far = open(&port);
    let (through, alone) = (inlet(&far, "roomcast/home/robot/told/decision"), inlet(&far, ALONE));
    let decision = DecisionV1 {
        robot: sequence::source_of_name("robot"),
        epoch: 7,
        action: action::GO,
        to: text::encode("to", "kitchen").unwrap(),
        from: text::encode("from", "hall").unwrap(),
        policy: text::encode("policy", "coverage-aware").unwrap(),
        reason: text::encode_cut("the least time shared with somebody in the slots that are left"),
        ..DecisionV1::default()
    };
    let send = |number| send(&decisions, decision, number);
    // Until the bridge is there.
    let mut number = 0;
    let bytes = loop {
        number += 1;
        decisions.tick().unwrap();
        send(number);
        if let Ok((_, message)) = through.recv_timeout(Duration::from_millis(200)) {
            break message.len();
        }
    };
    // Earlier messages may still be on their way.
    std::thread::sleep(Duration::from_millis(500));
    while through.try_recv().is_ok() {}
    let mut putter = Command::new(std::env::current_exe().unwrap());
    putter.args([&port, PUT, &bytes.to_string()]).stdin(Stdio::piped());
    let mut putter = putter.spawn().unwrap();
    let mut turns = putter.stdin.take().unwrap();
    while alone.recv_timeout(Duration::from_millis(200)).is_err() {
        turns.write_all(&[0]).unwrap();
    }
    // The same.
    std::thread::sleep(Duration::from_millis(500));
    while alone.try_recv().is_ok() {}
    let (mut hop, mut bare, mut inside) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..count {
        number += 1;
        let start_ns = send(number);
        let (heard_ns, message) = through.recv_timeout(PATIENCE).unwrap();
        hop.push(Duration::from_nanos(heard_ns - start_ns));
        inside.push(Duration::from_nanos(within(&message)));
        std::thread::sleep(Duration::from_millis(1));
        turns.write_all(&[0]).unwrap();
        let (heard_ns, message) = alone.recv_timeout(PATIENCE).unwrap();
        let start_ns = u64::from_le_bytes(message[..8].try_into().unwrap());
        bare.push(Duration::from_nanos(heard_ns - start_ns));
        std::thread::sleep(Duration::from_millis(1));
    }
    drop(turns);
    let _ended = putter.wait();
    let _ended = bridge.kill();
    let _waited = bridge.wait();
    let whole = [("through the bridge", &mut hop), ("of it, until put", &mut inside), ("zenoh alone", &mut bare)];
    for (what, times) in whole {
        let [p50, p99] = [0.5, 0.99].map(|share| percentile(times, share));
        println!("{what:<20} {bytes} bytes  n {count}  p50 {p50:?}  p99 {p99:?}");
    }
    let ratio =
        |share| percentile(&mut hop.clone(), share).as_secs_f64() / percentile(&mut bare.clone(), share).as_secs_f64();
    println!("ratio                p50 {:.2}  p99 {:.2}", ratio(0.5), ratio(0.99));
}
