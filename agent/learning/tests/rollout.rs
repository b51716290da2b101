//! The step of agents that plan for one robot or several.

use emberwatch_belief::Belief;
use emberwatch_learning::beliefs::Conditions;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::policy::Policy;
use emberwatch_learning::rollout::building::agent;
use emberwatch_learning::rollout::{Actor, Rollout, Seen};
use emberwatch_messages::message::{RobotResult, WorldResult};
use emberwatch_messages::observation::Observation;
use emberwatch_model::path::fly;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Cell, Frame, Model, Move, Shape};

const N_MOVES: usize = 6;

fn shape() -> Shape {
    Shape::new(8, 9).expect("test shape")
}

/// What robots see of a made-up world at a step: each the cells that it flew over, in the frame of all.
fn seen(step: u64, flights: &[(Cell, &[Move])]) -> Seen {
    let mut frame = Frame::empty(shape());
    let mut robot = |&(start, path): &(Cell, &[Move])| {
        let flight = fly(shape(), start, path);
        for &cell in &flight.visited {
            frame.observe(cell, (split_mix(step, cell as u64) % 3) as u8);
        }
        RobotResult {
            n_visited: flight.visited.len() as u32,
            row: flight.end.row as u32,
            col: flight.end.col as u32,
            ..RobotResult::default()
        }
    };
    let robots: Vec<RobotResult> = flights.iter().map(&mut robot).collect();
    let world = WorldResult {
        step,
        ..WorldResult::default()
    };
    Seen::new(robots.into_iter().map(|robot| Observation {
        world,
        robot,
        frame: frame.clone(),
    }))
}

/// An agent at the start of a made-up world, with robots at these cells.
fn robot(policy: &str, cells: &[Cell]) -> Rollout {
    let model = Model::wildfire();
    let conditions = Conditions {
        model: Some(&model),
        shape: shape(),
        prior: Some(&Belief::uniform(3, shape())),
        learned: &Learned::default(),
    };
    let policy = Policy::named(policy, &model).expect("known");
    let config = AgentConfig::default();
    let agent = agent(&policy, &config, &conditions, N_MOVES, 7).expect("an agent");
    let flights: Vec<(Cell, &[Move])> = cells.iter().map(|&cell| (cell, &[][..])).collect();
    Rollout::begun(agent, seen(0, &flights)).expect("possible")
}

const CELLS: [Cell; 3] = [
    Cell { row: 0, col: 0 },
    Cell { row: 4, col: 4 },
    Cell { row: 7, col: 8 },
];

#[test]
fn paths_are_flown_by_robot_and_each_agent_sees_its_own() {
    let team = robot("beam_exploit", &CELLS[..2]);
    let single = robot("beam_exploit", &CELLS[2..]);
    let mut agents = vec![team, single];
    for step in 1..5 {
        let cells: Vec<Vec<Cell>> = agents.iter().map(Rollout::cells).collect();
        let paths = agents.plan();
        assert_eq!(paths.len(), 3);
        let flights = |agent: usize, first: usize| -> Vec<(Cell, &[Move])> {
            let own = cells[agent].iter().copied();
            own.zip(paths[first..].iter().map(|path| &**path)).collect()
        };
        let seen = vec![seen(step, &flights(0, 0)), seen(step, &flights(1, 2))];
        agents.see(seen).expect("possible");
        assert!(agents.iter().all(|agent| agent.step() == step));
        agents.predict();
        // No two paths of a team meet where there is room for both.
        let n_visited: u32 = agents[0].results().map(|it| it.n_visited).sum();
        assert_eq!(
            n_visited as usize,
            agents[0].observation().frame.observed().count()
        );
    }
}

#[test]
fn one_robot_of_a_team_flies_as_if_there_were_no_team() {
    for policy in [
        "beam_exploit",
        "shooting_exploit",
        "random_walk",
        "known/options/exploit_ahead_3",
    ] {
        let mut alone = robot(policy, &CELLS[..1]);
        let mut team = robot(policy, &CELLS);
        let (own, of_team) = (alone.plan(), team.plan());
        assert_eq!((own.len(), of_team.len()), (1, 3), "{policy}");
        // The same beliefs: planned first and alone, unless a teammate's answer was better.
        let first = team.agent.plan(&CELLS[..1], team.step());
        assert_eq!(own, first, "{policy}");
    }
}

#[test]
fn missed_steps_equal_steps_without_a_frame() {
    let mut late = robot("beam_exploit", &CELLS[..1]);
    let mut hovering = robot("beam_exploit", &CELLS[..1]);
    for step in 1..4 {
        hovering.plan();
        let nothing = seen(step, &[(CELLS[0], &[])]);
        hovering.see(nothing).expect("possible");
        hovering.agent.predict();
        if step < 3 {
            late.agent.predict();
        }
    }
    late.see(seen(3, &[(CELLS[0], &[])])).expect("possible");
    late.agent.predict();
    assert_eq!(late.agent.belief(), hovering.agent.belief());
    assert_eq!(late.observation(), hovering.observation());
    assert_eq!(late.plan(), hovering.plan());
}
