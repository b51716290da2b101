//! What a resumed run needs of the DQN: tensors by name out, and in again.

use super::memory::Row;
use super::{Dqn, Memory};
use crate::checkpoint::{Contents, Problem, Tensor};
use crate::network::perceptron::Perceptron;

/// Updates made, among a checkpoint's texts.
const UPDATES: &str = "dqn.updates";

/// One tensor: name, shape, numbers.
type Named = (String, Vec<usize>, Vec<f32>);

impl Dqn {
    /// Everything that a resumed run needs but settings, seed and [`Self::n_updates`]: the network and
    /// its target in PyTorch's layout, Adam's moments, and the replay, the oldest transition first.
    pub fn named_tensors(&self) -> Vec<Named> {
        let of_network = |numbers: &[f32], prefix: &str| -> Vec<Named> {
            let tensors = self.network.with_numbers(numbers).tensors().into_iter();
            tensors
                .map(|(name, dims, numbers)| (format!("{prefix}.{name}"), dims, numbers))
                .collect()
        };
        [
            of_network(&self.network.numbers, "dqn.network"),
            of_network(&self.target.numbers, "dqn.target"),
            of_network(&self.adam.first, "dqn.adam.first"),
            of_network(&self.adam.second, "dqn.adam.second"),
            self.replay_tensors(),
        ]
        .concat()
    }

    fn replay_tensors(&self) -> Vec<Named> {
        let n = self.memory.len();
        let rows = || self.memory.rows();
        let input = rows().flat_map(|row| row.input).copied().collect();
        let action = rows().map(|row| row.action as f32).collect();
        let reward = rows().map(|row| row.reward).collect();
        let next = rows().flat_map(|row| row.next).copied().collect();
        vec![
            ("dqn.replay.input".into(), vec![n, self.n_inputs], input),
            ("dqn.replay.action".into(), vec![n], action),
            ("dqn.replay.reward".into(), vec![n], reward),
            ("dqn.replay.next".into(), vec![n, self.n_inputs], next),
        ]
    }

    /// Adds [`Self::named_tensors`] and the number of updates to a checkpoint.
    pub fn save(&self, contents: &mut Contents) {
        for (name, shape, numbers) in self.named_tensors() {
            contents.tensors.insert(name, Tensor { shape, numbers });
        }
        let updates = self.n_updates.to_string();
        contents.texts.insert(UPDATES.into(), updates);
    }

    /// Takes over what [`Self::save`] gave, of a DQN of the same inputs and actions: from here on, it
    /// learns as that one would have, bit for bit. Of a longer replay the latest transitions stay.
    ///
    /// # Errors
    /// [`Problem`] names the tensor; nothing has changed then.
    pub fn load(&mut self, contents: &Contents) -> Result<(), Problem> {
        let network = |prefix: &str| -> Result<Perceptron, Problem> {
            self.network.with_tensors(|name, shape| {
                let numbers = contents.tensor(&format!("{prefix}.{name}"), shape)?;
                Ok(numbers.to_vec())
            })
        };
        let n_updates = contents.count(UPDATES)?;
        let (learnt, target) = (network("dqn.network")?, network("dqn.target")?);
        let [first, second] = [network("dqn.adam.first")?, network("dqn.adam.second")?];
        self.memory = self.memory_from(contents)?;
        (self.network, self.target) = (learnt, target);
        (self.adam.first, self.adam.second) = (first.numbers, second.numbers);
        (self.adam.step, self.n_updates) = (n_updates, n_updates);
        Ok(())
    }

    fn memory_from(&self, contents: &Contents) -> Result<Memory, Problem> {
        const ACTION: &str = "dqn.replay.action";
        let n = contents
            .tensors
            .get(ACTION)
            .map_or(0, |tensor| tensor.numbers.len());
        let inputs = contents.tensor("dqn.replay.input", &[n, self.n_inputs])?;
        let actions = contents.tensor(ACTION, &[n])?;
        let rewards = contents.tensor("dqn.replay.reward", &[n])?;
        let nexts = contents.tensor("dqn.replay.next", &[n, self.n_inputs])?;
        let mut memory = Memory::new(self.settings.replay, self.n_inputs);
        for index in 0..n {
            let range = index * self.n_inputs..(index + 1) * self.n_inputs;
            memory.push(Row {
                input: &inputs[range.clone()],
                action: self.action_from(ACTION, actions[index])?,
                reward: rewards[index],
                next: &nexts[range],
            });
        }
        Ok(memory)
    }

    fn action_from(&self, name: &str, number: f32) -> Result<usize, Problem> {
        let action = number as usize;
        match action < self.n_actions && action as f32 == number {
            true => Ok(action),
            false => Err(Problem::Value {
                name: name.into(),
                expected: format!("actions below {}", self.n_actions),
                got: number.to_string(),
            }),
        }
    }
}
