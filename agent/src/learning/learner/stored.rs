//! A learner in a checkpoint: its progress, and what else it goes on from bit for bit.

use crate::config::AgentConfig;
use crate::estimation::parameters::Dimensions;
use crate::learning::checkpoint::{Bytes, Contents, Problem};
use crate::learning::filter::Iterates;
use crate::learning::learner::{Learner, Progress};
use crate::learning::replay::Form;
use crate::learning::reward::RewardEstimate;
use protocol::Shape;

/// Names in checkpoints.
const PRODUCTS: &str = "reward.products";
const REWARDS: &str = "reward.rewards";
const WORLD_STEPS: &str = "world_steps";
const FORM: &str = "replay.form";
const OWED: &str = "owed";

impl Learner {
    /// As a checkpoint, without the settings.
    pub fn to_contents(&self) -> Contents {
        let mut contents = self.progress().to_contents();
        let form = self.form();
        let memory = Bytes::of_counts(self.memory().map(|side| side as u64));
        contents.bytes.insert(FORM.into(), memory);
        let owed = Bytes::of_floats([self.owed]);
        contents.bytes.insert(OWED.into(), owed);
        self.replay.store(form, &mut contents);
        self.trainer.store(form.belief, &mut contents);
        contents
    }

    /// From a checkpoint; with an empty replay if it was of another grid or cut into other windows
    /// than the settings say.
    ///
    /// # Errors
    /// [`Problem`] names what is missing or of another shape.
    pub fn from_contents(
        contents: &Contents,
        dimensions: Dimensions,
        shape: Shape,
        config: &AgentConfig,
    ) -> Result<Self, Problem> {
        let progress = Progress::from_contents(contents, Some(dimensions))?;
        let mut learner = Self::new(progress, shape, config);
        if contents.counts(FORM)? == learner.memory().map(|side| side as u64) {
            let form = learner.form();
            learner.owed = contents.floats(OWED, 1)?[0];
            learner.replay.restore(form, contents)?;
            learner.trainer.restore(form.belief, contents)?;
        }
        Ok(learner)
    }

    fn form(&self) -> Form {
        let dimensions = self.trainer.dimensions();
        let (height, width) = self.shape.dim();
        Form {
            belief: [dimensions.n_states, height, width],
            n_observations: dimensions.n_observations,
        }
    }

    /// Sizes that a memory of what was seen only fits if they are the same.
    fn memory(&self) -> [usize; 5] {
        let config = &self.config;
        let (height, width) = self.shape.dim();
        let (window, block_windows) = (config.window, config.block_windows);
        [window, block_windows, config.streams, height, width]
    }
}

impl Progress {
    /// As a checkpoint, without the settings.
    pub fn to_contents(&self) -> Contents {
        let mut contents = Contents::default();
        self.iterates.store(&mut contents);
        let estimates = [
            (PRODUCTS, &self.reward.products),
            (REWARDS, &self.reward.rewards),
        ];
        for (name, numbers) in estimates {
            let numbers = Bytes::of_floats(numbers.iter().copied());
            contents.bytes.insert(name.into(), numbers);
        }
        let texts = [(WORLD_STEPS, self.world_steps.to_string())];
        for (name, text) in texts {
            contents.texts.insert(name.into(), text);
        }
        contents
    }

    /// From a checkpoint. `expected`: refuse other dimensions; without it, the file's own.
    ///
    /// # Errors
    /// [`Problem`] names the tensor that is missing or of another shape.
    pub fn from_contents(
        contents: &Contents,
        expected: Option<Dimensions>,
    ) -> Result<Self, Problem> {
        let dimensions = match expected {
            Some(dimensions) => dimensions,
            None => dimensions_of(contents)?,
        };
        let n_states = dimensions.n_states;
        Ok(Self {
            iterates: Iterates::restored(dimensions, contents)?,
            reward: RewardEstimate {
                products: contents.floats(PRODUCTS, n_states * n_states)?,
                rewards: contents.floats(REWARDS, n_states)?,
            },
            world_steps: contents.count(WORLD_STEPS)?,
        })
    }
}

/// The dimensions that a checkpoint's tensors have.
fn dimensions_of(contents: &Contents) -> Result<Dimensions, Problem> {
    let shape = |name: &str| match contents.tensors.get(name) {
        Some(tensor) => Ok(tensor.shape.clone()),
        None => Err(Problem::Missing(name.into())),
    };
    let (kernel, likelihood) = (shape("kernel")?, shape("likelihood")?);
    let wrong = |got: String| Problem::Value {
        name: "kernel".into(),
        expected: "the shape [states, states, rows, columns] of a filter".into(),
        got,
    };
    let (&[n_states, _, rows, cols], &[_, n_observations]) = (&*kernel, &*likelihood) else {
        return Err(wrong(format!(
            "{kernel:?} and a likelihood of {likelihood:?}"
        )));
    };
    let dimensions = Dimensions {
        n_states,
        n_observations,
        kernel: (rows, cols),
    };
    dimensions.check().map_err(|error| wrong(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::belief::Belief;
    use protocol::Frame;

    fn progress() -> Progress {
        let dimensions = Dimensions {
            n_states: 3,
            n_observations: 2,
            kernel: (1, 3),
        };
        let mut progress = Progress::first(dimensions, 5);
        progress.iterates.adam.n_steps = 9;
        progress.reward.add(&[1.0, 2.0, 0.5], 3.0);
        progress
    }

    #[test]
    fn progress_survives_a_checkpoint() {
        let contents = progress().to_contents();
        let own = Progress::from_contents(&contents, None).expect("whole");
        assert_eq!(own, progress());
        let expected = Some(progress().iterates.parameters.dimensions);
        assert_eq!(Progress::from_contents(&contents, expected).ok(), Some(own));
    }

    #[test]
    fn what_was_seen_survives_a_checkpoint_unless_it_is_cut_otherwise() {
        let shape = Shape::new(1, 3).expect("test shape");
        let mut config = AgentConfig::default();
        config.learning.window = 2;
        config.learning.block_windows = 1;
        config.learning.streams = 2;
        let mut learner = Learner::new(progress(), shape, &config);
        let belief = protocol::grid::Probabilities::from_elem((3, 1, 3), 1.0 / 3.0);
        let belief = Belief::from_probabilities(belief).expect("a belief");
        learner.begin(4);
        for value in [0, 1, 1, 0, 1] {
            let frame = Frame::from_bytes(shape, 2, &[value, 255, 1]).expect("a frame");
            learner.expect(4, &belief);
            learner.see(4, &frame);
            let visited: Vec<usize> = frame.observed().map(|(cell, _)| cell).collect();
            learner.reward(&belief, &visited, 0.3);
        }
        learner.learn().expect("finite");
        let contents = learner.to_contents();
        let dimensions = progress().iterates.parameters.dimensions;
        let restored = |config: &AgentConfig| {
            Learner::from_contents(&contents, dimensions, shape, config).expect("whole")
        };
        let same = restored(&config);
        assert!(same.has_track(4) && same.n_updates() > 9);
        assert_eq!(same.to_contents(), contents);
        config.learning.streams = 3;
        let other = restored(&config);
        assert!(!other.has_track(4), "an empty replay");
        assert_eq!(other.progress(), learner.progress());
    }

    #[test]
    fn another_shape_is_refused_by_the_tensors_name() {
        let contents = progress().to_contents();
        let check = |change: fn(&mut Dimensions), words: &str| {
            let mut dimensions = progress().iterates.parameters.dimensions;
            change(&mut dimensions);
            let error = Progress::from_contents(&contents, Some(dimensions));
            assert_eq!(error.expect_err(words).to_string(), words);
        };
        check(
            |d| d.kernel = (3, 3),
            "kernel: expected shape [3, 3, 3, 3], got [3, 3, 1, 3]",
        );
        check(
            |d| d.n_observations = 4,
            "likelihood: expected shape [3, 4], got [3, 2]",
        );
        let mut without = contents.clone();
        without.tensors.remove("initial.first_moment");
        let error = Progress::from_contents(&without, None).expect_err("missing");
        assert_eq!(
            error.to_string(),
            "expected \"initial.first_moment\" in it, found none"
        );
    }
}
