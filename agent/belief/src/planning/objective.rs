//! An [`Objective`] says what a path is for; on a belief it becomes [`CellValues`], which planners
//! maximise (the costs `c_1` and `c_2` of paper eqs. 13 and 14, with the sign turned).

use crate::estimation::belief::{Belief, EntropyKind};
use emberwatch_model::grid::{Cell, Grid, Shape};
use emberwatch_model::path::Move;
use emberwatch_model::{Airspace, Pays};
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
    /// On the path.
    value: Grid<f32>,
    coverage_bonus: f32,
    revisits: bool,
    /// In sight of the path, where the sensor sees beyond it.
    in_sight: Option<Grid<f32>>,
    airspace: Airspace,
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

    /// What the cells are worth under a belief, on a grid that is open everywhere with a sensor of the path.
    pub fn values(&self, belief: &Belief) -> CellValues {
        self.values_in(belief, &Airspace::open(belief.shape()))
    }

    /// What the cells are worth under a belief. Entropy counts where it is seen, all else where it pays.
    ///
    /// # Panics
    /// If the airspace is of another grid.
    pub fn values_in(&self, belief: &Belief, airspace: &Airspace) -> CellValues {
        let value = match self.target {
            Target::State(state) => belief.probability(state).to_owned(),
            Target::Entropy => belief.entropy(self.entropy),
            Target::Coverage => Grid::zeros(belief.shape().dim()),
        };
        let values = CellValues {
            revisits: self.revisits,
            ..CellValues::new(value, self.coverage_bonus)
        };
        let counts_in_sight = self.target == Target::Entropy || airspace.pays() == Pays::Seen;
        if counts_in_sight && airspace.radius() > 0 {
            CellValues::in_sight_of(airspace, values.value + self.coverage_bonus)
        } else {
            values.within(airspace, None)
        }
    }
}

impl CellValues {
    /// Values of shape `[H, W]`, finite, and what each distinct cell is worth besides.
    pub fn new(value: Grid<f32>, coverage_bonus: f32) -> Self {
        let (height, width) = value.dim();
        let shape = Shape::new(height, width).expect("invariant: a grid of cells");
        Self {
            airspace: Airspace::open(shape),
            value,
            coverage_bonus,
            revisits: false,
            in_sight: None,
        }
    }

    /// The same where robots fly and see as an airspace has it; `in_sight`: what each distinct cell in sight of the path
    /// is worth beside that, shape `[H, W]`, finite.
    ///
    /// # Panics
    /// If the airspace is of another grid.
    pub fn within(self, airspace: &Airspace, in_sight: Option<Grid<f32>>) -> Self {
        assert_eq!(
            airspace.shape(),
            self.shape(),
            "airspace: expected the grid"
        );
        Self {
            airspace: airspace.clone(),
            in_sight,
            ..self
        }
    }

    /// What each distinct cell that is seen is worth, shape `[H, W]`, finite: those in sight of a path, or on it where the
    /// sensor sees no further.
    ///
    /// # Panics
    /// If the airspace is of another grid.
    pub fn in_sight_of(airspace: &Airspace, value: Grid<f32>) -> Self {
        if airspace.radius() == 0 {
            return Self::new(value, 0.0).within(airspace, None);
        }
        let nothing = Self::new(Grid::zeros(value.dim()), 0.0);
        nothing.within(airspace, Some(value))
    }

    pub fn shape(&self) -> Shape {
        self.airspace.shape()
    }

    pub fn airspace(&self) -> &Airspace {
        &self.airspace
    }

    /// What each distinct cell in sight of the path is worth, where sight counts.
    pub fn in_sight(&self) -> Option<&Grid<f32>> {
        self.in_sight.as_ref()
    }

    /// Value of each cell without the bonus, on the path and in sight of it together, shape `[H, W]`.
    pub fn worth(&self) -> Grid<f32> {
        match &self.in_sight {
            None => self.value.clone(),
            Some(in_sight) => &self.value + in_sight,
        }
    }

    /// Value of each cell without the bonus, shape `[H, W]`.
    pub fn value(&self) -> ArrayView2<'_, f32> {
        self.value.view()
    }

    /// Adds `weight` times a layer of shape `[H, W]`, whose numbers are finite, to the cells' values.
    pub fn add(&mut self, weight: f32, layer: &Grid<f32>) {
        self.value.scaled_add(weight, layer);
    }

    /// Adds `weight` times a layer of shape `[H, W]`, whose numbers are finite, to what each cell that is seen is worth.
    pub fn add_in_sight(&mut self, weight: f32, layer: &Grid<f32>) {
        if self.airspace.radius() == 0 {
            return self.add(weight, layer);
        }
        let zeros = || Grid::zeros(layer.dim());
        self.in_sight
            .get_or_insert_with(zeros)
            .scaled_add(weight, layer);
    }

    /// The same, with nothing left to gain at cells that a teammate visits or sees, by the row-major indices of those
    /// visited, which may be named more than once. Where each visit counts, a teammate's takes nothing away.
    pub fn without(&self, visited: &[usize]) -> Self {
        let mut left = self.clone();
        if !left.revisits {
            let value = left.value.as_slice_mut();
            let value = value.expect("invariant: grids are row-major");
            let taken = visited.iter();
            taken.for_each(|&cell| value[cell] = -left.coverage_bonus);
        }
        if let Some(in_sight) = &mut left.in_sight {
            let in_sight = in_sight.as_slice_mut();
            let in_sight = in_sight.expect("invariant: grids are row-major");
            let seen = self.airspace.see(visited);
            seen.iter().for_each(|it| in_sight[it.cell] = 0.0);
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

    /// Score of the path flown from `start` by [`Airspace::fly`]'s rules.
    pub fn score(&self, start: Cell, moves: &[Move]) -> f32 {
        let shape = self.shape();
        let mut visited = vec![false; shape.n_cells()];
        let mut cell = start;
        let mut score = self.seen_score(start, moves);
        for step in moves {
            cell = self.airspace.after(*step, cell);
            let value = self.value[[cell.row, cell.col]];
            let first = !std::mem::replace(&mut visited[shape.index(cell)], true);
            score += match (first, self.revisits) {
                (true, _) => value + self.coverage_bonus,
                (false, true) => value,
                (false, false) => 0.0,
            };
        }
        score
    }

    /// The part of a path's score that is seen.
    fn seen_score(&self, start: Cell, moves: &[Move]) -> f32 {
        let Some(in_sight) = &self.in_sight else {
            return 0.0;
        };
        let in_sight = in_sight.as_slice();
        let in_sight = in_sight.expect("invariant: grids are row-major");
        let visited = self.airspace.fly(start, moves).visited;
        let seen = self.airspace.see(&visited);
        seen.iter().map(|it| in_sight[it.cell]).sum()
    }
}
