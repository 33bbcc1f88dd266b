//! Talk to Roomcast: report what persons do, follow the forecasts, tell a robot where to go.
//!
//! Roomcast's daemon reads events, and forecasts which rooms people will be in. This crate is all that a narrator, a planner or a robot
//! needs. The processes exchange messages through shared memory ([iceoryx2](https://docs.rs/iceoryx2)).
//!
//! ```no_run
//! use std::time::Duration;
//! use roomcast_ipc::Domain;
//!
//! # fn main() -> Result<(), roomcast_ipc::Error> {
//! let domain = Domain::for_user()?;
//! let mut camera = domain.narrator("hall-camera")?;
//! camera.present("ada", Some("kitchen"))?;
//! let understood = camera.did("ada", "opens the fridge")?.confirmed(Duration::from_millis(500))?;
//! println!("{:?} is {} at {:?}", understood.persons, understood.presence, understood.place);
//!
//! for forecast in domain.forecasts()? {
//!     let busy = forecast?.occupied("kitchen", Duration::from_secs(600));
//!     println!("somebody is in the kitchen in 10 minutes: {busy:?}");
//! }
//! # Ok(())
//! # }
//! ```
//!
//! | to | use | Python |
//! | --- | --- | --- |
//! | report events | [`Domain::narrator`] | `Narrator` |
//! | decide for a robot | [`Domain::planner`] | `Planner` |
//! | drive a robot | [`Domain::robot`] | `Robot` |
//! | follow forecasts | [`Domain::forecasts`] | `Forecasts` |
//! | follow room scores | [`Domain::scores`] | `Scores` |
//! | follow decisions | [`Domain::decisions`] | `Decisions` |
//! | ask about persons, habits, the map | [`Domain::persons`], [`Domain::habits`], [`Domain::moment`], [`Domain::change_map`] | `persons`, `habits`, `moment`, `change_map` |
//!
//! [`Domain::for_user`] is the domain of the `roomcast` program: `ROOMCAST_ROOT` and `ROOMCAST_DOMAIN` choose another one, as they do for
//! the program.
//!
//! A planner sends a robot to the calmest room. Its name is the robot's name:
//!
//! ```no_run
//! # use std::time::Duration;
//! # use roomcast_ipc::Domain;
//! # fn main() -> Result<(), roomcast_ipc::Error> {
//! let mut planner = Domain::for_user()?.planner("robot")?;
//! loop {
//!     let known = planner.next_forecast(Duration::from_secs(2))?.filter(|forecast| forecast.is_known());
//!     let Some(forecast) = known else {
//!         planner.pause("no forecast, or no person was observed yet")?;
//!         continue;
//!     };
//!     let soon = Duration::from_secs(60);
//!     let rooms = forecast.rooms().filter_map(|room| Some((room.to_owned(), forecast.occupied(room, soon)?)));
//!     let Some((calmest, p)) = rooms.min_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
//!     planner.decide(&calmest, &format!("occupied in a minute with {:.0} %", 100.0 * p))?;
//! }
//! # }
//! ```
//!
//! The robot of that name follows the decisions and reports:
//!
//! ```no_run
//! # use std::time::Duration;
//! # use roomcast_ipc::{Action, Domain};
//! # fn main() -> Result<(), roomcast_ipc::Error> {
//! let mut robot = Domain::for_user()?.robot("robot")?;
//! while let Some(decision) = robot.next(Duration::MAX)? {
//!     if decision.action() == Action::Go {
//!         println!("to {}: {}", decision.room(), decision.reason());
//!         robot.started()?;
//!         // The work in the room.
//!         robot.finished()?;
//!     }
//! }
//! # Ok(())
//! # }
//! ```
//!
//! The messages themselves are in [`raw`], with their ports ([`Publisher`], [`Subscriber`]) and the layout of every byte.
//!
//! # The contract
//!
//! Three contracts go in one direction, and the robot's reports go back to the planner:
//!
//! ```text
//! narrator --(narration)--> daemon --(room, person and item scores, forecasts)--> planner --(decision)--> robot
//!                                                                                 planner <--(report)---- robot
//! ```
//!
//! | service | payload | publishers | subscribers | buffer | history |
//! | --- | --- | --- | --- | --- | --- |
//! | `roomcast/v1/narration` | [`raw::NarrationV1`] | 8 | 4 | 256 | 32 |
//! | `roomcast/v1/room-scores` | [`raw::RoomScoresV1`], a full snapshot | 1 | 16 | 2 | 1 |
//! | `roomcast/v1/person-scores` | [`raw::PersonScoresV1`] for each person | 1 | 16 | 2 | 1 |
//! | `roomcast/v1/item-scores` | slice of [`raw::ItemScoreV1`] with [`raw::ItemScoresHeaderV1`] | 1 | 8 | 2 | 1 |
//! | `roomcast/v1/forecast` | [`raw::ForecastV1`] | 1 | 16 | 2 | 1 |
//! | `roomcast/v1/person-forecasts` | [`raw::PersonForecastsV1`] for each person | 1 | 16 | 2 | 1 |
//! | `roomcast/v1/decision` | [`raw::DecisionV1`] | 8 | 16 | 16 | 1 |
//! | `roomcast/v1/robot-report` | [`raw::RobotReportV1`] | 8 | 8 | 64 | 8 |
//! | `roomcast/v1/status` | [`raw::StatusRequestV1`] to [`raw::StatusResponseV1`] | 1 server | 8 clients | 2 | - |
//! | `roomcast/v1/map-change` | JSON text ([`question`]) | 1 server | 8 clients | 2 | - |
//! | `roomcast/v1/moment` | JSON text ([`question`]) | 1 server | 8 clients | 2 | - |
//! | `roomcast/v1/person` | JSON text ([`question`]) | 1 server | 8 clients | 2 | - |
//! | `roomcast/v1/habits` | JSON text ([`question`]) | 1 server | 8 clients | 2 | - |
//!
//! All publish-subscribe services overflow safely: a publisher never waits for a slow subscriber, and overwritten messages show as a gap in
//! the sequence numbers ([`sequence`]). Each has an event service of the same name, so that a subscriber sleeps until there is news
//! ([`Subscriber::wait`]).
//!
//! # Every message
//!
//! - `#[repr(C)]`, fixed-width integers, `f32` and `f64` only, no padding, little endian on all supported machines. Each
//!   field's documentation has its offset, which the compiler asserts. `cargo run -p roomcast-ipc --example layout` lists the
//!   offsets for other languages. The iceoryx2 type name is the message's `TYPE_NAME`.
//! - Text is UTF-8 in a fixed array, zero padded, without control characters ([`text`]).
//! - `*_ns` is `CLOCK_BOOTTIME` ([`clock::monotonic_ns`]), for ages: it is monotonic and counts suspension. `*_unix_ns` is the wall
//!   clock, for people only.
//! - An epoch is random per process start; a sequence starts at 1 and grows by 1 within an epoch.
//! - Scores are f64 in nats. `-inf` means that no label of the map is there.
//! - Reserved bytes are zero; a minor number in each message grows when one of them gets a meaning. A breaking change gets a
//!   new type name and a new service name, published together with the old one.
//! - A message is data: it is copied out of shared memory first, and [`raw::Message::check`] checks the copy.

mod ask;
#[cfg(feature = "yardstick")]
pub mod bare;
pub mod clock;
mod domain;
mod error;
mod follow;
mod give_up;
pub mod limits;
mod message;
mod narrator;
pub mod own_file;
mod planner;
mod port;
pub mod question;
mod robot;
mod sensor;
pub mod sequence;
pub mod stop;
pub mod text;
mod unused;
mod who;
mod words;

pub use domain::{Domain, Node};
pub use error::{IpcError, MessageError};
pub use give_up::end_where_iceoryx2_panics;
/// The messages as they lie in shared memory, and the numbers in them.
pub mod raw {
    pub use crate::message::{
        ALL_PERSONS, ByteImage, DecisionV1, Field, ForecastV1, IncludedV1, ItemScoreV1, ItemScoresHeaderV1,
        LEARNED_SHARE_S, Layout, MAX_HORIZONS, MAX_ITEMS, MAX_PERSONS, MAX_ROOMS, MAX_SOURCES, Message, NAME_BYTES,
        NARRATION_TEXT_BYTES, NO_PARTITION, NOTE_TEXT_BYTES, NarrationV1, PersonForecastV1, PersonForecastsV1,
        PersonScoresV1, PersonV1, REASON_TEXT_BYTES, RobotReportV1, RoomScoresV1, RoomV1, ServiceQuality,
        StatusRequestV1, StatusResponseV1, action, decision_flags, forecast_flags, narration_kind, person_flags,
        presence, probability_at, reached, report_flags, report_kind, score_flags,
    };
}

pub use ask::{
    ChangedMap, IncludedEvent, KnownPerson, LabelScore, LearnedHabits, MapBox, MapChange, Moment, PersonHabits,
    PersonLabels, ReadSentence, TokenScore, Understood, UnderstoodPerson,
};
pub use error::IpcError as Error;
pub use follow::{Decision, Decisions, Forecast, Forecasts, RoomScores, Scores};
pub use narrator::{Narrator, Said, UNDER_WAY_MAX};
pub use planner::{Order, Planner};
pub use port::{
    Awaited, ItemScores, ItemScoresPublisher, ItemScoresSubscriber, Judged, Publisher, Sender, StatusClient,
    StatusServer, Subscriber, wait_for_any,
};
pub use question::{AnswerPort, QuestionPort};
pub use robot::{Report, Robot};
pub use sensor::{SENSOR_ID_BYTES_MAX, Sensor, SensorKind};
pub use who::Who;
pub use words::{Action, NarrationKind, Presence, Reached, ReportKind};

/// The exact version of iceoryx2 that every participant of a domain must run, patch included.
pub const ICEORYX2_VERSION: &str = "0.10.0";

impl Domain {
    /// A narrator of this name.
    ///
    /// # Errors
    ///
    /// As [`Domain::open`] and [`Node::publisher`].
    pub fn narrator(&self, name: &str) -> Result<Narrator, Error> {
        Narrator::open(self, name)
    }

    /// A planner for the robot of this name.
    ///
    /// # Errors
    ///
    /// As [`Domain::narrator`].
    pub fn planner(&self, name: &str) -> Result<Planner, Error> {
        Planner::open(self, name)
    }

    /// A robot of this name, `planner.robot` in the planner's configuration.
    ///
    /// # Errors
    ///
    /// As [`Domain::narrator`].
    pub fn robot(&self, name: &str) -> Result<Robot, Error> {
        Robot::open(self, name)
    }

    /// The room scores as they come.
    ///
    /// # Errors
    ///
    /// As [`Domain::narrator`].
    pub fn scores(&self) -> Result<Scores, Error> {
        Scores::open(self)
    }

    /// The forecasts as they come.
    ///
    /// # Errors
    ///
    /// As [`Domain::narrator`].
    pub fn forecasts(&self) -> Result<Forecasts, Error> {
        Forecasts::open(self)
    }

    /// The decisions of all planners as they come.
    ///
    /// # Errors
    ///
    /// As [`Domain::narrator`].
    pub fn decisions(&self) -> Result<Decisions, Error> {
        Decisions::open(self)
    }
}
