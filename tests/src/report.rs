//! Statistics that benchmarks and long runs print.

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

/// Formats the median, minimum and maximum.
pub fn range(numbers: Vec<f64>, digits: usize) -> String {
    let [median, least, most] = quantiles(numbers, [0.5, 0.0, 1.0]);
    format!("{median:.digits$} ({least:.digits$}-{most:.digits$})")
}

/// Formats the median, 99th percentile and maximum, in milliseconds.
pub fn spread(seconds: Vec<f64>) -> String {
    let [median, high, most] = quantiles(seconds, [0.5, 0.99, 1.0]).map(|seconds| seconds * 1e3);
    format!("p50 {median:.2} p99 {high:.2} max {most:.2} ms")
}
