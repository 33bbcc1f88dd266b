//! The driver's process: its ports, the broker and the clock.

use std::time::{Duration, Instant};

use roomcast_ipc::raw::{DecisionV1, RobotReportV1, RoomScoresV1};
use roomcast_ipc::{Domain, IpcError, MessageError, Publisher, Subscriber, sequence};
use sd_notify::NotifyState;

use super::dialect::{Dialect, Order};
use super::driver::{Act, Driver};
use crate::clock;
use crate::config::{Config, RobotKind};
use crate::logging::Limiter;
use crate::mqtt::link::Link;
use crate::mqtt::{Broker, MqttError, shown};
use crate::notify::{Watchdog, notify};
use crate::participant::{DRIVER, join};
use crate::reporter::{Report, Reporter};
use crate::stop::Stop;

const TICK: Duration = Duration::from_millis(50);
/// The time that a broker may store a command for an absent robot: a late command would be wrong.
const ORDER_S: u32 = 10;
/// The longest turn of the connection's thread before this process stops reporting that it is alive.
const TURN_MAX_NS: u64 = 5_000_000_000;
/// The time for the robot's first message before the log says that it is silent; and then for its segments, before the log names rooms that
/// it cannot do.
const SETTLING: Duration = Duration::from_secs(5);
const QUIET_NS: u64 = 5_000_000_000;
/// Reports at once, and then one in this time: a battery may change with every message.
const REPORTS_AT_ONCE: u64 = 16;

/// A robot cannot be driven.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DriveError {
    /// A service failed.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// The broker failed.
    #[error(transparent)]
    Mqtt(#[from] MqttError),
    /// The robot's name is not allowed.
    #[error("planner.robot cannot be a robot's name: {0}")]
    Name(#[from] MessageError),
    /// The planner would call the robot away with every new score.
    #[error(
        "planner.room_time_s is 0: the planner decides with every new score, which calls the robot away before it has done a room; give about the seconds that a room takes"
    )]
    NoStay,
    /// The output cannot be written.
    #[error("failed to write to standard output: {0}; check where it leads")]
    Print(std::io::Error),
}

/// The handling of commands.
pub enum Way<'a> {
    /// The robot gets them.
    Obey,
    /// They are only shown: topic and message.
    Show(&'a mut dyn FnMut(&str, &str) -> std::io::Result<()>),
}

struct RobotLink<'a> {
    dialect: Dialect,
    link: Link,
    reporter: Reporter,
    reports: Publisher<RobotReportV1>,
    way: Way<'a>,
    log: Limiter,
    log_reports: Limiter,
}

impl RobotLink<'_> {
    fn act(&mut self, acts: Vec<Act>) -> Result<(), DriveError> {
        acts.into_iter().try_for_each(|act| match act {
            Act::Order(order) => self.order(&order),
            Act::Report(report) => self.report(&report),
        })
    }

    fn order(&mut self, order: &Order) -> Result<(), DriveError> {
        let (topic, payload) = self.dialect.order(order);
        if let Way::Show(show) = &mut self.way {
            return show(&topic, &payload).map_err(DriveError::Print);
        }
        // A rejected command is repeated later.
        let said = self.link.say(&topic, &payload, false, Some(ORDER_S));
        tracing::info!(?order, said, "order to the robot");
        Ok(())
    }

    fn report(&mut self, report: &Report) -> Result<(), DriveError> {
        if let Some(not_told) = self.log_reports.pass(clock::monotonic_ns()) {
            tracing::info!(kind = %report.kind, room = report.room, battery = report.battery, note = report.note, not_told, "report of the robot");
        }
        match self.reporter.message(report, clock::monotonic_ns(), clock::unix_ns()) {
            Ok(message) => {
                self.reports.send(&message)?;
            }
            Err(error) => {
                if let Some(not_told) = self.log.pass(clock::monotonic_ns()) {
                    tracing::warn!(%error, not_told, "a report cannot be made");
                }
            }
        }
        Ok(())
    }
}

fn require_stays(config: &Config) -> Result<(), DriveError> {
    if config.planner.room_time_s > 0.0 { Ok(()) } else { Err(DriveError::NoStay) }
}

/// Drives the robot until a stop is requested. A robot at work then finishes its room.
///
/// # Errors
///
/// [`DriveError`] when a service is lost, or the broker's set-up cannot be used.
pub fn run(config: &Config, domain: &Domain, broker: &Broker, way: Way<'_>, stop: &Stop) -> Result<(), DriveError> {
    require_stays(config)?;
    let robot = &config.planner.robot;
    let number = sequence::source_of_name(robot);
    let node = join(domain, &DRIVER.name(robot))?.be_the_only_one()?;
    let decisions: Subscriber<DecisionV1> = node.subscriber()?;
    let scores: Subscriber<RoomScoresV1> = node.subscriber()?;
    let dialect = Dialect::new(&config.robot, &config.bridge.topic, robot);
    let link = Link::start(broker, dialect.filters(), None)?;
    let reporter = Reporter::new(robot, sequence::random_epoch())?;
    let reports = node.publisher()?;
    let mut driver = Driver::new(&config.robot, number);
    let mut robot = RobotLink {
        dialect,
        link,
        reporter,
        reports,
        way,
        log: Limiter::new(QUIET_NS),
        log_reports: Limiter::with_burst(QUIET_NS, REPORTS_AT_ONCE),
    };
    let mut plan = Vec::new();
    let mut garbled = Limiter::new(QUIET_NS);
    let (mut hearing, mut watchdog) = (Hearing::Nothing { since: Instant::now() }, Watchdog::default());
    notify(&[NotifyState::Ready]);
    while !stop.requested() {
        decisions.wait(TICK)?;
        if let Some(scores) = scores.newest()? {
            driver.know_rooms(scores.rooms().iter().map(roomcast_ipc::raw::RoomV1::id));
        }
        let now_ns = clock::monotonic_ns();
        // Decisions come before the robot's messages: its state may be the result of this decision.
        while let Some(decision) = decisions.receive()? {
            let acts = driver.decide(&decision, now_ns);
            robot.act(acts)?;
        }
        let heard = robot.link.heard();
        // Messages from before a break of the connection are out of date, and come again with the next one.
        let is_connected = robot.link.connection() > 0;
        let acts = driver.link(is_connected, now_ns);
        robot.act(acts)?;
        for heard in heard.into_iter().filter(|_| is_connected) {
            if let Some(sensed) = robot.dialect.hear(&heard.topic, &heard.payload) {
                let acts = driver.sense(sensed, now_ns);
                robot.act(acts)?;
            } else if robot.dialect.is_garbled(&heard.topic, &heard.payload)
                && let Some(not_told) = garbled.pass(now_ns)
            {
                let payload = shown(&heard.payload);
                tracing::warn!(
                    topic = heard.topic,
                    payload,
                    not_told,
                    "the robot says what is not understood, and it is passed over"
                );
            }
        }
        let acts = driver.tick(now_ns);
        robot.act(acts)?;
        robot.reports.tick()?;
        hearing = hearing.go_on(&driver, is_connected, config, broker);
        if hearing.is_settled(&driver) {
            show_plan(&driver, &mut plan);
        }
        let turned_ns = now_ns.since(robot.link.turned_ns());
        if turned_ns <= TURN_MAX_NS {
            watchdog.lives();
        }
    }
    notify(&[NotifyState::Stopping]);
    robot.link.leave();
    Ok(())
}

#[derive(Debug, Clone, Copy)]
enum Hearing {
    Nothing {
        since: Instant,
    },
    /// It is silent, and the log has said so.
    Missed,
    Something {
        since: Instant,
    },
}

impl Hearing {
    /// Logs once that a robot is silent, and when it is not any more.
    fn go_on(self, driver: &Driver, is_connected: bool, config: &Config, broker: &Broker) -> Self {
        let now = Instant::now();
        let topic = config.robot.topic.as_str();
        match self {
            Self::Nothing { .. } if driver.is_heard() => Self::Something { since: now },
            Self::Missed if driver.is_heard() => {
                tracing::info!(topic, "the robot speaks");
                Self::Something { since: now }
            }
            // The log names an absent broker separately, and the robot can be heard only after that.
            Self::Nothing { .. } if !is_connected => Self::Nothing { since: now },
            Self::Nothing { since } if since.elapsed() >= SETTLING => {
                let remedy = match config.robot.kind {
                    RobotKind::Valetudo => {
                        "switch it on and connect it to this broker; or set robot.topic to its topic prefix and identifier"
                    }
                    RobotKind::HomeAssistant => {
                        "let the vacuum do something, since Home Assistant says a state when it changes (mqtt_statestream); or set robot.topic to its states"
                    }
                };
                tracing::warn!(topic, broker = broker.address, remedy, "nothing was heard of the robot yet");
                Self::Missed
            }
            same => same,
        }
    }

    /// Whether the rooms' segments are known as well as they will be.
    fn is_settled(self, driver: &Driver) -> bool {
        matches!(self, Self::Something { since } if driver.knows_segments() || since.elapsed() >= SETTLING)
    }
}

fn show_plan(driver: &Driver, before: &mut Vec<(String, Result<String, String>)>) {
    if driver.plan().eq(before.iter().map(|(room, segment)| (room.as_str(), segment.clone()))) {
        return;
    }
    *before = driver.plan().map(|(room, segment)| (room.to_owned(), segment)).collect();
    for (room, segment) in before {
        match segment {
            Ok(segment) => tracing::info!(room, segment, "a room that the robot can do"),
            Err(why) => tracing::warn!(room, why, "a room that the robot cannot do"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_needs_a_planner_that_lets_it_stay() {
        let mut config = Config::default();
        require_stays(&config).unwrap();
        config.planner.room_time_s = 0.0;
        let refused = require_stays(&config).unwrap_err().to_string();
        assert!(refused.starts_with("planner.room_time_s is 0"), "{refused}");
    }
}
