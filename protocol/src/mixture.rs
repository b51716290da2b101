//! The tables of [`crate::dynamics`]: the weights of paper eq. 2 as a mixture over the kernel's taps,
//! and draws of a tap and its outcome from them.

use crate::model::Model;

/// Mark of a cell to be drawn again, and of what lies off the grid: who draws it as its parent is
/// rejected.
pub(crate) const REJECTED: u8 = 255;

/// The weights of eq. 2 as a mixture over taps.
#[derive(Debug, Clone)]
pub(crate) struct Mixture {
    n_states: usize,
    n_taps: usize,
    /// `w[m, n, t]` as `[tap][from][to]`, the bias in the centre tap.
    weights: Vec<f64>,
    /// `most[t]`, the largest column sum of each tap.
    most: Vec<f64>,
    /// `C`, the sum of `most`.
    total: f64,
}

/// A distribution over taps, and over outcomes given the tap and its parent.
#[derive(Debug, Clone)]
pub(crate) struct Draw {
    n_states: usize,
    /// An alias table with a power of two of slots.
    slots: Vec<Slot>,
    /// Low bits of the random number that decide within a slot.
    slot_bits: u32,
    /// Cumulative outcome probabilities in units of `2^-32`, a row for each tap and parent (the last
    /// row of a tap for a parent off the grid), in each as many quadruples as hold S.
    thresholds: Vec<[u32; 4]>,
    quads: usize,
}

/// A tap drawn.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tap {
    /// Where it reads, relative to a cell's home.
    pub(crate) offset: u32,
    /// The first row of its thresholds.
    row: u32,
}

/// One slot of an alias table.
#[derive(Debug, Clone, Copy)]
struct Slot {
    /// Below it the first tap is drawn, else the second.
    threshold: u32,
    taps: [Tap; 2],
}

impl Mixture {
    pub(crate) fn new(model: &Model) -> Self {
        let (n_states, _, kernel_height, kernel_width) = model.kernel().dim();
        let n_taps = kernel_height * kernel_width;
        // Eq. 3 cancels a common factor; taken out, no sum of weights overflows.
        let largest = model.kernel().iter().chain(model.bias()).copied();
        let largest = largest.fold(0.0, f64::max);
        let mut weights = Vec::with_capacity(n_taps * n_states * n_states);
        for tap in 0..n_taps {
            let (row, col) = (tap / kernel_width, tap % kernel_width);
            for from in 0..n_states {
                weights.extend((0..n_states).map(|to| {
                    let bias = if tap == n_taps / 2 {
                        model.bias()[to]
                    } else {
                        0.0
                    };
                    (model.kernel()[[to, from, row, col]] + bias) / largest
                }));
            }
        }
        let column_sums: Vec<f64> = weights.chunks(n_states).map(|w| w.iter().sum()).collect();
        let largest = |sums: &[f64]| sums.iter().copied().fold(0.0, f64::max);
        let most: Vec<f64> = column_sums.chunks(n_states).map(largest).collect();
        let total = most.iter().sum();
        Self {
            n_states,
            n_taps,
            weights,
            most,
            total,
        }
    }

    /// The weight of each next state, given the tap and its parent's state.
    pub(crate) fn weights(&self, tap: usize, from: usize) -> &[f64] {
        &self.weights[(tap * self.n_states + from) * self.n_states..][..self.n_states]
    }

    /// `f`: the state that each state mostly leads to.
    pub(crate) fn likeliest(&self) -> Vec<usize> {
        let sum = |from, to| {
            (0..self.n_taps)
                .map(|tap| self.weights(tap, from)[to])
                .sum()
        };
        let likeliest = |from| {
            let sums: Vec<f64> = (0..self.n_states).map(|to| sum(from, to)).collect();
            let better = |best, to| if sums[to] > sums[best] { to } else { best };
            (0..self.n_states).fold(0, better)
        };
        (0..self.n_states).map(likeliest).collect()
    }

    /// `q`: how many of 256 byte values stand for each tap.
    pub(crate) fn fast_counts(&self, likeliest: &[usize]) -> Vec<usize> {
        let count = |tap| {
            let certain = likeliest.iter().enumerate();
            let certain = certain.map(|(from, &to)| self.weights(tap, from)[to]);
            (256.0 * certain.fold(f64::INFINITY, f64::min) / self.total) as usize
        };
        (0..self.n_taps).map(count).collect()
    }
}

impl Draw {
    /// The distribution of tap and outcome, less `counts[t] / 256` of "tap `t`, likeliest outcome". The
    /// taps read at `offsets`.
    pub(crate) fn new(
        mixture: &Mixture,
        offsets: &[usize],
        likeliest: &[usize],
        counts: &[usize],
    ) -> Self {
        let n_states = mixture.n_states;
        let taken = |tap: usize| counts[tap] as f64 / 256.0;
        let left = |(tap, most)| f64::max(most / mixture.total - taken(tap), 0.0);
        let masses: Vec<f64> = mixture.most.iter().enumerate().map(left).collect();
        let probability = |tap: usize, from: usize, to| {
            let fast = f64::from(u8::from(to == likeliest[from])) * taken(tap);
            let weight = mixture.weights(tap, from)[to] / mixture.total;
            f64::max(weight - fast, 0.0) / masses[tap]
        };
        let quads = n_states.div_ceil(4);
        // A parent off the grid keeps thresholds of zero: always rejected.
        let mut thresholds = vec![[0; 4]; mixture.n_taps * (n_states + 1) * quads];
        for (tap, rows) in thresholds.chunks_mut((n_states + 1) * quads).enumerate() {
            for (from, row) in rows.chunks_mut(quads).take(n_states).enumerate() {
                let outcomes = (0..n_states).map(|to| probability(tap, from, to));
                cumulate(outcomes, row.as_flattened_mut());
            }
        }
        let slots = alias_table(&masses, &taps(offsets, n_states));
        Self {
            n_states,
            slot_bits: 32 - slots.len().trailing_zeros(),
            slots,
            thresholds,
            quads,
        }
    }

    pub(crate) fn tap(&self, random: u32) -> Tap {
        let slot = &self.slots[(random >> self.slot_bits) as usize];
        let within = random & ((1 << self.slot_bits) - 1);
        slot.taps[usize::from(within >= slot.threshold)]
    }

    /// The number of thresholds passed: branch-free, as no outcome is predictable.
    pub(crate) fn outcome(&self, tap: Tap, parent: u8, random: u32) -> u8 {
        let row = tap.row as usize + usize::from(parent).min(self.n_states);
        let passed = |quad: &[u32; 4]| quad.iter().map(|&t| u32::from(random >= t)).sum::<u32>();
        let outcome = if self.quads == 1 {
            passed(&self.thresholds[row])
        } else {
            let quads = &self.thresholds[row * self.quads..][..self.quads];
            quads.iter().map(passed).sum()
        };
        if (outcome as usize) < self.n_states {
            outcome as u8
        } else {
            REJECTED
        }
    }
}

fn taps(offsets: &[usize], n_states: usize) -> Vec<Tap> {
    let tap = |(tap, &offset): (usize, &usize)| Tap {
        offset: offset as u32,
        row: (tap * (n_states + 1)) as u32,
    };
    offsets.iter().enumerate().map(tap).collect()
}

/// Cumulative probabilities in units of `2^-32`; entries without a probability repeat the last sum.
fn cumulate(mut probabilities: impl Iterator<Item = f64>, thresholds: &mut [u32]) {
    let mut sum = 0.0;
    for threshold in thresholds {
        sum += probabilities.next().unwrap_or(0.0);
        // Casts saturate: a probability of one loses 2^-32, and 0/0 becomes 0.
        *threshold = (sum * 2f64.powi(32)) as u32;
    }
}

/// The smallest alias table with a power of two of slots (Vose, IEEE TSE 17(9), 1991). The masses
/// need not sum to one; if they sum to zero, the table must not be drawn from.
fn alias_table(masses: &[f64], taps: &[Tap]) -> Vec<Slot> {
    let n_slots = masses.len().next_power_of_two().max(2);
    let unit = 2f64.powi(32) / n_slots as f64;
    let per_slot = masses.iter().sum::<f64>() / n_slots as f64;
    let mut left: Vec<f64> = masses.iter().map(|mass| mass / per_slot).collect();
    left.resize(n_slots, 0.0);
    let (mut small, mut large): (Vec<usize>, Vec<usize>) =
        (0..n_slots).partition(|&tap| left[tap] < 1.0);
    let whole = |tap: usize| Slot {
        threshold: u32::MAX,
        taps: [taps[tap.min(taps.len() - 1)]; 2],
    };
    let mut slots: Vec<Slot> = (0..n_slots).map(whole).collect();
    while let Some(&over) = large.last() {
        let Some(under) = small.pop() else { break };
        slots[under].threshold = (left[under] * unit) as u32;
        slots[under].taps[1] = taps[over];
        left[over] -= 1.0 - left[under];
        if left[over] < 1.0 {
            large.pop();
            small.push(over);
        }
    }
    // What is left on either list is one but for rounding: such slots stay whole.
    slots
}

/// A number in `[0, 1)` from the high 53 bits.
pub(crate) fn uniform(random: u64) -> f64 {
    (random >> 11) as f64 * 2f64.powi(-53)
}

/// The state at `uniform` of the cumulated weights, which need not sum to one.
pub(crate) fn invert(weights: &[f64], uniform: f64) -> u8 {
    let target = uniform * weights.iter().sum::<f64>();
    let mut sum = 0.0;
    let reached = weights.iter().position(|weight| {
        sum += weight;
        target < sum
    });
    // Rounding can leave the target at the very end: that is the last state with a weight.
    let last = || weights.iter().rposition(|&weight| weight > 0.0);
    let state = reached
        .or_else(last)
        .expect("invariant: the weights have a positive sum");
    state as u8
}
