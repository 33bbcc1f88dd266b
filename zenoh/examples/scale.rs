//! Many robots' bridges at their real rates, in one process, against one router: their messages, bytes, memory and processor time.
//!
//! ```text
//! cargo run --release --manifest-path zenoh/Cargo.toml --example scale -- PORT ROUTER_PID ROBOTS SECONDS
//! ```
//!
//! Each robot has a session and sends the messages of a home with eight rooms and two persons: a status every second, scores, forecast and
//! persons every five seconds, a decision a minute. One operator hears everything.

#![expect(clippy::unwrap_used, reason = "a measurement that cannot be made ends")]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use roomcast_ipc::raw::{DecisionV1, ForecastV1, PersonForecastsV1, RoomScoresV1, StatusResponseV1};
use roomcast_ipc::text;
use roomcast_zenoh::config::Router;
use roomcast_zenoh::keys::Keys;
use roomcast_zenoh::link::client;
use roomcast_zenoh::told::{self, Teller, Told};
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

const ROOMS: u32 = 8;

fn open(port: &str) -> Session {
    let router = Router { connect: format!("tcp/127.0.0.1:{port}"), ..Router::default() };
    zenoh::open(client(&router).unwrap()).wait().unwrap()
}

/// The messages of a robot, and their number per minute.
fn said() -> Vec<(&'static str, u64, Told)> {
    let ids = (0..ROOMS as usize).map(|room| text::encode("id", &format!("room number {room}")).unwrap());
    let ids: Vec<_> = ids.collect();
    let mut scores = RoomScoresV1 { epoch: 1, sequence: 1, room_count: ROOMS, persons: 2, ..Default::default() };
    let mut forecast = ForecastV1 { epoch: 1, sequence: 1, room_count: ROOMS, horizon_count: 12, ..Default::default() };
    let mut persons = PersonForecastsV1 { room_count: ROOMS, horizon_count: 12, person_count: 2, ..Default::default() };
    for (room, id) in ids.iter().enumerate() {
        (scores.room[room].id, forecast.id[room], persons.id[room]) = (*id, *id, *id);
        (scores.room[room].probability, scores.room[room].log_score_nats) = (0.123_456_789, -2.091_857_3);
        forecast.probability[room] = [0.123_456; 16];
        persons.person.iter_mut().for_each(|person| person.probability[room] = [0.123_456; 16]);
    }
    persons.person.iter_mut().for_each(|person| person.set_coverage = 0.9);
    vec![
        ("status", 60, told::status("robot", Some(1), Some(&StatusResponseV1::default()))),
        ("scores", 12, told::scores(&scores)),
        ("forecast", 12, told::forecast(&forecast)),
        ("persons", 12, told::persons(&persons)),
        ("decision", 1, told::decision(&DecisionV1::default())),
    ]
}

/// Seconds of processor and bytes of memory of a process.
fn used(process: &str) -> (f64, u64) {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    let ticks = |place: usize| fields[place].parse::<u64>().unwrap();
    let status = std::fs::read_to_string(format!("/proc/{process}/statm")).unwrap();
    let pages: u64 = status.split_whitespace().nth(1).unwrap().parse().unwrap();
    // utime and stime, in hundredths of a second.
    ((ticks(11) + ticks(12)) as f64 / 100.0, pages * 4096)
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let mut next = || arguments.next().unwrap();
    let (port, router) = (next(), next());
    let (robots, seconds): (u64, u64) = (next().parse().unwrap(), next().parse().unwrap());
    let idle = used(&router);
    let operator = open(&port);
    let (messages, bytes) = (Arc::<AtomicU64>::default(), Arc::<AtomicU64>::default());
    let (count, size) = (Arc::clone(&messages), Arc::clone(&bytes));
    let hear = move |sample: zenoh::sample::Sample| {
        count.fetch_add(1, Ordering::Relaxed);
        size.fetch_add(sample.payload().len() as u64, Ordering::Relaxed);
    };
    operator.declare_subscriber("roomcast/scale/*/told/**").callback(hear).background().wait().unwrap();
    let opened = Instant::now();
    let said = said();
    let sessions: Vec<_> = (0..robots)
        .map(|robot| {
            let session = open(&port);
            let keys = Keys::new("scale", &format!("robot-{robot}"));
            let token = session.liveliness().declare_token(keys.alive()).wait().unwrap();
            let publishers: Vec<_> = said
                .iter()
                .map(|(topic, ..)| {
                    let publisher = session.declare_publisher(keys.told(topic));
                    publisher.congestion_control(CongestionControl::Drop).express(true).wait().unwrap()
                })
                .collect();
            (session, token, publishers)
        })
        .collect();
    println!("{robots} sessions in {:.1} s", opened.elapsed().as_secs_f64());
    // A publisher that has not heard of the operator yet says nothing.
    std::thread::sleep(Duration::from_secs(5));
    let (before, own) = (used(&router), used("self"));
    let (start, mut put, mut put_bytes) = (Instant::now(), 0_u64, 0_u64);
    // Spread over each second as robots are that know nothing of one another.
    let step = Duration::from_secs_f64(1.0 / robots as f64);
    for turn in 0..robots * seconds {
        let (robot, second) = (turn % robots, turn / robots);
        if let Some(wait) = (start + step * u32::try_from(turn).unwrap()).checked_duration_since(Instant::now()) {
            std::thread::sleep(wait);
        }
        for (publisher, (_, a_minute, told)) in sessions[robot as usize].2.iter().zip(&said) {
            if (second + robot) % (60 / a_minute) == 0 {
                let payload = told.bytes(Teller { start: robot, number: second, clock: 1, started_ns: 0 });
                (put, put_bytes) = (put + 1, put_bytes + payload.len() as u64);
                publisher.put(payload).wait().unwrap();
            }
        }
    }
    let took = start.elapsed().as_secs_f64();
    // The last messages are on their way.
    std::thread::sleep(Duration::from_millis(500));
    let (after, own_after) = (used(&router), used("self"));
    let heard = messages.load(Ordering::Relaxed);
    println!(
        "{:.0} messages/s, {:.0} kB/s put; heard {heard} of {put}",
        put as f64 / took,
        put_bytes as f64 / took / 1e3
    );
    let of_core = |before: f64, after: f64| 100.0 * (after - before) / took;
    println!(
        "router: {:.1} % of a core, {:.0} MB ({:.0} MB before)",
        of_core(before.0, after.0),
        after.1 as f64 / 1e6,
        idle.1 as f64 / 1e6
    );
    println!("robots and operator: {:.1} % of a core, {:.0} MB", of_core(own.0, own_after.0), own_after.1 as f64 / 1e6);
}
