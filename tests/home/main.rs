//! Whole homes: one that is set up, well and with mistakes, and one that is lived in for a day and a night. Both mostly wait, so they are one
//! program, which runs them beside one another.

#![expect(clippy::unwrap_used, reason = "a panic in a test is the report")]

mod household;
#[cfg(feature = "home")]
#[expect(clippy::panic, reason = "as above")]
mod setup;
