//! Resets, episode ends and coverage, as every client sees them.

use crate::random_robot::fly_at_random;
use emberwatch_protocol::control::{Reply, Request, WorldInfo};
use emberwatch_protocol::message::{Status, StepRequest};
use emberwatch_protocol::payload::split_step_payload;
use emberwatch_protocol::{Coverage, UNOBSERVED};
use tests::harness::{Paths, SMALL, Server, fly, reset, seed};
use tests::wire::{RawClient, Wire, step_body, step_header};

/// Moves of a path on a [`SMALL`] server.
const N_MOVES: u32 = 6;

/// Cells of a [`SMALL`] server.
const N_CELLS: usize = 35;

#[test]
fn a_reset_starts_an_empty_frame_in_the_corner_and_answers_in_order() {
    let server = Server::start(&format!("{SMALL} --worlds 3 --seed 7"));
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0..3);
    assert!(lease.worlds.iter().map(|world| world.seed).eq(7..10));
    let (lease, start) = (lease.lease, lease.worlds);
    let is_fresh = |w: &WorldInfo| (w.step, w.episode, &w.robots[..]) == (0, 0, &[[0, 0]]);
    assert!(start.iter().all(is_fresh));
    wire.step(step_header(lease, N_MOVES), &step_body(&[0], &[3; 6]));
    let worlds = vec![seed(2, 0), seed(0, u64::MAX)];
    let Reply::Reset { worlds } = wire.ask(&Request::Reset { lease, worlds }) else {
        panic!("expected a reset");
    };
    let expected = |world, seed| WorldInfo {
        world,
        step: 0,
        seed,
        episode: 1,
        robots: vec![[0, 0]],
    };
    assert_eq!(worlds, [expected(2, 0), expected(0, u64::MAX)]);
    let (world, robot, frame) = server.observe(0);
    assert_eq!(frame, vec![UNOBSERVED; N_CELLS]);
    assert_eq!(robot.coverage, Coverage::Empty as u32);
    assert_eq!((world.reward, world.n_visited), (0.0, 0));
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
fn unseeded_resets_change_seeds_and_seeded_ones_repeat_bytes() {
    let server = Server::start(SMALL);
    let mut client = server.acquire(0..1);
    let unseeded = [seed(0, None)];
    let seeds: Vec<u64> = (0..4)
        .map(|_| client.reset(&unseeded).expect("reset")[0].seed)
        .collect();
    let mut distinct = seeds.clone();
    distinct.sort_unstable();
    distinct.dedup();
    assert_eq!(distinct.len(), 4, "{seeds:?}");
    assert!(
        seeds.iter().all(|&seed| seed < 1 << 53 && seed != 0),
        "{seeds:?}"
    );
    let path = Paths::new(0).next(6);
    let mut run = |seed| {
        reset(&mut client, seed);
        let mut steps: Vec<_> = (0..20).map(|_| fly(&mut client, path.clone())).collect();
        steps.iter_mut().for_each(|step| step.world.episode = 0);
        steps
    };
    let (first, other, again) = (run(3), run(4), run(3));
    assert_eq!(first, again);
    assert_ne!(first, other);
}

#[test]
fn an_episode_is_over_at_max_steps_until_it_is_reset() {
    let server = Server::start(&format!("{SMALL} --max-steps 3 --worlds 2"));
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0..2).lease;
    let step = |k| wire.step(step_header(lease, N_MOVES), &step_body(&[k], &[3; 6]));
    for k in 1..=3 {
        let (reply, payload) = step(k - 1);
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        let world = parts.worlds[0];
        assert_eq!((world.step, world.terminated), (k, 0));
        assert_eq!(world.truncated != 0, k == 3);
    }
    let again = wire.status_of(step_header(lease, N_MOVES), &step_body(&[3], &[3; 6]));
    assert_eq!(again, (Status::EpisodeOver, 0));
    let both = StepRequest {
        n_robots: 2,
        ..step_header(lease, N_MOVES)
    };
    let again = wire.status_of(both, &step_body(&[3, 0], &[3; 12]));
    assert_eq!(again, (Status::EpisodeOver, 0));
    assert_eq!(server.step_of(1), 0, "its neighbour was not stepped");
    let worlds = vec![seed(0, None)];
    wire.ask(&Request::Reset { lease, worlds });
    assert_eq!(step(0).0.status, Status::Ok as u32);
}

#[test]
fn what_waits_for_a_burn_in_is_answered_after_it() {
    let flags = "--height 32 --width 32 --moves 6 --burn-in 100000";
    let server = Server::start_in_burn_in(flags);
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0..1).lease;
    assert!(!server.status().worlds[0].resetting);
    let worlds = vec![seed(0, 7)];
    let Reply::Reset { worlds } = wire.ask(&Request::Reset { lease, worlds }) else {
        panic!("expected a reset");
    };
    let begun = (worlds[0].seed, worlds[0].step, worlds[0].episode);
    assert_eq!(begun, (7, 0, 1));
    let step = wire.status_of(step_header(lease, N_MOVES), &step_body(&[0], &[0; 6]));
    assert_eq!(step.0, Status::Ok);
}
