//! The predictors of some cells side by side, from the beliefs of their neighbours.

use super::acts::{Act, Group, Layout, Source};
use super::lanes::{
    LANES, Lanes, add, add_product, divided, exponential, lanes_from, multiply, sum,
};

/// Nodes and weights of the Gauss-Laguerre quadrature.
const NODES: [(f32, f32); 2] = [(0.585_786_46, 0.853_553_4), (3.414_213_7, 0.146_446_6)];

/// One node at zero: for weights whose total is certain, which the mean field predicts exactly.
const MEAN_FIELD: [(f32, f32); 1] = [(0.0, 1.0)];

/// Cells have no smaller total of weights.
const LEAST_TOTAL: f32 = 1e-30;

/// What is computed for the cells of a chunk.
#[derive(Debug, Clone)]
pub struct Work {
    /// Of each act the distribution of the next state, by the act's next states.
    pub distributions: Vec<Vec<Lanes>>,
    /// Of each neighbour the same while that neighbour is held, in the act that has cavities.
    pub held: Vec<Vec<Lanes>>,
    /// Of each source the sum over its group's neighbours: of their belief, and of that divided by their factor.
    beliefs: Vec<Lanes>,
    ratios: Vec<Lanes>,
    /// What each next state weighs at one node.
    numbers: Vec<Lanes>,
    /// `exp(-t d)` of each total.
    exponentials: Vec<Lanes>,
    /// Of each source of a group one without that.
    lost: Vec<Lanes>,
    /// Of each neighbour one divided by its factor.
    inverses: Vec<Lanes>,
}

/// Where the neighbours of a chunk's cells are read.
#[derive(Clone, Copy)]
pub struct Reading<'a> {
    pub slots: &'a [Lanes],
    /// The beliefs of neighbours, states one after the other.
    pub planes: &'a [f32],
    /// Numbers of a plane.
    pub length: usize,
    /// Of each neighbour the place in `planes` of its first state.
    pub places: &'a [usize],
}

impl Reading<'_> {
    #[inline(always)]
    fn belief(&self, neighbour: usize, state: usize) -> &Lanes {
        lanes_from(self.planes, self.places[neighbour] + state * self.length)
    }
}

impl Work {
    pub fn new(layout: &Layout, n_states: usize) -> Self {
        let acts = layout.acts.iter();
        let n_sources = |act: &Act| act.groups.iter().map(|group| group.sources.len()).sum();
        let n_sources: usize = acts.clone().map(n_sources).max().unwrap_or(0);
        let n_totals = acts.clone().map(|act| act.totals.len()).max().unwrap_or(0);
        let zeros = |n: usize| vec![[0.0; LANES]; n];
        Self {
            distributions: acts.map(|act| zeros(act.next.len())).collect(),
            held: vec![zeros(n_states); layout.taps.len()],
            beliefs: zeros(n_sources),
            ratios: zeros(n_sources),
            numbers: zeros(n_states),
            exponentials: zeros(n_totals),
            lost: zeros(n_states),
            inverses: zeros(layout.taps.len()),
        }
    }

    /// Computes the distribution of the next state in one act, and, if `is_held`, what it is while each neighbour is held.
    #[inline(always)] // As are its parts, to be compiled for the vectors of this processor.
    pub fn predict(
        &mut self,
        index: usize,
        act: &Act,
        is_second_order: bool,
        is_held: bool,
        reading: Reading<'_>,
    ) {
        let n = act.next.len();
        let is_exact = !(is_second_order && act.totals_differ);
        self.add_beliefs(act, reading);
        if is_exact && !is_held {
            self.weigh(act, reading.slots, false);
            self.distributions[index].copy_from_slice(&self.numbers[..n]);
        } else {
            let mean = self.mean_total(act, reading.slots);
            self.distributions[index].fill([0.0; LANES]);
            if is_held {
                for held in &mut self.held {
                    held[..n].fill([0.0; LANES]);
                }
            }
            let nodes: &[(f32, f32)] = if is_exact { &MEAN_FIELD } else { &NODES };
            for node in nodes {
                self.add_node(index, act, *node, &mean, is_held, reading);
            }
        }
        normalise(&mut self.distributions[index], None);
        if is_held {
            let all = &self.distributions[index];
            for held in &mut self.held {
                normalise(&mut held[..n], Some(all));
            }
        }
    }

    #[inline(always)]
    fn add_beliefs(&mut self, act: &Act, reading: Reading<'_>) {
        let mut at = 0;
        for group in &act.groups {
            for source in &group.sources {
                let mut sum = [0.0; LANES];
                for &neighbour in &group.neighbours {
                    add(&mut sum, reading.belief(neighbour, source.state));
                }
                self.beliefs[at] = sum;
                at += 1;
            }
        }
    }

    /// The mean of eq. 3's denominator.
    #[inline(always)]
    fn mean_total(&self, act: &Act, slots: &[Lanes]) -> Lanes {
        let mut mean = [0.0; LANES];
        for slot in &act.base {
            add(&mut mean, &slots[*slot]);
        }
        let sources = act.groups.iter().flat_map(|group| &group.sources);
        for (source, belief) in sources.zip(&self.beliefs) {
            add_product(&mut mean, &slots[act.totals[source.total]], belief);
        }
        mean
    }

    /// Eq. 2 from sums over neighbours: of their beliefs, or, `at_node`, of their ratios times the exponentials.
    #[inline(always)]
    fn weigh(&mut self, act: &Act, slots: &[Lanes], at_node: bool) {
        for (number, slot) in self.numbers.iter_mut().zip(&act.base) {
            *number = slots[*slot];
        }
        let sources = act.groups.iter().flat_map(|group| &group.sources);
        let sums = if at_node { &self.ratios } else { &self.beliefs };
        for (source, from) in sources.zip(sums) {
            let mut from = *from;
            if at_node {
                multiply(&mut from, &self.exponentials[source.total]);
            }
            for (next, slot) in &source.terms {
                add_product(&mut self.numbers[*next], &slots[*slot], &from);
            }
        }
    }

    /// Adds to the weights what they are at one node, `t = node / mean`.
    #[inline(always)]
    fn add_node(
        &mut self,
        index: usize,
        act: &Act,
        (node, weight): (f32, f32),
        mean: &Lanes,
        is_held: bool,
        reading: Reading<'_>,
    ) {
        let slots = reading.slots;
        let t = divided(node, mean);
        for (to, slot) in self.exponentials.iter_mut().zip(&act.totals) {
            *to = exponential(&t, &slots[*slot]);
        }
        let mut base = [0.0; LANES];
        for slot in &act.base {
            add(&mut base, &slots[*slot]);
        }
        // exp(node - t b), times the factors of neighbours.
        let mut factor = exponential(&t, &base);
        multiply(&mut factor, &[weight * node.exp(); LANES]);
        let mut at = 0;
        for group in &act.groups {
            let n_sources = group.sources.len();
            for (lost, source) in self.lost.iter_mut().zip(&group.sources) {
                let exponential = &self.exponentials[source.total];
                for lane in 0..LANES {
                    lost[lane] = 1.0 - exponential[lane];
                }
            }
            let lost = &self.lost[..n_sources];
            let to = ReadTo {
                factor: &mut factor,
                inverses: &mut self.inverses,
                ratios: &mut self.ratios[at..at + n_sources],
            };
            at += n_sources;
            // With a constant number of sources the sums stay in registers.
            match n_sources {
                1 => read_few::<1>(group, reading, lost, to),
                2 => read_few::<2>(group, reading, lost, to),
                3 => read_few::<3>(group, reading, lost, to),
                _ => read(&group.sources, group, reading, lost, to),
            }
        }
        self.weigh(act, slots, true);
        for (to, number) in self.distributions[index].iter_mut().zip(&self.numbers) {
            add_product(to, number, &factor);
        }
        if is_held {
            for group in &act.groups {
                self.hold(act, group, &factor, reading);
            }
        }
    }

    /// Adds to what the cells weigh while a neighbour of a group is held in the act's own state: all without the
    /// neighbour's belief, and with its weights in that state.
    #[inline(always)]
    fn hold(&mut self, act: &Act, group: &Group, factor: &Lanes, reading: Reading<'_>) {
        let own = group
            .sources
            .iter()
            .find(|source| Some(source.state) == act.own);
        for &neighbour in &group.neighbours {
            let inverse = &self.inverses[neighbour];
            let mut others = *factor;
            multiply(&mut others, inverse);
            let held = &mut self.held[neighbour];
            if let Some(own) = own {
                multiply(&mut others, &self.exponentials[own.total]);
                for (next, slot) in &own.terms {
                    add_product(&mut held[*next], &reading.slots[*slot], &others);
                }
            }
            for (to, number) in held.iter_mut().zip(&self.numbers[..act.next.len()]) {
                add_product(to, number, &others);
            }
            multiply(&mut others, inverse);
            for source in &group.sources {
                let mut left_out = self.exponentials[source.total];
                multiply(&mut left_out, reading.belief(neighbour, source.state));
                multiply(&mut left_out, &others);
                multiply(&mut left_out, &[-1.0; LANES]);
                for (next, slot) in &source.terms {
                    add_product(&mut held[*next], &reading.slots[*slot], &left_out);
                }
            }
        }
    }
}

/// What is read of a group's neighbours.
struct ReadTo<'a> {
    factor: &'a mut Lanes,
    inverses: &'a mut [Lanes],
    ratios: &'a mut [Lanes],
}

/// [`read`] of a group with a few sources.
#[inline(always)]
fn read_few<const N: usize>(group: &Group, reading: Reading<'_>, lost: &[Lanes], to: ReadTo<'_>) {
    let (mut ratios, mut factor) = ([[0.0; LANES]; N], *to.factor);
    let mut few = [[0.0; LANES]; N];
    few.copy_from_slice(lost);
    let local = ReadTo {
        factor: &mut factor,
        inverses: to.inverses,
        ratios: &mut ratios,
    };
    read(&group.sources[..N], group, reading, &few, local);
    *to.factor = factor;
    to.ratios.copy_from_slice(&ratios);
}

/// Multiplies a factor by those of a group's neighbours, and adds up the neighbours' beliefs, each divided by its factor.
///
/// A neighbour's factor is the mean of `exp(-t d)` over what it can be, and one beyond the edge. `lost` is one without
/// `exp(-t d)`, of each source.
#[inline(always)]
fn read(sources: &[Source], group: &Group, reading: Reading<'_>, lost: &[Lanes], to: ReadTo<'_>) {
    to.ratios.fill([0.0; LANES]);
    for &neighbour in &group.neighbours {
        let mut own = [1.0; LANES];
        for (source, lost) in sources.iter().zip(lost) {
            let belief = reading.belief(neighbour, source.state);
            for lane in 0..LANES {
                own[lane] -= belief[lane] * lost[lane];
            }
        }
        multiply(to.factor, &own);
        let inverse = divided(1.0, &own);
        for (ratio, source) in to.ratios.iter_mut().zip(sources) {
            add_product(ratio, reading.belief(neighbour, source.state), &inverse);
        }
        to.inverses[neighbour] = inverse;
    }
}

/// Divides weights by their total. Where they have none, they are those of `instead`.
#[inline(always)]
fn normalise(weights: &mut [Lanes], instead: Option<&[Lanes]>) {
    for lanes in weights.iter_mut() {
        for weight in lanes {
            *weight = weight.max(0.0);
        }
    }
    let total = sum(weights);
    let inverse = divided(1.0, &total);
    for (index, lanes) in weights.iter_mut().enumerate() {
        multiply(lanes, &inverse);
        if let Some(instead) = instead {
            for lane in 0..LANES {
                if total[lane] <= LEAST_TOTAL {
                    lanes[lane] = instead[index][lane];
                }
            }
        }
    }
}
