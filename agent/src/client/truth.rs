//! The hidden states of a batch of worlds. They are used for evaluation and by oracles, never for learning.

use anyhow::{Context, Result, bail};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::message::TruthHeader;
use emberwatch_protocol::observer::{Observer, Sample};
use emberwatch_protocol::{Grid, Shape};
use std::ops::Range;
use std::time::{Duration, Instant};

const TIMEOUT: Duration = Duration::from_secs(5);

/// A reader of the channel `truth` that keeps pace with a client that acts.
pub struct TruthFeed {
    observer: Observer<TruthHeader>,
    shape: Shape,
}

impl TruthFeed {
    pub fn open(instance: &Instance, shape: Shape) -> Result<Self> {
        Ok(Self {
            observer: Observer::truth(instance)?,
            shape,
        })
    }

    /// Returns the states of consecutive worlds at a step of the episodes with these seeds.
    ///
    /// Samples of other worlds, steps and episodes are skipped for good, so each step must be read once, in order.
    pub fn states(&self, worlds: Range<u32>, seeds: &[u64], step: u64) -> Result<Vec<Grid<u8>>> {
        let mut states: Vec<Option<Grid<u8>>> = vec![None; worlds.len()];
        let deadline = Instant::now() + TIMEOUT;
        while let Some(missing) = states.iter().position(Option::is_none) {
            let left = deadline.saturating_duration_since(Instant::now());
            let sample = match left {
                Duration::ZERO => None,
                left => self.observer.receive(left)?,
            };
            let Some(sample) = sample else {
                let world = worlds.start + missing as u32;
                bail!("truth of world {world} at step {step}: not published within {TIMEOUT:?}");
            };
            let Sample { header, payload } = sample;
            let wanted = |index: usize| header.step == step && header.seed == seeds[index];
            if let Some(index) = header
                .world
                .checked_sub(worlds.start)
                .map(|index| index as usize)
                && index < states.len()
                && wanted(index)
            {
                states[index] = Some(self.grid(header.world, payload)?);
            }
        }
        Ok(states.into_iter().flatten().collect())
    }

    fn grid(&self, world: u32, bytes: Vec<u8>) -> Result<Grid<u8>> {
        let (expected, got) = (self.shape.n_cells(), bytes.len());
        let grid = Grid::from_shape_vec(self.shape.dim(), bytes);
        grid.with_context(|| {
            format!("truth of world {world}: expected {expected} bytes, got {got}")
        })
    }
}
