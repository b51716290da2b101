//! The comparison as text that fits a terminal, and that Markdown renders as tables.

use crate::benchmark::report::columns::Columns;
use crate::benchmark::report::merit::merit_table;
use crate::benchmark::report::number::{NOTHING, decimals, number};
use crate::benchmark::report::policy_run::{Group, PolicyRun, groups};
use crate::benchmark::report::statistics::ratio_of_means;
use std::collections::BTreeSet;

const TRUTH: &str = "truth";

/// Renders rewards and figures of merit. `baseline` is the policy that paired differences are relative to.
pub fn render_table(runs: &[PolicyRun], baseline: &str) -> String {
    let groups = groups(runs);
    if groups.is_empty() {
        return "No results: no policy was run.\n".into();
    }
    let heading = heading(runs, &groups, baseline);
    let summary = summary(&groups, baseline);
    let merit = merit_table(&groups, baseline);
    let merit = merit.map_or(String::new(), |table| format!("\n{table}\n"));
    format!("{heading}\n\n{summary}\n{merit}")
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

fn counted(n: usize, what: &str) -> String {
    match n {
        1 => format!("1 {what}"),
        n => format!("{n} {what}s"),
    }
}
