//! `roomcast replay`: sends a recording back onto the services, bit for bit, at any speed.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use roomcast_ipc::raw::{MAX_SOURCES, NarrationV1, RoomScoresV1};
use roomcast_ipc::{Domain, IpcError};

use super::flow::Publishers;
use super::{CommandResult, Failure, ranges, record, service};
use roomcast_services::recording::Recorded;
use roomcast_services::stop::Stop;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// A recording of `roomcast record`.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Speed: this many times faster than recorded.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = ranges::positive)]
    speed: f64,
    /// Replay scores, forecasts, decisions and robots' reports too. The domain must have no daemon, planner, robot and bridge, which would act on
    /// them. Without this option only the narration is replayed, and a daemon that does not have it yet scores it again.
    #[arg(long)]
    all: bool,
    /// Seconds to wait at the end until a daemon has taken in the last narration.
    #[arg(long, value_name = "SECONDS", default_value_t = 10, value_parser = ranges::any())]
    linger: u64,
}

/// The shortest time between two messages, which a daemon's buffer can take at any speed.
const PAUSE_MIN: Duration = Duration::from_millis(2);
/// Period of sending missed messages to late subscribers.
const TICK: Duration = Duration::from_millis(100);

pub fn run(args: &Args) -> CommandResult {
    let stop = service::stop()?;
    let (_, domain) = args.service.load()?;
    let messages = record::read_until(&args.file, &|| stop.requested())?.messages;
    let node = domain.open("roomcast-replay")?;
    if args.all {
        refuse_running_system(&node.participants()?, &domain)?;
    }
    let publishers = Publishers::open(&node, args.all)?;
    let heard = (!args.all).then(|| node.subscriber::<RoomScoresV1>()).transpose()?;
    let mut newest = None;
    if let Some(heard) = &heard {
        heard.wait(TICK)?;
        newest = heard.newest()?;
    }
    let known = newest.as_ref().and_then(|scores| known_words(scores, &messages));
    let start_unix_ns = messages.first().map_or(0, |(time, _)| *time);
    let started = Instant::now();
    let mut sent = 0_u64;
    let mut last = None;
    for (time, message) in &messages {
        let due = Duration::from_nanos((time.saturating_sub(start_unix_ns) as f64 / args.speed) as u64);
        sleep_until(started, due, &publishers, &stop)?;
        if stop.requested() {
            break;
        }
        if publishers.send(message)? {
            sent += 1;
            std::thread::sleep(PAUSE_MIN);
        }
        if let Recorded::Narration(message) = message {
            last = Some((message.source, message.epoch, message.sequence));
        }
    }
    let (of, seconds) = (messages.len(), started.elapsed().as_secs_f64());
    let others =
        if args.all { "" } else { "; the others are scores, forecasts, decisions and reports, which --all replays" };
    super::tell(format_args!("{sent} of {of} messages replayed in {seconds:.1} s{others}"));
    if stop.requested() {
        return Err(service::interrupted(&format!("{sent} of {of} messages were replayed")));
    }
    if let Some(known) = known {
        super::tell(format_args!("{known}"));
    }
    let (Some(heard), Some(last)) = (heard, last) else { return Ok(()) };
    // Waiting messages are lost with their publisher, so this one lives until the daemon has them.
    let (begun, linger) = (Instant::now(), Duration::from_secs(args.linger));
    while !stop.requested() {
        publishers.tick()?;
        heard.wait(TICK)?;
        newest = heard.newest()?.or(newest);
        let mut included = newest.iter().flat_map(RoomScoresV1::included);
        if included.any(|i| (i.source, i.epoch) == (last.0, last.1) && i.sequence >= last.2) {
            // A recorder with slow polls gets the last messages too.
            std::thread::sleep(TICK);
            return Ok(());
        }
        // Without a wait, it still checks once.
        if begun.elapsed() >= linger {
            break;
        }
    }
    if stop.requested() {
        return Err(service::interrupted(&format!(
            "{sent} of {of} messages were replayed, and nothing has confirmed the last one"
        )));
    }
    let place = service::shown(&domain);
    Err(Failure::ipc(match newest {
        None => format!("no daemon was heard in {place}: start `roomcast daemon`, then replay again"),
        Some(_) => format!(
            "the daemon in {place} had not taken in the last narration {} s after it was sent: give it longer (--linger SECONDS)",
            args.linger
        ),
    }))
}

/// Participants that would act on replayed messages, by the beginning of their names: a robot would drive, and a daemon's scores would mix with the
/// recorded ones.
const MISLED: [(&str, &str); 6] = [
    ("roomcast-daemon", "a daemon"),
    ("roomcast-planner", "a planner"),
    ("roomcast-robot", "a robot's driver"),
    ("roomcast-publish", "a bridge over MQTT"),
    ("roomcast-zenoh", "a bridge to others"),
    ("roomcast-ros2", "a bridge to ROS 2"),
];

fn refuse_running_system(participants: &[String], domain: &Domain) -> CommandResult {
    let misled =
        MISLED.into_iter().find_map(|(name, who)| Some((who, participants.iter().find(|own| own.starts_with(name))?)));
    let Some((who, name)) = misled else { return Ok(()) };
    let text = format!(
        "{who} ({name:?}) runs in {}, and would take what is replayed for what is so: end it, or replay in a domain of its own (--domain NAME)",
        service::shown(domain)
    );
    Err(Failure::ipc(text))
}

/// How many narrations the daemon has taken in already, in words, by its newest scores.
fn known_words(scores: &RoomScoresV1, messages: &[(u64, Recorded)]) -> Option<String> {
    let contained = |message: &NarrationV1| {
        let newest = scores.included().iter().find(|i| (i.source, i.epoch) == (message.source, message.epoch));
        newest.is_some_and(|newest| newest.sequence >= message.sequence)
    };
    let narrations = messages.iter().filter(|(_, message)| match message {
        Recorded::Narration(message) => contained(message),
        _ => false,
    });
    // With more sources, the scores name only the newest.
    let names_all = scores.included().len() < MAX_SOURCES;
    let how_many = match (narrations.count(), names_all) {
        (0, true) => return None,
        (0, false) => "may have taken in some".to_owned(),
        (known, true) => format!("has taken in {known}"),
        (known, false) => format!("has taken in at least {known}"),
    };
    Some(format!("the daemon {how_many} of them before and takes none twice; a fresh one would score them"))
}

fn sleep_until(started: Instant, due: Duration, publishers: &Publishers, stop: &Stop) -> Result<(), IpcError> {
    while let Some(left) = due.checked_sub(started.elapsed()).filter(|left| !left.is_zero()) {
        if stop.requested() {
            break;
        }
        std::thread::sleep(left.min(TICK));
        publishers.tick()?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_ipc::raw::IncludedV1;
    use roomcast_services::participant::{DRIVER, PLANNER};

    #[test]
    fn everything_is_replayed_beside_those_alone_who_do_nothing_by_it() {
        let domain = Domain::new("/tmp/roomcast-x", "x").unwrap();
        let refused = |names: &[&str]| {
            let names: Vec<_> = names.iter().map(|name| (*name).to_owned()).collect();
            refuse_running_system(&names, &domain).err().map(|failure| failure.to_string())
        };
        let watching = ["roomcast-metrics", "roomcast-record", "roomcast-replay", "roomcast-top", "roomcast-view"];
        assert_eq!(refused(&watching), None);
        let (planner, driver) = (PLANNER.name("mop 2"), DRIVER.name("mop 2"));
        let acting = [
            "roomcast-publish",
            "roomcast-daemon",
            &planner,
            "roomcast-robot",
            &driver,
            "roomcast-ros2",
            "roomcast-zenoh",
        ];
        for name in acting {
            let said = refused(&["roomcast-top", name]).unwrap();
            assert!(said.contains(name) && said.contains("end it, or replay in a domain of its own"), "{said}");
        }
    }

    /// Nineteen narrators sent one sentence each, but scores have places for sixteen.
    #[test]
    fn what_was_taken_in_before_is_not_counted_short() {
        let narration = |source| {
            Recorded::Narration(Box::new(NarrationV1 { source, epoch: 1, sequence: 1, ..NarrationV1::default() }))
        };
        let messages: Vec<(u64, Recorded)> = (1..=19).map(|source| (source, narration(source))).collect();
        let told = |sources: std::ops::RangeInclusive<u64>| {
            let mut scores = RoomScoresV1::default();
            for (place, source) in scores.included.iter_mut().zip(sources) {
                *place = IncludedV1 { source, epoch: 1, sequence: 1, ..IncludedV1::default() };
                scores.source_count += 1;
            }
            known_words(&scores, &messages)
        };
        assert_eq!(told(20..=21), None);
        assert!(told(1..=3).unwrap().contains("has taken in 3 of them"));
        assert!(told(4..=19).unwrap().contains("has taken in at least 16 of them"));
        assert!(told(20..=40).unwrap().contains("may have taken in some of them"));
    }
}
