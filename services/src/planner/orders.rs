//! The state that outlives a reboot: orders of persons, and the last cleaning of each room.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::rules::{Hold, RoomSet};

/// Most rooms of each list, with rooms of several maps.
const ROOMS_MAX: usize = 256;

/// Orders and cleanings. Rooms are ids, times are seconds since 1970.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Orders {
    /// The robot does not work.
    pub hold: Option<Hold>,
    /// Rooms that a person asked for, and the end of each order.
    pub asked: BTreeMap<String, u64>,
    /// Rooms that a person skips, and the end of each order.
    pub skipped: BTreeMap<String, u64>,
    /// The last cleaning of each room.
    pub cleaned: BTreeMap<String, u64>,
    /// Reporters by their epoch, and the newest order of each: a port repeats its last reports for a planner that joins.
    pub taken: Vec<(u64, u64)>,
}

impl Orders {
    pub(super) fn expire(&mut self, unix_s: u64) -> bool {
        let before = (self.hold.is_some(), self.asked.len(), self.skipped.len());
        self.hold.take_if(|hold| hold.until_unix_s.is_some_and(|until_s| until_s <= unix_s));
        for rooms in [&mut self.asked, &mut self.skipped] {
            rooms.retain(|_, until_s| *until_s > unix_s);
        }
        before != (self.hold.is_some(), self.asked.len(), self.skipped.len())
    }

    pub(super) fn clean(&mut self, room: &str, unix_s: u64) {
        self.asked.remove(room);
        if room.is_empty() || self.cleaned.len() >= ROOMS_MAX && !self.cleaned.contains_key(room) {
            return;
        }
        // A fast clock may have written a later time.
        self.cleaned.insert(room.to_owned(), unix_s);
    }

    pub(super) fn ask(&mut self, room: &str, until_unix_s: u64) {
        self.skipped.remove(room);
        self.asked.insert(room.to_owned(), until_unix_s);
    }

    pub(super) fn skip(&mut self, room: &str, until_unix_s: u64) {
        self.asked.remove(room);
        self.skipped.insert(room.to_owned(), until_unix_s);
    }
}

pub(super) fn set_of<'a>(rooms: &BTreeMap<String, u64>, ids: impl Iterator<Item = &'a str>) -> RoomSet {
    let set = ids.take(64).enumerate().filter(|(_, id)| rooms.contains_key(*id));
    set.fold(0, |set, (room, _)| set | 1 << room)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn orders() -> Orders {
        let mut orders =
            Orders { hold: Some(Hold { why: "meeting".to_owned(), until_unix_s: Some(100) }), ..Orders::default() };
        orders.ask("kitchen", 200);
        orders.skip("hall", 300);
        orders.clean("office", 50);
        orders
    }

    #[test]
    fn orders_end_at_their_times() {
        let mut orders = orders();
        assert!(!orders.expire(99) && orders.hold.is_some());
        assert!(orders.expire(100) && orders.hold.is_none());
        assert!(orders.expire(200) && orders.asked.is_empty() && !orders.skipped.is_empty());
        assert!(orders.expire(300) && orders.skipped.is_empty());
        orders.hold = Some(Hold { why: String::new(), until_unix_s: None });
        assert!(!orders.expire(u64::MAX), "a hold without an end ends by a person");
    }

    #[test]
    fn a_cleaned_room_is_not_asked_for_any_more() {
        let mut orders = orders();
        orders.clean("kitchen", 60);
        orders.clean("kitchen", 40);
        assert!(orders.asked.is_empty() && orders.cleaned["kitchen"] == 40, "a clock that ran ahead is corrected");
        orders.ask("hall", 200);
        assert!(orders.skipped.is_empty(), "the newest order counts");
        (0..1000).for_each(|room| orders.clean(&format!("room-{room}"), 1));
        assert_eq!(orders.cleaned.len(), ROOMS_MAX);
    }
}
