//! The comparison as text that fits a terminal, and that Markdown renders as tables.

use crate::benchmark::report::columns::Columns;
use crate::benchmark::report::merit::merit_table;
use crate::benchmark::report::number::{NOTHING, decimals, number};
use crate::benchmark::report::policy_run::{Group, PolicyRun, groups};
use crate::benchmark::report::statistics::ratio_of_means;
use std::collections::{BTreeMap, BTreeSet};

/// Estimator label of the oracles. The table shows rewards as a percentage of the best oracle's reward.
const TRUTH: &str = "truth";

/// Renders the rewards and figures of merit of every policy over all worlds, then the rewards by amount of fire.
///
/// Policies keep their order. `baseline` names the policy that paired differences are relative to.
pub fn render_table(runs: &[PolicyRun], baseline: &str) -> String {
    let groups = groups(runs);
    if groups.is_empty() {
        return "No results: no policy was run.\n".into();
    }
    let heading = heading(runs, &groups, baseline);
    let summary = summary(&groups, baseline);
    let merit = merit_table(&groups, baseline);
    let merit = merit.map_or(String::new(), |table| format!("{table}\n\n"));
    let split = split_by_fire(runs, &groups);
    format!("{heading}\n\n{summary}\n\n{merit}{split}\n")
}

fn heading(runs: &[PolicyRun], groups: &[Group<'_>], baseline: &str) -> String {
    let seeds: BTreeSet<u64> = runs.iter().map(|run| run.world_seed).collect();
    let worlds = counted(seeds.len(), "world");
    let steps = || runs.iter().map(|run| run.steps);
    let steps = match (steps().min().unwrap_or(0), steps().max().unwrap_or(0)) {
        (least, most) if least == most => counted(most as usize, "step"),
        (least, most) => format!("{least} to {most} steps"),
    };
    let error = match seeds.len() {
        1 => "one world: no standard error is possible",
        _ => "± is one standard error over worlds",
    };
    let baseline = if groups.iter().any(|group| group.policy == baseline) {
        let same = if groups.iter().any(Group::is_team) {
            " alone with as many robots"
        } else {
            ""
        };
        format!("differences are paired by world, to {baseline}{same}")
    } else {
        format!("no differences: baseline {baseline:?} was not run")
    };
    format!("{worlds}, {steps} each; {error}; {baseline}.")
}

fn summary(groups: &[Group<'_>], baseline: &str) -> String {
    let decimals = decimals(groups.iter().flat_map(rewards));
    let has_teams = groups.iter().any(Group::is_team);
    let mut columns = Columns::of_names(groups);
    columns.add_estimate("mean reward", decimals, &reward);
    if has_teams {
        let share = |run: &PolicyRun| Some(run.mean_reward / f64::from(run.robots));
        columns.add_mean("per robot", decimals, &share);
    }
    columns.add_difference(baseline, decimals, &reward);
    columns.add_mean("distinct cells", 1, &|run| Some(run.mean_distinct_cells));
    columns.add_mean("hit rate", 3, &|run| Some(run.hit_rate));
    if has_teams {
        columns.add_mean("repeated", 3, &|run| Some(run.mean_repeated));
    }
    if groups.iter().any(|group| group.estimator == TRUTH) {
        columns.add("% of oracle", |group| percent_of_oracle(group, groups));
    }
    columns.add_mean("Brier", 4, &|run| run.brier);
    columns.add_mean("ms/plan", 3, &|run| Some(run.mean_plan_millis));
    columns.table()
}

fn reward(run: &PolicyRun) -> Option<f64> {
    Some(run.mean_reward)
}

fn rewards(group: &Group<'_>) -> impl Iterator<Item = f64> {
    group.by_seed(reward).into_values()
}

/// Renders a group's reward as a percentage of the reward of the best oracle with the same number of robots.
fn percent_of_oracle(group: &Group<'_>, groups: &[Group<'_>]) -> String {
    let wanted = (TRUTH, group.robots);
    let oracles = groups.iter();
    let oracles = oracles.filter(|it| (it.estimator, it.robots) == wanted);
    let mean = |oracle: &Group<'_>| oracle.estimate(reward).map_or(f64::MIN, |it| it.mean);
    let oracle = oracles.max_by(|a, b| mean(a).total_cmp(&mean(b)));
    let ratio =
        oracle.and_then(|oracle| ratio_of_means(&group.by_seed(reward), &oracle.by_seed(reward)));
    ratio.map_or(NOTHING.into(), |ratio| number(100.0 * ratio, 1))
}

/// Renders mean rewards over the half of the worlds with less fire, and over the half with more fire. If the number of
/// worlds is odd, the middle world belongs to the half with more fire.
fn split_by_fire(runs: &[PolicyRun], groups: &[Group<'_>]) -> String {
    let mut fire_of: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for run in runs {
        let fires = fire_of.entry(run.world_seed).or_default();
        fires.push(run.mean_fire_cells);
    }
    let mean = |fires: &Vec<f64>| fires.iter().sum::<f64>() / fires.len() as f64;
    let worlds = fire_of.iter().map(|(&seed, fires)| (mean(fires), seed));
    let mut worlds: Vec<(f64, u64)> = worlds.collect();
    worlds.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let (less, more) = worlds.split_at(worlds.len() / 2);
    let Some((below, _)) = less.last() else {
        return "No split by fire: one world has no halves.".into();
    };
    let median = if less.len() == more.len() {
        (below + more[0].0) / 2.0
    } else {
        more[0].0
    };
    let decimals = decimals(groups.iter().flat_map(rewards));
    let mut columns = Columns::of_names(groups);
    for (name, half) in [("less", less), ("more", more)] {
        let is_in = |run: &PolicyRun| half.iter().any(|world| world.1 == run.world_seed);
        let heading = format!("{name} fire ({})", counted(half.len(), "world"));
        let value = move |run: &PolicyRun| reward(run).filter(|_| is_in(run));
        columns.add_estimate(&heading, decimals, &value);
    }
    format!(
        "Mean reward by fire, split at the median of {} burning cells:\n\n{}",
        number(median, 1),
        columns.table()
    )
}

fn counted(n: usize, what: &str) -> String {
    match n {
        1 => format!("1 {what}"),
        n => format!("{n} {what}s"),
    }
}
