//! What a resumed run needs of the DQN: tensors by name out, and in again.

use super::memory::{Memory, Row};
use super::{Dqn, Perceptron, on_cpu};
use crate::error::NetworkError;
use crate::tensors::{NamedTensor, named, restored};
use candle_core::Tensor;
use candle_nn::Linear;

/// Where the actions of the replay are.
const ACTION: &str = "dqn.replay.action";

impl Dqn {
    /// Everything that a resumed run needs but settings, seed and [`Self::n_updates`]: the network and its
    /// target by PyTorch's names, Adam's moments, and the replay, the oldest transition first.
    pub fn named_tensors(&self) -> Vec<NamedTensor> {
        let networks = self.network_tensors().chain(self.target_tensors());
        let mut all = on_cpu(named(networks.chain(self.adam.tensors("dqn.adam"))));
        let rows = || self.memory.rows();
        let (n, n_inputs) = (self.memory.len(), self.n_inputs);
        let vectors = |vector: fn(&Row<'_>) -> Vec<f32>| rows().flat_map(move |row| vector(&row));
        let mut add = |name: &str, dims: Vec<usize>, numbers: Vec<f32>| {
            all.push((name.to_owned(), dims, numbers));
        };
        let input = vectors(|row| row.input.to_vec()).collect();
        add("dqn.replay.input", vec![n, n_inputs], input);
        add(
            ACTION,
            vec![n],
            rows().map(|row| row.action as f32).collect(),
        );
        add(
            "dqn.replay.reward",
            vec![n],
            rows().map(|row| row.reward).collect(),
        );
        let next = vectors(|row| row.next.to_vec()).collect();
        add("dqn.replay.next", vec![n, n_inputs], next);
        all
    }

    /// Takes over what [`Self::named_tensors`] gave, of a DQN of the same inputs and actions with so many
    /// transitions, after so many updates: from here on, it learns as that one would have, bit for bit. Of a
    /// longer replay the latest transitions stay. `find` gives the numbers of a name and shape.
    ///
    /// # Errors
    /// As of `find`, or for an action that there is not; nothing has changed then.
    pub fn load<E: From<NetworkError>>(
        &mut self,
        find: impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
        n_remembered: usize,
        n_updates: u64,
    ) -> Result<(), E> {
        let variables = self.network_tensors();
        let variables = variables.map(|(name, tensor)| restored(&name, tensor, &find));
        let variables = variables.collect::<Result<Vec<_>, E>>()?;
        let target = self.target_from(&find)?;
        let moments = self.adam.found("dqn.adam", &find)?;
        self.memory = self.memory_from(&find, n_remembered)?;
        for (var, tensor) in self.variables.values().zip(&variables) {
            var.set(tensor).map_err(NetworkError::from)?;
        }
        self.target = target;
        self.adam.restore(moments, n_updates);
        self.n_updates = n_updates;
        Ok(())
    }

    pub(super) fn network_tensors(&self) -> impl Iterator<Item = (String, &Tensor)> {
        let variables = self.variables.iter();
        variables.map(|(name, var)| (format!("dqn.network.{name}"), var.as_tensor()))
    }

    pub(super) fn target_tensors(&self) -> impl Iterator<Item = (String, &Tensor)> {
        let layers = self.target.0.iter().enumerate();
        layers.flat_map(|(index, layer)| {
            let name = |what: &str| format!("dqn.target.{}.{what}", 2 * index);
            let bias = layer.bias().expect("invariant: a bias");
            [(name("weight"), layer.weight()), (name("bias"), bias)]
        })
    }

    fn target_from<E: From<NetworkError>>(
        &self,
        find: &impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
    ) -> Result<Perceptron, E> {
        let tensors = self.target_tensors();
        let tensors = tensors.map(|(name, tensor)| restored(&name, tensor, find));
        let tensors = tensors.collect::<Result<Vec<_>, E>>()?;
        let layers = tensors.chunks_exact(2);
        let layer = |pair: &[Tensor]| Linear::new(pair[0].clone(), Some(pair[1].clone()));
        Ok(Perceptron(layers.map(layer).collect()))
    }

    fn memory_from<E: From<NetworkError>>(
        &self,
        find: &impl Fn(&str, &[usize]) -> Result<Vec<f32>, E>,
        n: usize,
    ) -> Result<Memory, E> {
        let inputs = find("dqn.replay.input", &[n, self.n_inputs])?;
        let actions = find(ACTION, &[n])?;
        let rewards = find("dqn.replay.reward", &[n])?;
        let nexts = find("dqn.replay.next", &[n, self.n_inputs])?;
        let mut memory = Memory::new(self.settings.replay, self.n_inputs);
        for index in 0..n {
            let action = actions[index] as usize;
            if action >= self.n_actions || action as f32 != actions[index] {
                let (expected, got) = (self.n_actions, actions[index]);
                return Err(NetworkError::Action { expected, got }.into());
            }
            let range = index * self.n_inputs..(index + 1) * self.n_inputs;
            memory.push(Row {
                input: &inputs[range.clone()],
                action,
                reward: rewards[index],
                next: &nexts[range],
            });
        }
        Ok(memory)
    }
}
