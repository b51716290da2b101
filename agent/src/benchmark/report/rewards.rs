//! Plots rewards over time: a moving average per policy, with standard errors over worlds.

use crate::benchmark::report::number::readable;
use crate::benchmark::report::policy_run::{Group, PolicyRun, groups};
use crate::benchmark::report::statistics::Estimate;
use crate::charts::{Curve, Lines, MAX_CURVES, Panel, Scale};
use std::collections::BTreeSet;

const MAX_POINTS: usize = 500;
/// The moving average spans about 1 / `WINDOWS` of the steps.
const WINDOWS: usize = 40;

/// Returns the page for these runs, each of which has at least one reward.
pub fn rewards(runs: &[PolicyRun], axis_label: &str) -> Lines {
    let groups = groups(runs);
    let n_steps = runs.iter().map(|run| run.rewards.len()).max();
    let window = window(n_steps.unwrap_or(0));
    let curves = curves(&groups, window);
    Lines {
        title: title(runs),
        note: note(runs, window, (curves.len(), groups.len())),
        axis: "step k".into(),
        panels: vec![Panel {
            title: axis_label.into(),
            scale: Scale::Linear,
            curves,
        }],
    }
}

fn title(runs: &[PolicyRun]) -> String {
    let worlds: BTreeSet<u64> = runs.iter().map(|run| run.world_seed).collect();
    match worlds.first() {
        Some(seed) if worlds.len() == 1 => format!("Reward over time on world {seed}"),
        _ => format!("Reward over time, mean over {} worlds", worlds.len()),
    }
}

fn note(runs: &[PolicyRun], window: usize, (shown, n_policies): (usize, usize)) -> String {
    let mut note = match window {
        1 => "each step".to_string(),
        window => format!("moving average over the last {window} steps"),
    };
    if runs.iter().any(|run| run.world_seed != runs[0].world_seed) {
        note += "; bands: ±1 standard error over worlds";
    }
    if shown < n_policies {
        note += &format!("; the best {shown} of {n_policies} policies");
    }
    note
}

fn curves(groups: &[Group<'_>], window: usize) -> Vec<Curve> {
    let mean = |group: &Group<'_>| {
        let rewards = || group.runs.iter().flat_map(|run| &run.rewards);
        rewards().copied().map(f64::from).sum::<f64>() / rewards().count() as f64
    };
    let mut ranked: Vec<&Group<'_>> = groups.iter().collect();
    ranked.sort_by(|a, b| mean(b).total_cmp(&mean(a)));
    let best = ranked.into_iter().take(MAX_CURVES);
    best.map(|group| curve(group, readable(&group.name(groups)), window))
        .collect()
}

fn curve(group: &Group<'_>, name: String, window: usize) -> Curve {
    let lengths = group.runs.iter().map(|run| run.rewards.len());
    let n_steps = lengths.min().unwrap_or(0);
    let worlds = group.runs.iter().map(|run| &run.rewards[..n_steps]);
    let worlds: Vec<_> = worlds
        .map(|rewards| moving_average(rewards, window))
        .collect();
    let point = |at: usize| {
        let values: Vec<f64> = worlds.iter().map(|averages| averages[at].1).collect();
        Some(Estimate::of(&values)?.at(worlds[0][at].0))
    };
    let n_points = worlds.first().map_or(0, Vec::len);
    let points = (0..n_points).filter_map(point).collect();
    Curve { name, points }
}

fn window(n_steps: usize) -> usize {
    let target = (n_steps / WINDOWS).max(1);
    let round = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000];
    round
        .into_iter()
        .rev()
        .find(|&window| window <= target)
        .unwrap_or(1)
}

/// Returns pairs of a step, counted from 1, and the mean of the `window` values up to and including that step.
fn moving_average(values: &[f32], window: usize) -> Vec<(f64, f64)> {
    let window = window.min(values.len()).max(1);
    let mut sums = vec![0.0_f64];
    for &value in values {
        sums.push(sums[sums.len() - 1] + f64::from(value));
    }
    let stride = values.len().div_ceil(MAX_POINTS).max(1);
    let last = values.len();
    // Counting back from the last step always includes that step, whatever the stride.
    let mut ends: Vec<usize> = (window..=last).rev().step_by(stride).collect();
    ends.reverse();
    let average = |end: usize| (end as f64, (sums[end] - sums[end - window]) / window as f64);
    ends.into_iter().map(average).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moving_averages_look_back_over_the_window() {
        let values = [1.0, 3.0, 5.0, 7.0];
        let expected = [(2.0, 2.0), (3.0, 4.0), (4.0, 6.0)];
        assert_eq!(moving_average(&values, 2), expected);
        assert_eq!(moving_average(&values, 9), [(4.0, 4.0)]);
        assert_eq!(moving_average(&[], 3), []);
        let long = vec![1.0; 25_000];
        let points = moving_average(&long, 500);
        assert!(points.len() <= MAX_POINTS && points.last() == Some(&(25_000.0, 1.0)));
    }

    #[test]
    fn windows_are_round_and_never_zero() {
        assert_eq!([0, 1, 100, 1_500, 25_000].map(window), [1, 1, 2, 20, 500]);
    }
}
