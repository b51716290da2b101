//! Draws of a *parent*: one neighbour of a cell, whose vote decides.
//!
//! Why it is fast: a draw costs one random number and two look-ups, whatever the size of the kernel.
//!
//! Why it is the same: the weight of outcome `m` is `sum_t w[m, n_t, t]`. Pick tap `t` with probability `most[t] / C`,
//! where `most[t] = max_n sum_m w[m, n, t]` and `C = sum_t most[t]`; then outcome `m` with probability
//! `w[m, n_t, t] / most[t]`. What is missing to one rejects, and so does a neighbour off the grid, whose weight is zero.
//! So `m` is accepted with probability `sum_t w[m, n_t, t] / C`: in proportion to its weight. After a rejection, draw
//! again. `tests/model/dynamics.rs` compares draws with `Phi` for any models and grids.

use super::lanes::Words;
use super::mixture::Mixture;
use super::places::{OFF_GRID, Places, centre};

/// Mark of a cell to be drawn again: its parent is off the grid, or has no such vote. Odd, and its high bit is set, as
/// in no state.
const REJECTED: u8 = OFF_GRID;

/// Rounds of drawing parents before a cell's kernel is summed. The wildfire rejects about 1 in 30,
/// in a corner 1 in 3; only models with columns of very different sums come here often.
const ROUNDS: usize = 8;

/// Most rules of [`Parents`]: 64 states have as many with a 3 x 3 kernel. The tables of more would not
/// stay in any cache.
const MOST_RULES: usize = 1 << 16;

/// Tables to draw a tap and its outcome, from the residual distribution of [`super::bytes`] or from the whole.
///
/// Tap `t` has an interval as long as its probability, and each state of its parent divides it among
/// the outcomes. All their ends together cut it into *rules*: pieces in which a parent's state
/// leads to one outcome. So one draw, by an alias table (Walker 1977, Vose 1991), and two
/// look-ups decide a cell. The wildfire has 53 rules in its residual distribution.
#[derive(Debug)]
pub(super) struct Parents {
    /// For each mixture two alias tables, all of one length, a power of two: the residual distribution,
    /// then the whole.
    slots: Vec<Slot>,
    log_n_slots: u32,
    /// Outcomes, in rows of a power of two.
    outcomes: Vec<u8>,
    /// What of a parent indexes a row; takes [`OFF_GRID`] to the row's end.
    mask: u8,
    /// Where a cell's own state lies, if it chooses the mixture.
    own: Option<usize>,
    /// The first mixture of each home's zone, where zones differ.
    first_mixtures: Option<Vec<u16>>,
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

impl Parents {
    /// What the bytes leave of each mixture, and the whole of it; the taps read at `offsets`, and `zones` has that of
    /// each home. `None` if the rules would be too many.
    pub(super) fn new(
        mixtures: &[Mixture],
        offsets: &[usize],
        zones: Option<&[u8]>,
    ) -> Option<Self> {
        let n_weights: usize = mixtures.iter().map(Mixture::n_weights).sum();
        if n_weights + mixtures.len() * offsets.len() > MOST_RULES {
            return None;
        }
        let mut outcomes = Vec::new();
        let none = vec![0; offsets.len()];
        let mut tables = Vec::new();
        for mixture in mixtures {
            for taken in [mixture.counts(), &none] {
                tables.push(rules(mixture, offsets, taken, &mut outcomes));
            }
        }
        let n_own = mixtures.len() / mixtures[0].n_zones();
        let first = |&zone: &u8| u16::from(zone) * n_own as u16;
        let most_rules = tables.iter().map(Vec::len).max().unwrap_or(0);
        let n_slots = most_rules.next_power_of_two();
        let slots = tables.iter().map(|rules| alias_table(rules, n_slots));
        Some(Self {
            slots: slots.flatten().collect(),
            log_n_slots: n_slots.trailing_zeros(),
            outcomes,
            mask: (row_length(mixtures[0].n_states()) - 1) as u8,
            own: (n_own > 1).then(|| centre(offsets)),
            first_mixtures: zones.map(|zones| zones.iter().map(first).collect()),
        })
    }

    /// Draws a parent for every listed cell, and again for the rejected ones, up to [`ROUNDS`] times; those still
    /// rejected stay first in the list, which has as many as are returned.
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
            n_undecided = match (self.own, &self.first_mixtures) {
                (None, None) => self.round(places, undecided, randoms, |_, _| 0),
                (Some(own), None) => self.round(places, undecided, randoms, |states, home| {
                    usize::from(states[home + own])
                }),
                (None, Some(first)) => self.round(places, undecided, randoms, |_, home| {
                    usize::from(first[home])
                }),
                (Some(own), Some(first)) => {
                    self.round(places, undecided, randoms, |states, home| {
                        usize::from(first[home]) + usize::from(states[home + own])
                    })
                }
            };
            if n_undecided == 0 {
                break;
            }
        }
        n_undecided
    }

    /// One draw for every listed cell, by the `mixture` that states and home tell; the rejected ones come first in the
    /// list, which has as many as are returned.
    #[inline(never)] // As `Bytes::list_undecided`.
    fn round(
        &self,
        places: &mut Places,
        undecided: &mut [u32],
        randoms: &[u8],
        mixture: impl Fn(&[u8], usize) -> usize,
    ) -> usize {
        let (states, next) = (&places.states[..], &mut places.next[..]);
        let randoms = &randoms.as_chunks().0[..undecided.len()];
        let mut n_rejected = 0;
        for index in 0..undecided.len() {
            let home = undecided[index];
            let mark = next[home as usize];
            let random = u32::from_le_bytes(randoms[index]);
            let mixture = mixture(states, home as usize);
            let state = self.outcome(mixture, mark, random, states, home);
            next[home as usize] = state;
            // Branch-free: no rejection is predictable.
            undecided[n_rejected] = home;
            n_rejected += usize::from(state == REJECTED);
        }
        n_rejected
    }

    /// Draws for the cell at `home`, by its mark: from the residual distribution after a byte, from the whole
    /// after a rejection.
    #[inline]
    fn outcome(&self, mixture: usize, mark: u8, random: u32, states: &[u8], home: u32) -> u8 {
        let table = (mixture << 1 | usize::from(mark & 1)) << self.log_n_slots;
        let slot = &self.slots[(u64::from(random) << self.log_n_slots >> 32) as usize | table];
        let within = random << self.log_n_slots;
        let rule = slot.rules[usize::from(within >= slot.threshold)];
        let parent = states[(home + rule.offset) as usize];
        self.outcomes[rule.outcomes as usize | usize::from(parent & self.mask)]
    }
}

/// The distribution of tap and outcome as rules, less `taken[t] / 256` of "tap `t`, likeliest outcome".
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
    // The slots left on either list have a share of one but for rounding: they stay whole.
    slots
}
