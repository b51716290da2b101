//! Updates of the filter's parameters from the replay buffer.
//!
//! Each update learns from one window per stream. A stream reads the buffer's blocks in random order, and carries its
//! belief from window to window. At the end of a block, this belief is stored in the track's next block. So every
//! window starts from a belief that depends on the earlier frames, but gradients reach back only to the start of the
//! window.

use crate::gradient::adam::Adam;
use crate::replay::{Block, BlockReplay};
use anyhow::{Result, anyhow};
use emberwatch_acting::config::LearningConfig;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};
use emberwatch_gradient::{Outcome, Recursion};
use emberwatch_model::Shape;
use emberwatch_model::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use rayon::prelude::*;

/// Number of groups of streams. Each group has its own buffers, so more threads than groups are useless. Groups and the
/// order of summation do not depend on the number of threads.
const N_PARTS: usize = 8;

/// Weight, per cell, of the prior that the state with the highest reward is observed almost surely.
const ANCHOR: f64 = 0.001;

/// The parameters, and everything else that a later update depends on, except the replay buffer.
#[derive(Debug, Clone)]
pub struct Optimiser {
    parameters: Parameters,
    pub adam: Adam,
    config: LearningConfig,
    seed: u64,
    pub shape: Shape,
    streams: Vec<Stream>,
    /// Blocks that remain in this lap. A lap is one pass through all blocks in random order.
    lap: Vec<u64>,
    n_laps: u64,
    recursions: Vec<Recursion>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Update {
    pub number: u64,
    /// Negative mean log-likelihood per visited cell, before the update.
    pub loss: f64,
    pub rate: f64,
}

#[derive(Debug, Clone, PartialEq)]
struct Stream {
    block: Option<u64>,
    n_done: usize,
    belief: Vec<f32>,
    end: Vec<f32>,
}

impl Optimiser {
    /// Creates an optimiser before the first update. The streams have no block yet.
    pub fn new(parameters: Parameters, shape: Shape, config: LearningConfig, seed: u64) -> Self {
        let tables = parameters.tables();
        let numbers = vec![0.0; parameters.dimensions.n_states * shape.n_cells()];
        let stream = Stream {
            block: None,
            n_done: 0,
            belief: numbers.clone(),
            end: numbers,
        };
        Self {
            adam: Adam::new(parameters.dimensions),
            parameters,
            config,
            seed,
            shape,
            streams: vec![stream; config.streams],
            lap: Vec::new(),
            n_laps: 0,
            recursions: vec![Recursion::new(tables, shape, config.window); N_PARTS],
        }
    }

    /// Continues from parameters and moments. Orders of blocks differ from those before.
    pub fn resume(&mut self, parameters: Parameters, adam: Adam) {
        self.n_laps = adam.n_steps;
        (self.parameters, self.adam) = (parameters, adam);
    }

    pub fn config(&self) -> &LearningConfig {
        &self.config
    }

    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    pub fn dimensions(&self) -> Dimensions {
        self.parameters.dimensions
    }

    /// Makes one update. Returns `None` if there are fewer blocks than streams, or no cell is observed in the windows.
    /// `sure` is the state whose observation is almost certain, see `add_anchor`.
    ///
    /// # Errors
    /// If a value is not finite. The parameters then remain unchanged.
    pub fn update(
        &mut self,
        replay: &mut BlockReplay,
        sure: Option<usize>,
    ) -> Result<Option<Update>> {
        if replay.n_blocks() < self.streams.len() {
            return Ok(None);
        }
        if let Some(tensor) = self.parameters.not_finite() {
            return Err(self.wrong(tensor, "a NaN or infinite parameter"));
        }
        self.place_streams(replay);
        let outcomes = self.run_windows(replay);
        let (log_likelihood, n_seen, mut gradient) = add_up(&outcomes, self.dimensions());
        // Checked before `move_streams`, which would store a belief with such values in the replay buffer.
        if !log_likelihood.is_finite() {
            return Err(self.wrong("loss", "a NaN or infinite sum"));
        }
        self.move_streams(replay);
        if n_seen == 0 {
            return Ok(None);
        }
        gradient
            .iter_mut()
            .flatten()
            .for_each(|slope| *slope /= n_seen as f64);
        if let Some(state) = sure {
            self.add_anchor(state, &mut gradient[1]);
        }
        let loss = -log_likelihood / n_seen as f64;
        self.step(loss, &gradient).map(Some)
    }

    fn place_streams(&mut self, replay: &BlockReplay) {
        for index in 0..self.streams.len() {
            let stream = &self.streams[index];
            let block = stream.block.and_then(|number| replay.block(number));
            if block.is_none_or(|block| stream.n_done >= self.n_windows(block)) {
                let (number, block) = self.next_block(replay);
                let stream = &mut self.streams[index];
                (stream.block, stream.n_done) = (Some(number), 0);
                if let Some(start) = &block.start {
                    stream.belief.clone_from(start);
                }
            }
        }
    }

    fn n_windows(&self, block: &Block) -> usize {
        block.frames.len().div_ceil(self.config.window)
    }

    fn next_block<'a>(&mut self, replay: &'a BlockReplay) -> (u64, &'a Block) {
        loop {
            match self.lap.pop() {
                Some(number) => {
                    if let Some(block) = replay.block(number) {
                        return (number, block);
                    }
                }
                None => {
                    self.lap = replay.blocks().collect();
                    shuffle(&mut self.lap, self.seed, self.n_laps);
                    self.n_laps += 1;
                }
            }
        }
    }

    fn run_windows(&mut self, replay: &BlockReplay) -> Vec<Outcome> {
        let tables = self.parameters.tables();
        let length = self.config.window;
        let part = self.streams.len().div_ceil(N_PARTS);
        let parts = self.streams.par_chunks_mut(part).zip(&mut self.recursions);
        let outcomes = parts.flat_map_iter(|(streams, recursion)| {
            recursion.set(&tables);
            streams.iter_mut().filter_map(move |stream| {
                let block = replay.block(stream.block?)?;
                let first = stream.n_done * length;
                let is_first = block.start.is_none() && first == 0;
                let start = (!is_first).then_some(&*stream.belief);
                let end = block.frames.len().min(first + length);
                Some(recursion.run(start, &block.frames[first..end], &mut stream.end))
            })
        });
        outcomes.collect()
    }

    fn move_streams(&mut self, replay: &mut BlockReplay) {
        let length = self.config.window;
        for stream in &mut self.streams {
            std::mem::swap(&mut stream.belief, &mut stream.end);
            stream.n_done += 1;
            if let Some(number) = stream.block
                && let Some(block) = replay.block(number)
                && stream.n_done * length >= block.frames.len()
            {
                replay.hand_on(number, &stream.belief);
            }
        }
    }

    /// Adds the gradient of the negative log-prior `-ANCHOR * ln P(y | x)`, where y is the most likely observation of
    /// state x. The paper assumes that "there is a state which is observable with negligible uncertainties" (section
    /// III.E, remark).
    fn add_anchor(&self, state: usize, by_likelihood: &mut [f64]) {
        let n_observations = self.dimensions().n_observations;
        let likelihood = self.parameters.likelihood();
        let row = &likelihood[state * n_observations..][..n_observations];
        let shown = (0..n_observations).max_by(|&a, &b| row[a].total_cmp(&row[b]));
        if let Some(shown) = shown {
            by_likelihood[state * n_observations + shown] -= ANCHOR / row[shown];
        }
    }

    fn step(&mut self, loss: f64, by_tables: &[Vec<f64>; 3]) -> Result<Update> {
        let number = self.adam.n_steps + 1;
        let gradient = self.parameters.chain(by_tables);
        if let Some(tensor) = gradient.not_finite() {
            return Err(self.wrong(tensor, "a NaN or infinite gradient"));
        }
        let rate = self.config.rate * self.config.rate_at(number - 1);
        let observation_rate = rate * self.config.observation_rate;
        let rates = [rate, observation_rate, observation_rate];
        let (mut parameters, mut adam) = (self.parameters.clone(), self.adam.clone());
        adam.step(&mut parameters, &gradient, rates);
        if let Some(tensor) = parameters.not_finite() {
            return Err(self.wrong(tensor, "a NaN or infinite step"));
        }
        parameters.bound();
        (self.parameters, self.adam) = (parameters, adam);
        Ok(Update { number, loss, rate })
    }

    fn wrong(&self, tensor: &str, what: &str) -> anyhow::Error {
        let update = self.adam.n_steps + 1;
        anyhow!("update {update}: {tensor}: expected finite numbers, got {what}")
    }
}

/// Adds up the outcomes in the order of the streams.
fn add_up(outcomes: &[Outcome], dimensions: Dimensions) -> (f64, usize, [Vec<f64>; 3]) {
    let mut gradient = dimensions.lengths().map(|length| vec![0.0; length]);
    let (mut log_likelihood, mut n_seen) = (0.0, 0);
    for outcome in outcomes {
        log_likelihood += outcome.log_likelihood;
        n_seen += outcome.n_seen;
        let slopes = outcome.gradient.iter().flatten();
        let sums = gradient.iter_mut().flatten();
        sums.zip(slopes).for_each(|(sum, slope)| *sum += slope);
    }
    (log_likelihood, n_seen, gradient)
}

fn shuffle(numbers: &mut [u64], seed: u64, lap: u64) {
    let mut random = stream(seed, Purpose::Learner, lap);
    for last in (1..numbers.len()).rev() {
        let other = random.next_u64() % (last as u64 + 1);
        numbers.swap(last, other as usize);
    }
}
