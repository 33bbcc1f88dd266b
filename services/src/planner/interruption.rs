//! Interrupts the robot when a person comes into its room, with hysteresis: the robot returns only when the room is likely empty.

use super::round::nanoseconds;
use crate::config::PlannerConfig;
use roomcast_core::ids::BootNs;

#[derive(Debug)]
pub(super) struct Interruption {
    on: bool,
    at: f64,
    after_ns: u64,
    resume_at: f64,
    /// The room of the current stay, and whether a person there now came after the robot.
    stay: Option<(usize, bool)>,
    /// The time since which a person is likely there.
    since_ns: Option<BootNs>,
    held: Vec<bool>,
}

impl Interruption {
    pub(super) fn new(config: &PlannerConfig) -> Self {
        Self {
            on: config.interrupt,
            at: config.interrupt_at,
            after_ns: nanoseconds(config.interrupt_after_s),
            resume_at: config.resume_at,
            stay: None,
            since_ns: None,
            held: Vec::new(),
        }
    }

    pub(super) fn held(&self) -> &[bool] {
        &self.held
    }

    /// Whether a person in its room with this probability meets the robot.
    pub(super) fn is_met(&self, likely: f64) -> bool {
        self.on && likely >= self.at
    }

    pub(super) fn hold(&mut self, room: usize) {
        if let Some(held) = self.held.get_mut(room) {
            *held = true;
        }
    }

    pub(super) fn move_rooms(&mut self, rooms: usize, before: impl Fn(usize) -> Option<usize>) {
        let held = |room: usize| before(room).and_then(|old| self.held.get(old).copied()).unwrap_or(false);
        self.held = (0..rooms).map(held).collect();
        let after = |old: usize| (0..rooms).find(|room| before(*room) == Some(old));
        self.stay = self.stay.and_then(|(room, came)| Some((after(room)?, came)));
    }

    /// Begins another stay, or none. The planner knew about a person in the room at the start.
    pub(super) fn new_stay(&mut self, begun: Option<(usize, f64)>) {
        self.stay = begun.map(|(room, likely)| (room, likely < self.at));
        self.since_ns = None;
    }

    /// For the room of the stay, whether a person there came after the robot. Always true for another room.
    pub(super) fn is_alone(&self, room: usize) -> bool {
        self.stay.is_none_or(|(same, came)| same != room || came)
    }

    /// Continues a stay that began before a restart.
    pub(super) fn go_on(&mut self, room: usize, alone: bool) {
        self.stay = Some((room, alone));
    }

    /// Updates with the probability of a person in each room, while the robot works in `room`. Returns whether this interrupts it. Only a
    /// later arrival does.
    pub(super) fn look(&mut self, now_ns: BootNs, likely: &[f64], room: Option<usize>) -> bool {
        for (held, likely) in self.held.iter_mut().zip(likely) {
            *held &= *likely > self.resume_at;
        }
        let Some((room, likely)) = room.and_then(|room| Some((room, *likely.get(room)?))).filter(|_| self.on) else {
            self.new_stay(None);
            return false;
        };
        let came = match self.stay {
            Some((same, came)) if same == room => came || likely <= self.resume_at,
            _ => likely < self.at,
        };
        self.stay = Some((room, came));
        if !came || likely < self.at {
            self.since_ns = None;
            return false;
        }
        let since_ns = *self.since_ns.get_or_insert(now_ns);
        if now_ns.since(since_ns) < self.after_ns {
            return false;
        }
        self.hold(room);
        self.new_stay(None);
        true
    }

    /// Without a forecast, the time of a likely person starts again.
    pub(super) fn look_away(&mut self) {
        self.since_ns = None;
    }

    /// No person is known: no room is held, and a person in `room` from now on came after the robot.
    pub(super) fn forget(&mut self, room: Option<usize>) {
        self.held.fill(false);
        self.new_stay(room.map(|room| (room, 0.0)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    fn interruption(rooms: usize) -> Interruption {
        let mut interruption = Interruption::new(&PlannerConfig::default());
        interruption.move_rooms(rooms, |_| None);
        interruption
    }

    #[test]
    fn a_person_who_comes_and_stays_interrupts_once() {
        let mut robot = interruption(2);
        assert!(!robot.look(BootNs(0), &[0.5, 0.0], Some(0)));
        assert!(!robot.look(BootNs(S), &[0.7, 0.0], Some(0)));
        assert!(!robot.look(BootNs(2 * S), &[0.5, 0.0], Some(0)), "who only passes does not");
        assert!(!robot.look(BootNs(3 * S), &[0.7, 0.0], Some(0)));
        assert!(!robot.look(BootNs(4 * S), &[0.6, 0.0], Some(0)));
        assert!(robot.look(BootNs(5 * S), &[0.6, 0.0], Some(0)));
        assert_eq!(robot.held(), [true, false]);
        assert!(!robot.look(BootNs(6 * S), &[0.9, 0.0], None));
    }

    /// The first known person was unknown when the robot was sent.
    #[test]
    fn the_first_who_is_told_of_interrupts() {
        let mut robot = interruption(2);
        robot.new_stay(Some((0, 0.0)));
        robot.forget(Some(0));
        assert!(!robot.look(BootNs(0), &[0.98, 0.0], Some(0)) && robot.look(BootNs(3 * S), &[0.98, 0.0], Some(0)));
        // A person already known in the room when the robot was sent does not interrupt.
        robot.new_stay(Some((1, 0.98)));
        assert!(!robot.look(BootNs(4 * S), &[0.0, 0.98], Some(1)) && !robot.look(BootNs(9 * S), &[0.0, 0.98], Some(1)));
    }

    #[test]
    fn a_person_who_came_before_a_change_of_the_map_interrupts_after_it() {
        let mut robot = interruption(2);
        robot.look(BootNs(0), &[0.0, 0.0], Some(1));
        robot.look(BootNs(S), &[0.0, 0.9], Some(1));
        // A new room comes first.
        robot.move_rooms(3, |room| room.checked_sub(1));
        assert!(robot.look(BootNs(4 * S), &[0.0, 0.0, 0.9], Some(2)) && robot.held()[2]);
    }

    #[test]
    fn the_room_is_free_again_only_when_it_is_likely_empty() {
        let mut robot = interruption(1);
        robot.look(BootNs(0), &[0.0], Some(0));
        robot.look(BootNs(S), &[0.9], Some(0));
        assert!(robot.look(BootNs(9 * S), &[0.9], Some(0)));
        for (likely, held) in [(0.5, true), (0.31, true), (0.3, false), (0.5, false)] {
            robot.look(BootNs(10 * S), &[likely], None);
            assert_eq!(robot.held(), [held], "{likely}");
        }
    }

    #[test]
    fn a_room_is_left_to_nobody_once_nobody_is_known() {
        let mut robot = interruption(1);
        robot.look(BootNs(0), &[0.0], Some(0));
        robot.look(BootNs(S), &[0.9], Some(0));
        assert!(robot.look(BootNs(9 * S), &[0.9], Some(0)) && robot.held()[0]);
        robot.look_away();
        assert!(robot.held()[0], "a forecast that is late says nothing");
        robot.forget(None);
        assert!(!robot.held()[0]);
    }

    #[test]
    fn whoever_was_there_before_the_robot_does_not_interrupt_before_they_have_left() {
        let mut robot = interruption(1);
        robot.new_stay(Some((0, 0.9)));
        assert!((0..100).all(|s| !robot.look(BootNs(s * S), &[0.9], Some(0))));
        assert!(!robot.look(BootNs(100 * S), &[0.5], Some(0)));
        assert!((101..200).all(|s| !robot.look(BootNs(s * S), &[0.9], Some(0))), "a doubt is no leaving");
        robot.look(BootNs(200 * S), &[0.2], Some(0));
        robot.look(BootNs(201 * S), &[0.9], Some(0));
        assert!(robot.look(BootNs(203 * S), &[0.9], Some(0)));
    }

    #[test]
    fn time_without_a_forecast_does_not_count_and_it_can_be_off() {
        let mut robot = interruption(1);
        robot.look(BootNs(0), &[0.0], Some(0));
        robot.look(BootNs(S), &[0.9], Some(0));
        robot.look_away();
        assert!(!robot.look(BootNs(60 * S), &[0.9], Some(0)));
        assert!(robot.look(BootNs(62 * S), &[0.9], Some(0)));
        let config = PlannerConfig { interrupt: false, ..PlannerConfig::default() };
        let mut off = Interruption::new(&config);
        off.move_rooms(1, |_| None);
        off.look(BootNs(0), &[0.0], Some(0));
        assert!((1..100).all(|s| !off.look(BootNs(s * S), &[1.0], Some(0))));
    }
}
