//! Kinds of planner, which find a policy's paths. Each kind is a constant in this file, with an entry in [`PLANNERS`].

use super::goals::{GOALS, GoalEntry, OPTION_GOALS};
use crate::config::AgentConfig;
use emberwatch_belief::planning::objective::BEAM_BONUS;
use emberwatch_belief::planning::{Ahead, BeamSearch, Planner, RandomWalk, Shooting};
use std::fmt;

/// All kinds of planner.
pub const PLANNERS: &[&PlannerKind] = &[&RANDOM, &SHOOTING, &BEAM, &AHEAD, &BY_OPTIONS];

/// A kind of planner: its constructor, name and properties.
pub struct PlannerKind {
    /// Name, as it appears in the names of policies.
    pub name: &'static str,
    /// Short description.
    pub about: &'static str,
    /// Returns the bonus for a new cell, in addition to the goal's value.
    pub bonus: f32,
    /// The goals that it accepts, besides options or the states of the model. Empty if it ignores the values of cells.
    pub goals: &'static [GoalEntry],
    pub build: fn(&AgentConfig) -> Box<dyn Planner + Send>,
}

/// Uniformly random moves, the paper's baseline.
pub const RANDOM: PlannerKind = PlannerKind {
    name: "random",
    about: "random moves, the paper's baseline; without a goal",
    bonus: 1.0,
    goals: &[],
    build: |_| Box::new(RandomWalk),
};

/// Random shooting: the best of many random paths (paper section III.D).
pub const SHOOTING: PlannerKind = PlannerKind {
    name: "shooting",
    about: "the best of random paths, as in the paper",
    bonus: 1.0,
    goals: GOALS,
    build: |config| {
        let (n_samples, integration) = (config.shooting_samples, config.shooting_integration);
        Box::new(Shooting::new(n_samples, integration))
    },
};

pub const BEAM: PlannerKind = PlannerKind {
    name: "beam",
    about: "beam search",
    bonus: BEAM_BONUS,
    goals: GOALS,
    build: |config| Box::new(BeamSearch::new(config.beam_width)),
};

pub const AHEAD: PlannerKind = PlannerKind {
    name: "ahead",
    about: "beam search over six paths in a row; only the first is flown",
    build: |config| Box::new(Ahead::new(config.beam_width)),
    ..BEAM
};

/// A choice among options (paper section III.E).
pub const BY_OPTIONS: PlannerKind = PlannerKind {
    name: "options",
    about: "a choice among options, each planned by beam search",
    goals: OPTION_GOALS,
    ..BEAM
};

impl PartialEq for PlannerKind {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl fmt::Debug for PlannerKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name)
    }
}
