//! The list of all parts of policies, for `--help`.

use super::goals::{GOALS, GoalEntry, OPTION_GOALS};
use super::names::NAMED;
use super::planners::PLANNERS;
use crate::beliefs::BELIEFS;
use emberwatch_belief::planning::options::OPTIONS;

/// Returns a description of each part of a policy, followed by the policies that have a short name.
pub fn help() -> String {
    let goals = |goals: &'static [GoalEntry]| {
        let goals = goals.iter();
        goals.map(|(_, name, about)| (*name, *about))
    };
    let state = ("STATE", "the probability of the state with this name");
    let options = OPTIONS.iter().map(|option| (option.name, option.about));
    let sections = [
        section("BELIEF", BELIEFS.iter().map(|it| (it.name, it.about))),
        section("PLANNER", PLANNERS.iter().map(|it| (it.name, it.about))),
        section("GOAL", goals(GOALS).chain([state])),
        section(
            "GOAL of the planner options",
            goals(OPTION_GOALS).chain(options),
        ),
        section("Names", NAMED.iter().copied()),
    ];
    format!(
        "A policy is BELIEF/PLANNER/GOAL, such as learned+spatial/beam/exploit, or one of the names below.\n{}",
        sections.concat()
    )
}

fn section(title: &str, lines: impl Iterator<Item = (&'static str, &'static str)>) -> String {
    let lines: Vec<_> = lines.collect();
    let width = lines.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
    let lines = lines.iter();
    let lines = lines.map(|(name, about)| format!("  {name:width$}  {about}\n"));
    format!("{title}:\n{}", lines.collect::<String>())
}

#[cfg(test)]
mod tests {
    #[test]
    fn each_part_has_a_line() {
        let help = super::help();
        let parts = "known+spatial ahead exploit_only best_region oracle_policy";
        for name in parts.split(' ') {
            let start = format!("{name} ");
            let mut lines = help.lines().map(str::trim_start);
            assert!(lines.any(|line| line.starts_with(&start)), "{help}");
        }
        assert!(help.lines().all(|line| line.len() <= 120), "{help}");
    }
}
