//! The round across a restart: a small file in the state directory, written whole or not at all.
//!
//! It is written after a decision was sent, and after reports were taken. What a planner that is killed has not written comes again from
//! a reporter that is still there: the service keeps its last 8 reports for whoever joins. Those of work and dock that the round rests on already
//! are known by their numbers, and not taken twice.

use std::path::Path;

use roomcast_core::ids::BootNs;
use serde::{Deserialize, Serialize};

use super::robot::{REST_NS, Work};
use super::{Planner, Standing};
use crate::clock;
use crate::state_file::{self, Kept};

/// How often the file says that a robot which charges was heard.
const MINUTE_NS: u64 = 60_000_000_000;

/// Most bytes of the file that are read.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// What a planner keeps of its round. Times are monotonic nanoseconds of one boot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeptRound {
    /// The boot that the times belong to.
    boot: String,
    /// The map that the rooms are of, in hexadecimal.
    map: String,
    began_ns: Option<BootNs>,
    /// When the round before was due.
    #[serde(default)]
    due_ns: Option<BootNs>,
    done: Vec<String>,
    /// Rooms that the robot could not do, and when.
    #[serde(default)]
    failed: Vec<(String, BootNs)>,
    /// How often in a row it could not do each of them; once where an older version did not keep it.
    #[serde(default)]
    failures: Vec<u32>,
    /// Rooms that were left to a person.
    #[serde(default)]
    held: Vec<String>,
    room: Option<String>,
    work: Option<KeptWork>,
    reports_work: bool,
    battery: Option<f64>,
    charges: bool,
    /// The minute in which a robot that charges was heard last.
    #[serde(default)]
    heard_ns: Option<BootNs>,
    /// Reporters by their epoch, and the newest report of work or dock of each that the round rests on.
    #[serde(default)]
    told: Vec<(u64, u64)>,
    /// How often in a row the robot failed before it began, and until when it is left alone.
    #[serde(default)]
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
    /// Nobody was likely there when it began, or they have left since: who is there came after it.
    #[serde(default = "yes")]
    alone: bool,
}

/// An older version did not keep it: who is there then interrupts.
fn yes() -> bool {
    true
}

impl Planner {
    /// What is to be kept of the round; none before the first scores.
    #[must_use]
    pub fn kept(&self, boot: &str) -> Option<KeptRound> {
        let scores = self.scores.as_ref()?;
        let id = |room: usize| self.id_of(room).to_owned();
        let done = self.round.covered().iter().enumerate().filter(|(_, done)| **done);
        let held = self.interruption.held().iter().enumerate().filter(|(_, held)| **held);
        Some(KeptRound {
            boot: boot.to_owned(),
            map: hex::encode(scores.map_fingerprint),
            began_ns: self.round.began_ns,
            due_ns: self.round.due_ns,
            done: done.map(|(room, _)| id(room)).collect(),
            failed: self.round.failed().map(|(room, failed_ns, _)| (id(room), failed_ns)).collect(),
            failures: self.round.failed().map(|(_, _, failures)| failures).collect(),
            held: held.map(|(room, _)| id(room)).collect(),
            room: self.robot.room.map(id),
            // Of a robot that decides with every score no work outlasts the planner.
            work: self.robot.work.as_ref().filter(|_| self.round.stay_ns > 0).map(|work| KeptWork {
                room: id(work.room),
                decisions: work.decisions.clone(),
                began_ns: work.began_ns,
                ends_ns: work.ends_ns,
                waits: work.waits,
                started: work.started,
                alone: self.interruption.is_alone(work.room),
            }),
            reports_work: self.robot.reports_work,
            battery: self.robot.battery,
            charges: self.robot.charges,
            heard_ns: self
                .robot
                .heard_ns
                .filter(|_| self.robot.charges)
                .map(|heard_ns| BootNs(heard_ns.0 - heard_ns.0 % MINUTE_NS)),
            told: self.robot.told.clone(),
            trouble: self.robot.trouble(),
        })
    }

    /// Takes up a round that was kept, if it is of the rooms that the scores are of.
    pub(super) fn restore(&mut self, kept: &KeptRound) {
        let Some(scores) = self.scores.filter(|scores| hex::encode(scores.map_fingerprint) == kept.map) else { return };
        let room = |id: &str| scores.rooms().iter().position(|room| room.id() == id);
        for done in kept.done.iter().filter_map(|id| room(id)) {
            self.round.cover(done);
        }
        for ((failed, failed_ns), failures) in kept.failed.iter().zip(kept.failures.iter().chain(std::iter::repeat(&1)))
        {
            room(failed).into_iter().for_each(|room| self.round.restore_failed(room, *failed_ns, *failures));
        }
        kept.held.iter().filter_map(|id| room(id)).for_each(|room| self.interruption.hold(room));
        (self.round.began_ns, self.round.due_ns) = (kept.began_ns, kept.due_ns);
        let robot = &mut self.robot;
        robot.room = kept.room.as_deref().and_then(room);
        // A robot that only waits is told again where: it is not to work there.
        robot.work = kept.work.as_ref().filter(|work| !work.waits).and_then(|work| {
            let KeptWork { decisions, began_ns, ends_ns, waits, started, .. } = work.clone();
            Some(Work { room: room(&work.room)?, decisions, began_ns, ends_ns, waits, started })
        });
        if let (Some(work), Some(kept)) = (&robot.work, &kept.work) {
            // Whoever came while nobody looked is noticed too.
            self.interruption.go_on(work.room, kept.alone);
        }
        if robot.work.is_some() {
            self.standing = Standing::Resumes;
        }
        robot.reports_work = kept.reports_work;
        robot.restore_told(&kept.told);
        robot.restore_trouble(kept.trouble);
        // An older version kept no time: a robot that charges counts as heard when its round was taken up.
        robot.heard_ns = kept.heard_ns.or(kept.charges.then_some(BootNs(scores.published_ns)));
        (robot.battery, robot.charges) = (kept.battery, kept.charges && kept.battery.is_some());
    }

    /// Whether scores have said which rooms there are: reports before that are to wait.
    #[must_use]
    pub fn knows_rooms(&self) -> bool {
        self.scores.is_some()
    }
}

/// The file that a planner keeps its round in.
#[derive(Debug)]
pub(super) struct RoundFile {
    file: Kept<KeptRound>,
    boot: String,
}

impl RoundFile {
    /// In the state directory, one for each robot.
    pub(super) fn new(directory: &Path, robot: u64) -> Self {
        let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
        let path = directory.join(format!("planner-{robot:016x}.json"));
        Self { file: Kept::new(path), boot: boot.trim().to_owned() }
    }

    /// The round that was kept, of this boot: a robot that was off with its machine begins another.
    pub(super) fn load(&self) -> Option<KeptRound> {
        let path = self.file.path().display();
        // A directory that cannot be written is told of where something is to be written.
        let _removed = state_file::remove_unfinished(self.file.path());
        let text = state_file::read(self.file.path(), FILE_BYTES_MAX);
        let kept: KeptRound = match text.map(|text| text.map(|text| serde_json::from_str(&text))) {
            Ok(None) => return None,
            Ok(Some(Ok(kept))) => kept,
            Ok(Some(Err(error))) => {
                tracing::warn!(%error, %path, "the kept round is damaged; a new one begins");
                return None;
            }
            Err(error) => {
                tracing::warn!(%error, %path, "the kept round cannot be read; a new one begins");
                return None;
            }
        };
        let now_ns = clock::monotonic_ns();
        let mut times = kept.failed.iter().map(|(_, failed_ns)| *failed_ns).chain(kept.began_ns).chain(kept.heard_ns);
        let past = times.all(|past_ns| past_ns <= now_ns);
        // A file that says that work goes on for longer than a day would hold the robot up.
        const LONGEST_NS: u64 = 86_400_000_000_000;
        let is_sane = |work: &KeptWork| {
            work.began_ns <= now_ns
                && work.began_ns <= work.ends_ns
                && work.ends_ns <= now_ns.saturating_add(LONGEST_NS)
        };
        // So would one that says that the robot is left alone for longer than it ever is.
        let rests = kept.trouble.1 <= now_ns.saturating_add(REST_NS.1);
        let in_order = kept.work.as_ref().is_none_or(is_sane) && rests;
        let is_share = kept.battery.is_none_or(|battery| (0.0..=1.0).contains(&battery));
        (kept.boot == self.boot && past && in_order && is_share).then_some(kept)
    }

    /// Keeps a round if it has changed; the old file stays whole until the new one is. A directory that cannot be written costs the
    /// round across a restart, and nothing else. The file is of this boot alone, which no loss of power outlives.
    pub(super) fn keep(&mut self, planner: &Planner) {
        if let Some(kept) = planner.kept(&self.boot) {
            self.file.keep(kept, "the round cannot be kept for a restart; check the directory");
        }
    }
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::raw::RoomScoresV1;

    use super::*;
    use crate::config::PlannerConfig;

    /// A room that fails again and again rests as long after a restart as before it.
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
        let older = kept.replace("\"failures\":[3],", "");
        assert!(older != kept);
        assert_eq!(restored(&older), [(0, BootNs(5), 1)]);
    }

    #[test]
    fn a_round_comes_back_whole_or_not_at_all() {
        let directory = tempfile::tempdir().unwrap();
        let mut file = RoundFile::new(directory.path(), 7);
        assert_eq!(file.load(), None);
        let mut planner = Planner::new(&PlannerConfig::default(), 1);
        let path = file.file.path().to_owned();
        let write = |kept: &KeptRound| std::fs::write(&path, serde_json::to_vec(kept).unwrap()).unwrap();
        file.keep(&planner);
        assert!(!path.exists(), "nothing is known before the first scores");
        planner.take(&RoomScoresV1 { room_count: 1, ..RoomScoresV1::default() }, BootNs(0)).unwrap();
        // A directory that is away for a moment costs nothing that does not change.
        std::fs::remove_dir(directory.path()).unwrap();
        file.keep(&planner);
        assert_eq!(file.load(), None);
        std::fs::create_dir(directory.path()).unwrap();
        file.keep(&planner);
        assert!(file.load().is_some() && file.load() == planner.kept(&file.boot));
        let of_another_boot = KeptRound { boot: "other".to_owned(), ..planner.kept("").unwrap() };
        write(&of_another_boot);
        assert_eq!(file.load(), None);
        for damaged in ["", "{", "[]", r#"{"boot": 1}"#] {
            std::fs::write(&path, damaged).unwrap();
            assert_eq!(file.load(), None, "{damaged}");
        }
        for battery in [-0.1, 1.1, 1e300] {
            write(&KeptRound { battery: Some(battery), ..planner.kept(&file.boot).unwrap() });
            assert_eq!(file.load(), None, "{battery}");
        }
        write(&KeptRound { trouble: (2, BootNs(u64::MAX)), ..planner.kept(&file.boot).unwrap() });
        assert_eq!(file.load(), None);
        let left = std::fs::read_dir(directory.path()).unwrap().count();
        assert_eq!(left, 1, "no half-written files");
    }
}
