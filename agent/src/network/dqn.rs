//! The DQN of paper section III.E (eqs. 16 to 21): which objective the next path is for.
//!
//! Its input is the autoencoder's hidden vector, or any other summary of the belief. A transition is
//! never terminal: episodes are cut off, the world goes on.

use super::adam::{Adam, AdamSettings};
use super::lanes::{Arithmetic, Kernel, dispatch};
use super::parameters::uniform;
use super::perceptron::{Activations, Perceptron};
use protocol::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

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
    n_actions: usize,
    network: Perceptron,
    target: Perceptron,
    adam: Adam,
    replay: VecDeque<Transition>,
    n_updates: u64,
}

impl Dqn {
    /// A learner over `n_inputs` numbers and `n_actions` actions; its target starts equal.
    pub fn new(settings: DqnSettings, n_inputs: usize, n_actions: usize, seed: u64) -> Self {
        let network = Perceptron::new(&[n_inputs, WIDTH, WIDTH, n_actions], seed);
        Self {
            settings,
            seed,
            n_actions,
            target: network.clone(),
            adam: Adam::new(network.numbers.len()),
            network,
            replay: VecDeque::with_capacity(settings.replay),
            n_updates: 0,
        }
    }

    /// The value of each action, `Q(h, .)`.
    pub fn values(&self, input: &[f32]) -> Vec<f32> {
        let mut values = outputs(&self.network, input);
        values.pop().expect("invariant: a layer")
    }

    /// Changes the step size.
    pub fn set_learning_rate(&mut self, learning_rate: f32) {
        self.settings.adam.learning_rate = learning_rate;
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

    /// Remembers a transition, and forgets the oldest if there are too many.
    pub fn remember(&mut self, transition: Transition) {
        if self.replay.len() == self.settings.replay {
            self.replay.pop_front();
        }
        self.replay.push_back(transition);
    }

    /// One step of Adam on a random batch, then of the target; the loss before it, or `None` while there
    /// are fewer transitions than a batch.
    pub fn update(&mut self) -> Option<f32> {
        if self.replay.len() < self.settings.batch {
            return None;
        }
        let mut rng = stream(self.seed, Purpose::Replay, self.n_updates);
        let mut pick = || (rng.next_u64() % self.replay.len() as u64) as usize;
        let batch: Vec<Transition> = (0..self.settings.batch)
            .map(|_| self.replay[pick()].clone())
            .collect();
        Some(self.learn(&batch))
    }

    /// [`Self::update`] on a given batch (eqs. 19 and 21).
    pub fn learn(&mut self, batch: &[Transition]) -> f32 {
        let targets = self.targets(batch);
        let inputs: Vec<f32> = batch.iter().flat_map(|row| row.input.clone()).collect();
        let activations = outputs(&self.network, &inputs);
        let values = activations.last().expect("invariant: a layer");
        let mut d_values = vec![0.0; values.len()];
        let mut loss = 0.0;
        for (index, (row, target)) in batch.iter().zip(targets).enumerate() {
            let at = index * self.n_actions + row.action;
            let error = values[at] - target;
            loss += error * error / batch.len() as f32;
            d_values[at] = 2.0 * error / batch.len() as f32;
        }
        let mut gradient = Vec::new();
        dispatch(Backward {
            network: &self.network,
            activations: &activations,
            d_values,
            gradient: &mut gradient,
        });
        let numbers = &mut self.network.numbers;
        self.adam.step(&self.settings.adam, numbers, &gradient);
        self.follow();
        self.n_updates += 1;
        loss
    }

    /// `r + gamma Q'(h', a')` of each transition.
    fn targets(&self, batch: &[Transition]) -> Vec<f32> {
        let next: Vec<f32> = batch.iter().flat_map(|row| row.next.clone()).collect();
        let of_target = outputs(&self.target, &next)
            .pop()
            .expect("invariant: a layer");
        let of_network = match self.settings.double {
            true => outputs(&self.network, &next).pop(),
            false => None,
        };
        let rows = 0..batch.len();
        let target = |row: usize| {
            let range = row * self.n_actions..(row + 1) * self.n_actions;
            let judge = of_network.as_ref().unwrap_or(&of_target);
            let action = best(&judge[range.clone()]);
            batch[row].reward + self.settings.gamma * of_target[range][action]
        };
        rows.map(target).collect()
    }

    /// Moves the target towards the network.
    fn follow(&mut self) {
        let tau = self.settings.tau;
        for (target, number) in self.target.numbers.iter_mut().zip(&self.network.numbers) {
            *target += tau * (number - *target);
        }
    }

    /// Updates so far.
    pub fn n_updates(&self) -> u64 {
        self.n_updates
    }

    /// Transitions remembered.
    pub fn n_transitions(&self) -> usize {
        self.replay.len()
    }

    /// Everything that a resumed run needs but settings, seed and counts: name, shape, numbers.
    pub fn named_tensors(&self) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let mut tensors = Vec::new();
        for (part, numbers) in [
            ("network", &self.network.numbers),
            ("target", &self.target.numbers),
            ("adam.first", &self.adam.first),
            ("adam.second", &self.adam.second),
        ] {
            let layers = self.network.with_numbers(numbers).tensors();
            let named = |(name, shape, numbers)| (format!("dqn.{part}.{name}"), shape, numbers);
            tensors.extend(layers.into_iter().map(named));
        }
        let rows = || self.replay.iter();
        let n = rows().len();
        let flat = |of: fn(&Transition) -> &[f32]| rows().flat_map(of).copied().collect();
        let n_inputs = self.network.ends(0)[0];
        let actions = rows().map(|row| row.action as f32).collect();
        let rewards = rows().map(|row| row.reward).collect();
        for (name, shape, numbers) in [
            ("input", vec![n, n_inputs], flat(|row| &row.input)),
            ("action", vec![n], actions),
            ("reward", vec![n], rewards),
            ("next", vec![n, n_inputs], flat(|row| &row.next)),
        ] {
            tensors.push((format!("dqn.replay.{name}"), shape, numbers));
        }
        tensors
    }

    /// Takes over what [`Self::named_tensors`] gave, of a learner of the same sizes. `numbers` finds those of
    /// a name and shape.
    ///
    /// # Errors
    /// As of `numbers`; nothing has changed then.
    pub fn load<E>(
        &mut self,
        numbers: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
        n_updates: u64,
        n_transitions: usize,
    ) -> Result<(), E> {
        let layers = |part: &str| {
            self.network
                .filled(|name, shape| numbers(&format!("dqn.{part}.{name}"), shape))
        };
        let [network, target] = [layers("network")?, layers("target")?];
        let [first, second] = [layers("adam.first")?, layers("adam.second")?];
        let n_inputs = self.network.ends(0)[0];
        let pairs = [n_transitions, n_inputs];
        let input = numbers("dqn.replay.input", &pairs)?;
        let next = numbers("dqn.replay.next", &pairs)?;
        let actions = numbers("dqn.replay.action", &[n_transitions])?;
        let rewards = numbers("dqn.replay.reward", &[n_transitions])?;
        let row = |index: usize| Transition {
            input: input[index * n_inputs..][..n_inputs].to_vec(),
            action: (actions[index] as usize).min(self.n_actions - 1),
            reward: rewards[index],
            next: next[index * n_inputs..][..n_inputs].to_vec(),
        };
        self.replay = (0..n_transitions).map(row).collect();
        (self.network, self.target) = (network, target);
        (self.adam.first, self.adam.second) = (first.numbers, second.numbers);
        (self.adam.step, self.n_updates) = (n_updates, n_updates);
        Ok(())
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

fn outputs(network: &Perceptron, inputs: &[f32]) -> Activations {
    let mut activations = Vec::new();
    dispatch(Forward {
        network,
        inputs,
        activations: &mut activations,
    });
    activations
}

struct Forward<'a> {
    network: &'a Perceptron,
    inputs: &'a [f32],
    activations: &'a mut Activations,
}

impl Kernel for Forward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        *self.activations = self.network.forward::<A>(self.inputs);
    }
}

struct Backward<'a> {
    network: &'a Perceptron,
    activations: &'a Activations,
    d_values: Vec<f32>,
    gradient: &'a mut Vec<f32>,
}

impl Kernel for Backward<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        *self.gradient = self.network.backward::<A>(self.activations, self.d_values);
    }
}
