//! The DQN: its settings, action values and updates.

use super::track::{Track, Transition};
use crate::adam::{Adam, AdamSettings};
use crate::error::NetworkError;
use crate::variables::{Variables, build, uniform, uniform_init};
use candle_core::{DType, Device, Result as CandleResult, Tensor};
use candle_nn::loss::mse;
use candle_nn::{Linear, Module, VarBuilder};
use emberwatch_model::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Settings of a DQN, as stored in files. Files do not contain the optimiser's settings.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DqnSettings {
    /// Capacity of the replay buffer, in transitions.
    pub replay: usize,
    /// Number of transitions per update.
    pub batch: usize,
    /// Discount per step.
    pub gamma: f32,
    /// Number of steps per transition. Transitions at the end of an episode span fewer: see [`Track`].
    pub n_step: usize,
    /// Weight of the network's variables in each update of the target network.
    pub tau: f32,
    /// Probability of a random action at the first step.
    pub epsilon: f32,
    /// Probability of a random action after `epsilon_steps` steps.
    pub epsilon_end: f32,
    /// Number of steps over which the probability changes linearly from `epsilon` to `epsilon_end`.
    pub epsilon_steps: u64,
    /// Whether to use double Q-learning: the network selects the next action, and the target network evaluates it.
    pub double: bool,
    /// Whether to use the Huber loss, which is linear for errors above 1, instead of the squared error.
    pub huber: bool,
    /// Number of units in each of the two hidden layers.
    pub width: usize,
    /// Settings of the optimiser. The default settings are the authors'.
    #[serde(skip, default = "adam")]
    pub adam: AdamSettings,
}

impl DqnSettings {
    /// Returns the authors' settings.
    pub fn paper() -> Self {
        Self {
            replay: 1000,
            batch: 64,
            gamma: 0.99,
            n_step: 1,
            tau: 0.01,
            epsilon: 0.1,
            epsilon_end: 0.1,
            epsilon_steps: 0,
            double: false,
            huber: false,
            width: 128,
            adam: adam(),
        }
    }

    /// Replaces the learning rate.
    pub fn with_rate(mut self, learning_rate: f32) -> Self {
        self.adam.learning_rate = learning_rate;
        self
    }

    /// Returns the probability of a random action at a step.
    pub fn epsilon_at(&self, step: u64) -> f32 {
        let share = (step as f32 / self.epsilon_steps.max(1) as f32).min(1.0);
        self.epsilon + (self.epsilon_end - self.epsilon) * share
    }
}

fn adam() -> AdamSettings {
    AdamSettings {
        betas: [0.9, 0.999],
        ..AdamSettings::paper(0.01)
    }
}

/// The sizes of a decision: its inputs and its choices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DqnShape {
    /// Number of inputs of the network.
    pub n_inputs: usize,
    /// Number of outputs of the network.
    pub n_outputs: usize,
    /// Number of evaluations of the network per decision: one per candidate, or 1.
    pub n_candidates: usize,
}

impl DqnShape {
    /// Returns the shape of a DQN that scores all actions from one input vector.
    pub fn of_actions(n_inputs: usize, n_actions: usize) -> Self {
        Self {
            n_inputs,
            n_outputs: n_actions,
            n_candidates: 1,
        }
    }

    /// Returns the shape of a DQN that scores each candidate from the candidate's features.
    pub const fn of_candidates(n_inputs: usize, n_candidates: usize) -> Self {
        Self {
            n_inputs,
            n_outputs: 1,
            n_candidates,
        }
    }

    /// Returns the number of input values per decision, over all candidates.
    pub fn n_numbers(&self) -> usize {
        self.n_inputs * self.n_candidates
    }

    /// Returns the number of choices of a decision.
    pub fn n_choices(&self) -> usize {
        self.n_outputs * self.n_candidates
    }
}

/// A deep Q-network, which learns action values from transitions.
pub struct Dqn {
    pub(super) settings: DqnSettings,
    pub(super) seed: u64,
    pub(super) shape: DqnShape,
    network: Perceptron,
    pub(super) adam: Adam,
    target: Perceptron,
    pub(super) target_variables: Variables,
    /// The replay buffer, the oldest transition first.
    pub(super) memory: VecDeque<Transition>,
}

struct Perceptron(Vec<Linear>);

struct Batch {
    input: Tensor,
    action: Tensor,
    reward: Tensor,
    next: Tensor,
    discount: Tensor,
}

impl Perceptron {
    /// Creates the layers, named as in `torch.nn.Sequential`.
    fn new(vb: &VarBuilder<'_>, sizes: [usize; 4]) -> CandleResult<Self> {
        let layers = sizes.windows(2).enumerate().map(|(index, sizes)| {
            let (vb, init) = (vb.pp(2 * index), uniform_init(sizes[0]));
            let weight = vb.get_with_hints((sizes[1], sizes[0]), "weight", init)?;
            let bias = vb.get_with_hints(sizes[1], "bias", init)?;
            Ok(Linear::new(weight, Some(bias)))
        });
        layers.collect::<CandleResult<_>>().map(Self)
    }

    fn forward(&self, input: &Tensor) -> CandleResult<Tensor> {
        let (last, hidden) = self.0.split_last().expect("invariant: three layers");
        let x = hidden
            .iter()
            .try_fold(input.clone(), |x, layer| layer.forward(&x)?.relu())?;
        last.forward(&x)
    }
}

impl Dqn {
    /// Creates a learner. The target network has the same initial variables as the network.
    pub fn new(settings: DqnSettings, shape: DqnShape, seed: u64) -> Self {
        let sizes = [
            shape.n_inputs,
            settings.width,
            settings.width,
            shape.n_outputs,
        ];
        let perceptron = |vb: VarBuilder<'_>| Perceptron::new(&vb, sizes);
        // Initial values depend only on the seed and the names, so both networks start equal.
        let made = || on_cpu(build(seed, DType::F32, &Device::Cpu, perceptron));
        let ((network, variables), (target, target_variables)) = (made(), made());
        Self {
            settings,
            seed,
            shape,
            network,
            adam: on_cpu(Adam::new(variables)),
            target,
            target_variables,
            memory: VecDeque::new(),
        }
    }

    /// Returns the settings, with the current learning rate.
    pub fn settings(&self) -> &DqnSettings {
        &self.settings
    }

    /// Returns the number of updates so far.
    pub fn n_updates(&self) -> u64 {
        self.adam.steps()
    }

    /// Returns the replay buffer, the oldest transition first.
    pub fn remembered(&self) -> &VecDeque<Transition> {
        &self.memory
    }

    /// Sets the learning rate.
    pub fn set_learning_rate(&mut self, learning_rate: f32) {
        self.settings.adam.learning_rate = learning_rate;
    }

    /// Computes the value of each choice of a decision, `Q(h, .)`.
    ///
    /// # Panics
    /// If `input` has the wrong length.
    pub fn values(&self, input: &[f32]) -> Vec<f32> {
        assert_eq!(
            input.len(),
            self.shape.n_numbers(),
            "input: expected the DQN's number of inputs"
        );
        let values = Tensor::from_slice(input, (1, input.len()), &Device::Cpu)
            .and_then(|input| self.choices(&self.network, &input)?.squeeze(0)?.to_vec1());
        on_cpu(values)
    }

    /// Computes the values of all choices, `[N, n_choices]`, from the inputs of N decisions.
    fn choices(&self, network: &Perceptron, input: &Tensor) -> CandleResult<Tensor> {
        let n = input.dim(0)?;
        let input = input.reshape((n * self.shape.n_candidates, self.shape.n_inputs))?;
        network
            .forward(&input)?
            .reshape((n, self.shape.n_choices()))
    }

    /// Returns the choice with the largest value.
    pub fn best(&self, input: &[f32]) -> usize {
        let values = self.values(input);
        let larger = |best: usize, at: usize| if values[at] > values[best] { at } else { best };
        (0..values.len()).fold(0, larger)
    }

    /// Returns a random choice with the probability [`DqnSettings::epsilon_at`], and otherwise the best choice.
    pub fn act(&self, input: &[f32], step: u64) -> usize {
        let mut rng = stream(self.seed, Purpose::Exploration, step);
        if uniform(&mut rng) < self.settings.epsilon_at(step) {
            (rng.next_u64() % self.shape.n_choices() as u64) as usize
        } else {
            self.best(input)
        }
    }

    /// Returns an empty track, which combines steps into transitions of [`DqnSettings::n_step`] steps.
    pub fn track(&self) -> Track {
        Track::new(self.settings.n_step)
    }

    /// Returns the discount of the next state's value: 0 if the episode terminated, otherwise gamma. After a truncated
    /// episode, the next state's value still counts, because the world continues.
    pub fn discount(&self, is_terminated: bool) -> f32 {
        if is_terminated {
            0.0
        } else {
            self.settings.gamma
        }
    }

    /// Adds a transition to the replay buffer. Removes the oldest if the buffer is full.
    ///
    /// # Panics
    /// If the transition has the wrong number of inputs or an invalid action.
    pub fn remember(&mut self, transition: Transition) {
        assert!(
            self.fits(&transition),
            "transition: expected the DQN's inputs and actions"
        );
        self.memory.push_back(transition);
        if self.memory.len() > self.settings.replay {
            self.memory.pop_front();
        }
    }

    /// Performs one step of Adam on a random batch, then updates the target network. Returns the loss before the step,
    /// or `None` if there are fewer transitions than a batch.
    ///
    /// # Errors
    /// [`NetworkError`] if a value is not finite. The DQN is then unchanged.
    pub fn update(&mut self) -> Result<Option<f32>, NetworkError> {
        if self.memory.len() < self.settings.batch.max(1) {
            return Ok(None);
        }
        let mut rng = stream(self.seed, Purpose::Replay, self.n_updates());
        let ages = std::iter::repeat_with(|| rng.next_u64() % self.memory.len() as u64);
        let rows = ages.map(|age| &self.memory[age as usize]);
        let batch = Batch::new(rows.take(self.settings.batch), self.shape)?;
        self.learn_batch(&batch).map(Some)
    }

    /// Performs an update as [`Self::update`] does, but on a given batch (eqs. 19 and 21).
    ///
    /// # Errors
    /// [`NetworkError`] if a value is not finite. The DQN is then unchanged.
    pub fn learn(&mut self, batch: &[Transition]) -> Result<f32, NetworkError> {
        let batch = Batch::new(batch.iter(), self.shape)?;
        self.learn_batch(&batch)
    }

    fn learn_batch(&mut self, batch: &Batch) -> Result<f32, NetworkError> {
        let loss = self.loss(batch)?;
        let settings = &self.settings.adam;
        let loss = self
            .adam
            .update_with(settings, &loss, Vec::new(), "dqn.network.")?;
        let tau = f64::from(self.settings.tau);
        for (name, target) in &self.target_variables {
            let (now, old) = (&self.adam.variables()[name], target.as_detached_tensor());
            let towards = ((now.as_detached_tensor() - &old)? * tau)?;
            target.set(&(old + towards)?)?;
        }
        Ok(loss)
    }

    /// Computes the mean of `(Q(h, a) - (r + discount Q'(h', a')))^2`, or of its Huber loss.
    fn loss(&self, batch: &Batch) -> CandleResult<Tensor> {
        let after = self.choices(&self.target, &batch.next)?.detach();
        let judge = if self.settings.double {
            self.choices(&self.network, &batch.next)?.detach()
        } else {
            after.clone()
        };
        let next = after.gather(&judge.argmax_keepdim(1)?, 1)?;
        let goal = (&batch.reward + (next * &batch.discount)?)?;
        let values = self.network.forward(&batch.input)?;
        let values = values.gather(&batch.action, 1)?;
        if self.settings.huber {
            huber(&values, &goal)
        } else {
            mse(&values, &goal)
        }
    }

    /// The input must contain the features of one candidate, and the next input the features of all candidates.
    fn fits(&self, transition: &Transition) -> bool {
        transition.input.len() == self.shape.n_inputs
            && transition.next.len() == self.shape.n_numbers()
            && transition.action < self.shape.n_outputs
    }
}

impl Batch {
    fn new<'a>(rows: impl Iterator<Item = &'a Transition>, shape: DqnShape) -> CandleResult<Self> {
        let rows: Vec<&Transition> = rows.collect();
        let vectors = |vector: fn(&&'a Transition) -> &'a [f32], length: usize| {
            let numbers: Vec<f32> = rows.iter().flat_map(vector).copied().collect();
            Tensor::from_vec(numbers, (rows.len(), length), &Device::Cpu)
        };
        let column = |number: fn(&&'a Transition) -> f32| {
            let numbers: Vec<f32> = rows.iter().map(number).collect();
            Tensor::new(numbers, &Device::Cpu)?.unsqueeze(1)
        };
        let actions: Vec<u32> = rows.iter().map(|row| row.action as u32).collect();
        Ok(Self {
            input: vectors(|row| &row.input, shape.n_inputs)?,
            next: vectors(|row| &row.next, shape.n_numbers())?,
            action: Tensor::new(actions, &Device::Cpu)?.unsqueeze(1)?,
            reward: column(|row| row.reward)?,
            discount: column(|row| row.discount)?,
        })
    }
}

fn huber(got: &Tensor, goal: &Tensor) -> CandleResult<Tensor> {
    let size = (got - goal)?.abs()?;
    let near = size.minimum(1.0)?;
    (&near * (&size - (&near * 0.5)?)?)?.mean_all()
}

/// Unwraps the result of an operation that cannot fail, because it runs on the CPU and the sizes of tensors are known.
pub(super) fn on_cpu<T>(result: CandleResult<T>) -> T {
    result.expect("invariant: sizes fit, and the CPU does not fail")
}
