//! A model's weights, laid out to be read by a prediction: which neighbours weigh alike, and in which states they weigh
//! anything.

use emberwatch_model::zoned::ZonedNumbers;
use emberwatch_model::{Grid, Model};
use ndarray::Array4;

/// The weights of a model, or learned ones.
#[derive(Debug, Clone, Copy)]
pub struct Weights<'a> {
    /// `w[m, n, a, c]`, `[S, S, KH, KW]`: for each zone one for all cells, or one for each own state.
    pub kernels: &'a [Array4<f64>],
    /// `b[m]`.
    pub bias: &'a [f64],
    /// The zone of each cell, `[H, W]`, and how many zones there are.
    pub zones: (Option<&'a Grid<u8>>, usize),
    /// The state of cells outside the grid; `None`: they add no weight.
    pub edge: Option<usize>,
}

impl<'a> From<&'a Model> for Weights<'a> {
    fn from(model: &'a Model) -> Self {
        Self {
            kernels: model.kernels(),
            bias: model.bias().as_slice().expect("invariant: row-major"),
            zones: (model.zone_map().map(|map| &**map), model.n_zones()),
            edge: model.edge(),
        }
    }
}

/// The next states of cells in an own state on which neighbours act; without own kernels those of all cells.
#[derive(Debug, Clone)]
pub struct Act {
    pub own: Option<usize>,
    /// The next states that have a weight.
    pub next: Vec<usize>,
    /// Of each of them the slot of what it weighs without neighbours: its bias, and the centre of an own kernel.
    pub base: Vec<usize>,
    pub groups: Vec<Group>,
    /// The slots of the different totals that a neighbour's weights can have.
    pub totals: Vec<usize>,
    /// Whether a neighbour's weights have another total in one state than in another.
    pub totals_differ: bool,
    /// How much neighbours change the next state: the change of weights by their states, as a share of the total.
    influence: f64,
}

/// Neighbours that weigh alike.
#[derive(Debug, Clone)]
pub struct Group {
    /// By index, from the upper left of the kernel on.
    pub neighbours: Vec<usize>,
    pub sources: Vec<Source>,
}

/// A state in which a neighbour of a group weighs something.
#[derive(Debug, Clone)]
pub struct Source {
    pub state: usize,
    /// Which of the totals its weights have.
    pub total: usize,
    /// Indices of [`Act::next`], and the slots of their weights.
    pub terms: Vec<(usize, usize)>,
}

/// An own state on which nothing acts.
#[derive(Debug, Clone)]
pub struct Rest {
    pub own: usize,
    /// The slot of each next state's probability.
    pub next: Vec<usize>,
}

/// The acts and rests of weights, and the numbers in their slots.
#[derive(Debug, Clone)]
pub struct Layout {
    pub acts: Vec<Act>,
    pub rests: Vec<Rest>,
    /// Neighbours as taps of the kernel, row and column: with own kernels all but the centre.
    pub taps: Vec<[usize; 2]>,
    /// The numbers in the slots.
    pub slots: ZonedNumbers<f32>,
}

impl Layout {
    pub fn new(weights: Weights<'_>) -> Self {
        let mut slots = Slots::new(weights);
        let (mut acts, mut rests) = (Vec::new(), Vec::new());
        for own in 0..slots.n_own {
            let act = slots.act(own);
            if slots.n_own > 1 && act.groups.is_empty() {
                rests.push(slots.rest(own));
            } else {
                acts.push(act);
            }
        }
        Self {
            acts,
            rests,
            slots: ZonedNumbers::new(&slots.of_zones, weights.zones.0),
            taps: slots.taps,
        }
    }

    /// The act whose next states depend most on neighbours.
    pub fn most_influenced(&self) -> Option<usize> {
        let acts = (0..self.acts.len()).filter(|act| self.acts[*act].own.is_some());
        acts.max_by(|a, b| {
            let influence = |act: usize| self.acts[act].influence;
            influence(*a).total_cmp(&influence(*b))
        })
    }
}

/// Collects the numbers that a prediction reads, each by zone.
struct Slots<'a> {
    weights: Weights<'a>,
    n_states: usize,
    n_own: usize,
    taps: Vec<[usize; 2]>,
    centre: [usize; 2],
    /// Of each slot the number of each zone.
    of_zones: Vec<Vec<f32>>,
}

impl<'a> Slots<'a> {
    fn new(weights: Weights<'a>) -> Self {
        let (n_states, _, height, width) = weights.kernels[0].dim();
        let n_own = weights.kernels.len() / weights.zones.1;
        let centre = [height / 2, width / 2];
        let taps = (0..height * width).map(|tap| [tap / width, tap % width]);
        Self {
            weights,
            n_states,
            n_own,
            taps: taps.filter(|tap| n_own == 1 || *tap != centre).collect(),
            centre,
            of_zones: Vec::new(),
        }
    }

    /// A number that is `f` of each zone's kernel of an own state, by zone.
    fn by_zone(&self, own: usize, f: impl Fn(&Array4<f64>) -> f64) -> Vec<f64> {
        let kernels = self.weights.kernels.iter().skip(own).step_by(self.n_own);
        kernels.map(f).collect()
    }

    /// The slot of a number by zone.
    fn slot(&mut self, by_zone: &[f64]) -> usize {
        let by_zone: Vec<f32> = by_zone.iter().map(|number| *number as f32).collect();
        let known = self.of_zones.iter().position(|known| *known == by_zone);
        known.unwrap_or_else(|| {
            self.of_zones.push(by_zone);
            self.of_zones.len() - 1
        })
    }

    /// What a next state weighs without neighbours, by zone.
    fn base(&self, own: usize, next: usize) -> Vec<f64> {
        let [row, col] = self.centre;
        let bias = self.weights.bias[next];
        let centre = if self.n_own > 1 { 1.0 } else { 0.0 };
        self.by_zone(own, |kernel| bias + centre * kernel[[next, own, row, col]])
    }

    /// The total of a neighbour's weights in a state, by zone.
    fn total(&self, own: usize, state: usize, [row, col]: [usize; 2]) -> Vec<f64> {
        let states = 0..self.n_states;
        let of = |kernel: &Array4<f64>| states.clone().map(|m| kernel[[m, state, row, col]]).sum();
        self.by_zone(own, of)
    }

    fn act(&mut self, own: usize) -> Act {
        let groups = self.groups(own);
        let is_next = |next: &usize| {
            let weighs = |tap: &[usize; 2]| {
                (0..self.n_states).any(|state| self.weighs(own, *next, state, *tap))
            };
            self.base(own, *next).iter().any(|base| *base > 0.0) || self.taps.iter().any(weighs)
        };
        let next: Vec<usize> = (0..self.n_states).filter(is_next).collect();
        let base = next
            .iter()
            .map(|next| self.base(own, *next))
            .collect::<Vec<_>>();
        let totals_differ = self.taps.iter().any(|tap| {
            let first = self.total(own, 0, *tap);
            let differs = |(a, b): (&f64, &f64)| (a - b).abs() > 1e-9;
            let other = |state| self.total(own, state, *tap).iter().zip(&first).any(differs);
            (1..self.n_states).any(other)
        });
        let influence = self.influence(own);
        let mut act = Act {
            own: (self.n_own > 1).then_some(own),
            base: base.iter().map(|base| self.slot(base)).collect(),
            next,
            groups: Vec::new(),
            totals: Vec::new(),
            totals_differ,
            influence,
        };
        for neighbours in groups {
            let sources = self.sources(own, self.taps[neighbours[0]], &mut act);
            if !sources.is_empty() {
                act.groups.push(Group {
                    neighbours,
                    sources,
                });
            }
        }
        act
    }

    fn sources(&mut self, own: usize, tap: [usize; 2], act: &mut Act) -> Vec<Source> {
        let mut sources = Vec::new();
        for state in 0..self.n_states {
            let mut terms = Vec::new();
            for (index, next) in act.next.iter().enumerate() {
                if self.weighs(own, *next, state, tap) {
                    let at = [*next, state, tap[0], tap[1]];
                    let weight = self.by_zone(own, |kernel| kernel[at]);
                    terms.push((index, self.slot(&weight)));
                }
            }
            if terms.is_empty() {
                continue;
            }
            let slot = self.slot(&self.total(own, state, tap));
            let known = act.totals.iter().position(|known| *known == slot);
            let total = known.unwrap_or(act.totals.len());
            if known.is_none() {
                act.totals.push(slot);
            }
            sources.push(Source {
                state,
                total,
                terms,
            });
        }
        sources
    }

    fn weighs(&self, own: usize, next: usize, state: usize, [row, col]: [usize; 2]) -> bool {
        let weights = self.by_zone(own, |kernel| kernel[[next, state, row, col]]);
        weights.iter().any(|weight| *weight > 0.0)
    }

    /// Neighbours that weigh alike, in the order of their first.
    fn groups(&self, own: usize) -> Vec<Vec<usize>> {
        let mut groups: Vec<Vec<usize>> = Vec::new();
        let of = |tap: [usize; 2]| {
            let pairs = (0..self.n_states * self.n_states).map(move |pair| {
                let (next, state) = (pair / self.n_states, pair % self.n_states);
                self.by_zone(own, |kernel| kernel[[next, state, tap[0], tap[1]]])
            });
            pairs.collect::<Vec<_>>()
        };
        for (neighbour, tap) in self.taps.iter().enumerate() {
            let alike = |group: &&mut Vec<usize>| of(self.taps[group[0]]) == of(*tap);
            match groups.iter_mut().find(alike) {
                Some(group) => group.push(neighbour),
                None => groups.push(vec![neighbour]),
            }
        }
        groups
    }

    /// See [`Act::influence`]; the mean over zones.
    fn influence(&self, own: usize) -> f64 {
        let n = self.n_states;
        let of = |kernel: &Array4<f64>| {
            let (mut change, mut total) = (0.0, self.weights.bias.iter().sum::<f64>());
            let [row, col] = self.centre;
            total += (0..n).map(|m| kernel[[m, own, row, col]]).sum::<f64>();
            for &[row, col] in &self.taps {
                for m in 0..n {
                    let weights = (0..n).map(|state| kernel[[m, state, row, col]]);
                    let (least, most) = weights
                        .clone()
                        .fold((f64::MAX, 0.0_f64), |(a, b), w| (a.min(w), b.max(w)));
                    change += most - least;
                    total += weights.sum::<f64>() / n as f64;
                }
            }
            change / total
        };
        let by_zone = self.by_zone(own, of);
        by_zone.iter().sum::<f64>() / by_zone.len() as f64
    }

    fn rest(&mut self, own: usize) -> Rest {
        let base: Vec<Vec<f64>> = (0..self.n_states).map(|m| self.base(own, m)).collect();
        let share = |m: usize| {
            let zones = 0..base[m].len();
            let total = |zone: usize| base.iter().map(|base| base[zone]).sum::<f64>();
            zones.map(|zone| base[m][zone] / total(zone)).collect()
        };
        let next: Vec<Vec<f64>> = (0..self.n_states).map(share).collect();
        let next = next.iter().map(|next| self.slot(next)).collect();
        Rest { own, next }
    }
}
