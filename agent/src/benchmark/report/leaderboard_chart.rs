//! The chart of the leaderboard.

use crate::benchmark::report::figures::{bar, save};
use crate::benchmark::report::leaderboard::{Entry, merged};
use crate::benchmark::report::policy_run::groups;
use crate::benchmark::report::statistics::Estimate;
use crate::benchmark::report::suite::{by_score, score_text};
use crate::charts::{Bar, Ladder};
use anyhow::Result;
use std::path::Path;

/// Draws each entry's score over tasks, with a dot for its mean in each task. Entries that lack a task get only dots.
pub fn draw_leaderboard(path: &Path, entries: &[Entry]) -> Result<()> {
    let tasks = merged(entries);
    let bars = by_score(&tasks).into_iter().filter_map(|(policy, score)| {
        let means = tasks.iter().enumerate().filter_map(|(index, task)| {
            let mean = Estimate::of(&task.scores(policy))?.mean;
            Some((index as u64, mean))
        });
        let means: Vec<(u64, f64)> = means.collect();
        let runs = tasks.iter().flat_map(|task| &task.runs);
        let run = runs.clone().find(|run| run.policy == policy)?;
        let group = &groups(std::slice::from_ref(run))[0];
        let label = match score {
            Some(score) => score_text(score),
            None => format!("{} of {} tasks", means.len(), tasks.len()),
        };
        let bar = Bar {
            label,
            value: score.map_or(f64::NAN, |score| score.mean),
            ends: score.and_then(|score| score.interval),
            worlds: means,
            ..bar(group, &[])
        };
        (!bar.worlds.is_empty()).then_some(bar)
    });
    let bars: Vec<Bar> = bars.collect();
    if bars.is_empty() {
        return Ok(()); // Without both ends of the scale there are no scores.
    }
    let ladder = Ladder {
        title: "Score of each policy over tasks".into(),
        note: "bars are interquartile means over tasks and worlds, whiskers 95 % intervals, dots means of single tasks".into(),
        axis: "score: 0 is a random walk's, 1 an oracle's".into(),
        bars,
    };
    save(path, &ladder.svg()?)
}
