//! The DQN of paper section III.E (eqs. 16 to 21): which objective the next path is for.
//!
//! Its input is the autoencoder's hidden vector, or any other summary of the belief. A transition is
//! never terminal: episodes are cut off, the world goes on.

mod input;
mod learning;
mod memory;
mod state;
mod track;

pub use input::DqnInput;
pub use track::Track;

use super::adam::{Adam, AdamSettings};
use super::autoencoder::NotFinite;
use super::lanes::{Arithmetic, Kernel, dispatch};
use super::parameters::uniform;
use super::perceptron::{Batch, Perceptron};
use learning::{Learn, Workspace};
use memory::{Memory, Row};
use protocol::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use serde::{Deserialize, Serialize};

/// Width of both hidden layers, as in the authors' code.
const WIDTH: usize = 128;

/// Settings of the learner.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
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
    /// The optimiser.
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
            adam: AdamSettings {
                betas: [0.9, 0.999],
                ..AdamSettings::paper(0.01)
            },
        }
    }

    /// Chance of a random action at a step.
    pub fn epsilon_at(&self, step: u64) -> f32 {
        let share = (step as f32 / self.epsilon_steps.max(1) as f32).min(1.0);
        self.epsilon + (self.epsilon_end - self.epsilon) * share
    }
}

/// One row `(h, a, r, h')` of the replay.
#[derive(Debug, Clone, PartialEq)]
pub struct Transition {
    /// Before.
    pub input: Vec<f32>,
    /// What was chosen.
    pub action: usize,
    /// What it brought.
    pub reward: f32,
    /// After.
    pub next: Vec<f32>,
}

/// Values of actions, learnt from transitions.
#[derive(Debug, Clone)]
pub struct Dqn {
    settings: DqnSettings,
    seed: u64,
    n_inputs: usize,
    n_actions: usize,
    network: Perceptron,
    target: Perceptron,
    adam: Adam,
    memory: Memory,
    n_updates: u64,
    workspace: Workspace,
}

impl Dqn {
    /// A learner over `n_inputs` numbers and `n_actions` actions; its target starts equal.
    pub fn new(settings: DqnSettings, n_inputs: usize, n_actions: usize, seed: u64) -> Self {
        let network = Perceptron::new(&[n_inputs, WIDTH, WIDTH, n_actions], seed);
        Self {
            settings,
            seed,
            n_inputs,
            n_actions,
            target: network.clone(),
            adam: Adam::new(network.numbers.len()),
            network,
            memory: Memory::new(settings.replay, n_inputs),
            n_updates: 0,
            workspace: Workspace::default(),
        }
    }

    /// Settings, with the present step size.
    pub fn settings(&self) -> &DqnSettings {
        &self.settings
    }

    /// Updates so far.
    pub fn n_updates(&self) -> u64 {
        self.n_updates
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
        let mut batch = Batch::default();
        batch.input.extend_from_slice(input);
        dispatch(Forward {
            network: &self.network,
            batch: &mut batch,
        });
        batch.values()[..self.n_actions].to_vec()
    }

    /// The action of the largest value.
    pub fn best(&self, input: &[f32]) -> usize {
        best(&self.values(input))
    }

    /// The best action, or with the chance of this step a random one.
    pub fn act(&self, input: &[f32], step: u64) -> usize {
        let mut rng = stream(self.seed, Purpose::Exploration, step);
        match uniform(&mut rng) < self.settings.epsilon_at(step) {
            true => (rng.next_u64() % self.n_actions as u64) as usize,
            false => best(&self.values(input)),
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
        self.memory.push(Row::from(&transition));
    }

    /// One step of Adam on a random batch, then of the target; the loss before it, or `None` while there
    /// are fewer transitions than a batch.
    ///
    /// # Errors
    /// [`NotFinite`] for a number that is not; nothing has changed then.
    pub fn update(&mut self) -> Result<Option<f32>, NotFinite> {
        if self.memory.len() < self.settings.batch.max(1) {
            return Ok(None);
        }
        let mut rng = stream(self.seed, Purpose::Replay, self.n_updates);
        self.workspace.clear();
        for _ in 0..self.settings.batch {
            let age = (rng.next_u64() % self.memory.len() as u64) as usize;
            self.workspace.add(self.memory.row(age));
        }
        self.learn_workspace().map(Some)
    }

    /// [`Self::update`] on a given batch (eqs. 19 and 21).
    ///
    /// # Errors
    /// [`NotFinite`] for a number that is not; nothing has changed then.
    pub fn learn(&mut self, batch: &[Transition]) -> Result<f32, NotFinite> {
        self.workspace.clear();
        for transition in batch {
            self.workspace.add(Row::from(transition));
        }
        self.learn_workspace()
    }

    fn learn_workspace(&mut self) -> Result<f32, NotFinite> {
        let mut loss = Ok(0.0);
        dispatch(Learn {
            dqn: self,
            loss: &mut loss,
        });
        loss
    }

    /// The network's layers as PyTorch has them: name, shape, numbers.
    pub fn tensors(&self) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        self.network.tensors()
    }
}

/// The first of the largest values.
fn best(values: &[f32]) -> usize {
    let larger =
        |best: usize, (at, &value): (usize, &f32)| if value > values[best] { at } else { best };
    values.iter().enumerate().fold(0, larger)
}

struct Forward<'a> {
    network: &'a Perceptron,
    batch: &'a mut Batch,
}

impl Kernel for Forward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        self.network.forward::<A>(self.batch);
    }
}
