//! Fits a filter's parameters to the frames of acting robots.

mod neighbours;

pub use self::neighbours::Neighbours;

use crate::checkpoint::{Contents, check_counts};
use crate::gradient::Adam;
use crate::gradient::{Optimiser, Update};
use crate::models::{SavedFilter, SavedModel, named_tensors, read_parameters};
use crate::replay::BlockReplay;
use crate::reward::{RewardEstimate, met};
use anyhow::Result;
use emberwatch_acting::beliefs::learned::LearnedModel;
use emberwatch_acting::config::AgentConfig;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};
use emberwatch_model::{Frame, Shape};

const SUFFIXES: [&str; 3] = ["", ".first_moment", ".second_moment"];

/// A filter that is fitted to frames as they arrive.
#[derive(Debug, Clone)]
pub struct FilterFit {
    pub optimiser: Optimiser,
    pub reward: RewardEstimate,
    /// Number of world steps, for all worlds together.
    pub world_steps: u64,
    /// Number of updates that are due but not made yet.
    pub earned: f64,
    replay: BlockReplay,
    neighbours: Neighbours,
}

impl FilterFit {
    /// Creates a fit before the first frame.
    pub fn new(dimensions: Dimensions, shape: Shape, config: &AgentConfig) -> Self {
        let parameters = Parameters::first(dimensions, config.seed);
        Self {
            optimiser: Optimiser::new(parameters, shape, config.learning, config.seed),
            reward: RewardEstimate::new(dimensions.n_states),
            world_steps: 0,
            earned: 0.0,
            replay: BlockReplay::new(
                config.learning.window * config.learning.block_windows,
                config.learning.replay_frames,
            ),
            neighbours: Neighbours::default(),
        }
    }

    /// Begins a new track for a robot.
    pub fn start_track(&mut self, robot: u32) {
        self.replay.start_track(robot);
        self.neighbours
            .start_track(robot, self.optimiser.shape.n_cells());
    }

    /// Adds a robot's next frame. `predictor` is the belief before the frame (`None` for the track's first frame), and
    /// `learned` is the current model.
    pub fn see(
        &mut self,
        robot: u32,
        frame: &Frame,
        predictor: Option<&Belief>,
        learned: &LearnedModel,
    ) {
        self.replay.push(robot, frame, predictor);
        let (tables, target) = (&learned.tables, learned.target);
        self.neighbours.see(robot, frame, predictor, tables, target);
    }

    /// Records the reward of a path. `posterior` is the belief after the path's frame, and `visited` contains the
    /// distinct cells of the path.
    pub fn earn(&mut self, posterior: &Belief, visited: &[usize], reward: f64) {
        let met = met(posterior, visited);
        self.reward.add(&met, reward);
        self.world_steps += 1;
        self.earned += self.optimiser.config().updates_per_step;
    }

    /// Makes the updates that are due after the steps since the last call.
    ///
    /// # Errors
    /// If a value is not finite. The parameters then stay as they were after the last successful update.
    pub fn learn(&mut self) -> Result<Vec<Update>> {
        let mut updates = Vec::new();
        let target = self.reward.target();
        while self.earned >= 1.0 {
            self.earned -= 1.0;
            updates.extend(self.optimiser.update(&mut self.replay, target)?);
        }
        Ok(updates)
    }

    pub fn learned(&self) -> LearnedModel {
        let parameters = self.optimiser.parameters();
        let last = parameters.dimensions.n_states - 1;
        let target = self.reward.target().unwrap_or(last);
        let correlations = self.neighbours.correlations_of(target);
        LearnedModel::new(parameters.clone(), target, correlations)
    }

    pub fn n_updates(&self) -> u64 {
        self.optimiser.adam.n_steps
    }

    /// Returns the contents of a checkpoint.
    pub fn contents(&self) -> Contents {
        let adam = &self.optimiser.adam;
        let parts = [self.optimiser.parameters(), &adam.first, &adam.second];
        let parts = SUFFIXES.into_iter().zip(parts);
        let tensors = parts.flat_map(|(suffix, part)| named_tensors(part, suffix));
        let state = SavedFilter {
            model: SavedModel::of(&self.learned()),
            reward: self.reward.clone(),
            n_updates: self.n_updates(),
            world_steps: self.world_steps,
        };
        Contents::new(tensors, &state)
    }

    /// Loads a checkpoint of a filter with the same dimensions.
    ///
    /// # Errors
    /// If a value is missing or does not fit. The error names it.
    pub fn load(&mut self, contents: &Contents) -> Result<()> {
        let saved: SavedFilter = contents.state()?;
        check_counts(&[
            ("n_updates", saved.n_updates),
            ("world_steps", saved.world_steps),
        ])?;
        let (dimensions, part) = (self.optimiser.dimensions(), contents.part(""));
        let [parameters, first, second] =
            SUFFIXES.map(|suffix| read_parameters(dimensions, &part, suffix));
        let (parameters, first, second) = (parameters?, first?, second?);
        contents.check_squares()?;
        saved.reward.check(dimensions.n_states)?;
        let model = saved.model.read(&part)?;
        let adam = Adam {
            first,
            second,
            n_steps: saved.n_updates,
        };
        self.optimiser.resume(parameters, adam);
        self.neighbours = Neighbours::of(model.correlations, model.target);
        (self.reward, self.world_steps) = (saved.reward, saved.world_steps);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_belief::estimation::belief::Belief;

    const DIMENSIONS: Dimensions = Dimensions {
        n_states: 3,
        n_observations: 2,
        kernel: (1, 3),
    };

    fn shape() -> Shape {
        Shape::new(1, 3).expect("test shape")
    }

    fn config() -> AgentConfig {
        let mut config = AgentConfig::default();
        config.learning.window = 2;
        config.learning.block_windows = 1;
        config.learning.streams = 2;
        config
    }

    fn see(fit: &mut FilterFit, values: &[u8]) {
        let belief = Belief::uniform(3, shape());
        for &value in values {
            let frame = Frame::from_bytes(shape(), 2, &[value, 255, 1]).expect("a frame");
            let learned = fit.learned();
            fit.see(4, &frame, Some(&belief), &learned);
            let visited: Vec<usize> = frame.observed().map(|(cell, _)| cell).collect();
            fit.earn(&belief, &visited, 0.3);
            for update in fit.learn().expect("finite") {
                // The mean over cells, about ln 2 at first. A sum over cells would be larger.
                assert!(update.loss < 1.1, "{update:?}");
            }
        }
    }

    fn fit() -> FilterFit {
        let mut fit = FilterFit::new(DIMENSIONS, shape(), &config());
        fit.start_track(4);
        see(&mut fit, &[0, 1, 1, 0, 1, 1, 0]);
        fit
    }

    fn resume(contents: &Contents, dimensions: Dimensions) -> Result<FilterFit, String> {
        let mut fit = FilterFit::new(dimensions, shape(), &config());
        let loaded = fit.load(contents);
        loaded.map_err(|error| error.to_string()).map(|()| fit)
    }

    #[test]
    fn a_fit_continues_from_what_was_learned() {
        let fit = fit();
        assert!(fit.n_updates() > 0);
        assert_eq!(fit.world_steps, 7);
        let stored = fit.contents();
        let mut same = resume(&stored, DIMENSIONS).expect("whole");
        assert_eq!(same.contents(), stored);
        assert_eq!(same.learned(), fit.learned());
        assert_eq!(same.replay.n_blocks(), 0);
        same.start_track(4);
        see(&mut same, &[1, 0, 0, 1, 1]);
        assert!(same.n_updates() > fit.n_updates());
    }

    #[test]
    fn the_target_is_the_state_with_the_highest_reward() {
        let mut fit = fit();
        let states = ndarray::arr2(&[[0, 1, 2]]);
        let belief = Belief::from_states(&states, 3).expect("states");
        (0..50).for_each(|at| fit.earn(&belief, &[at % 3], f64::from(u8::from(at % 3 == 1))));
        assert_eq!(fit.learned().target, 1);
    }

    #[test]
    fn errors_name_what_does_not_fit() {
        let kernel = (3, 3);
        let error = resume(
            &fit().contents(),
            Dimensions {
                kernel,
                ..DIMENSIONS
            },
        );
        let words = "kernel: expected shape [3, 3, 3, 3], got [3, 3, 1, 3]";
        assert_eq!(error.map(drop), Err(words.into()));
        let forged = |change: fn(&mut Contents, &mut SavedFilter), words: &str| {
            let mut contents = fit().contents();
            let mut saved = contents.state().expect("its state");
            change(&mut contents, &mut saved);
            contents.set_state(&saved);
            let error = resume(&contents, DIMENSIONS).expect_err(words);
            assert!(error.starts_with(words), "{error}");
        };
        forged(
            |contents, _| {
                let tensor = contents.tensors.get_mut("kernel.second_moment");
                tensor.expect("a moment").numbers[2] = -0.5;
            },
            "kernel.second_moment: expected no negative numbers, got -0.5",
        );
        let words = "reward.rewards: expected 3 finite numbers, got NaN";
        forged(|_, saved| saved.reward.rewards[1] = f64::NAN, words);
        let words = "n_updates: expected at most";
        forged(|_, saved| saved.n_updates = u64::MAX, words);
    }
}
