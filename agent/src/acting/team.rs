//! How the robots of a world act together.

use clap::ValueEnum;

/// Label of a team whose robots ignore each other, and of a single robot.
pub const ALONE: &str = "alone";

/// How the robots of a world act together. With one robot, all kinds are the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Team {
    /// Each robot plans on its own observations, as if there were no other robots
    Alone,
    /// Each robot plans for itself, on the observations of all robots
    Shared,
    /// One agent plans for all robots, on one belief
    Joint,
}

impl Team {
    pub fn label(self) -> &'static str {
        match self {
            Self::Alone => ALONE,
            Self::Shared => "shared",
            Self::Joint => "joint",
        }
    }
}
