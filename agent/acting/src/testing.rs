//! Worlds, settings and learned models of unit tests.

use crate::beliefs::autoencoder::AutoencoderModel;
use crate::beliefs::learned::LearnedModel;
use crate::config::AgentConfig;
use emberwatch_belief::estimation::Correlations;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};
use emberwatch_model::Shape;
use emberwatch_network::{Autoencoder, Device, Dqn, DqnSettings, DqnShape, NetworkShape};
use std::sync::Arc;

pub fn shape() -> Shape {
    Shape::new(8, 9).expect("test shape")
}

pub fn config() -> AgentConfig {
    AgentConfig {
        beam_width: 8,
        shooting_samples: 64,
        ..AgentConfig::default()
    }
}

/// A filter with its initial parameters.
pub fn learned_filter() -> LearnedModel {
    let dimensions = Dimensions {
        n_states: 3,
        n_observations: 3,
        kernel: (3, 3),
    };
    let parameters = Parameters::first(dimensions, AgentConfig::default().seed);
    LearnedModel::new(parameters, 2, Correlations::default())
}

/// An untrained network. The seed of its DQN is the lowest seed with which the DQN satisfies the condition `suits`.
pub fn network(suits: impl Fn(&Dqn) -> bool) -> AutoencoderModel {
    let settings = config().autoencoder.settings();
    let shape = NetworkShape {
        grid: shape(),
        n_states: 3,
        n_observations: 3,
        encoding: settings.encoding,
        hidden: settings.hidden,
    };
    let autoencoder = Autoencoder::new(settings, shape, 1, &Device::Cpu).expect("a network");
    let actions = DqnShape::of_actions(settings.hidden, 4);
    let dqn = |seed| Dqn::new(DqnSettings::paper(), actions, seed);
    AutoencoderModel {
        autoencoder,
        dqn: Arc::new((0..1000).map(dqn).find(suits).expect("a seed that suits")),
        target: 2,
    }
}
