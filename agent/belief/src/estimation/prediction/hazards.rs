//! Predictions by a model of hazards.
//!
//! Let `p_k[n, l]` be the probability that neighbour `l`, if it is in state `n`, causes one of the first `k` transitions
//! of a cell. None of these transitions happens with probability `(1 - b_k) prod_l (1 - p_k[x_l, l])`, where `x_l` is
//! the neighbour's state. The filter assumes that the neighbours are independent. So the mean is the product of means:
//!
//! `S_k = (1 - b_k) prod_l (1 - sum_n p_k[n, l] mu_l[n])`, with the belief `mu_l` about neighbour `l`.
//!
//! Transition `k` is then the next one with probability `S_{k-1} - S_k`. This is exact under the assumption. The code
//! computes `1 - S_k` instead of `S_k`, because `S_k` of a rare transition is 1 in single precision.
//!
//! **Echo.** A cell changes its neighbours, and the changed beliefs about them change the cell's next prediction, as if
//! they were new evidence. Dynamic message passing (Karrer and Newman 2010; Lokhov et al. 2014) avoids this echo. It
//! keeps a *cavity* for each cell and each of its neighbours: the belief about the cell, given that the neighbour stays
//! susceptible. A cell is *susceptible* in the state in which its neighbours influence its next state. A susceptible
//! cell is predicted from its neighbours' cavities, which do not contain its own influence. If neighbours have an
//! influence in several current states, only the state with the most influence is treated as susceptible.

use super::lanes::{LANES, Lanes, add, add_product, lanes_from};
use super::padded::PaddedBeliefs;
use super::planes::Planes;
use crate::estimation::belief::Belief;
use emberwatch_model::hazards::{Factors, Hazards, Near, Transition, scaled};
use emberwatch_model::vectors::vectorised;
use emberwatch_model::{Cell, Shape};
use std::collections::BTreeMap;
use std::sync::Arc;

const MAX_DRIFT: f32 = 1e-5;

/// The predictions of one world, with its belief and cavities in planes.
#[derive(Debug, Clone)]
pub struct HazardPrediction {
    shape: Shape,
    n_states: usize,
    changes: Arc<[Vec<Change>]>,
    susceptible: Option<usize>,
    /// For each neighbour, the offset from the cell's index in a plane to the neighbour's index. The opposite of
    /// neighbour `l` is neighbour `n - 1 - l`.
    offsets: Vec<isize>,
    pub beliefs: PaddedBeliefs,
    next: PaddedBeliefs,
    work: Work,
}

/// The first `k` transitions of cells in one state.
#[derive(Debug)]
struct Change {
    to: usize,
    /// `b_k`.
    base: Values,
    /// The neighbours that can cause one of the transitions, in ascending order. Empty if they and their probabilities
    /// are those of the transitions before.
    neighbours: Vec<Neighbour>,
}

#[derive(Debug)]
struct Neighbour {
    index: usize,
    /// `p_k[n, l]` of each state `n` in which it is not 0.
    sources: Vec<(usize, Values)>,
}

#[derive(Debug)]
enum Values {
    One(f32),
    Plane(Vec<f32>),
}

#[derive(Debug, Clone)]
struct Work {
    next: Vec<Lanes>,
    /// The same for each cavity, as `[cavity][state]`.
    next_cavities: Vec<Lanes>,
    /// For each cavity, the probability that the other neighbours cause one of the transitions.
    rest: Vec<Lanes>,
    /// For each cavity, the probability of one of the transitions so far.
    last: Vec<Lanes>,
    by_neighbour: Vec<Lanes>,
}

impl HazardPrediction {
    /// Prepares predictions on the belief's grid. All cavities start as copies of the belief.
    pub fn new(hazards: &Hazards, edge: Option<usize>, belief: &Belief, cavities: bool) -> Self {
        let n_states = belief.n_states();
        let [height, width] = hazards.size();
        let of = |from: usize| hazards.transitions(from);
        let influence = |from: usize| {
            let near = of(from).iter().flat_map(|it| &it.near);
            near.map(|near| near.hazard.min(1.0)).sum::<f64>()
        };
        let influenced = (0..n_states).filter(|&from| cavities && influence(from) > 0.0);
        let susceptible = influenced.max_by(|&a, &b| influence(a).total_cmp(&influence(b)));
        let mut offsets: Vec<[isize; 2]> = (0..n_states)
            .flat_map(of)
            .flat_map(|transition| &transition.near)
            .flat_map(|near| [near.offset, near.offset.map(|it| -it)])
            .collect();
        offsets.sort_unstable();
        offsets.dedup();
        let n_cavities = susceptible.map_or(0, |_| offsets.len());
        let beliefs = PaddedBeliefs::new(belief, [height, width], n_cavities, edge);
        let table = Builder {
            shape: belief.shape(),
            planes: &beliefs.planes,
            offsets: &offsets,
        };
        let lanes = |n: usize| vec![[0.0; LANES]; n];
        Self {
            shape: belief.shape(),
            n_states,
            changes: (0..n_states).map(|from| table.changes(of(from))).collect(),
            susceptible,
            offsets: offsets
                .iter()
                .map(|offset| beliefs.planes.offset(*offset))
                .collect(),
            next: beliefs.clone(),
            beliefs,
            work: Work {
                next: lanes(n_states),
                next_cavities: lanes(n_cavities * n_states),
                rest: lanes(n_cavities),
                last: lanes(n_cavities),
                by_neighbour: lanes(n_cavities),
            },
        }
    }

    /// Moves the belief, shape `[S, H, W]`, and the cavities one step ahead.
    pub fn predict(&mut self, belief: &mut [f32]) {
        let expected = self.n_states * self.shape.n_cells();
        assert_eq!(belief.len(), expected, "belief: expected [S, H, W]");
        self.beliefs.set_belief(belief);
        let changes = Arc::clone(&self.changes);
        vectorised(
            #[inline(always)]
            || {
                for row in 0..self.shape.height() {
                    for col in (0..self.shape.width()).step_by(LANES) {
                        self.predict_chunk(&changes, self.beliefs.planes.place([row, col]));
                        self.store([row, col], belief);
                    }
                }
            },
        );
        std::mem::swap(&mut self.beliefs, &mut self.next);
    }

    #[inline(always)] // So that `vectorised` compiles it for this processor's vector instructions.
    fn predict_chunk(&mut self, changes: &[Vec<Change>], place: usize) {
        let n_cavities = self.beliefs.n_cavities;
        self.work.next.fill([0.0; LANES]);
        self.work.next_cavities.fill([0.0; LANES]);
        for (own, changes) in changes.iter().enumerate() {
            let has_cavities = self.susceptible == Some(own);
            let here = *self.belief(n_cavities, own, place);
            let (mut by_neighbours, mut last) = ([0.0; LANES], [0.0; LANES]);
            if has_cavities {
                self.work.rest.fill([0.0; LANES]);
                self.work.last.fill([0.0; LANES]);
            }
            for change in changes {
                if !change.neighbours.is_empty() {
                    by_neighbours = self.by_neighbours(change, place, has_cavities);
                }
                let mut any = by_neighbours;
                change.base.or(&mut any, place);
                add_difference(&mut self.work.next[change.to], &here, &any, &last);
                for cavity in 0..n_cavities {
                    let here = *self.belief(cavity, own, place);
                    let to = cavity * self.n_states + change.to;
                    if has_cavities {
                        let mut any = self.work.rest[cavity];
                        change.base.or(&mut any, place);
                        let last = std::mem::replace(&mut self.work.last[cavity], any);
                        add_difference(&mut self.work.next_cavities[to], &here, &any, &last);
                    } else {
                        add_difference(&mut self.work.next_cavities[to], &here, &any, &last);
                    }
                }
                last = any;
            }
            add_difference(&mut self.work.next[own], &here, &[1.0; LANES], &last);
            for cavity in 0..n_cavities {
                let here = *self.belief(cavity, own, place);
                let last = if has_cavities {
                    &self.work.last[cavity]
                } else {
                    &last
                };
                let to = cavity * self.n_states + own;
                add_difference(&mut self.work.next_cavities[to], &here, &[1.0; LANES], last);
            }
        }
    }

    /// Returns the probability that neighbours cause one of the transitions. With cavities, also computes for each
    /// neighbour that of the other neighbours, given that the neighbour is susceptible.
    #[inline(always)]
    fn by_neighbours(&mut self, change: &Change, place: usize, has_cavities: bool) -> Lanes {
        let n_cavities = self.beliefs.n_cavities;
        let mut any = [0.0; LANES];
        for Neighbour { index, sources } in &change.neighbours {
            // The cavity of the neighbour that excludes this cell, which lies in the opposite direction.
            let opposite = self.offsets.len() - 1 - index;
            let of = if has_cavities { opposite } else { n_cavities };
            let at = place.wrapping_add_signed(self.offsets[*index]);
            let mut by_one = [0.0; LANES];
            for (state, probability) in sources {
                probability.add_product(&mut by_one, self.belief(of, *state, at), place);
            }
            // The sum of a belief can exceed 1 by rounding.
            for lane in &mut by_one {
                *lane = if *lane > 1.0 { 1.0 } else { *lane };
            }
            if has_cavities {
                self.work.rest[*index] = any;
                self.work.by_neighbour[*index] = by_one;
            }
            or(&mut any, &by_one);
        }
        if has_cavities {
            let mut later = [0.0; LANES];
            let mut to_come = change.neighbours.iter().rev().peekable();
            for index in (0..n_cavities).rev() {
                let Some(Neighbour { sources, .. }) = to_come.next_if(|it| it.index == index)
                else {
                    self.work.rest[index] = any;
                    continue;
                };
                let rest = &mut self.work.rest[index];
                or(rest, &later);
                let own = sources
                    .iter()
                    .find(|source| Some(source.0) == self.susceptible);
                if let Some((_, probability)) = own {
                    probability.or(rest, place);
                }
                or(&mut later, &self.work.by_neighbour[index]);
            }
        }
        any
    }

    /// Returns the belief about a chunk of cells in a state: a cavity, or for `n_cavities` the belief itself.
    #[inline(always)]
    fn belief(&self, cavity: usize, state: usize, place: usize) -> &Lanes {
        let plane = self.beliefs.start(cavity) + state * self.beliefs.planes.length;
        lanes_from(&self.beliefs.probabilities, plane + place)
    }

    #[inline(always)]
    fn store(&mut self, [row, col]: [usize; 2], belief: &mut [f32]) {
        let n_lanes = LANES.min(self.shape.width() - col);
        let first = row * self.shape.width() + col;
        let n_cells = self.shape.n_cells();
        write(&self.work.next, &mut belief[first..], n_cells, n_lanes);
        let (length, place) = (self.next.planes.length, self.next.planes.place([row, col]));
        for cavity in 0..self.next.n_cavities {
            let next = &self.work.next_cavities[cavity * self.n_states..][..self.n_states];
            let planes = self.next.start(cavity)..self.next.start(cavity + 1);
            write(
                next,
                &mut self.next.probabilities[planes][place..],
                length,
                n_lanes,
            );
        }
    }
}

#[inline(always)]
fn write(next: &[Lanes], planes: &mut [f32], plane_length: usize, n_lanes: usize) {
    let mut sums = [0.0; LANES];
    for (lanes, plane) in next.iter().zip(planes.chunks_mut(plane_length)) {
        add(&mut sums, lanes);
        plane[..n_lanes].copy_from_slice(&lanes[..n_lanes]);
    }
    correct_drift(planes, plane_length, &sums[..n_lanes]);
}

/// Rounding errors add up in a cell that is never seen.
#[inline(always)]
fn correct_drift(planes: &mut [f32], plane_length: usize, sums: &[f32]) {
    if sums.iter().all(|sum| (sum - 1.0).abs() <= MAX_DRIFT) {
        return;
    }
    for plane in planes.chunks_mut(plane_length) {
        let lanes = plane.iter_mut().zip(sums);
        lanes.for_each(|(probability, sum)| *probability /= sum);
    }
}

#[inline(always)]
fn add_difference(to: &mut Lanes, here: &Lanes, any: &Lanes, last: &Lanes) {
    for lane in 0..LANES {
        to[lane] += here[lane] * (any[lane] - last[lane]);
    }
}

/// Adds the probability of an independent event: `any` becomes the probability of one of the two.
#[inline(always)]
fn or(any: &mut Lanes, event: &Lanes) {
    for lane in 0..LANES {
        any[lane] += event[lane] * (1.0 - any[lane]);
    }
}

impl Values {
    #[inline(always)]
    fn or(&self, any: &mut Lanes, place: usize) {
        match self {
            Self::One(number) => or(any, &[*number; LANES]),
            Self::Plane(numbers) => or(any, lanes_from(numbers, place)),
        }
    }

    #[inline(always)]
    fn add_product(&self, to: &mut Lanes, by: &Lanes, place: usize) {
        match self {
            Self::One(number) => add_product(to, &[*number; LANES], by),
            Self::Plane(numbers) => add_product(to, lanes_from(numbers, place), by),
        }
    }
}

struct Builder<'a> {
    shape: Shape,
    planes: &'a Planes,
    offsets: &'a [[isize; 2]],
}

impl Builder<'_> {
    fn changes(&self, transitions: &[Transition]) -> Vec<Change> {
        let change = |k: usize| {
            let so_far = &transitions[..=k];
            let is_alike = so_far.iter().all(|it| it.factors.are_one());
            let base = self.values(is_alike, |cell| {
                let hazards = so_far
                    .iter()
                    .map(|it| scaled(it.base, it.factors.of_base(cell)));
                -(-hazards.sum::<f64>()).exp_m1()
            });
            let is_new = !transitions[k].near.is_empty();
            Change {
                to: transitions[k].to,
                base,
                neighbours: if is_new {
                    self.neighbours(so_far)
                } else {
                    Vec::new()
                },
            }
        };
        (0..transitions.len()).map(change).collect()
    }

    fn neighbours(&self, transitions: &[Transition]) -> Vec<Neighbour> {
        let mut by_source: BTreeMap<_, Vec<(&Factors, Near)>> = BTreeMap::new();
        for transition in transitions {
            for near in &transition.near {
                let of_source = by_source.entry((near.offset, near.state)).or_default();
                of_source.push((&transition.factors, *near));
            }
        }
        let mut neighbours: Vec<Neighbour> = Vec::new();
        for ((offset, state), near) in by_source {
            let index = self.offsets.binary_search(&offset);
            let index = index.expect("invariant: all offsets are listed");
            let is_alike = near.iter().all(|(factors, _)| factors.are_one());
            let probability = self.values(is_alike, |cell| {
                let hazards = near
                    .iter()
                    .map(|(factors, near)| scaled(near.hazard, factors.of_neighbour(offset, cell)));
                -(-hazards.sum::<f64>()).exp_m1()
            });
            match neighbours.last_mut() {
                Some(last) if last.index == index => last.sources.push((state, probability)),
                _ => neighbours.push(Neighbour {
                    index,
                    sources: vec![(state, probability)],
                }),
            }
        }
        neighbours
    }

    fn values(&self, is_alike: bool, value: impl Fn(Cell) -> f64) -> Values {
        if is_alike {
            return Values::One(value(Cell { row: 0, col: 0 }) as f32);
        }
        let mut plane = vec![0.0; self.planes.length];
        for cell in (0..self.shape.n_cells()).map(|index| self.shape.cell(index)) {
            plane[self.planes.place([cell.row, cell.col])] = value(cell) as f32;
        }
        Values::Plane(plane)
    }
}
