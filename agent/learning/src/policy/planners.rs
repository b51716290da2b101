//! Kinds of planner: how a policy finds paths. A kind is an entry here, and a line in [`PLANNERS`].

use crate::config::{AgentConfig, ObjectiveConfig};
use emberwatch_belief::planning::{Ahead, BeamSearch, Planner, RandomWalk, Shooting};
use std::fmt;

/// All kinds.
pub const PLANNERS: &[&PlannerKind] = &[&RANDOM, &SHOOTING, &BEAM, &AHEAD, &BY_OPTIONS];

/// A kind of planner: its constructor and its facts.
pub struct PlannerKind {
    /// Its name in policies.
    pub name: &'static str,
    /// What it does, in a few words.
    pub about: &'static str,
    /// What a new cell is worth to it beside the goal.
    pub bonus: fn(&ObjectiveConfig) -> f32,
    /// Whether it plans for a goal.
    pub has_goal: bool,
    pub build: fn(&AgentConfig) -> Box<dyn Planner + Send>,
}

/// Uniform moves: the paper's baseline.
pub const RANDOM: PlannerKind = PlannerKind {
    name: "random",
    about: "random moves, the paper's baseline; without a goal",
    bonus: |objective| objective.shooting_bonus,
    has_goal: false,
    build: |_| Box::new(RandomWalk),
};

/// The best of many random paths (paper section III.D).
pub const SHOOTING: PlannerKind = PlannerKind {
    name: "shooting",
    about: "the best of random paths, as in the paper",
    bonus: |objective| objective.shooting_bonus,
    has_goal: true,
    build: |config| {
        let (n_samples, integration) = (config.shooting_samples, config.shooting_integration);
        Box::new(Shooting::new(n_samples, integration))
    },
};

pub const BEAM: PlannerKind = PlannerKind {
    name: "beam",
    about: "beam search",
    bonus: |objective| objective.beam_bonus,
    has_goal: true,
    build: |config| Box::new(BeamSearch::new(config.beam_width)),
};

pub const AHEAD: PlannerKind = PlannerKind {
    name: "ahead",
    about: "beam search six paths ahead, of which the first is flown",
    build: |config| Box::new(Ahead::new(config.beam_width)),
    ..BEAM
};

/// One option or another (paper section III.E).
pub const BY_OPTIONS: PlannerKind = PlannerKind {
    name: "options",
    about: "options, each planned by beam search",
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
