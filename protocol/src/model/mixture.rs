//! The tables of [`super::dynamics`]: the weights of paper eq. 2 as a mixture over the kernel's taps,
//! and draws of a tap and its outcome from them.

use super::parameters::Model;
use ndarray::Array4;

/// Mark of a cell to be drawn again, and of what lies off the grid: a cell with such a parent is
/// rejected. Odd, and its high bit is set, as in no state.
pub(crate) const REJECTED: u8 = 255;

/// Mark of a cell that the first byte left to the residual distribution. Even; high bit set.
pub(crate) const ESCAPED: u8 = 254;

/// Most rules of a [`Draw`]: 64 states have as many with a 3 x 3 kernel. The tables of more would not
/// stay in any cache.
const MOST_RULES: usize = 1 << 16;

/// The weights of eq. 2 as a mixture over taps: of all cells, or of those in one state themselves.
#[derive(Debug, Clone)]
pub(crate) struct Mixture {
    n_states: usize,
    n_taps: usize,
    /// `w[m, n, t]` as `[tap][from][to]`, the bias in the centre tap. Where the cell's own state is known,
    /// the centre has its weights in place of all others.
    weights: Vec<f64>,
    /// `most[t]`, the largest column sum of each tap.
    most: Vec<f64>,
    /// `C`, the sum of `most`.
    total: f64,
    /// `f`: the state that each state mostly leads to under each tap, `[tap][from]`.
    likeliest: Vec<Vec<usize>>,
    /// `q`: how many of 256 byte values stand for each tap.
    counts: Vec<usize>,
}

/// Draws of a tap and its outcome, from the residual distribution or from the whole.
///
/// Tap `t` has an interval as long as its probability, and each state of its parent divides it among
/// the outcomes. All their ends together cut it into *rules*: pieces in which a parent's state
/// leads to one outcome. So one draw, by an alias table (Walker 1977, Vose 1991), and two
/// look-ups decide a cell. The wildfire has 53 rules in its residual distribution.
#[derive(Debug)]
pub(crate) struct Draw {
    /// For each mixture two alias tables, all of one length, a power of two: the residual distribution,
    /// then the whole.
    slots: Vec<Slot>,
    log_n_slots: u32,
    /// Outcomes, in rows of a power of two.
    outcomes: Vec<u8>,
    /// What of a parent indexes a row; takes [`REJECTED`] to the row's end.
    mask: u8,
}

/// A tap, and the outcome for each state of its parent.
#[derive(Debug, Clone, Copy, Default)]
struct Rule {
    /// Where the tap reads, relative to a cell's home.
    offset: u32,
    /// The first of its row of outcomes.
    outcomes: u32,
}

/// One slot of an alias table.
#[derive(Debug, Clone, Copy, Default)]
struct Slot {
    /// Below it the first rule is drawn, else the second.
    threshold: u32,
    rules: [Rule; 2],
}

impl Mixture {
    /// One for all cells, or one for each state that a cell itself can be in.
    pub(crate) fn of_model(model: &Model) -> Vec<Self> {
        let kernels = model.kernels().iter().enumerate();
        let own = |state| model.sees_own_state().then_some(state);
        kernels
            .map(|(state, kernel)| Self::new(kernel, &model.bias().to_vec(), own(state)))
            .collect()
    }

    fn new(kernel: &Array4<f64>, bias: &[f64], own: Option<usize>) -> Self {
        let (n_states, _, kernel_height, kernel_width) = kernel.dim();
        let n_taps = kernel_height * kernel_width;
        // Eq. 3 cancels a common factor; taken out, no sum of weights overflows.
        let largest = kernel.iter().chain(bias).copied().fold(0.0, f64::max);
        let mut weights = Vec::with_capacity(n_taps * n_states * n_states);
        for tap in 0..n_taps {
            let (row, col) = (tap / kernel_width, tap % kernel_width);
            let is_centre = tap == n_taps / 2;
            for parent in 0..n_states {
                let from = own.filter(|_| is_centre).unwrap_or(parent);
                weights.extend((0..n_states).map(|to| {
                    let bias = if is_centre { bias[to] } else { 0.0 };
                    (kernel[[to, from, row, col]] + bias) / largest
                }));
            }
        }
        Self::of_weights(n_states, n_taps, weights, own)
    }

    fn of_weights(n_states: usize, n_taps: usize, weights: Vec<f64>, own: Option<usize>) -> Self {
        let column_sums: Vec<f64> = weights.chunks(n_states).map(|w| w.iter().sum()).collect();
        let largest = |sums: &[f64]| sums.iter().copied().fold(0.0, f64::max);
        let most: Vec<f64> = column_sums.chunks(n_states).map(largest).collect();
        let total = most.iter().sum();
        let mut mixture = Self {
            n_states,
            n_taps,
            weights,
            most,
            total,
            likeliest: Vec::new(),
            counts: Vec::new(),
        };
        let centre = n_taps / 2;
        mixture.likeliest = if own.is_some() {
            let neighbours = mixture.likeliest_under((0..n_taps).filter(|&tap| tap != centre));
            let mut likeliest = vec![neighbours; n_taps];
            likeliest[centre] = mixture.likeliest_under(std::iter::once(centre));
            likeliest
        } else {
            vec![mixture.likeliest_under(0..n_taps); n_taps]
        };
        mixture.counts = mixture.fast_counts();
        mixture
    }

    /// The weight of each next state, given the tap and its parent's state.
    pub(crate) fn weights(&self, tap: usize, from: usize) -> &[f64] {
        &self.weights[(tap * self.n_states + from) * self.n_states..][..self.n_states]
    }

    /// `f` under a tap.
    pub(crate) fn likeliest(&self, tap: usize) -> &[usize] {
        &self.likeliest[tap]
    }

    /// `q` by tap.
    pub(crate) fn counts(&self) -> &[usize] {
        &self.counts
    }

    /// The state that each state mostly leads to under some taps.
    fn likeliest_under(&self, taps: impl Iterator<Item = usize> + Clone) -> Vec<usize> {
        let sum = |from, to| taps.clone().map(|tap| self.weights(tap, from)[to]).sum();
        let likeliest = |from| {
            let sums: Vec<f64> = (0..self.n_states).map(|to| sum(from, to)).collect();
            let better = |best, to| if sums[to] > sums[best] { to } else { best };
            (0..self.n_states).fold(0, better)
        };
        (0..self.n_states).map(likeliest).collect()
    }

    /// For each state of the parent under a tap, where each outcome's part of the tap's interval ends;
    /// `taken` has gone from the likeliest outcome's.
    fn ends(&self, tap: usize, taken: f64) -> Vec<Vec<f64>> {
        let of_parent = |(from, &likeliest): (usize, &usize)| {
            let mut end = 0.0;
            let weights = self.weights(tap, from).iter().enumerate();
            let ends = weights.map(|(to, weight)| {
                let taken = if to == likeliest { taken } else { 0.0 };
                end += f64::max(weight / self.total - taken, 0.0);
                end
            });
            ends.collect()
        };
        let likeliest = self.likeliest[tap].iter();
        likeliest.enumerate().map(of_parent).collect()
    }

    fn fast_counts(&self) -> Vec<usize> {
        let count = |tap: usize| {
            let certain = self.likeliest[tap].iter().enumerate();
            let certain = certain.map(|(from, &to)| self.weights(tap, from)[to]);
            (256.0 * certain.fold(f64::INFINITY, f64::min) / self.total) as usize
        };
        (0..self.n_taps).map(count).collect()
    }

    /// The distribution of tap and outcome as rules, less `taken[t] / 256` of "tap `t`, likeliest outcome".
    fn rules(
        &self,
        offsets: &[usize],
        taken: &[usize],
        outcomes: &mut Vec<u8>,
    ) -> Vec<(f64, Rule)> {
        let mut rules = Vec::new();
        for (tap, &offset) in offsets.iter().enumerate() {
            let taken = taken[tap] as f64 / 256.0;
            let ends = self.ends(tap, taken);
            let length = self.most[tap] / self.total - taken;
            add_rules(&ends, length, offset, &mut rules, outcomes);
        }
        rules
    }
}

impl Draw {
    /// What the bytes leave of each mixture, and the whole of it; the taps read at `offsets`. `None` if the
    /// rules would be too many.
    pub(crate) fn new(mixtures: &[Mixture], offsets: &[usize]) -> Option<Self> {
        let weights = mixtures.iter().flat_map(|mixture| &mixture.weights);
        let n_weights = weights.filter(|&&weight| weight > 0.0).count();
        if n_weights + mixtures.len() * offsets.len() > MOST_RULES {
            return None;
        }
        let mut outcomes = Vec::new();
        let none = vec![0; offsets.len()];
        let mut tables = Vec::new();
        for mixture in mixtures {
            for taken in [mixture.counts(), &none] {
                tables.push(mixture.rules(offsets, taken, &mut outcomes));
            }
        }
        let most_rules = tables.iter().map(Vec::len).max().unwrap_or(0);
        let n_slots = most_rules.next_power_of_two();
        let slots = tables.iter().map(|rules| alias_table(rules, n_slots));
        Some(Self {
            slots: slots.flatten().collect(),
            log_n_slots: n_slots.trailing_zeros(),
            outcomes,
            mask: (row_length(mixtures[0].n_states) - 1) as u8,
        })
    }

    /// Draws from a mixture again for the cell at `home` that bears `mark`: a state, or [`REJECTED`].
    #[inline]
    pub(crate) fn outcome(
        &self,
        mixture: u8,
        mark: u8,
        random: u32,
        parents: &[u8],
        home: u32,
    ) -> u8 {
        let table = usize::from(mixture << 1 | mark & 1) << self.log_n_slots;
        let slot = &self.slots[(u64::from(random) << self.log_n_slots >> 32) as usize | table];
        let within = random << self.log_n_slots;
        let rule = slot.rules[usize::from(within >= slot.threshold)];
        let parent = parents[(home + rule.offset) as usize];
        self.outcomes[rule.outcomes as usize | usize::from(parent & self.mask)]
    }
}

/// Room for an outcome of each state and of no parent.
fn row_length(n_states: usize) -> usize {
    (n_states + 1).next_power_of_two()
}

/// Cuts a tap's interval into rules with their lengths; appends their rows of outcomes.
fn add_rules(
    ends: &[Vec<f64>],
    length: f64,
    offset: usize,
    rules: &mut Vec<(f64, Rule)>,
    outcomes: &mut Vec<u8>,
) {
    let mut cuts = ends.concat();
    cuts.push(length);
    cuts.sort_by(f64::total_cmp);
    let mut begin = 0.0;
    for end in cuts {
        if end <= begin {
            continue;
        }
        let rule = Rule {
            offset: offset as u32,
            outcomes: outcomes.len() as u32,
        };
        rules.push((end - begin, rule));
        for ends in ends {
            let outcome = ends.iter().position(|&of_outcome| end <= of_outcome);
            outcomes.push(outcome.map_or(REJECTED, |outcome| outcome as u8));
        }
        let end_of_row = rule.outcomes as usize + row_length(ends.len());
        outcomes.resize(end_of_row, REJECTED);
        begin = end;
    }
}

/// An alias table of the rules, which need not sum to one (Vose, IEEE TSE 17(9), 1991). If there are
/// none, it must not be drawn from.
fn alias_table(rules: &[(f64, Rule)], n_slots: usize) -> Vec<Slot> {
    let per_slot = rules.iter().map(|(mass, _)| mass).sum::<f64>() / n_slots as f64;
    let mut left: Vec<f64> = rules.iter().map(|(mass, _)| mass / per_slot).collect();
    left.resize(n_slots, 0.0);
    let (mut small, mut large): (Vec<usize>, Vec<usize>) =
        (0..n_slots).partition(|&slot| left[slot] < 1.0);
    let rule = |slot: usize| {
        rules
            .get(slot)
            .or(rules.last())
            .map_or_else(Rule::default, |r| r.1)
    };
    let whole = |slot| Slot {
        threshold: u32::MAX,
        rules: [rule(slot); 2],
    };
    let mut slots: Vec<Slot> = (0..n_slots).map(whole).collect();
    while let Some(&over) = large.last() {
        let Some(under) = small.pop() else { break };
        slots[under].threshold = (left[under] * 2f64.powi(32)) as u32;
        slots[under].rules[1] = rule(over);
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
