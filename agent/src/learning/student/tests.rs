//! Which belief students plan on.

use crate::config::AgentConfig;
use crate::learning::student::decisions::{Decisions, DecisionsStudent};
use crate::learning::student::filter::FilterStudent;
use crate::learning::student::network::{NetworkStudent, Progress};
use crate::learning::student::{Student, Worlds};
use crate::policy::{EstimatorKind, PlannerKind, Policy};
use emberwatch_belief::estimation::BayesFilter;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::parameters::Dimensions;
use emberwatch_belief::planning::action::{Action, ActionSet};
use emberwatch_belief::planning::{BasisKind, Objective, PlanningProblem, Target};
use protocol::client::Observation;
use protocol::message::{RobotResult, WorldResult};
use protocol::randomness::split_mix;
use protocol::{Cell, Frame, Model, Move, Shape};

const ROBOT: Cell = Cell { row: 4, col: 4 };

fn worlds() -> Worlds {
    Worlds {
        shape: Shape::new(8, 9).expect("test shape"),
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
    let mut frame = Frame::empty(worlds().shape);
    for cell in 0..worlds().shape.n_cells() {
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

fn learned_beam() -> Policy {
    let target = Target::State(0);
    Policy::new(
        "learned_beam",
        EstimatorKind::Learned,
        PlannerKind::Beam,
        target,
    )
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
    config.planner(policy).plan(&problem).moves
}

/// One step: the path, and the posterior after its frame.
fn fly(student: &mut impl Student, step: u64) -> (Vec<Move>, Belief) {
    let path = student.plan().remove(0);
    student.see(vec![observation(step)]).expect("possible");
    let posterior = student.rollout(0).agent.belief().clone();
    student.predict();
    (path, posterior)
}

/// A frozen student must plan on one of the beliefs. `paths`: what it may choose among on a belief, where
/// a state pays most, at a step.
fn check(
    mut student: impl Student,
    basis: BasisKind,
    paths: impl Fn(&Belief, usize, u64) -> Vec<Vec<Move>>,
) {
    student.freeze();
    student.attach(vec![observation(0)]).expect("possible");
    let (mut all, mut before) = ([true; 2], None);
    for step in 1..9 {
        let (path, estimate) = fly(&mut student, step);
        let (predictor, target) = student.belief().expect("a belief");
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
    assert_eq!(all, expected, "{}, {basis:?}", student.kind());
}

#[test]
fn students_plan_on_the_belief_that_settings_say() {
    for basis in [BasisKind::Predictor, BasisKind::Estimate] {
        let config = &config(basis);
        let dimensions = Dimensions {
            n_states: 3,
            n_observations: 3,
            kernel: (3, 3),
            sees_own_state: false,
        };
        let student = FilterStudent::new(dimensions, worlds(), config);
        check(student, basis, |belief, target, step| {
            let policy = learned_beam();
            let objective = Objective {
                target: Target::State(target),
                ..config.objective(&policy)
            };
            vec![path(config, &policy, objective, belief, step)]
        });
        let progress = Progress::first(&worlds(), config, &::network::Device::Cpu);
        let student = NetworkStudent::new(progress.expect("a network"), worlds(), config);
        check(student, basis, |belief, _, step| {
            let choices = Policy::network_choices(3);
            let path = |choice| path(config, choice, config.objective(choice), belief, step);
            choices.iter().map(path).collect()
        });
        let model = Model::wildfire();
        let filter = BayesFilter::known(&model, Belief::uniform(3, worlds().shape)).expect("valid");
        let decisions = Decisions::first(&model, &config.decisions, 0);
        let student = DecisionsStudent::new(decisions, filter, &model, worlds(), config);
        let actions = ActionSet::beam(&model);
        let beam = learned_beam();
        check(student, basis, |belief, _, step| {
            let path = |action: &Action| {
                let random = (config.planner_seed(0), step);
                let mut planner = config.planner(&beam);
                let plans = action.plan(&mut *planner, belief, &[ROBOT], worlds().n_moves, random);
                plans[0].moves.clone()
            };
            actions.actions().iter().map(path).collect()
        });
    }
}
