//! Means and standard errors over worlds, and paired differences between policies.
//!
//! A world is one sample. Its steps are too correlated to count as samples: the share of burning cells decorrelates
//! over thousands of steps. So every standard error here is over worlds.

use std::collections::BTreeMap;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    pub mean: f64,
    /// Standard error of the mean; `None` for a single world.
    pub standard_error: Option<f64>,
}

impl Estimate {
    /// Computes mean and standard error (with `n - 1`) of one value per world; `None` if there is no world.
    pub fn of(values: &[f64]) -> Option<Self> {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let standard_error = (n > 1.0).then(|| (squares / (n - 1.0) / n).sqrt());
        (n > 0.0).then_some(Self {
            mean,
            standard_error,
        })
    }

    /// Estimates the mean of `values - baseline` over the worlds that both have; `None` if they share none.
    pub fn of_difference(
        values: &BTreeMap<u64, f64>,
        baseline: &BTreeMap<u64, f64>,
    ) -> Option<Self> {
        let pairs = shared(values, baseline);
        let differences: Vec<f64> = pairs.map(|(value, base)| value - base).collect();
        Self::of(&differences)
    }
}

/// Returns the ratio of the means over common worlds. `None` without any, or if the reference's mean is not positive.
pub fn ratio_of_means(values: &BTreeMap<u64, f64>, reference: &BTreeMap<u64, f64>) -> Option<f64> {
    let (above, below): (Vec<f64>, Vec<f64>) = shared(values, reference).unzip();
    let (above, below): (f64, f64) = (above.iter().sum(), below.iter().sum());
    (below > 0.0).then(|| above / below)
}

fn shared<'a>(
    values: &'a BTreeMap<u64, f64>,
    others: &'a BTreeMap<u64, f64>,
) -> impl Iterator<Item = (f64, f64)> + 'a {
    values
        .iter()
        .filter_map(|(seed, &value)| Some((value, *others.get(seed)?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_pair_only_the_worlds_both_ran() {
        let a = BTreeMap::from([(1, 10.0), (2, 20.0), (3, 30.0)]);
        let b = BTreeMap::from([(2, 19.0), (3, 26.0), (4, 1000.0)]);
        // Differences 1 and 4: mean 2.5, variance 4.5, error sqrt(4.5 / 2) = 1.5.
        let got = Estimate::of_difference(&a, &b).expect("two shared worlds");
        assert_eq!((got.mean, got.standard_error), (2.5, Some(1.5)));
        let other = BTreeMap::from([(9, 1.0)]);
        assert_eq!(Estimate::of_difference(&a, &other), None);
    }

    #[test]
    fn ratios_need_a_positive_reference() {
        let worlds = |values: [f64; 2]| BTreeMap::from([(1, values[0]), (2, values[1])]);
        let ratio = |reference| ratio_of_means(&worlds([3.0, 6.0]), &worlds(reference));
        assert_eq!(ratio([4.0, 8.0]), Some(0.75));
        assert_eq!(ratio([1.0, -1.0]), None);
    }
}
