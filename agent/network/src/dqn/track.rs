//! Transitions, and n-step returns.

use std::collections::VecDeque;

/// A transition `(h, a, r, h')` of the replay buffer, with the discount of the value of `h'`.
#[derive(Debug, Clone, PartialEq)]
pub struct Transition {
    /// The input before the action. With several candidates, the features of the chosen candidate.
    pub input: Vec<f32>,
    /// The index of the action. With several candidates, it is always 0.
    pub action: usize,
    /// The reward.
    pub reward: f32,
    /// The input after the action. With several candidates, the features of all candidates.
    pub next: Vec<f32>,
    /// Factor on the value of `next`: `gamma` after one step, `gamma^m` after m steps, or 0 if the episode terminated.
    pub discount: f32,
}

/// The latest steps of one episode, whose n-step returns are still incomplete (Sutton and Barto, section 7.1).
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    n_step: usize,
    open: VecDeque<Transition>,
}

impl Track {
    pub(super) fn new(n_step: usize) -> Self {
        Self {
            n_step: n_step.max(1),
            open: VecDeque::new(),
        }
    }

    /// Adds the episode's next step. Returns the transition over `n` steps that this step completes, whose reward is
    /// `r_1 + gamma r_2 + ... + gamma^(n-1) r_n`. Returns `None` for the first `n - 1` steps.
    pub fn add(&mut self, step: Transition) -> Option<Transition> {
        self.open.push_back(step);
        if self.open.len() < self.n_step {
            return None;
        }
        self.complete()
    }

    /// Ends the episode. Returns the remaining transitions, which span fewer than `n` steps and end at the last state.
    pub fn end(&mut self) -> Vec<Transition> {
        std::iter::from_fn(|| self.complete()).collect()
    }

    fn complete(&mut self) -> Option<Transition> {
        let next = self.open.back()?.next.clone();
        let later = self.open.iter().rev();
        let reward = later.fold(0.0, |sum, step| step.reward + step.discount * sum);
        let discounts = self.open.iter().map(|step| f64::from(step.discount));
        let discount = discounts.product::<f64>() as f32;
        Some(Transition {
            reward,
            next,
            discount,
            ..self.open.pop_front()?
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
            discount: 0.5,
        }
    }

    /// Creates a transition over `n_steps` steps from the step `first`.
    fn over(first: u8, reward: f32, n_steps: u8, discount: f32) -> Transition {
        Transition {
            reward,
            next: vec![f32::from(first + n_steps)],
            discount,
            ..step(first)
        }
    }

    #[test]
    fn a_short_episode_has_one_transition_per_step() {
        // The returns are 4 + 5 / 2 + 6 / 4, 5 + 6 / 2 and 6. All end at the last state, 7.
        let last = [
            over(4, 8.0, 3, 0.125),
            over(5, 8.0, 2, 0.25),
            over(6, 6.0, 1, 0.5),
        ];
        for n_steps in 1..=3 {
            let mut track = Track::new(4);
            let steps = 7 - n_steps..7;
            assert!(steps.map(|at| track.add(step(at))).all(|it| it.is_none()));
            assert_eq!(track.end(), last[3 - usize::from(n_steps)..]);
        }
        let mut track = Track::new(3);
        let full: Vec<_> = (2..7).filter_map(|at| track.add(step(at))).collect();
        assert_eq!((full.len(), &full[2]), (3, &last[0]));
        assert_eq!(track.end(), last[1..]);
        assert_eq!((track.end(), track), (vec![], Track::new(3)));
    }

    #[test]
    fn discounts_are_exact_powers() {
        for (gamma, n) in [(0.97_f32, 4), (0.99, 3), (0.9, 8)] {
            let mut track = Track::new(n);
            let mut step = step(0);
            step.discount = gamma;
            let got = (0..n).find_map(|_| track.add(step.clone()));
            let expected = f64::from(gamma).powi(n as i32) as f32;
            assert_eq!(got.expect("n steps").discount, expected);
        }
    }
}
