//! Number formats of tables and figures.

use crate::benchmark::report::statistics::Estimate;

/// Placeholder for a missing number.
pub const NOTHING: &str = "-";

/// Returns the number of decimals, at least two, that shows about three digits of the largest absolute value.
pub fn decimals(values: impl Iterator<Item = f64>) -> usize {
    let largest = values.fold(0.0_f64, |largest, value| largest.max(value.abs()));
    match largest {
        _ if largest >= 1.0 || largest == 0.0 => 2,
        _ if largest >= 0.1 => 3,
        _ => 5,
    }
}

/// Formats `mean ± error`, or `mean (n = 1)` for a single world.
pub fn with_error(estimate: Option<Estimate>, decimals: usize) -> String {
    let Some(estimate) = estimate else {
        return NOTHING.into();
    };
    let mean = number(estimate.mean, decimals);
    match estimate.standard_error {
        Some(error) => format!("{mean} ± {}", number(error, decimals)),
        None => format!("{mean} (n = 1)"),
    }
}

pub(super) fn signed(estimate: Option<Estimate>, decimals: usize) -> String {
    match with_error(estimate, decimals) {
        text if text.starts_with('-') => text,
        text => format!("+{text}"),
    }
}

/// Formats a number with fixed decimals, without the sign of a negative zero.
pub fn number(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    if text.trim_start_matches(['-', '0', '.']).is_empty() {
        return text.trim_start_matches('-').into();
    }
    text
}

pub(super) fn readable(name: &str) -> String {
    name.replace('_', " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zeros_have_no_sign_and_small_values_keep_their_digits() {
        assert_eq!(number(-0.001, 2), "0.00");
        assert_eq!(number(-0.01, 2), "-0.01");
        assert_eq!(decimals([-48.0, 0.1].into_iter()), 2);
        assert_eq!(decimals([0.25].into_iter()), 3);
        assert_eq!(decimals([0.0123].into_iter()), 5);
        assert_eq!(decimals([0.0].into_iter()), 2);
    }
}
