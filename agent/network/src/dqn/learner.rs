//! The DQN itself: values of actions, and its updates.

use super::track::{Track, Transition};
use crate::adam::{Adam, AdamSettings};
use crate::error::NetworkError;
use crate::tensors::named;
use crate::variables::{Variables, build, uniform, uniform_init};
use candle_core::{DType, Device, Result as CandleResult, Tensor};
use candle_nn::loss::mse;
use candle_nn::{Linear, Module, VarBuilder};
use emberwatch_model::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::fmt;

/// Settings of the learner, as in files; there the optimiser has none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DqnSettings {
    /// Transitions remembered.
    pub replay: usize,
    /// Transitions an update learns from.
    pub batch: usize,
    /// Discount per step.
    pub gamma: f32,
    /// Steps that a transition spans, fewer at the end of an episode, see [`Track`].
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
    /// Whether an error of more than 1 counts by its size (Huber's loss), not by its square.
    pub huber: bool,
    /// Width of both hidden layers.
    pub width: usize,
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
            huber: false,
            width: 128,
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

/// What a decision is made on, and among.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DqnShape {
    /// Numbers that the network reads at once.
    pub n_inputs: usize,
    /// Values that it gives for them.
    pub n_outputs: usize,
    /// How often it reads for a decision: once, or for each candidate its own numbers.
    pub n_candidates: usize,
}

impl DqnShape {
    /// One vector, of which the network gives the value of each action.
    pub fn of_actions(n_inputs: usize, n_actions: usize) -> Self {
        Self {
            n_inputs,
            n_outputs: n_actions,
            n_candidates: 1,
        }
    }

    /// Candidates, each with numbers of its own, of which the network gives the candidate's value.
    pub const fn of_candidates(n_inputs: usize, n_candidates: usize) -> Self {
        Self {
            n_inputs,
            n_outputs: 1,
            n_candidates,
        }
    }

    /// Numbers that a decision is made on.
    pub fn n_numbers(&self) -> usize {
        self.n_inputs * self.n_candidates
    }

    /// Choices of a decision.
    pub fn n_choices(&self) -> usize {
        self.n_outputs * self.n_candidates
    }
}

/// Values of actions, learned from transitions.
pub struct Dqn {
    pub(super) settings: DqnSettings,
    pub(super) seed: u64,
    pub(super) shape: DqnShape,
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
    discount: Tensor,
}

impl Perceptron {
    /// Named as the layers of `torch.nn.Sequential`.
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
    /// A learner whose target starts equal.
    pub fn new(settings: DqnSettings, shape: DqnShape, seed: u64) -> Self {
        let sizes = [
            shape.n_inputs,
            settings.width,
            settings.width,
            shape.n_outputs,
        ];
        let perceptron = |vb: VarBuilder<'_>| Perceptron::new(&vb, sizes);
        // First values depend on the seed and names alone.
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

    /// The value of each choice of a decision, `Q(h, .)`.
    ///
    /// # Panics
    /// If `input` has another length.
    pub fn values(&self, input: &[f32]) -> Vec<f32> {
        assert_eq!(input.len(), self.shape.n_numbers(), "numbers of the input");
        let values = Tensor::from_slice(input, (1, input.len()), &Device::Cpu)
            .and_then(|input| self.choices(&self.network, &input)?.squeeze(0)?.to_vec1());
        on_cpu(values)
    }

    /// Values of all choices, `[N, n_choices]`, from the numbers of N decisions.
    fn choices(&self, network: &Perceptron, input: &Tensor) -> CandleResult<Tensor> {
        let n = input.dim(0)?;
        let input = input.reshape((n * self.shape.n_candidates, self.shape.n_inputs))?;
        network
            .forward(&input)?
            .reshape((n, self.shape.n_choices()))
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
        if uniform(&mut rng) < self.settings.epsilon_at(step) {
            (rng.next_u64() % self.shape.n_choices() as u64) as usize
        } else {
            self.best(input)
        }
    }

    /// Makes transitions of [`DqnSettings::n_step`] steps out of the single steps of an episode.
    pub fn track(&self) -> Track {
        Track::new(self.settings.n_step)
    }

    /// Factor on the value of what follows one step: nothing follows the end of an episode that terminated. What
    /// follows a truncated episode counts, because the world continues.
    pub fn discount(&self, is_terminated: bool) -> f32 {
        if is_terminated {
            0.0
        } else {
            self.settings.gamma
        }
    }

    /// Remembers a transition, and forgets the oldest if there are too many.
    ///
    /// # Panics
    /// If it has other numbers of inputs or an action that there is not.
    pub fn remember(&mut self, transition: Transition) {
        assert!(self.fits(&transition), "transition: numbers or action");
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
        let batch = Batch::new(rows.take(self.settings.batch), self.shape)?;
        self.learn_batch(&batch).map(Some)
    }

    /// [`Self::update`] on a given batch (eqs. 19 and 21).
    ///
    /// # Errors
    /// [`NetworkError`] for a number that is not finite; nothing has changed then.
    pub fn learn(&mut self, batch: &[Transition]) -> Result<f32, NetworkError> {
        let batch = Batch::new(batch.iter(), self.shape)?;
        self.learn_batch(&batch)
    }

    fn learn_batch(&mut self, batch: &Batch) -> Result<f32, NetworkError> {
        let targets = [("dqn.target.", &self.target_variables)];
        let known: Vec<_> = batch.named().into_iter().chain(named(&targets)).collect();
        let loss = self.loss(batch)?;
        self.adam.checked(&known, &loss)?;
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

    /// The mean of `(Q(h, a) - (r + discount Q'(h', a')))^2`, or of its Huber loss.
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

    /// Whether a transition is of such decisions: an input is of one candidate, what follows of all.
    pub(super) fn fits(&self, transition: &Transition) -> bool {
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

    fn named(&self) -> [(String, &Tensor); 4] {
        [
            ("dqn.replay.input".into(), &self.input),
            ("dqn.replay.next".into(), &self.next),
            ("dqn.replay.reward".into(), &self.reward),
            ("dqn.replay.discount".into(), &self.discount),
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

/// The mean of half the squared differences, which grow linearly from 1 on.
fn huber(got: &Tensor, goal: &Tensor) -> CandleResult<Tensor> {
    let size = (got - goal)?.abs()?;
    let near = size.minimum(1.0)?;
    (&near * (&size - (&near * 0.5)?)?)?.mean_all()
}

/// What candle gives for tensors of known sizes on the CPU.
pub(super) fn on_cpu<T>(result: CandleResult<T>) -> T {
    result.expect("invariant: sizes fit, and the CPU does not fail")
}
