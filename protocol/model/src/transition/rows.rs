//! Computes eq. 2. Beliefs at taps with equal weights are added before they are multiplied.
//!
//! Why it is fast: taps of one state with equal weights (the eight neighbours in most of the wildfire kernel) are added
//! once for all next states. A cell needs 35 additions and 16 multiplications, where the formula has 54 of each.
//!
//! Why the result is the same: `w x + w y = w (x + y)`. `tests/model/models.rs` computes the formula's sums in double
//! precision, and `tests/model/transition.rs` compares the results for random models and grids.
//!
//! A weight that differs between zones has a *slot*: one value per lane, chosen by the zone of the lane's cell. Most
//! weights are the same in all zones.

use super::super::vectors::LANES;
use super::layout::Layout;
use ndarray::{Array4, NdFloat, s};

/// For each next state, its bias and its weights for groups of taps.
pub(super) type Rows<T> = Vec<Row<T>>;

#[derive(Debug, Clone)]
pub(super) enum Kernels<T> {
    /// One kernel for all cells.
    Alike(Rows<T>),
    /// One kernel for each own state (the state of the cell itself).
    Own(Vec<Own<T>>),
}

/// The distribution of the next state of cells in one own state.
#[derive(Debug, Clone)]
pub(super) enum Own<T> {
    /// The probability of each possible next state, which does not depend on neighbours.
    Fixed(Vec<(usize, T)>),
    /// The rows of the possible next states.
    Weighed(Vec<(usize, Row<T>)>),
}

/// Eq. 2 for one next state.
#[derive(Debug, Clone)]
pub(super) struct Row<T> {
    bias: T,
    /// The slot of the bias, if the bias differs between zones.
    bias_slot: Option<usize>,
    /// Groups of taps, each with its weight.
    terms: Vec<(usize, T)>,
    /// Groups of taps whose weight differs between zones, each with the slot of this weight.
    zoned_terms: Vec<(usize, usize)>,
}

/// The weights that differ between zones, as `[slot][zone]`.
pub(super) type Slots<T> = Vec<Vec<T>>;

impl<T: NdFloat> Own<T> {
    pub(super) fn new(rows: Rows<T>) -> Self {
        let is_weighed = rows.iter().any(Row::is_weighed);
        let total = rows.iter().fold(T::zero(), |sum, row| sum + row.bias);
        let is_possible = |row: &Row<T>| row.bias > T::zero() || row.is_weighed();
        let possible = rows.into_iter().enumerate();
        let possible = possible.filter(|(_, row)| is_possible(row));
        if is_weighed {
            Self::Weighed(possible.collect())
        } else {
            Self::Fixed(possible.map(|(to, row)| (to, row.bias / total)).collect())
        }
    }

    /// Adds to `next` the probability of each next state, for cells that are in this own state with probability `p`.
    /// `slots` contains each lane's values of the weights that differ between zones.
    #[inline(always)]
    pub(super) fn add(
        &self,
        p: &[T; LANES],
        (sums, slots): (&[[T; LANES]], &[[T; LANES]]),
        weights: &mut [[T; LANES]],
        next: &mut [[T; LANES]],
    ) {
        match self {
            Self::Fixed(probabilities) => {
                for &(to, probability) in probabilities {
                    for (next, &p) in next[to].iter_mut().zip(p) {
                        *next += p * probability;
                    }
                }
            }
            Self::Weighed(rows) => {
                let mut total = [T::zero(); LANES];
                for (weight, (_, row)) in weights.iter_mut().zip(rows) {
                    *weight = row.weigh(sums, slots);
                    for (total, &weight) in total.iter_mut().zip(&*weight) {
                        *total += weight;
                    }
                }
                let mut factor = *p;
                for (factor, total) in factor.iter_mut().zip(total) {
                    *factor /= total;
                }
                for ((to, _), weight) in rows.iter().zip(weights) {
                    let lanes = next[*to].iter_mut().zip(&*weight).zip(&factor);
                    for ((next, &weight), &factor) in lanes {
                        *next += weight * factor;
                    }
                }
            }
        }
    }
}

impl<T: NdFloat> Row<T> {
    /// Returns whether the row has any weights, or has a bias that differs between zones.
    fn is_weighed(&self) -> bool {
        self.bias_slot.is_some() || !self.terms.is_empty() || !self.zoned_terms.is_empty()
    }

    #[inline(always)]
    pub(super) fn weigh(&self, sums: &[[T; LANES]], slots: &[[T; LANES]]) -> [T; LANES] {
        let mut weight = match self.bias_slot {
            None => [self.bias; LANES],
            Some(slot) => slots[slot],
        };
        for &(group, factor) in &self.terms {
            for (weight, &sum) in weight.iter_mut().zip(&sums[group]) {
                *weight += factor * sum;
            }
        }
        for &(group, slot) in &self.zoned_terms {
            let lanes = weight.iter_mut().zip(&sums[group]).zip(&slots[slot]);
            for ((weight, &sum), &factor) in lanes {
                *weight += factor * sum;
            }
        }
        weight
    }
}

/// Returns the rows of eq. 2 for cells in state `own`, or for all cells if kernels do not depend on the cell's own
/// state. `kernels` contains one kernel per zone, and `columns` the weights of the groups. Appends weights that differ
/// between zones to `slots`.
pub(super) fn kernel_rows<T: NdFloat>(
    own: usize,
    kernels: &[&Array4<f64>],
    bias: &[f64],
    n_own: usize,
    columns: &[Vec<f64>],
    slots: &mut Slots<T>,
) -> Rows<T> {
    // A common factor cancels in eq. 3. Dividing by the largest weight keeps the weights in the range of `T`.
    let weights = kernels.iter().flat_map(|kernel| kernel.iter());
    let largest = weights.chain(bias).copied().fold(0.0, f64::max);
    let scaled = |weight: f64| T::from(weight / largest).expect("invariant: f64 casts to T");
    let (n_states, _, height, width) = kernels[0].dim();
    let mut slot = |by_zone: &[f64]| {
        slots.push(by_zone.iter().copied().map(scaled).collect());
        slots.len() - 1
    };
    let mut row = |to: usize| {
        let centre = |kernel: &&Array4<f64>| match n_own {
            1 => bias[to],
            _ => bias[to] + kernel[[to, own, height / 2, width / 2]],
        };
        let biases: Vec<f64> = kernels.iter().map(centre).collect();
        let differ = |by_zone: &[f64]| by_zone.iter().any(|weight| *weight != by_zone[0]);
        let (mut terms, mut zoned_terms) = (Vec::new(), Vec::new());
        for (group, column) in columns.iter().enumerate() {
            let of_zone = |zone: usize| column[(zone * n_own + own) * n_states + to];
            let by_zone: Vec<f64> = (0..kernels.len()).map(of_zone).collect();
            if differ(&by_zone) {
                zoned_terms.push((group, slot(&by_zone)));
            } else if by_zone[0] > 0.0 {
                terms.push((group, scaled(by_zone[0])));
            }
        }
        Row {
            bias: scaled(biases[0]),
            bias_slot: differ(&biases).then(|| slot(&biases)),
            terms,
            zoned_terms,
        }
    };
    (0..n_states).map(&mut row).collect()
}

/// Groups the taps whose columns of weights `w[.., n, a, c]` are equal in every kernel. For each group, returns its
/// columns in all kernels as one vector, and the offsets of its taps. Leaves out taps without weight, and the centre
/// tap if kernels depend on the own state.
pub(super) fn taps_that_weigh_alike(
    kernels: &[Array4<f64>],
    sees_own_state: bool,
    layout: Layout,
) -> Vec<(Vec<f64>, Vec<usize>)> {
    let (n_states, _, kernel_height, kernel_width) = kernels[0].dim();
    let is_own = |tap| sees_own_state && tap == (kernel_height / 2, kernel_width / 2);
    let mut groups: Vec<(Vec<f64>, Vec<usize>)> = Vec::new();
    for from in 0..n_states {
        // With a single kernel, a group stays within one state, because a different order of additions would change the
        // last bits.
        let first = if kernels.len() > 1 { 0 } else { groups.len() };
        for (row, col) in (0..kernel_height).flat_map(|a| (0..kernel_width).map(move |c| (a, c))) {
            let columns = kernels
                .iter()
                .map(|kernel| kernel.slice(s![.., from, row, col]));
            let column: Vec<f64> = columns.flat_map(|column| column.to_vec()).collect();
            if is_own((row, col)) || column.iter().all(|&weight| weight == 0.0) {
                continue;
            }
            let offset = from * layout.plane + row * layout.stride + col;
            match groups[first..].iter_mut().find(|group| group.0 == column) {
                Some((_, offsets)) => offsets.push(offset),
                None => groups.push((column, vec![offset])),
            }
        }
    }
    groups
}
