//! Tests of the transitions that learners remember, of step sizes, and of resuming from checkpoints.

use crate::checkpoint::Contents;
use crate::learners::decisions::{Base, DecisionsLearner, SavedDecisions};
use crate::learners::filter::fit::FilterFit;
use crate::learners::network::{NetworkLearner, Progress};
use crate::learners::neural::NeuralLearner;
use crate::learners::{Learner, ModelUpdate, Worlds};
use emberwatch_acting::beliefs::learned::LearnedModel;
use emberwatch_acting::beliefs::neural::NeuralModel;
use emberwatch_acting::beliefs::{KNOWN, LEARNED, LEARNED_SPATIAL, NEURAL};
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::rollout::AgentObservation;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::parameters::Dimensions;
use emberwatch_messages::message::{RobotResult, WorldResult};
use emberwatch_messages::observation::Observation;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Airspace, Frame, Model, Shape};
use emberwatch_network::{Device, Dqn, NeuralBelief};

pub(crate) fn worlds() -> Worlds {
    Worlds {
        airspace: Airspace::open(Shape::new(8, 9).expect("test shape")),
        n_observations: 3,
        n_moves: 6,
        numbers: 0..1,
    }
}

pub(crate) fn config() -> AgentConfig {
    AgentConfig {
        beam_width: 8,
        shooting_samples: 64,
        ..AgentConfig::default()
    }
}

fn observation(step: u64) -> Observation {
    let mut frame = Frame::empty(worlds().shape());
    for cell in 0..worlds().shape().n_cells() {
        let bits = split_mix(step, cell as u64);
        if bits.is_multiple_of(4) {
            frame.observe(cell, (bits >> 32) as u8 % 3);
        }
    }
    let (mut world, mut robot) = (WorldResult::default(), RobotResult::default());
    (world.step, robot.row, robot.col) = (step, 4, 4);
    Observation {
        world,
        robot,
        frame,
    }
}

fn take_step(learner: &mut impl Learner, step: u64) {
    learner.plan();
    let seen = vec![AgentObservation::new([observation(step)])];
    learner.see(seen).expect("possible");
    learner.predict();
}

/// A base with the known-model filter.
fn known_base() -> Base {
    let known = (Model::wildfire(), Belief::uniform(3, worlds().shape()));
    let base = Base::new(&KNOWN, Some(known), Learned::default(), worlds().shape());
    base.expect("a model")
}

/// Makes steps with updates. Returns the contents of a checkpoint afterwards.
fn learn(learner: &mut impl Learner, steps: std::ops::Range<u64>) -> Contents {
    for step in steps {
        take_step(learner, step);
        learner.learn().expect("finite");
    }
    learner.contents().expect("whole")
}

/// A filter with its initial parameters.
pub(crate) fn learned_filter() -> LearnedModel {
    let dimensions = Dimensions {
        n_states: 3,
        n_observations: 3,
        kernel: (3, 3),
    };
    FilterFit::new(dimensions, worlds().shape(), &config()).learned()
}

#[test]
fn decisions_continue_from_what_was_learned() {
    let mut config = config();
    let decisions = &mut config.decisions;
    (decisions.learning.batch, decisions.updates_per_step) = (4, 1.0);
    let filter = || {
        let mut learned = Learned::default();
        learned.put(learned_filter());
        learned
    };
    let neural = |filter: Option<LearnedModel>| {
        let mut learned = Learned::default();
        learned.put(NeuralModel {
            network: NeuralBelief::new(3, 1, &Device::Cpu).expect("a network"),
            filter: filter.map(Box::new),
            target: 1,
        });
        learned
    };
    for (kind, learned) in [
        (&LEARNED, filter()),
        (&LEARNED_SPATIAL, filter()),
        (&NEURAL, neural(None)),
        (&NEURAL, neural(Some(learned_filter()))),
    ] {
        let base = Base::new(kind, None, learned, worlds().shape()).expect("learned");
        let mut learner = DecisionsLearner::new(base, None, worlds(), &config).expect("new");
        learner.start_episode(0, observation(0)).expect("possible");
        let first = learner.contents().expect("whole");
        let left = learn(&mut learner, 1..12);
        assert!(left.tensors != first.tensors, "something was learned");
        let saved: SavedDecisions = left.state().expect("its state");
        let base = saved.base(&left, worlds().shape(), &Device::Cpu);
        let base = base.expect("whole").expect("a belief");
        let resumed = DecisionsLearner::new(base, Some(&left), worlds(), &config);
        let mut resumed = resumed.expect("its own");
        assert!(resumed.contents().expect("whole") == left, "{kind:?}");
        resumed.start_episode(0, observation(12)).expect("possible");
        learn(&mut resumed, 13..24);
        assert!(resumed.n_updates() > learner.n_updates(), "{kind:?}");
    }
}

/// Flies three steps, whose rewards are 1, 2 and 3, and begins the next episode.
fn fly_episode(learner: &mut impl Learner, is_terminated: bool) {
    learner.start_episode(0, observation(0)).expect("possible");
    for step in 1..=3 {
        learner.plan();
        let mut seen = observation(step);
        seen.robot.reward = step as f64;
        seen.world.truncated = u16::from(step == 3 && !is_terminated);
        seen.world.terminated = u16::from(step == 3 && is_terminated);
        let seen = vec![AgentObservation::new([seen])];
        learner.see(seen).expect("possible");
        learner.predict();
    }
    learner.start_episode(0, observation(0)).expect("possible");
}

/// Checks the transitions of `fly_episode`, which sum up the rewards of two steps with `gamma` = .5.
fn check_transitions(dqn: &Dqn, is_terminated: bool, scale: f32) {
    let got = dqn
        .remembered()
        .iter()
        .map(|it| (it.reward / scale, it.discount));
    let last = if is_terminated { [0.0; 2] } else { [0.25, 0.5] };
    let expected = [(2.0, 0.25), (3.5, last[0]), (3.0, last[1])];
    assert_eq!(got.len(), expected.len());
    for ((reward, discount), expected) in got.zip(expected) {
        assert!((reward - expected.0).abs() < 1e-4 && discount == expected.1);
    }
    // The transitions of the last steps lead to the same state.
    assert_eq!(dqn.remembered()[1].next, dqn.remembered()[2].next);
}

#[test]
fn decisions_and_the_network_learn_from_every_step_of_an_episode() {
    let mut config = config();
    for learning in [&mut config.decisions.learning, &mut config.dqn.learning] {
        (learning.n_step, learning.gamma) = (2, 0.5);
    }
    let scale = config.decisions.reward_scale / worlds().n_moves as f32;
    for is_terminated in [false, true] {
        let learner = DecisionsLearner::new(known_base(), None, worlds(), &config);
        let mut learner = learner.expect("new");
        fly_episode(&mut learner, is_terminated);
        check_transitions(&learner.dqn, is_terminated, scale);
        let progress = Progress::first(&worlds().form(), &config, &Device::Cpu);
        let mut learner = NetworkLearner::new(progress.expect("a network"), worlds(), &config);
        fly_episode(&mut learner, is_terminated);
        check_transitions(&learner.progress.dqn, is_terminated, 1.0);
    }
}

/// Checks that the step size falls linearly over 10 steps, to a fifth of `rate`. `rate_of` returns an update's step
/// size.
fn check_rates(mut learner: impl Learner, rate: f64, rate_of: fn(&ModelUpdate) -> Option<f64>) {
    learner.start_episode(0, observation(0)).expect("possible");
    for step in 1..14 {
        take_step(&mut learner, step);
        let updates = learner.learn().expect("finite");
        assert!(!updates.is_empty() || step < 5);
        for update in updates {
            let expected = rate * (1.0 - step as f64 / 10.0).max(0.2);
            let got = rate_of(&update).expect("a step size");
            assert!((got - expected).abs() < 1e-6 * rate, "{step}: {got}");
        }
    }
}

#[test]
fn step_sizes_fall_linearly_to_their_final_value() {
    let mut config = config();
    let decisions = &mut config.decisions;
    (decisions.learning.batch, decisions.updates_per_step) = (2, 1.0);
    (decisions.steps, decisions.final_rate) = (10, 0.2);
    decisions.learning.n_step = 1;
    let neural = &mut config.neural;
    (neural.batch, neural.updates_per_step) = (2, 1.0);
    (neural.steps, neural.final_rate) = (10, 0.2);
    let learner = DecisionsLearner::new(known_base(), None, worlds(), &config);
    let rate = config.decisions.rate.into();
    // The columns are the loss, the step size and epsilon.
    check_rates(learner.expect("new"), rate, |update| update.more[1]);
    let learner = NeuralLearner::new(None, None, worlds(), &config, &Device::Cpu);
    let rate = config.neural.rate;
    check_rates(learner.expect("new"), rate, |update| update.rate);
}

/// A learner of a neural belief that makes one update per step.
fn neural(
    contents: Option<&Contents>,
    filter: Option<&LearnedModel>,
    worlds: Worlds,
) -> anyhow::Result<NeuralLearner> {
    let mut config = config();
    config.neural.steps = 40;
    (config.neural.batch, config.neural.updates_per_step) = (4, 1.0);
    NeuralLearner::new(contents, filter, worlds, &config, &Device::Cpu)
}

#[test]
fn a_neural_belief_continues_from_what_was_learned() {
    let filter = learned_filter();
    for filter in [None, Some(&filter)] {
        let mut learner = neural(None, filter, worlds()).expect("new");
        learner.start_episode(0, observation(0)).expect("possible");
        let bias = |contents: &Contents| contents.tensors["head.bias"].clone();
        let before = bias(&learner.contents().expect("whole"));
        let left = learn(&mut learner, 1..12);
        assert!(bias(&left) != before, "something was learned");
        let mut resumed = neural(Some(&left), None, worlds()).expect("its own");
        assert!(resumed.contents().expect("whole") == left);
        resumed.start_episode(0, observation(12)).expect("possible");
        learn(&mut resumed, 13..16);
        assert_eq!((learner.n_updates(), resumed.n_updates()), (11, 14));
    }
}

#[test]
fn errors_name_what_does_not_fit_a_neural_belief() {
    let mut learner = neural(None, None, worlds()).expect("new");
    learner.start_episode(0, observation(0)).expect("possible");
    let left = learn(&mut learner, 1..5);
    let refused = |change: fn(&mut Contents, &mut Worlds), words: &str| {
        let (mut contents, mut worlds) = (left.clone(), worlds());
        change(&mut contents, &mut worlds);
        let learner = neural(Some(&contents), None, worlds).map(drop);
        let error = learner.expect_err(words).to_string();
        assert!(error.starts_with(words), "{error}");
    };
    let words = "n_observations: expected 2, got 3";
    refused(|_, worlds| worlds.n_observations = 2, words);
    let squares = |it: &mut Contents, _: &mut Worlds| {
        let tensor = it.tensors.get_mut("adam.second.head.bias");
        tensor.expect("a moment").numbers[0] = -1.0;
    };
    let words = "adam.second.head.bias: expected no negative numbers, got -1";
    refused(squares, words);
}
