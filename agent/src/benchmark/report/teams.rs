//! Plots the reward of a team against its number of robots.

use crate::benchmark::report::number::readable;
use crate::benchmark::report::policy_run::{Group, PolicyRun, groups};
use crate::charts::{Curve, Lines, Panel, Point, Scale};
use std::collections::BTreeSet;

/// Returns the page: one curve per policy and kind of team, in the given order.
pub fn teams(runs: &[PolicyRun], axis_label: &str) -> Lines {
    let groups = groups(runs);
    let mut kinds: Vec<(&str, &str)> = Vec::new();
    for kind in groups.iter().map(|group| (group.policy, group.team)) {
        if !kinds.contains(&kind) {
            kinds.push(kind);
        }
    }
    let worlds: BTreeSet<u64> = runs.iter().map(|run| run.world_seed).collect();
    let note = match worlds.len() {
        1 => "1 world".into(),
        n => format!("means over {n} worlds; bands: ±1 standard error"),
    };
    let curves = kinds.iter().map(|&kind| curve(kind, &kinds, &groups));
    Lines {
        title: "Reward of all robots of a world together".into(),
        note,
        axis: "robots".into(),
        panels: vec![Panel {
            title: axis_label.into(),
            scale: Scale::Linear,
            curves: curves.collect(),
        }],
    }
}

fn curve((policy, team): (&str, &str), kinds: &[(&str, &str)], groups: &[Group<'_>]) -> Curve {
    let n_twins = kinds.iter().filter(|kind| kind.1 == team).count();
    let name = match n_twins {
        1 => team.into(),
        _ => format!("{team}, {policy}"),
    };
    let own = groups
        .iter()
        .filter(|it| (it.policy, it.team) == (policy, team));
    let point = |group: &Group<'_>| {
        let reward = group.estimate(|run| Some(run.mean_reward))?;
        Some(reward.at(f64::from(group.robots)))
    };
    let mut points: Vec<Point> = own.filter_map(point).collect();
    points.sort_by(|a, b| a.x.total_cmp(&b.x));
    Curve {
        name: readable(&name),
        points,
    }
}
