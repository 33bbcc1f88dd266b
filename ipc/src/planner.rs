//! A planner: follows scores and forecasts, and publishes decisions.

use std::time::Duration;

use crate::follow::{Follow, Forecast, RoomScores};
use crate::raw::{DecisionV1, ForecastV1, Message, RoomScoresV1};
use crate::{Action, Domain, IpcError, Node, Publisher, clock, sequence, text};

/// The longest stay of a decision.
const STAY_MAX: Duration = Duration::from_secs(1_000_000_000);

/// What a robot is to do: [`Planner::publish`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Order<'a> {
    /// The room to go to, or to wait in.
    pub room: &'a str,
    /// The reason, for people. It is cut if it is too long.
    pub reason: &'a str,
    /// The planned time in the room; zero if none is planned.
    pub stay: Duration,
    /// The number of an earlier decision that ends before its time, from [`Planner::sequence`]; 0 for none.
    pub cancels: u64,
}

/// Follows scores and forecasts, and publishes decisions for one robot: [`Domain::planner`].
#[derive(Debug)]
pub struct Planner {
    publisher: Publisher<DecisionV1>,
    scores: Follow<RoomScoresV1>,
    forecasts: Follow<ForecastV1>,
    newest: Option<RoomScores>,
    forecast: Option<Forecast>,
    name: String,
    robot: u64,
    epoch: u64,
    sequence: u64,
    room: String,
    paused: bool,
    _node: Node,
}

impl Planner {
    pub(crate) fn open(domain: &Domain, name: &str) -> Result<Self, IpcError> {
        let node = domain.open(name)?;
        Ok(Self {
            publisher: node.publisher()?,
            scores: Follow::open(&node)?,
            forecasts: Follow::open(&node)?,
            newest: None,
            forecast: None,
            name: name.to_owned(),
            robot: sequence::source_of_name(name),
            epoch: sequence::random_epoch(),
            sequence: 0,
            room: String::new(),
            paused: false,
            _node: node,
        })
    }

    /// Waits for the next forecast, `None` if none comes within `timeout`: then the daemon does not run in this domain. It publishes four times a
    /// second.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn next_forecast(&mut self, timeout: Duration) -> Result<Option<&Forecast>, IpcError> {
        let key = |message: &ForecastV1| (message.epoch, message.published_ns);
        let publisher = &self.publisher;
        let next = self.forecasts.next_within(timeout, key, || publisher.tick().map(|_| ()))?;
        Ok(next.map(|message| &*self.forecast.insert(Forecast(message))))
    }

    /// Waits for the next room scores, `None` if none come within `timeout`.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn next_scores(&mut self, timeout: Duration) -> Result<Option<&RoomScores>, IpcError> {
        let publisher = &self.publisher;
        let key = |message: &RoomScoresV1| (message.epoch, message.sequence);
        let next = self.scores.next_within(timeout, key, || publisher.tick().map(|_| ()))?;
        Ok(next.map(|message| &*self.newest.insert(RoomScores(message))))
    }

    /// Publishes that the robot goes to `room`. If the previous decision names the same room, it publishes that the robot stays, so a
    /// planner may decide at each forecast. Returns the number of participants that received it: 0 if no robot listens.
    ///
    /// # Errors
    ///
    /// As [`Planner::publish`].
    pub fn decide(&mut self, room: &str, reason: &str) -> Result<usize, IpcError> {
        self.publish(&Order { room, reason, ..Order::default() })
    }

    /// Publishes an order. Returns the number of participants that received it.
    ///
    /// # Errors
    ///
    /// [`IpcError::Argument`] for a room that the newest scores and forecast do not have, and for numbers out of range;
    /// [`IpcError::Refused`] for text that no message holds; [`IpcError::Port`].
    pub fn publish(&mut self, order: &Order<'_>) -> Result<usize, IpcError> {
        let rooms = self.rooms()?;
        if order.room.is_empty() {
            return Err(IpcError::Argument("room \"\": give the id of a room of the map".to_owned()));
        }
        if !rooms.is_empty() && !rooms.iter().any(|room| room == order.room) {
            let text = format!("room {:?}: the map has no such room; give one of {}", order.room, rooms.join(", "));
            return Err(IpcError::Argument(text));
        }
        let stays = order.room == self.room && !self.paused;
        self.send(if stays { Action::Stay } else { Action::Go }, order)
    }

    /// Publishes that the robot stops its work and waits at a place without people.
    ///
    /// # Errors
    ///
    /// As [`Planner::publish`].
    pub fn pause(&mut self, reason: &str) -> Result<usize, IpcError> {
        self.rooms()?;
        let room = std::mem::take(&mut self.room);
        let paused = self.send(Action::Pause, &Order { room: &room, reason, ..Order::default() });
        self.room = room;
        paused
    }

    /// The number of the last decision, 0 before the first.
    #[must_use]
    pub fn sequence(&self) -> u64 {
        self.sequence
    }

    fn rooms(&mut self) -> Result<Vec<String>, IpcError> {
        while let Some(message) = self.scores.take(|message| (message.epoch, message.sequence))? {
            self.newest = Some(RoomScores(message));
        }
        while let Some(message) = self.forecasts.take(|message| (message.epoch, message.published_ns))? {
            self.forecast = Some(Forecast(message));
        }
        Ok(match (&self.newest, &self.forecast) {
            (Some(scores), _) => scores.rooms().map(|(room, _)| room.to_owned()).collect(),
            (None, Some(forecast)) => forecast.rooms().map(str::to_owned).collect(),
            (None, None) => Vec::new(),
        })
    }

    fn send(&mut self, action: Action, order: &Order<'_>) -> Result<usize, IpcError> {
        if order.stay > STAY_MAX || order.cancels > self.sequence {
            let text = format!(
                "stay {:?}, cancels {}: give at most {STAY_MAX:?}, and at most {}",
                order.stay, order.cancels, self.sequence
            );
            return Err(IpcError::Argument(text));
        }
        let refused = |source| IpcError::Refused { service: DecisionV1::SERVICE.name, source };
        let decided_ns = clock::monotonic_ns();
        let scores = self.newest.as_ref().map(RoomScores::raw);
        let occupied = self.forecast.as_ref().and_then(|forecast| forecast.occupied(order.room, order.stay));
        let score =
            || self.newest.as_ref()?.rooms().find(|(room, _)| *room == order.room).map(|(_, probability)| probability);
        let message = DecisionV1 {
            robot: self.robot,
            epoch: self.epoch,
            sequence: self.sequence + 1,
            decided_ns,
            decided_unix_ns: clock::unix_ns(),
            scores_epoch: scores.map_or(0, |scores| scores.epoch),
            scores_sequence: scores.map_or(0, |scores| scores.sequence),
            scores_age_ns: scores.map_or(0, |scores| scores.age_ns(decided_ns)),
            observed_ns: scores.map_or(0, |scores| scores.observed_ns),
            probability: occupied.or_else(score).unwrap_or(0.0).clamp(0.0, 1.0),
            stay_ns: u64::try_from(order.stay.as_nanos()).unwrap_or(u64::MAX),
            action: action.number(),
            cancels: order.cancels,
            minor: 2,
            from: text::encode("from", &self.room).map_err(refused)?,
            to: text::encode("to", order.room).map_err(refused)?,
            policy: text::encode_cut(&self.name),
            robot_name: text::encode_cut(&self.name),
            reason: text::encode_cut(order.reason),
            ..DecisionV1::default()
        };
        let receivers = self.publisher.send(&message)?;
        self.sequence += 1;
        order.room.clone_into(&mut self.room);
        self.paused = action == Action::Pause;
        Ok(receivers)
    }
}
