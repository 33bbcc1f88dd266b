//! The contract between Roomcast's processes: services, messages and ports over iceoryx2.
//!
//! A planner of somebody else's needs this crate alone. Three contracts, one direction, and the robot's
//! reports back to the planner:
//!
//! ```text
//! narrator --(narration)--> daemon --(room, person and item scores, forecasts)--> planner --(decision)--> robot
//!                                                                                 planner <--(report)---- robot
//! ```
//!
//! | service | payload | publishers | subscribers | buffer | history |
//! | --- | --- | --- | --- | --- | --- |
//! | `roomcast/v1/narration` | [`NarrationV1`] | 8 | 4 | 256 | 32 |
//! | `roomcast/v1/room-scores` | [`RoomScoresV1`], a full snapshot | 1 | 16 | 2 | 1 |
//! | `roomcast/v1/person-scores` | [`PersonScoresV1`], those of each person | 1 | 16 | 2 | 1 |
//! | `roomcast/v1/item-scores` | slice of [`ItemScoreV1`] with [`ItemScoresHeaderV1`] | 1 | 8 | 2 | 1 |
//! | `roomcast/v1/forecast` | [`ForecastV1`] | 1 | 16 | 2 | 1 |
//! | `roomcast/v1/person-forecasts` | [`PersonForecastsV1`], those of each person | 1 | 16 | 2 | 1 |
//! | `roomcast/v1/decision` | [`DecisionV1`] | 8 | 16 | 16 | 1 |
//! | `roomcast/v1/robot-report` | [`RobotReportV1`] | 8 | 8 | 64 | 8 |
//! | `roomcast/v1/status` | [`StatusRequestV1`] to [`StatusResponseV1`] | 1 server | 8 clients | 2 | - |
//! | `roomcast/v1/map-change` | JSON text ([`question`]) | 1 server | 8 clients | 2 | - |
//! | `roomcast/v1/moment` | JSON text ([`question`]) | 1 server | 8 clients | 2 | - |
//! | `roomcast/v1/person` | JSON text ([`question`]) | 1 server | 8 clients | 2 | - |
//! | `roomcast/v1/habits` | JSON text ([`question`]) | 1 server | 8 clients | 2 | - |
//!
//! All publish-subscribe services overflow safely: a publisher never waits for a slow subscriber, and what was overwritten
//! shows as a gap in the sequence numbers ([`sequence`]). Each has an event service of the same name, so that a
//! subscriber sleeps until there is news ([`Subscriber::wait`]).
//!
//! # What holds for every message
//!
//! - `#[repr(C)]`, fixed-width integers, `f32` and `f64` only, no padding, little endian on all supported machines. Offsets
//!   stand in each field's documentation, are asserted at compile time, and are listed by `cargo run -p roomcast-ipc
//!   --example layout` for other languages. The iceoryx2 type name is the message's `TYPE_NAME`.
//! - Text is UTF-8 in a fixed array, zero padded, without control characters ([`text`]).
//! - `*_ns` is `CLOCK_BOOTTIME` ([`clock::monotonic_ns`]), monotonic and counting suspension, for ages; `*_unix_ns` is wall clock, for people only.
//! - An epoch is random per process start; a sequence starts at 1 and grows by 1 within an epoch.
//! - Scores are f64 in nats. `-inf` says that nothing of the map's labels lies there.
//! - Reserved bytes are zero; a minor number in each message grows when one of them gets a meaning. A breaking change is a new
//!   type name and a new service name, published beside the old one.
//! - A message is data: it is copied out of shared memory before it is looked at, and [`Message::check`] judges the copy.
//!
//! # A planner in ten lines
//!
//! ```no_run
//! use std::time::Duration;
//! use roomcast_ipc::{Domain, RoomScoresV1};
//!
//! let node = Domain::default_for_user()?.open("my-planner")?;
//! let scores = node.subscriber::<RoomScoresV1>()?;
//! loop {
//!     scores.wait(Duration::from_millis(500))?;
//!     let Some(snapshot) = scores.newest()? else { continue };
//!     for room in snapshot.rooms() {
//!         println!("{} {:.3}", room.id(), room.probability);
//!     }
//! }
//! # #[expect(unreachable_code)]
//! # Ok::<(), roomcast_ipc::IpcError>(())
//! ```

#[cfg(feature = "yardstick")]
pub mod bare;
pub mod clock;
mod domain;
mod error;
mod give_up;
pub mod limits;
mod message;
pub mod own_file;
mod port;
pub mod question;
pub mod sequence;
pub mod text;
mod unused;

pub use domain::{Domain, Node};
pub use error::{IpcError, MessageError};
pub use give_up::end_where_iceoryx2_panics;
pub use message::{
    ALL_PERSONS, ByteImage, DecisionV1, Field, ForecastV1, IncludedV1, ItemScoreV1, ItemScoresHeaderV1,
    LEARNED_SHARE_S, Layout, MAX_HORIZONS, MAX_ITEMS, MAX_PERSONS, MAX_ROOMS, MAX_SOURCES, Message, NAME_BYTES,
    NARRATION_TEXT_BYTES, NO_PARTITION, NOTE_TEXT_BYTES, NarrationV1, PersonForecastV1, PersonForecastsV1,
    PersonScoresV1, PersonV1, REASON_TEXT_BYTES, RobotReportV1, RoomScoresV1, RoomV1, ServiceQuality, StatusRequestV1,
    StatusResponseV1, action, decision_flags, forecast_flags, narration_kind, person_flags, presence, reached,
    report_flags, report_kind, score_flags,
};
pub use port::{
    Awaited, ItemScores, ItemScoresPublisher, ItemScoresSubscriber, Judged, Publisher, Sender, StatusClient,
    StatusServer, Subscriber, wait_for_any,
};
pub use question::{AnswerPort, QuestionPort};

/// The exact version of iceoryx2 that every participant of a domain must run, patch included.
pub const ICEORYX2_VERSION: &str = "0.10.0";
