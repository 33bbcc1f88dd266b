//! Handles the robot's reports.

use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_ipc::raw::{RobotReportV1, report_kind};

use super::robot::{Work, note_newest};
use super::rules::Hold;
use super::{Notice, Planner};

const DAY_S: f64 = 86_400.0;
/// The least duration of a person's order for a room, for one late in the evening.
const ASKED_S: u64 = 2 * 3_600;

/// A report, or a part of it, is not used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ReportFault {
    /// No room has this name.
    #[error("the robot reports the room `{room}`, which the map in use does not have: its rooms are {known}")]
    UnknownRoom {
        /// As reported.
        room: String,
        /// The known rooms.
        known: String,
    },
    /// The planner's scene is not the daemon's.
    #[error(
        "the robot reports a position, and the planner's scene has other rooms than the map that the daemon uses: \
         give the planner the same scene.path, with the rooms of a changed map, or name the room in the report"
    )]
    OtherMap,
    /// An order to clean or skip a room lacks the room.
    #[error("the order to clean or skip a room names no room; give the id of a room")]
    NoRoom,
    /// The planner knows no decision of this number.
    #[error(
        "the robot answers decision {decision}, which is none that this planner knows of the work in hand or before it, and names no room: \
         report the sequence of a decision of this planner, or name the room"
    )]
    UnknownDecision {
        /// As reported.
        decision: u64,
    },
}

fn is_of_work(kind: u32) -> bool {
    use report_kind::{BLOCKED, CANCELLED, FAILED, FINISHED, STARTED};
    [STARTED, FINISHED, FAILED, BLOCKED, CANCELLED].contains(&kind)
}

impl Planner {
    /// Takes a checked report of the planner's robot, from any sender. Reports of other robots and repeated reports are ignored. The first
    /// scores give the rooms, so a report must not come here before them.
    ///
    /// # Errors
    /// [`ReportFault`] for an unknown room, an unknown decision, or a position that cannot be placed. The rest of the report is used,
    /// except work in an unknown room.
    pub fn take_report(&mut self, report: &RobotReportV1, now_ns: BootNs) -> Result<(), ReportFault> {
        let is_meant = report.robot == self.number && (self.robot.listens() || report.is_order());
        if !is_meant || !self.robot.is_new(report.epoch, report.sequence) {
            return Ok(());
        }
        let at_ns = BootNs(report.reported_ns).min(now_ns);
        if report.is_order() {
            return self.take_order(report);
        }
        self.robot.hear(at_ns);
        let is_of_work = is_of_work(report.kind);
        if is_of_work || report.kind == report_kind::DOCKED {
            self.robot.note_told(report.epoch, report.sequence);
        }
        if let Some(battery) = report.battery() {
            self.robot.charge(battery);
        }
        let (named, named_fault) = split(self.named_room(report));
        let (placed, placed_fault) = split(self.placed_room(report));
        let (named, placed) = (named.flatten(), placed.flatten());
        let answered = (report.decision_sequence > 0).then_some((report.decision_epoch, report.decision_sequence));
        // An unknown room must not count as the current one. An answered decision gives the room.
        if let Some(fault) = named_fault.clone().filter(|_| answered.is_none() && is_of_work) {
            return Err(fault);
        }
        let told = answered.and_then(|decision| self.room_of_decision(decision));
        let work = self.robot.work.as_ref();
        // A report is about the current work if it answers its decision. Without a decision, it must be from after the start of the work
        // and not about another room.
        let room = named.or(told).or(placed.flatten());
        let of_work = work.is_some_and(|work| match answered {
            // Work that a person started answers no decision; its room counts.
            Some(decision) => work.answers(decision) || work.decisions.is_empty() && named == Some(work.room),
            None => at_ns >= work.began_ns && room.is_none_or(|room| room == work.room),
        });
        let unknown = answered.filter(|_| told.is_none() && !of_work && named.is_none() && is_of_work);
        let unknown_fault = unknown.map(|(_, decision)| ReportFault::UnknownDecision { decision });
        let room = room.or(work.filter(|_| of_work).map(|work| work.room));
        // Reports from before this round do not count: a planner that joins receives the last reports, of any age.
        let in_round = room.filter(|_| self.round.began_ns.is_some_and(|began_ns| at_ns >= began_ns));
        self.robot.reports_work |= is_of_work;
        match report.kind {
            report_kind::POSITION => {
                if let Some(place) = placed.or(named.map(Some)) {
                    self.robot.be(place, at_ns);
                }
            }
            report_kind::STARTED | report_kind::FINISHED => {
                self.robot.is_well();
                self.robot.leave_dock();
                self.robot.be(placed.unwrap_or(room), at_ns);
                if report.kind == report_kind::STARTED {
                    self.start(room, answered, of_work, at_ns, now_ns);
                } else {
                    in_round.into_iter().for_each(|room| self.cover(room, at_ns));
                    self.robot.work.take_if(|_| of_work);
                }
            }
            report_kind::FAILED | report_kind::BLOCKED | report_kind::CANCELLED => {
                placed.into_iter().for_each(|place| self.robot.be(place, at_ns));
                in_round.into_iter().for_each(|room| self.round.fail(room, at_ns));
                if of_work && let Some(work) = self.robot.work.take() {
                    if report.kind == report_kind::FAILED && !work.started {
                        self.robot.refuse(at_ns);
                    }
                    self.complain(work.room, report.note());
                }
            }
            report_kind::DOCKED => {
                self.robot.be(placed.unwrap_or(named), at_ns);
                self.dock(at_ns, answered.is_some() && of_work);
            }
            // The battery was handled above. Unknown kinds have no effect.
            _ => {}
        }
        named_fault.or(placed_fault).or(unknown_fault).map_or(Ok(()), Err)
    }

    fn dock(&mut self, at_ns: BootNs, is_answer: bool) {
        self.robot.dock();
        self.robot.is_well();
        // A robot also reports that it is docked before it leaves.
        let gives_up = |work: &Work| at_ns >= work.began_ns && (work.started || is_answer);
        let work = self.robot.work.take_if(|work| gives_up(work) || self.robot.charges);
        // A robot that only waited has not failed.
        if let Some(work) = work.filter(|work| !work.waits) {
            self.round.fail(work.room, at_ns);
        }
    }

    /// Ends work that this planner ordered, for a person's order.
    fn end_work(&mut self, is_ended: impl Fn(&Work) -> bool, why: String) {
        if let Some(work) = self.robot.work.take_if(|work| is_ended(work) && !work.decisions.is_empty()) {
            self.notice = Notice { cancels: self.own_decision(&work), flags: 0, why };
            self.interruption.new_stay(None);
        }
    }

    /// Takes a person's order. An order for a room ends with the local day.
    fn take_order(&mut self, report: &RobotReportV1) -> Result<(), ReportFault> {
        let key = (report.epoch, report.sequence);
        if !note_newest(&mut self.orders.taken, key.0, key.1) {
            return Ok(());
        }
        let unix_s = report.reported_unix_ns / 1_000_000_000;
        let room = self.named_room(report)?;
        let local_s = self.zone.local_s(UnixNs(report.reported_unix_ns));
        let day_ends_s = unix_s.saturating_add((DAY_S - local_s.rem_euclid(DAY_S)).ceil() as u64);
        match (report.kind, room) {
            (report_kind::HOLD, _) => {
                let until_unix_s = (report.until_unix_ns > 0).then_some(report.until_unix_ns / 1_000_000_000);
                self.orders.hold = Some(Hold { why: report.note().to_owned(), until_unix_s });
            }
            (report_kind::RESUME, _) => self.orders.hold = None,
            (report_kind::CLEAN, Some(room)) => {
                let id = self.id_of(room).to_owned();
                self.orders.ask(&id, day_ends_s.max(unix_s.saturating_add(ASKED_S)));
                self.end_work(|work| work.room != room, String::new());
            }
            (report_kind::SKIP, Some(room)) => {
                let (id, name) = (self.id_of(room).to_owned(), self.name_of(room));
                self.orders.skip(&id, day_ends_s);
                self.end_work(|work| work.room == room, format!("The {name} is skipped today. "));
            }
            _ => return Err(ReportFault::NoRoom),
        }
        self.ordered();
        Ok(())
    }

    /// The robot works in a room: the ordered one, or another, for example after a person pressed its button.
    fn start(
        &mut self,
        room: Option<usize>,
        answered: Option<(u64, u64)>,
        of_work: bool,
        at_ns: BootNs,
        now_ns: BootNs,
    ) {
        let Some(room) = room else { return };
        let ends_ns = at_ns.saturating_add(self.stay_in_ns(room));
        let may_still_work = self.robot.may_still_work(ends_ns, now_ns);
        match &mut self.robot.work {
            Some(work) if of_work => (work.started, work.ends_ns) = (true, ends_ns),
            Some(work) if answered.is_none() && at_ns >= work.began_ns => {
                // The earlier order is not for this room: a report that answers it is about the ordered room.
                *work = Work { room, decisions: Vec::new(), started: true, ends_ns, waits: false, ..work.clone() };
                self.interruption.new_stay(None);
            }
            Some(_) => {}
            None if may_still_work => {
                let decisions = answered.into_iter().collect();
                let work = Work { room, decisions, began_ns: at_ns, ends_ns, waits: false, started: true };
                self.robot.work = Some(work);
                self.interruption.new_stay(None);
                if self.round.undone() > 0 {
                    self.round.began_ns.get_or_insert(at_ns);
                }
            }
            None => {}
        }
    }

    /// The next decision contains the robot's reason for not doing a room.
    fn complain(&mut self, room: usize, note: &str) {
        if !note.is_empty() {
            self.notice.why = format!("The robot could not do the {} ({note}). ", self.name_of(room));
        }
    }

    fn named_room(&self, report: &RobotReportV1) -> Result<Option<usize>, ReportFault> {
        let (name, Some(scores)) = (report.room(), &self.scores) else { return Ok(None) };
        if name.is_empty() {
            return Ok(None);
        }
        let by_id = scores.rooms().iter().position(|room| room.id() == name);
        let by_name = || self.places.as_ref().filter(|places| places.fits(scores))?.named(name, scores);
        by_id.or_else(by_name).map(Some).ok_or_else(|| ReportFault::UnknownRoom {
            room: name.to_owned(),
            known: scores.rooms().iter().map(roomcast_ipc::raw::RoomV1::id).collect::<Vec<_>>().join(", "),
        })
    }

    /// The room at a report's position; the inner `None` is a position outside all rooms.
    fn placed_room(&self, report: &RobotReportV1) -> Result<Option<Option<usize>>, ReportFault> {
        let (Some(position_m), Some(scores)) = (report.position_m(), &self.scores) else { return Ok(None) };
        let places = self.places.as_ref().filter(|places| places.fits(scores)).ok_or(ReportFault::OtherMap);
        match places {
            Ok(places) => Ok(Some(places.at(position_m, scores))),
            // The name of the room is enough.
            Err(_) if !report.room().is_empty() => Ok(None),
            Err(fault) => Err(fault),
        }
    }
}

fn split<T>(result: Result<T, ReportFault>) -> (Option<T>, Option<ReportFault>) {
    match result {
        Ok(value) => (Some(value), None),
        Err(fault) => (None, Some(fault)),
    }
}
