//! What all episodes of a server share: the model, the grid, and the settings that decide a world's future.

use super::hidden::Source;
use super::recorded::Recorded;
use super::sensor::Sensor;
use emberwatch_protocol::model::ModelError;
use emberwatch_protocol::randomness::{Purpose, stream};
use emberwatch_protocol::task::Start;
use emberwatch_protocol::{Airspace, Cell, Dynamics, Model, Shape};
use rand::RngExt;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// What all episodes of a server share.
#[derive(Debug, Clone)]
pub struct Rules {
    pub shape: Shape,
    pub airspace: Airspace,
    /// Cells where random starts may be; `None`: all.
    starts: Option<Arc<Vec<usize>>>,
    /// Reward for each distinct cell that pays, by state.
    pub reward: Vec<f64>,
    /// The state that pays most.
    pub target_state: u8,
    /// Number of states S.
    pub n_states: usize,
    /// Number of observations O.
    pub n_observations: usize,
    /// Steps simulated before k = 0.
    pub burn_in: u64,
    /// Episode length; 0: never truncated.
    pub max_steps: u64,
    pub start: Start,
    /// Steps whose frames are kept.
    pub history: usize,
    /// Moves in a path.
    pub n_moves: usize,
    /// Robots of a world.
    pub n_robots: usize,
    /// Set when nobody wants the worlds any more: burn-ins that still run end at once, and are not to be used.
    pub ended: Arc<AtomicBool>,
    pub(super) sensor: Sensor,
    pub(super) source: Source,
}

impl Rules {
    /// The rules under a model, for one robot; `history` and `n_moves` are 0.
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
            starts: airspace.starts().map(Arc::new),
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

    /// The same, of worlds whose hidden states were recorded.
    pub fn with_recorded(mut self, recorded: Arc<Recorded>) -> Self {
        self.source = Source::Recorded(recorded);
        self
    }

    /// Whether the episode of a seed is truncated at a step.
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

    /// Most cells that a robot sees in a step.
    pub(super) fn most_seen(&self) -> usize {
        match self.airspace.radius() {
            0 => self.n_moves,
            radius => {
                let side = 2 * radius + 1;
                (side * (self.n_moves + side)).min(self.shape.n_cells())
            }
        }
    }
}

/// Where a robot starts, unless that is random.
fn fixed_start(start: Start, shape: Shape, robot: usize) -> Option<Cell> {
    match start {
        Start::Corner => Some(corner_or_side(shape, robot)),
        Start::Centre => Some(shape.centre()),
        Start::Random => None,
        Start::At(cell) => Some(cell),
    }
}

/// Checks that so many robots can start in an airspace and leave their start.
///
/// # Errors
/// What was expected of the start, and what was got.
pub fn check_start(start: Start, airspace: &Airspace, n_robots: usize) -> Result<(), [String; 2]> {
    if airspace.starts().is_some_and(|starts| starts.is_empty()) {
        let got = "a no-fly map that leaves none".into();
        return Err(["a cell that robots can leave".into(), got]);
    }
    let places = (0..n_robots).filter_map(|robot| fixed_start(start, airspace.shape(), robot));
    for cell in places.filter(|_| !airspace.is_open()) {
        if !airspace.is_free(cell) {
            let got = format!("{cell}, a no-fly cell");
            return Err(["a cell where robots may be".into(), got]);
        }
        if !airspace.has_way_out(cell) {
            let got = format!("{cell}, which no-fly cells cut off");
            return Err(["a cell that robots can leave".into(), got]);
        }
    }
    Ok(())
}

/// A place at the edge, another one for each of eight robots.
fn corner_or_side(shape: Shape, robot: usize) -> Cell {
    let (bottom, right) = (shape.height() - 1, shape.width() - 1);
    let places = [
        (0, 0),
        (bottom, right),
        (0, right),
        (bottom, 0),
        (0, right / 2),
        (bottom, right / 2),
        (bottom / 2, 0),
        (bottom / 2, right),
    ];
    let (row, col) = places[robot % places.len()];
    Cell { row, col }
}
