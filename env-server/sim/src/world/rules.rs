//! The rules that all episodes of a server share: the model, the grid, and the settings that determine a world's
//! future.

use super::hidden::Source;
use super::recorded::Recorded;
use super::sensor::Sensor;
use super::starts::{fixed_start, random_starts};
use emberwatch_model::ModelError;
use emberwatch_model::randomness::{Purpose, stream};
use emberwatch_model::settings::Start;
use emberwatch_model::{Airspace, Cell, Dynamics, Model, Shape};
use rand::RngExt;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

#[derive(Debug, Clone)]
pub struct Rules {
    pub shape: Shape,
    pub airspace: Airspace,
    /// Row-major indices of the cells from which random starts are drawn, or `None` for all cells.
    starts: Option<Arc<Vec<usize>>>,
    /// Reward of a distinct visited cell, indexed by the cell's state.
    pub reward: Vec<f64>,
    pub target_state: u8,
    pub n_states: usize,
    pub n_observations: usize,
    /// Number of steps simulated before k = 0.
    pub burn_in: u64,
    /// Episode length in steps. If it is 0, episodes are never truncated.
    pub max_steps: u64,
    pub start: Start,
    /// Number of latest steps, including the current one, whose frames are kept.
    pub history: usize,
    pub n_moves: usize,
    pub n_robots: usize,
    /// Set when the worlds are no longer needed. Running burn-ins then stop at once, and the unfinished worlds must not
    /// be used.
    pub ended: Arc<AtomicBool>,
    pub(super) sensor: Sensor,
    pub(super) source: Source,
}

impl Rules {
    pub fn new(
        model: &Model,
        shape: Shape,
        burn_in: u64,
        max_steps: u64,
        start: Start,
    ) -> Result<Self, ModelError> {
        let airspace = model.airspace(shape)?;
        Ok(Self {
            shape,
            starts: random_starts(&airspace).map(Arc::new),
            airspace,
            reward: model.reward().to_vec(),
            target_state: model.target_state() as u8,
            n_states: model.n_states(),
            n_observations: model.n_observations(),
            burn_in,
            max_steps,
            start,
            history: 0,
            n_moves: 0,
            n_robots: 1,
            ended: Arc::default(),
            sensor: Sensor::new(model),
            source: Source::Simulated(Dynamics::new(model, shape)?),
        })
    }

    pub fn with_recorded(mut self, recorded: Arc<Recorded>) -> Self {
        self.source = Source::Recorded(recorded);
        self
    }

    pub(super) fn truncates(&self, seed: u64, step: u64) -> bool {
        let last = self.source.last_step(seed);
        (self.max_steps > 0 && step >= self.max_steps) || last.is_some_and(|last| step >= last)
    }

    pub(super) fn start_cell(&self, seed: u64, robot: usize) -> Cell {
        fixed_start(self.start, self.shape, robot).unwrap_or_else(|| {
            let mut stream = stream(seed, Purpose::Start, robot as u64);
            let index = match &self.starts {
                None => stream.random_range(0..self.shape.n_cells()),
                Some(starts) => starts[stream.random_range(0..starts.len())],
            };
            self.shape.cell(index)
        })
    }

    pub(super) fn most_seen(&self) -> usize {
        most_seen(self.airspace.radius(), self.n_moves, self.shape.n_cells())
    }
}

/// Returns the maximum number of cells that a robot with a sensor of this radius sees along a path.
pub fn most_seen(radius: usize, n_moves: usize, n_cells: usize) -> usize {
    match radius {
        0 => n_moves,
        radius => {
            let side = 2 * radius + 1;
            (side * (n_moves + side)).min(n_cells)
        }
    }
}
