//! Figures as PNG: the ladder of policies, rewards over time, a snapshot of one step, and curves.
//!
//! Drawn at two pixels a point, with a font and colours of their own, so that a figure looks the
//! same on every machine. [`canvas`] draws, [`axis`] scales, [`palette`] colours.

mod axis;
mod canvas;
pub mod curves;
mod ladder;
mod legend;
mod lettering;
pub(crate) mod palette;
mod panels;
mod rewards;
mod snapshot;
pub(crate) mod text;

pub use self::ladder::draw_ladder;
pub use self::rewards::draw_rewards;
pub use self::snapshot::{Snapshot, draw_snapshot};

use super::{Group, PolicyRun, ReportError};

/// Width of every figure in points.
const WIDTH: f64 = 1200.0;

/// Empty rim of every figure in points.
const MARGIN: f64 = 32.0;

/// What the reward of the wildfire model counts: the label of a reward axis.
pub const FIRE_CELLS_PER_STEP: &str = "distinct fire cells found per step";

/// A policy's name as a person would write it.
fn readable(name: &str) -> String {
    name.replace('_', " ")
}

/// Names for lines: the policy, with its estimator where the policy stands more than once.
fn short_names(groups: &[Group<'_>]) -> Vec<String> {
    let name = |group: &Group<'_>| {
        let same = groups.iter().filter(|other| other.policy == group.policy);
        let policy = readable(group.policy);
        if same.count() > 1 {
            format!("{policy} ({})", readable(group.estimator))
        } else {
            policy
        }
    };
    groups.iter().map(name).collect()
}

fn check_finite(
    run: &PolicyRun,
    what: &'static str,
    mut values: impl Iterator<Item = f64>,
) -> Result<(), ReportError> {
    match values.find(|value| !value.is_finite()) {
        Some(got) => Err(ReportError::NotFinite {
            policy: run.policy.clone(),
            world_seed: run.world_seed,
            what,
            got,
        }),
        None => Ok(()),
    }
}
