//! The sections of the configuration that belong to one process each.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;

use super::house::{OnlyWhen, QuietHours, RoomNeeds, WhileAsleep, is_room};
use roomcast_core::habits::{HabitsOptions, SetOptions};
use roomcast_core::narration::history::PERSONS_MAX;
use roomcast_core::parsing::{keyed, list_of_keyed};
use roomcast_core::policy::PolicyName;
use roomcast_core::text::odd_name;

/// The section `[daemon]`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DaemonConfig {
    /// The state directory with the state database; without one, systemd's `$STATE_DIRECTORY`, and without that no database. In a file a relative
    /// one gives way to systemd's.
    pub state: Option<PathBuf>,
    /// About how many bytes the events in the state database have at most.
    pub journal_bytes: u64,
    /// Milliseconds between two syncs of the state database.
    pub journal_sync_ms: u64,
    /// Milliseconds between two heartbeats.
    pub heartbeat_ms: u64,
    /// Seconds without a step of the loop after which the daemon gives itself up, for systemd to restart it.
    pub hang_s: u64,
    /// What one narrator may send.
    #[serde(deserialize_with = "keyed")]
    pub intake: IntakeLimits,
    /// Narrators that are known by name.
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
    /// The state directory: the one that is configured, else systemd's.
    #[must_use]
    pub fn state_directory(&self) -> Option<PathBuf> {
        self.state.clone().or_else(state_of_service)
    }
}

/// The state directory that systemd gives a service.
pub(super) fn state_of_service() -> Option<PathBuf> {
    std::env::var_os("STATE_DIRECTORY").filter(|directory| !directory.is_empty()).map(PathBuf::from)
}

/// What one narrator may send: everything that comes by one port.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IntakeLimits {
    /// Narrations per second that one narrator may send over time; 0 for no limit.
    pub rate_per_s: f64,
    /// Narrations that it may send at once after a silence.
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

/// A word of `may`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Report {
    Did,
    Presence,
}

impl May {
    /// All events.
    pub const ALL: Self = Self { did: true, presence: true };
    /// Actions only: a narrator that the configuration does not name, if it names any.
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
    /// Where places are short, what is remembered of less trusted ones goes first; 1 to 100, and 0 for whoever is not named.
    #[serde(default = "one")]
    pub trust: u32,
    /// Places in a person's window that it keeps for each one of a narrator of share 1, 1 to 100.
    #[serde(default = "one")]
    pub share: u32,
    /// The events that it may send: `did`, `presence`, or both. A narrator that is not named may send `did` only, if any narrator is named.
    #[serde(default)]
    pub may: May,
    /// In place of `daemon.intake.rate_per_s`.
    pub rate_per_s: Option<f64>,
    /// Its narration comes through `roomcast-zenoh`: when that starts again, its port goes on where the closed one was.
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
    /// Who lives in the house, by name or by number; everybody else is a visitor. When empty, nobody is a visitor.
    pub residents: Vec<String>,
    /// Names of pets, robots and devices: a plain sentence about one is about nobody.
    pub not_persons: Vec<String>,
    /// Seconds of silence after which a visitor counts as gone.
    pub visitor_s: f64,
    /// Seconds of silence after which whoever was last on a bed is possibly asleep.
    pub asleep_s: f64,
    /// For so many seconds after a narrator that the configuration names has told of a person, nobody else is heard of that person; 0: everybody
    /// is heard of everybody. Where it names none, everybody is heard of everybody, too.
    pub guard_s: f64,
}

impl PersonsConfig {
    /// Warnings about the names of residents, and about these: words of mixed alphabets, and names that look alike.
    #[must_use]
    pub fn odd_names<'a>(&'a self, more: impl IntoIterator<Item = &'a str>) -> Vec<String> {
        let residents = || self.residents.iter().map(String::as_str);
        let odd = |(place, name): (usize, &str)| odd_name(name, residents().take(place));
        // The warning names the later one of two names that look alike. Each is compared with each, so the number is bounded.
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
    /// Whether the daemon learns what the people of the home do; what it knows already is used either way.
    pub learn: bool,
    /// Days after which what was seen counts half; 0 for never.
    pub half_life_days: f64,
    /// Seconds between two writes of what was learned, at least; it is also written when the daemon is stopped.
    pub save_s: f64,
    /// Share of moments, 0 to 1, in which a person is to be in their room set.
    pub coverage: f64,
}

impl Default for HabitsConfig {
    fn default() -> Self {
        let HabitsOptions { learn, half_life_days, sets, .. } = HabitsOptions::default();
        Self { learn, half_life_days, save_s: 300.0, coverage: sets.coverage }
    }
}

impl HabitsConfig {
    /// The options for learning.
    #[must_use]
    pub fn options(&self) -> HabitsOptions {
        let default = HabitsOptions::default();
        let sets = SetOptions { coverage: self.coverage, ..default.sets };
        HabitsOptions { learn: self.learn, half_life_days: self.half_life_days, sets, ..default }
    }
}

roomcast_core::choices! {
    /// Whose word the planner takes for what the robot has done.
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
    /// What the planner does where the round's deadline leaves no later time for a room that somebody is likely in.
    #[derive(Default)]
    pub enum Forced {
        /// The robot goes in where the policy says so.
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
    /// The robot's name; its number on the decision service follows from it.
    pub robot: String,
    /// The policy.
    pub policy: PolicyName,
    /// Seed of the policy's random choices.
    pub seed: u64,
    /// T_r: seconds that the robot must spend in every room; 0 decides again with every new score, which `roomcast robot` refuses.
    pub room_time_s: f64,
    /// Seconds from the begin of a round to its deadline. When empty, two stays for each room, and a round that is done early ends.
    pub round_s: Option<f64>,
    /// Milliseconds after which scores that the daemon has not confirmed are not acted upon.
    pub deadline_ms: u64,
    /// Another round of all rooms follows. Otherwise rooms that are undone at the deadline are tried again, and the robot stays when
    /// every room is covered.
    pub repeat: bool,
    /// What the planner does where the deadline leaves no later time for a room that somebody is likely in.
    pub forced: Forced,
    /// No room is entered that is in the room set of a person at any time of the stay. Where nothing was learned there are no sets.
    pub avoid_sets: bool,
    /// Whether rooms that other robots are in or on their way to are not entered.
    pub avoid_robots: bool,
    /// Seconds that the planner waits at most, after a start of it or the daemon, until each resident was observed.
    pub know_s: f64,
    /// Hours in which the robot does not work.
    pub quiet: Vec<QuietHours>,
    /// The rooms in which the robot does not work while a person sleeps.
    pub while_asleep: WhileAsleep,
    /// What must be empty before the robot works; without it, the policy weighs alone.
    pub only_when: Option<OnlyWhen>,
    /// Seconds for which it must stay empty.
    pub min_absence_s: f64,
    /// ... with this probability.
    pub min_absence_at: f64,
    /// What rooms need.
    #[serde(deserialize_with = "list_of_keyed")]
    pub room: Vec<RoomNeeds>,
    /// A person who comes into the robot's room ends its work there.
    pub interrupt: bool,
    /// How likely somebody must be in a room, 0 to 1, to interrupt the robot; and to keep it out under `forced = "skip"`.
    pub interrupt_at: f64,
    /// Seconds for which that must hold before the robot is interrupted.
    pub interrupt_after_s: f64,
    /// The room is entered again when somebody is there with at most this probability; less than `interrupt_at`.
    pub resume_at: f64,
    /// Whose word is taken for what the robot has done.
    pub reports: Reports,
    /// Seconds after the end of a stay and after the robot's last report from which a robot that reports counts as silent.
    pub report_timeout_s: f64,
    /// A robot whose battery is below this, 0 to 1, is not sent out.
    pub battery_low: f64,
    /// It is sent out again when the battery is at this or above, 0 to 1.
    pub battery_ready: f64,
    /// Seconds after the last report of a robot that charges from which it counts as charged.
    pub charge_timeout_s: f64,
}

impl PlannerConfig {
    /// What a room needs; none for a room without an entry.
    #[must_use]
    pub fn needs_of(&self, id: &str) -> Option<&RoomNeeds> {
        let exact = self.room.iter().find(|room| room.id == id);
        exact.or_else(|| self.room.iter().find(|room| is_room(&room.id, id)))
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

roomcast_core::choices! {
    /// How a robot speaks.
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
    /// What a robot at work does when it is to pause.
    #[derive(Default)]
    pub enum OnPause {
        /// It goes to its dock.
        #[default]
        Return,
        /// It stands still where it is.
        Pause,
        /// It goes on: nobody is to interrupt it.
        GoOn,
    }
}

/// The section `[robot]`: what `roomcast robot` drives.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RobotConfig {
    /// How it speaks.
    pub kind: RobotKind,
    /// Where it speaks: Valetudo's topic prefix and identifier, or Home Assistant's state topics of the vacuum.
    pub topic: String,
    /// A topic that says how full its battery is, in percent, where the robot's own ones do not.
    pub battery: Option<String>,
    /// A battery of this or less, 0 to 1, says that a vacuum of Home Assistant that leaves its work has to charge and has not done the room.
    pub recharge_at: f64,
    /// Whether it is told anything; otherwise what it would be told is only printed.
    pub obey: bool,
    /// What it does when it is to pause.
    pub on_pause: OnPause,
    /// Seconds after which an order that the robot does not follow is given again; the third time it has failed.
    pub start_s: f64,
    /// How long a robot is at a room at least, in seconds: one that leaves sooner has not done it.
    pub least_s: f64,
    /// Seconds that the robot may take for a room.
    pub most_s: f64,
    /// Segments by the ids of rooms, where names and numbers do not tell.
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

/// The section `[mqtt]`: the broker that everything meets at which speaks MQTT.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MqttConfig {
    /// `mqtt://HOST[:PORT]`, or `mqtts://HOST[:PORT]` with `ca`. None: the command line says it.
    pub broker: Option<String>,
    /// A file with user name and password, a line each.
    pub credentials: Option<PathBuf>,
    /// A PEM file with the certificates that the broker's is signed by.
    pub ca: Option<PathBuf>,
    /// The rules by which `roomcast narrate --mqtt` makes narration of messages.
    pub rules: Option<PathBuf>,
}

/// The section `[bridge]`: what `roomcast publish mqtt` publishes.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BridgeConfig {
    /// What its topics begin with.
    pub topic: String,
    /// What Home Assistant's discovery topics begin with; empty for no discovery.
    pub discovery: String,
    /// Seconds ahead that rooms and persons are told of, beside now: each takes the nearest horizon of the forecast.
    pub horizons_s: Vec<f64>,
    /// "Somebody soon" means within so many seconds.
    pub soon_s: f64,
    /// ... with this probability, more than 0.
    pub soon_at: f64,
    /// ... until the probability is below this, at most `soon_at`.
    pub soon_until: f64,
    /// Seconds between two messages of a topic, at least.
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
