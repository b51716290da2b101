//! TensorBoard events of a training: the columns of `metrics.csv`, and an image of the belief at intervals.

use crate::training::heat::{Heat, heat};
use crate::training::metrics::{Tick, averages};
use crate::training::tensorboard::{EventFile, Value};
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_learning::learners::{Learner, ModelUpdate};
use std::path::Path;

/// Number of steps from one image of the belief to the next.
const TICKS_PER_PICTURE: u64 = 100;

pub struct Events {
    file: EventFile,
    n_ticks: u64,
}

impl Events {
    /// Creates a file. TensorBoard then ignores events after `world_steps` in older files of the folder.
    pub fn begin(folder: &Path, world_steps: u64) -> Result<Self> {
        let file = EventFile::begin(folder, world_steps + 1)?;
        Ok(Self { file, n_ticks: 0 })
    }

    /// Adds a step with one number per column, because TensorBoard shows one value per step.
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
        let picture = heat(&belief.probability(state).to_owned());
        let Heat { height, width, png } = picture.expect("invariant: a grid has cells, and fits");
        let png = &png;
        let image = Value::Image { height, width, png };
        self.file.add(step, [("belief_of_first_world", image)])
    }
}
