//! One score over tasks: rewards between the random walk's and an oracle's, their interquartile mean, and its interval.
//!
//! As Agarwal et al. (2021), *Deep Reinforcement Learning at the Edge of the Statistical Precipice*, define it and
//! `rliable` computes it.

use crate::benchmark::report::columns::markdown;
use crate::benchmark::report::number::{NOTHING, number};
use crate::benchmark::report::policy_run::PolicyRun;
use crate::benchmark::report::statistics::Estimate;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::collections::BTreeSet;

/// The policy whose mean reward of a task is 0.
pub const FLOOR: &str = "random_walk";

/// The policy whose mean reward of a task is 1.
pub const CEILING: &str = "oracle_ahead";

/// How often worlds are drawn again for an interval.
const N_DRAWS: usize = 10_000;

/// What was measured of one task.
#[derive(Debug, Clone)]
pub struct TaskRuns {
    pub task: String,
    pub runs: Vec<PolicyRun>,
}

/// An interquartile mean with the ends of its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aggregate {
    pub mean: f64,
    /// `None` if a task has only one world, whose spread is unknown.
    pub interval: Option<[f64; 2]>,
}

impl Aggregate {
    /// Of the scores of each task's worlds; `None` if a task has none.
    ///
    /// The interval is that of a stratified bootstrap: in each draw the worlds of each task are drawn again, with
    /// replacement. The same scores give the same digits.
    pub fn of(tasks: &[Vec<f64>]) -> Option<Self> {
        if tasks.is_empty() || tasks.iter().any(Vec::is_empty) {
            return None;
        }
        let mean = interquartile_mean(tasks.concat());
        if tasks.iter().any(|scores| scores.len() == 1) {
            let interval = None;
            return Some(Self { mean, interval });
        }
        let mut random = ChaCha8Rng::seed_from_u64(0);
        let mut draw = || {
            let again = tasks.iter().flat_map(|scores| {
                let index =
                    |_| ((u64::from(random.next_u32()) * scores.len() as u64) >> 32) as usize;
                (0..scores.len())
                    .map(index)
                    .map(|index| scores[index])
                    .collect::<Vec<_>>()
            });
            interquartile_mean(again.collect())
        };
        let mut means: Vec<f64> = (0..N_DRAWS).map(|_| draw()).collect();
        means.sort_by(f64::total_cmp);
        let interval = Some([0.025, 0.975].map(|share| quantile(&means, share)));
        Some(Self { mean, interval })
    }
}

impl TaskRuns {
    /// A policy's reward of each world, scaled so that the random walk's mean is 0 and the oracle's 1; none if these
    /// are missing, or the oracle's is no higher.
    pub fn scores(&self, policy: &str) -> Vec<f64> {
        let means = [FLOOR, CEILING].map(|policy| self.mean(policy, reward));
        let [Some(floor), Some(ceiling)] = means else {
            return Vec::new();
        };
        let score = |run: &PolicyRun| (run.mean_reward - floor) / (ceiling - floor);
        self.of(policy)
            .filter(|_| ceiling > floor)
            .map(score)
            .collect()
    }

    fn of<'a>(&'a self, policy: &'a str) -> impl Iterator<Item = &'a PolicyRun> {
        self.runs.iter().filter(move |run| run.policy == policy)
    }

    /// The mean over the worlds that have a value.
    fn mean(&self, policy: &str, value: fn(&PolicyRun) -> Option<f64>) -> Option<f64> {
        let values: Vec<f64> = self.of(policy).filter_map(value).collect();
        Estimate::of(&values).map(|estimate| estimate.mean)
    }
}

/// Each policy's score of each task and over all, then how well beliefs predict: a row a policy, a column a task.
pub fn render_suite(tasks: &[TaskRuns]) -> String {
    let policies = by_score(tasks);
    let names = || tasks.iter().map(|task| task.task.clone());
    let heading = |last: Option<&str>| {
        let last = last.map(String::from);
        ["policy".into()]
            .into_iter()
            .chain(names())
            .chain(last)
            .collect::<Vec<String>>()
    };
    let rows = policies.iter().map(|policy| scores(tasks, *policy));
    let scores = markdown(&heading(Some("score [95 %]")), rows);
    let belief = |value: fn(&PolicyRun) -> Option<f64>| {
        let row = |(policy, _): &(&str, Option<Aggregate>)| {
            let means: Vec<Option<f64>> =
                tasks.iter().map(|task| task.mean(policy, value)).collect();
            let cells = || {
                means
                    .iter()
                    .map(|mean| mean.map_or(NOTHING.into(), |mean| number(mean, 4)))
            };
            means
                .iter()
                .any(Option::is_some)
                .then(|| [(*policy).into()].into_iter().chain(cells()).collect())
        };
        let rows: Vec<Vec<String>> = policies.iter().filter_map(row).collect();
        markdown(&heading(None), rows.into_iter())
    };
    format!(
        "Scores: 0 is {FLOOR}'s mean reward of a task, 1 is {CEILING}'s; over all the interquartile mean \
         over the worlds of all tasks.\n\n{scores}\n\n\
         Log-likelihood of a visited cell (higher is better):\n\n{}\n\nBrier score (lower is better):\n\n{}\n",
        belief(|run| run.log_likelihood),
        belief(|run| run.brier),
    )
}

/// The cells of a policy's row: its mean score of each task, and over all.
fn scores(tasks: &[TaskRuns], (policy, score): (&str, Option<Aggregate>)) -> Vec<String> {
    let mean = |task: &TaskRuns| {
        Estimate::of(&task.scores(policy)).map_or(NOTHING.into(), |it| number(it.mean, 3))
    };
    [policy.to_owned()]
        .into_iter()
        .chain(tasks.iter().map(mean))
        .chain([told(score)])
        .collect()
}

/// All policies with their scores over tasks, the highest first; then those that lack a task, by name.
pub fn by_score(tasks: &[TaskRuns]) -> Vec<(&str, Option<Aggregate>)> {
    let names = tasks
        .iter()
        .flat_map(|task| task.runs.iter().map(|run| &*run.policy));
    let names: BTreeSet<&str> = names.collect();
    let score = |name: &str| {
        Aggregate::of(
            &tasks
                .iter()
                .map(|task| task.scores(name))
                .collect::<Vec<_>>(),
        )
    };
    let mut all: Vec<_> = names.into_iter().map(|name| (name, score(name))).collect();
    let mean = |score: Option<Aggregate>| score.map_or(f64::NEG_INFINITY, |score| score.mean);
    all.sort_by(|a, b| mean(b.1).total_cmp(&mean(a.1)));
    all
}

/// A score with its interval, as tables and figures show it.
pub fn told(score: Option<Aggregate>) -> String {
    let Some(Aggregate { mean, interval }) = score else {
        return NOTHING.into();
    };
    let mean = number(mean, 3);
    match interval.map(|ends| ends.map(|it| number(it, 3))) {
        Some([low, high]) => format!("{mean} [{low}, {high}]"),
        None => format!("{mean} (one world)"),
    }
}

fn reward(run: &PolicyRun) -> Option<f64> {
    Some(run.mean_reward)
}

/// The mean of what is left when a quarter of the numbers, rounded down, goes at each end.
fn interquartile_mean(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_by(f64::total_cmp);
    let n_cut = numbers.len() / 4;
    let middle = &numbers[n_cut..numbers.len() - n_cut];
    middle.iter().sum::<f64>() / middle.len() as f64
}

/// Between the two numbers around a share of sorted ones, in proportion.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let at = share * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    below + (above - below) * at.fract()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_score_is_that_of_rliable() {
        let tasks = [
            vec![0.21, 0.21, 0.33, 0.07, -0.03, 0.13, 0.24, 0.34],
            vec![0.57, 0.49, 0.79, 0.48, 0.56, 0.49, 0.81, 0.47],
            vec![1.09, 1.01, 0.69, 0.91, 0.53, 0.81, 0.86, 1.01],
        ];
        let Aggregate { mean, interval } = Aggregate::of(&tasks).expect("scores");
        let [low, high] = interval.expect("eight worlds");
        // rliable 1.2: 0.54583333, [0.4775 to 0.4783, 0.6200 to 0.6217] in three runs of 50,000 draws.
        assert!((mean - 0.545_833_333).abs() < 1e-8, "{mean}");
        assert!((low - 0.478).abs() < 0.003, "{low}");
        assert!((high - 0.621).abs() < 0.003, "{high}");
        assert_eq!(Aggregate::of(&tasks), Aggregate::of(&tasks));
        assert_eq!(Aggregate::of(&[vec![1.0], vec![]]), None);
        assert_eq!(interquartile_mean(vec![9.0, 1.0, 3.0, 2.0, -7.0]), 2.0);
    }

    #[test]
    fn a_task_of_one_world_leaves_no_interval() {
        for tasks in [
            vec![vec![0.5]],
            vec![vec![0.5], vec![0.5]],
            vec![vec![0.5], vec![0.4, 0.5, 0.6]],
        ] {
            let score = Aggregate::of(&tasks).expect("scores");
            let expected = Aggregate {
                mean: 0.5,
                interval: None,
            };
            assert_eq!(score, expected, "{tasks:?}");
            assert_eq!(told(Some(score)), "0.500 (one world)");
        }
        // Worlds of equal scores are an observation: their interval is a point.
        let equal = Aggregate::of(&[vec![0.5, 0.5]]).expect("scores");
        assert_eq!(told(Some(equal)), "0.500 [0.500, 0.500]");
    }
}
