//! The table of the figures of merit, below the table of rewards.

use crate::benchmark::report::columns::Columns;
use crate::benchmark::report::number::NOTHING;
use crate::benchmark::report::policy_run::{Group, PolicyRun};
use emberwatch_belief::merit::RECENT_STEPS;

/// `None` if the runs lack the figures of merit, as runs from old files do.
pub(super) fn merit_table(groups: &[Group<'_>], baseline: &str) -> Option<String> {
    let mut runs = groups.iter().flat_map(|group| &group.runs);
    runs.find_map(|run| run.grid_seen_share)?;
    let mut heading = format!(
        "Figures of merit (docs/figures-of-merit.md): time to detection among the worlds where fire \
         was detected; burning\ncells seen in the last {RECENT_STEPS} steps; front: moves to the \
         nearest burning cell not seen in these.\n"
    );
    if groups
        .iter()
        .all(|group| group.by_seed(burning_seen).is_empty())
    {
        heading += "No values for burning seen and front: no hidden states were published, or \
                    nothing burnt.\n";
    }
    let mut columns = Columns::new(groups);
    columns.add("policy", |group| group.name(groups));
    columns.add("detected", detected);
    columns.add_estimate("after steps", 1, &|run| {
        run.steps_to_detection.map(|steps| steps as f64)
    });
    columns.add_estimate("burning then", 1, &|run| {
        run.burning_cells_at_detection.map(f64::from)
    });
    columns.add_estimate("burning seen %", 1, &burning_seen);
    columns.add_difference(baseline, 1, &burning_seen);
    columns.add_estimate("front", 1, &|run| run.front_distance);
    columns.add_estimate("grid seen %", 1, &|run| run.grid_seen_share.map(percent));
    Some(format!("{heading}\n{}", columns.table()))
}

fn detected(group: &Group<'_>) -> String {
    let n_worlds = group.by_seed(|run| run.grid_seen_share).len();
    let detection = |run: &PolicyRun| run.steps_to_detection.map(|_| 1.0);
    match n_worlds {
        0 => NOTHING.into(),
        _ => format!("{} of {n_worlds}", group.by_seed(detection).len()),
    }
}

fn burning_seen(run: &PolicyRun) -> Option<f64> {
    run.burning_seen_share.map(percent)
}

fn percent(share: f64) -> f64 {
    100.0 * share
}
