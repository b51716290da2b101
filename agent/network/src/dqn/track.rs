//! Transitions, and those over several steps: from one world's steps in a row.

use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// One row `(h, a, r, h')` of the replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Transition {
    /// Before; of several candidates, the chosen one's numbers.
    pub input: Vec<f32>,
    /// What was chosen; of several candidates, 0.
    pub action: usize,
    /// What it brought.
    pub reward: f32,
    /// After; of several candidates, the numbers of each.
    pub next: Vec<f32>,
}

/// One world's latest steps. Where the world or its robot begins again, so does its track.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Track {
    pub(super) n_step: usize,
    pub(super) gamma: f32,
    /// Steps whose transition is not complete.
    pub(super) open: VecDeque<Transition>,
}

impl Track {
    /// A track without steps, whose transitions span `n_step` of them.
    pub(super) fn new(n_step: usize, gamma: f32) -> Self {
        Self {
            n_step: n_step.max(1),
            gamma,
            open: VecDeque::new(),
        }
    }

    /// Takes the next step; gives the transition that it completes: `n` steps from where the oldest
    /// began, with the reward `r_1 + gamma r_2 + ... + gamma^(n-1) r_n`. `None` for the first `n - 1`.
    pub fn add(&mut self, step: Transition) -> Option<Transition> {
        let next = step.next.clone();
        self.open.push_back(step);
        if self.open.len() < self.n_step {
            return None;
        }
        let later = self.open.iter().rev();
        let reward = later.fold(0.0, |sum, step| step.reward + self.gamma * sum);
        let first = self.open.pop_front()?;
        Some(Transition {
            reward,
            next,
            ..first
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(at: u8) -> Transition {
        let at = f32::from(at);
        Transition {
            input: vec![at],
            action: at as usize,
            reward: at,
            next: vec![at + 1.0],
        }
    }

    #[test]
    fn single_steps_pass_through() {
        let mut track = Track::new(1, 0.5);
        assert_eq!(track.add(step(3)), Some(step(3)));
        assert_eq!(track.add(step(4)), Some(step(4)));
    }

    #[test]
    fn three_steps_become_one_with_the_discounted_reward() {
        let mut track = Track::new(3, 0.5);
        assert_eq!([step(2), step(3)].map(|step| track.add(step)), [None, None]);
        for first in 2..6 {
            let [a, b, c] = [0, 1, 2].map(|later| f32::from(first + later));
            let expected = Transition {
                reward: a + 0.5 * b + 0.25 * c,
                next: vec![c + 1.0],
                ..step(first)
            };
            assert_eq!(track.add(step(first + 2)), Some(expected));
        }
    }
}
