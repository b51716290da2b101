//! How the robots of a world act together.

use crate::benchmark::report::ALONE;
use clap::ValueEnum;

/// How the robots of a world act together. With one robot all are the same, but that on the truth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Team {
    /// Each on its own belief of what it sees itself, as if there were no others
    Alone,
    /// Each on its own, but of what all see
    Shared,
    /// On one belief, by one plan
    Joint,
    /// By one plan on the true states, whatever the policies
    Oracle,
}

impl Team {
    pub fn label(self) -> &'static str {
        match self {
            Self::Alone => ALONE,
            Self::Shared => "shared",
            Self::Joint => "joint",
            Self::Oracle => "oracle",
        }
    }

    /// Whether one agent flies all robots of a world.
    pub fn is_joint(self) -> bool {
        matches!(self, Self::Joint | Self::Oracle)
    }
}
