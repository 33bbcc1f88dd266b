//! The sections of the configuration that belong to one process each.

use std::net::SocketAddr;
use std::path::PathBuf;

use roomcast_core::policy::PolicyName;

/// The section `[daemon]`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DaemonConfig {
    /// The state directory with the narration journal; without one, systemd's `$STATE_DIRECTORY`, and without that no journal.
    pub state: Option<PathBuf>,
    /// Most bytes of the journal on disk.
    pub journal_bytes: u64,
    /// Milliseconds between two syncs of the journal.
    pub journal_sync_ms: u64,
    /// Milliseconds between two heartbeats.
    pub heartbeat_ms: u64,
    /// Seconds without a step of the loop after which the daemon gives itself up, for systemd to restart it.
    pub hang_s: u64,
    /// What one source may send.
    pub intake: IntakeLimits,
}

impl Default for DaemonConfig {
    fn default() -> Self {
        Self {
            state: None,
            journal_bytes: 4 << 20,
            journal_sync_ms: 1000,
            heartbeat_ms: 250,
            hang_s: 60,
            intake: IntakeLimits::default(),
        }
    }
}

impl DaemonConfig {
    /// The state directory: the one that is configured, else systemd's.
    #[must_use]
    pub(crate) fn state_directory(&self) -> Option<PathBuf> {
        let given = || std::env::var_os("STATE_DIRECTORY").filter(|directory| !directory.is_empty());
        self.state.clone().or_else(|| given().map(PathBuf::from))
    }
}

/// What one source may send.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IntakeLimits {
    /// Narrations per second that one source may send over time; 0 for no limit.
    pub rate_per_s: f64,
    /// Narrations that it may send at once after a silence.
    pub burst: f64,
}

impl Default for IntakeLimits {
    fn default() -> Self {
        Self { rate_per_s: 1000.0, burst: 4096.0 }
    }
}

/// The section `[planner]`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlannerConfig {
    /// The robot's name; its number on the decision service follows from it.
    pub robot: String,
    /// The policy.
    pub policy: PolicyName,
    /// Seed of the policy's random choices.
    pub seed: u64,
    /// T_r: seconds that the robot must spend in every room; 0 decides again with every new score.
    pub room_time_s: f64,
    /// Seconds from the begin of a round to its deadline. When empty, two stays for each room, and a round that is done early ends.
    pub round_s: Option<f64>,
    /// Milliseconds after which scores that the daemon has not confirmed are not acted upon.
    pub deadline_ms: u64,
    /// Another round of all rooms follows. Otherwise rooms that are undone at the deadline are tried again, and the robot stays when
    /// every room is covered.
    pub repeat: bool,
}

impl Default for PlannerConfig {
    fn default() -> Self {
        Self {
            robot: "robot".to_owned(),
            policy: PolicyName::CoverageAware,
            seed: 1,
            room_time_s: 600.0,
            round_s: None,
            deadline_ms: 2000,
            repeat: true,
        }
    }
}

/// The section `[narrator]`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NarratorConfig {
    /// The source's name; its number follows from it, so it must differ between narrators.
    pub name: String,
    /// Seconds to wait at the end until the daemon has confirmed everything.
    pub linger_s: f64,
}

impl Default for NarratorConfig {
    fn default() -> Self {
        Self { name: "narrator".to_owned(), linger_s: 10.0 }
    }
}

/// The section `[metrics]`.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MetricsConfig {
    /// Where to serve them: a loopback address with a port. None: not at all.
    pub listen: Option<SocketAddr>,
}
