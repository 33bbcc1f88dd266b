//! Messages of the daemon and the planners, one after the other: [`Scores`], [`Forecasts`] and [`Decisions`].

use std::time::{Duration, Instant};

use crate::raw::{
    DecisionV1, ForecastV1, Message, RoomScoresV1, decision_flags, forecast_flags, probability_at, score_flags,
};
use crate::{Action, Domain, IpcError, Node, Reached, Subscriber, clock};

/// The longest sleep between two calls of `tick`.
const SLEEP: Duration = Duration::from_millis(250);

#[derive(Debug)]
pub(crate) struct Follow<M: Message> {
    subscriber: Subscriber<M>,
    newest: (u64, u64),
}

impl<M: Message> Follow<M> {
    pub(crate) fn open(node: &Node) -> Result<Self, IpcError> {
        Ok(Self { subscriber: node.subscriber()?, newest: (0, 0) })
    }

    pub(crate) fn malformed(&self) -> u64 {
        self.subscriber.malformed()
    }

    /// The next message that is there already. `key` is its epoch and its sequence: a message with the key of the one before repeats it.
    pub(crate) fn take(&mut self, key: impl Fn(&M) -> (u64, u64)) -> Result<Option<Box<M>>, IpcError> {
        while let Some(message) = self.subscriber.receive()? {
            if std::mem::replace(&mut self.newest, key(&message)) != key(&message) {
                return Ok(Some(Box::new(message)));
            }
        }
        Ok(None)
    }

    /// Waits for the next message, `None` if none comes within `timeout`.
    pub(crate) fn next_within(
        &mut self,
        timeout: Duration,
        key: impl Fn(&M) -> (u64, u64),
        tick: impl Fn() -> Result<(), IpcError>,
    ) -> Result<Option<Box<M>>, IpcError> {
        let start = Instant::now();
        loop {
            if let Some(message) = self.take(&key)? {
                return Ok(Some(message));
            }
            let left = timeout.saturating_sub(start.elapsed());
            if left.is_zero() {
                return Ok(None);
            }
            tick()?;
            self.subscriber.wait(left.min(SLEEP))?;
        }
    }
}

macro_rules! stream {
    ($(#[$about:meta])* $stream:ident of $item:ident in $message:ident, $name:literal, $key:expr) => {
        $(#[$about])*
        #[derive(Debug)]
        pub struct $stream {
            follow: Follow<$message>,
            _node: Node,
        }

        impl $stream {
            pub(crate) fn open(domain: &Domain) -> Result<Self, IpcError> {
                let node = domain.open($name)?;
                Ok(Self { follow: Follow::open(&node)?, _node: node })
            }

            /// Waits for the next message, `None` if none comes within `timeout`.
            ///
            /// # Errors
            ///
            /// [`IpcError::Port`].
            pub fn next_within(&mut self, timeout: Duration) -> Result<Option<$item>, IpcError> {
                Ok(self.follow.next_within(timeout, $key, || Ok(()))?.map($item))
            }

            /// Messages that were malformed, and dropped.
            #[must_use]
            pub fn malformed(&self) -> u64 {
                self.follow.malformed()
            }
        }

        /// All messages as they come. It ends with an error only.
        impl Iterator for $stream {
            type Item = Result<$item, IpcError>;

            fn next(&mut self) -> Option<Self::Item> {
                self.next_within(Duration::MAX).transpose()
            }
        }

        impl $item {
            /// The message as it lies in shared memory.
            #[must_use]
            pub fn raw(&self) -> &$message {
                &self.0
            }
        }
    };
}

stream! {
    /// Follows the room scores: [`Domain::scores`].
    Scores of RoomScores in RoomScoresV1, "scores", |message| (message.epoch, message.sequence)
}
stream! {
    /// Follows the forecasts: [`Domain::forecasts`].
    ///
    /// The daemon sends the forecast again when time changes it, also without new events.
    Forecasts of Forecast in ForecastV1, "forecasts", |message| (message.epoch, message.published_ns)
}
stream! {
    /// Follows the decisions of all planners: [`Domain::decisions`].
    Decisions of Decision in DecisionV1, "decisions", |message| (message.epoch, message.sequence)
}

/// The scores of all rooms at one moment: which room a person goes to next.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomScores(pub(crate) Box<RoomScoresV1>);

impl RoomScores {
    /// Each room's id, with the probability that a person goes there next. It does not say that the room is occupied: [`Forecast`] does.
    pub fn rooms(&self) -> impl ExactSizeIterator<Item = (&str, f64)> {
        self.0.rooms().iter().map(|room| (room.id(), room.probability))
    }

    /// The time since the scores were computed.
    #[must_use]
    pub fn age(&self) -> Duration {
        Duration::from_nanos(self.0.age_ns(clock::monotonic_ns()))
    }

    /// Why scoring stopped.
    #[must_use]
    pub fn reached(&self) -> Reached {
        Reached::of(self.0.reached)
    }

    /// Whether all known persons are away.
    #[must_use]
    pub fn is_nobody_home(&self) -> bool {
        self.0.has(score_flags::NOBODY_HOME)
    }
}

/// The probability that each room is occupied, now and later.
#[derive(Debug, Clone, PartialEq)]
pub struct Forecast(pub(crate) Box<ForecastV1>);

impl Forecast {
    /// The rooms' ids, in the map's order.
    pub fn rooms(&self) -> impl Iterator<Item = &str> {
        self.0.rooms().map(|(room, _)| room)
    }

    /// The probability that people are in `room` after the time `ahead` from now; `None` if the map has no such room. The forecast's age
    /// counts. Between two horizons the probability is interpolated. After the last horizon it stays the same.
    #[must_use]
    pub fn occupied(&self, room: &str, ahead: Duration) -> Option<f64> {
        let (_, row) = self.0.rooms().find(|(id, _)| *id == room)?;
        Some(self.at(row, self.age().saturating_add(ahead)))
    }

    /// The probability that all persons are outside the map's rooms at the time `ahead` from now.
    #[must_use]
    pub fn elsewhere(&self, ahead: Duration) -> f64 {
        self.at(&self.0.elsewhere, self.age().saturating_add(ahead))
    }

    /// The time since the forecast was computed.
    #[must_use]
    pub fn age(&self) -> Duration {
        Duration::from_nanos(clock::monotonic_ns().saturating_sub(self.0.computed_ns))
    }

    /// Whether the daemon knows the place of any person. If not, all rooms are equally likely.
    #[must_use]
    pub fn is_known(&self) -> bool {
        !self.0.has(forecast_flags::NOT_KNOWN)
    }

    fn at(&self, row: &[f32], since: Duration) -> f64 {
        probability_at(self.0.horizons_s(), row, since.as_secs_f64())
    }
}

/// Where a robot goes next, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct Decision(pub(crate) Box<DecisionV1>);

impl Decision {
    /// What the robot is to do.
    #[must_use]
    pub fn action(&self) -> Action {
        Action::of(self.0.action)
    }

    /// The target room; empty if the robot may wait in its place.
    #[must_use]
    pub fn room(&self) -> &str {
        self.0.to()
    }

    /// The reason, for people.
    #[must_use]
    pub fn reason(&self) -> &str {
        self.0.reason()
    }

    /// The robot's name; empty if the planner gave none.
    #[must_use]
    pub fn robot(&self) -> &str {
        self.0.robot_name()
    }

    /// The planned time in the room; `None` if the planner gave none.
    #[must_use]
    pub fn stay(&self) -> Option<Duration> {
        (self.0.stay_ns > 0).then(|| Duration::from_nanos(self.0.stay_ns))
    }

    /// Whether the planner asked for this work before and waits for its report. The robot does not begin the work again.
    #[must_use]
    pub fn is_owed(&self) -> bool {
        self.0.has(decision_flags::OWED)
    }

    /// Whether another domain's planner decided this. It is an order to no robot of this domain.
    #[must_use]
    pub fn is_elsewhere(&self) -> bool {
        self.0.has(decision_flags::ELSEWHERE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::text;

    fn forecast(age: Duration) -> Forecast {
        let mut message = ForecastV1 { room_count: 1, horizon_count: 3, ..ForecastV1::default() };
        message.computed_ns = clock::monotonic_ns() - u64::try_from(age.as_nanos()).unwrap();
        message.horizon_s[..3].copy_from_slice(&[0.0, 100.0, 300.0]);
        message.probability[0][..3].copy_from_slice(&[1.0, 0.5, 0.1]);
        message.id[0] = text::encode("room id", "kitchen").unwrap();
        Forecast(Box::new(message))
    }

    fn is_near(found: Option<f64>, expected: f64) -> bool {
        found.is_some_and(|found| (found - expected).abs() < 1e-3)
    }

    #[test]
    fn a_forecast_between_two_horizons_is_interpolated() {
        let seconds = Duration::from_secs;
        let now = forecast(Duration::ZERO);
        for (ahead, expected) in [(0, 1.0), (50, 0.75), (100, 0.5), (200, 0.3), (300, 0.1), (9_000, 0.1)] {
            assert!(is_near(now.occupied("kitchen", seconds(ahead)), expected), "{ahead}");
        }
        assert_eq!(now.occupied("hall", seconds(0)), None);
    }

    #[test]
    fn an_old_forecast_is_corrected_for_its_age() {
        assert!(is_near(forecast(Duration::from_secs(50)).occupied("kitchen", Duration::from_secs(50)), 0.5));
    }
}
