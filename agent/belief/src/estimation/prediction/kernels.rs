//! Transition weights, and the kernels that a prediction reads. The kernels contain only positive weights, and combine
//! neighbours with equal weights into groups.

use emberwatch_model::{Grid, Model};
use ndarray::Array4;

/// Transition weights of eq. 2, from a model or learned.
#[derive(Debug, Clone, Copy)]
pub struct Weights<'a> {
    /// Kernels `w[m, n, a, c]`, shape `[S, S, KH, KW]`. Each zone has one kernel, or one per own state of the cell.
    pub kernels: &'a [Array4<f64>],
    /// Bias `b[m]` of each next state.
    pub bias: &'a [f64],
    /// The zone of each cell, shape `[H, W]`, and the number of zones.
    pub zones: (Option<&'a Grid<u8>>, usize),
    /// The state of all cells outside the grid. If `None`, these cells add no weight.
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

/// The transition weights of a cell in one current state (its *own state*) in which neighbours can influence it.
///
/// Weights are stored as indices into `Layout::slots` (their *slots*), because their values can differ between zones.
#[derive(Debug, Clone)]
pub struct OwnKernel {
    /// The own state. If `None`, the kernel applies to all own states.
    pub own_state: Option<usize>,
    /// The possible next states.
    pub next_states: Vec<usize>,
    /// The slot of each next state's weight without neighbours: its bias plus the centre weight of an own-state kernel.
    pub bias_slots: Vec<usize>,
    pub groups: Vec<Group>,
    /// The slots of the distinct totals `d` that a neighbour's weights can have.
    pub total_slots: Vec<usize>,
    /// Whether the total `d` of some neighbour depends on its state.
    pub totals_differ: bool,
    /// How much the states of all neighbours together can change the weights, as a fraction of the mean total `D`.
    pub influence: f64,
}

/// Neighbours with equal weights.
#[derive(Debug, Clone)]
pub struct Group {
    /// The indices of the neighbours in `Layout::taps`.
    pub neighbours: Vec<usize>,
    pub sources: Vec<Source>,
}

/// A state in which the neighbours of a group have a positive weight.
#[derive(Debug, Clone)]
pub struct Source {
    pub state: usize,
    /// The total `d` of the weights in this state, as an index in [`OwnKernel::total_slots`].
    pub total: usize,
    /// For each positive weight, the index of its next state in [`OwnKernel::next_states`], and its slot.
    pub terms: Vec<(usize, usize)>,
}

/// The transition from an own state in which no neighbour influences the cell.
#[derive(Debug, Clone)]
pub struct FixedTransition {
    pub own_state: usize,
    /// The slot of each next state's probability, for all S states.
    pub probability_slots: Vec<usize>,
}
