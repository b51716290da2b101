//! Which belief students plan on.

use crate::config::AgentConfig;
use crate::estimation::BayesFilter;
use crate::estimation::belief::Belief;
use crate::estimation::parameters::Dimensions;
use crate::learning::student::decisions::{Decisions, DecisionsStudent};
use crate::learning::student::filter::FilterStudent;
use crate::learning::student::network::{NetworkStudent, Progress};
use crate::learning::student::{Student, Worlds};
use crate::planning::BasisKind;
use crate::rollout::Robot;
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
        let progress = Progress::first(&worlds(), config, &::network::Device::Cpu);
        let model = Model::wildfire();
        let filter = BayesFilter::known(&model, Belief::uniform(3, worlds().shape)).expect("valid");
        let decisions = Decisions::first(&model, &config.decisions, 0);
        let students: [Box<dyn Student>; 3] = [
            Box::new(FilterStudent::new(dimensions, worlds(), config)),
            Box::new(NetworkStudent::new(
                progress.expect("a network"),
                worlds(),
                config,
            )),
            Box::new(DecisionsStudent::new(
                decisions,
                filter,
                &model,
                worlds(),
                config,
            )),
        ];
        for mut student in students {
            student.attach(vec![observation(0)]).expect("possible");
            for step in 1..4 {
                let mut n_looks = 0;
                let mut look = |_: usize, robot: &Robot| {
                    n_looks += 1;
                    assert_eq!(robot.agent.basis, basis);
                    // The one that its path was planned on.
                    let has_estimate = robot.agent.estimate().is_some();
                    assert_eq!(has_estimate, basis == BasisKind::Estimate);
                };
                let mut fly = |_: &[Vec<Move>]| Ok(vec![observation(step)]);
                student.step(&mut fly, &mut look).expect("possible");
                assert_eq!(n_looks, 1, "{}", student.kind());
            }
        }
    }
}
