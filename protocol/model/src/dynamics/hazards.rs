//! Draws next states by the rule of [`crate::hazards`].
//!
//! # What is drawn
//! Each cell has a uniform number `v`, and so a threshold `-log(1 - v)`. It takes the first transition for which the sum
//! of the hazards of this transition and all before it exceeds the threshold. Hazards are integers, in units of 2^-40,
//! so a probability has a relative error below 1e-3 if it is over 1e-9, and results are the same on every platform.
//!
//! # How it is fast
//! The highest byte of `v` rules out most cells, 64 at a time: `v` must be below the probability that the cell changes
//! at all, which is at most the sum of the neighbours' probabilities. Only the remaining cells, some 30 of 4,096, add
//! hazards.

use super::super::grid::{Cell, Shape};
use super::super::hazards::{Factors, Hazards, Transition, hazard, scaled};
use super::super::randomness::split_mix;
use super::buffers::{Buffers, Keys};
use super::kernel::uniform;
use super::lanes::{LANES, fill, lanes_from};
use super::places::Places;
use std::collections::BTreeMap;

/// Number of units of a hazard of 1.
const UNIT: f64 = (1_u64 << 40) as f64;

const MARGIN: f64 = 1.0 + 1e-6;

/// The tables computed from the transitions and the grid, which all worlds share.
#[derive(Debug)]
pub(super) struct Tables {
    /// For each state that can change, a bound of the probability with which it does.
    bounds: Vec<Bound>,
    changes: Vec<Changes>,
    centre: usize,
}

/// An upper bound of the probability that a cell in one state changes, in 256ths.
#[derive(Debug)]
struct Bound {
    state: u8,
    /// The bound without neighbours, less 1 unless it is 0: the last byte value within the bound.
    base: Counts,
    neighbours: Vec<Neighbour>,
}

/// The part of a bound that is due to one neighbour in one state.
#[derive(Debug)]
struct Neighbour {
    state: u8,
    offset: usize,
    count: Counts,
}

/// A number of 256ths for all cells, or for each chunk of [`LANES`] homes.
#[derive(Debug)]
struct Counts(Vec<u8>);

#[derive(Debug)]
struct Changes {
    /// The offsets from a cell's home to the neighbours that influence it.
    offsets: Vec<usize>,
    transitions: Vec<Change>,
}

/// A transition with its hazards in units.
#[derive(Debug)]
struct Change {
    to: u8,
    base: f64,
    /// The hazard of each neighbour, as `[neighbour][state]`. The last state stands for places off the grid. Empty if no
    /// neighbour has a hazard.
    near: Vec<f64>,
    /// The factors by home, unless all are 1.
    factors: Option<HomeFactors>,
}

#[derive(Debug)]
struct HomeFactors {
    of_base: Vec<f32>,
    /// The factors of the neighbours' hazards, as `[neighbour][home]`. Empty if they equal `of_base`.
    of_neighbours: Vec<f32>,
}

impl Tables {
    pub(super) fn new(hazards: &Hazards, n_states: usize, shape: Shape, places: &Places) -> Self {
        let homes = Homes { shape, places };
        let states = (0..n_states).map(|from| (from, hazards.transitions(from)));
        let changes = states.clone().map(|(_, of)| homes.changes(of, n_states));
        let changing = states.filter(|(_, transitions)| !transitions.is_empty());
        let bounds = changing.map(|(from, transitions)| homes.bound(from, transitions));
        Self {
            bounds: bounds.collect(),
            changes: changes.collect(),
            centre: places.centre(),
        }
    }

    #[inline(always)] // Like the functions it calls, so that all are compiled for this processor's vectors.
    pub(super) fn advance(&self, keys: Keys, buffers: &mut Buffers) {
        for band in buffers.bands() {
            let Places { states, next, .. } = &mut buffers.places;
            let bytes = &mut next[band.clone()];
            fill(bytes, keys[0], band.start / 8);
            let (chunks, _) = bytes.as_chunks_mut();
            for (home, lanes) in band.clone().step_by(LANES).zip(chunks) {
                self.mark(home, lanes, &states[home..]);
            }
            let n_listed = buffers.list_marked(band);
            self.draw(&buffers.listed[..n_listed], keys, &mut buffers.places);
        }
    }

    /// Replaces the random bytes of a chunk with the cells' states, or with marks where the state may change.
    #[inline(always)]
    fn mark(&self, home: usize, bytes: &mut [u8; LANES], states: &[u8]) {
        let own = lanes_from(states, self.centre);
        let (mut may_change, mut most) = ([0; LANES], [0; LANES]);
        for bound in &self.bounds {
            let mut sum = [bound.base.of(home); LANES];
            for neighbour in &bound.neighbours {
                let lanes = lanes_from(states, neighbour.offset);
                let count = neighbour.count.of(home);
                for lane in 0..LANES {
                    let is_in_state = u8::from(lanes[lane] == neighbour.state).wrapping_neg();
                    sum[lane] = sum[lane].saturating_add(count & is_in_state);
                }
            }
            for lane in 0..LANES {
                let is_own = u8::from(own[lane] == bound.state).wrapping_neg();
                may_change[lane] |= is_own;
                most[lane] |= sum[lane] & is_own;
            }
        }
        for lane in 0..LANES {
            let is_within = u8::from(bytes[lane] <= most[lane]).wrapping_neg();
            bytes[lane] = own[lane] | (is_within & may_change[lane]);
        }
    }

    #[inline(never)] // For the same reason as `Buffers::list_marked`.
    fn draw(&self, listed: &[u32], [byte_key, draw_key]: Keys, places: &mut Places) {
        for &home in listed {
            let home = home as usize;
            // The byte that `mark` compared, and 56 more bits.
            let byte = split_mix(byte_key, home as u64 / 8).to_le_bytes()[home % 8];
            let random = u64::from(byte) << 56 | split_mix(draw_key, home as u64) >> 8;
            let threshold = (UNIT * hazard(uniform(random))) as u64;
            let states = &places.states[home..];
            let own = states[self.centre];
            let next = self.changes[usize::from(own)].next(home, states, threshold);
            places.next[home] = next.unwrap_or(own);
        }
    }
}

impl Counts {
    #[inline(always)]
    fn of(&self, home: usize) -> u8 {
        self.0[if self.0.len() == 1 { 0 } else { home / LANES }]
    }
}

impl Changes {
    /// Returns the next state of the first transition whose sum of hazards exceeds the threshold. `states` begins at
    /// the cell's home.
    #[inline]
    fn next(&self, home: usize, states: &[u8], threshold: u64) -> Option<u8> {
        let mut sum = 0_u64;
        for change in &self.transitions {
            let factors = change.factors.as_ref();
            let of_base = factors.map_or(1.0, |factors| factors.of_base[home]);
            sum = sum.saturating_add(units(change.base, of_base));
            let row = change.near.len() / self.offsets.len().max(1);
            let near = change.near.chunks_exact(row.max(1)).zip(&self.offsets);
            for (index, (hazards, &offset)) in near.enumerate() {
                let hazard = hazards[usize::from(states[offset]).min(row - 1)];
                if hazard > 0.0 {
                    let factor = factors.map_or(1.0, |it| it.of_neighbour(index, home));
                    sum = sum.saturating_add(units(hazard, factor));
                }
            }
            if threshold < sum {
                return Some(change.to);
            }
        }
        None
    }
}

impl HomeFactors {
    #[inline]
    fn of_neighbour(&self, index: usize, home: usize) -> f32 {
        if self.of_neighbours.is_empty() {
            self.of_base[home]
        } else {
            self.of_neighbours[index * self.of_base.len() + home]
        }
    }
}

/// Multiplies a hazard in units by a factor, and rounds the product. A certain transition has the largest number.
#[inline]
fn units(hazard: f64, factor: f32) -> u64 {
    (scaled(hazard, factor.into()) + 0.5) as u64
}

/// Returns the probability of a hazard in 256ths, rounded up, but at most 255.
fn count(hazard: f64) -> u8 {
    let probability = -(-hazard).exp_m1();
    (256.0 * MARGIN * probability).ceil() as u8
}

/// The homes of a grid's cells, for which tables are made.
#[derive(Clone, Copy)]
struct Homes<'a> {
    shape: Shape,
    places: &'a Places,
}

impl Homes<'_> {
    fn offset(&self, [row, col]: [isize; 2]) -> usize {
        let offset = row * self.places.stride as isize + col;
        self.places.centre().wrapping_add_signed(offset)
    }

    fn cells(&self) -> impl Iterator<Item = (Cell, usize)> {
        let cells = (0..self.shape.n_cells()).map(|index| self.shape.cell(index));
        cells.map(|cell| (cell, self.places.home(cell.row, cell.col)))
    }

    fn changes(&self, transitions: &[Transition], n_states: usize) -> Changes {
        let near = transitions.iter().flat_map(|it| &it.near);
        let mut offsets: Vec<[isize; 2]> = near.map(|near| near.offset).collect();
        offsets.sort_unstable();
        offsets.dedup();
        let change = |transition: &Transition| {
            let row = n_states + 1;
            let n_neighbours = if transition.near.is_empty() {
                0
            } else {
                offsets.len()
            };
            let mut near = vec![0.0; n_neighbours * row];
            for it in &transition.near {
                let index = offsets.binary_search(&it.offset);
                let index = index.expect("invariant: all offsets are listed");
                near[index * row + it.state] = UNIT * it.hazard;
            }
            Change {
                to: transition.to as u8,
                base: UNIT * transition.base,
                near,
                factors: self.factors(&transition.factors, &offsets),
            }
        };
        Changes {
            transitions: transitions.iter().map(change).collect(),
            offsets: offsets.iter().map(|offset| self.offset(*offset)).collect(),
        }
    }

    fn factors(&self, factors: &Factors, offsets: &[[isize; 2]]) -> Option<HomeFactors> {
        if factors.are_one() {
            return None;
        }
        let of_homes = |factor: &dyn Fn(Cell) -> f64| {
            let mut of_homes = vec![0.0; self.places.next.len()];
            for (cell, home) in self.cells() {
                of_homes[home] = factor(cell) as f32;
            }
            of_homes
        };
        let mut of_neighbours = Vec::new();
        if factors.differ_by_place() {
            for &offset in offsets {
                of_neighbours.extend(of_homes(&|cell| factors.of_neighbour(offset, cell)));
            }
        }
        Some(HomeFactors {
            of_base: of_homes(&|cell| factors.of_base(cell)),
            of_neighbours,
        })
    }

    fn bound(&self, from: usize, transitions: &[Transition]) -> Bound {
        let is_alike = transitions.iter().all(|it| it.factors.are_one());
        let mut base = self.counts(is_alike, |cell| {
            let bases = transitions
                .iter()
                .map(|it| scaled(it.base, it.factors.of_base(cell)));
            bases.sum()
        });
        base.0
            .iter_mut()
            .for_each(|count| *count = count.saturating_sub(1));
        let mut by_neighbour: BTreeMap<_, Vec<(&Factors, f64)>> = BTreeMap::new();
        for transition in transitions {
            for near in &transition.near {
                let hazards = by_neighbour.entry((near.offset, near.state)).or_default();
                hazards.push((&transition.factors, near.hazard));
            }
        }
        let neighbour = |((offset, state), hazards): (_, Vec<(&Factors, f64)>)| {
            let hazard = |cell| {
                let hazards = hazards.iter();
                let hazards =
                    hazards.map(|(it, hazard)| scaled(*hazard, it.of_neighbour(offset, cell)));
                hazards.sum()
            };
            Neighbour {
                state: state as u8,
                offset: self.offset(offset),
                count: self.counts(is_alike, hazard),
            }
        };
        Bound {
            state: from as u8,
            base,
            neighbours: by_neighbour.into_iter().map(neighbour).collect(),
        }
    }

    /// Counts a hazard for all cells, or for each chunk its largest value.
    fn counts(&self, is_alike: bool, hazard: impl Fn(Cell) -> f64) -> Counts {
        if is_alike {
            return Counts(vec![count(hazard(Cell { row: 0, col: 0 }))]);
        }
        let mut counts = vec![0; self.places.next.len() / LANES];
        for (cell, home) in self.cells() {
            let most = &mut counts[home / LANES];
            *most = count(hazard(cell)).max(*most);
        }
        Counts(counts)
    }
}
