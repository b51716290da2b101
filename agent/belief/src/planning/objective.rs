//! Objectives, the goals of planned paths. An [`Objective`] and a belief determine [`CellValues`], which planners
//! maximise. These values are the costs `c_1` and `c_2` of paper eqs. 13 and 14 with the opposite sign.

use crate::estimation::belief::Belief;
use emberwatch_model::Airspace;
use emberwatch_model::grid::{Cell, Grid, Shape};
use emberwatch_model::path::Move;
use ndarray::ArrayView2;

/// Bonus of beam search for each distinct cell, in addition to its probability.
///
/// The bonus is just large enough to make a robot leave a region without value. Without it, a clairvoyant robot stays
/// where nothing burns, and earns a reward of 20.2 +- 8.1 instead of 43.6 +- 6.5 per step. With the filter, the bonus
/// makes no difference (36.4 and 36.6). All rewards were measured on 8 training worlds with burn-in 25,000 over 1,500
/// steps.
pub const BEAM_BONUS: f32 = 0.02;

/// The quantity that a path collects at its cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Target {
    /// The probability of one state, which is an action `a_k < S` of the paper.
    State(usize),
    /// The entropy of the belief, which is the action `a_k = S` of the paper.
    Entropy,
    /// Nothing but the bonus per distinct cell, regardless of the belief.
    Coverage,
}

impl Target {
    /// Returns a one-word label for display. `states` are the names of the belief's states.
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

/// The quantity that a planner maximises: the sum of the target over the path's cells, plus a bonus per cell.
/// A cell counts once, as in the authors' code and in the reward; in eq. 15, each visit counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Objective {
    pub target: Target,
    pub coverage_bonus: f32,
}

/// The value that a planner assigns to each cell of the grid. All values are finite.
#[derive(Debug, Clone, PartialEq)]
pub struct CellValues {
    value: Grid<f32>,
    coverage_bonus: f32,
    /// The value of each cell in sight of the path. `None` if only cells on the path count, or if the sensor sees no
    /// other cells.
    in_sight: Option<Grid<f32>>,
    airspace: Airspace,
}

impl Objective {
    /// Creates an objective that counts each distinct cell once and has no bonus. For [`Target::Coverage`], the bonus
    /// is 1, so the score is the number of distinct cells.
    pub fn new(target: Target) -> Self {
        let coverage_bonus = if target == Target::Coverage { 1.0 } else { 0.0 };
        Self {
            target,
            coverage_bonus,
        }
    }

    /// Creates the objective of the authors' code, with a bonus of 1 per distinct cell.
    pub fn paper(target: Target) -> Self {
        Self {
            target,
            coverage_bonus: 1.0,
        }
    }

    /// Computes the cells' values under a belief, without no-fly cells and with a sensor that sees only the path.
    pub fn values(&self, belief: &Belief) -> CellValues {
        self.values_in(belief, &Airspace::open(belief.shape()))
    }

    /// Computes the cells' values under a belief. Entropy counts in all observed cells. The other targets count in
    /// visited cells, as the reward does.
    ///
    /// # Panics
    /// If the airspace has a different grid.
    pub fn values_in(&self, belief: &Belief, airspace: &Airspace) -> CellValues {
        let value = match self.target {
            Target::State(state) => belief.probability(state).to_owned(),
            Target::Entropy => belief.mean_entropy(),
            Target::Coverage => Grid::zeros(belief.shape().dim()),
        };
        let values = CellValues::new(value, self.coverage_bonus);
        if self.target == Target::Entropy && airspace.radius() > 0 {
            CellValues::in_sight_of(airspace, values.value + self.coverage_bonus)
        } else {
            values.within(airspace, None)
        }
    }
}

impl CellValues {
    /// Creates values from a grid of finite numbers, shape `[H, W]`, and a bonus for each distinct cell.
    pub fn new(value: Grid<f32>, coverage_bonus: f32) -> Self {
        let (height, width) = value.dim();
        let shape = Shape::new(height, width).expect("invariant: a grid of cells");
        Self {
            airspace: Airspace::open(shape),
            value,
            coverage_bonus,
            in_sight: None,
        }
    }

    /// Applies the no-fly cells and the sensor of an airspace. `in_sight` contains the finite value that each cell adds
    /// once if it is in sight of the path, shape `[H, W]`.
    ///
    /// # Panics
    /// If the airspace has a different grid.
    pub fn within(self, airspace: &Airspace, in_sight: Option<Grid<f32>>) -> Self {
        assert_eq!(
            airspace.shape(),
            self.shape(),
            "airspace: expected the grid of the values"
        );
        Self {
            airspace: airspace.clone(),
            in_sight,
            ..self
        }
    }

    /// Creates values that count once for each observed cell, from a grid of finite numbers, shape `[H, W]`. If the
    /// sensor sees only the path, the observed cells are those on the path.
    ///
    /// # Panics
    /// If the airspace has a different grid.
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

    /// Returns the value of each distinct cell in sight of the path, if cells in sight count.
    pub fn in_sight(&self) -> Option<&Grid<f32>> {
        self.in_sight.as_ref()
    }

    /// Returns each cell's value on the path plus its value in sight of the path, without the bonus, shape `[H, W]`.
    pub fn worth(&self) -> Grid<f32> {
        match &self.in_sight {
            None => self.value.clone(),
            Some(in_sight) => &self.value + in_sight,
        }
    }

    /// Returns the value of each cell on the path without the bonus, shape `[H, W]`.
    pub fn value(&self) -> ArrayView2<'_, f32> {
        self.value.view()
    }

    /// Adds `weight` times a layer of finite numbers, shape `[H, W]`, to the values of cells on the path.
    pub fn add(&mut self, weight: f32, layer: &Grid<f32>) {
        self.value.scaled_add(weight, layer);
    }

    /// Adds `weight` times a layer of finite numbers, shape `[H, W]`, to the values of observed cells.
    pub fn add_in_sight(&mut self, weight: f32, layer: &Grid<f32>) {
        if self.airspace.radius() == 0 {
            return self.add(weight, layer);
        }
        let zeros = || Grid::zeros(layer.dim());
        self.in_sight
            .get_or_insert_with(zeros)
            .scaled_add(weight, layer);
    }

    /// Returns the values that remain after a teammate's path: cells that the teammate visits or sees are worth
    /// nothing.
    ///
    /// `visited` lists the row-major indices of the teammate's cells, and may repeat them.
    pub fn without(&self, visited: &[usize]) -> Self {
        let mut left = self.clone();
        let value = left.value.as_slice_mut();
        let value = value.expect("invariant: grids are row-major");
        let taken = visited.iter();
        taken.for_each(|&cell| value[cell] = -left.coverage_bonus);
        if let Some(in_sight) = &mut left.in_sight {
            let in_sight = in_sight.as_slice_mut();
            let in_sight = in_sight.expect("invariant: grids are row-major");
            let seen = self.airspace.see(visited);
            seen.iter().for_each(|&cell| in_sight[cell] = 0.0);
        }
        left
    }

    pub fn coverage_bonus(&self) -> f32 {
        self.coverage_bonus
    }

    /// Computes the score of the path from `start`, flown by the rules of [`Airspace::fly`].
    pub fn score(&self, start: Cell, moves: &[Move]) -> f32 {
        let shape = self.shape();
        let mut visited = vec![false; shape.n_cells()];
        let mut cell = start;
        let mut score = self.seen_score(start, moves);
        for step in moves {
            cell = self.airspace.after(*step, cell);
            let value = self.value[[cell.row, cell.col]];
            if !std::mem::replace(&mut visited[shape.index(cell)], true) {
                score += value + self.coverage_bonus;
            }
        }
        score
    }

    fn seen_score(&self, start: Cell, moves: &[Move]) -> f32 {
        let Some(in_sight) = &self.in_sight else {
            return 0.0;
        };
        let in_sight = in_sight.as_slice().expect("invariant: grids are row-major");
        let visited = self.airspace.fly(start, moves).visited;
        let seen = self.airspace.see(&visited);
        seen.iter().map(|&cell| in_sight[cell]).sum()
    }
}
