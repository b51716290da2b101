//! Tables of a comparison, with one row per group.

use crate::benchmark::report::number::{NOTHING, number, signed, with_error};
use crate::benchmark::report::policy_run::{ALONE, Group, PolicyRun};
use crate::benchmark::report::statistics::Estimate;
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};

type Cell<'a> = Box<dyn Fn(&Group<'_>) -> String + 'a>;

/// The columns of a table, with their headings.
#[derive(Default)]
pub(super) struct Columns<'a>(Vec<(String, Cell<'a>)>);

impl<'a> Columns<'a> {
    /// Returns the columns that name each group. If any group is a team, they include team and number of robots.
    pub(super) fn of_names(groups: &[Group<'_>]) -> Self {
        let mut columns = Self::default();
        columns.add("policy", |group| group.policy.into());
        columns.add("estimator", |group| group.estimator.into());
        if groups.iter().any(Group::is_team) {
            columns.add("team", |group| group.team.into());
            columns.add("robots", |group| group.robots.to_string());
        }
        columns
    }

    pub(super) fn add(&mut self, heading: &str, cell: impl Fn(&Group<'_>) -> String + 'a) {
        self.0.push((heading.into(), Box::new(cell)));
    }

    /// Adds a column of means over worlds.
    pub(super) fn add_mean(
        &mut self,
        heading: &str,
        decimals: usize,
        value: impl Fn(&PolicyRun) -> Option<f64> + 'a,
    ) {
        self.add(heading, move |group| match group.estimate(&value) {
            Some(estimate) => number(estimate.mean, decimals),
            None => NOTHING.into(),
        });
    }

    /// Adds a column of means over worlds with standard errors.
    pub(super) fn add_estimate(
        &mut self,
        heading: &str,
        decimals: usize,
        value: impl Fn(&PolicyRun) -> Option<f64> + 'a,
    ) {
        let cell = move |group: &Group<'_>| with_error(group.estimate(&value), decimals);
        self.add(heading, cell);
    }

    /// Adds a column of differences from the baseline policy with the same number of robots in team `alone`. The
    /// differences are paired by world.
    pub(super) fn add_difference(
        &mut self,
        groups: &'a [Group<'a>],
        baseline: &'a str,
        decimals: usize,
        value: impl Fn(&PolicyRun) -> Option<f64> + 'a,
    ) {
        self.add("difference", move |group| {
            let wanted = (baseline, group.robots, ALONE);
            let is_baseline = |it: &Group<'_>| (it.policy, it.robots, it.team) == wanted;
            match groups.iter().rfind(|other| is_baseline(other)) {
                _ if is_baseline(group) => "baseline".into(),
                None => NOTHING.into(),
                Some(base) => {
                    let (values, base) = (group.by_seed(&value), base.by_seed(&value));
                    signed(Estimate::of_difference(&values, &base), decimals)
                }
            }
        });
    }

    pub(super) fn table(&self, groups: &[Group<'_>]) -> Table {
        let headings: Vec<&str> = self.0.iter().map(|column| &*column.0).collect();
        let cells = |group: &Group<'_>| self.0.iter().map(|(_, cell)| cell(group)).collect();
        markdown(&headings, groups.iter().map(cells))
    }
}

/// Builds a Markdown table. All columns except names are right-aligned.
pub(super) fn markdown<H: AsRef<str>>(
    headings: &[H],
    rows: impl Iterator<Item = Vec<String>>,
) -> Table {
    let mut table = Table::new();
    table
        .load_preset(presets::ASCII_MARKDOWN)
        .set_content_arrangement(ContentArrangement::Disabled)
        .set_header(headings.iter().map(AsRef::as_ref));
    for (column, heading) in table.column_iter_mut().zip(headings) {
        if !["policy", "estimator", "team"].contains(&heading.as_ref()) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table.add_rows(rows);
    table
}
