//! Tests of resets, ends of episodes, and coverage, as clients observe them.

use crate::random_robot::fly_at_random;
use emberwatch_protocol::control::{Reply, Request, WorldInfo, WorldSeed};
use emberwatch_protocol::message::{Status, StepRequest};
use emberwatch_protocol::payload::split_step_payload;
use emberwatch_protocol::{Coverage, UNOBSERVED};
use tests::harness::{SMALL, Server, seed};
use tests::wire::{RawClient, Wire, step_body, step_header};

/// Number of moves in a path on a [`SMALL`] server.
const N_MOVES: u32 = 6;

/// Number of cells of a world on a [`SMALL`] server.
const N_CELLS: usize = 35;

fn reset(wire: &Wire, lease: u64, worlds: &[WorldSeed]) -> Vec<WorldInfo> {
    let worlds = worlds.to_vec();
    match wire.ask(&Request::Reset { lease, worlds }) {
        Reply::Reset { worlds } => worlds,
        other => panic!("expected a reset, got {other:?}"),
    }
}

#[test]
fn a_reset_starts_an_empty_frame_in_the_corner_and_answers_in_order() {
    let server = Server::start(&format!("{SMALL} --worlds 3 --seed 7"));
    let wire = Wire::open(&server.instance);
    let given = wire.acquire(0..3);
    let info = |world, seed, episode| WorldInfo {
        world,
        step: 0,
        seed,
        episode,
        robots: vec![[0, 0]],
    };
    assert_eq!(given.worlds, [info(0, 7, 0), info(1, 8, 0), info(2, 9, 0)]);
    let lease = given.lease;
    wire.step(step_header(lease, N_MOVES), &step_body(&[0], &[3; 6]));
    let worlds = reset(&wire, lease, &[seed(2, 0), seed(0, u64::MAX)]);
    assert_eq!(worlds, [info(2, 0, 1), info(0, u64::MAX, 1)]);
    let (world, robot, frame) = server.observe(0);
    assert_eq!(frame, [UNOBSERVED; N_CELLS]);
    assert_eq!(robot.coverage, Coverage::Empty as u32);
    assert_eq!((world.reward, world.n_visited), (0.0, 0));
    // Without a given seed, each reset chooses a new one.
    let mut seeds = Vec::from_iter((0..4).map(|_| reset(&wire, lease, &[seed(0, None)])[0].seed));
    seeds.sort_unstable();
    seeds.dedup();
    assert_eq!(seeds.len(), 4, "{seeds:?}");
    assert!(seeds[0] > 0 && seeds[3] < 1 << 53, "{seeds:?}");
}

#[test]
fn the_example_of_a_client_flies_an_episode() {
    let server = Server::start(SMALL);
    let rewards = fly_at_random(&server.instance, 5).expect("five steps");
    let (world, robot, _) = server.observe(0);
    assert_eq!((world.seed, world.step), (1000, 5));
    assert_eq!((rewards.len(), rewards[4]), (5, robot.reward));
}

#[test]
fn an_episode_is_over_at_max_steps_until_it_is_reset() {
    let server = Server::start(&format!("{SMALL} --max-steps 3 --worlds 2"));
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0..2).lease;
    let one = step_header(lease, N_MOVES);
    let step = |k| wire.step(one, &step_body(&[k], &[3; 6]));
    for k in 1..=3 {
        let (reply, payload) = step(k - 1);
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        let world = parts.worlds[0];
        let ended = (world.terminated, world.truncated != 0);
        assert_eq!((world.step, ended), (k, (0, k == 3)));
    }
    let both = StepRequest { n_robots: 2, ..one };
    for (header, body) in [
        (one, step_body(&[3], &[3; 6])),
        (both, step_body(&[3, 0], &[3; 12])),
    ] {
        assert_eq!(wire.status_of(header, &body), (Status::EpisodeOver, 0));
    }
    assert_eq!(server.step_of(1), 0, "its neighbour was not stepped");
    reset(&wire, lease, &[seed(0, None)]);
    assert_eq!(step(0).0.status, Status::Ok as u32);
}

#[test]
fn what_waits_for_a_burn_in_is_answered_after_it() {
    let flags = "--height 32 --width 32 --moves 6 --burn-in 30000";
    let server = Server::start_in_burn_in(flags);
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0..1).lease;
    assert!(!server.status().worlds[0].resetting);
    let begun = &reset(&wire, lease, &[seed(0, 7)])[0];
    assert_eq!((begun.seed, begun.step, begun.episode), (7, 0, 1));
    let step = wire.status_of(step_header(lease, N_MOVES), &step_body(&[0], &[0; 6]));
    assert_eq!(step.0, Status::Ok);
}
