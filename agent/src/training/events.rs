//! What TensorBoard shows of a training: the columns of the CSV, and now and then the belief.

use crate::training::metrics::{Tick, averages};
use crate::training::tensorboard::{EventFile, Value};
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_figures::{Heat, heat};
use emberwatch_learning::learners::{Learner, ModelUpdate};
use std::path::Path;

/// Steps of all worlds from one picture to the next.
const TICKS_PER_PICTURE: u64 = 100;

pub struct Events {
    file: EventFile,
    n_ticks: u64,
}

impl Events {
    /// Begins a file; what the folder's files tell of later world steps counts no more.
    pub fn begin(folder: &Path, world_steps: u64) -> Result<Self> {
        let file = EventFile::begin(folder, world_steps + 1)?;
        Ok(Self { file, n_ticks: 0 })
    }

    /// Adds a step: one number a column, as TensorBoard shows one value a step.
    pub fn add(
        &mut self,
        tick: &Tick,
        updates: &[ModelUpdate],
        columns: &[&'static str],
        learner: &dyn Learner,
    ) -> Result<()> {
        let averages = averages(tick, updates, columns);
        let scalars = averages
            .iter()
            .map(|&(name, value)| (name, Value::Scalar(value)));
        self.file.add(tick.world_steps, scalars)?;
        let is_due = self.n_ticks.is_multiple_of(TICKS_PER_PICTURE);
        self.n_ticks += 1;
        if !is_due {
            return Ok(());
        }
        let belief = learner.rollout(0).agent.belief();
        self.show(tick.world_steps, belief, learner.target())
    }

    pub fn flush(&mut self) -> Result<()> {
        self.file.flush()
    }

    fn show(&mut self, step: u64, belief: &Belief, state: usize) -> Result<()> {
        let picture = heat(belief.probability(state).view());
        let Heat { height, width, png } = picture.expect("invariant: a grid has cells, and fits");
        let png = &png;
        let image = Value::Image { height, width, png };
        self.file.add(step, [("belief_of_first_world", image)])
    }
}
