//! The chart of the leaderboard.

use crate::benchmark::report::figures::{bar, save};
use crate::benchmark::report::policy_run::{PolicyRun, groups};
use crate::benchmark::report::statistics::Estimate;
use crate::benchmark::report::suite::{by_score, score_text, scores, tasks};
use crate::charts::{Bar, Ladder};
use anyhow::Result;
use std::path::Path;

/// Draws each policy's score over tasks, with a dot for its mean in each task. Policies that lack a task get only dots.
pub fn draw_leaderboard(path: &Path, runs: &[PolicyRun]) -> Result<()> {
    let (tasks, groups) = (tasks(runs), groups(runs));
    let mut bars = Vec::new();
    for (policy, score) in by_score(runs) {
        let mean = |task| Some(Estimate::of(&scores(runs, task, policy))?.mean);
        let means = (0..).zip(&tasks);
        let means = means.filter_map(|(index, task)| Some((index, mean(task)?)));
        let worlds: Vec<(u64, f64)> = means.collect();
        let group = groups.iter().find(|group| group.policy == policy);
        let Some(group) = group.filter(|_| !worlds.is_empty()) else {
            continue; // Without both ends of the scale there are no scores.
        };
        let label = match score {
            Some(score) => score_text(score),
            None => format!("{} of {} tasks", worlds.len(), tasks.len()),
        };
        bars.push(Bar {
            label,
            value: score.map_or(f64::NAN, |score| score.mean),
            ends: score.and_then(|score| score.interval),
            worlds,
            ..bar(group, &[])
        });
    }
    if bars.is_empty() {
        return Ok(());
    }
    let ladder = Ladder {
        title: "Score of each policy over tasks".into(),
        note: "bars are interquartile means over tasks and worlds, whiskers 95 % intervals, dots means of single tasks".into(),
        axis: "score: 0 is a random walk's, 1 an oracle's".into(),
        bars,
    };
    save(path, &ladder.svg()?)
}
