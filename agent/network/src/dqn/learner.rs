//! The DQN itself: values of actions, and its updates.

use super::track::{Track, Transition};
use crate::adam::{Adam, AdamSettings};
use crate::error::NetworkError;
use crate::tensors::named;
use crate::variables::{Variables, build, uniform, uniform_init};
use candle_core::{DType, Device, Result as CandleResult, Tensor};
use candle_nn::loss::mse;
use candle_nn::{Linear, Module, VarBuilder};
use protocol::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::fmt;

/// Width of both hidden layers, as in the authors' code.
const WIDTH: usize = 128;

/// Settings of the learner, as in files; there the optimiser has none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DqnSettings {
    /// Transitions remembered.
    pub replay: usize,
    /// Transitions an update learns from.
    pub batch: usize,
    /// Discount.
    pub gamma: f32,
    /// Steps that a transition spans, see [`Track`]: what follows it is discounted by `gamma^n`.
    pub n_step: usize,
    /// Share of the network in its target after each update.
    pub tau: f32,
    /// Chance of a random action at the first step.
    pub epsilon: f32,
    /// Chance of a random action in the end.
    pub epsilon_end: f32,
    /// Steps from the one to the other, in a straight line.
    pub epsilon_steps: u64,
    /// Whether the network, and not its target, picks the action whose value the target gives.
    pub double: bool,
    /// The optimiser: by default the authors'.
    #[serde(skip, default = "adam")]
    pub adam: AdamSettings,
}

impl DqnSettings {
    /// What the authors ran.
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
            adam: adam(),
        }
    }

    /// The same with another step size.
    pub fn with_rate(mut self, learning_rate: f32) -> Self {
        self.adam.learning_rate = learning_rate;
        self
    }

    /// Chance of a random action at a step.
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

/// Values of actions, learned from transitions.
pub struct Dqn {
    pub(super) settings: DqnSettings,
    pub(super) seed: u64,
    pub(super) n_inputs: usize,
    pub(super) n_actions: usize,
    network: Perceptron,
    pub(super) adam: Adam,
    /// Follows the network slowly.
    target: Perceptron,
    pub(super) target_variables: Variables,
    /// The latest transitions, the oldest first.
    pub(super) memory: VecDeque<Transition>,
}

/// Linear layers with ReLU between them.
struct Perceptron(Vec<Linear>);

/// Transitions as tensors.
struct Batch {
    input: Tensor,
    action: Tensor,
    reward: Tensor,
    next: Tensor,
}

impl Perceptron {
    /// Named as the layers of `torch.nn.Sequential`.
    fn new(vb: &VarBuilder<'_>, n_inputs: usize, n_actions: usize) -> CandleResult<Self> {
        let sizes = [n_inputs, WIDTH, WIDTH, n_actions];
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
    /// A learner over `n_inputs` numbers and `n_actions` actions; its target starts equal.
    pub fn new(settings: DqnSettings, n_inputs: usize, n_actions: usize, seed: u64) -> Self {
        let perceptron = |vb: VarBuilder<'_>| Perceptron::new(&vb, n_inputs, n_actions);
        // First values depend on the seed and names alone.
        let made = || on_cpu(build(seed, DType::F32, &Device::Cpu, perceptron));
        let ((network, variables), (target, target_variables)) = (made(), made());
        Self {
            settings,
            seed,
            n_inputs,
            n_actions,
            network,
            adam: on_cpu(Adam::new(variables)),
            target,
            target_variables,
            memory: VecDeque::new(),
        }
    }

    /// Settings, with the present step size.
    pub fn settings(&self) -> &DqnSettings {
        &self.settings
    }

    /// Updates so far.
    pub fn n_updates(&self) -> u64 {
        self.adam.steps()
    }

    /// Transitions remembered.
    pub fn n_remembered(&self) -> usize {
        self.memory.len()
    }

    /// Changes the step size.
    pub fn set_learning_rate(&mut self, learning_rate: f32) {
        self.settings.adam.learning_rate = learning_rate;
    }

    /// The value of each action, `Q(h, .)`.
    ///
    /// # Panics
    /// If `input` has another length.
    pub fn values(&self, input: &[f32]) -> Vec<f32> {
        assert_eq!(input.len(), self.n_inputs, "numbers of the input");
        let values = Tensor::from_slice(input, (1, input.len()), &Device::Cpu)
            .and_then(|input| self.network.forward(&input)?.squeeze(0)?.to_vec1());
        on_cpu(values)
    }

    /// The action of the largest value.
    pub fn best(&self, input: &[f32]) -> usize {
        let values = self.values(input);
        let larger = |best: usize, at: usize| if values[at] > values[best] { at } else { best };
        (0..values.len()).fold(0, larger)
    }

    /// The best action, or with the chance of this step a random one.
    pub fn act(&self, input: &[f32], step: u64) -> usize {
        let mut rng = stream(self.seed, Purpose::Exploration, step);
        match uniform(&mut rng) < self.settings.epsilon_at(step) {
            true => (rng.next_u64() % self.n_actions as u64) as usize,
            false => self.best(input),
        }
    }

    /// Makes transitions of [`DqnSettings::n_step`] steps out of one world's single steps.
    pub fn track(&self) -> Track {
        Track::new(self.settings.n_step, self.settings.gamma)
    }

    /// Remembers a transition, and forgets the oldest if there are too many.
    ///
    /// # Panics
    /// If it has other numbers of inputs or an action that there is not.
    pub fn remember(&mut self, transition: Transition) {
        assert!(transition.action < self.n_actions, "transition: action");
        for vector in [&transition.input, &transition.next] {
            assert_eq!(vector.len(), self.n_inputs, "transition: numbers");
        }
        self.memory.push_back(transition);
        if self.memory.len() > self.settings.replay {
            self.memory.pop_front();
        }
    }

    /// One step of Adam on a random batch, then of the target; the loss before it, or `None` while there
    /// are fewer transitions than a batch.
    ///
    /// # Errors
    /// [`NetworkError`] for a number that is not finite; nothing has changed then.
    pub fn update(&mut self) -> Result<Option<f32>, NetworkError> {
        if self.memory.len() < self.settings.batch.max(1) {
            return Ok(None);
        }
        let mut rng = stream(self.seed, Purpose::Replay, self.n_updates());
        let ages = std::iter::repeat_with(|| rng.next_u64() % self.memory.len() as u64);
        let rows = ages.map(|age| &self.memory[age as usize]);
        let batch = Batch::new(rows.take(self.settings.batch), self.n_inputs)?;
        self.learn_batch(&batch).map(Some)
    }

    /// [`Self::update`] on a given batch (eqs. 19 and 21).
    ///
    /// # Errors
    /// [`NetworkError`] for a number that is not finite; nothing has changed then.
    pub fn learn(&mut self, batch: &[Transition]) -> Result<f32, NetworkError> {
        let batch = Batch::new(batch.iter(), self.n_inputs)?;
        self.learn_batch(&batch)
    }

    fn learn_batch(&mut self, batch: &Batch) -> Result<f32, NetworkError> {
        let targets = [("dqn.target.", &self.target_variables)];
        let known = batch.named().into_iter().chain(named(&targets));
        self.adam.check(known)?;
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

    /// The mean of `(Q(h, a) - (r + gamma^n Q'(h', a')))^2`.
    fn loss(&self, batch: &Batch) -> CandleResult<Tensor> {
        let after = self.target.forward(&batch.next)?.detach();
        let judge = match self.settings.double {
            true => self.network.forward(&batch.next)?.detach(),
            false => after.clone(),
        };
        let next = after.gather(&judge.argmax_keepdim(1)?, 1)?;
        let gamma = f64::from(self.settings.gamma).powi(self.settings.n_step.max(1) as i32);
        let goal = (&batch.reward + (next * gamma)?)?;
        let values = self.network.forward(&batch.input)?;
        mse(&values.gather(&batch.action, 1)?, &goal)
    }
}

impl Batch {
    fn new<'a>(rows: impl Iterator<Item = &'a Transition>, n_inputs: usize) -> CandleResult<Self> {
        let rows: Vec<&Transition> = rows.collect();
        let vectors = |vector: fn(&&'a Transition) -> &'a [f32]| {
            let numbers: Vec<f32> = rows.iter().flat_map(vector).copied().collect();
            Tensor::from_vec(numbers, (rows.len(), n_inputs), &Device::Cpu)
        };
        let actions: Vec<u32> = rows.iter().map(|row| row.action as u32).collect();
        let rewards: Vec<f32> = rows.iter().map(|row| row.reward).collect();
        Ok(Self {
            input: vectors(|row| &row.input)?,
            next: vectors(|row| &row.next)?,
            action: Tensor::new(actions, &Device::Cpu)?.unsqueeze(1)?,
            reward: Tensor::new(rewards, &Device::Cpu)?.unsqueeze(1)?,
        })
    }

    fn named(&self) -> [(String, &Tensor); 3] {
        [
            ("dqn.replay.input".into(), &self.input),
            ("dqn.replay.next".into(), &self.next),
            ("dqn.replay.reward".into(), &self.reward),
        ]
    }
}

impl fmt::Debug for Dqn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut debug = f.debug_struct("Dqn");
        debug.field("settings", &self.settings);
        debug.field("n_updates", &self.n_updates());
        debug.finish_non_exhaustive()
    }
}

/// What candle gives for tensors of known sizes on the CPU.
pub(super) fn on_cpu<T>(result: CandleResult<T>) -> T {
    result.expect("invariant: sizes fit, and the CPU does not fail")
}
