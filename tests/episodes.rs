//! Resets, episode ends and coverage, as every client sees them.

use crate::harness::{PATIENCE, SMALL, Server, eventually, fly, new_instance, reset};
use crate::random_robot::fly_at_random;
use crate::wire::{RawClient, Wire, answer, control_header, step_body, step_header};
use protocol::control::{Reply, Request, WorldInfo, WorldSeed};
use protocol::message::{FLAG_FULL_COVERAGE, Operation, Status, StepRequest};
use protocol::payload::split_step_payload;
use protocol::{Coverage, Move, UNOBSERVED};
use std::time::Duration;

/// Moves of a path on a [`SMALL`] server.
const N_MOVES: u32 = 6;

/// Cells of a [`SMALL`] server.
const N_CELLS: usize = 35;

#[test]
fn a_reset_starts_an_empty_frame_in_the_corner_and_answers_in_order() {
    let server = Server::start(&format!("{SMALL} --worlds 3 --seed 7"));
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0, 3);
    assert_eq!(
        lease.worlds.iter().map(|w| w.seed).collect::<Vec<_>>(),
        [7, 8, 9]
    );
    let (lease, start) = (lease.lease, lease.worlds);
    assert!(
        start
            .iter()
            .all(|w| (w.step, w.episode, &w.robots[..]) == (0, 0, &[[0, 0]]))
    );
    wire.step(step_header(lease, N_MOVES), &step_body(&[0], &[3; 6]));
    let order = |world, seed| WorldSeed { world, seed };
    let worlds = vec![order(2, Some(0)), order(0, Some(u64::MAX))];
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
    assert_eq!(
        (robot.coverage, world.reward, world.n_visited),
        (Coverage::Empty as u32, 0.0, 0)
    );
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
fn unseeded_resets_go_on_to_other_seeds_and_seeded_ones_repeat_every_byte() {
    let server = Server::start(SMALL);
    let mut client = server.acquire(0..1);
    let unseeded = [WorldSeed {
        world: 0,
        seed: None,
    }];
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
    let mut run = |seed| {
        reset(&mut client, seed);
        let path = vec![
            Move::Right,
            Move::Down,
            Move::Right,
            Move::Down,
            Move::Right,
            Move::Up,
        ];
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
    let lease = wire.acquire(0, 2).lease;
    let step = |k| wire.step(step_header(lease, N_MOVES), &step_body(&[k], &[3; 6]));
    for k in 1..=3 {
        let (reply, payload) = step(k - 1);
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        let world = parts.worlds[0];
        assert_eq!(
            (world.step, world.truncated, world.terminated),
            (k, u16::from(k == 3), 0)
        );
    }
    let (reply, _) = step(3);
    assert_eq!(
        (Status::try_from(reply.status), reply.detail),
        (Ok(Status::EpisodeOver), 0)
    );
    let both = StepRequest {
        n_robots: 2,
        ..step_header(lease, N_MOVES)
    };
    let (reply, _) = wire.step(both, &step_body(&[3, 0], &[3; 12]));
    assert_eq!(
        (Status::try_from(reply.status), reply.detail),
        (Ok(Status::EpisodeOver), 0)
    );
    assert_eq!(
        server.status().worlds[1].info.step,
        0,
        "its neighbour was not stepped"
    );
    let worlds = vec![WorldSeed {
        world: 0,
        seed: None,
    }];
    wire.ask(&Request::Reset { lease, worlds });
    assert_eq!(step(0).0.status, Status::Ok as u32);
}

#[test]
fn coverage_is_what_the_server_says() {
    for (rule, asks, expected) in [
        ("path", false, Ok(Coverage::Path)),
        ("path", true, Err(Status::NotPermitted)),
        ("full", false, Ok(Coverage::Full)),
        ("full", true, Ok(Coverage::Full)),
        ("client", false, Ok(Coverage::Path)),
        ("client", true, Ok(Coverage::Full)),
    ] {
        let server = Server::start(&format!("{SMALL} --coverage {rule}"));
        let wire = Wire::open(&server.instance);
        let header = StepRequest {
            flags: u32::from(asks) * FLAG_FULL_COVERAGE,
            ..step_header(wire.acquire(0, 1).lease, N_MOVES)
        };
        let body = step_body(&[0], &[3, 3, 3, 1, 1, 2]);
        let (reply, payload) = wire.step(header, &body);
        let status = expected.err().unwrap_or(Status::Ok);
        assert_eq!(Status::try_from(reply.status), Ok(status), "{rule} {asks}");
        let Ok(coverage) = expected else { continue };
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        let seen = parts.frames.iter();
        let n_seen = seen.filter(|&&value| value != UNOBSERVED).count();
        let is_full = coverage == Coverage::Full;
        assert_eq!(n_seen, if is_full { N_CELLS } else { 6 }, "{rule} {asks}");
        assert_eq!(
            (parts.robots[0].coverage, parts.robots[0].n_visited),
            (coverage as u32, 6)
        );
    }
}

#[test]
fn a_world_in_burn_in_takes_no_step_and_requests_for_it_wait() {
    let server = Server::start_with_endless_resets("");
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0, 2).lease;
    let reset = |wire: &Wire| {
        let text = format!(r#"{{"op":"reset","lease":{lease},"worlds":[{{"world":1}}]}}"#);
        let pending = wire.send_control(control_header(1), text.as_bytes());
        pending.expect("send")
    };
    let pending = reset(&wire);
    let is_resetting = || server.status().worlds[1].resetting;
    assert!(eventually(PATIENCE, is_resetting));
    let second = StepRequest {
        first_robot: 1,
        ..step_header(lease, N_MOVES)
    };
    let body = step_body(&[0], &[0; 6]);
    assert_eq!(wire.step(second, &body).0.status, Status::Resetting as u32);
    let observe = StepRequest {
        operation: Operation::Observe as u32,
        first_robot: 1,
        ..step_header(0, 0)
    };
    assert_eq!(wire.step(observe, &[]).0.status, Status::Resetting as u32);
    let first = wire.step(step_header(lease, N_MOVES), &body);
    assert_eq!(first.0.status, Status::Ok as u32, "its neighbour goes on");
    let other = Wire::open(&server.instance);
    let (refused, _) = answer(&reset(&other), PATIENCE).expect("an answer");
    assert_eq!(refused.status, Status::NoLease as u32);
    assert!(answer(&pending, Duration::ZERO).is_none());
}

#[test]
fn what_waits_for_a_burn_in_is_answered_after_it() {
    let flags = "--height 32 --width 32 --moves 6 --burn-in 100000";
    let server = Server::start_in_burn_in(&new_instance(), flags);
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(0, 1).lease;
    assert!(!server.status().worlds[0].resetting);
    let worlds = vec![WorldSeed {
        world: 0,
        seed: Some(7),
    }];
    let Reply::Reset { worlds } = wire.ask(&Request::Reset { lease, worlds }) else {
        panic!("expected a reset");
    };
    let begun = (worlds[0].seed, worlds[0].step, worlds[0].episode);
    assert_eq!(begun, (7, 0, 1));
    let (step, _) = wire.step(step_header(lease, N_MOVES), &step_body(&[0], &[0; 6]));
    assert_eq!(step.status, Status::Ok as u32);
}
