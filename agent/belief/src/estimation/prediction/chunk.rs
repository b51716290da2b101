//! Computes the next-state distributions of a chunk of cells from the beliefs about their neighbours.
//!
//! The [parent module](super) defines the symbols in these comments.

use super::kernels::{Group, OwnKernel, Source};
use super::lanes::{
    LANES, Lanes, add, add_product, divided, exponential, lanes_from, multiply, sum,
};
use super::layout::Layout;

/// Nodes `s` and weights of the Gauss-Laguerre quadrature.
const NODES: [(f32, f32); 2] = [(0.585_786_46, 0.853_553_4), (3.414_213_7, 0.146_446_6)];

/// A single node at 0, with which the quadrature computes the mean field. This is exact if the total `D` is certain.
const MEAN_FIELD: [(f32, f32); 1] = [(0.0, 1.0)];

/// Totals of weights up to this value count as zero, because they may be rounding errors.
const MIN_TOTAL: f32 = 1e-30;

/// Work space and results of the prediction of one chunk of cells.
#[derive(Debug, Clone)]
pub struct ChunkPredictor {
    /// For each kernel, the probability of each of its next states.
    pub distributions: Vec<Vec<Lanes>>,
    /// For each neighbour, the next-state probabilities of the susceptible state's kernel, given that this neighbour is
    /// susceptible.
    pub cavity_distributions: Vec<Vec<Lanes>>,
    /// For each source (a state of the group's neighbours), the belief that a neighbour is in this state, summed over
    /// the group.
    belief_sums: Vec<Lanes>,
    /// For each source, the same sum, but with each neighbour's belief divided by the neighbour's `f_k`.
    ratio_sums: Vec<Lanes>,
    /// The weight of each next state.
    weights: Vec<Lanes>,
    /// `exp(-t d)` for each distinct total `d`.
    exponentials: Vec<Lanes>,
    /// `1 - exp(-t d)` for each source of a group.
    complements: Vec<Lanes>,
    /// `1 / f_k` for each neighbour.
    inverse_factors: Vec<Lanes>,
}

/// Input of the prediction of one chunk.
#[derive(Clone, Copy)]
pub struct ChunkInputs<'a> {
    /// The value of each weight slot (see [`OwnKernel`]).
    pub slots: &'a [Lanes],
    /// The planes of all beliefs.
    pub planes: &'a [f32],
    pub plane_length: usize,
    /// For each neighbour, the index in `planes` of the belief that the neighbour is in state 0.
    pub places: &'a [usize],
}

impl ChunkInputs<'_> {
    /// Returns the belief that a neighbour is in a state.
    #[inline(always)]
    fn belief(&self, neighbour: usize, state: usize) -> &Lanes {
        lanes_from(
            self.planes,
            self.places[neighbour] + state * self.plane_length,
        )
    }
}

impl ChunkPredictor {
    pub fn new(layout: &Layout, n_states: usize) -> Self {
        let kernels = layout.kernels.iter();
        let n_sources = |kernel: &OwnKernel| kernel.groups.iter().map(|it| it.sources.len()).sum();
        let n_sources: usize = kernels.clone().map(n_sources).max().unwrap_or(0);
        let n_totals = kernels.clone().map(|kernel| kernel.total_slots.len());
        let n_totals = n_totals.max().unwrap_or(0);
        let zeros = |n: usize| vec![[0.0; LANES]; n];
        Self {
            distributions: kernels.map(|it| zeros(it.next_states.len())).collect(),
            cavity_distributions: vec![zeros(n_states); layout.taps.len()],
            belief_sums: zeros(n_sources),
            ratio_sums: zeros(n_sources),
            weights: zeros(n_states),
            exponentials: zeros(n_totals),
            complements: zeros(n_states),
            inverse_factors: zeros(layout.taps.len()),
        }
    }

    /// Computes the next-state distribution of a kernel. If `has_cavities` is set, also computes its cavity
    /// distributions.
    #[inline(always)] // So that `vectorised` compiles it for this processor's vector instructions.
    pub fn predict(
        &mut self,
        index: usize,
        kernel: &OwnKernel,
        is_second_order: bool,
        has_cavities: bool,
        inputs: ChunkInputs<'_>,
    ) {
        let n = kernel.next_states.len();
        let is_exact = !(is_second_order && kernel.totals_differ);
        self.sum_beliefs(kernel, inputs);
        if is_exact && !has_cavities {
            self.sum_weights(kernel, inputs.slots, false);
            self.distributions[index].copy_from_slice(&self.weights[..n]);
        } else {
            let mean = self.mean_total(kernel, inputs.slots);
            self.distributions[index].fill([0.0; LANES]);
            if has_cavities {
                for distribution in &mut self.cavity_distributions {
                    distribution[..n].fill([0.0; LANES]);
                }
            }
            let nodes: &[(f32, f32)] = if is_exact { &MEAN_FIELD } else { &NODES };
            for node in nodes {
                self.add_node(index, kernel, *node, &mean, has_cavities, inputs);
            }
        }
        normalise(&mut self.distributions[index], None);
        if has_cavities {
            let otherwise = &self.distributions[index];
            for distribution in &mut self.cavity_distributions {
                normalise(&mut distribution[..n], Some(otherwise));
            }
        }
    }

    /// Sums the neighbours' beliefs for each source.
    #[inline(always)]
    fn sum_beliefs(&mut self, kernel: &OwnKernel, inputs: ChunkInputs<'_>) {
        let mut at = 0;
        for group in &kernel.groups {
            for source in &group.sources {
                let mut sum = [0.0; LANES];
                for &neighbour in &group.neighbours {
                    add(&mut sum, inputs.belief(neighbour, source.state));
                }
                self.belief_sums[at] = sum;
                at += 1;
            }
        }
    }

    /// Returns `E[D]`, the mean of the denominator of eq. 3.
    #[inline(always)]
    fn mean_total(&self, kernel: &OwnKernel, slots: &[Lanes]) -> Lanes {
        let mut mean = [0.0; LANES];
        for slot in &kernel.bias_slots {
            add(&mut mean, &slots[*slot]);
        }
        let sources = kernel.groups.iter().flat_map(|group| &group.sources);
        for (source, belief) in sources.zip(&self.belief_sums) {
            add_product(&mut mean, &slots[kernel.total_slots[source.total]], belief);
        }
        mean
    }

    /// Computes `b[m] + sum_k g_k[m] / f_k`, the weights at one node. If `at_node` is not set, computes the weights at
    /// `t = 0`, where they equal the mean of eq. 2.
    #[inline(always)]
    fn sum_weights(&mut self, kernel: &OwnKernel, slots: &[Lanes], at_node: bool) {
        for (weight, slot) in self.weights.iter_mut().zip(&kernel.bias_slots) {
            *weight = slots[*slot];
        }
        let sources = kernel.groups.iter().flat_map(|group| &group.sources);
        let sums = if at_node {
            &self.ratio_sums
        } else {
            &self.belief_sums
        };
        for (source, from) in sources.zip(sums) {
            let mut from = *from;
            if at_node {
                multiply(&mut from, &self.exponentials[source.total]);
            }
            for (next, slot) in &source.terms {
                add_product(&mut self.weights[*next], &slots[*slot], &from);
            }
        }
    }

    /// Adds the term of one node to the distributions, at `t = node / E[D]`.
    #[inline(always)]
    fn add_node(
        &mut self,
        index: usize,
        kernel: &OwnKernel,
        (node, weight): (f32, f32),
        mean: &Lanes,
        has_cavities: bool,
        inputs: ChunkInputs<'_>,
    ) {
        let t = divided(node, mean);
        for (to, slot) in self.exponentials.iter_mut().zip(&kernel.total_slots) {
            *to = exponential(&t, &inputs.slots[*slot]);
        }
        let mut bias = [0.0; LANES];
        for slot in &kernel.bias_slots {
            add(&mut bias, &inputs.slots[*slot]);
        }
        // The quadrature weight times exp(node - t b), then times each f_k.
        let mut factor = exponential(&t, &bias);
        multiply(&mut factor, &[weight * node.exp(); LANES]);
        self.multiply_groups(kernel, &mut factor, inputs);
        self.sum_weights(kernel, inputs.slots, true);
        for (to, weight) in self.distributions[index].iter_mut().zip(&self.weights) {
            add_product(to, weight, &factor);
        }
        if has_cavities {
            for group in &kernel.groups {
                self.add_cavities(kernel, group, &factor, inputs);
            }
        }
    }

    /// Multiplies `factor` by `f_k` of each neighbour, and computes the sums over each group.
    #[inline(always)]
    fn multiply_groups(&mut self, kernel: &OwnKernel, factor: &mut Lanes, inputs: ChunkInputs<'_>) {
        let mut at = 0;
        for group in &kernel.groups {
            let n_sources = group.sources.len();
            for (complement, source) in self.complements.iter_mut().zip(&group.sources) {
                let exponential = &self.exponentials[source.total];
                for lane in 0..LANES {
                    complement[lane] = 1.0 - exponential[lane];
                }
            }
            let complements = &self.complements[..n_sources];
            let products = GroupProducts {
                factor: &mut *factor,
                inverse_factors: &mut self.inverse_factors,
                ratio_sums: &mut self.ratio_sums[at..at + n_sources],
            };
            at += n_sources;
            // With a constant number of sources, the sums stay in registers.
            match n_sources {
                1 => multiply_few::<1>(group, inputs, complements, products),
                2 => multiply_few::<2>(group, inputs, complements, products),
                3 => multiply_few::<3>(group, inputs, complements, products),
                _ => multiply_factors(&group.sources, group, inputs, complements, products),
            }
        }
    }

    /// Adds the term of one node to the cavity distributions of a group's neighbours.
    ///
    /// Each cavity assumes that its neighbour `k` is susceptible. The neighbour's weights in that state then replace
    /// `g_k[m]`, and `exp(-t d)` replaces `f_k`. `factor` contains the product of all `f_k`.
    #[inline(always)]
    fn add_cavities(
        &mut self,
        kernel: &OwnKernel,
        group: &Group,
        factor: &Lanes,
        inputs: ChunkInputs<'_>,
    ) {
        let mut sources = group.sources.iter();
        let susceptible = sources.find(|source| Some(source.state) == kernel.own_state);
        for &neighbour in &group.neighbours {
            let inverse = &self.inverse_factors[neighbour];
            let mut other_factors = *factor;
            multiply(&mut other_factors, inverse);
            let distribution = &mut self.cavity_distributions[neighbour];
            if let Some(source) = susceptible {
                multiply(&mut other_factors, &self.exponentials[source.total]);
                for (next, slot) in &source.terms {
                    add_product(
                        &mut distribution[*next],
                        &inputs.slots[*slot],
                        &other_factors,
                    );
                }
            }
            let n = kernel.next_states.len();
            for (to, weight) in distribution.iter_mut().zip(&self.weights[..n]) {
                add_product(to, weight, &other_factors);
            }
            multiply(&mut other_factors, inverse);
            for source in &group.sources {
                let mut removed = self.exponentials[source.total];
                multiply(&mut removed, inputs.belief(neighbour, source.state));
                multiply(&mut removed, &other_factors);
                multiply(&mut removed, &[-1.0; LANES]);
                for (next, slot) in &source.terms {
                    add_product(&mut distribution[*next], &inputs.slots[*slot], &removed);
                }
            }
        }
    }
}

/// Results for the neighbours of a group.
struct GroupProducts<'a> {
    /// The running product, which is multiplied by the `f_k` of each neighbour.
    factor: &'a mut Lanes,
    inverse_factors: &'a mut [Lanes],
    ratio_sums: &'a mut [Lanes],
}

/// Calls [`multiply_factors`] for a group with `N` sources.
#[inline(always)]
fn multiply_few<const N: usize>(
    group: &Group,
    inputs: ChunkInputs<'_>,
    complements: &[Lanes],
    products: GroupProducts<'_>,
) {
    let (mut ratio_sums, mut factor) = ([[0.0; LANES]; N], *products.factor);
    let mut few = [[0.0; LANES]; N];
    few.copy_from_slice(complements);
    let local = GroupProducts {
        factor: &mut factor,
        inverse_factors: products.inverse_factors,
        ratio_sums: &mut ratio_sums,
    };
    multiply_factors(&group.sources[..N], group, inputs, &few, local);
    *products.factor = factor;
    products.ratio_sums.copy_from_slice(&ratio_sums);
}

/// Computes `f_k` for each neighbour of a group, and sums the neighbours' beliefs divided by `f_k`.
///
/// `f_k = 1 - sum_n p_k[n] (1 - exp(-t d[n]))`, where `p_k[n]` is the belief that the neighbour is in state `n`. So
/// `f_k` is 1 for a neighbour outside the grid, whose beliefs are all 0. `complements` contains `1 - exp(-t d)` for
/// each source.
#[inline(always)]
fn multiply_factors(
    sources: &[Source],
    group: &Group,
    inputs: ChunkInputs<'_>,
    complements: &[Lanes],
    products: GroupProducts<'_>,
) {
    products.ratio_sums.fill([0.0; LANES]);
    for &neighbour in &group.neighbours {
        let mut factor = [1.0; LANES];
        for (source, complement) in sources.iter().zip(complements) {
            let belief = inputs.belief(neighbour, source.state);
            for lane in 0..LANES {
                factor[lane] -= belief[lane] * complement[lane];
            }
        }
        multiply(products.factor, &factor);
        let inverse = divided(1.0, &factor);
        for (sum, source) in products.ratio_sums.iter_mut().zip(sources) {
            add_product(sum, inputs.belief(neighbour, source.state), &inverse);
        }
        products.inverse_factors[neighbour] = inverse;
    }
}

/// Divides weights by their total, so that they become probabilities. Where the total is 0, copies `otherwise`.
#[inline(always)]
fn normalise(weights: &mut [Lanes], otherwise: Option<&[Lanes]>) {
    for lanes in weights.iter_mut() {
        for weight in lanes {
            *weight = weight.max(0.0);
        }
    }
    let total = sum(weights);
    let inverse = divided(1.0, &total);
    for (index, lanes) in weights.iter_mut().enumerate() {
        multiply(lanes, &inverse);
        if let Some(otherwise) = otherwise {
            for lane in 0..LANES {
                if total[lane] <= MIN_TOTAL {
                    lanes[lane] = otherwise[index][lane];
                }
            }
        }
    }
}
