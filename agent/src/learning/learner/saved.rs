//! A learner in a checkpoint: parameters and moments as tensors, and what else it goes on from bit for bit.

use crate::config::AgentConfig;
use crate::estimation::parameters::{Dimensions, Parameters};
use crate::learning::checkpoint::{Contents, Problem, check, check_counts};
use crate::learning::filter::{Adam, Iterates, Laps};
use crate::learning::learner::neighbours::Neighbours;
use crate::learning::learner::online::{Learner, Progress};
use crate::learning::replay::Replay;
use crate::learning::reward::RewardEstimate;
use ::network::NamedTensor;
use protocol::Shape;
use serde::{Deserialize, Serialize};

/// Names of tensors end so: parameters, means and means of squares.
const SUFFIXES: [&str; 3] = ["", ".first_moment", ".second_moment"];

/// More updates than a step of all worlds earns.
const MAX_OWED: f64 = 2e6;

/// A learner without its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedLearner {
    /// The parameters'.
    pub dimensions: Dimensions,
    /// Updates so far.
    pub n_updates: u64,
    /// Which state pays.
    pub reward: RewardEstimate,
    /// World steps seen, of all worlds together.
    pub world_steps: u64,
    /// The grid.
    pub shape: Shape,
    /// Window, windows of a block, streams.
    pub cut: [usize; 3],
    /// Updates that steps have earned and that are not made yet.
    pub owed: f64,
    /// What was seen.
    pub replay: Replay,
    /// Where the streams are in it.
    pub laps: Laps,
    /// How much cells say of their neighbours.
    pub neighbours: Neighbours,
}

impl Learner {
    /// Parameters and moments by name.
    pub fn named_tensors(&self) -> Vec<NamedTensor> {
        let Iterates { parameters, adam } = self.trainer.iterates();
        let parts = [parameters, &adam.first, &adam.second];
        let named = |(suffix, part): (&str, &Parameters)| {
            let shapes = part.dimensions.shapes();
            [0, 1, 2].map(|at| {
                let name = format!("{}{suffix}", Parameters::NAMES[at]);
                (name, shapes[at].clone(), part.tensors[at].clone())
            })
        };
        SUFFIXES.into_iter().zip(parts).flat_map(named).collect()
    }

    /// What else a resumed run needs.
    pub fn saved(&self) -> SavedLearner {
        SavedLearner {
            dimensions: self.trainer.dimensions(),
            n_updates: self.n_updates(),
            reward: self.reward.clone(),
            world_steps: self.world_steps,
            shape: self.shape,
            cut: self.cut(),
            owed: self.owed,
            replay: self.replay.clone(),
            laps: self.trainer.laps().clone(),
            neighbours: self.neighbours.clone(),
        }
    }

    /// From a checkpoint; with an empty replay if it was of another grid or cut into other windows
    /// than the settings say.
    ///
    /// # Errors
    /// Names what is missing or of another form.
    pub fn resume(
        saved: SavedLearner,
        contents: &Contents,
        dimensions: Dimensions,
        shape: Shape,
        config: &AgentConfig,
    ) -> Result<Self, Problem> {
        let progress = saved.progress(contents, dimensions)?;
        let mut learner = Self::new(progress, shape, config);
        if (saved.shape, saved.cut) == (shape, learner.cut()) {
            let (n_states, n_observations) = (dimensions.n_states, dimensions.n_observations);
            let fits = (0.0..MAX_OWED).contains(&saved.owed);
            check(fits, "owed", format!("0 to {MAX_OWED}"), saved.owed)?;
            learner.owed = saved.owed;
            let replay = &mut learner.replay;
            replay.resume(saved.replay, shape, n_states, n_observations)?;
            learner.trainer.resume_laps(saved.laps)?;
        } else {
            learner.neighbours.forget_worlds();
        }
        Ok(learner)
    }

    fn cut(&self) -> [usize; 3] {
        let config = &self.config;
        [config.window, config.block_windows, config.streams]
    }
}

impl SavedLearner {
    /// What was learned, of given dimensions; its tensors are in `contents`.
    ///
    /// # Errors
    /// Names what is missing or of another form.
    pub fn progress(
        &self,
        contents: &Contents,
        dimensions: Dimensions,
    ) -> Result<Progress, Problem> {
        let (n_steps, world_steps) = (self.n_updates, self.world_steps);
        check_counts(&[("n_updates", n_steps), ("world_steps", world_steps)])?;
        let shapes = dimensions.shapes();
        let part = |suffix: &str| -> Result<Parameters, Problem> {
            let tensor = |at: usize| {
                contents.tensor(&format!("{}{suffix}", Parameters::NAMES[at]), &shapes[at])
            };
            let tensors = [tensor(0)?, tensor(1)?, tensor(2)?];
            Ok(Parameters {
                dimensions,
                tensors,
            })
        };
        let [parameters, first, second] = SUFFIXES.map(part);
        let (parameters, first, second) = (parameters?, first?, second?);
        contents.check_squares()?;
        self.reward.check(dimensions.n_states)?;
        let n_cells = self.shape.n_cells();
        let (name, expected) = ("neighbours.ages", format!("those of {n_cells} cells"));
        check(self.neighbours.are_of(n_cells), name, expected, "others")?;
        Ok(Progress {
            iterates: Iterates {
                parameters,
                adam: Adam {
                    first,
                    second,
                    n_steps,
                },
            },
            reward: self.reward.clone(),
            world_steps,
            neighbours: self.neighbours.clone(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::belief::Belief;
    use protocol::Frame;

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

    fn see(learner: &mut Learner, values: &[u8]) {
        let belief = Belief::uniform(3, shape());
        for &value in values {
            let frame = Frame::from_bytes(shape(), 2, &[value, 255, 1]).expect("a frame");
            learner.expect(4, &belief);
            learner.see(4, &frame);
            let visited: Vec<usize> = frame.observed().map(|(cell, _)| cell).collect();
            learner.reward(&belief, &visited, 0.3);
            learner.learn().expect("finite");
        }
    }

    fn learner() -> Learner {
        let mut learner = Learner::new(Progress::first(DIMENSIONS, 5), shape(), &config());
        learner.begin(4);
        see(&mut learner, &[0, 1, 1, 0, 1, 1, 0]);
        learner
    }

    fn contents(learner: &Learner) -> Contents {
        Contents::new(learner.named_tensors(), &learner.saved())
    }

    fn resume(
        contents: &Contents,
        dimensions: Dimensions,
        config: &AgentConfig,
    ) -> Result<Learner, String> {
        let learner = contents
            .state()
            .and_then(|saved| Learner::resume(saved, contents, dimensions, shape(), config));
        learner.map_err(|error| error.to_string())
    }

    #[test]
    fn a_learner_resumes_alike_unless_its_replay_is_cut_otherwise() {
        let mut learner = learner();
        assert!(learner.n_updates() > 0);
        let stored = contents(&learner);
        let mut same = resume(&stored, DIMENSIONS, &config()).expect("whole");
        assert!(same.has_track(4) && contents(&same) == stored);
        let later = |learner: &mut Learner| see(learner, &[1, 0, 0, 1, 1]);
        later(&mut learner);
        later(&mut same);
        assert!(contents(&same) == contents(&learner) && contents(&same) != stored);
        let mut config = config();
        config.learning.streams = 3;
        let other = resume(&stored, DIMENSIONS, &config).expect("whole");
        assert!(!other.has_track(4), "an empty replay");
        assert_eq!(contents(&other).tensors, stored.tensors);
    }

    #[test]
    fn what_does_not_fit_is_refused_by_name() {
        let other = |change: fn(&mut Dimensions), words: &str| {
            let mut dimensions = DIMENSIONS;
            change(&mut dimensions);
            let error = resume(&contents(&learner()), dimensions, &config()).expect_err(words);
            assert_eq!(error, words);
        };
        other(
            |dimensions| dimensions.kernel = (3, 3),
            "kernel: expected shape [3, 3, 3, 3], got [3, 3, 1, 3]",
        );
        other(
            |dimensions| dimensions.n_observations = 4,
            "likelihood: expected shape [3, 4], got [3, 2]",
        );
        let forged = |change: fn(&mut Contents, &mut SavedLearner), words: &str| {
            let (mut contents, mut saved) = (contents(&learner()), learner().saved());
            change(&mut contents, &mut saved);
            contents.set_state(&saved);
            let error = resume(&contents, DIMENSIONS, &config()).expect_err(words);
            assert!(error.starts_with(words), "{error}");
        };
        forged(
            |contents, _| drop(contents.tensors.remove("initial.first_moment")),
            "initial.first_moment: expected shape [3], got none",
        );
        forged(
            |contents, _| {
                let tensor = contents.tensors.get_mut("kernel.second_moment");
                tensor.expect("a moment").numbers[2] = -0.5;
            },
            "kernel.second_moment: expected numbers from 0 on, got -0.5",
        );
        forged(
            |_, saved| saved.owed = 1e300,
            "owed: expected 0 to 2000000, got 1",
        );
        forged(
            |_, saved| saved.reward.rewards[1] = f64::NAN,
            "reward.rewards: expected 3 finite numbers, got NaN",
        );
        forged(
            |_, saved| saved.n_updates = u64::MAX,
            "n_updates: expected at most",
        );
        let other_laps = |_: &mut Contents, saved: &mut SavedLearner| {
            let first = Progress::first(DIMENSIONS, 5);
            let other = Learner::new(first, shape(), &AgentConfig::default());
            saved.laps = other.saved().laps;
        };
        forged(other_laps, "streams: expected 2, got ");
    }
}
