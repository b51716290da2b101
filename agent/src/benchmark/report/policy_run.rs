//! The results of a comparison, and their groups.

use crate::acting::team::ALONE;
use crate::benchmark::report::statistics::Estimate;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The results of one policy on one world: a row of the CSV file of `emberwatch-agent compare`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PolicyRun {
    pub policy: String,
    /// Name of the belief: `none`, `known`, `truth` or another.
    pub estimator: String,
    pub world_seed: u64,
    pub steps: u64,
    pub mean_reward: f64,
    /// Mean number of distinct cells visited in a step. Entries of the leaderboard lack columns with a default.
    #[serde(default)]
    pub mean_distinct_cells: f64,
    /// Share of the distinct visited cells that are in the state with the highest reward, in `0..=1`.
    #[serde(default)]
    pub hit_rate: f64,
    /// Mean number of burning cells of the world.
    #[serde(default)]
    pub mean_fire_cells: f64,
    /// Mean time of one plan in milliseconds.
    #[serde(default)]
    pub mean_plan_millis: f64,
    /// Mean Brier score of the belief; `None` without a belief.
    pub brier: Option<f64>,
    #[serde(default)]
    pub moves: usize,
    /// Number of robots in the world. Rewards and cells are the team's: a cell that several robots visit in a step counts
    /// once. Planning times are summed over the world's agents.
    pub robots: u32,
    pub team: String,
    /// Share of the robots' visits to distinct cells that repeat a teammate's visit in the same step, in `0..1`.
    #[serde(default)]
    pub mean_repeated: f64,
    /// Steps until a robot first visited a burning cell, `None` if never. This and the next four fields are defined in
    /// `docs/figures-of-merit.md`.
    pub steps_to_detection: Option<u64>,
    /// Number of burning cells in the world at that step.
    pub burning_cells_at_detection: Option<u32>,
    /// Share of the burning cells that were seen in the last 10 steps.
    pub burning_seen_share: Option<f64>,
    /// Moves from the nearest robot to the nearest burning cell that was not seen in the last 10 steps.
    pub front_distance: Option<f64>,
    /// Share of the grid's cells that were ever seen.
    pub grid_seen_share: Option<f64>,
    /// Mean `ln P(y)` of a visited cell under the prediction made before the frame; `None` if nothing is predicted.
    pub log_likelihood: Option<f64>,
    /// The server's `worlds_fingerprint`.
    pub worlds_fingerprint: String,
    /// Processor seconds of training for the world's task, if `suite` recorded them.
    pub training_seconds: Option<f64>,
    /// The world's task, if the run is from a folder of `suite` or from the leaderboard.
    #[serde(default, skip_serializing)]
    pub task: String,
    /// Whether the run comes from a file given by `--add`.
    #[serde(skip)]
    pub is_added: bool,
    /// Reward of each step, in order.
    #[serde(skip)]
    pub rewards: Vec<f32>,
}

/// The runs of one policy with one estimator and one kind of team, in the order given.
pub struct Group<'a> {
    pub policy: &'a str,
    pub(super) estimator: &'a str,
    pub(super) robots: u32,
    pub(super) team: &'a str,
    pub runs: Vec<&'a PolicyRun>,
}

impl Group<'_> {
    fn key(&self) -> (&str, &str, u32, &str) {
        (self.policy, self.estimator, self.robots, self.team)
    }

    pub(super) fn estimate(&self, value: impl Fn(&PolicyRun) -> Option<f64>) -> Option<Estimate> {
        let values: Vec<f64> = self.runs.iter().filter_map(|run| value(run)).collect();
        Estimate::of(&values)
    }

    pub(super) fn by_seed(&self, value: impl Fn(&PolicyRun) -> Option<f64>) -> BTreeMap<u64, f64> {
        let pair = |run: &&PolicyRun| Some((run.world_seed, value(run)?));
        self.runs.iter().filter_map(pair).collect()
    }

    /// Returns whether the group is a team. A single robot in team `alone` is not a team.
    pub(super) fn is_team(&self) -> bool {
        (self.robots, self.team) != (1, ALONE)
    }

    pub(super) fn name(&self, groups: &[Self]) -> String {
        match self.marks(groups).as_slice() {
            [] => self.policy.into(),
            marks => format!("{} ({})", self.policy, marks.join(", ")),
        }
    }

    pub(super) fn marks(&self, groups: &[Self]) -> Vec<String> {
        let twins = || groups.iter().filter(|other| other.policy == self.policy);
        let mut marks = Vec::new();
        if twins().any(|other| other.estimator != self.estimator) {
            marks.push(self.estimator.to_owned());
        }
        if twins().any(|other| (other.robots, other.team) != (self.robots, self.team)) {
            marks.push(format!("{} {}", self.team, self.robots));
        }
        marks
    }
}

/// Groups runs by policy, estimator, robots and team, ordered by first appearance.
pub fn groups(runs: &[PolicyRun]) -> Vec<Group<'_>> {
    let mut groups: Vec<Group<'_>> = Vec::new();
    for run in runs {
        let new = Group {
            policy: &run.policy,
            estimator: &run.estimator,
            robots: run.robots,
            team: &run.team,
            runs: vec![run],
        };
        match groups.iter_mut().find(|group| group.key() == new.key()) {
            Some(group) => group.runs.push(run),
            None => groups.push(new),
        }
    }
    groups
}
