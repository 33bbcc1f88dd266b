//! Damaged messages, files and lines, given to every reader. No reader panics, accepted messages keep the contract, and a spool repeats no number.
//!
//! `PROPTEST_CASES=20000` sets the number of cases of each kind. proptest prints a failing case.

use std::fs;
use std::path::Path;

use proptest::prelude::*;
use roomcast_ipc::raw::{Message, NAME_BYTES};
use roomcast_ros2::types::{Text, decode_string, encode};
use roomcast_zenoh::config::Config;
use roomcast_zenoh::delivery::Delivery;
use roomcast_zenoh::line::line;
use roomcast_zenoh::relay::{Offered, Relay};
use roomcast_zenoh::spool::{self, Kept, Place, Spool, SpoolError};
use roomcast_zenoh::told::Teller;
use roomcast_zenoh::wire::{Arrived, BYTES_MAX, Confirmed, Hex, Kind, Narrated, Observation, Who, read};

use crate::eventually::eventually;

/// A process that another test starts inherits the lock of an open spool, for a moment.
fn open(folder: &Path) -> Spool {
    eventually("the spool is free", || match Spool::open(folder, 64) {
        Err(SpoolError::Locked { .. }) => None,
        opened => Some(opened.unwrap()),
    })
}

/// One change of some bytes: its place as a part of their length, its kind, its byte.
type Damage = (f64, u8, u8);

fn damage() -> impl Strategy<Value = Vec<Damage>> {
    proptest::collection::vec((0.0..1.0, 0..5_u8, any::<u8>()), 0..6)
}

/// Applies the changes: a byte is replaced, a digit repeated, bytes removed or doubled, or the rest cut off.
fn damaged(good: &[u8], damage: &[Damage]) -> Vec<u8> {
    let mut bytes = good.to_vec();
    for (place, what, with) in damage {
        if bytes.is_empty() {
            break;
        }
        let at = (place * bytes.len() as f64) as usize;
        let end = (at + usize::from(*with) % 32).min(bytes.len());
        match what {
            0 => bytes[at] = *with,
            1 => drop(bytes.splice(at..at, [b'0' + with % 10; 24])),
            2 => drop(bytes.drain(at..end)),
            3 => {
                let again = bytes[at..end].to_vec();
                bytes.splice(at..at, again);
            }
            _ => bytes.truncate(at),
        }
    }
    bytes
}

fn observation(kind: u8) -> Observation {
    let (kind, text) = match kind % 4 {
        0 => (Kind::Sentence, "They open the fridge."),
        1 => (Kind::Action, "[Grab] <mug> (1)"),
        2 => (Kind::Device, "the oven is on"),
        _ => (Kind::Presence, "present in the kitchen"),
    };
    Observation { text: text.to_owned(), kind, person: Who::Name("Ada".to_owned()), count: 0 }
}

proptest! {
    #[test]
    fn counts_of_habits_are_refused_or_can_be(room in ".{0,60}", count in any::<f64>(), damage in damage()) {
        let good = roomcast_zenoh::told::habits(&[(room, [count, 1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 7.25])]);
        let bytes = damaged(&good.bytes(Teller { start: 1, number: 2, clock: 3, started_ns: 0 }), &damage);
        for (room, counts) in roomcast_zenoh::habits::read(&bytes).unwrap_or_default() {
            prop_assert!(!room.is_empty() && room.len() <= NAME_BYTES && !room.chars().any(char::is_control));
            prop_assert!(counts.iter().all(|count| count.is_finite() && *count >= 0.0));
        }
    }

    /// An accepted message is valid for the daemon, and its number is accepted once.
    #[test]
    fn a_damaged_narration_is_refused_or_is_one(kind in any::<u8>(), sequence in 1..u64::MAX, changes in damage()) {
        let narrated = Narrated {
            epoch: Hex(7),
            sequence,
            first: 1,
            age_ns: 5,
            ahead_ns: 7,
            sent_ns: 9,
            clock: Hex(3),
            observation: observation(kind),
        };
        let bytes = damaged(&serde_json::to_vec(&narrated).unwrap(), &changes);
        let Ok(heard) = read::<Narrated>(&bytes) else { return Ok(()) };
        let arrived = Arrived { now_ns: 1 << 40, now_unix_ns: 1 << 60, excess_ns: u64::MAX };
        let message = heard.message("hub", arrived);
        if let Ok(message) = &message {
            message.check().unwrap();
            prop_assert!(message.observed_ns <= arrived.now_ns);
        }
        let mut relay = Relay::new("hub", 100.0);
        let Narrated { epoch, sequence, first, .. } = heard;
        let offered = relay.offer(epoch.0, sequence, first, message.clone().ok());
        if offered == Offered::Taken {
            prop_assert_ne!(relay.offer(epoch.0, sequence, first, message.ok()), Offered::Taken);
        }
        let _sent = relay.send(1);
        prop_assert!(relay.confirmed().confirmed <= sequence);
    }

    /// A robot cannot confirm more than it was sent.
    #[test]
    fn a_damaged_confirmation_confirms_nothing_that_is_not_there(next in any::<u64>(), confirmed in any::<u64>(), changes in damage()) {
        let said = Confirmed { epoch: Hex(7), next, confirmed, refused: 0 };
        let bytes = damaged(&serde_json::to_vec(&said).unwrap(), &changes);
        let Ok(heard) = read::<Confirmed>(&bytes) else { return Ok(()) };
        let mut delivery = Delivery::from(1, 40, 0);
        delivery.hear(heard, 7, 40, 1);
        delivery.give_up_before(3);
        prop_assert!(delivery.confirmed() <= 40 && delivery.lost() <= 2);
        let next = delivery.next(40, 2);
        prop_assert!(next.is_none_or(|next| (1..=40).contains(&next)));
    }

    /// A ROS 2 text with a line of narration.
    #[test]
    fn a_damaged_text_is_refused_or_is_a_line(text in "(\\{\"text\":\"[a-z. ]{0,40}\",\"observed_unix_s\":1e[0-9]{1,3}\\}|\\[[A-Z][a-z]{1,8}\\] <mug> \\(1\\)|.{0,60})", changes in damage()) {
        let bytes = damaged(&encode(&Text { data: text }).unwrap(), &changes);
        let Ok(text) = decode_string(&bytes) else { return Ok(()) };
        prop_assert!(text.len() <= bytes.len());
        if let Ok((observation, age)) = line(&text, 1 << 60) {
            observation.message().unwrap();
            prop_assert!(age.age_ns <= 1 << 60);
        }
    }

    #[test]
    fn what_is_too_long_is_refused(more in 1..BYTES_MAX) {
        let bytes = vec![b' '; BYTES_MAX + more];
        read::<Confirmed>(&bytes).unwrap_err();
    }

    #[test]
    fn a_damaged_configuration_is_refused_or_checked(changes in damage()) {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("zenoh.toml");
        fs::write(&file, damaged(include_bytes!("../../src/default.toml"), &changes)).unwrap();
        if let Ok(config) = Config::load(&file) {
            let _checked = (config.check_hub(), config.check_robot(), config.check_watch());
            let _domain = config.domain();
        }
    }

    /// A spool that was damaged while closed continues with unused numbers, or in a new epoch.
    #[test]
    fn a_damaged_spool_gives_no_number_twice(count in 1..20_u64, confirmed in 0..20_u64, changes in damage()) {
        let folder = tempfile::tempdir().unwrap();
        let (file, before) = {
            let mut spool = open(folder.path());
            for number in 0..count {
                let place = spool.input().unwrap();
                let place = Place { at: place.at + 10, ..place };
                spool.append(vec![Kept::new(observation(number as u8), 7, Some(place))]).unwrap();
            }
            spool.confirm(confirmed.min(count)).unwrap();
            // All is in one file.
            let file = folder.path().join(spool::FILE);
            let database = roomcast_database::Connection::open(&file).unwrap();
            database.execute_batch("VACUUM; PRAGMA wal_checkpoint(TRUNCATE)").unwrap();
            (file, (spool.epoch(), spool.last()))
        };
        let good = fs::read(&file).unwrap();
        let bad = damaged(&good, &changes);
        fs::write(&file, &bad).unwrap();
        let mut spool = open(folder.path());
        let opened = (spool.epoch(), spool.first(), spool.last());
        prop_assert!(opened.0 != 0 && opened.1 >= 1 && opened.2 + 1 >= opened.1);
        if bad == good {
            prop_assert_eq!((opened.0, opened.2), before);
        }
        for number in opened.1..=opened.2 {
            let kept = spool.get(number).unwrap();
            prop_assert_eq!(kept.sequence, number);
            // A damaged entry is never narrated.
            prop_assert_eq!(&kept.observation, &observation((number - 1) as u8));
        }
        spool.append(vec![Kept::new(observation(0), 0, spool.input())]).unwrap();
        prop_assert_eq!(spool.last(), opened.2 + 1);
        drop(spool);
        let again = open(folder.path());
        prop_assert_eq!((again.epoch(), again.last()), (opened.0, opened.2 + 1), "what was kept since is whole");
    }
}
