//! Draws a *parent* of a cell: one neighbour, whose weights alone decide the cell's next state.
//!
//! Why it is fast: a draw costs one random number and two look-ups, whatever the size of the kernel.
//!
//! Why the distribution is the same: the weight of outcome `m` is `sum_t w[m, n_t, t]`. A draw picks tap `t` with
//! probability `most[t] / C`, where `most[t] = max_n sum_m w[m, n, t]` and `C = sum_t most[t]`. It then picks outcome
//! `m` with probability `w[m, n_t, t] / most[t]`. If these probabilities sum to less than one, the rest is the
//! probability of a rejection. A neighbour off the grid has no weight, so it is always rejected. Thus `m` is accepted
//! with probability `sum_t w[m, n_t, t] / C`, in proportion to its weight. After a rejection, the cell is drawn again.
//! `tests/model/dynamics.rs` compares draws with `Phi` for random models and grids.

use super::lanes::Words;
use super::mixture::Mixture;
use super::places::{OFF_GRID, Places};

/// Mark of a cell to be drawn again, because its parent is off the grid or was rejected. Its high bit distinguishes it
/// from all states, and its odd value from the mark of an escaped byte.
const REJECTED: u8 = OFF_GRID;

/// Maximum number of draws for a cell before its kernel is summed instead. The wildfire model rejects about 1 draw in
/// 30, and 1 in 3 in a corner. Only models with very unequal column sums often need all the draws.
const ROUNDS: usize = 8;

/// Maximum number of rules of [`Parents`]. A model with 64 states and a 3 x 3 kernel stays below it. Larger tables
/// would not stay in any cache.
const MAX_RULES: usize = 1 << 16;

/// Tables for drawing a tap and its outcome, either from the residual distribution of [`super::bytes`] or from the
/// whole distribution.
///
/// Each tap has an interval whose length is the tap's probability. For each state of the parent, the interval is
/// divided among the outcomes. The ends of all these parts cut the interval into *rules*: pieces in which each parent
/// state has exactly one outcome. So one draw from an alias table (Walker 1977, Vose 1991) and two look-ups decide a
/// cell. The residual distribution of the wildfire model has 53 rules.
#[derive(Debug)]
pub(super) struct Parents {
    /// Two alias tables: for the residual distribution, then for the whole distribution. Both have the same length, a
    /// power of two.
    slots: Vec<Slot>,
    log_n_slots: u32,
    /// Rows of outcomes by parent state. The length of a row is a power of two.
    outcomes: Vec<u8>,
    /// Bit mask that turns a parent's state into an index within a row, and [`OFF_GRID`] into the index of the last
    /// entry.
    mask: u8,
}

/// A tap, and the outcome for each state of its parent.
#[derive(Debug, Clone, Copy, Default)]
struct Rule {
    /// The offset of the tap's neighbour from the cell's home (see `places.rs`).
    offset: u32,
    /// The start of the rule's row in `Parents::outcomes`.
    outcomes: u32,
}

#[derive(Debug, Clone, Copy, Default)]
struct Slot {
    /// A random number below this threshold draws the first rule. Any other draws the second.
    threshold: u32,
    rules: [Rule; 2],
}

impl Parents {
    /// Makes a table for the residual distribution that bytes leave, and one for the whole distribution. `offsets`
    /// contains the offset of each tap's neighbour from a cell's home. Returns `None` if there would be too many rules.
    pub(super) fn new(mixture: &Mixture, offsets: &[usize]) -> Option<Self> {
        if mixture.n_weights() + offsets.len() > MAX_RULES {
            return None;
        }
        let mut outcomes = Vec::new();
        let none = vec![0; offsets.len()];
        let tables = [mixture.counts(), &none];
        let tables = tables.map(|taken| rules(mixture, offsets, taken, &mut outcomes));
        let most_rules = tables.iter().map(Vec::len).max().unwrap_or(0);
        let n_slots = most_rules.next_power_of_two();
        let slots = tables.iter().map(|rules| alias_table(rules, n_slots));
        Some(Self {
            slots: slots.flatten().collect(),
            log_n_slots: n_slots.trailing_zeros(),
            outcomes,
            mask: (row_length(mixture.n_states()) - 1) as u8,
        })
    }

    /// Draws a parent for every listed cell, and again for rejected cells, up to [`ROUNDS`] times. Moves the cells that
    /// are still rejected to the front of the list, and returns their number.
    #[inline(always)]
    pub(super) fn decide(
        &self,
        places: &mut Places,
        undecided: &mut [u32],
        randoms: &mut [u8],
        words: &mut Words,
    ) -> usize {
        let mut n_undecided = undecided.len();
        for _ in 0..ROUNDS {
            let randoms = &mut randoms[..n_undecided.next_multiple_of(2) * 4];
            words.fill(randoms);
            let undecided = &mut undecided[..n_undecided];
            n_undecided = self.round(places, undecided, randoms);
            if n_undecided == 0 {
                break;
            }
        }
        n_undecided
    }

    /// Draws once for every listed cell. Moves rejected cells to the front of the list, and returns their number.
    #[inline(never)] // For the same reason as `Marked::list`.
    fn round(&self, places: &mut Places, undecided: &mut [u32], randoms: &[u8]) -> usize {
        let (states, next) = (&places.states[..], &mut places.next[..]);
        let randoms = &randoms.as_chunks().0[..undecided.len()];
        let mut n_rejected = 0;
        for index in 0..undecided.len() {
            let home = undecided[index];
            let mark = next[home as usize];
            let random = u32::from_le_bytes(randoms[index]);
            let state = self.outcome(mark, random, states, home);
            next[home as usize] = state;
            // Branch-free, because the processor cannot predict rejections.
            undecided[n_rejected] = home;
            n_rejected += usize::from(state == REJECTED);
        }
        n_rejected
    }

    /// Draws an outcome for the cell at `home`. The cell's mark selects the distribution: the residual one after its
    /// byte escaped, the whole one after a rejection.
    #[inline]
    fn outcome(&self, mark: u8, random: u32, states: &[u8], home: u32) -> u8 {
        let table = usize::from(mark & 1) << self.log_n_slots;
        let slot = &self.slots[(u64::from(random) << self.log_n_slots >> 32) as usize | table];
        let within = random << self.log_n_slots;
        let rule = slot.rules[usize::from(within >= slot.threshold)];
        let parent = states[(home + rule.offset) as usize];
        self.outcomes[rule.outcomes as usize | usize::from(parent & self.mask)]
    }
}

/// Returns the rules of a mixture, each with its weight. Bytes have already decided the draw "tap `t`, most likely
/// outcome" with probability `taken[t] / 256`, so the rules omit this part.
fn rules(
    mixture: &Mixture,
    offsets: &[usize],
    taken: &[usize],
    outcomes: &mut Vec<u8>,
) -> Vec<(f64, Rule)> {
    let mut rules = Vec::new();
    for (tap, &offset) in offsets.iter().enumerate() {
        let taken = taken[tap] as f64 / 256.0;
        let ends = mixture.ends(tap, taken);
        let length = mixture.share(tap) - taken;
        add_rules(&ends, length, offset, &mut rules, outcomes);
    }
    rules
}

/// Returns the length of a row, which has an outcome for each state and one for a parent off the grid.
fn row_length(n_states: usize) -> usize {
    (n_states + 1).next_power_of_two()
}

/// Cuts a tap's interval into rules. Appends each rule with its weight (the length of its piece) to `rules`, and its
/// row to `outcomes`.
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

/// Makes an alias table (Vose, IEEE TSE 17(9), 1991) of rules, whose weights need not sum to one. Nothing may be drawn
/// from a table without rules.
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
    // For the slots that remain in either list, `left` is one up to rounding, so each keeps a single rule.
    slots
}
