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

pub(super) const PARTIAL: &str = "Policies that lack a task have no score over all tasks:";

pub(super) const SCORE: &str = "score [95 %]";

const LIKELIHOOD: &str = "Log-likelihood of a visited cell (higher is better):";

const BRIER: &str = "Brier score (lower is better):";

const N_DRAWS: usize = 10_000;

/// The mean rewards of a policy, the random walk and the oracle in one world.
pub type WorldRewards = [f64; 3];

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

/// Returns all policies with their scores over tasks, the highest first. Policies that lack a task come last, by name.
pub fn by_score(runs: &[PolicyRun]) -> Vec<Scored<'_>> {
    let tasks = tasks(runs);
    let names: BTreeSet<&str> = runs.iter().map(|run| &*run.policy).collect();
    let score = |name: &str| {
        let rewards = tasks.iter().map(|task| rewards(runs, task, name));
        Aggregate::of(&rewards.collect::<Vec<_>>())
    };
    let mut all: Vec<_> = names.into_iter().map(|name| (name, score(name))).collect();
    let mean = |score: Option<Aggregate>| score.map_or(f64::NEG_INFINITY, |score| score.mean);
    all.sort_by(|a, b| mean(b.1).total_cmp(&mean(a.1)));
    all
}

/// Returns the names of the runs' tasks, in order of first appearance.
pub fn tasks(runs: &[PolicyRun]) -> Vec<&str> {
    let mut tasks = Vec::new();
    for run in runs {
        if !tasks.contains(&&*run.task) {
            tasks.push(&*run.task);
        }
    }
    tasks
}

/// Returns a policy's score in each world of a task, on a scale from the random walk's mean (0) to the oracle's (1).
/// Returns no scores if either is missing, or if the oracle's mean is not the higher one.
pub fn scores(runs: &[PolicyRun], task: &str, policy: &str) -> Vec<f64> {
    scaled(&rewards(runs, task, policy)).unwrap_or_default()
}

fn rewards(runs: &[PolicyRun], task: &str, policy: &str) -> Vec<WorldRewards> {
    let by_seed = |policy| -> BTreeMap<u64, f64> {
        let runs = of(runs, task, policy);
        runs.map(|run| (run.world_seed, run.mean_reward)).collect()
    };
    let [floors, ceilings] = [FLOOR, CEILING].map(by_seed);
    let of_world = |(seed, reward)| Some([reward, *floors.get(&seed)?, *ceilings.get(&seed)?]);
    by_seed(policy).into_iter().filter_map(of_world).collect()
}

fn of<'a>(
    runs: &'a [PolicyRun],
    task: &'a str,
    policy: &'a str,
) -> impl Iterator<Item = &'a PolicyRun> {
    let is_of = move |run: &&PolicyRun| (&*run.task, &*run.policy) == (task, policy);
    runs.iter().filter(is_of)
}

/// Renders the scores of all policies per task, and their beliefs' likelihood and Brier score.
pub fn render_suite(runs: &[PolicyRun]) -> String {
    let (tasks, policies) = (tasks(runs), by_score(runs));
    let headings = [&["policy"], &*tasks].concat();
    let cell = |values: Vec<f64>, decimals| match Estimate::of(&values) {
        Some(estimate) => number(estimate.mean, decimals),
        None => NOTHING.into(),
    };
    let row = |policy: &str, cells: Vec<String>| [vec![policy.to_owned()], cells].concat();
    let of_scores = |&&(policy, score): &&Scored<'_>| {
        let means = tasks.iter().map(|task| cell(scores(runs, task, policy), 3));
        row(policy, means.chain(score.map(score_text)).collect())
    };
    let beliefs = |value: fn(&PolicyRun) -> Option<f64>| {
        let values = move |task, policy| of(runs, task, policy).filter_map(value).collect();
        let means = |policy| tasks.iter().map(move |task| cell(values(task, policy), 4));
        let rows = policies.iter().map(|it| row(it.0, means(it.0).collect()));
        rows.filter(|row| row[1..].iter().any(|cell| cell != NOTHING))
            .collect()
    };
    let is_complete = |(_, score): &&Scored<'_>| score.is_some();
    let (complete, partial): (Vec<_>, Vec<_>) = policies.iter().partition(is_complete);
    let with_score = [&*headings, &[SCORE]].concat();
    let parts = [
        table(
            SCORES,
            &with_score,
            complete.iter().map(of_scores).collect(),
        ),
        table(PARTIAL, &headings, partial.iter().map(of_scores).collect()),
        table(LIKELIHOOD, &headings, beliefs(|run| run.log_likelihood)),
        table(BRIER, &headings, beliefs(|run| run.brier)),
    ];
    parts.concat().join(
        "

",
    ) + "
"
}

pub(super) fn table(line: &str, headings: &[&str], rows: Vec<Vec<String>>) -> Vec<String> {
    if rows.is_empty() {
        return Vec::new();
    }
    vec![line.into(), markdown(headings, rows)]
}

/// Formats a score with its interval, for tables and figures.
pub fn score_text(Aggregate { mean, interval }: Aggregate) -> String {
    let mean = number(mean, 3);
    match interval.map(|ends| ends.map(|it| number(it, 3))) {
        Some([low, high]) => format!("{mean} [{low}, {high}]"),
        None => format!("{mean} (no interval)"),
    }
}

fn score(tasks: impl Iterator<Item = impl Iterator<Item = WorldRewards>>) -> Option<f64> {
    let scores = tasks.map(|worlds| scaled(&worlds.collect::<Vec<_>>()));
    let scores = scores.collect::<Option<Vec<_>>>()?.concat();
    (!scores.is_empty()).then(|| interquartile_mean(scores))
}

/// Returns each world's score, on a scale from the random walk's mean over the worlds (0) to the oracle's (1). Returns
/// `None` if the oracle's mean is not the higher one.
fn scaled(worlds: &[WorldRewards]) -> Option<Vec<f64>> {
    let mean = |index: usize| worlds.iter().map(|it| it[index]).sum::<f64>() / worlds.len() as f64;
    let (floor, ceiling) = (mean(1), mean(2));
    let score = |[policy, ..]: &WorldRewards| (policy - floor) / (ceiling - floor);
    (ceiling > floor).then(|| worlds.iter().map(score).collect())
}

/// Returns the mean without the lowest and the highest quarter of the numbers. The size of a quarter is rounded down.
fn interquartile_mean(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_by(f64::total_cmp);
    let n_cut = numbers.len() / 4;
    let middle = &numbers[n_cut..numbers.len() - n_cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

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
        scores.iter().map(|&score| [score, 0.0, 1.0]).collect()
    }

    fn aggregate(tasks: &[Vec<WorldRewards>]) -> (f64, [f64; 2]) {
        let Aggregate { mean, interval } = Aggregate::of(tasks).expect("scores");
        (mean, interval.expect("several worlds"))
    }

    #[test]
    fn scores_match_rliable() {
        let tasks = [
            worlds(&[0.21, 0.21, 0.33, 0.07, -0.03, 0.13, 0.24, 0.34]),
            worlds(&[0.57, 0.49, 0.79, 0.48, 0.56, 0.49, 0.81, 0.47]),
            worlds(&[1.09, 1.01, 0.69, 0.91, 0.53, 0.81, 0.86, 1.01]),
        ];
        let (mean, [low, high]) = aggregate(&tasks);
        // rliable 1.2: 0.54583333, [0.4775 to 0.4783, 0.6200 to 0.6217] in three runs of 50,000 draws.
        assert!((mean - 0.545_833_333).abs() < 1e-8, "{mean}");
        assert!((low - 0.478).abs() < 0.003, "{low}");
        assert!((high - 0.621).abs() < 0.003, "{high}");
        assert_eq!(aggregate(&tasks), (mean, [low, high]));
        assert_eq!(Aggregate::of(&[worlds(&[1.0]), vec![]]), None);
        assert_eq!(interquartile_mean(vec![9.0, 1.0, 3.0, 2.0, -7.0]), 2.0);
    }

    #[test]
    fn bootstrap_draws_also_resample_both_ends_of_the_scale() {
        let world = |reward: f64| [reward, reward / 2.0, 2.0 * reward];
        // All worlds have the same reward ratios, so only the drawn mixture of worlds varies.
        let (mean, interval) = aggregate(&[vec![world(1.0); 4]]);
        assert_eq!(interval, [mean; 2]);
        let width = |world: fn(f64) -> WorldRewards| {
            let worlds = (1..=8).map(|reward| world(reward.into()));
            let (_, [low, high]) = aggregate(&[worlds.collect()]);
            high - low
        };
        assert!(width(world) < 0.5 * width(|reward| [reward, 2.25, 9.0]));
        // Half of the draws of these two worlds have no scale.
        let (_, ends) = aggregate(&[vec![world(2.0), [0.5, 1.0, 0.0]]]);
        assert!(ends.iter().all(|end| end.is_finite()), "{ends:?}");
    }

    #[test]
    fn a_task_of_one_world_leaves_no_interval() {
        let one = worlds(&[0.5]);
        for tasks in [vec![one.clone()], vec![one, worlds(&[0.4, 0.5, 0.6])]] {
            let score = Aggregate::of(&tasks).expect("scores");
            assert_eq!(score_text(score), "0.500 (no interval)");
        }
        // Several worlds with equal scores have an interval: a single point.
        let equal = Aggregate::of(&[worlds(&[0.5, 0.5])]).expect("scores");
        assert_eq!(score_text(equal), "0.500 [0.500, 0.500]");
    }
}
