//! Simulated homes with sensors: the truth by the second, and the reports of imperfect devices. They measure [`roomcast_core::tracker`].
//!
//! The simulation is not the filter's model:
//!
//! | part | simulation | filter |
//! | --- | --- | --- |
//! | days | schedules: sleep, work, meals at one table, errands together, short errands of a minute | hazards and destinations per room and hour |
//! | stays | appointments, lognormal activities | a mixture of two exponentials |
//! | movement in a room | bursts with lognormal gaps by activity, blind spots per stay | two rates, for walking and for settled persons |
//! | motion sensors | fixed hold time, retriggered, dead time, crosstalk through doors | exponential on and off times |
//! | phones | late, lost for minutes, forgotten at home | late and rarely lost |
//! | false alarms | single ones, and days of noise | a rate per sensor, learned |
//! | captions | wrong names, wrong rooms, vague texts | one trust |
//!
//! Every draw has a seed: the same seed gives the same days.

pub mod days;
pub mod devices;
pub mod plan;
pub mod recorded;

use rand::RngExt;

pub const DAY_S: usize = 86_400;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Act {
    Walk,
    /// Moves about: cooks, washes, tidies.
    Busy,
    Sit,
    Sleep,
    Out,
}

/// One person's truth by the second.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Life {
    /// The room; `None` is elsewhere.
    pub room: Vec<Option<u8>>,
    pub act: Vec<Act>,
}

impl Life {
    pub fn stay(&mut self, seconds: usize, room: Option<u8>, act: Act) {
        self.room.extend(std::iter::repeat_n(room, seconds));
        self.act.extend(std::iter::repeat_n(act, seconds));
    }

    pub fn len(&self) -> usize {
        self.room.len()
    }

    /// Cuts it to a length, or lengthens it by its last second.
    pub fn fit(&mut self, seconds: usize) {
        let (room, act) = (self.room.last().copied().flatten(), self.act.last().copied().unwrap_or(Act::Out));
        self.room.resize(seconds, room);
        self.act.resize(seconds, act);
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Truth {
    pub residents: Vec<Life>,
    pub visitors: Vec<Life>,
}

impl Truth {
    /// Everybody's room at a second; `None` is elsewhere.
    pub(crate) fn places(&self, second: usize) -> impl Iterator<Item = Option<usize>> {
        self.residents.iter().chain(&self.visitors).map(move |life| life.room[second].map(usize::from))
    }
}

/// A normal draw (Box and Muller).
pub(crate) fn normal(random: &mut impl RngExt, mean: f64, deviation: f64) -> f64 {
    let (u, v): (f64, f64) = (random.random_range(1e-12..1.0), random.random_range(0.0..1.0));
    mean + deviation * (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// A lognormal draw with this median.
pub(crate) fn lognormal(random: &mut impl RngExt, median: f64, deviation: f64) -> f64 {
    normal(random, median.ln(), deviation).exp()
}
