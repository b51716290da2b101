//! Steps of agents that plan for one or more robots.

use emberwatch_acting::beliefs::Conditions;
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::policy::Policy;
use emberwatch_acting::rollout::building::agent;
use emberwatch_acting::rollout::{ActingAgent, Actor, AgentObservation};
use emberwatch_belief::Belief;
use emberwatch_messages::message::{RobotResult, WorldResult};
use emberwatch_messages::observation::Observation;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Cell, Frame, Model, Shape};

fn shape() -> Shape {
    Shape::new(8, 9).expect("test shape")
}

/// The observations of robots at the given cells of a made-up world.
fn seen(step: u64, cells: &[Cell]) -> AgentObservation {
    let mut frame = Frame::empty(shape());
    for cell in (0..72).filter(|cell| split_mix(step, *cell).is_multiple_of(4)) {
        frame.observe(cell as usize, (split_mix(step + 9, cell) % 3) as u8);
    }
    AgentObservation::new(cells.iter().map(|cell| {
        let (mut world, mut robot) = (WorldResult::default(), RobotResult::default());
        (world.step, robot.row, robot.col) = (step, cell.row as u32, cell.col as u32);
        let frame = frame.clone();
        Observation {
            world,
            robot,
            frame,
        }
    }))
}

/// An agent at the start of a made-up world, with robots at the given cells.
fn robot(policy: &str, cells: &[Cell]) -> ActingAgent {
    let model = Model::wildfire();
    let conditions = Conditions {
        model: Some(&model),
        shape: shape(),
        prior: Some(&Belief::uniform(3, shape())),
        learned: &Learned::default(),
    };
    let policy = Policy::named(policy, &model).expect("known");
    let agent = agent(&policy, &AgentConfig::default(), &conditions, 6, 7);
    ActingAgent::begun(agent.expect("an agent"), seen(0, cells)).expect("possible")
}

const CELLS: [Cell; 3] = [
    Cell { row: 0, col: 0 },
    Cell { row: 4, col: 4 },
    Cell { row: 7, col: 8 },
];

#[test]
fn missed_steps_equal_steps_with_empty_frames() {
    let [mut late, mut hovering] = [0; 2].map(|_| robot("known/beam/exploit", &CELLS[..1]));
    let empty = |step| {
        let mut seen = seen(step, &CELLS[..1]);
        seen.observation.frame = Frame::empty(shape());
        seen
    };
    for step in 1..4 {
        hovering.plan();
        hovering.see(empty(step)).expect("possible");
        hovering.agent.predict();
        if step < 3 {
            late.agent.predict();
        }
    }
    late.see(empty(3)).expect("possible");
    late.agent.predict();
    assert_eq!(late.agent.belief(), hovering.agent.belief());
    assert_eq!(late.observation(), hovering.observation());
    assert_eq!(late.plan(), hovering.plan());
}

#[test]
fn a_step_is_scored_before_its_correction() {
    let mut acting = robot("known/beam/exploit", &CELLS[..1]);
    acting.plan();
    let seen = seen(1, &CELLS[..1]);
    let expected = acting.agent.score(&seen.observation.frame);
    let got = acting.see(seen.clone()).expect("possible").score;
    assert!(got.is_some() && got == expected);
    let after = acting.agent.score(&seen.observation.frame);
    assert!(after.expect("a filter").log_likelihood > got.expect("a score").log_likelihood);
}

#[test]
fn agents_together_act_as_each_agent_alone() {
    let new = || {
        vec![
            robot("known/beam/exploit", &CELLS[..2]),
            robot("known/beam/exploit", &CELLS[2..]),
        ]
    };
    let (mut together, mut alone) = (new(), new());
    for step in 1..4 {
        let paths = together.plan();
        let of_each = alone.iter_mut().flat_map(ActingAgent::plan);
        assert_eq!(paths, of_each.map(|plan| plan.moves).collect::<Vec<_>>());
        let sights = || [seen(step, &CELLS[..2]), seen(step + 50, &CELLS[2..])];
        together.see(sights().into()).expect("possible");
        together.predict();
        for (agent, seen) in alone.iter_mut().zip(sights()) {
            agent.see(seen).expect("possible");
            agent.agent.predict();
        }
        for (one, other) in together.iter().zip(&alone) {
            assert_eq!(one.agent.belief(), other.agent.belief());
            assert_eq!(one.step(), other.step());
        }
    }
}

#[test]
fn the_first_robot_of_a_team_flies_as_it_would_alone() {
    for policy in [
        "known/beam/exploit",
        "shooting",
        "random_walk",
        "known/options/exploit_ahead_3",
    ] {
        let mut alone = robot(policy, &CELLS[..1]);
        let mut team = robot(policy, &CELLS);
        let (own, of_team) = (alone.plan(), team.plan());
        assert_eq!((own.len(), of_team.len()), (1, 3), "{policy}");
        // Both agents have the same belief, so the team's agent finds the same path if it plans for its first robot
        // only.
        let first = team.agent.plan(&CELLS[..1], team.step());
        assert_eq!(own, first, "{policy}");
    }
}
