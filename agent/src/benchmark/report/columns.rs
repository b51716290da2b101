//! Markdown tables of comparisons, suites and the leaderboard.

use crate::acting::team::ALONE;
use crate::benchmark::report::number::{NOTHING, number, signed, with_error};
use crate::benchmark::report::policy_run::{Group, PolicyRun};
use crate::benchmark::report::statistics::Estimate;
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};

type Value<'a> = &'a dyn Fn(&PolicyRun) -> Option<f64>;

pub(super) struct Columns<'a> {
    groups: &'a [Group<'a>],
    headings: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl<'a> Columns<'a> {
    pub(super) fn new(groups: &'a [Group<'a>]) -> Self {
        Self {
            groups,
            headings: Vec::new(),
            rows: vec![Vec::new(); groups.len()],
        }
    }

    pub(super) fn of_names(groups: &'a [Group<'a>]) -> Self {
        let mut columns = Self::new(groups);
        columns.add("policy", |group| group.policy.into());
        columns.add("estimator", |group| group.estimator.into());
        if groups.iter().any(Group::is_team) {
            columns.add("team", |group| group.team.into());
            columns.add("robots", |group| group.robots.to_string());
        }
        columns
    }

    pub(super) fn add(&mut self, heading: &str, cell: impl Fn(&Group<'_>) -> String) {
        self.headings.push(heading.into());
        let rows = self.rows.iter_mut().zip(self.groups);
        rows.for_each(|(row, group)| row.push(cell(group)));
    }

    pub(super) fn add_mean(&mut self, heading: &str, decimals: usize, value: Value<'_>) {
        self.add(heading, |group| match group.estimate(value) {
            Some(estimate) => number(estimate.mean, decimals),
            None => NOTHING.into(),
        });
    }

    pub(super) fn add_estimate(&mut self, heading: &str, decimals: usize, value: Value<'_>) {
        self.add(heading, |it| with_error(it.estimate(value), decimals));
    }

    /// Differences from the baseline with as many robots, each alone, paired by world.
    pub(super) fn add_difference(&mut self, baseline: &str, decimals: usize, value: Value<'_>) {
        let groups = self.groups;
        self.add("difference", |group| {
            let wanted = (baseline, group.robots, ALONE);
            let is_baseline = |it: &Group<'_>| (it.policy, it.robots, it.team) == wanted;
            match groups.iter().rfind(|other| is_baseline(other)) {
                _ if is_baseline(group) => "baseline".into(),
                None => NOTHING.into(),
                Some(base) => {
                    let (values, base) = (group.by_seed(value), base.by_seed(value));
                    signed(Estimate::of_difference(&values, &base), decimals)
                }
            }
        });
    }

    pub(super) fn table(self) -> String {
        let headings: Vec<&str> = self.headings.iter().map(|it| &**it).collect();
        markdown(&headings, self.rows)
    }
}

pub(super) fn markdown(headings: &[&str], rows: Vec<Vec<String>>) -> String {
    let mut table = Table::new();
    table
        .load_preset(presets::ASCII_MARKDOWN)
        .set_content_arrangement(ContentArrangement::Disabled)
        .set_header(headings)
        .add_rows(rows);
    for (column, heading) in table.column_iter_mut().zip(headings) {
        if !["policy", "estimator", "team"].contains(heading) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table.to_string()
}
