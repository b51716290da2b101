//! What the DQN of Algorithm 1 sees when it chooses an action (paper eq. 17).

use emberwatch_belief::Belief;
use emberwatch_belief::estimation::summary::{spread_summary, summary_length};
use protocol::Cell;
use serde::{Deserialize, Serialize};

/// What an action goes by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DqnInput {
    /// `h_{k+1}`, which has read the last frame.
    AfterFrame,
    /// A summary of the predictor, as the learner `decisions` sees it.
    Summary,
}

impl DqnInput {
    pub fn label(self) -> &'static str {
        match self {
            Self::AfterFrame => "after_frame",
            Self::Summary => "summary",
        }
    }

    /// How many numbers it is, with a hidden vector of a length.
    pub fn length(self, hidden: usize, n_states: usize) -> usize {
        match self {
            Self::AfterFrame => hidden,
            Self::Summary => summary_length(n_states),
        }
    }

    /// The input after a frame was read.
    pub fn of(self, hidden: &[f32], predictor: &Belief, robot: Cell, n_moves: usize) -> Vec<f32> {
        match self {
            Self::AfterFrame => hidden.to_vec(),
            Self::Summary => spread_summary(predictor, robot, n_moves),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::Shape;

    #[test]
    fn inputs_are_the_hidden_vector_and_the_summary_of_the_predictor() {
        let shape = Shape::new(8, 6).expect("test shape");
        let (hidden, belief) = ([0.5, -1.0, 2.0, 0.0], Belief::uniform(2, shape));
        let robot = Cell { row: 2, col: 5 };
        for input in [DqnInput::AfterFrame, DqnInput::Summary] {
            let numbers = input.of(&hidden, &belief, robot, 4);
            assert_eq!(numbers.len(), input.length(4, 2), "{}", input.label());
        }
        let after = DqnInput::AfterFrame.of(&hidden, &belief, robot, 4);
        assert_eq!(after, hidden);
        let summary = DqnInput::Summary.of(&hidden, &belief, robot, 4);
        assert_eq!(summary[summary.len() - 1], 1.0, "the robot's column");
        assert!((summary[0] - 0.5_f32.sqrt()).abs() < 1e-5);
    }

    #[test]
    fn labels_are_the_names_in_settings() {
        for input in [DqnInput::AfterFrame, DqnInput::Summary] {
            let value = toml::Value::try_from(input).expect("a name");
            assert_eq!(value.as_str(), Some(input.label()));
        }
    }
}
