//! The goals of paths, and their names.

use emberwatch_belief::planning::options::PathOption;

/// The goal of a policy's paths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Goal {
    /// New cells only.
    Coverage,
    /// The belief's entropy.
    Explore,
    /// The state with the highest reward, with a small bonus for each new cell.
    Exploit,
    /// The state with the highest reward, without a bonus.
    ExploitOnly,
    /// The probability of a state of the model.
    State(usize),
    /// The choice of a DQN: an option, or an objective if the DQN reads an autoencoder's hidden vector.
    Learned,
    /// The option that a hand-written rule chooses.
    Rule,
    /// Always the same option.
    Option(&'static PathOption),
}

/// A goal with its name and a short description.
pub type GoalEntry = (Goal, &'static str, &'static str);

/// Goals of all planners except `options`. The states of the model are goals as well.
pub const GOALS: &[GoalEntry] = &[
    (Goal::Coverage, "coverage", "new cells only"),
    (Goal::Explore, "explore", "the belief's entropy"),
    (
        Goal::Exploit,
        "exploit",
        "the state with the highest reward, with a small bonus for each new cell",
    ),
    (
        Goal::ExploitOnly,
        "exploit_only",
        "the state with the highest reward, without a bonus",
    ),
    (
        Goal::Learned,
        "learned",
        "the goal that a DQN chooses; only with the autoencoder",
    ),
];

pub(super) const OPTION_GOALS: &[GoalEntry] = &[
    (
        Goal::Rule,
        "rule",
        "best_region if that region promises more than the surroundings, otherwise exploit",
    ),
    (
        Goal::Learned,
        "learned",
        "the option with the highest value under a DQN; needs --checkpoint",
    ),
];
