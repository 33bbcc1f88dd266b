//! A person's orders from the page: hold, resume, clean a room now, skip a room today.

use roomcast_ipc::raw::{RobotReportV1, RoomScoresV1};
use roomcast_ipc::sequence;
use roomcast_services::clock;
use roomcast_services::reporter::{Kind, Report, Reporter};

/// Most orders that wait for the sending thread.
const WAITING_MAX: usize = 16;

/// Orders that wait to be sent.
#[derive(Debug)]
pub(super) struct Control {
    reporter: Reporter,
    waiting: Vec<RobotReportV1>,
}

impl Control {
    /// `None` if the robot's name does not fit into a message.
    pub(super) fn new(robot: &str) -> Option<Self> {
        let reporter = Reporter::new(robot, sequence::random_epoch()).ok()?;
        Some(Self { reporter, waiting: Vec::new() })
    }

    /// Takes an order: its kind, the place of its room among the scores' rooms, and the seconds of a hold.
    ///
    /// # Errors
    /// A sentence if the order is malformed, or if too many wait.
    pub(super) fn take(
        &mut self,
        kind: &str,
        room: Option<&str>,
        for_s: Option<&str>,
        scores: Option<&RoomScoresV1>,
    ) -> Result<(), String> {
        let kind: Kind = kind.parse().map_err(|_| format!("{kind:?} is no order"))?;
        if !matches!(kind, Kind::Hold | Kind::Resume | Kind::Clean | Kind::Skip) {
            return Err("the page sends orders only: hold, resume, clean, skip".to_owned());
        }
        if self.waiting.len() >= WAITING_MAX {
            return Err("too many orders at once; wait a second".to_owned());
        }
        let room = room.map(|place| {
            let room = place.parse().ok().and_then(|place: usize| scores?.rooms().get(place));
            room.map(|room| room.id().to_owned())
                .ok_or_else(|| "the map has no such room; load the page again".to_owned())
        });
        let for_s = for_s.map(|text| text.parse().map_err(|_| format!("{text:?} is no number of seconds")));
        let report = Report { room: room.transpose()?, for_s: for_s.transpose()?, ..Report::new(kind) };
        let message = self.reporter.message(&report, clock::monotonic_ns(), clock::unix_ns());
        self.waiting.push(message.map_err(|error| error.to_string())?);
        Ok(())
    }

    /// The orders that were not sent yet.
    pub(super) fn drain(&mut self) -> Vec<RobotReportV1> {
        std::mem::take(&mut self.waiting)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_ipc::raw::report_kind;
    use roomcast_ipc::text;

    #[test]
    fn orders_name_rooms_by_their_place_and_reports_are_refused() {
        let mut scores = RoomScoresV1 { room_count: 2, ..Default::default() };
        for (room, id) in scores.room.iter_mut().zip(["kitchen", "bath"]) {
            room.id = text::encode("id", id).unwrap();
        }
        let mut control = Control::new("robot").unwrap();
        control.take("hold", None, Some("3600"), Some(&scores)).unwrap();
        control.take("clean", Some("1"), None, Some(&scores)).unwrap();
        for (kind, room, for_s) in [
            ("finished", Some("0"), None),
            ("clean", None, None),
            ("clean", Some("2"), None),
            ("skip", Some("-1"), None),
            ("hold", None, Some("x")),
            ("hold", None, Some("-5")),
            ("dance", None, None),
        ] {
            assert!(control.take(kind, room, for_s, Some(&scores)).is_err(), "{kind} {room:?} {for_s:?}");
        }
        let sent = control.drain();
        let sent: Vec<_> = sent.iter().map(|order| (order.kind, order.room().to_owned())).collect();
        assert_eq!(sent, [(report_kind::HOLD, String::new()), (report_kind::CLEAN, "bath".to_owned())]);
        for _ in 0..WAITING_MAX {
            control.take("resume", None, None, None).unwrap();
        }
        assert!(control.take("resume", None, None, None).is_err());
    }
}
