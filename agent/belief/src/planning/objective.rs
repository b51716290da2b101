//! An [`Objective`] says what a path is for; on a belief it becomes [`CellValues`], which planners
//! maximise (the costs `c_1` and `c_2` of paper eqs. 13 and 14, with the sign turned).

use crate::estimation::belief::{Belief, EntropyKind};
use emberwatch_protocol::grid::{Cell, Grid, Shape};
use emberwatch_protocol::path::Move;
use ndarray::ArrayView2;
use serde::{Deserialize, Serialize};

/// Worth of a distinct cell to beam search beside its probability: just enough that a robot in the
/// middle of nothing goes somewhere else. Without it a clairvoyant robot stands still where nothing
/// burns around it and earns 20.2 +- 8.1 instead of 43.6 +- 6.5 per step; with the filter it makes no
/// difference (36.4 and 36.6; 8 training worlds, burn-in 25,000, 1,500 steps).
pub const BEAM_BONUS: f32 = 0.02;

/// A belief that paths may be planned on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BasisKind {
    /// The predictor `u_{k+1}` of where the world stands when the path is observed, as in the authors' code.
    Predictor,
    /// The estimate `p_k` of where it stands (the paper as printed, eqs. 13 to 15).
    Estimate,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Target {
    /// The probability of one state: the paper's actions `a_k < S`.
    State(usize),
    /// The entropy of the belief: the paper's action `a_k = S`.
    Entropy,
    /// Nothing but the visit itself.
    Coverage,
}

impl Target {
    /// In a word, for observers; `states`: names of the belief's states.
    ///
    /// # Panics
    /// If a state has no name.
    pub fn label(self, states: &[String]) -> String {
        match self {
            Self::State(state) => states[state].clone(),
            Self::Entropy => "entropy".into(),
            Self::Coverage => "coverage".into(),
        }
    }
}

/// What a planner maximises: the sum over a path's cells of the target, plus a bonus per cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Objective {
    pub target: Target,
    pub coverage_bonus: f32,
    pub entropy: EntropyKind,
    /// Whether a cell's value counts at every visit (eq. 15 as printed), not only at the first (the
    /// authors' code, and the reward).
    pub revisits: bool,
}

/// What each cell of the grid is worth to a planner. All numbers are finite.
#[derive(Debug, Clone, PartialEq)]
pub struct CellValues {
    value: Grid<f32>,
    coverage_bonus: f32,
    revisits: bool,
    shape: Shape,
}

impl Objective {
    /// Value of distinct cells alone; for [`Target::Coverage`], their number.
    pub fn new(target: Target) -> Self {
        let coverage_bonus = if target == Target::Coverage { 1.0 } else { 0.0 };
        Self {
            target,
            coverage_bonus,
            entropy: EntropyKind::Sum,
            revisits: false,
        }
    }

    /// The authors' code: 1 per distinct cell on top of the target, and the mean of the entropy terms.
    pub fn paper(target: Target) -> Self {
        Self {
            target,
            coverage_bonus: 1.0,
            entropy: EntropyKind::Mean,
            revisits: false,
        }
    }

    /// What the cells are worth under a belief.
    pub fn values(&self, belief: &Belief) -> CellValues {
        let value = match self.target {
            Target::State(state) => belief.probability(state).to_owned(),
            Target::Entropy => belief.entropy(self.entropy),
            Target::Coverage => Grid::zeros(belief.shape().dim()),
        };
        CellValues {
            value,
            coverage_bonus: self.coverage_bonus,
            revisits: self.revisits,
            shape: belief.shape(),
        }
    }
}

impl CellValues {
    /// Values of shape `[H, W]`, finite, and what each distinct cell is worth besides.
    pub fn new(value: Grid<f32>, coverage_bonus: f32) -> Self {
        let (height, width) = value.dim();
        Self {
            shape: Shape::new(height, width).expect("invariant: a grid of cells"),
            value,
            coverage_bonus,
            revisits: false,
        }
    }

    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Value of each cell without the bonus, shape `[H, W]`.
    pub fn value(&self) -> ArrayView2<'_, f32> {
        self.value.view()
    }

    /// Adds `weight` times a layer of shape `[H, W]`, whose numbers are finite, to the cells' values.
    pub fn add(&mut self, weight: f32, layer: &Grid<f32>) {
        self.value.scaled_add(weight, layer);
    }

    /// The same, with nothing left to gain at some cells, by their row-major indices, which may be named more than
    /// once. Where each visit counts, a teammate's takes nothing away.
    pub fn without(&self, taken: impl Iterator<Item = usize>) -> Self {
        let mut left = self.clone();
        if !left.revisits {
            let value = left.value.as_slice_mut();
            let value = value.expect("invariant: grids are row-major");
            taken.for_each(|cell| value[cell] = -left.coverage_bonus);
        }
        left
    }

    pub fn coverage_bonus(&self) -> f32 {
        self.coverage_bonus
    }

    /// Whether a cell's value counts at every visit.
    pub fn revisits(&self) -> bool {
        self.revisits
    }

    /// Score of the path flown from `start` by [`emberwatch_protocol::path::fly`]'s rules.
    pub fn score(&self, start: Cell, moves: &[Move]) -> f32 {
        let mut seen = vec![false; self.shape.n_cells()];
        let mut cell = start;
        let mut score = 0.0;
        for step in moves {
            cell = step.apply(cell, self.shape);
            let value = self.value[[cell.row, cell.col]];
            let first = !std::mem::replace(&mut seen[self.shape.index(cell)], true);
            score += match (first, self.revisits) {
                (true, _) => value + self.coverage_bonus,
                (false, true) => value,
                (false, false) => 0.0,
            };
        }
        score
    }
}
