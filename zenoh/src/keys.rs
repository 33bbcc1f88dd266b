//! The keys of a site and robot. A robot writes only below its own name, so that one rule of a router's access control covers it.

/// The keys of one robot.
#[derive(Debug, Clone)]
pub struct Keys {
    base: String,
}

impl Keys {
    /// Creates the keys of a robot.
    #[must_use]
    pub fn new(site: &str, robot: &str) -> Self {
        Self { base: format!("roomcast/{site}/{robot}") }
    }

    /// A topic that the robot publishes: `scores`, `forecast`, `persons`, `decision`, `status`, `habits`.
    #[must_use]
    pub fn told(&self, topic: &str) -> String {
        format!("{}/told/{topic}", self.base)
    }

    /// All topics that the robot publishes.
    #[must_use]
    pub fn all_told(&self) -> String {
        format!("{}/told/**", self.base)
    }

    /// A narrator's narration for the robot.
    #[must_use]
    pub fn narration(&self, narrator: &str) -> String {
        format!("{}/narration/{narrator}", self.base)
    }

    /// The robot's reports of how far it has a narrator's narration.
    #[must_use]
    pub fn confirmed(&self, narrator: &str) -> String {
        format!("{}/confirmed/{narrator}", self.base)
    }

    /// A question: `moment`, `map-change`, `person`.
    #[must_use]
    pub fn ask(&self, question: &str) -> String {
        format!("{}/ask/{question}", self.base)
    }

    /// The token that lives while the robot's bridge runs.
    #[must_use]
    pub fn alive(&self) -> String {
        format!("{}/alive", self.base)
    }
}
