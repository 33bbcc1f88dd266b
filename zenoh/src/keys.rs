//! The keys of a site and robot. A robot writes only below its own name, so that one rule of a router's access control says so.

/// All robots and hubs of a site.
#[derive(Debug, Clone)]
pub struct Keys {
    base: String,
}

impl Keys {
    /// Those of one robot.
    #[must_use]
    pub fn new(site: &str, robot: &str) -> Self {
        Self { base: format!("roomcast/{site}/{robot}") }
    }

    /// What the robot tells: `scores`, `forecast`, `persons`, `decision`, `status`, `habits`.
    #[must_use]
    pub fn told(&self, topic: &str) -> String {
        format!("{}/told/{topic}", self.base)
    }

    /// All that it tells.
    #[must_use]
    pub fn all_told(&self) -> String {
        format!("{}/told/**", self.base)
    }

    /// A narrator's narration for the robot.
    #[must_use]
    pub fn narration(&self, narrator: &str) -> String {
        format!("{}/narration/{narrator}", self.base)
    }

    /// How far the robot has a narrator's narration.
    #[must_use]
    pub fn confirmed(&self, narrator: &str) -> String {
        format!("{}/confirmed/{narrator}", self.base)
    }

    /// A question: `moment`, `map-change`, `person`.
    #[must_use]
    pub fn ask(&self, question: &str) -> String {
        format!("{}/ask/{question}", self.base)
    }

    /// The token that is there as long as the robot's bridge is.
    #[must_use]
    pub fn alive(&self) -> String {
        format!("{}/alive", self.base)
    }
}
