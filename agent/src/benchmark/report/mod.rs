//! What a comparison of policies looks like: a table, a CSV file and figures.
//!
//! Everything here turns finished [`PolicyRun`]s into text or a file; nothing here runs a policy.
//! Read [`statistics`] first, then [`table`], [`csv`] and [`figures`]. [`training`] turns metrics into curves.

pub mod csv;
pub mod events;
pub mod figures;
mod number;
mod rewards;
pub mod statistics;
pub mod table;
pub mod training;

pub use self::csv::write_csv;
pub use self::events::write_events;
pub use self::figures::{Snapshot, draw_ladder, draw_rewards, draw_snapshot, save};
pub use self::table::render_table;

use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// One policy on one world: what `emberwatch-agent compare` measured.
#[derive(Debug, Clone, PartialEq)]
pub struct PolicyRun {
    /// Name of the policy, such as `beam`.
    pub policy: String,
    /// Where the belief came from: `none`, `known_model`, `truth`, `next_truth` or a learned one.
    pub estimator: String,
    /// Seed of the world.
    pub world_seed: u64,
    /// Number of scored steps.
    pub steps: u64,
    /// Mean reward of a step.
    pub mean_reward: f64,
    /// Mean number of distinct cells visited in a step.
    pub mean_distinct_cells: f64,
    /// Distinct visited cells on target, as a fraction of the distinct visited cells, in `0..=1`.
    pub hit_rate: f64,
    /// Mean number of burning cells of the world.
    pub mean_fire_cells: f64,
    /// Mean time of one plan in milliseconds.
    pub mean_plan_millis: f64,
    /// Mean Brier score of the belief, where there is a belief.
    pub brier: Option<f64>,
    /// Reward of each step, in order.
    pub rewards: Vec<f32>,
}

/// Why a report could not be made.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ReportError {
    /// Nothing to report on.
    #[error("{what}: expected at least one policy run, got none")]
    Empty {
        /// The report.
        what: &'static str,
    },
    /// A number that cannot be drawn.
    #[error(
        "policy {policy:?} on world seed {world_seed}: {what}: expected a finite number, got {got}"
    )]
    NotFinite {
        /// The policy.
        policy: String,
        /// The world.
        world_seed: u64,
        /// Which number.
        what: &'static str,
        /// The number.
        got: f64,
    },
    /// Parts of a snapshot that do not belong together.
    #[error(transparent)]
    Snapshot(#[from] ::figures::Misfit),
    /// A file that could not be written.
    #[error("cannot write {}: {reason}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system or the encoder said.
        reason: String,
    },
}

/// The runs of one policy with one estimator, in the order given.
struct Group<'a> {
    policy: &'a str,
    estimator: &'a str,
    runs: Vec<&'a PolicyRun>,
}

impl Group<'_> {
    fn values(&self, value: impl Fn(&PolicyRun) -> f64) -> Vec<f64> {
        self.runs.iter().map(|run| value(run)).collect()
    }

    fn by_seed(&self, value: impl Fn(&PolicyRun) -> f64) -> BTreeMap<u64, f64> {
        let pair = |run: &&PolicyRun| (run.world_seed, value(run));
        self.runs.iter().map(pair).collect()
    }
}

/// Groups runs by policy and estimator, ordered by first appearance.
fn groups(runs: &[PolicyRun]) -> Vec<Group<'_>> {
    let mut groups: Vec<Group<'_>> = Vec::new();
    for run in runs {
        let (policy, estimator) = (run.policy.as_str(), run.estimator.as_str());
        let same = |group: &&mut Group<'_>| (group.policy, group.estimator) == (policy, estimator);
        match groups.iter_mut().find(same) {
            Some(group) => group.runs.push(run),
            None => groups.push(Group {
                policy,
                estimator,
                runs: vec![run],
            }),
        }
    }
    groups
}

/// Writes a file beside `path` and renames it, so that `path` is never half a file.
///
/// # Errors
/// [`ReportError::Write`] names `path`.
pub(crate) fn replace_file<E: Display>(
    path: &Path,
    extension: &str,
    write: impl FnOnce(&Path) -> Result<(), E>,
) -> Result<(), ReportError> {
    let failed = |reason: String| ReportError::Write {
        path: path.into(),
        reason,
    };
    let Some(name) = path.file_name() else {
        return Err(failed("the path names no file".into()));
    };
    let name = name.to_string_lossy();
    let temporary = path.with_file_name(format!(".{name}.{}.tmp.{extension}", std::process::id()));
    let written = write(&temporary).map_err(|error| error.to_string());
    let result =
        written.and_then(|()| std::fs::rename(&temporary, path).map_err(|error| error.to_string()));
    if result.is_err() {
        // It may not exist; the first error is the one to tell.
        let _ = std::fs::remove_file(&temporary);
    }
    result.map_err(failed)
}
