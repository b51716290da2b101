//! The figures of merit as a table below that of the rewards.

use crate::benchmark::report::number::{NOTHING, signed, with_error};
use crate::benchmark::report::plain_table::plain_table;
use crate::benchmark::report::policy_run::{ALONE, Group, PolicyRun};
use crate::benchmark::report::statistics::Estimate;

const HEADER: [&str; 8] = [
    "policy",
    "detected",
    "after steps",
    "burning then",
    "burning seen %",
    "difference",
    "front",
    "grid seen %",
];

/// The table with its heading; `None` of runs that lack the figures, as those of old files do.
///
/// Differences are of the burning cells seen, paired by world, to `baseline`.
pub(super) fn merit_table(groups: &[Group<'_>], baseline: &str) -> Option<String> {
    let mut runs = groups.iter().flat_map(|group| &group.runs);
    let recent_steps = runs.find_map(|run| run.recent_steps)?;
    let mut heading = format!(
        "Figures of merit (docs/figures-of-merit.md): time to detection among the worlds where fire \
         was detected; burning\ncells seen in the last {recent_steps} steps; front: moves to the \
         nearest burning cell not seen in these.\n"
    );
    if groups
        .iter()
        .all(|group| group.known(burning_seen).is_empty())
    {
        heading += "No burning cells seen, and no front: no hidden states were published, or \
                    nothing burnt.\n";
    }
    let mut table = plain_table(&HEADER);
    for group in groups {
        table.add_row(row(group, groups, baseline));
    }
    Some(format!("{heading}\n{table}"))
}

fn row(group: &Group<'_>, groups: &[Group<'_>], baseline: &str) -> Vec<String> {
    let mean = |value: fn(&PolicyRun) -> Option<f64>| {
        let values: Vec<f64> = group.known(value).into_values().collect();
        with_error(Estimate::of(&values), 1)
    };
    vec![
        name(group, groups),
        detected(group),
        mean(|run| run.steps_to_detection.map(|steps| steps as f64)),
        mean(|run| run.burning_cells_at_detection.map(f64::from)),
        mean(burning_seen),
        difference(group, groups, baseline),
        mean(|run| run.front_distance),
        mean(|run| run.grid_seen_share.map(percent)),
    ]
}

/// The policy, with its estimator and team where there are several of it.
fn name(group: &Group<'_>, groups: &[Group<'_>]) -> String {
    match group.marks(groups).as_slice() {
        [] => group.policy.into(),
        marks => format!("{} ({})", group.policy, marks.join(", ")),
    }
}

/// In how many worlds fire was detected.
fn detected(group: &Group<'_>) -> String {
    let n_worlds = group.known(|run| run.grid_seen_share).len();
    let n_detected = group.known(|run| run.steps_to_detection.map(|_| 1.0)).len();
    match n_worlds {
        0 => NOTHING.into(),
        _ => format!("{n_detected} of {n_worlds}"),
    }
}

fn difference(group: &Group<'_>, groups: &[Group<'_>], baseline: &str) -> String {
    let is_baseline = |other: &Group<'_>| {
        (other.policy, other.robots, other.team) == (baseline, group.robots, ALONE)
    };
    match groups.iter().rfind(|other| is_baseline(other)) {
        _ if is_baseline(group) => "baseline".into(),
        None => NOTHING.into(),
        Some(base) => {
            let (seen, base) = (group.known(burning_seen), base.known(burning_seen));
            signed(Estimate::of_difference(&seen, &base), 1)
        }
    }
}

fn burning_seen(run: &PolicyRun) -> Option<f64> {
    run.burning_seen_share.map(percent)
}

fn percent(share: f64) -> f64 {
    100.0 * share
}
