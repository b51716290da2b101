//! The figures of a comparison, drawn by the crate `emberwatch-figures` and written to files.

use crate::benchmark::report::number::{decimals, readable, with_error};
use crate::benchmark::report::policy_run::{Group, PolicyRun, groups};
use crate::benchmark::report::rewards::rewards;
use crate::benchmark::report::statistics::Estimate;
use crate::benchmark::report::teams::teams;
use anyhow::{Context, Result, bail, ensure};
use emberwatch_figures::{Bar, Color, Ladder};
use emberwatch_learning::beliefs::{self, BELIEFS, BeliefKind, KNOWN, LEARNED};
use emberwatch_learning::file::{Readers, replace_file};
use emberwatch_learning::policy;
use std::collections::BTreeSet;
use std::path::Path;

/// Label of the reward axis for the wildfire model, whose reward is the number of distinct fire cells found.
pub const FIRE_CELLS_PER_STEP: &str = "distinct fire cells found per step";

/// Legend and colour of known-model policies that sample paths. Known-model policies that search have another colour.
const SHOOTING: (&str, Color) = ("known model, shooting", Color(0x56, 0xb4, 0xe9));

/// Legend and colour of rows from `--add`.
const ADDED: (&str, Color) = ("added", Color(0xcc, 0x79, 0xa7));

/// Writes an SVG page to `path`.
pub fn save(path: &Path, svg: &str) -> Result<()> {
    replace_file(path, svg.as_bytes(), Readers::Any)
}

/// Draws the mean reward per policy, the best at the top. `axis_label` names what the reward counts, such as
/// [`FIRE_CELLS_PER_STEP`].
pub fn draw_ladder(path: &Path, runs: &[PolicyRun], axis_label: &str) -> Result<()> {
    let title = "Reward of each policy on the same worlds";
    let means = groups(runs).iter().filter_map(mean).collect::<Vec<_>>();
    let decimals = decimals(means.iter().map(|it| it.mean));
    let height = |group: &Group<'_>| {
        let estimate = mean(group);
        Height {
            value: estimate.map_or(f64::NAN, |it| it.mean),
            ends: estimate.and_then(|it| {
                let error = it.standard_error?;
                Some([it.mean - error, it.mean + error])
            }),
            label: with_error(estimate, decimals),
        }
    };
    draw_bars(path, runs, [title, &ladder_note(runs), axis_label], &height)
}

/// The length and the label of a bar.
pub(super) struct Height {
    /// If the value is NaN, no bar is drawn.
    pub(super) value: f64,
    pub(super) ends: Option<[f64; 2]>,
    pub(super) label: String,
}

/// Draws one bar per policy, the best at the top, with a dot for each of the policy's runs.
pub(super) fn draw_bars(
    path: &Path,
    runs: &[PolicyRun],
    [title, note, axis]: [&str; 3],
    height: &dyn Fn(&Group<'_>) -> Height,
) -> Result<()> {
    ensure!(
        !runs.is_empty(),
        "ladder: expected at least one policy run, got none"
    );
    for run in runs {
        check_finite(run, "mean reward", std::iter::once(run.mean_reward))?;
    }
    let groups = groups(runs);
    let of_group = |group| bar(group, &groups, height(group));
    let mut bars: Vec<Bar> = groups.iter().map(of_group).collect();
    let rank = |bar: &Bar| {
        if bar.value.is_nan() {
            f64::NEG_INFINITY
        } else {
            bar.value
        }
    };
    bars.sort_by(|a, b| rank(b).total_cmp(&rank(a)));
    let is_used = |entry: &(&str, Color)| bars.iter().any(|bar| bar.color == entry.1);
    let ladder = Ladder {
        title: title.into(),
        note: note.into(),
        axis: axis.into(),
        legend: legend().into_iter().filter(is_used).collect(),
        bars,
    };
    save(path, &ladder.svg())
}

fn mean(group: &Group<'_>) -> Option<Estimate> {
    group.estimate(|run| Some(run.mean_reward))
}

fn bar(group: &Group<'_>, groups: &[Group<'_>], height: Height) -> Bar {
    let team = format!("{} {}", group.team, group.robots);
    let team = groups.iter().any(Group::is_team).then_some(&*team);
    let estimator = Some(group.estimator).filter(|name| *name != "none");
    let remark: Vec<&str> = team.into_iter().chain(estimator).collect();
    let remark = match remark.as_slice() {
        [] => String::new(),
        // SVG renderers drop an ordinary space between two text elements.
        remark => format!("\u{a0}({})", readable(&remark.join(", "))),
    };
    let pair = |run: &&PolicyRun| (run.world_seed, run.mean_reward);
    Bar {
        name: readable(group.policy),
        remark,
        label: height.label,
        color: chart(group).1,
        value: height.value,
        ends: height.ends,
        worlds: group.runs.iter().map(pair).collect(),
    }
}

/// Returns all entries of a legend, from the least to the most informed policies.
fn legend() -> Vec<(&'static str, Color)> {
    let mut all: Vec<_> = BELIEFS.iter().copied().map(chart_of).collect();
    let at = all.iter().position(|entry| *entry == chart_of(&KNOWN));
    all.insert(at.unwrap_or(0), SHOOTING);
    all.push(ADDED);
    all.dedup();
    all
}

fn chart_of(belief: &BeliefKind) -> (&'static str, Color) {
    let (legend, [red, green, blue]) = belief.chart;
    (legend, Color(red, green, blue))
}

/// Returns the legend and colour of a group, which depend on its belief.
fn chart(group: &Group<'_>) -> (&'static str, Color) {
    if group.runs.iter().any(|run| run.is_added) {
        return ADDED;
    }
    let belief = beliefs::named(group.estimator).unwrap_or(&LEARNED);
    let samples = policy::planner_of(group.policy) == Some(&policy::SHOOTING);
    if belief.knows_model && samples {
        return SHOOTING;
    }
    chart_of(belief)
}

/// Draws the total reward of a world's robots against the number of robots, with one curve per policy and kind of
/// team. Draws nothing if all runs have the same number of robots.
pub fn draw_teams(path: &Path, runs: &[PolicyRun], axis_label: &str) -> Result<()> {
    if runs.iter().all(|run| run.robots == runs[0].robots) {
        return Ok(());
    }
    for run in runs {
        check_finite(run, "mean reward", std::iter::once(run.mean_reward))?;
    }
    let svg = teams(runs, axis_label).svg();
    save(path, &svg.context("teams: expected runs, got none")?)
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

/// Draws rewards over time, averaged over worlds, for the eight policies with the highest means.
/// `fire_cells` is the number of burning cells per step, shaded in the background.
pub fn draw_rewards(
    path: &Path,
    runs: &[PolicyRun],
    axis_label: &str,
    fire_cells: Option<&[f32]>,
) -> Result<()> {
    let recorded: Vec<PolicyRun> = runs
        .iter()
        .filter(|run| !run.rewards.is_empty())
        .cloned()
        .collect();
    for run in &recorded {
        check_finite(run, "reward", run.rewards.iter().copied().map(f64::from))?;
    }
    let page = rewards(&recorded, axis_label, fire_cells.unwrap_or_default());
    let svg = page.svg();
    let svg = svg.context("rewards: expected at least one policy run, got none")?;
    save(path, &svg)
}

fn check_finite(run: &PolicyRun, what: &str, mut values: impl Iterator<Item = f64>) -> Result<()> {
    let (policy, seed) = (&run.policy, run.world_seed);
    match values.find(|value| !value.is_finite()) {
        Some(got) => bail!(
            "policy {policy:?} on world seed {seed}: {what}: expected a finite number, got {got}"
        ),
        None => Ok(()),
    }
}
