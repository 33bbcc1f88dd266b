//! The sections of the configuration for one process each.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;

use super::house::{OnlyWhen, QuietHours, RoomNeeds, WhileAsleep, is_room};
use roomcast_core::habits::HabitsOptions;
use roomcast_core::narration::history::PERSONS_MAX;
use roomcast_core::parsing::{keyed, list_of_keyed};
use roomcast_core::policy::PolicyName;
use roomcast_core::text::odd_name;

/// The section `[daemon]`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DaemonConfig {
    /// The state directory with the state database; by default systemd's `$STATE_DIRECTORY`, and without that no database. For a service,
    /// systemd's directory replaces a relative one in a file.
    pub state: Option<PathBuf>,
    /// About how many bytes the events in the state database have at most.
    pub journal_bytes: u64,
    /// Milliseconds between two syncs of the state database.
    pub journal_sync_ms: u64,
    /// Milliseconds between two heartbeats.
    pub heartbeat_ms: u64,
    /// Seconds without a step of the loop after which the daemon ends itself, so that systemd restarts it.
    pub hang_s: u64,
    /// Rate limits of one narrator.
    #[serde(deserialize_with = "keyed")]
    pub intake: IntakeLimits,
    /// Known narrators.
    #[serde(deserialize_with = "list_of_keyed")]
    pub narrator: Vec<KnownNarrator>,
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
            narrator: Vec::new(),
        }
    }
}

impl DaemonConfig {
    /// The configured state directory, else systemd's.
    #[must_use]
    pub fn state_directory(&self) -> Option<PathBuf> {
        self.state.clone().or_else(state_of_service)
    }
}

pub(super) fn state_of_service() -> Option<PathBuf> {
    std::env::var_os("STATE_DIRECTORY").filter(|directory| !directory.is_empty()).map(PathBuf::from)
}

/// Rate limits of one narrator, for all narrations of one port.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IntakeLimits {
    /// Narrations per second of one narrator over time; 0 for no limit.
    pub rate_per_s: f64,
    /// Narrations at once after a silence.
    pub burst: f64,
}

impl Default for IntakeLimits {
    fn default() -> Self {
        Self { rate_per_s: 1000.0, burst: 4096.0 }
    }
}

/// The events that a narrator may send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "Vec<Report>", into = "Vec<Report>")]
pub struct May {
    /// Actions.
    pub did: bool,
    /// Presence: events of the kind presence, and texts that are presence forms.
    pub presence: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Report {
    Did,
    Presence,
}

impl May {
    /// All events.
    pub const ALL: Self = Self { did: true, presence: true };
    /// Actions only: an unknown narrator, if the configuration names any.
    pub const DID: Self = Self { did: true, presence: false };
}

impl Default for May {
    fn default() -> Self {
        Self::ALL
    }
}

impl TryFrom<Vec<Report>> for May {
    type Error = &'static str;

    fn try_from(reports: Vec<Report>) -> Result<Self, Self::Error> {
        let has = |report| reports.contains(&report);
        let may = Self { did: has(Report::Did), presence: has(Report::Presence) };
        if reports.is_empty() { Err("give \"did\", \"presence\" or both") } else { Ok(may) }
    }
}

impl From<May> for Vec<Report> {
    fn from(may: May) -> Self {
        let reports = [(may.did, Report::Did), (may.presence, Report::Presence)];
        reports.into_iter().filter(|(may, _)| *may).map(|(_, report)| report).collect()
    }
}

/// An entry of `[[daemon.narrator]]`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownNarrator {
    /// The source's name.
    pub name: String,
    /// If memory is short, the records of narrators with less trust go first; 1 to 100, and 0 for unknown narrators.
    #[serde(default = "one")]
    pub trust: u32,
    /// The narrator's part of a person's window, relative to a narrator of share 1; 1 to 100.
    #[serde(default = "one")]
    pub share: u32,
    /// The events that it may send: `did`, `presence`, or both. If any narrator is named, unknown narrators may send `did` only.
    #[serde(default)]
    pub may: May,
    /// Replaces `daemon.intake.rate_per_s`.
    pub rate_per_s: Option<f64>,
    /// Its narration comes through `roomcast-zenoh`. When that restarts, the new port continues where the closed one stopped.
    #[serde(default)]
    pub relayed: bool,
}

fn one() -> u32 {
    1
}

/// The section `[persons]`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PersonsConfig {
    /// Residents, by name or number. All other persons are visitors. If empty, no person is a visitor.
    pub residents: Vec<String>,
    /// Names of pets, robots and devices. A plain sentence about one is about no person.
    pub not_persons: Vec<String>,
    /// Seconds of silence after which a visitor counts as gone.
    pub visitor_s: f64,
    /// Seconds of silence after which a person last seen on a bed is possibly asleep.
    pub asleep_s: f64,
    /// Seconds after an event of a known narrator in which unknown narrators' events about that person are ignored; 0 for none. Without
    /// known narrators, no events are ignored.
    pub guard_s: f64,
}

impl PersonsConfig {
    /// Warnings about the names of residents, and about `more`: words of mixed alphabets, and names that look alike.
    #[must_use]
    pub fn odd_names<'a>(&'a self, more: impl IntoIterator<Item = &'a str>) -> Vec<String> {
        let residents = || self.residents.iter().map(String::as_str);
        let odd = |(place, name): (usize, &str)| odd_name(name, residents().take(place));
        // The warning names the later one of two similar names. Each is compared with each, so the number is bounded.
        residents().take(PERSONS_MAX).chain(more.into_iter().take(PERSONS_MAX)).enumerate().filter_map(odd).collect()
    }
}

impl Default for PersonsConfig {
    fn default() -> Self {
        Self {
            residents: Vec::new(),
            not_persons: Vec::new(),
            visitor_s: 3.0 * 3600.0,
            asleep_s: 1200.0,
            guard_s: 600.0,
        }
    }
}

/// The section `[habits]`.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HabitsConfig {
    /// Whether the daemon learns habits. It uses known habits in either case.
    pub learn: bool,
    /// Days after which an observation has half its weight; 0 for never.
    pub half_life_days: f64,
    /// Least seconds between two writes of the habits. The daemon also writes them when it stops.
    pub save_s: f64,
    /// Share of moments, 0 to 1, when a person is in their room set.
    pub coverage: f64,
}

impl Default for HabitsConfig {
    fn default() -> Self {
        let HabitsOptions { learn, half_life_days, coverage, .. } = HabitsOptions::default();
        Self { learn, half_life_days, save_s: 300.0, coverage }
    }
}

impl HabitsConfig {
    /// The options for learning.
    #[must_use]
    pub fn options(&self) -> HabitsOptions {
        let Self { learn, half_life_days, coverage, .. } = *self;
        HabitsOptions { learn, half_life_days, coverage, ..HabitsOptions::default() }
    }
}

roomcast_core::choices! {
    /// The source of the robot's state for the planner.
    #[derive(Default)]
    pub enum Reports {
        /// The clock's until the robot first reports its work, then the robot's.
        #[default]
        Auto,
        /// The robot's alone.
        Always,
        /// The clock's alone; reports are not looked at.
        Never,
    }
}

roomcast_core::choices! {
    /// The planner's action if the round's deadline leaves no later time for a room that is probably occupied.
    #[derive(Default)]
    pub enum Forced {
        /// The robot goes in if the policy says so.
        Enter,
        /// The room is left to the next round.
        #[default]
        Skip,
    }
}

/// The section `[planner]`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlannerConfig {
    /// The robot's name. Its number on the decision service follows from the name.
    pub robot: String,
    /// The policy.
    pub policy: PolicyName,
    /// Seed of the policy's random choices.
    pub seed: u64,
    /// T_r: seconds that the robot must spend in every room. 0 decides again with every new score, which `roomcast robot` rejects.
    pub room_time_s: f64,
    /// Seconds from the start of a round to its deadline. By default two stays for each room, and a completed round ends early.
    pub round_s: Option<f64>,
    /// Milliseconds after which unconfirmed scores are stale for the planner.
    pub deadline_ms: u64,
    /// Another round of all rooms follows. Otherwise rooms that are undone at the deadline are tried again, and the robot stays when every
    /// room is covered.
    pub repeat: bool,
    /// The action if the deadline leaves no later time for a room that is probably occupied.
    pub forced: Forced,
    /// Rooms in a person's room set at any time of the stay are avoided. Without learned habits there are no sets.
    pub avoid_sets: bool,
    /// Whether rooms of other robots, present or on their way, are avoided.
    pub avoid_robots: bool,
    /// Longest wait of the planner, in seconds after its start or the daemon's, until each resident was observed.
    pub know_s: f64,
    /// Hours when the robot does not work.
    pub quiet: Vec<QuietHours>,
    /// The rooms in which the robot does not work while a person sleeps.
    pub while_asleep: WhileAsleep,
    /// The part of the house that must be empty before the robot works; by default the policy alone decides.
    pub only_when: Option<OnlyWhen>,
    /// Seconds for which it must stay empty.
    pub min_absence_s: f64,
    /// ... with this probability.
    pub min_absence_at: f64,
    /// The needs of rooms.
    #[serde(deserialize_with = "list_of_keyed")]
    pub room: Vec<RoomNeeds>,
    /// A person who comes into the robot's room ends its work there.
    pub interrupt: bool,
    /// The probability of people in a room, 0 to 1, that interrupts the robot, and that keeps it out under `forced = "skip"`.
    pub interrupt_at: f64,
    /// Seconds of that probability before the robot is interrupted.
    pub interrupt_after_s: f64,
    /// The robot returns to the room at this probability or less; less than `interrupt_at`.
    pub resume_at: f64,
    /// The source of the robot's state.
    pub reports: Reports,
    /// Seconds after the end of a stay and after the robot's last report until a reporting robot counts as silent.
    pub report_timeout_s: f64,
    /// A robot with a battery below this, 0 to 1, is not sent out.
    pub battery_low: f64,
    /// It is sent out again at this level or above, 0 to 1.
    pub battery_ready: f64,
    /// Seconds after the last report of a charging robot until it counts as charged.
    pub charge_timeout_s: f64,
}

impl PlannerConfig {
    /// Each room of quiet hours and needs, with its key.
    pub fn named_rooms(&mut self) -> impl Iterator<Item = (&'static str, &mut String)> {
        let quiet = self.quiet.iter_mut().flat_map(|hours| &mut hours.rooms).map(|room| ("planner.quiet", room));
        quiet.chain(self.room.iter_mut().map(|room| ("planner.room.id", &mut room.id)))
    }

    /// The needs of a room; `None` without an entry. An entry with the id counts before one with a name without its
    /// number; of two such entries, the one that excludes the room.
    #[must_use]
    pub fn needs_of(&self, id: &str) -> Option<&RoomNeeds> {
        let own = self.room.iter().rev().filter(|room| is_room(&room.id, id));
        own.max_by_key(|room| (room.id == id, room.exclude))
    }
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
            forced: Forced::default(),
            avoid_sets: false,
            avoid_robots: false,
            know_s: 3600.0,
            quiet: Vec::new(),
            while_asleep: WhileAsleep::default(),
            only_when: None,
            min_absence_s: 0.0,
            min_absence_at: 0.8,
            room: Vec::new(),
            interrupt: true,
            interrupt_at: 0.6,
            interrupt_after_s: 2.0,
            resume_at: 0.3,
            reports: Reports::default(),
            report_timeout_s: 120.0,
            battery_low: 0.15,
            battery_ready: 0.5,
            charge_timeout_s: 14_400.0,
        }
    }
}

/// The section `[narrator]`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NarratorConfig {
    /// The source's name. Its number follows from the name, so narrators need different names.
    pub name: String,
    /// Longest wait at the end for the daemon's confirmation, in seconds.
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
    /// A loopback address with a port. `None`: no metrics.
    pub listen: Option<SocketAddr>,
}

roomcast_core::choices! {
    /// The interface of a robot.
    #[derive(Default)]
    pub enum RobotKind {
        /// Valetudo's topics.
        #[default]
        Valetudo,
        /// A vacuum that Home Assistant has, by an automation.
        HomeAssistant,
    }
}

roomcast_core::choices! {
    /// The action of a working robot on a pause.
    #[derive(Default)]
    pub enum OnPause {
        /// It goes to its dock.
        #[default]
        Return,
        /// It stands still where it is.
        Pause,
        /// It goes on without an interruption.
        GoOn,
    }
}

/// The section `[robot]`: the robot that `roomcast robot` drives.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RobotConfig {
    /// The interface.
    pub kind: RobotKind,
    /// Valetudo's topic prefix and identifier, or Home Assistant's state topics of the vacuum.
    pub topic: String,
    /// A topic with the battery's level in percent, if the robot's own topics lack it.
    pub battery: Option<String>,
    /// If a vacuum of Home Assistant leaves its work with a battery at this level or less, 0 to 1, it has to charge and has not finished
    /// the room.
    pub recharge_at: f64,
    /// Whether the robot gets commands; otherwise they are only printed.
    pub obey: bool,
    /// The action on a pause.
    pub on_pause: OnPause,
    /// Seconds after which an ignored order is repeated. At the third time it has failed.
    pub start_s: f64,
    /// The shortest time in a room, in seconds: a robot that leaves sooner has not done it.
    pub least_s: f64,
    /// The longest time in a room, in seconds.
    pub most_s: f64,
    /// Segments by the ids of rooms, if names and numbers do not match.
    pub segments: BTreeMap<String, String>,
}

impl Default for RobotConfig {
    fn default() -> Self {
        Self {
            kind: RobotKind::default(),
            topic: "valetudo/robot".to_owned(),
            battery: None,
            recharge_at: 0.15,
            obey: false,
            on_pause: OnPause::default(),
            start_s: 20.0,
            least_s: 20.0,
            most_s: 7200.0,
            segments: BTreeMap::new(),
        }
    }
}

/// The section `[mqtt]`: the broker for all uses of MQTT.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MqttConfig {
    /// `mqtt://HOST[:PORT]`, or `mqtts://HOST[:PORT]` with `ca`. `None`: the command line names it.
    pub broker: Option<String>,
    /// A file with user name and password on one line each.
    pub credentials: Option<PathBuf>,
    /// A PEM file with the certificates that signed the broker's.
    pub ca: Option<PathBuf>,
    /// The rules of `roomcast narrate --mqtt`.
    pub rules: Option<PathBuf>,
}

/// The section `[bridge]`, for `roomcast publish mqtt`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BridgeConfig {
    /// The prefix of its topics.
    pub topic: String,
    /// The prefix of Home Assistant's discovery topics; empty for no discovery.
    pub discovery: String,
    /// Horizons of rooms and persons in seconds, in addition to now. Each takes the nearest horizon of the forecast.
    pub horizons_s: Vec<f64>,
    /// "Somebody soon" means within this many seconds.
    pub soon_s: f64,
    /// ... with this probability, more than 0.
    pub soon_at: f64,
    /// ... until the probability is below this, at most `soon_at`.
    pub soon_until: f64,
    /// Least seconds between two messages of a topic.
    pub interval_s: f64,
}

impl Default for BridgeConfig {
    fn default() -> Self {
        Self {
            topic: "roomcast".to_owned(),
            discovery: "homeassistant".to_owned(),
            horizons_s: vec![60.0, 600.0],
            soon_s: 300.0,
            soon_at: 0.5,
            soon_until: 0.4,
            interval_s: 2.0,
        }
    }
}
