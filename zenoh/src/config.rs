//! The configuration: `default.toml` is the manual, and tested against this file.

use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use roomcast_core::grounding::PartitionLevel;
use roomcast_core::parsing::{keyed, list_of_keyed, toml_says};
use roomcast_ipc::raw::NAME_BYTES;
use roomcast_ipc::{Domain, IpcError};
use roomcast_ros2::content::HORIZONS_S;
use serde::Deserialize;

/// The example file, which documents every key.
pub const MANUAL: &str = include_str!("default.toml");
/// Largest configuration in bytes.
pub const FILE_BYTES_MAX: u64 = 64 << 10;
/// Most narrators on other machines. Each has its own port, so that the daemon's rates and quotas hold for each. A service has eight ports.
pub const NARRATORS_MAX: usize = 4;
/// The narrator of strings from ROS 2.
pub const ROS2_NARRATOR: &str = "ros2";
/// Most robots of a hub.
pub const ROBOTS_MAX: usize = 16;

/// Why a configuration is refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The file is too long.
    #[error("{path} has more than {FILE_BYTES_MAX} bytes; is it a configuration?")]
    TooLong {
        /// The file.
        path: PathBuf,
    },
    /// The file is malformed or has an unknown key.
    #[error("{path}: {}\n`roomcast-zenoh config` prints every key", toml_says(.error))]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Position and fault. It is not the `source`, which would be printed a second time.
        error: Box<toml::de::Error>,
    },
    /// A value is not allowed.
    #[error("{}", shown(key, value, allowed))]
    Value {
        /// The key.
        key: &'static str,
        /// Its value.
        value: String,
        /// The allowed values.
        allowed: String,
    },
    /// The domain is invalid.
    #[error(transparent)]
    Domain(#[from] IpcError),
}

fn shown(key: &str, value: &str, allowed: &str) -> String {
    if value.is_empty() { format!("{key}: {allowed}") } else { format!("{key} = {value}: {allowed}") }
}

fn refuse<T>(key: &'static str, value: impl ToString, allowed: impl Into<String>) -> Result<T, ConfigError> {
    Err(ConfigError::Value { key, value: value.to_string(), allowed: allowed.into() })
}

/// The whole configuration.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The connection to the router.
    #[serde(deserialize_with = "keyed")]
    pub router: Router,
    /// The site.
    #[serde(deserialize_with = "keyed")]
    pub site: Site,
    /// The robot.
    #[serde(deserialize_with = "keyed")]
    pub robot: Robot,
    /// The domain of the robot's processes.
    #[serde(deserialize_with = "keyed")]
    pub ipc: Ipc,
    /// Topics that the robot publishes.
    #[serde(deserialize_with = "keyed")]
    pub tell: Tell,
    /// Sharing of habits.
    #[serde(deserialize_with = "keyed")]
    pub habits: Habits,
    /// Allowed questions.
    #[serde(deserialize_with = "keyed")]
    pub ask: Ask,
    /// Other robots of the site.
    #[serde(deserialize_with = "keyed")]
    pub peers: Peers,
    /// Narrators on other machines.
    #[serde(deserialize_with = "list_of_keyed")]
    pub narrator: Vec<Narrator>,
    /// ROS 2.
    #[serde(deserialize_with = "keyed")]
    pub ros2: Ros2,
    /// The hub.
    #[serde(deserialize_with = "keyed")]
    pub hub: Hub,
}

/// The connection to the router.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Router {
    /// `tls/HOST:PORT` or `tcp/HOST:PORT`.
    pub connect: String,
    /// PEM file of the certificate authority.
    pub ca: Option<PathBuf>,
    /// PEM file of this machine's certificate.
    pub certificate: Option<PathBuf>,
    /// PEM file of its key.
    pub key: Option<PathBuf>,
    /// Whether TCP without TLS may lead to another machine.
    pub insecure: bool,
}

/// The site.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Site {
    /// Its name in keys.
    pub name: String,
}

impl Default for Site {
    fn default() -> Self {
        Self { name: "home".to_owned() }
    }
}

/// The robot.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Robot {
    /// The planner's name for it.
    pub name: String,
    /// Its name in keys.
    pub key: Option<String>,
}

impl Default for Robot {
    fn default() -> Self {
        Self { name: "robot".to_owned(), key: None }
    }
}

impl Robot {
    /// Its name in keys.
    #[must_use]
    pub fn key(&self) -> &str {
        self.key.as_deref().unwrap_or(&self.name)
    }
}

/// The domain of the robot's processes.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ipc {
    /// The root path.
    pub root: Option<PathBuf>,
    /// The domain's name.
    pub domain: String,
}

impl Default for Ipc {
    fn default() -> Self {
        Self { root: None, domain: Domain::DEFAULT_NAME.to_owned() }
    }
}

/// Topics that the robot publishes.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tell {
    /// Room scores.
    pub scores: bool,
    /// The forecast of all persons together.
    pub forecast: bool,
    /// Each person's forecast and room sets.
    pub persons: bool,
    /// The planner's decisions.
    pub decision: bool,
    /// Seconds after which unchanged values are published again.
    pub repeat_s: f64,
}

impl Default for Tell {
    fn default() -> Self {
        Self { scores: true, forecast: true, persons: true, decision: true, repeat_s: 5.0 }
    }
}

/// Sharing of habits.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Habits {
    /// Whether counts of visits are published. Nothing else about habits ever is.
    pub share: bool,
}

/// Other robots of the site.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Peers {
    /// Whether the planner receives their messages.
    pub hear: bool,
}

/// Allowed questions.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ask {
    /// The snapshot behind the scores.
    pub moment: bool,
    /// Changes of the map.
    pub map_change: bool,
    /// Persons.
    pub person: bool,
}

/// A narrator on another machine.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Narrator {
    /// Its name.
    pub name: String,
    /// Events per second that reach the daemon in the long run.
    #[serde(default = "rate")]
    pub rate_per_s: f64,
    /// Whether its hub learns how the daemon understood each event.
    #[serde(default)]
    pub understood: bool,
}

fn rate() -> f64 {
    100.0
}

/// ROS 2.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ros2 {
    /// The endpoint of rmw_zenoh's router.
    pub connect: Option<String>,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// The prefix of its topics.
    pub prefix: String,
    /// Whether its strings are events.
    pub narration: bool,
    /// The frame of scene and map.
    pub frame: String,
    /// The robot's scene.
    pub scene: Option<PathBuf>,
    /// The level of a partition, as in `grounding.level`.
    pub level: PartitionLevel,
    /// A Nav2 map's YAML file.
    pub map: Option<PathBuf>,
    /// The height of the map's floor, if the scene has several storeys.
    pub floor_m: Option<f64>,
    /// Seconds ahead for which rooms and persons have topics. Now always has one.
    pub horizons_s: Vec<f64>,
    /// A mask shows the likeliest time within this many seconds.
    pub horizon_s: f64,
    /// Least seconds between two masks.
    pub mask_s: f64,
}

impl Default for Ros2 {
    fn default() -> Self {
        Self {
            connect: None,
            domain: 0,
            prefix: "/roomcast".to_owned(),
            narration: false,
            frame: "map".to_owned(),
            scene: None,
            level: PartitionLevel::Room,
            map: None,
            floor_m: None,
            horizons_s: HORIZONS_S.to_vec(),
            horizon_s: 300.0,
            mask_s: 5.0,
        }
    }
}

impl Ros2 {
    /// The connection to its router.
    #[must_use]
    pub fn router(&self) -> Option<Router> {
        self.connect.clone().map(|connect| Router { connect, ..Router::default() })
    }

    fn check(&self) -> Result<(), ConfigError> {
        if let Some(Router { connect, .. }) = self.router() {
            let here = connect.strip_prefix("tcp/").and_then(|address| address.rsplit_once(':'));
            if !here.is_some_and(|(host, _)| is_this_machine(host)) {
                return refuse(
                    "ros2.connect",
                    connect,
                    "give tcp/localhost:PORT, because ROS 2's router is on the robot itself",
                );
            }
            Router { connect, ..Router::default() }.check("ros2.connect")?;
        }
        let part = |part: &str| {
            part.starts_with(|first: char| first.is_ascii_lowercase())
                && part.bytes().all(|byte| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'_')
        };
        let name = self.prefix.strip_prefix('/').unwrap_or_default();
        if name.len() > NAME_BYTES || !name.split('/').all(part) {
            return refuse(
                "ros2.prefix",
                &self.prefix,
                "a ROS 2 name: a slash, then a to z, 0 to 9 and _, such as /roomcast",
            );
        }
        if self.domain > 232 {
            return refuse("ros2.domain", self.domain, "0 to 232");
        }
        for (key, seconds) in [("ros2.horizon_s", self.horizon_s), ("ros2.mask_s", self.mask_s)] {
            if !(0.1..=86_400.0).contains(&seconds) {
                return refuse(key, seconds, "0.1 to 86400");
            }
        }
        let rises = self.horizons_s.windows(2).all(|pair| pair[0] < pair[1]);
        if self.horizons_s.len() > 8 || !rises || !self.horizons_s.iter().all(|at| (1.0..=86_400.0).contains(at)) {
            let allowed = "at most 8 times of 1 to 86400 s, rising";
            return refuse("ros2.horizons_s", format!("{:?}", self.horizons_s), allowed);
        }
        if let Some(floor_m) = self.floor_m.filter(|floor_m| !floor_m.is_finite()) {
            return refuse("ros2.floor_m", floor_m, "a height in metres");
        }
        for (key, is_set) in
            [("ros2.narration", self.narration), ("ros2.scene", self.scene.is_some()), ("ros2.map", self.map.is_some())]
        {
            if is_set && self.connect.is_none() {
                return refuse(
                    key,
                    "",
                    "without ros2.connect nothing is heard of ROS 2 or said to it: give it, or leave this out",
                );
            }
        }
        if self.map.is_some() && self.scene.is_none() {
            return refuse("ros2.map", "", "the mask needs ros2.scene, which says where rooms are");
        }
        Ok(())
    }
}

/// The hub.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Hub {
    /// The narrator's name.
    pub name: String,
    /// Names of robots, as in keys.
    pub robots: Vec<String>,
    /// The folder of unconfirmed narration.
    pub spool: PathBuf,
    /// Most narrations in it.
    pub keep: usize,
}

impl Default for Hub {
    fn default() -> Self {
        Self { name: String::new(), robots: Vec::new(), spool: PathBuf::new(), keep: 10_000 }
    }
}

/// Reads one byte more than allowed, which shows that a file is too long. A device has no length and no end.
fn read_start(path: &Path) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    fs::File::open(path)?.take(FILE_BYTES_MAX + 1).read_to_end(&mut bytes)?;
    Ok(bytes)
}

fn is_this_machine(host: &str) -> bool {
    matches!(host, "localhost" | "127.0.0.1" | "[::1]")
}

fn is_chunk(name: &str) -> bool {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_';
    !name.is_empty() && name.len() <= NAME_BYTES && name.bytes().all(plain)
}

const CHUNK: &str = "a name in keys has letters, digits, \"-\" and \"_\" alone, 1 to 48 of them";

impl Config {
    /// Reads a file.
    ///
    /// # Errors
    ///
    /// [`ConfigError`] with the key, what it has, and what can be there.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let read = |source| ConfigError::Read { path: path.to_owned(), source };
        let bytes = read_start(path).map_err(read)?;
        if bytes.len() as u64 > FILE_BYTES_MAX {
            return Err(ConfigError::TooLong { path: path.to_owned() });
        }
        let text = String::from_utf8(bytes).map_err(|error| read(io::Error::new(io::ErrorKind::InvalidData, error)))?;
        let mut config: Self = toml::from_str(&text)
            .map_err(|error| ConfigError::Malformed { path: path.to_owned(), error: Box::new(error) })?;
        // The parent of a bare file name is an empty path, but a domain's root must be absolute.
        let file = std::path::absolute(path).map_err(read)?;
        config.begin_at(file.parent().unwrap_or(Path::new("/")));
        Ok(config)
    }

    /// Resolves relative paths against this folder.
    fn begin_at(&mut self, folder: &Path) {
        let Self { router, ipc, ros2, hub, .. } = self;
        let files = [&mut router.ca, &mut router.certificate, &mut router.key, &mut ipc.root];
        for file in files.into_iter().chain([&mut ros2.scene, &mut ros2.map]).flatten() {
            *file = folder.join(&*file);
        }
        if !hub.spool.as_os_str().is_empty() {
            hub.spool = folder.join(&hub.spool);
        }
    }

    fn check(&self) -> Result<(), ConfigError> {
        self.router.check("router.connect")?;
        if !is_chunk(&self.site.name) {
            return refuse("site.name", &self.site.name, CHUNK);
        }
        Ok(())
    }

    /// Checks the configuration for `watch`.
    ///
    /// # Errors
    ///
    /// [`ConfigError::Value`].
    pub fn check_watch(&self) -> Result<(), ConfigError> {
        self.check()
    }

    /// Checks the configuration for a robot's bridge.
    ///
    /// # Errors
    ///
    /// [`ConfigError::Value`].
    pub fn check_robot(&self) -> Result<(), ConfigError> {
        // A robot may connect to ROS 2 alone.
        if self.ros2.connect.is_none() || !self.router.connect.is_empty() {
            self.check()?;
        }
        self.ros2.check()?;
        // Other robots know it by its name in keys, and its planner compares these names with its own.
        if self.peers.hear && !is_chunk(&self.robot.name) {
            let remedy =
                "with peers.hear it is the robot's name in keys, too: give it another, and planner.robot the same";
            return refuse("robot.name", &self.robot.name, format!("{CHUNK}; {remedy}"));
        }
        if self.peers.hear && self.robot.key() != self.robot.name {
            let remedy = "with peers.hear the robot has one name, in keys and in its planner: leave robot.key out";
            return refuse("robot.key", self.robot.key(), remedy);
        }
        if !is_chunk(self.robot.key()) {
            return refuse("robot.key", self.robot.key(), format!("{CHUNK}; give robot.key beside robot.name"));
        }
        if self.narrator.len() > NARRATORS_MAX {
            return refuse("narrator", self.narrator.len(), format!("at most {NARRATORS_MAX} narrators"));
        }
        for (index, narrator) in self.narrator.iter().enumerate() {
            if !is_chunk(&narrator.name) {
                return refuse("narrator.name", &narrator.name, CHUNK);
            }
            if self.narrator.iter().take(index).any(|other| other.name == narrator.name) {
                return refuse("narrator.name", &narrator.name, "it is there twice");
            }
            if self.ros2.narration && narrator.name == ROS2_NARRATOR {
                return refuse("narrator.name", &narrator.name, "with ros2.narration this is the name of ROS 2's own");
            }
            if !(0.1..=100_000.0).contains(&narrator.rate_per_s) {
                return refuse("narrator.rate_per_s", narrator.rate_per_s, "0.1 to 100000");
            }
        }
        if !(1.0..=3600.0).contains(&self.tell.repeat_s) {
            return refuse("tell.repeat_s", self.tell.repeat_s, "1 to 3600");
        }
        Ok(())
    }

    /// Checks the configuration for a hub.
    ///
    /// # Errors
    ///
    /// [`ConfigError::Value`].
    pub fn check_hub(&self) -> Result<(), ConfigError> {
        self.check()?;
        let Hub { name, robots, spool, keep } = &self.hub;
        if !is_chunk(name) {
            return refuse("hub.name", name, CHUNK);
        }
        if robots.is_empty() || robots.len() > ROBOTS_MAX {
            return refuse("hub.robots", robots.len(), format!("1 to {ROBOTS_MAX} robots"));
        }
        for (index, robot) in robots.iter().enumerate() {
            if !is_chunk(robot) {
                return refuse("hub.robots", robot, CHUNK);
            }
            if robots.iter().take(index).any(|other| other == robot) {
                return refuse("hub.robots", robot, "it is there twice");
            }
        }
        if spool.as_os_str().is_empty() {
            return refuse("hub.spool", "", "a folder that this program may write");
        }
        if !(100..=1_000_000).contains(keep) {
            return refuse("hub.keep", keep, "100 to 1000000");
        }
        Ok(())
    }

    /// The robot's domain.
    ///
    /// # Errors
    ///
    /// [`ConfigError::Domain`].
    pub fn domain(&self) -> Result<Domain, ConfigError> {
        let root = self.ipc.root.clone().unwrap_or_else(Domain::default_root);
        Ok(Domain::new(root, &self.ipc.domain)?)
    }
}

impl Router {
    fn check(&self, name: &'static str) -> Result<(), ConfigError> {
        let Self { connect, ca, certificate, key, insecure } = self;
        let Some((protocol @ ("tcp" | "tls"), address)) = connect.split_once('/') else {
            return refuse(name, connect, "tls/HOST:PORT or tcp/HOST:PORT; `roomcast-zenoh config` shows one");
        };
        let Some((host, port)) = address.rsplit_once(':') else {
            return refuse(name, connect, "the port is missing; zenoh's own is 7447");
        };
        let digits = port.bytes().all(|byte| byte.is_ascii_digit());
        let is_port = digits && port.parse::<u16>().is_ok_and(|port| port > 0);
        if host.is_empty() || !is_port || address.contains(['#', '?', ';', '/']) {
            return refuse(name, connect, "tls/HOST:PORT or tcp/HOST:PORT and nothing else");
        }
        if protocol == "tls" {
            for (key, file) in [("router.ca", ca), ("router.certificate", certificate), ("router.key", key)] {
                match file {
                    None => return refuse(key, "", "tls needs ca, certificate and key; docs/fleet.md makes them"),
                    Some(file) => {
                        let wanted =
                            if key == "router.key" { "PRIVATE KEY-----" } else { "-----BEGIN CERTIFICATE-----" };
                        match read_start(file) {
                            Err(error) => {
                                return refuse(key, file.display(), format!("the file cannot be read: {error}"));
                            }
                            Ok(bytes) if !String::from_utf8_lossy(&bytes).contains(wanted) => {
                                return refuse(key, file.display(), format!("a PEM file with {wanted:?} in it"));
                            }
                            Ok(_) => {}
                        }
                    }
                }
            }
        } else if !insecure && !is_this_machine(host) {
            return refuse(
                name,
                connect,
                "tcp is for a router on this machine; use tls, or set router.insecure = true",
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_manual_is_the_default() {
        assert_eq!(toml::from_str::<Config>(MANUAL).unwrap(), Config::default());
        // Keys that are commented out are checked too.
        let all: String = MANUAL
            .lines()
            .map(|line| match line.strip_prefix("# ") {
                Some(rest)
                    if (rest.starts_with('[') && rest.ends_with(']'))
                        || rest.split_once(" = ").is_some_and(|(key, _)| !key.contains(' ')) =>
                {
                    format!("{rest}\n")
                }
                _ => format!("{line}\n"),
            })
            .collect();
        let config: Config = toml::from_str(&all).unwrap();
        assert_eq!((config.narrator.len(), config.hub.robots.len()), (1, 1));
        assert_eq!(config.narrator[0].rate_per_s, rate());
    }

    #[test]
    fn relative_paths_begin_at_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("zenoh.toml");
        let text =
            "[router]\nconnect='tls/far:7447'\nca='ca.pem'\ncertificate='/c.pem'\nkey='k.key'\n[hub]\nspool='spool'";
        fs::write(&file, text).unwrap();
        let config = Config::load(&file).unwrap();
        assert_eq!(
            (config.router.ca, config.router.certificate),
            (Some(folder.path().join("ca.pem")), Some("/c.pem".into()))
        );
        assert_eq!((config.hub.spool, config.ros2.map), (folder.path().join("spool"), None));
        fs::write(folder.path().join("ca.pem"), "[router]").unwrap();
        let fault = Config::load(&file).unwrap().check_watch().unwrap_err().to_string();
        assert!(fault.starts_with("router.ca = ") && fault.contains("PEM"), "{fault}");
    }

    /// Regression: the root was joined to an empty folder and refused as a relative path.
    #[test]
    fn relative_paths_of_a_file_that_is_named_relatively_are_absolute() {
        let folder = tempfile::tempdir().unwrap();
        let up: PathBuf = std::env::current_dir().unwrap().components().skip(1).map(|_| "..").collect();
        let file = up.join(folder.path().strip_prefix("/").unwrap()).join("zenoh.toml");
        assert!(file.is_relative());
        fs::write(&file, "[ipc]\nroot='d'\n[hub]\nspool='spool'").unwrap();
        let config = Config::load(&file).unwrap();
        assert!(config.ipc.root.is_some_and(|root| root.is_absolute()) && config.hub.spool.is_absolute());
    }

    #[test]
    fn no_more_is_read_than_a_configuration_may_have() {
        for endless in ["/dev/zero", "/dev/full"] {
            let fault = Config::load(Path::new(endless)).unwrap_err().to_string();
            assert!(fault.contains("has more than 65536 bytes"), "{fault}");
            assert_eq!(read_start(Path::new(endless)).unwrap().len() as u64, FILE_BYTES_MAX + 1);
        }
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("zenoh.toml");
        let of = |bytes: u64| {
            fs::write(&file, "#".repeat(usize::try_from(bytes).unwrap())).unwrap();
            Config::load(&file)
        };
        assert!(of(FILE_BYTES_MAX).is_ok());
        assert!(matches!(of(FILE_BYTES_MAX + 1), Err(ConfigError::TooLong { .. })));
        fs::write(&file, b"\xff").unwrap();
        assert!(matches!(Config::load(&file), Err(ConfigError::Read { .. })));
    }

    #[test]
    fn what_cannot_be_is_refused_with_its_key() {
        let fault = |text: &str| {
            let config: Config = toml::from_str(text).unwrap();
            config.check_robot().unwrap_err().to_string()
        };
        assert!(fault("").starts_with("router.connect"));
        assert!(fault("[router]\nconnect='tls/far:7447'").starts_with("router.ca"));
        assert!(fault("[router]\nconnect='tcp/far:7447'").contains("insecure"));
        assert!(fault("[router]\nconnect='udp/far:7447'").starts_with("router.connect"));
        assert!(fault("[router]\nconnect='tcp/localhost:7447#x=1'").starts_with("router.connect"));
        let near = "[router]\nconnect='tcp/localhost:7447'\n";
        for address in ["tcp/localhost:0", "tcp/localhost:+1", "tcp/localhost:70000", "tcp/:1"] {
            assert!(fault(&format!("[router]\nconnect='{address}'")).starts_with("router.connect"), "{address}");
        }
        for address in ["tcp/far:7447", "tls/localhost:7447", "tcp/localhost", "tcp/localhost:0", "localhost:7447"] {
            assert!(fault(&format!("[ros2]\nconnect='{address}'")).starts_with("ros2.connect"), "{address}");
        }
        assert!(fault(&format!("{near}[robot]\nname='my robot'")).contains("robot.key"));
        assert!(fault(&format!("{near}[site]\nname='a/**'")).starts_with("site.name"));
        // No remedy may lead to the next error.
        let hears = |robot: &str| fault(&format!("{near}[peers]\nhear=true\n[robot]\n{robot}"));
        for robot in ["name='Küche'", "name='Küche'\nkey='kitchen'"] {
            let fault = hears(robot);
            assert!(fault.starts_with("robot.name") && !fault.contains("robot.key"), "{fault}");
        }
        assert!(hears("name='kitchen'\nkey='k'").contains("leave robot.key out"));
        for key in ["narration=true", "scene='scene.json'", "scene='scene.json'\nmap='map.yaml'"] {
            let fault = fault(&format!("{near}[ros2]\n{key}"));
            assert!(fault.starts_with("ros2.") && fault.contains("without ros2.connect"), "{fault}");
        }
        assert!(fault(&format!("{near}[[narrator]]\nname='a'\n[[narrator]]\nname='a'")).contains("twice"));
        let own =
            fault(&format!("{near}[ros2]\nconnect='tcp/localhost:7447'\nnarration=true\n[[narrator]]\nname='ros2'"));
        assert!(own.starts_with("narrator.name"), "{own}");
        assert!(toml::from_str::<Config>("[router]\nconect='x'").is_err());
        let good: Config = toml::from_str(near).unwrap();
        good.check_robot().unwrap();
        assert!(good.check_hub().unwrap_err().to_string().starts_with("hub.name"));
        let twice = format!("{near}[hub]\nname='a'\nrobots=['b','b']\nspool='c'");
        let twice: Config = toml::from_str(&twice).unwrap();
        assert!(twice.check_hub().unwrap_err().to_string().contains("twice"));
    }
}
