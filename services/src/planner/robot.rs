//! The known state of the robot: work, place, battery, and the time of its last report.

use crate::config::{PlannerConfig, Reports};
use roomcast_core::ids::BootNs;

use super::round::nanoseconds;

/// A robot that fails so often in a row without starting has a fault itself; the room is not the cause.
const REFUSALS: u32 = 2;
/// The first pause and the longest pause before it is asked again. The pause doubles.
pub(super) const REST_NS: (u64, u64) = (60_000_000_000, 600_000_000_000);
const REPORTERS: usize = 16;
/// Most remembered decisions of earlier planners for the current work.
const FORMER: usize = 4;

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Work {
    pub(super) room: usize,
    /// The decisions for it, by epoch and sequence, newest last: of this planner, and from before a restart.
    pub(super) decisions: Vec<(u64, u64)>,
    pub(super) began_ns: BootNs,
    pub(super) ends_ns: BootNs,
    /// The robot has no work there and waits.
    pub(super) waits: bool,
    /// The robot has reported the start.
    pub(super) started: bool,
}

impl Work {
    /// Whether a decision asked for this; an epoch of 0 means any.
    pub(super) fn answers(&self, (epoch, sequence): (u64, u64)) -> bool {
        self.decisions.iter().any(|asked| asked.1 == sequence && (epoch == 0 || asked.0 == epoch))
    }

    pub(super) fn asked_by(&mut self, epoch: u64, sequence: u64) {
        if self.decisions.len() > FORMER {
            self.decisions.remove(0);
        }
        self.decisions.push((epoch, sequence));
    }
}

/// Rooms are indices in the scores.
#[derive(Debug)]
pub(super) struct Robot {
    reports: Reports,
    timeout_ns: u64,
    battery_low: f64,
    battery_ready: f64,
    charge_timeout_ns: u64,
    /// The highest number of each reporter, by epoch; newest last.
    reporters: Vec<(u64, u64)>,
    /// The same for reports about work and dock only.
    pub(super) told: Vec<(u64, u64)>,
    pub(super) reports_work: bool,
    pub(super) heard_ns: Option<BootNs>,
    pub(super) room: Option<usize>,
    /// The time of that place.
    pub(super) room_ns: BootNs,
    pub(super) battery: Option<f64>,
    /// It must not be sent out until its battery is ready.
    pub(super) charges: bool,
    pub(super) work: Option<Work>,
    /// It is overdue, and has sent no report since.
    pub(super) silent: bool,
    /// Failures in a row without a start, and the end of the pause after them.
    refusals: u32,
    rests_until_ns: BootNs,
}

impl Robot {
    pub(super) fn new(config: &PlannerConfig) -> Self {
        Self {
            reports: config.reports,
            timeout_ns: nanoseconds(config.report_timeout_s),
            battery_low: config.battery_low,
            battery_ready: config.battery_ready,
            charge_timeout_ns: nanoseconds(config.charge_timeout_s),
            reporters: Vec::new(),
            told: Vec::new(),
            reports_work: false,
            heard_ns: None,
            room: None,
            room_ns: BootNs(0),
            battery: None,
            charges: false,
            work: None,
            silent: false,
            refusals: 0,
            rests_until_ns: BootNs(0),
        }
    }

    pub(super) fn refuse(&mut self, at_ns: BootNs) {
        self.refusals = self.refusals.saturating_add(1);
        if let Some(more) = self.refusals.checked_sub(REFUSALS) {
            let (first_ns, most_ns) = REST_NS;
            let rest_ns = first_ns.saturating_mul(1 << more.min(16)).min(most_ns);
            self.rests_until_ns = at_ns.saturating_add(rest_ns);
        }
    }

    /// The failures in a row and the end of the pause, for a restart.
    pub(super) fn trouble(&self) -> (u32, BootNs) {
        (self.refusals, self.rests_until_ns)
    }

    pub(super) fn restore_trouble(&mut self, (refusals, rests_until_ns): (u32, BootNs)) {
        (self.refusals, self.rests_until_ns) = (refusals, rests_until_ns);
    }

    /// It works, or has come to its dock, so an earlier fault is over.
    pub(super) fn is_well(&mut self) {
        (self.refusals, self.rests_until_ns) = (0, BootNs(0));
    }

    /// Whether it is in a pause after repeated failures.
    pub(super) fn rests(&self, now_ns: BootNs) -> bool {
        now_ns < self.rests_until_ns
    }

    /// The reason of that pause, if there is one.
    pub(super) fn why_it_rests(&self, now_ns: BootNs) -> Option<String> {
        let minutes = self.rests_until_ns.since(now_ns).div_ceil(60_000_000_000);
        let often = self.refusals;
        self.rests(now_ns).then(|| {
            format!("the robot failed {often} times in a row before it began: it is asked again in {minutes} min, or when it comes to its dock")
        })
    }

    pub(super) fn listens(&self) -> bool {
        self.reports != Reports::Never
    }

    /// Whether the robot's reports decide what is done; otherwise the clock does.
    pub(super) fn is_believed(&self) -> bool {
        match self.reports {
            Reports::Auto => self.reports_work,
            Reports::Always => true,
            Reports::Never => false,
        }
    }

    /// Whether a report is new. Reporters may take turns; each has its own numbers.
    pub(super) fn is_new(&mut self, epoch: u64, sequence: u64) -> bool {
        note_newest(&mut self.reporters, epoch, sequence)
    }

    /// Records a report about work or dock, so that it does not count again after a restart.
    pub(super) fn note_told(&mut self, epoch: u64, sequence: u64) {
        note_newest(&mut self.told, epoch, sequence);
    }

    /// Restores the reports about work and dock that an earlier planner took.
    pub(super) fn restore_told(&mut self, told: &[(u64, u64)]) {
        for (epoch, sequence) in told {
            self.is_new(*epoch, *sequence);
            self.note_told(*epoch, *sequence);
        }
    }

    pub(super) fn hear(&mut self, at_ns: BootNs) {
        self.heard_ns = self.heard_ns.max(Some(at_ns));
        self.silent = false;
    }

    pub(super) fn be(&mut self, room: Option<usize>, at_ns: BootNs) {
        if at_ns >= self.room_ns {
            (self.room, self.room_ns) = (room, at_ns);
        }
    }

    pub(super) fn charge(&mut self, battery: f64) {
        self.battery = Some(battery);
        if battery < self.battery_low {
            self.charges = true;
        } else if battery >= self.battery_ready {
            self.charges = false;
        }
    }

    /// It is at its dock. With a known battery that is not ready, it stays there. Docking alone does not mean charging.
    pub(super) fn dock(&mut self) {
        self.charges |= self.battery.is_some_and(|battery| battery < self.battery_ready);
    }

    /// It works, so it has left the dock, unless the battery is low.
    pub(super) fn leave_dock(&mut self) {
        self.charges = self.battery.is_some_and(|battery| battery < self.battery_low);
    }

    /// Whether the time for its work is over and a report is overdue.
    pub(super) fn is_overdue(&self, now_ns: BootNs) -> bool {
        let due_ns = self.work.as_ref().map(|work| work.ends_ns.max(self.heard_ns.unwrap_or_default()));
        self.is_believed() && due_ns.is_some_and(|due_ns| now_ns >= due_ns.saturating_add(self.timeout_ns))
    }

    /// Whether work with this end may still be going on.
    pub(super) fn may_still_work(&self, ends_ns: BootNs, now_ns: BootNs) -> bool {
        now_ns < ends_ns.saturating_add(self.timeout_ns)
    }

    /// A charging robot without a report for too long counts as charged; returns whether it does so now.
    pub(super) fn give_up_charging(&mut self, now_ns: BootNs) -> bool {
        let until_ns = self.heard_ns.unwrap_or_default().saturating_add(self.charge_timeout_ns);
        let gives_up = self.charges && now_ns >= until_ns;
        if gives_up {
            (self.charges, self.battery, self.silent) = (false, None, true);
        }
        gives_up
    }

    /// The reason for keeping it in, if there is one.
    pub(super) fn why_it_charges(&self) -> Option<String> {
        let (battery, ready) = (100.0 * self.battery?, 100.0 * self.battery_ready);
        self.charges.then(|| format!("the battery is at {battery:.0} %: the robot charges until {ready:.0} %"))
    }

    /// The rooms have changed: each old one is at `after(old)` now, if it still exists.
    pub(super) fn move_rooms(&mut self, after: impl Fn(usize) -> Option<usize>) {
        self.room = self.room.and_then(&after);
        self.work = self.work.take().and_then(|work| Some(Work { room: after(work.room)?, ..work }));
    }
}

/// Records the highest number of a reporter, which becomes the newest one. Returns whether the number is a new maximum.
pub(super) fn note_newest(reporters: &mut Vec<(u64, u64)>, epoch: u64, sequence: u64) -> bool {
    let known = reporters.iter().position(|(known, _)| *known == epoch);
    let before = known.map(|place| reporters.remove(place));
    if reporters.len() == REPORTERS {
        reporters.remove(0);
    }
    let newest = before.map_or(0, |(_, newest)| newest);
    reporters.push((epoch, newest.max(sequence)));
    sequence > newest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reporters_that_take_turns_are_each_heard_once() {
        let mut robot = Robot::new(&PlannerConfig::default());
        let heard = [(1, 1), (2, 1), (1, 2), (1, 2), (2, 1), (1, 1), (2, 5)].map(|(epoch, n)| robot.is_new(epoch, n));
        assert_eq!(heard, [true, true, true, false, false, false, true]);
        assert!((10..1000).all(|epoch| robot.is_new(epoch, 1)) && robot.reporters.len() == REPORTERS);
    }
}
