//! Types of ids and times. Messages and files hold the plain numbers; readers and writers convert them.

use std::fmt;
use std::num::ParseIntError;
use std::ops::Add;
use std::str::FromStr;

/// A person's number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default, serde::Serialize, serde::Deserialize)]
#[serde(transparent)]
pub struct PersonId(pub u32);

impl PersonId {
    /// The number of an event without a person, and of scores of all persons together.
    pub const SOMEBODY: Self = Self(u32::MAX);
}

impl fmt::Display for PersonId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl FromStr for PersonId {
    type Err = ParseIntError;

    fn from_str(text: &str) -> Result<Self, ParseIntError> {
        text.parse().map(Self)
    }
}

/// The name of an event: its narrator, the narrator's start, and the event's number since that start.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct EventId {
    /// The narrator.
    pub source: u64,
    /// The random number of the narrator's process start.
    pub epoch: u64,
    /// The event's number since that start.
    pub sequence: u64,
}

impl EventId {
    /// The event of these numbers.
    #[must_use]
    pub const fn new(source: u64, epoch: u64, sequence: u64) -> Self {
        Self { source, epoch, sequence }
    }

    /// The narrator and its start.
    #[must_use]
    pub fn start(self) -> (u64, u64) {
        (self.source, self.epoch)
    }
}

/// Defines a point in time in nanoseconds.
macro_rules! clock {
    ($name:ident, $about:literal) => {
        #[doc = $about]
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default, serde::Serialize, serde::Deserialize,
        )]
        #[serde(transparent)]
        pub struct $name(pub u64);

        impl $name {
            /// Nanoseconds since an earlier time; 0 since a later one.
            #[must_use]
            pub const fn since(self, earlier: Self) -> u64 {
                self.0.saturating_sub(earlier.0)
            }

            /// So many nanoseconds later.
            #[must_use]
            pub const fn saturating_add(self, nanoseconds: u64) -> Self {
                Self(self.0.saturating_add(nanoseconds))
            }

            /// So many nanoseconds earlier.
            #[must_use]
            pub const fn saturating_sub(self, nanoseconds: u64) -> Self {
                Self(self.0.saturating_sub(nanoseconds))
            }

            /// As seconds.
            #[must_use]
            pub fn seconds(self) -> f64 {
                self.0 as f64 / 1e9
            }
        }

        impl Add<u64> for $name {
            type Output = Self;

            fn add(self, nanoseconds: u64) -> Self {
                self.saturating_add(nanoseconds)
            }
        }
    };
}

clock!(BootNs, "A time of the clock that begins at boot and never goes back; 0 for no time.");
clock!(UnixNs, "A time of the wall clock, since 1970; 0 for no time.");
