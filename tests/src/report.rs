//! Statistics that benchmarks print.

use std::io::Write;

pub fn say(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// Returns quantiles of values: 0.5 is the median, 1.0 the maximum.
pub fn quantiles<const N: usize>(mut numbers: Vec<f64>, shares: [f64; N]) -> [f64; N] {
    numbers.sort_unstable_by(f64::total_cmp);
    let last = numbers.len() - 1;
    shares.map(|share| numbers[last.min((numbers.len() as f64 * share) as usize)])
}
