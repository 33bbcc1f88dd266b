//! Services as participants of a domain, and the names of each robot's services.

use roomcast_ipc::{Domain, IpcError, Node, sequence};

/// Joins as a service. If another participant has its place, joining takes up to 8 s to fail, so the log warns first.
pub(crate) fn join(domain: &Domain, name: &str) -> Result<Node, IpcError> {
    let tell = |error: &IpcError| tracing::warn!(reason = %error, "waiting up to 8 s for another to end");
    Ok(domain.open(name)?.telling_of_waits(tell))
}

/// A kind of service that each robot has.
#[derive(Debug, Clone, Copy)]
pub struct OfRobot(&'static str);

/// Planners.
pub const PLANNER: OfRobot = OfRobot("roomcast-planner");
/// Drivers of robots.
pub const DRIVER: OfRobot = OfRobot("roomcast-robot");

impl OfRobot {
    /// The name of a robot's service: the robot's name for people, and its number.
    ///
    /// ```
    /// use roomcast_ipc::sequence::source_of_name;
    /// use roomcast_services::participant::{DRIVER, PLANNER};
    ///
    /// let name = PLANNER.name("mop 2");
    /// assert_eq!(PLANNER.robot_of(&name), Some(source_of_name("mop 2")));
    /// assert_eq!((DRIVER.robot_of(&name), PLANNER.robot_name(&name)), (None, Some("mop 2")));
    /// ```
    #[must_use]
    pub fn name(self, robot: &str) -> String {
        format!("{} {robot} {:016x}", self.0, sequence::source_of_name(robot))
    }

    /// The number of the robot with the service `participant`; `None` for another participant.
    #[must_use]
    pub fn robot_of(self, participant: &str) -> Option<u64> {
        self.read(participant).map(|(_, number)| number)
    }

    /// The robot's name, if it is complete: participants' names have question marks in place of characters that are not ASCII.
    #[must_use]
    pub fn robot_name(self, participant: &str) -> Option<&str> {
        let (name, number) = self.read(participant)?;
        (sequence::source_of_name(name) == number).then_some(name)
    }

    fn read(self, participant: &str) -> Option<(&str, u64)> {
        let (name, number) = participant.strip_prefix(self.0)?.strip_prefix(' ')?.rsplit_once(' ')?;
        Some((name, u64::from_str_radix(number, 16).ok()?))
    }
}
