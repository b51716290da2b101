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
use emberwatch_network::{Device, Dqn, DqnSettings, NeuralBelief, Transition};

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

fn dimensions() -> Dimensions {
    Dimensions {
        n_states: 3,
        n_observations: 3,
        kernel: (3, 3),
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
    let config = config();
    FilterFit::new(dimensions(), worlds().shape(), &config).learned()
}

#[test]
fn decisions_continue_from_what_was_learned() {
    let mut config = config();
    let decisions = &mut config.decisions;
    (decisions.learning.batch, decisions.updates_per_step) = (4, 1.0);
    let neural = |filter: Option<LearnedModel>| {
        let mut learned = Learned::default();
        learned.put(NeuralModel {
            network: NeuralBelief::new(3, 1, &Device::Cpu).expect("a network"),
            filter: filter.map(Box::new),
            target: 1,
        });
        learned
    };
    let filter = || {
        let mut learned = Learned::default();
        learned.put(learned_filter());
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

/// Flies an episode in which the reward of a step is its number, and begins the next one.
fn fly_episode(learner: &mut impl Learner, (n_steps, is_terminated): (u64, bool)) {
    learner.start_episode(0, observation(0)).expect("possible");
    for step in 1..=n_steps {
        learner.plan();
        let mut seen = observation(step);
        seen.robot.reward = step as f64;
        seen.world.truncated = u16::from(step == n_steps && !is_terminated);
        seen.world.terminated = u16::from(step == n_steps && is_terminated);
        learner
            .see(vec![AgentObservation::new([seen])])
            .expect("possible");
        learner.predict();
    }
    learner.start_episode(0, observation(0)).expect("possible");
}

/// Lengths of episodes, and whether they are terminated. Others are truncated.
const EPISODES: [(u64, bool); 5] = [(1, true), (3, false), (4, true), (6, false), (6, true)];

/// Checks the transitions of `fly_episode`, which sum up the rewards of `n_step` steps.
fn check_transitions(
    dqn: &Dqn,
    (n_steps, is_terminated): (u64, bool),
    learning: &DqnSettings,
    scale: f32,
) {
    let (gamma, n) = (learning.gamma, learning.n_step as u64);
    let got: Vec<&Transition> = dqn.remembered().iter().collect();
    assert_eq!(got.len() as u64, n_steps);
    for (first, got) in (1..).zip(&got) {
        let last = n_steps.min(first + n - 1);
        let rewards = (first..=last).rev().map(|step| step as f32 * scale);
        let reward = rewards.fold(0.0, |sum, reward| reward + gamma * sum);
        assert!((got.reward - reward).abs() < 1e-4 * reward, "{n_steps}");
        let ends = last == n_steps && is_terminated;
        let discount = gamma.powi((last + 1 - first) as i32);
        let discount = if ends { 0.0 } else { discount };
        assert!((got.discount - discount).abs() < 1e-6, "{n_steps}");
    }
    // The transitions of the last steps all lead to the same state.
    let short = &got[got.len().saturating_sub(learning.n_step)..];
    assert!(short.iter().all(|it| it.next == short[0].next));
}

#[test]
fn decisions_learn_from_every_step_of_an_episode() {
    let mut config = config();
    config.decisions.learning.n_step = 4;
    let scale = config.decisions.reward_scale / worlds().n_moves as f32;
    for episode in EPISODES {
        let learner = DecisionsLearner::new(known_base(), None, worlds(), &config);
        let mut learner = learner.expect("new");
        fly_episode(&mut learner, episode);
        check_transitions(&learner.dqn, episode, &config.decisions.learning, scale);
    }
}

#[test]
fn the_network_learns_from_every_step_of_an_episode() {
    let mut config = config();
    config.dqn.learning.n_step = 4;
    for episode in EPISODES {
        let progress = Progress::first(&worlds().form(), &config, &Device::Cpu);
        let mut learner = NetworkLearner::new(progress.expect("a network"), worlds(), &config);
        fly_episode(&mut learner, episode);
        check_transitions(&learner.progress.dqn, episode, &config.dqn.learning, 1.0);
    }
}

/// Checks that the step size falls linearly over 10 steps, to a fifth of `rate`. `rate_of` returns an update's step
/// size.
fn check_rates(mut learner: impl Learner, rate: f64, rate_of: fn(&ModelUpdate) -> Option<f64>) {
    learner.start_episode(0, observation(0)).expect("possible");
    let mut rates = Vec::new();
    for step in 1..14 {
        take_step(&mut learner, step);
        for update in learner.learn().expect("finite") {
            let expected = rate * (1.0 - step as f64 / 10.0).max(0.2);
            let got = rate_of(&update).expect("a step size");
            assert!((got - expected).abs() < 1e-6 * rate, "{step}: {got}");
            rates.push(got);
        }
    }
    assert!(rates[0] > 0.5 * rate && rates[rates.len() - 1] < 0.3 * rate);
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
    let refused = |contents: &Contents, worlds: Worlds, words: &str| {
        let learner = neural(Some(contents), None, worlds).map(drop);
        let error = learner.expect_err(words).to_string();
        assert!(error.starts_with(words), "{error}");
    };
    let mut two = worlds();
    two.n_observations = 2;
    refused(&left, two, "n_observations: expected 2, got 3");
    let mut without = left.clone();
    without.tensors.remove("head.bias");
    let words = "head.bias: expected a tensor of shape [3], got none";
    refused(&without, worlds(), words);
    let mut squares = left.clone();
    let tensor = squares.tensors.get_mut("adam.second.head.bias");
    tensor.expect("a moment").numbers[0] = -1.0;
    let words = "adam.second.head.bias: expected no negative numbers, got -1";
    refused(&squares, worlds(), words);
    let cut = Contents {
        state: left.state[..left.state.len() - 1].to_vec(),
        ..left
    };
    refused(&cut, worlds(), "state: expected");
}
