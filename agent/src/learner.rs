//! What learns a model while an agent acts: replay in, parameters out. Pure.

use crate::belief::Belief;
use crate::checkpoint::{Contents, Problem, Tensor};
use crate::config::{AgentConfig, LearningConfig};
use crate::estimator::learned_filter::{
    Adam, Dimensions, NotFinite, Parameters, Tables, Trainer, Update,
};
use crate::replay::Replay;
use crate::reward::{RewardEstimate, met};
use protocol::{Frame, Shape};

/// How checkpoints of this learner call it.
pub const KIND: &str = "learned_filter";

/// What was learned: all that acting on it needs.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnedModel {
    /// The filter's parameters.
    pub tables: Tables,
    /// The state that pays most.
    pub target: usize,
}

/// The state of learning.
#[derive(Debug, Clone, PartialEq)]
pub struct Progress {
    /// The free numbers.
    pub parameters: Parameters,
    /// The optimiser.
    pub adam: Adam,
    /// Which state pays.
    pub reward: RewardEstimate,
    /// World steps seen, of all worlds together.
    pub world_steps: u64,
}

/// Learns from frames as they come.
#[derive(Debug, Clone)]
pub struct Learner {
    trainer: Trainer,
    replay: Replay,
    reward: RewardEstimate,
    config: LearningConfig,
    world_steps: u64,
    /// Updates that steps have earned and that are not made yet.
    owed: f64,
}

impl Learner {
    /// A learner with an empty replay.
    pub fn new(progress: Progress, shape: Shape, config: &AgentConfig) -> Self {
        let learning = config.learning;
        let Progress {
            parameters,
            adam,
            reward,
            world_steps,
        } = progress;
        let block = learning.window * learning.block_windows;
        Self {
            trainer: Trainer::resume(parameters, adam, shape, learning, config.seed),
            replay: Replay::new(block, learning.replay_frames),
            reward,
            config: learning,
            world_steps,
            owed: 0.0,
        }
    }

    /// A world's track begins, here or anew.
    pub fn begin(&mut self, world: u32) {
        self.replay.begin(world);
    }

    /// A world's next frame, with the belief before it.
    pub fn see(&mut self, world: u32, predictor: &Belief, frame: &Frame) {
        if self.replay.wants_belief(world) {
            self.replay.give_belief(world, predictor.as_slice());
        }
        self.replay.push(world, frame);
    }

    /// The reward of the path that a frame shows, with the belief after it.
    pub fn reward(&mut self, posterior: &Belief, frame: &Frame, reward: f64) {
        self.reward.add(&met(posterior, frame), reward);
        self.world_steps += 1;
        self.owed += self.config.updates_per_step;
    }

    /// Makes the updates that the steps since the last call have earned.
    ///
    /// # Errors
    /// [`NotFinite`]: learning cannot go on; the parameters are those before.
    pub fn learn(&mut self) -> Result<Vec<Update>, NotFinite> {
        let mut updates = Vec::new();
        let target = self.reward.target();
        while self.owed >= 1.0 {
            self.owed -= 1.0;
            updates.extend(self.trainer.update(&mut self.replay, target)?);
        }
        Ok(updates)
    }

    /// What is known by now.
    pub fn learned(&self) -> LearnedModel {
        let progress = self.trainer.parameters();
        learned(progress, &self.reward)
    }

    /// World steps seen, of all worlds together.
    pub fn world_steps(&self) -> u64 {
        self.world_steps
    }

    /// Updates made.
    pub fn n_updates(&self) -> u64 {
        self.trainer.adam().n_steps
    }

    /// The state of learning, to go on from.
    pub fn progress(&self) -> Progress {
        Progress {
            parameters: self.trainer.parameters().clone(),
            adam: self.trainer.adam().clone(),
            reward: self.reward.clone(),
            world_steps: self.world_steps,
        }
    }
}

impl Progress {
    /// Before the first frame.
    pub fn first(dimensions: Dimensions, seed: u64) -> Self {
        Self {
            parameters: Parameters::first(dimensions, seed),
            adam: Adam::new(dimensions),
            reward: RewardEstimate::new(dimensions.n_states),
            world_steps: 0,
        }
    }

    /// What is known by then.
    pub fn learned(&self) -> LearnedModel {
        learned(&self.parameters, &self.reward)
    }

    /// As a checkpoint, with the effective settings.
    pub fn to_contents(&self, settings: &str) -> Contents {
        let mut contents = Contents::default();
        let shapes = self.parameters.dimensions.shapes();
        let parts = [
            ("", &self.parameters),
            (".first_moment", &self.adam.first),
            (".second_moment", &self.adam.second),
        ];
        for (suffix, part) in parts {
            let named = Parameters::NAMES.iter().zip(&shapes).zip(&part.tensors);
            for ((name, shape), numbers) in named {
                let (shape, numbers) = (shape.clone(), numbers.clone());
                let tensor = Tensor { shape, numbers };
                contents.tensors.insert(format!("{name}{suffix}"), tensor);
            }
        }
        let n_states = self.parameters.dimensions.n_states;
        let estimates = [
            ("reward.products", &self.reward.products, vec![n_states; 2]),
            ("reward.rewards", &self.reward.rewards, vec![n_states]),
        ];
        for (name, numbers, shape) in estimates {
            let numbers = numbers.iter().map(|&x| x as f32).collect();
            contents
                .tensors
                .insert(name.into(), Tensor { shape, numbers });
        }
        let texts = [
            ("settings", settings.to_owned()),
            ("updates", self.adam.n_steps.to_string()),
            ("world_steps", self.world_steps.to_string()),
        ];
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
        let shapes = dimensions.shapes();
        let part = |suffix: &str| -> Result<Parameters, Problem> {
            let mut part = Parameters::zeros(dimensions);
            for ((name, shape), numbers) in
                Parameters::NAMES.iter().zip(&shapes).zip(&mut part.tensors)
            {
                let tensor = contents.tensor(&format!("{name}{suffix}"), shape)?;
                numbers.copy_from_slice(tensor);
            }
            Ok(part)
        };
        let wide = |numbers: &[f32]| numbers.iter().map(|&x| f64::from(x)).collect();
        let n_states = dimensions.n_states;
        let products = contents.tensor("reward.products", &[n_states, n_states])?;
        let rewards = contents.tensor("reward.rewards", &[n_states])?;
        Ok(Self {
            parameters: part("")?,
            adam: Adam {
                first: part(".first_moment")?,
                second: part(".second_moment")?,
                n_steps: contents.count("updates")?,
            },
            reward: RewardEstimate {
                products: wide(products),
                rewards: wide(rewards),
            },
            world_steps: contents.count("world_steps")?,
        })
    }
}

fn learned(parameters: &Parameters, reward: &RewardEstimate) -> LearnedModel {
    LearnedModel {
        tables: parameters.tables(),
        target: reward
            .target()
            .unwrap_or(parameters.dimensions.n_states - 1),
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

    fn progress() -> Progress {
        let dimensions = Dimensions {
            n_states: 3,
            n_observations: 2,
            kernel: (1, 3),
        };
        let mut progress = Progress::first(dimensions, 5);
        progress.adam.n_steps = 9;
        progress.reward.add(&[1.0, 2.0, 0.5], 3.0);
        progress
    }

    #[test]
    fn progress_survives_a_checkpoint() {
        let contents = progress().to_contents("seed = 1");
        let own = Progress::from_contents(&contents, None).expect("whole");
        assert_eq!(own, progress());
        let expected = Some(progress().parameters.dimensions);
        assert_eq!(Progress::from_contents(&contents, expected).ok(), Some(own));
        assert_eq!(contents.texts["settings"], "seed = 1");
    }

    #[test]
    fn another_shape_is_refused_by_the_tensors_name() {
        let contents = progress().to_contents("");
        let check = |change: fn(&mut Dimensions), words: &str| {
            let mut dimensions = progress().parameters.dimensions;
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
