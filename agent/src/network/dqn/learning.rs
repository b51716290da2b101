//! One update of the DQN, on whichever vectors the CPU has (paper eqs. 19 and 21).

use super::memory::Row;
use super::{Dqn, best};
use crate::network::autoencoder::NotFinite;
use crate::network::lanes::{Arithmetic, Kernel, whole_lanes};
use crate::network::perceptron::Batch;

/// Room for an update: a batch by columns, and what is computed from it.
#[derive(Debug, Clone, Default)]
pub(super) struct Workspace {
    actions: Vec<usize>,
    rewards: Vec<f32>,
    /// The network before the action.
    before: Batch,
    /// The target after it.
    after: Batch,
    /// The network after it, which picks the action where the two differ.
    judge: Batch,
    gradient: Vec<f32>,
}

impl Workspace {
    pub(super) fn clear(&mut self) {
        self.actions.clear();
        self.rewards.clear();
        self.before.input.clear();
        self.after.input.clear();
    }

    pub(super) fn add(&mut self, row: Row<'_>) {
        self.actions.push(row.action);
        self.rewards.push(row.reward);
        self.before.input.extend_from_slice(row.input);
        self.after.input.extend_from_slice(row.next);
    }
}

/// An update on the batch that the workspace holds.
pub(super) struct Learn<'a> {
    pub(super) dqn: &'a mut Dqn,
    pub(super) loss: &'a mut Result<f32, NotFinite>,
}

impl Kernel for Learn<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        let dqn = self.dqn;
        dqn.evaluate::<A>();
        let loss = dqn.loss();
        let Workspace {
            before, gradient, ..
        } = &mut dqn.workspace;
        gradient.resize(dqn.network.numbers.len(), 0.0);
        dqn.network.backward::<A>(before, gradient);
        *self.loss = dqn.finite(loss);
        if self.loss.is_ok() {
            dqn.step();
        }
    }
}

impl Dqn {
    /// The values that the loss compares.
    #[inline(always)]
    fn evaluate<A: Arithmetic>(&mut self) {
        let Workspace {
            before,
            after,
            judge,
            ..
        } = &mut self.workspace;
        self.network.forward::<A>(before);
        self.target.forward::<A>(after);
        if self.settings.double {
            judge.input.clone_from(&after.input);
            self.network.forward::<A>(judge);
        }
    }

    /// The mean of `(Q(h, a) - (r + gamma^n Q'(h', a')))^2`; leaves its gradient with the batch.
    #[inline(always)]
    fn loss(&mut self) -> f32 {
        let row = whole_lanes(self.n_actions);
        let gamma = self.settings.gamma.powi(self.settings.n_step.max(1) as i32);
        let Workspace {
            actions,
            rewards,
            before,
            after,
            judge,
            ..
        } = &mut self.workspace;
        let judge = if self.settings.double { judge } else { &*after }.values();
        let mut errors = Vec::with_capacity(actions.len());
        for (index, (&action, reward)) in actions.iter().zip(rewards).enumerate() {
            let range = index * row..index * row + self.n_actions;
            let next = best(&judge[range.clone()]);
            let goal = *reward + gamma * after.values()[range.clone()][next];
            errors.push((range.start + action, before.values()[range][action] - goal));
        }
        let (mut loss, share) = (0.0, 1.0 / errors.len() as f32);
        let d_values = before.d_values();
        for (at, error) in errors {
            loss += error * error * share;
            d_values[at] = 2.0 * error * share;
        }
        loss
    }

    /// The loss, unless something is not finite: of causes the first.
    #[inline(always)]
    fn finite(&self, loss: f32) -> Result<f32, NotFinite> {
        let Workspace {
            rewards,
            before,
            after,
            gradient,
            ..
        } = &self.workspace;
        // ReLU makes zeros of what is not a number, so the loss alone would not tell.
        let all = [
            ("replay.input", &before.input),
            ("replay.next", &after.input),
            ("replay.reward", rewards),
            ("network", &self.network.numbers),
            ("target", &self.target.numbers),
            ("gradient", gradient),
        ];
        let broken = all.into_iter().find(|(_, numbers)| !all_finite(numbers));
        let tensor = match broken {
            None if loss.is_finite() => return Ok(loss),
            None => "loss".to_owned(),
            Some((what, numbers)) => self.tensor_in(what, numbers),
        };
        let update = self.n_updates;
        Err(NotFinite { update, tensor })
    }

    /// The tensor among a network's numbers that holds one that is not finite.
    fn tensor_in(&self, what: &str, numbers: &[f32]) -> String {
        let within = |what: &str| {
            let tensors = self.network.with_numbers(numbers).tensors().into_iter();
            let mut broken = tensors.filter(|(_, _, numbers)| !all_finite(numbers));
            let name = broken.next().map_or_else(String::new, |(name, ..)| name);
            format!("{what}{name}")
        };
        match what {
            "network" | "target" => within(&format!("dqn.{what}.")),
            "gradient" => within("gradient of dqn.network."),
            _ => format!("dqn.{what}"),
        }
    }

    /// One step of Adam, then of the target towards the network.
    #[inline(always)]
    fn step(&mut self) {
        let (numbers, gradient) = (&mut self.network.numbers, &self.workspace.gradient);
        self.adam.move_by(&self.settings.adam, numbers, gradient);
        let tau = self.settings.tau;
        for (target, number) in self.target.numbers.iter_mut().zip(numbers) {
            *target += tau * (*number - *target);
        }
        self.n_updates += 1;
    }
}

/// Whether every number is finite, without a branch per number.
#[inline(always)]
fn all_finite(numbers: &[f32]) -> bool {
    let broken = |number: &f32| u32::from(!number.is_finite());
    numbers
        .iter()
        .map(broken)
        .fold(0, |any, broken| any | broken)
        == 0
}
