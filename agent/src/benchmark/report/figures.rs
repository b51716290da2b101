//! The charts of a comparison, written to files.

use crate::benchmark::report::number::{decimals, readable, with_error};
use crate::benchmark::report::policy_run::{Group, PolicyRun, groups};
use crate::benchmark::report::rewards::rewards;
use crate::benchmark::report::statistics::Estimate;
use crate::benchmark::report::teams::teams;
use crate::charts::{Bar, Ladder, Point, RGBColor};
use anyhow::Result;
use emberwatch_acting::beliefs::{self, LEARNED};
use emberwatch_acting::policy;
use emberwatch_learning::file::replace_file;
use std::collections::BTreeSet;
use std::path::Path;

/// Label of the reward axis for the wildfire model, whose reward is the number of distinct fire cells found.
pub const FIRE_CELLS_PER_STEP: &str = "distinct fire cells found per step";

const SHOOTING: (&str, RGBColor) = ("known model, shooting", RGBColor(0x56, 0xb4, 0xe9));

const ADDED: (&str, RGBColor) = ("added", RGBColor(0xcc, 0x79, 0xa7));

impl Estimate {
    /// Returns the estimate as a point of a curve, with the standard error as its band.
    pub fn at(self, x: f64) -> Point {
        Point {
            x,
            y: self.mean,
            error: self.standard_error.unwrap_or(0.0),
        }
    }
}

/// Writes an SVG page to `path`.
pub fn save(path: &Path, svg: &str) -> Result<()> {
    replace_file(path, svg.as_bytes())
}

/// Draws the mean reward per policy, the best at the top. `axis_label` names what the reward counts.
pub fn draw_ladder(path: &Path, runs: &[PolicyRun], axis_label: &str) -> Result<()> {
    let groups = groups(runs);
    let mean = |group: &Group<'_>| group.estimate(|run| Some(run.mean_reward));
    let mut means: Vec<(&Group<'_>, Estimate)> = groups
        .iter()
        .filter_map(|group| Some((group, mean(group)?)))
        .collect();
    means.sort_by(|a, b| b.1.mean.total_cmp(&a.1.mean));
    let decimals = decimals(means.iter().map(|it| it.1.mean));
    let bar = |&(group, mean): &(&Group<'_>, Estimate)| Bar {
        label: with_error(Some(mean), decimals),
        value: mean.mean,
        ends: mean
            .standard_error
            .map(|error| [mean.mean - error, mean.mean + error]),
        worlds: group
            .by_seed(|run| Some(run.mean_reward))
            .into_iter()
            .collect(),
        ..bar(group, &groups)
    };
    let ladder = Ladder {
        title: "Reward of each policy on the same worlds".into(),
        note: ladder_note(runs),
        axis: axis_label.into(),
        bars: means.iter().map(bar).collect(),
    };
    save(path, &ladder.svg()?)
}

pub(super) fn bar(group: &Group<'_>, groups: &[Group<'_>]) -> Bar {
    let team = format!("{} {}", group.team, group.robots);
    let team = groups.iter().any(Group::is_team).then_some(&*team);
    let estimator = Some(group.estimator).filter(|name| *name != "none");
    let remark: Vec<&str> = team.into_iter().chain(estimator).collect();
    let remark = match remark.as_slice() {
        [] => String::new(),
        remark => format!(" ({})", readable(&remark.join(", "))),
    };
    Bar {
        name: readable(group.policy),
        remark,
        label: String::new(),
        kind: kind(group),
        value: f64::NAN,
        ends: None,
        worlds: Vec::new(),
    }
}

fn kind(group: &Group<'_>) -> (&'static str, RGBColor) {
    if group.runs.iter().any(|run| run.is_added) {
        return ADDED;
    }
    let belief = beliefs::named(group.estimator).unwrap_or(&LEARNED);
    let samples = policy::planner_of(group.policy) == Some(&policy::SHOOTING);
    if belief.knows_model && samples {
        return SHOOTING;
    }
    let (legend, [red, green, blue]) = belief.chart;
    (legend, RGBColor(red, green, blue))
}

fn ladder_note(runs: &[PolicyRun]) -> String {
    let worlds: BTreeSet<u64> = runs.iter().map(|run| run.world_seed).collect();
    let steps = runs.iter().map(|run| run.steps).max().unwrap_or(0);
    match worlds.len() {
        1 => format!(
            "1 world, {steps} steps: bars are means over steps; one world gives no standard error"
        ),
        n => format!(
            "{n} worlds, {steps} steps each: bars are means over worlds, whiskers ±1 standard error, dots single worlds"
        ),
    }
}

/// Draws the total reward of a world's robots against the number of robots, with one curve per policy and kind of
/// team. Draws nothing if all runs have the same number of robots.
pub fn draw_teams(path: &Path, runs: &[PolicyRun], axis_label: &str) -> Result<()> {
    if runs.iter().all(|run| run.robots == runs[0].robots) {
        return Ok(());
    }
    save(path, &teams(runs, axis_label).svg()?)
}

/// Draws rewards over time, averaged over worlds, for the eight policies with the highest means.
pub fn draw_rewards(path: &Path, runs: &[PolicyRun], axis_label: &str) -> Result<()> {
    let recorded: Vec<PolicyRun> = runs
        .iter()
        .filter(|run| !run.rewards.is_empty())
        .cloned()
        .collect();
    save(path, &rewards(&recorded, axis_label).svg()?)
}
