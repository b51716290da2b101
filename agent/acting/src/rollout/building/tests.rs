//! Tests of the inputs of an agent's decisions.

use super::*;
use crate::beliefs::autoencoder::AutoencoderEstimator;
use crate::beliefs::{KNOWN, numbered_states};
use crate::policy::LearnedDecisions;
use crate::testing::{config, network, shape};
use anyhow::Result;
use emberwatch_belief::Belief;
use emberwatch_belief::estimation::Estimator;
use emberwatch_belief::planning::OPTIONS;
use emberwatch_belief::planning::options::N_FEATURES;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Cell, Frame, Model};
use emberwatch_network::{Dqn, DqnShape};
use std::sync::Arc;

const ROBOT: Cell = Cell { row: 4, col: 4 };

/// A frame that shows some cells of a made-up world.
fn frame() -> Frame {
    let mut frame = Frame::empty(shape());
    for cell in (0..72).filter(|cell| split_mix(100, *cell).is_multiple_of(4)) {
        frame.observe(cell as usize, (split_mix(0, cell / 3) % 3) as u8);
    }
    frame
}

fn agent(policy: &str, config: &AgentConfig, learned: &Learned) -> Result<Agent> {
    let model = Model::wildfire();
    let conditions = Conditions {
        model: Some(&model),
        shape: shape(),
        prior: Some(&Belief::uniform(3, shape())),
        learned,
    };
    let policy = Policy::named(policy, &model).expect("known");
    super::agent(&policy, config, &conditions, 6, 7)
}

/// A DQN that chooses options on the belief of a known model.
fn decisions() -> LearnedDecisions {
    let settings = config().decisions.settings();
    let shape = DqnShape::of_candidates(N_FEATURES, OPTIONS.len());
    LearnedDecisions {
        beam_width: 30,
        scorer: Arc::new(Dqn::new(settings, shape, 0)),
        belief: &KNOWN,
    }
}

#[test]
fn decisions_on_another_belief_are_refused() {
    let mut learned = Learned::default();
    learned.put(decisions());
    let error = agent("known+spatial/options/learned", &config(), &learned).err();
    let error = format!("{:#}", error.expect("decisions on another belief"));
    let words = "on the belief known+spatial, got decisions on known";
    assert!(error.contains(words), "{error}");
}

#[test]
fn decisions_use_the_beam_width_that_they_were_learned_with() {
    let mut config = config();
    let mut learned = Learned::default();
    learned.put(decisions());
    for (policy, is_learned) in [
        ("known/options/coverage", false),
        ("known/options/learned", true),
    ] {
        let [narrow, wide] = [1, 30].map(|width| {
            config.decisions.beam_width = width;
            let mut agent = agent(policy, &config, &learned).expect("an agent");
            agent.correct(&frame(), None).expect("possible");
            agent.predict();
            agent.plan(&[ROBOT], 0)
        });
        assert_eq!(narrow == wide, is_learned, "{policy}");
    }
}

#[test]
fn a_network_decides_from_the_hidden_vector_after_the_frame() {
    let learned = network(|_| true).autoencoder;
    let mut estimator = AutoencoderEstimator::new(&learned).expect("a network");
    let before = estimator.hidden().to_vec();
    estimator.correct(&frame()).expect("possible");
    let after = estimator.hidden().to_vec();
    let network = network(|dqn| dqn.best(&before) != dqn.best(&after));
    let best = network.dqn.best(&after);
    let config = config();
    let expected = network_choices(3)[best].objective(0).target;
    let mut learned = Learned::default();
    learned.put(network);
    let mut agent = agent("autoencoder/shooting/learned", &config, &learned).expect("an agent");
    agent.correct(&frame(), None).expect("possible");
    agent.predict();
    agent.plan(&[ROBOT], 0);
    let aim = agent.intent(std::time::Duration::ZERO).objective;
    assert_eq!(aim, expected.label(&numbered_states(3)));
}
