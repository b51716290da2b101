//! Linear and logarithmic axes with ticks at round values, and the placement of labels without overlaps.

/// Minimum range of an axis, and maximum absolute value on it. Beyond these limits, ticks are not exact enough.
const MIN_RANGE: f64 = 1e-200;
const MAX_VALUE: f64 = 1e200;

/// Whether an axis can show a value.
pub fn is_drawable(value: f64) -> bool {
    value.abs() <= MAX_VALUE
}

#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    pub ticks: Vec<f64>,
    range: (f64, f64),
    decimals: usize,
}

impl Axis {
    /// Creates an axis that covers zero and all drawable values. It has about `n_ticks` ticks, with the first and the
    /// last tick at its ends.
    pub fn covering(values: impl Iterator<Item = f64>, n_ticks: usize) -> Self {
        let values = values.filter(|&value| is_drawable(value));
        let (least, most) = values.fold((0.0_f64, 0.0_f64), |(least, most), value| {
            (least.min(value), most.max(value))
        });
        let most = if most - least > MIN_RANGE {
            most
        } else {
            least + 1.0
        };
        let step = round_step((most - least) / n_ticks as f64);
        let (first, last) = ((least / step).floor() as i64, (most / step).ceil() as i64);
        let ticks = (first..=last).map(|tick| tick as f64 * step).collect();
        // Enough decimals to show the step exactly. The step is 1, 2, 2.5 or 5 times a power of ten.
        let exact = |decimals: &usize| {
            let shifted = step * 10_f64.powi(*decimals as i32);
            (shifted - shifted.round()).abs() < 1e-6 * shifted
        };
        let decimals = (0..12).find(exact).unwrap_or(12);
        Self {
            ticks,
            range: (first as f64 * step, last as f64 * step),
            decimals,
        }
    }

    /// Creates an axis from zero to exactly `n` (at least 1). Its ticks are whole numbers, and `n` is not always one of
    /// them.
    pub fn counting_to(n: usize, n_ticks: usize) -> Self {
        let most = n as f64;
        let mut axis = Self::covering(std::iter::once(most), n_ticks.min(n));
        axis.ticks
            .retain(|&tick| tick <= most && tick.fract() == 0.0);
        axis.decimals = 0;
        axis.range = (0.0, most);
        axis
    }

    /// Creates an axis for base-10 logarithms, which must be finite. Ticks are at whole powers of ten.
    pub fn of_powers(logarithms: impl Iterator<Item = f64>) -> Self {
        let (least, most) = logarithms.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), value| {
            (a.min(value), b.max(value))
        });
        let first = if least.is_finite() {
            least.floor()
        } else {
            0.0
        };
        let last = most.ceil().max(first + 1.0);
        Self {
            ticks: (0..=(last - first) as i64)
                .map(|tick| first + tick as f64)
                .collect(),
            range: (first, last),
            decimals: 0,
        }
    }

    /// Returns the position of a value on the axis: 0 at the start of its range, 1 at the end.
    pub fn fraction(&self, value: f64) -> f64 {
        let (first, last) = self.range;
        (value - first) / (last - first)
    }

    pub fn label(&self, tick: f64) -> String {
        let most = self.range.0.abs().max(self.range.1.abs());
        if self.decimals <= 6 && most < 1e7 {
            format!("{tick:.*}", self.decimals)
        } else if tick == 0.0 {
            "0".into()
        } else {
            format!("{:e}", format!("{tick:.2e}").parse().unwrap_or(tick))
        }
    }
}

/// Rounds `step` up to 1, 2, 2.5, 5 or 10 times a power of ten.
fn round_step(step: f64) -> f64 {
    let power = 10_f64.powf(step.log10().floor());
    let factor = [1.0, 2.0, 2.5, 5.0]
        .into_iter()
        .find(|factor| factor * power >= step * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

/// Moves positions so that neighbours are at least `gap` apart, and so that all positions lie within `least..=most` if
/// they fit. Minimises the sum of squared displacements. Equal positions keep their order.
pub fn spread(positions: &[f64], gap: f64, (least, most): (f64, f64)) -> Vec<f64> {
    let mut order: Vec<usize> = (0..positions.len()).collect();
    order.sort_by(|&a, &b| positions[a].total_cmp(&positions[b]));
    // After subtracting the gaps, this is isotonic regression: merge neighbours that are out of order.
    let mut pools: Vec<(f64, usize)> = Vec::new();
    for (rank, &index) in order.iter().enumerate() {
        let mut pool = (positions[index] - gap * rank as f64, 1);
        while let Some(before) = pools.pop_if(|before| before.0 > pool.0) {
            let n = before.1 + pool.1;
            let sum = before.0 * before.1 as f64 + pool.0 * pool.1 as f64;
            pool = (sum / n as f64, n);
        }
        pools.push(pool);
    }
    let highest = most - gap * positions.len().saturating_sub(1) as f64;
    let moved = pools.iter().flat_map(|&(at, n)| std::iter::repeat_n(at, n));
    let mut spread = vec![0.0; positions.len()];
    for ((rank, &index), at) in order.iter().enumerate().zip(moved) {
        spread[index] = at.min(highest).max(least) + gap * rank as f64;
    }
    spread
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_cover_zero_and_the_values() {
        let none: [f64; 6] = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0];
        for (values, ticks, label) in [
            (
                vec![38.0, 47.9],
                &[0.0, 10.0, 20.0, 30.0, 40.0, 50.0][..],
                "10",
            ),
            (vec![-3.0, 1.0], &[-3.0, -2.0, -1.0, 0.0, 1.0], "-2"),
            (vec![0.011], &none.map(|tick| tick / 80.0), "0.0025"),
            (vec![], &none, "0.2"),
            (vec![0.0, 0.0], &none, "0.2"),
            (vec![f64::NAN, 1e300, 1e-300], &none, "0.2"),
        ] {
            let axis = Axis::covering(values.into_iter(), 5);
            assert_eq!(axis.ticks.len(), ticks.len(), "{axis:?}");
            let mut pairs = axis.ticks.iter().zip(ticks);
            assert!(pairs.all(|(a, b)| (a - b).abs() < 1e-9), "{axis:?}");
            assert_eq!(axis.label(axis.ticks[1]), label);
        }
    }

    #[test]
    fn labels_of_extreme_values_stay_short() {
        for (value, label) in [(1e9, "2e8"), (1.2e-9, "2.5e-10"), (4e199, "1e199")] {
            let axis = Axis::covering(std::iter::once(value), 5);
            assert_eq!(
                (&*axis.label(0.0), &*axis.label(axis.ticks[1])),
                ("0", label)
            );
        }
    }

    #[test]
    fn logarithmic_axes_have_ticks_at_powers_of_ten() {
        let axis = Axis::of_powers([-3.6, -2.1].into_iter());
        assert_eq!(axis.ticks, [-4.0, -3.0, -2.0]);
        assert_eq!(axis.fraction(-3.0), 0.5);
        assert_eq!(Axis::of_powers([].into_iter()).ticks, [0.0, 1.0]);
        assert_eq!(Axis::of_powers([-2.0].into_iter()).ticks, [-2.0, -1.0]);
    }

    #[test]
    fn spread_labels_keep_their_distance_order_and_bounds() {
        let spread = |labels: &[f64]| spread(labels, 10.0, (0.0, 100.0));
        assert_eq!(spread(&[10.0, 50.0]), [10.0, 50.0]);
        assert_eq!(spread(&[50.0, 50.0]), [45.0, 55.0]);
        assert_eq!(spread(&[99.0, 98.0]), [100.0, 90.0]);
        assert_eq!(spread(&[1.0, 2.0, 3.0]), [0.0, 10.0, 20.0]);
        assert_eq!(spread(&[]), [0.0; 0]);
    }
}
