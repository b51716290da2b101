//! Policies: combinations of a belief, a planner and a goal, such as `learned+spatial/beam/exploit`.

mod decisions;
mod goals;
mod help;
mod ladder;
mod names;
mod parts;
mod planners;

pub use self::decisions::LearnedDecisions;
pub use self::goals::{GOALS, Goal, GoalEntry};
pub use self::help::help;
pub use self::ladder::ladder;
pub use self::names::{check_name, planner_of};
pub use self::parts::{Policy, network_choices};
pub use self::planners::{AHEAD, BEAM, BY_OPTIONS, PLANNERS, PlannerKind, RANDOM, SHOOTING};
