//! The DQN's replay: the latest transitions, in flat vectors.

use serde::{Deserialize, Serialize};

/// One row `(h, a, r, h')` of the replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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

/// Up to `capacity` transitions; the oldest gives way.
#[derive(Debug, Clone)]
pub(super) struct Memory {
    capacity: usize,
    n_inputs: usize,
    len: usize,
    /// Where the next transition goes: after the newest, so to the oldest once it is full.
    next_slot: usize,
    input: Vec<f32>,
    next: Vec<f32>,
    action: Vec<usize>,
    reward: Vec<f32>,
}

/// One transition of a [`Memory`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Row<'a> {
    pub(super) input: &'a [f32],
    pub(super) action: usize,
    pub(super) reward: f32,
    pub(super) next: &'a [f32],
}

impl<'a> From<&'a Transition> for Row<'a> {
    fn from(transition: &'a Transition) -> Self {
        Self {
            input: &transition.input,
            action: transition.action,
            reward: transition.reward,
            next: &transition.next,
        }
    }
}

impl From<Row<'_>> for Transition {
    fn from(row: Row<'_>) -> Self {
        Self {
            input: row.input.to_vec(),
            action: row.action,
            reward: row.reward,
            next: row.next.to_vec(),
        }
    }
}

impl Memory {
    pub(super) fn new(capacity: usize, n_inputs: usize) -> Self {
        Self {
            capacity,
            n_inputs,
            len: 0,
            next_slot: 0,
            input: Vec::new(),
            next: Vec::new(),
            action: Vec::new(),
            reward: Vec::new(),
        }
    }

    pub(super) fn len(&self) -> usize {
        self.len
    }

    pub(super) fn push(&mut self, row: Row<'_>) {
        assert_eq!(row.input.len(), self.n_inputs, "transition: numbers before");
        assert_eq!(row.next.len(), self.n_inputs, "transition: numbers after");
        if self.len < self.capacity {
            self.len += 1;
            self.input.extend(row.input);
            self.next.extend(row.next);
            self.action.push(row.action);
            self.reward.push(row.reward);
        } else if self.capacity > 0 {
            let range = self.range(self.next_slot);
            self.input[range.clone()].copy_from_slice(row.input);
            self.next[range].copy_from_slice(row.next);
            self.action[self.next_slot] = row.action;
            self.reward[self.next_slot] = row.reward;
        }
        self.next_slot = (self.next_slot + 1) % self.capacity.max(1);
    }

    /// A transition by age, the oldest first.
    pub(super) fn row(&self, age: usize) -> Row<'_> {
        let oldest = if self.len < self.capacity {
            0
        } else {
            self.next_slot
        };
        let slot = (oldest + age) % self.capacity;
        Row {
            input: &self.input[self.range(slot)],
            action: self.action[slot],
            reward: self.reward[slot],
            next: &self.next[self.range(slot)],
        }
    }

    /// All transitions, the oldest first.
    pub(super) fn rows(&self) -> impl Iterator<Item = Row<'_>> {
        (0..self.len).map(|age| self.row(age))
    }

    fn range(&self, slot: usize) -> std::ops::Range<usize> {
        slot * self.n_inputs..(slot + 1) * self.n_inputs
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latest_are_kept_oldest_first() {
        let mut memory = Memory::new(3, 2);
        for index in 0..8_u8 {
            let (first, second) = (f32::from(index), f32::from(index) + 0.5);
            memory.push(Row {
                input: &[first, second],
                action: usize::from(index),
                reward: -first,
                next: &[second, first],
            });
            let kept: Vec<usize> = memory.rows().map(|row| row.action).collect();
            let all: Vec<usize> = (0..=usize::from(index)).collect();
            assert_eq!(kept, all[all.len().saturating_sub(3)..]);
        }
        let row = memory.row(0);
        assert_eq!(
            (row.input, row.reward, row.next),
            (&[5.0, 5.5][..], -5.0, &[5.5, 5.0][..])
        );
    }
}
