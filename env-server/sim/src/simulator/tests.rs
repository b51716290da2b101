//! Tests of requests that wait for a reset, and of leases during that wait.

use super::lease::ClientId;
use super::outcome::{Outcome, PendingReply, ServerStats};
use super::state::{ResetJob, Simulator};
use super::step::Stepped;
use super::test_worlds::{finish, new_simulator};
use crate::config::ServerConfig;
use crate::snapshot::{NewEpisode, SnapshotWorld};
use emberwatch_messages::control::Reply;
use emberwatch_messages::message::{Operation, Status, StepRequest, VERSION};
use emberwatch_messages::payload::write_step_body;
use emberwatch_model::settings::WorldSettings;
use std::time::{Duration, Instant};

const US: ClientId = ClientId { node: 1, pid: 7 };

const LEASE: Duration = Duration::from_secs(20);

/// Creates two worlds in their first burn-in, and the jobs that end it.
fn start() -> (Simulator, Vec<ResetJob>) {
    new_simulator(ServerConfig {
        worlds: 2,
        lease_millis: LEASE.as_millis() as u64,
        world: WorldSettings {
            height: 3,
            width: 5,
            moves: 2,
            burn_in: 20,
            ..WorldSettings::default()
        },
        ..ServerConfig::default()
    })
}

fn ask(simulator: &mut Simulator, now: Instant, request: &str) -> Outcome {
    let stats = ServerStats::default();
    simulator.control(now, US, VERSION, request.as_bytes(), &stats)
}

fn wait(simulator: &mut Simulator, now: Instant, request: &str) -> (Vec<ResetJob>, PendingReply) {
    let Outcome::Pending(jobs, pending) = ask(simulator, now, request) else {
        panic!("{request} is not answered later");
    };
    (jobs, pending)
}

/// Acquires the robots of both worlds. The token of the first lease is 1.
const ACQUIRE: &str = r#"{"op":"acquire","first_robot":0,"n_robots":2}"#;
const RESET: &str = r#"{"op":"reset","lease":1,"worlds":[{"world":0,"seed":77}]}"#;

fn step(simulator: &mut Simulator, now: Instant, k: u64) -> Status {
    let mut body = Vec::new();
    write_step_body(&[k], &[1, 3], &mut body);
    status_of(simulator, now, Operation::Step, &body)
}

fn status_of(simulator: &mut Simulator, now: Instant, what: Operation, body: &[u8]) -> Status {
    let request = StepRequest {
        version: VERSION,
        operation: what as u32,
        lease: 1,
        n_robots: 1,
        n_moves: 2,
        ..StepRequest::default()
    };
    match simulator.step(now, US, &request, body, &mut Vec::new()) {
        Stepped::Reply(reply) => Status::try_from(reply.status).expect("a known status"),
        Stepped::Waits(_) => panic!("the only robot waits for nobody"),
    }
}

#[test]
fn a_world_in_burn_in_refuses_steps_and_delays_other_requests() {
    let ((mut simulator, jobs), now) = (start(), Instant::now());
    let (_, acquired) = wait(&mut simulator, now, ACQUIRE);
    assert_eq!(simulator.pending_reply(now, &acquired), None);
    assert_eq!(step(&mut simulator, now, 0), Status::Resetting);
    finish(&mut simulator, jobs);
    let told = simulator.pending_reply(now, &acquired);
    assert!(matches!(told, Some(Reply::Lease(_))), "{told:?}");
    assert_eq!(step(&mut simulator, now, 0), Status::Ok);

    let (jobs, pending) = wait(&mut simulator, now, RESET);
    assert_eq!(simulator.pending_reply(now, &pending), None);
    assert_eq!(step(&mut simulator, now, 0), Status::Resetting);
    let observed = status_of(&mut simulator, now, Operation::Observe, &[]);
    assert_eq!(observed, Status::Resetting);
    let Outcome::Answer(twice) = ask(&mut simulator, now, RESET) else {
        panic!("a world can have only one reset at a time");
    };
    assert_eq!(twice.status(), Status::Resetting);
    finish(&mut simulator, jobs);
    let Some(Reply::Reset { worlds }) = simulator.pending_reply(now, &pending) else {
        panic!("expected a reset");
    };
    // The reset has set the step to 0.
    assert_eq!(
        (worlds[0].seed, worlds[0].step, worlds[0].episode),
        (77, 0, 1)
    );
    assert_eq!(step(&mut simulator, now, 0), Status::Ok);
}

#[test]
fn a_lease_lasts_from_its_last_use_or_renewal() {
    let ((mut simulator, jobs), now) = (start(), Instant::now());
    let (_, acquired) = wait(&mut simulator, now, ACQUIRE);
    finish(&mut simulator, jobs);
    simulator.pending_reply(now, &acquired).expect("ready");
    let almost = LEASE - Duration::from_millis(1);
    let now = now + almost;
    assert_eq!(step(&mut simulator, now, 0), Status::Ok);
    let now = now + almost;
    let (_, pending) = wait(&mut simulator, now, r#"{"op":"renew","lease":1}"#);
    simulator.pending_reply(now, &pending).expect("ready");
    assert!(simulator.tick(now + almost).is_empty());
    assert_eq!(step(&mut simulator, now + LEASE, 1), Status::LeaseLost);
    assert_eq!(simulator.tick(now + LEASE), [US.pid]);
}

#[test]
fn a_lease_outlives_the_burn_ins_that_its_client_waits_for() {
    let ((mut simulator, mut jobs), mut now) = (start(), Instant::now());
    let (_, mut pending) = wait(&mut simulator, now, ACQUIRE);
    for wait_of in ["first burn-in", "burn-in of a reset"] {
        now += 9 * LEASE;
        assert!(simulator.tick(now).is_empty(), "{wait_of}");
        finish(&mut simulator, jobs);
        simulator.pending_reply(now, &pending).expect("ready");
        (jobs, pending) = wait(&mut simulator, now, RESET);
    }
    // A lease whose client has stopped waiting expires as usual.
    now += 9 * LEASE;
    simulator.cancel_reply(now, &pending);
    let almost = now + LEASE - Duration::from_millis(1);
    assert!(simulator.tick(almost).is_empty());
    assert_eq!(simulator.tick(now + LEASE), [US.pid]);
}

#[test]
fn a_saved_burn_in_begins_again() {
    let (mut simulator, _) = start();
    let saved = NewEpisode {
        seed: 77,
        episode: 3,
    };
    let job = simulator.start_with(1, SnapshotWorld::New(saved));
    assert!(simulator.episode(1).is_none());
    finish(&mut simulator, vec![job.expect("a burn-in")]);
    let begun = simulator.episode(1).expect("ready").outcome();
    assert_eq!((begun.seed, begun.episode, begun.step), (77, 3, 0));
}
