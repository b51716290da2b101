//! One score over all tasks: the interquartile mean of rewards, with its confidence interval. Rewards are scaled so
//! that a random walk scores 0 and an oracle scores 1.
//!
//! Defined by Agarwal et al. (2021), *Deep Reinforcement Learning at the Edge of the Statistical Precipice*, and
//! computed as in `rliable`.

use crate::benchmark::report::columns::markdown;
use crate::benchmark::report::number::{NOTHING, number};
use crate::benchmark::report::policy_run::PolicyRun;
use crate::benchmark::report::statistics::Estimate;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::collections::{BTreeMap, BTreeSet};

/// The policy whose mean reward in a task defines score 0.
pub const FLOOR: &str = "random_walk";

/// The policy whose mean reward in a task defines score 1.
pub const CEILING: &str = "oracle_ahead";

const SCORES: &str = "Scores: 0 is random_walk's mean reward in a task, 1 is oracle_ahead's. The last column is the \
     interquartile mean over the worlds of all tasks.";

/// Heading of the table of policies that lack a task.
pub(super) const PARTIAL: &str = "Policies that lack a task have no score over all tasks:";

const LIKELIHOOD: &str = "Log-likelihood of a visited cell (higher is better):";

const BRIER: &str = "Brier score (lower is better):";

/// Number of bootstrap draws for an interval.
const N_DRAWS: usize = 10_000;

/// The runs of all policies on one task.
#[derive(Debug, Clone)]
pub struct TaskRuns {
    pub task: String,
    pub runs: Vec<PolicyRun>,
}

/// The mean rewards of a policy, the random walk and the oracle in one world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldRewards {
    pub floor: f64,
    pub ceiling: f64,
    pub policy: f64,
}

/// An interquartile mean with the ends of its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aggregate {
    pub mean: f64,
    /// `None` if a task has only one world, whose spread is unknown.
    pub interval: Option<[f64; 2]>,
}

/// A policy with its score over tasks; `None` if it lacks a task.
pub type Scored<'a> = (&'a str, Option<Aggregate>);

impl Aggregate {
    /// Computes the score from the rewards in each task's worlds; `None` if a task has no scores.
    ///
    /// The interval comes from a stratified bootstrap. Each draw resamples the worlds of each task with replacement,
    /// both for the policy's rewards and for the ends of the scale. Policies on the same worlds use the same draws.
    /// Draws in which the oracle is not better than the random walk in some task have no scale and are left out.
    pub fn of(tasks: &[Vec<WorldRewards>]) -> Option<Self> {
        let mean = score(tasks.iter().map(|worlds| worlds.iter().copied()))?;
        if tasks.iter().any(|worlds| worlds.len() == 1) {
            let interval = None;
            return Some(Self { mean, interval });
        }
        let mut random = ChaCha8Rng::seed_from_u64(0);
        let mut draw = |worlds: &Vec<WorldRewards>| -> Vec<WorldRewards> {
            let n = worlds.len() as u64;
            let index = |_| ((u64::from(random.next_u32()) * n) >> 32) as usize;
            (0..n).map(index).map(|index| worlds[index]).collect()
        };
        let means = (0..N_DRAWS).filter_map(|_| {
            let drawn: Vec<_> = tasks.iter().map(&mut draw).collect();
            score(drawn.into_iter().map(Vec::into_iter))
        });
        let mut means: Vec<f64> = means.collect();
        means.sort_by(f64::total_cmp);
        let ends = || [0.025, 0.975].map(|share| quantile(&means, share));
        let interval = (!means.is_empty()).then(ends);
        Some(Self { mean, interval })
    }
}

impl TaskRuns {
    /// Returns a policy's score in each world, on a scale from the random walk's mean (0) to the oracle's (1). Returns
    /// no scores if either is missing, or if the oracle's mean is not the higher one.
    pub fn scores(&self, policy: &str) -> Vec<f64> {
        scaled(&self.rewards(policy)).unwrap_or_default()
    }

    /// Returns the rewards of a policy, the random walk and the oracle, for each world that all three have.
    fn rewards(&self, policy: &str) -> Vec<WorldRewards> {
        let by_seed = |policy| -> BTreeMap<u64, f64> {
            let runs = self.of(policy);
            runs.map(|run| (run.world_seed, run.mean_reward)).collect()
        };
        let [floors, ceilings] = [FLOOR, CEILING].map(by_seed);
        let of_world = |(seed, policy)| {
            Some(WorldRewards {
                floor: *floors.get(&seed)?,
                ceiling: *ceilings.get(&seed)?,
                policy,
            })
        };
        by_seed(policy).into_iter().filter_map(of_world).collect()
    }

    fn of<'a>(&'a self, policy: &'a str) -> impl Iterator<Item = &'a PolicyRun> {
        self.runs.iter().filter(move |run| run.policy == policy)
    }

    /// Returns the mean over the worlds that have a value.
    fn mean(&self, policy: &str, value: fn(&PolicyRun) -> Option<f64>) -> Option<f64> {
        let values: Vec<f64> = self.of(policy).filter_map(value).collect();
        Estimate::of(&values).map(|estimate| estimate.mean)
    }
}

/// Renders the scores of all policies, with one column per task, and the likelihood and Brier score of their beliefs.
/// Policies that lack a task have a separate table.
pub fn render_suite(tasks: &[TaskRuns]) -> String {
    let policies = by_score(tasks);
    let (complete, partial) = by_completeness(&policies);
    let scores = |policies: &[Scored<'_>]| {
        let rows = policies.iter().map(|(policy, score)| {
            let mean = |task: &TaskRuns| Estimate::of(&task.scores(policy));
            let cells = tasks
                .iter()
                .map(|task| cell(mean(task).map(|it| it.mean), 3));
            row(policy, cells.chain(score.map(score_text)))
        });
        rows.collect()
    };
    let beliefs = |value: fn(&PolicyRun) -> Option<f64>| {
        let rows = policies.iter().filter_map(|(policy, _)| {
            let means: Vec<_> = tasks.iter().map(|task| task.mean(policy, value)).collect();
            let is_any = means.iter().any(Option::is_some);
            is_any.then(|| row(policy, means.into_iter().map(|mean| cell(mean, 4))))
        });
        rows.collect()
    };
    let parts = [
        table(SCORES, tasks, Some("score [95 %]"), scores(complete)),
        table(PARTIAL, tasks, None, scores(partial)),
        table(LIKELIHOOD, tasks, None, beliefs(|run| run.log_likelihood)),
        table(BRIER, tasks, None, beliefs(|run| run.brier)),
    ];
    parts.into_iter().flatten().collect::<Vec<_>>().join("\n")
}

/// Returns a heading and a table with one column per task; `None` without rows.
fn table(
    heading: &str,
    tasks: &[TaskRuns],
    last: Option<&str>,
    rows: Vec<Vec<String>>,
) -> Option<String> {
    if rows.is_empty() {
        return None;
    }
    let names = tasks.iter().map(|task| &*task.task);
    let columns: Vec<&str> = ["policy"].into_iter().chain(names).chain(last).collect();
    let table = markdown(&columns, rows.into_iter());
    Some(format!("{heading}\n\n{table}\n"))
}

fn cell(mean: Option<f64>, decimals: usize) -> String {
    mean.map_or(NOTHING.into(), |mean| number(mean, decimals))
}

fn row(policy: &str, cells: impl Iterator<Item = String>) -> Vec<String> {
    [policy.to_owned()].into_iter().chain(cells).collect()
}

/// Separates the policies that have all tasks from the other policies, which come last.
pub(super) fn by_completeness<'a, 'b>(
    policies: &'b [Scored<'a>],
) -> (&'b [Scored<'a>], &'b [Scored<'a>]) {
    policies.split_at(policies.partition_point(|(_, score)| score.is_some()))
}

/// Returns all policies with their scores over tasks, the highest first. Policies that lack a task come last, by name.
pub fn by_score(tasks: &[TaskRuns]) -> Vec<Scored<'_>> {
    let names = tasks
        .iter()
        .flat_map(|task| task.runs.iter().map(|run| &*run.policy));
    let names: BTreeSet<&str> = names.collect();
    let score = |name: &str| {
        let rewards = tasks.iter().map(|task| task.rewards(name));
        Aggregate::of(&rewards.collect::<Vec<_>>())
    };
    let mut all: Vec<_> = names.into_iter().map(|name| (name, score(name))).collect();
    let mean = |score: Option<Aggregate>| score.map_or(f64::NEG_INFINITY, |score| score.mean);
    all.sort_by(|a, b| mean(b.1).total_cmp(&mean(a.1)));
    all
}

/// Formats a score with its interval, for tables and figures.
pub fn score_text(Aggregate { mean, interval }: Aggregate) -> String {
    let mean = number(mean, 3);
    match interval.map(|ends| ends.map(|it| number(it, 3))) {
        Some([low, high]) => format!("{mean} [{low}, {high}]"),
        None => format!("{mean} (no interval)"),
    }
}

/// Returns the interquartile mean of all worlds' scores; `None` without tasks, or if a task has no scores.
fn score(tasks: impl Iterator<Item = impl Iterator<Item = WorldRewards>>) -> Option<f64> {
    let scores = tasks.map(|worlds| scaled(&worlds.collect::<Vec<_>>()));
    let scores = scores.collect::<Option<Vec<_>>>()?.concat();
    (!scores.is_empty()).then(|| interquartile_mean(scores))
}

/// Returns each world's score, on a scale from the random walk's mean over the worlds (0) to the oracle's (1). Returns
/// `None` if the oracle's mean is not the higher one.
fn scaled(worlds: &[WorldRewards]) -> Option<Vec<f64>> {
    let n = worlds.len() as f64;
    let floor = worlds.iter().map(|it| it.floor).sum::<f64>() / n;
    let ceiling = worlds.iter().map(|it| it.ceiling).sum::<f64>() / n;
    let score = |it: &WorldRewards| (it.policy - floor) / (ceiling - floor);
    (ceiling > floor).then(|| worlds.iter().map(score).collect())
}

/// Returns the mean without the lowest and the highest quarter of the numbers. The size of a quarter is rounded down.
fn interquartile_mean(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_by(f64::total_cmp);
    let n_cut = numbers.len() / 4;
    let middle = &numbers[n_cut..numbers.len() - n_cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

/// Returns a quantile of sorted numbers, by linear interpolation.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let at = share * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    below + (above - below) * at.fract()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns worlds in which the policy's rewards equal its scores.
    fn worlds(scores: &[f64]) -> Vec<WorldRewards> {
        let world = |&policy: &f64| WorldRewards {
            floor: 0.0,
            ceiling: 1.0,
            policy,
        };
        scores.iter().map(world).collect()
    }

    #[test]
    fn scores_match_rliable() {
        let tasks = [
            worlds(&[0.21, 0.21, 0.33, 0.07, -0.03, 0.13, 0.24, 0.34]),
            worlds(&[0.57, 0.49, 0.79, 0.48, 0.56, 0.49, 0.81, 0.47]),
            worlds(&[1.09, 1.01, 0.69, 0.91, 0.53, 0.81, 0.86, 1.01]),
        ];
        let Aggregate { mean, interval } = Aggregate::of(&tasks).expect("scores");
        let [low, high] = interval.expect("eight worlds");
        // rliable 1.2: 0.54583333, [0.4775 to 0.4783, 0.6200 to 0.6217] in three runs of 50,000 draws.
        assert!((mean - 0.545_833_333).abs() < 1e-8, "{mean}");
        assert!((low - 0.478).abs() < 0.003, "{low}");
        assert!((high - 0.621).abs() < 0.003, "{high}");
        assert_eq!(Aggregate::of(&tasks), Aggregate::of(&tasks));
        assert_eq!(Aggregate::of(&[worlds(&[1.0]), vec![]]), None);
        assert_eq!(interquartile_mean(vec![9.0, 1.0, 3.0, 2.0, -7.0]), 2.0);
    }

    #[test]
    fn bootstrap_draws_also_resample_both_ends_of_the_scale() {
        let world = |policy: f64| WorldRewards {
            floor: policy / 2.0,
            ceiling: 2.0 * policy,
            policy,
        };
        // All worlds have the same reward ratios, so only the drawn mixture of worlds varies.
        let equal = [vec![world(1.0), world(1.0), world(1.0), world(1.0)]];
        let point = Aggregate::of(&equal).expect("scores");
        assert_eq!(point.interval, Some([point.mean; 2]));
        let mixed: Vec<_> = (1..=8).map(|reward| world(reward.into())).collect();
        let exact = |it: &WorldRewards| WorldRewards {
            floor: 2.25,
            ceiling: 9.0,
            ..*it
        };
        let width = |worlds: Vec<WorldRewards>| {
            let score = Aggregate::of(&[worlds]).expect("scores");
            let [low, high] = score.interval.expect("eight worlds");
            high - low
        };
        let with_exact_ends = width(mixed.iter().map(exact).collect());
        assert!(width(mixed) < 0.5 * with_exact_ends);
        // Half of the draws of these two worlds have no scale.
        let reversed = WorldRewards {
            floor: 1.0,
            ceiling: 0.0,
            policy: 0.5,
        };
        let score = Aggregate::of(&[vec![world(2.0), reversed]]).expect("scores");
        let ends = score.interval.expect("two worlds");
        assert!(ends.iter().all(|end| end.is_finite()), "{ends:?}");
    }

    #[test]
    fn a_task_of_one_world_leaves_no_interval() {
        for tasks in [
            vec![vec![0.5]],
            vec![vec![0.5], vec![0.5]],
            vec![vec![0.5], vec![0.4, 0.5, 0.6]],
        ] {
            let tasks: Vec<_> = tasks.iter().map(|scores| worlds(scores)).collect();
            let score = Aggregate::of(&tasks).expect("scores");
            let expected = Aggregate {
                mean: 0.5,
                interval: None,
            };
            assert_eq!(score, expected, "{tasks:?}");
            assert_eq!(score_text(score), "0.500 (no interval)");
        }
        // Several worlds with equal scores have an interval: a single point.
        let equal = Aggregate::of(&[worlds(&[0.5, 0.5])]).expect("scores");
        assert_eq!(score_text(equal), "0.500 [0.500, 0.500]");
    }
}
