//! The comparison as text: fits a terminal, and pastes into Markdown as a table.

use crate::benchmark::report::merit::merit_table;
use crate::benchmark::report::number::{NOTHING, decimals, number, signed, with_error};
use crate::benchmark::report::plain_table::plain_table;
use crate::benchmark::report::policy_run::{ALONE, Group, PolicyRun, groups};
use crate::benchmark::report::statistics::{Estimate, median, ratio_of_means};
use comfy_table::Table;
use std::collections::{BTreeMap, BTreeSet};

/// The policy that others are given as a percentage of: the best planner fed with the true state.
const ORACLE: &str = "oracle_beam";

/// Every policy over all worlds, its figures of merit, then the worlds with less and with more fire.
///
/// Policies stand in the order given; `baseline` names the one that paired differences are to.
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
    let worlds = match seeds.len() {
        1 => "1 world".to_string(),
        n => format!("{n} worlds"),
    };
    let steps = || runs.iter().map(|run| run.steps);
    let steps = match (steps().min().unwrap_or(0), steps().max().unwrap_or(0)) {
        (1, 1) => "1 step".to_string(),
        (least, most) if least == most => format!("{most} steps"),
        (least, most) => format!("{least} to {most} steps"),
    };
    let error = match seeds.len() {
        1 => "one world: no standard error is possible",
        _ => "± is one standard error over worlds",
    };
    let baseline = if groups.iter().any(|group| group.policy == baseline) {
        let same = match groups.iter().any(Group::is_team) {
            true => " alone with as many robots",
            false => "",
        };
        format!("differences are paired by world, to {baseline}{same}")
    } else {
        format!("no differences: baseline {baseline:?} was not run")
    };
    format!("{worlds}, {steps} each; {error}; {baseline}.")
}

/// What rows of the summary are compared with.
struct References<'a> {
    groups: &'a [Group<'a>],
    baseline: &'a str,
    has_teams: bool,
    has_oracle: bool,
}

impl References<'_> {
    /// Mean rewards by world of a policy, with as many robots as a group's; `is_one` chooses among its teams.
    fn rewards(
        &self,
        policy: &str,
        group: &Group<'_>,
        is_one: impl Fn(&Group<'_>) -> bool,
    ) -> Option<BTreeMap<u64, f64>> {
        let mut all = self.groups.iter();
        let found = all
            .rfind(|other| (other.policy, other.robots) == (policy, group.robots) && is_one(other));
        found.map(|found| found.by_seed(|run| run.mean_reward))
    }

    fn difference(&self, group: &Group<'_>, decimals: usize) -> String {
        let is_alone = |group: &Group<'_>| group.team == ALONE;
        if group.policy == self.baseline && is_alone(group) {
            return "baseline".into();
        }
        let rewards = group.by_seed(|run| run.mean_reward);
        match self.rewards(self.baseline, group, is_alone) {
            Some(base) => signed(Estimate::of_difference(&rewards, &base), decimals),
            None => NOTHING.into(),
        }
    }

    fn percent_of_oracle(&self, group: &Group<'_>) -> String {
        let rewards = group.by_seed(|run| run.mean_reward);
        let oracle = self.rewards(ORACLE, group, |_| true);
        let ratio = oracle.and_then(|oracle| ratio_of_means(&rewards, &oracle));
        ratio.map_or(NOTHING.into(), |ratio| number(100.0 * ratio, 1))
    }
}

fn summary(groups: &[Group<'_>], baseline: &str) -> Table {
    let references = References {
        groups,
        baseline,
        has_teams: groups.iter().any(Group::is_team),
        has_oracle: groups.iter().any(|group| group.policy == ORACLE),
    };
    let reward = |run: &PolicyRun| run.mean_reward;
    let decimals = decimals(groups.iter().flat_map(|group| group.values(reward)));
    let teams = |names: &'static [&'static str]| names.iter().filter(|_| references.has_teams);
    let mut header = vec!["policy", "estimator"];
    header.extend(teams(&["team", "robots"]));
    header.push("mean reward");
    header.extend(teams(&["per robot"]));
    header.extend(["difference", "distinct cells", "hit rate"]);
    header.extend(teams(&["repeated"]));
    header.extend(references.has_oracle.then_some("% of oracle"));
    header.extend(["Brier", "ms/plan"]);
    let mut table = plain_table(&header);
    for group in groups {
        table.add_row(summary_row(group, &references, decimals));
    }
    table
}

fn summary_row(group: &Group<'_>, references: &References<'_>, decimals: usize) -> Vec<String> {
    let rewards = group.values(|run| run.mean_reward);
    let brier = group.runs.iter().filter_map(|run| run.brier).collect();
    let teams = |texts: Vec<String>| texts.into_iter().filter(|_| references.has_teams);
    let mut row = vec![group.policy.to_string(), group.estimator.to_string()];
    row.extend(teams(vec![group.team.into(), group.robots.to_string()]));
    row.push(with_error(Estimate::of(&rewards), decimals));
    let share = |run: &PolicyRun| run.mean_reward / f64::from(run.robots);
    row.extend(teams(vec![mean(group.values(share), decimals)]));
    row.push(references.difference(group, decimals));
    row.push(mean(group.values(|run| run.mean_distinct_cells), 1));
    row.push(mean(group.values(|run| run.hit_rate), 3));
    row.extend(teams(vec![mean(group.values(|run| run.mean_repeated), 3)]));
    row.extend(
        references
            .has_oracle
            .then(|| references.percent_of_oracle(group)),
    );
    row.push(mean(brier, 4));
    row.push(mean(group.values(|run| run.mean_plan_millis), 3));
    row
}

/// Mean rewards over the half of the worlds with less fire and the half with more; the middle one
/// of an odd number of worlds goes to the latter.
fn split_by_fire(runs: &[PolicyRun], groups: &[Group<'_>]) -> String {
    let mut fire_of: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for run in runs {
        fire_of
            .entry(run.world_seed)
            .or_default()
            .push(run.mean_fire_cells);
    }
    if fire_of.len() < 2 {
        return "No split by fire: one world has no halves.".into();
    }
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let mut worlds: Vec<(f64, u64)> = fire_of
        .iter()
        .map(|(&seed, fires)| (mean(fires), seed))
        .collect();
    worlds.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let fires: Vec<f64> = worlds.iter().map(|world| world.0).collect();
    let (less, more) = worlds.split_at(worlds.len() / 2);
    let heading = format!(
        "Mean reward by fire, split at the median of {} burning cells:",
        number(median(&fires).unwrap_or(0.0), 1)
    );
    format!("{heading}\n\n{}", split_table(groups, less, more))
}

fn split_table(groups: &[Group<'_>], less: &[(f64, u64)], more: &[(f64, u64)]) -> Table {
    let worlds = |half: &[(f64, u64)]| match half.len() {
        1 => "1 world".to_string(),
        n => format!("{n} worlds"),
    };
    let less_title = format!("less fire ({})", worlds(less));
    let more_title = format!("more fire ({})", worlds(more));
    let has_teams = groups.iter().any(Group::is_team);
    let mut header = vec!["policy", "estimator"];
    header.extend(["team", "robots"].iter().filter(|_| has_teams));
    header.extend([&*less_title, &*more_title]);
    let mut table = plain_table(&header);
    let all = groups
        .iter()
        .flat_map(|group| group.values(|run| run.mean_reward));
    let decimals = decimals(all);
    for group in groups {
        let rewards = group.by_seed(|run| run.mean_reward);
        let half = |half: &[(f64, u64)]| {
            let values: Vec<f64> = half
                .iter()
                .filter_map(|(_, seed)| rewards.get(seed).copied())
                .collect();
            with_error(Estimate::of(&values), decimals)
        };
        let mut row = vec![group.policy.to_string(), group.estimator.to_string()];
        let team = [group.team.to_string(), group.robots.to_string()];
        row.extend(team.into_iter().filter(|_| has_teams));
        row.extend([half(less), half(more)]);
        table.add_row(row);
    }
    table
}

fn mean(values: Vec<f64>, decimals: usize) -> String {
    Estimate::of(&values).map_or(NOTHING.into(), |estimate| number(estimate.mean, decimals))
}
