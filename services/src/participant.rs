//! How services take part in a domain, and the names of those that each robot has.

use roomcast_ipc::{Domain, IpcError, Node, sequence};

/// Joins as a service, whose log says for whom it waits: a place that somebody else has makes it fail only after seconds.
pub(crate) fn join(domain: &Domain, name: &str) -> Result<Node, IpcError> {
    let tell = |error: &IpcError| tracing::warn!(reason = %error, "waiting up to 8 s for another to end");
    Ok(domain.open(name)?.telling_of_waits(tell))
}

/// A kind of service of which each robot has one.
#[derive(Debug, Clone, Copy)]
pub struct OfRobot(&'static str);

/// Planners.
pub const PLANNER: OfRobot = OfRobot("roomcast-planner");
/// What drives robots.
pub const DRIVER: OfRobot = OfRobot("roomcast-robot");

impl OfRobot {
    /// The name of a robot's service: for people the robot's name, and behind it its number.
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

    /// The number of the robot whose service takes part by this name; none where it is no such service.
    #[must_use]
    pub fn robot_of(self, participant: &str) -> Option<u64> {
        self.read(participant).map(|(_, number)| number)
    }

    /// The robot's name, where it is whole: among participants a name has question marks for what is not ASCII.
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
