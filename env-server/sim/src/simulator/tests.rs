//! What waits for worlds that are being reset, and what leases do meanwhile.

use super::lease::ClientId;
use super::outcome::{Outcome, PendingReply, ServerStats};
use super::state::{ResetJob, Simulator};
use super::step::Stepped;
use super::test_worlds::{finish, new_simulator};
use crate::config::ServerConfig;
use emberwatch_messages::control::{Reply, Request, WorldSeed};
use emberwatch_messages::message::{Operation, Status, StepRequest, VERSION};
use emberwatch_messages::payload::write_step_body;
use std::time::{Duration, Instant};

const US: ClientId = ClientId { node: 1, pid: 7 };

/// A lease's length, as this server's settings say.
const LEASE: Duration = Duration::from_secs(20);

/// Two worlds in their first burn-in, and what ends it.
fn start() -> (Simulator, Vec<ResetJob>) {
    new_simulator(ServerConfig {
        worlds: 2,
        height: 3,
        width: 5,
        moves: 2,
        burn_in: 20,
        lease_millis: LEASE.as_millis() as u64,
        ..ServerConfig::default()
    })
}

fn ask(simulator: &mut Simulator, now: Instant, request: &Request) -> Outcome {
    let text = serde_json::to_vec(request).expect("requests serialise");
    simulator.control(now, US, VERSION, &text, &ServerStats::default())
}

/// Asks for what is answered later.
fn ask_pending(
    simulator: &mut Simulator,
    now: Instant,
    request: &Request,
) -> (Vec<ResetJob>, PendingReply) {
    match ask(simulator, now, request) {
        Outcome::Pending(jobs, pending) => (jobs, pending),
        _ => panic!("{request:?} is not answered later"),
    }
}

/// Asks for both worlds; the first token is 1.
fn acquire(simulator: &mut Simulator, now: Instant) -> PendingReply {
    let request = Request::Acquire {
        first_robot: 0,
        n_robots: 2,
        takeover: false,
        ttl_millis: None,
    };
    ask_pending(simulator, now, &request).1
}

/// Resets world 0 to a seed.
fn reset(seed: u64) -> Request {
    let seed = Some(seed);
    Request::Reset {
        lease: 1,
        worlds: vec![WorldSeed { world: 0, seed }],
    }
}

/// The status of a step of world 0 from step k on.
fn step(simulator: &mut Simulator, now: Instant, k: u64) -> Status {
    let mut body = Vec::new();
    write_step_body(&[k], &[1, 3], &mut body);
    status_of(simulator, now, Operation::Step, &body)
}

/// The status of a request for world 0.
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
fn a_world_in_burn_in_takes_no_step_and_requests_for_it_wait() {
    let ((mut simulator, jobs), now) = (start(), Instant::now());
    let acquired = acquire(&mut simulator, now);
    assert_eq!(simulator.pending_reply(now, &acquired), None);
    assert_eq!(step(&mut simulator, now, 0), Status::Resetting);
    finish(&mut simulator, jobs);
    let told = simulator.pending_reply(now, &acquired);
    assert!(matches!(told, Some(Reply::Lease(_))), "{told:?}");
    assert_eq!(step(&mut simulator, now, 0), Status::Ok);

    let (jobs, pending) = ask_pending(&mut simulator, now, &reset(77));
    assert_eq!(simulator.pending_reply(now, &pending), None);
    assert_eq!(step(&mut simulator, now, 0), Status::Resetting);
    let observed = status_of(&mut simulator, now, Operation::Observe, &[]);
    assert_eq!(observed, Status::Resetting);
    let twice = ask(&mut simulator, now, &reset(78));
    let is_refused =
        matches!(&twice, Outcome::Answer(reply) if reply.status() == Status::Resetting);
    assert!(is_refused, "one reset of a world at a time");
    finish(&mut simulator, jobs);
    let Some(Reply::Reset { worlds }) = simulator.pending_reply(now, &pending) else {
        panic!("expected a reset");
    };
    let begun = (worlds[0].seed, worlds[0].step, worlds[0].episode);
    assert_eq!(begun, (77, 0, 1), "the step before is forgotten");
    assert_eq!(step(&mut simulator, now, 0), Status::Ok);
}

#[test]
fn a_lease_lasts_from_its_last_use_or_renewal() {
    let ((mut simulator, jobs), now) = (start(), Instant::now());
    let acquired = acquire(&mut simulator, now);
    finish(&mut simulator, jobs);
    simulator.pending_reply(now, &acquired).expect("ready");
    let almost = LEASE - Duration::from_millis(1);
    let now = now + almost;
    assert_eq!(step(&mut simulator, now, 0), Status::Ok);
    let now = now + almost;
    let (_, pending) = ask_pending(&mut simulator, now, &Request::Renew { lease: 1 });
    simulator.pending_reply(now, &pending).expect("ready");
    assert!(simulator.tick(now + almost).is_empty());
    assert_eq!(step(&mut simulator, now + LEASE, 1), Status::LeaseLost);
    assert_eq!(simulator.tick(now + LEASE), [US.pid]);
}

#[test]
fn a_lease_outlives_the_burn_ins_that_its_client_waits_for() {
    let ((mut simulator, jobs), now) = (start(), Instant::now());
    let acquired = acquire(&mut simulator, now);
    let now = now + 9 * LEASE;
    assert!(simulator.tick(now).is_empty(), "the first");
    finish(&mut simulator, jobs);
    let told = simulator.pending_reply(now, &acquired);
    assert!(matches!(told, Some(Reply::Lease(_))), "{told:?}");

    let (jobs, pending) = ask_pending(&mut simulator, now, &reset(77));
    let now = now + 9 * LEASE;
    assert!(simulator.tick(now).is_empty(), "that of a reset");
    finish(&mut simulator, jobs);
    let told = simulator.pending_reply(now, &pending);
    assert!(matches!(told, Some(Reply::Reset { .. })), "{told:?}");

    let (_, pending) = ask_pending(&mut simulator, now, &reset(78));
    let now = now + 9 * LEASE;
    simulator.cancel_reply(now, &pending);
    let almost = now + LEASE - Duration::from_millis(1);
    assert!(simulator.tick(almost).is_empty());
    assert_eq!(
        simulator.tick(now + LEASE),
        [US.pid],
        "but not one that nobody waits for any more"
    );
}
