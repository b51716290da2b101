//! Which belief learners plan on.

use crate::beliefs::learned::LearnedModel;
use crate::beliefs::neural::NeuralModel;
use crate::beliefs::{KNOWN, LEARNED, LEARNED_SPATIAL, NEURAL};
use crate::checkpoint::Contents;
use crate::config::AgentConfig;
use crate::learned::Learned;
use crate::learners::decisions::{Base, DecisionsLearner, SavedDecisions};
use crate::learners::filter::FilterLearner;
use crate::learners::filter::fit::FilterFit;
use crate::learners::network::{NetworkLearner, Progress};
use crate::learners::neural::NeuralLearner;
use crate::learners::{Learner, Learning, Saving, Worlds};
use crate::policy::{Policy, network_choices};
use crate::rollout::{Actor, Seen};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::parameters::Dimensions;
use emberwatch_belief::planning::{
    BasisKind, Memory, Objective, OptionPlanner, Outlook, PlanningProblem,
};
use emberwatch_messages::message::{RobotResult, WorldResult};
use emberwatch_messages::observation::Observation;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Airspace, Cell, Frame, Model, Move, Shape};
use emberwatch_network::{Device, NeuralBelief, Transition};

const ROBOT: Cell = Cell { row: 4, col: 4 };

fn worlds() -> Worlds {
    Worlds {
        airspace: Airspace::open(Shape::new(8, 9).expect("test shape")),
        n_observations: 3,
        n_moves: 6,
        numbers: 0..1,
    }
}

fn config(belief: BasisKind) -> AgentConfig {
    let mut config = AgentConfig {
        beam_width: 8,
        shooting_samples: 64,
        ..AgentConfig::default()
    };
    config.objective.belief = belief;
    config
}

fn observation(step: u64) -> Observation {
    let mut frame = Frame::empty(worlds().shape());
    for cell in 0..worlds().shape().n_cells() {
        let bits = split_mix(step, cell as u64);
        if bits.is_multiple_of(4) {
            frame.observe(cell, (bits >> 32) as u8 % 3);
        }
    }
    let (row, col) = (ROBOT.row as u32, ROBOT.col as u32);
    Observation {
        world: WorldResult {
            step,
            ..WorldResult::default()
        },
        robot: RobotResult {
            row,
            col,
            ..RobotResult::default()
        },
        frame,
    }
}

/// The path that a policy's planner finds for an objective.
fn path(
    config: &AgentConfig,
    policy: &Policy,
    objective: Objective,
    belief: &Belief,
    step: u64,
) -> Vec<Move> {
    let problem = PlanningProblem {
        start: ROBOT,
        n_moves: worlds().n_moves,
        values: &objective.values(belief),
        seed: config.planner_seed(0),
        step,
    };
    (policy.planner.build)(config).plan(&problem).moves
}

fn seen(step: u64) -> Seen {
    Seen::new([observation(step)])
}

/// One step: the path, and the posterior after its frame.
fn fly(learner: &mut impl Learner, step: u64) -> (Vec<Move>, Belief) {
    let path = learner.plan().remove(0);
    learner.see(vec![seen(step)]).expect("possible");
    let posterior = learner.rollout(0).agent.belief().clone();
    learner.predict();
    (path, posterior)
}

/// A frozen learner must plan on one of the beliefs. `paths`: what it may choose among on a belief, where
/// a state pays most, at a step.
fn check(
    mut learner: impl Learner,
    basis: BasisKind,
    paths: impl Fn(&Belief, usize, u64) -> Vec<Vec<Move>>,
) {
    learner.freeze();
    learner.attach(vec![observation(0)]).expect("possible");
    let (mut all, mut before) = ([true; 2], None);
    for step in 1..9 {
        let (path, estimate) = fly(&mut learner, step);
        let (predictor, target) = (learner.rollout(0).agent.belief(), learner.target());
        let now = [&estimate, predictor].map(|belief| paths(belief, target, step));
        let Some(paths) = before.replace(now) else {
            continue;
        };
        for (all, paths) in all.iter_mut().zip(&paths) {
            *all &= paths.contains(&path);
        }
    }
    let expected = match basis {
        BasisKind::Estimate => [true, false],
        BasisKind::Predictor => [false, true],
    };
    let policy = learner.rollout(0).agent.policy();
    assert_eq!(all, expected, "{policy:?}, {basis:?}");
}

#[test]
fn learners_plan_on_the_belief_that_settings_say() {
    for basis in [BasisKind::Predictor, BasisKind::Estimate] {
        let config = &config(basis);
        let dimensions = Dimensions {
            n_states: 3,
            n_observations: 3,
            kernel: (3, 3),
            sees_own_state: false,
            n_matrices: 1,
        };
        let learner = FilterLearner::new(dimensions, worlds(), config);
        let beam = |belief: &Belief, target: usize, step: u64| {
            let policy = Policy::exploiting(&LEARNED);
            let objective = policy.objective(target, config);
            vec![path(config, &policy, objective, belief, step)]
        };
        check(learner, basis, beam);
        let progress = Progress::first(&worlds(), config, &Device::Cpu);
        let learner = NetworkLearner::new(progress.expect("a network"), worlds(), config);
        check(learner, basis, |belief, _, step| {
            let choices = network_choices(3);
            let path =
                |choice: &Policy| path(config, choice, choice.objective(0, config), belief, step);
            choices.iter().map(path).collect()
        });
        let learner = NeuralLearner::new(None, None, worlds(), config, &Device::Cpu);
        check(learner.expect("a network"), basis, beam);
        let learner = DecisionsLearner::new(known_base(), None, worlds(), config).expect("new");
        // The robot remembers what every step showed, and never earns.
        let memory = |step: u64| {
            let mut memory = Memory::new(worlds().shape());
            (0..step).for_each(|step| {
                memory.see(&observation(step).frame);
                if step > 0 {
                    memory.earn(0.0, worlds().n_moves);
                }
            });
            memory
        };
        check(learner, basis, |belief, target, step| {
            let outlook = {
                let airspace = worlds().airspace;
                Outlook::new(
                    belief,
                    &airspace,
                    target,
                    &memory(step + 1),
                    worlds().n_moves,
                )
            };
            let mut planner = OptionPlanner::new(config.decisions.beam_width);
            let paths = planner.propose(&outlook, ROBOT).into_iter();
            paths.map(|proposal| proposal.plan.moves).collect()
        });
    }
}

/// The filter of a known model.
fn known_base() -> Base {
    let known = (Model::wildfire(), Belief::uniform(3, worlds().shape()));
    let base = Base::new(&KNOWN, Some(known), Learned::default(), worlds().shape());
    base.expect("a model")
}

/// What a checkpoint holds after so many steps in a row.
fn learn(learner: &mut impl Learner, steps: std::ops::Range<u64>) -> Contents {
    for step in steps {
        fly(learner, step);
        learner.learn().expect("finite");
    }
    learner.contents().expect("whole")
}

/// What a filter knows before it has learned.
fn learned_filter(sees_own_state: bool) -> LearnedModel {
    let dimensions = Dimensions {
        n_states: 3,
        n_observations: 3,
        kernel: (3, 3),
        sees_own_state,
        n_matrices: 1,
    };
    let config = config(BasisKind::Estimate);
    FilterFit::new(dimensions, worlds().shape(), &config).learned()
}

#[test]
fn decisions_resume_bit_for_bit() {
    let mut config = config(BasisKind::Estimate);
    (
        config.decisions.learning.batch,
        config.decisions.updates_per_step,
    ) = (4, 1.0);
    let network = NeuralBelief::new(3, 1, &Device::Cpu).expect("a network");
    let neural = |filter: Option<LearnedModel>| NeuralModel {
        network: network.clone(),
        filter: filter.map(Box::new),
        target: 1,
    };
    let learned = |put: &dyn Fn(&mut Learned) -> bool| {
        let mut learned = Learned::default();
        assert!(!put(&mut learned));
        learned
    };
    for (kind, learned) in [
        (&LEARNED, learned(&|it| it.put(learned_filter(true)))),
        (
            &LEARNED_SPATIAL,
            learned(&|it| it.put(learned_filter(false))),
        ),
        (&NEURAL, learned(&|it| it.put(neural(None)))),
        (
            &NEURAL,
            learned(&|it| it.put(neural(Some(learned_filter(false))))),
        ),
    ] {
        let base = Base::new(kind, None, learned, worlds().shape()).expect("learned");
        let mut learner = DecisionsLearner::new(base, None, worlds(), &config).expect("new");
        learner.attach(vec![observation(0)]).expect("possible");
        let left = learn(&mut learner, 1..20);
        let saved: SavedDecisions = left.state().expect("its state");
        let base = saved.base(&left, worlds().shape(), &Device::Cpu);
        let base = base.expect("whole").expect("a belief");
        let resumed = DecisionsLearner::new(base, Some(&left), worlds(), &config);
        let mut resumed = resumed.expect("its own");
        let n_gone_on = resumed.attach(vec![observation(19)]).expect("possible");
        assert_eq!(n_gone_on, 1);
        let contents = [&mut learner, &mut resumed].map(|learner| learn(learner, 20..40));
        assert!(
            contents[0] == contents[1] && learner.n_updates() > 20,
            "{kind:?}"
        );
    }
}

/// The transitions that decisions remember of one episode, which ended that way.
fn remembered(n_steps: u64, is_terminated: bool) -> Vec<Transition> {
    let config = config(BasisKind::Estimate);
    let mut learner = DecisionsLearner::new(known_base(), None, worlds(), &config).expect("new");
    learner.attach(vec![observation(0)]).expect("possible");
    for step in 1..=n_steps {
        learner.plan();
        let mut seen = observation(step);
        seen.robot.reward = step as f64;
        seen.world.truncated = u16::from(step == n_steps && !is_terminated);
        seen.world.terminated = u16::from(step == n_steps && is_terminated);
        learner.see(vec![Seen::new([seen])]).expect("possible");
        learner.predict();
    }
    learner.begin(0, observation(0)).expect("possible");
    let contents = learner.contents().expect("whole");
    contents
        .state::<SavedDecisions>()
        .expect("its state")
        .dqn
        .transitions
}

#[test]
fn decisions_learn_from_every_step_of_an_episode() {
    let decisions = config(BasisKind::Estimate).decisions;
    let (gamma, n) = (decisions.learning.gamma, decisions.learning.n_step as u64);
    assert_eq!(n, 4);
    let scale = decisions.reward_scale / worlds().n_moves as f32;
    for n_steps in [1, 3, 4, 5, 6] {
        for is_terminated in [false, true] {
            let got = remembered(n_steps, is_terminated);
            let expected = (1..=n_steps).map(|first| {
                let last = n_steps.min(first + n - 1);
                let reward = (first..=last)
                    .rev()
                    .fold(0.0, |sum, step| step as f32 * scale + gamma * sum);
                let is_last = last == n_steps && is_terminated;
                let discount = gamma.powi((last + 1 - first) as i32);
                (reward, if is_last { 0.0 } else { discount })
            });
            assert_eq!(got.len() as u64, n_steps);
            for (got, (reward, discount)) in got.iter().zip(expected) {
                assert!((got.reward - reward).abs() < 1e-4 * reward, "{n_steps}");
                assert!((got.discount - discount).abs() < 1e-6, "{n_steps}");
            }
            // Those of the last steps lead to the same state.
            let short = &got[got.len().saturating_sub(4)..];
            assert!(short.iter().all(|it| it.next == short[0].next));
        }
    }
}

/// A neural belief that learns at every step.
fn neural(
    contents: Option<&Contents>,
    filter: Option<&LearnedModel>,
    worlds: Worlds,
) -> anyhow::Result<NeuralLearner> {
    let mut config = config(BasisKind::Estimate);
    config.neural.steps = 40;
    (config.neural.batch, config.neural.updates_per_step) = (4, 1.0);
    NeuralLearner::new(contents, filter, worlds, &config, &Device::Cpu)
}

#[test]
fn a_neural_belief_resumes_bit_for_bit() {
    let filter = learned_filter(false);
    for filter in [None, Some(&filter)] {
        let mut learner = neural(None, filter, worlds()).expect("new");
        learner.attach(vec![observation(0)]).expect("possible");
        let left = learn(&mut learner, 1..20);
        let resumed = || neural(Some(&left), None, worlds()).expect("its own");
        let mut gone_on = resumed();
        let n_gone_on = gone_on.attach(vec![observation(19)]).expect("possible");
        assert_eq!(n_gone_on, 1);
        let contents = [&mut learner, &mut gone_on].map(|learner| learn(learner, 20..40));
        assert!(contents[0] == contents[1] && learner.n_updates() > 30);
        let mut elsewhere = resumed();
        let n_gone_on = elsewhere.attach(vec![observation(7)]).expect("possible");
        assert_eq!((n_gone_on, elsewhere.n_updates()), (0, 19));
    }
}

#[test]
fn what_does_not_fit_a_neural_belief_is_named() {
    let mut learner = neural(None, None, worlds()).expect("new");
    learner.attach(vec![observation(0)]).expect("possible");
    let left = learn(&mut learner, 1..5);
    let refused = |contents: &Contents, worlds: Worlds, words: &str| {
        let learner = neural(Some(contents), None, worlds).map(drop);
        let error = learner.expect_err(words).to_string();
        assert!(error.starts_with(words), "{error}");
    };
    let worlds_of_two = Worlds {
        n_observations: 2,
        ..worlds()
    };
    refused(&left, worlds_of_two, "n_observations: expected 2, got 3");
    let mut without = left.clone();
    without.tensors.remove("head.bias");
    refused(
        &without,
        worlds(),
        "head.bias: expected shape [3], got none",
    );
    let mut squares = left.clone();
    let tensor = squares.tensors.get_mut("adam.second.head.bias");
    tensor.expect("a moment").numbers[0] = -1.0;
    refused(
        &squares,
        worlds(),
        "adam.second.head.bias: expected numbers from 0 on, got -1",
    );
    let cut = Contents {
        state: left.state[..left.state.len() - 1].to_vec(),
        ..left
    };
    refused(&cut, worlds(), "state: expected");
}
