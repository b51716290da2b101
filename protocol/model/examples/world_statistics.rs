//! Compares simulated worlds with the authors' simulator, statistic by statistic.
//!
//! `cargo run --release -p emberwatch-model --example world_statistics -- --runs 32`
//!
//! Exits with 1 if any statistic differs by more than 3 combined standard errors. With other seeds, a difference just
//! above 3 does not prove an error: the reference has only 7 runs, and the statistics are correlated.

#![expect(clippy::print_stdout, reason = "the table is the output")]

#[path = "../tests/model/statistics.rs"]
mod statistics;

use std::process::ExitCode;

/// Maximum difference in combined standard errors.
const BOUND: f64 = 3.0;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let n_runs = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [] => Some(32),
        ["--runs", n_runs] => n_runs.parse().ok().filter(|&n_runs| n_runs >= 2),
        _ => None,
    };
    let Some(n_runs) = n_runs else {
        eprintln!("usage: world_statistics [--runs N], N >= 2");
        return ExitCode::from(2);
    };
    if compare(n_runs) > BOUND {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    }
}

/// Prints the table and returns the largest deviation.
fn compare(n_runs: u64) -> f64 {
    let (ours, reference) = (statistics::simulate(0..n_runs), statistics::reference());
    println!(
        "{:46} {:>21} {:>21} {:>6}",
        "statistic", "ours", "reference", "diff"
    );
    let mut largest = 0.0;
    for (name, theirs) in &reference {
        let our = ours[name];
        let deviation = our.deviation(*theirs);
        let show = |e: statistics::Estimate| format!("{:.5} ± {:.5}", e.mean, e.se);
        println!(
            "{name:46} {:>21} {:>21} {deviation:>6.2}",
            show(our),
            show(*theirs)
        );
        largest = f64::max(largest, deviation.abs());
    }
    println!(
        "{} statistics, largest difference {largest:.2} se",
        reference.len()
    );
    largest
}
