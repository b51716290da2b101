//! Arranges the weights of a model for predictions.

use super::kernels::{FixedTransition, Group, OwnKernel, Source, Weights};
use emberwatch_model::zoned::ZonedNumbers;
use ndarray::Array4;

/// Totals of scaled weights that differ by at most this value count as equal. The value exceeds the rounding errors of
/// the summation.
const TOTAL_TOLERANCE: f64 = 1e-9;

/// All weights of a model, arranged for predictions.
#[derive(Debug, Clone)]
pub struct Layout {
    pub kernels: Vec<OwnKernel>,
    pub fixed: Vec<FixedTransition>,
    /// Row and column of each neighbour in the kernel. Without own-state kernels, the centre counts as a neighbour too.
    pub taps: Vec<[usize; 2]>,
    /// The value of each slot in the zone of each cell.
    pub slots: ZonedNumbers<f32>,
}

impl Layout {
    pub fn new(weights: Weights<'_>) -> Self {
        let mut builder = Builder::new(weights);
        let (mut kernels, mut fixed) = (Vec::new(), Vec::new());
        for own_state in 0..builder.n_kernels {
            let kernel = builder.own_kernel(own_state);
            if kernel.own_state.is_some() && kernel.groups.is_empty() {
                fixed.push(builder.fixed_transition(own_state));
            } else {
                kernels.push(kernel);
            }
        }
        Self {
            kernels,
            fixed,
            slots: ZonedNumbers::new(&builder.slots, weights.zones.0),
            taps: builder.taps,
        }
    }

    /// Returns the index of the own-state kernel that neighbours influence most, if there are own-state kernels.
    pub fn most_influenced(&self) -> Option<usize> {
        let kernels = self.kernels.iter().enumerate();
        let kernels = kernels.filter(|(_, kernel)| kernel.own_state.is_some());
        let most = kernels.max_by(|(_, a), (_, b)| a.influence.total_cmp(&b.influence));
        most.map(|(index, _)| index)
    }
}

/// A builder of kernels, which also collects the values of their slots. Values that depend on the zone are lists with
/// one entry per zone.
struct Builder<'a> {
    weights: Weights<'a>,
    n_states: usize,
    /// Number of kernels per zone: 1, or S for own-state kernels.
    n_kernels: usize,
    /// Row and column of each neighbour in the kernel.
    taps: Vec<[usize; 2]>,
    centre: [usize; 2],
    /// For each own state, the power of two that scales its largest weight to at least 1 and less than 2, so that all
    /// weights fit in `f32`.
    scales: Vec<f64>,
    /// The value of each slot in each zone.
    slots: Vec<Vec<f32>>,
}

impl<'a> Builder<'a> {
    fn new(weights: Weights<'a>) -> Self {
        let (n_states, _, height, width) = weights.kernels[0].dim();
        let n_kernels = weights.kernels.len() / weights.zones.1;
        let centre = [height / 2, width / 2];
        let taps = (0..height * width).map(|tap| [tap / width, tap % width]);
        let scale = |own: usize| {
            let kernels = weights.kernels.iter().skip(own).step_by(n_kernels);
            let numbers = kernels.flatten().chain(weights.bias);
            let largest = numbers.copied().fold(f64::MIN_POSITIVE, f64::max);
            (-largest.log2().floor()).exp2()
        };
        Self {
            weights,
            n_states,
            n_kernels,
            taps: taps
                .filter(|tap| n_kernels == 1 || *tap != centre)
                .collect(),
            centre,
            scales: (0..n_kernels).map(scale).collect(),
            slots: Vec::new(),
        }
    }

    /// Builds the kernel of an own state. If one kernel applies to all own states, `own` is 0.
    fn own_kernel(&mut self, own: usize) -> OwnKernel {
        let next_states = self.next_states(own);
        let biases: Vec<_> = next_states.iter().map(|m| self.bias(own, *m)).collect();
        let mut kernel = OwnKernel {
            own_state: (self.n_kernels > 1).then_some(own),
            next_states,
            bias_slots: biases.iter().map(|bias| self.slot(bias)).collect(),
            groups: Vec::new(),
            total_slots: Vec::new(),
            totals_differ: self.totals_differ(own),
            influence: self.influence(own),
        };
        for neighbours in self.neighbours_by_weights(own) {
            let sources = self.sources(own, self.taps[neighbours[0]], &mut kernel);
            if !sources.is_empty() {
                kernel.groups.push(Group {
                    neighbours,
                    sources,
                });
            }
        }
        kernel
    }

    /// Builds the transition from an own state in which no neighbour influences the cell.
    fn fixed_transition(&mut self, own_state: usize) -> FixedTransition {
        let biases: Vec<_> = (0..self.n_states)
            .map(|m| self.bias(own_state, m))
            .collect();
        let probability = |m: usize| -> Vec<f64> {
            let zones = 0..biases[m].len();
            let total = |zone: usize| biases.iter().map(|bias| bias[zone]).sum::<f64>();
            zones.map(|zone| biases[m][zone] / total(zone)).collect()
        };
        let probabilities: Vec<_> = (0..self.n_states).map(probability).collect();
        FixedTransition {
            own_state,
            probability_slots: probabilities.iter().map(|p| self.slot(p)).collect(),
        }
    }

    /// Returns the kernels of an own state, one per zone.
    fn zones(&self, own: usize) -> impl Iterator<Item = &Array4<f64>> {
        let kernels = self.weights.kernels.iter().skip(own);
        kernels.step_by(self.n_kernels)
    }

    /// Evaluates `f`, a sum of weights, on each zone's kernel of an own state. Returns the scaled sums.
    fn by_zone(&self, own: usize, f: impl Fn(&Array4<f64>) -> f64) -> Vec<f64> {
        let scale = self.scales[own];
        self.zones(own).map(|kernel| scale * f(kernel)).collect()
    }

    /// Returns the slot with the given values. Adds a slot if there is none.
    fn slot(&mut self, by_zone: &[f64]) -> usize {
        let by_zone: Vec<f32> = by_zone.iter().map(|number| *number as f32).collect();
        let known = self.slots.iter().position(|known| *known == by_zone);
        known.unwrap_or_else(|| {
            self.slots.push(by_zone);
            self.slots.len() - 1
        })
    }

    /// Returns the weight that a neighbour's state adds to a next state, by zone.
    fn weight(&self, own: usize, next: usize, state: usize, [row, col]: [usize; 2]) -> Vec<f64> {
        self.by_zone(own, |kernel| kernel[[next, state, row, col]])
    }

    fn has_weight(&self, own: usize, next: usize, state: usize, tap: [usize; 2]) -> bool {
        self.weight(own, next, state, tap).iter().any(|w| *w > 0.0)
    }

    /// Returns the weight that a next state has without any neighbours, by zone.
    fn bias(&self, own: usize, next: usize) -> Vec<f64> {
        let [row, col] = self.centre;
        let bias = self.weights.bias[next];
        let centre = if self.n_kernels > 1 { 1.0 } else { 0.0 };
        self.by_zone(own, |kernel| bias + centre * kernel[[next, own, row, col]])
    }

    /// Returns the total `d` of a neighbour's weights in one of its states, by zone.
    fn total(&self, own: usize, state: usize, [row, col]: [usize; 2]) -> Vec<f64> {
        self.by_zone(own, |kernel| {
            let weights = (0..self.n_states).map(|m| kernel[[m, state, row, col]]);
            weights.sum()
        })
    }

    fn totals_differ(&self, own: usize) -> bool {
        self.taps.iter().any(|tap| {
            let first = self.total(own, 0, *tap);
            let differs = |(a, b): (&f64, &f64)| (a - b).abs() > TOTAL_TOLERANCE;
            let other = |state| self.total(own, state, *tap).iter().zip(&first).any(differs);
            (1..self.n_states).any(other)
        })
    }

    /// Lists the next states with a positive bias or weight.
    fn next_states(&self, own: usize) -> Vec<usize> {
        let has_any = |next: &usize| {
            let has_weight = |tap: &[usize; 2]| {
                (0..self.n_states).any(|state| self.has_weight(own, *next, state, *tap))
            };
            self.bias(own, *next).iter().any(|bias| *bias > 0.0) || self.taps.iter().any(has_weight)
        };
        (0..self.n_states).filter(has_any).collect()
    }

    /// Lists the states in which a neighbour has positive weights, and adds the totals of these weights to the kernel.
    fn sources(&mut self, own: usize, tap: [usize; 2], kernel: &mut OwnKernel) -> Vec<Source> {
        let mut sources = Vec::new();
        for state in 0..self.n_states {
            let mut terms = Vec::new();
            for (index, next) in kernel.next_states.iter().enumerate() {
                if self.has_weight(own, *next, state, tap) {
                    let weight = self.weight(own, *next, state, tap);
                    terms.push((index, self.slot(&weight)));
                }
            }
            if terms.is_empty() {
                continue;
            }
            let slot = self.slot(&self.total(own, state, tap));
            let known = kernel.total_slots.iter().position(|known| *known == slot);
            let total = known.unwrap_or(kernel.total_slots.len());
            if known.is_none() {
                kernel.total_slots.push(slot);
            }
            sources.push(Source {
                state,
                total,
                terms,
            });
        }
        sources
    }

    /// Groups the neighbours by their weights. Groups are ordered by their first neighbour.
    fn neighbours_by_weights(&self, own: usize) -> Vec<Vec<usize>> {
        let mut groups: Vec<Vec<usize>> = Vec::new();
        let weights = |tap: [usize; 2]| -> Vec<Vec<f64>> {
            let pairs = (0..self.n_states * self.n_states).map(|pair| {
                let (next, state) = (pair / self.n_states, pair % self.n_states);
                self.weight(own, next, state, tap)
            });
            pairs.collect()
        };
        for (neighbour, tap) in self.taps.iter().enumerate() {
            let is_alike = |group: &&mut Vec<usize>| weights(self.taps[group[0]]) == weights(*tap);
            match groups.iter_mut().find(is_alike) {
                Some(group) => group.push(neighbour),
                None => groups.push(vec![neighbour]),
            }
        }
        groups
    }

    /// Computes [`OwnKernel::influence`] as the mean over zones.
    fn influence(&self, own: usize) -> f64 {
        let n = self.n_states;
        let influence = |kernel: &Array4<f64>| {
            let (mut change, mut total) = (0.0, self.weights.bias.iter().sum::<f64>());
            let [row, col] = self.centre;
            total += (0..n).map(|m| kernel[[m, own, row, col]]).sum::<f64>();
            for &[row, col] in &self.taps {
                for m in 0..n {
                    let weights = (0..n).map(|state| kernel[[m, state, row, col]]);
                    let smallest = weights.clone().fold(f64::MAX, f64::min);
                    change += weights.clone().fold(0.0, f64::max) - smallest;
                    total += weights.sum::<f64>() / n as f64;
                }
            }
            change / total
        };
        let by_zone: Vec<f64> = self.zones(own).map(influence).collect();
        by_zone.iter().sum::<f64>() / by_zone.len() as f64
    }
}
