//! What one hop costs: a decision from shared memory through the bridge and a router, beside the same bytes put and received by zenoh alone, in
//! turns on the same machine.
//!
//! ```text
//! cargo run --release --manifest-path bridge/Cargo.toml --example hop -- PORT PROGRAM [N]
//! ```
//!
//! `PORT` is that of a router on this machine, `PROGRAM` is `roomcast-bridge`.

#![expect(clippy::unwrap_used, reason = "a measurement that cannot be made ends")]

use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use roomcast_bridge::config::Router;
use roomcast_bridge::link::client;
use roomcast_ipc::{DecisionV1, Domain, Publisher, action, clock, sequence, text};
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

const PATIENCE: Duration = Duration::from_secs(5);

fn open(port: &str) -> Session {
    let router = Router { connect: format!("tcp/127.0.0.1:{port}"), ..Router::default() };
    zenoh::open(client(&router).unwrap()).wait().unwrap()
}

/// Gives the time and the length of each message of a key.
fn ear(session: &Session, key: &str) -> Receiver<(Instant, usize)> {
    let (to, heard) = channel();
    let take = move |sample: zenoh::sample::Sample| {
        let _ended = to.send((Instant::now(), sample.payload().len()));
    };
    session.declare_subscriber(key.to_owned()).callback(take).background().wait().unwrap();
    heard
}

fn percentile(times: &mut [Duration], share: f64) -> Duration {
    times.sort_unstable();
    times[((times.len() - 1) as f64 * share) as usize]
}

/// Publishes a decision, and says when it began to.
fn send(decisions: &Publisher<DecisionV1>, decision: DecisionV1, number: u64) -> Instant {
    let start = Instant::now();
    decisions.send(&DecisionV1 { sequence: number, decided_ns: clock::monotonic_ns(), ..decision }).unwrap();
    start
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let (port, program) = (arguments.next().unwrap(), arguments.next().unwrap());
    let count = arguments.next().map_or(2000, |count| count.parse::<u64>().unwrap());
    let folder = tempfile::Builder::new().prefix("rch-").tempdir_in("/tmp").unwrap();
    let domain = Domain::new(folder.path().join("d"), "hop").unwrap();
    let config = folder.path().join("bridge.toml");
    let text = format!(
        "[router]\nconnect = \"tcp/127.0.0.1:{port}\"\n[ipc]\nroot = {:?}\ndomain = \"hop\"\n[tell]\nrepeat_s = 3600.0\n",
        domain.root()
    );
    std::fs::write(&config, text).unwrap();
    let mut bridge = Command::new(program);
    bridge.arg("robot").arg("--config").arg(&config).stderr(Stdio::null());
    let mut bridge = bridge.spawn().unwrap();
    let node = domain.open("hop").unwrap();
    let decisions = node.publisher::<DecisionV1>().unwrap();
    let (near, far) = (open(&port), open(&port));
    let through = ear(&far, "roomcast/home/robot/told/decision");
    let alone = ear(&far, "hop/alone");
    let put = near.declare_publisher("hop/alone").congestion_control(CongestionControl::Drop).express(true);
    let put = put.wait().unwrap();
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
        if let Ok((_, bytes)) = through.recv_timeout(Duration::from_millis(200)) {
            break bytes;
        }
    };
    std::thread::sleep(Duration::from_millis(500));
    while through.try_recv().is_ok() {}
    let payload = vec![b'x'; bytes];
    let (mut hop, mut bare) = (Vec::new(), Vec::new());
    for _ in 0..count {
        number += 1;
        let start = send(number);
        hop.push(through.recv_timeout(PATIENCE).unwrap().0 - start);
        std::thread::sleep(Duration::from_millis(1));
        let start = Instant::now();
        put.put(payload.clone()).wait().unwrap();
        bare.push(alone.recv_timeout(PATIENCE).unwrap().0 - start);
        std::thread::sleep(Duration::from_millis(1));
    }
    let _ended = bridge.kill();
    let _waited = bridge.wait();
    for (what, times) in [("through the bridge", &mut hop), ("zenoh alone", &mut bare)] {
        let [p50, p99] = [0.5, 0.99].map(|share| percentile(times, share));
        println!("{what:<20} {bytes} bytes  n {count}  p50 {p50:?}  p99 {p99:?}");
    }
    let ratio =
        |share| percentile(&mut hop.clone(), share).as_secs_f64() / percentile(&mut bare.clone(), share).as_secs_f64();
    println!("ratio                p50 {:.2}  p99 {:.2}", ratio(0.5), ratio(0.99));
}
