//! The round across a restart, and the orders across a reboot: a small database in the state directory.
//!
//! The round is written after each decision and after reports. If a planner is killed before it writes, its successor gets the reports again from a living
//! reporter: the service keeps each reporter's last 8. Reports of work and dock that the stored round contains are recognised by number and skipped.

use std::path::Path;

use roomcast_core::ids::BootNs;
use roomcast_database::Schema;
use serde::{Deserialize, Serialize};

use super::orders::Orders;
use super::robot::{REST_NS, Work};
use super::{Planner, Step};
use crate::clock;
use crate::kept::Kept;

const SCHEMA: Schema = Schema {
    application: 0x524d_4350,
    migrations: &["-- The fields of the values, as JSON.
        CREATE TABLE round (field TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID, STRICT;
        CREATE TABLE orders (field TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID, STRICT;"],
};
/// How often the round records that a charging robot was heard.
const MINUTE_NS: u64 = 60_000_000_000;

/// The stored round of a planner. Times are monotonic nanoseconds of one boot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeptRound {
    /// The boot of the times.
    boot: String,
    /// Fingerprint of the rooms' map, in hexadecimal.
    map: String,
    began_ns: Option<BootNs>,
    /// Due time of the previous round.
    due_ns: Option<BootNs>,
    done: Vec<String>,
    /// Rooms that the robot could not do, with the time of the failure, and the failures in a row.
    failed: Vec<(String, BootNs, u32)>,
    /// Rooms that were left to a person.
    held: Vec<String>,
    room: Option<String>,
    work: Option<KeptWork>,
    reports_work: bool,
    battery: Option<f64>,
    charges: bool,
    /// The minute in which a charging robot was last heard.
    heard_ns: Option<BootNs>,
    /// Per epoch of a reporter, the newest report of work or dock in this round.
    told: Vec<(u64, u64)>,
    /// Failures in a row before the robot began, and the end of its pause.
    trouble: (u32, BootNs),
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct KeptWork {
    room: String,
    decisions: Vec<(u64, u64)>,
    began_ns: BootNs,
    ends_ns: BootNs,
    waits: bool,
    started: bool,
    /// The room was probably empty when work began, or its persons left since: a person there came later.
    alone: bool,
}

impl Planner {
    /// The round to store; `None` before the first scores.
    #[must_use]
    pub fn kept(&self, boot: &str) -> Option<KeptRound> {
        let scores = self.scores.as_ref()?;
        let (robot, id) = (&self.robot, |room: usize| self.id_of(room).to_owned());
        let done = self.round.covered().iter().enumerate().filter(|(_, done)| **done);
        let held = self.interruption.held().iter().enumerate().filter(|(_, held)| **held);
        Some(KeptRound {
            boot: boot.to_owned(),
            map: hex::encode(scores.map_fingerprint),
            began_ns: self.round.began_ns,
            due_ns: self.round.due_ns,
            done: done.map(|(room, _)| id(room)).collect(),
            failed: self.round.failed().map(|(room, failed_ns, failures)| (id(room), failed_ns, failures)).collect(),
            held: held.map(|(room, _)| id(room)).collect(),
            room: robot.room.map(id),
            // A robot with a decision at every score has no work that outlasts the planner.
            work: robot.work.clone().filter(|_| self.round.stay_ns > 0).map(|work| {
                let Work { room, decisions, began_ns, ends_ns, waits, started } = work;
                let alone = self.interruption.is_alone(room);
                KeptWork { room: id(room), decisions, began_ns, ends_ns, waits, started, alone }
            }),
            reports_work: robot.reports_work,
            battery: robot.battery,
            charges: robot.charges,
            heard_ns: robot.heard_ns.filter(|_| robot.charges).map(|at_ns| BootNs(at_ns.0 - at_ns.0 % MINUTE_NS)),
            told: robot.told.clone(),
            trouble: robot.trouble(),
        })
    }

    /// Restores a stored round if the scores have the same map.
    pub(super) fn restore(&mut self, kept: &KeptRound) {
        let Some(scores) = self.scores.filter(|scores| hex::encode(scores.map_fingerprint) == kept.map) else { return };
        let room = |id: &str| scores.rooms().iter().position(|room| room.id() == id);
        for done in kept.done.iter().filter_map(|id| room(id)) {
            self.round.cover(done);
        }
        for (failed, failed_ns, failures) in &kept.failed {
            room(failed).into_iter().for_each(|room| self.round.restore_failed(room, *failed_ns, *failures));
        }
        kept.held.iter().filter_map(|id| room(id)).for_each(|room| self.interruption.hold(room));
        (self.round.began_ns, self.round.due_ns) = (kept.began_ns, kept.due_ns);
        let robot = &mut self.robot;
        robot.room = kept.room.as_deref().and_then(room);
        // A waiting robot gets its decision again: it must not work there.
        robot.work = kept.work.as_ref().filter(|work| !work.waits).and_then(|work| {
            let KeptWork { decisions, began_ns, ends_ns, waits, started, .. } = work.clone();
            Some(Work { room: room(&work.room)?, decisions, began_ns, ends_ns, waits, started })
        });
        if let (Some(work), Some(kept)) = (&robot.work, &kept.work) {
            // A person who came during the restart interrupts, too.
            self.interruption.go_on(work.room, kept.alone);
        }
        if robot.work.is_some() {
            self.phase = self.phase.after(Step::Restore);
        }
        robot.reports_work = kept.reports_work;
        robot.restore_told(&kept.told);
        robot.restore_trouble(kept.trouble);
        robot.heard_ns = kept.heard_ns;
        (robot.battery, robot.charges) = (kept.battery, kept.charges && kept.battery.is_some());
    }

    /// Whether scores have named the rooms; reports wait until then.
    #[must_use]
    pub fn knows_rooms(&self) -> bool {
        self.scores.is_some()
    }
}

/// The database of a planner: its round, and the orders to it.
#[derive(Debug)]
pub(super) struct Database {
    kept: Kept,
    boot: String,
}

impl Database {
    /// One in the state directory for each robot.
    pub(super) fn new(directory: &Path, robot: u64) -> Self {
        let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
        let path = directory.join(format!("planner-{robot:016x}.db"));
        Self { kept: Kept::new(path, SCHEMA), boot: boot.trim().to_owned() }
    }

    /// The stored round of this boot. After a reboot the robot begins another round.
    pub(super) fn round(&mut self) -> Option<KeptRound> {
        let kept: KeptRound = self.kept.load("round")?;
        let now_ns = clock::monotonic_ns();
        let mut times =
            kept.failed.iter().map(|(_, failed_ns, _)| *failed_ns).chain(kept.began_ns).chain(kept.heard_ns);
        let past = times.all(|past_ns| past_ns <= now_ns);
        // Damaged work of more than a day would block the robot.
        const LONGEST_NS: u64 = 86_400_000_000_000;
        let is_sane = |work: &KeptWork| {
            work.began_ns <= now_ns
                && work.began_ns <= work.ends_ns
                && work.ends_ns <= now_ns.saturating_add(LONGEST_NS)
        };
        // A pause longer than the longest one would block it, too.
        let rests = kept.trouble.1 <= now_ns.saturating_add(REST_NS.1);
        let in_order = kept.work.as_ref().is_none_or(is_sane) && rests;
        let is_share = kept.battery.is_none_or(|battery| (0.0..=1.0).contains(&battery));
        (kept.boot == self.boot && past && in_order && is_share).then_some(kept)
    }

    /// The orders, which outlive a reboot.
    pub(super) fn orders(&mut self) -> Orders {
        self.kept.load("orders").unwrap_or_default()
    }

    /// Writes a changed round and changed orders. The round needs no sync: it is valid for one boot, which ends when power fails. A hold survives that.
    pub(super) fn keep(&mut self, planner: &Planner) {
        if let Some(round) = planner.kept(&self.boot) {
            self.kept.keep("round", &round, false, "the round cannot be kept for a restart; check the directory");
        }
        let loss = "orders to the planner are lost with a restart; check the directory";
        self.kept.keep("orders", planner.orders(), true, loss);
    }
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::raw::RoomScoresV1;

    use super::*;
    use crate::config::PlannerConfig;

    /// A room that fails again and again pauses as long after a restart as before it.
    #[test]
    fn how_often_a_room_failed_outlasts_a_restart() {
        let with_room = || {
            let mut planner = Planner::new(&PlannerConfig::default(), 1);
            planner.take(&RoomScoresV1 { room_count: 1, ..RoomScoresV1::default() }, BootNs(0)).unwrap();
            planner
        };
        let mut planner = with_room();
        (0..3).for_each(|_| planner.round.fail(0, BootNs(5)));
        let kept = serde_json::to_string(&planner.kept("boot").unwrap()).unwrap();
        let restored = |kept: &str| {
            let mut again = with_room();
            again.restore(&serde_json::from_str(kept).unwrap());
            again.round.failed().collect::<Vec<_>>()
        };
        assert_eq!(restored(&kept), [(0, BootNs(5), 3)]);
    }

    #[test]
    fn a_round_comes_back_whole_or_not_at_all() {
        let directory = tempfile::tempdir().unwrap();
        let mut database = Database::new(directory.path(), 7);
        assert_eq!(database.round(), None);
        let mut planner = Planner::new(&PlannerConfig::default(), 1);
        database.keep(&planner);
        assert_eq!(database.round(), None, "nothing is known before the first scores");
        planner.take(&RoomScoresV1 { room_count: 1, ..RoomScoresV1::default() }, BootNs(0)).unwrap();
        database.keep(&planner);
        let round = planner.kept(&database.boot).unwrap();
        assert_eq!(database.round(), Some(round.clone()));
        let mut with = |round: KeptRound| {
            database.kept.keep("round", &round, false, "it is not kept");
            database.round()
        };
        assert_eq!(with(KeptRound { boot: "other".to_owned(), ..round.clone() }), None);
        for battery in [-0.1, 1.1, 1e300] {
            assert_eq!(with(KeptRound { battery: Some(battery), ..round.clone() }), None, "{battery}");
        }
        assert_eq!(with(KeptRound { trouble: (2, BootNs(u64::MAX)), ..round }), None);
    }

    #[test]
    fn orders_outlive_a_reboot() {
        let directory = tempfile::tempdir().unwrap();
        let open = |robot| Database::new(directory.path(), robot);
        let mut orders = Orders::default();
        orders.skip("hall", 300);
        orders.ask("kitchen", 200);
        open(7).keep(&Planner::new(&PlannerConfig::default(), 1).with_orders(orders.clone()));
        assert_eq!(open(7).orders(), orders);
        assert_eq!(open(8).orders(), Orders::default(), "another robot");
    }
}
