//! Fits a filter's parameters to the frames of acting robots.

mod neighbours;

pub use self::neighbours::Neighbours;

use crate::beliefs::learned::{LearnedModel, named_tensors, read_parameters};
use crate::checkpoint::{Contents, check, check_counts, check_earned};
use crate::config::{AgentConfig, LearningConfig};
use crate::gradient::{Optimiser, Update};
use crate::learners::base::lacks_steps;
use crate::replay::BlockReplay;
use crate::reward::{RewardEstimate, met};
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};
use emberwatch_model::{Frame, Shape};
use emberwatch_network::NamedTensor;
use serde::{Deserialize, Serialize};

/// Suffixes of tensor names: parameters, mean gradients and mean squared gradients.
const SUFFIXES: [&str; 3] = ["", ".first_moment", ".second_moment"];

/// A filter that is fitted to frames as they arrive. A checkpoint stores this struct, and its tensors separately.
#[derive(Debug, Clone, Serialize, Deserialize)]
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
            replay: replay(&config.learning),
            neighbours: Neighbours::default(),
        }
    }

    /// Begins a new track for a robot.
    pub fn begin(&mut self, robot: u32) {
        self.replay.begin(robot);
        self.neighbours
            .begin(robot, self.optimiser.cut().0.n_cells());
    }

    pub fn has_track(&self, robot: u32) -> bool {
        self.replay.has_track(robot)
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

    /// Drops all frames and tracks. The learned parameters remain.
    pub fn forget(&mut self) {
        self.replay = replay(self.optimiser.config());
        self.optimiser.leave_replay();
        self.earned = 0.0;
        self.neighbours.forget_robots();
    }

    pub fn learned(&self) -> LearnedModel {
        let parameters = self.optimiser.parameters();
        let last = parameters.dimensions.n_states - 1;
        let target = self.reward.target().unwrap_or(last);
        let correlations = self.neighbours.correlations_of(target);
        LearnedModel::new(parameters.clone(), target, correlations)
    }

    /// Explains why a run with this number of steps made no update, and what to do.
    pub fn lacks(&self, steps: u64) -> String {
        let config = self.optimiser.config();
        let (expected, got) = (config.streams, self.replay.n_blocks());
        if got < expected {
            return format!(
                "an update needs {expected} blocks of frames (learning.streams), and there were {got}; a block ends \
                 after {} frames or with its episode: train for more --steps",
                config.window * config.block_windows
            );
        }
        if steps as f64 * config.updates_per_step < 1.0 {
            return lacks_steps("learning.updates_per_step", config.updates_per_step);
        }
        "the frames show no cell".into()
    }

    pub fn n_updates(&self) -> u64 {
        self.optimiser.adam.n_steps
    }

    /// Returns the parameters and moments as named tensors.
    pub fn named_tensors(&self) -> Vec<NamedTensor> {
        let adam = &self.optimiser.adam;
        let parts = [self.optimiser.parameters(), &adam.first, &adam.second];
        let parts = SUFFIXES.into_iter().zip(parts);
        parts
            .flat_map(|(suffix, part)| named_tensors(part, suffix))
            .collect()
    }

    /// Loads the tensors from a checkpoint with the given dimensions.
    ///
    /// # Errors
    /// If a tensor is missing or has another form. The error names it.
    pub fn load(&mut self, contents: &Contents, dimensions: Dimensions) -> Result<()> {
        let counts = [
            ("n_updates", self.n_updates()),
            ("world_steps", self.world_steps),
        ];
        check_counts(&counts)?;
        let part = contents.part("");
        let [parameters, first, second] =
            SUFFIXES.map(|suffix| read_parameters(dimensions, &part, suffix));
        self.optimiser.set_parameters(parameters?);
        (self.optimiser.adam.first, self.optimiser.adam.second) = (first?, second?);
        contents.check_squares()?;
        self.reward.check(dimensions.n_states)
    }

    /// Resumes from a checkpoint. The replay buffer starts empty if the checkpoint's grid, windows or streams differ
    /// from the settings.
    ///
    /// # Errors
    /// If a value is missing or does not fit. The error names it.
    pub fn resume(
        mut saved: Self,
        contents: &Contents,
        dimensions: Dimensions,
        shape: Shape,
        config: &AgentConfig,
    ) -> Result<Self> {
        saved.load(contents, dimensions)?;
        let mut fit = Self::new(dimensions, shape, config);
        if saved.optimiser.cut() == fit.optimiser.cut() {
            check_earned(saved.earned)?;
            fit.earned = saved.earned;
            let (n_states, n_observations) = (dimensions.n_states, dimensions.n_observations);
            let replay = &mut fit.replay;
            replay.resume(saved.replay, shape, n_states, n_observations)?;
            let n_cells = shape.n_cells();
            let (name, expected) = ("neighbours.ages", format!("ages of {n_cells} cells"));
            check(saved.neighbours.are_of(n_cells), name, expected, "others")?;
        } else {
            saved.neighbours.forget_robots();
        }
        fit.optimiser.resume(saved.optimiser)?;
        fit.reward = saved.reward;
        fit.neighbours = saved.neighbours;
        fit.world_steps = saved.world_steps;
        Ok(fit)
    }
}

fn replay(config: &LearningConfig) -> BlockReplay {
    BlockReplay::new(config.window * config.block_windows, config.replay_frames)
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
        fit.begin(4);
        see(&mut fit, &[0, 1, 1, 0, 1, 1, 0]);
        fit
    }

    fn contents(fit: &FilterFit) -> Contents {
        Contents::new(fit.named_tensors(), fit)
    }

    fn resume(
        contents: &Contents,
        dimensions: Dimensions,
        config: &AgentConfig,
    ) -> Result<FilterFit, String> {
        let fit = contents
            .state()
            .and_then(|saved| FilterFit::resume(saved, contents, dimensions, shape(), config));
        fit.map_err(|error| error.to_string())
    }

    #[test]
    fn a_fit_resumes_exactly_unless_its_streams_differ() {
        let mut fit = fit();
        assert!(fit.n_updates() > 0);
        assert_eq!(fit.world_steps, 7);
        let stored = contents(&fit);
        let mut same = resume(&stored, DIMENSIONS, &config()).expect("whole");
        assert!(same.has_track(4) && contents(&same) == stored);
        let later = |fit: &mut FilterFit| see(fit, &[1, 0, 0, 1, 1]);
        later(&mut fit);
        later(&mut same);
        assert!(contents(&same) == contents(&fit) && contents(&same) != stored);
        let mut config = config();
        config.learning.streams = 3;
        let other = resume(&stored, DIMENSIONS, &config).expect("whole");
        assert!(!other.has_track(4), "an empty replay");
        assert_eq!(contents(&other).tensors, stored.tensors);
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
        let other = |change: fn(&mut Dimensions), words: &str| {
            let mut dimensions = DIMENSIONS;
            change(&mut dimensions);
            let error = resume(&contents(&fit()), dimensions, &config()).expect_err(words);
            assert_eq!(error, words);
        };
        let words = "kernel: expected shape [3, 3, 3, 3], got [3, 3, 1, 3]";
        other(|dimensions| dimensions.kernel = (3, 3), words);
        let words = "likelihood: expected shape [3, 4], got [3, 2]";
        other(|dimensions| dimensions.n_observations = 4, words);
        let forged = |change: fn(&mut Contents, &mut FilterFit), words: &str| {
            let (mut contents, mut saved) = (contents(&fit()), fit());
            change(&mut contents, &mut saved);
            contents.set_state(&saved);
            let error = resume(&contents, DIMENSIONS, &config()).expect_err(words);
            assert!(error.starts_with(words), "{error}");
        };
        forged(
            |contents, _| {
                let kernel = contents.tensors.get_mut("kernel");
                kernel.expect("a tensor").shape.insert(0, 3);
            },
            "kernel: expected one kernel for all cells, got kernels by own state or zone: train the filter again",
        );
        forged(
            |contents, _| drop(contents.tensors.remove("initial.first_moment")),
            "initial.first_moment: expected a tensor of shape [3], got none",
        );
        forged(
            |contents, _| {
                let tensor = contents.tensors.get_mut("kernel.second_moment");
                tensor.expect("a moment").numbers[2] = -0.5;
            },
            "kernel.second_moment: expected no negative numbers, got -0.5",
        );
        let words = "earned: expected 0 to 2000000, got 1";
        forged(|_, saved| saved.earned = 1e300, words);
        let words = "reward.rewards: expected 3 finite numbers, got NaN";
        forged(|_, saved| saved.reward.rewards[1] = f64::NAN, words);
        let words = "n_updates: expected at most";
        forged(|_, saved| saved.optimiser.adam.n_steps = u64::MAX, words);
        let words = "streams: expected 2, got 0";
        forged(|_, saved| saved.optimiser.streams.clear(), words);
    }
}
