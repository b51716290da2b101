//! What the DQN of Algorithm 1 sees when it chooses an action (paper eq. 17).

use crate::network::Autoencoder;
use crate::summary::{spread_summary, summary_length};
use protocol::Cell;
use serde::{Deserialize, Serialize};

/// What an action goes by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DqnInput {
    /// `h_{k+1}`, which has read the last frame.
    AfterFrame,
    /// `h_k`, which has read the frames before the last (eq. 17 as printed).
    BeforeFrame,
    /// A summary of the predictor, as the learner `decisions` sees it.
    Summary,
}

impl DqnInput {
    /// Its name in settings.
    pub fn label(self) -> &'static str {
        match self {
            Self::AfterFrame => "after_frame",
            Self::BeforeFrame => "before_frame",
            Self::Summary => "summary",
        }
    }

    /// How many numbers it is, with a hidden vector of a length.
    pub fn length(self, hidden: usize, n_states: usize) -> usize {
        match self {
            Self::AfterFrame | Self::BeforeFrame => hidden,
            Self::Summary => summary_length(n_states),
        }
    }

    /// The input after a frame was read.
    pub fn of(self, autoencoder: &Autoencoder, robot: Cell, n_moves: usize) -> Vec<f32> {
        match self {
            Self::AfterFrame => autoencoder.hidden().to_vec(),
            Self::BeforeFrame => autoencoder.hidden_before().to_vec(),
            Self::Summary => spread_summary(autoencoder.prediction(), robot, n_moves),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::AutoencoderSettings;
    use protocol::{Frame, Shape};

    #[test]
    fn inputs_are_the_vectors_before_and_after_the_frame_and_the_summary_of_the_predictor() {
        let shape = Shape::new(8, 6).expect("test shape");
        let mut network = Autoencoder::new(AutoencoderSettings::paper(), shape, 2, 3, 1);
        let robot = Cell { row: 2, col: 5 };
        let input = |network: &Autoencoder, input: DqnInput| {
            let numbers = input.of(network, robot, 4);
            assert_eq!(numbers.len(), input.length(4, 2), "{}", input.label());
            numbers
        };
        for cell in [3, 9] {
            let before = network.hidden().to_vec();
            let mut frame = Frame::empty(shape);
            frame.observe(cell, 1);
            network.step(&frame).expect("possible");
            assert_eq!(input(&network, DqnInput::BeforeFrame), before);
            assert_eq!(input(&network, DqnInput::AfterFrame), network.hidden());
            assert_ne!(before, network.hidden());
            let summary = input(&network, DqnInput::Summary);
            assert_eq!(summary[summary.len() - 1], 1.0, "the robot's column");
            let mean = network.prediction().probability(0).mean().expect("cells");
            assert!((summary[0] - mean.sqrt()).abs() < 1e-5);
        }
    }

    #[test]
    fn labels_are_the_names_in_settings() {
        for input in [
            DqnInput::AfterFrame,
            DqnInput::BeforeFrame,
            DqnInput::Summary,
        ] {
            let value = toml::Value::try_from(input).expect("a name");
            assert_eq!(value.as_str(), Some(input.label()));
        }
    }
}
