//! Tests of the simulator; here those of requests that wait for a reset, and of leases during that wait.

mod barrier;
pub(crate) mod lab;
mod leases;

use crate::snapshot::{NewEpisode, SnapshotWorld};
use emberwatch_messages::control::{Reply, Request, WorldSeed};
use emberwatch_messages::message::{Operation, Status};
use lab::{LEASE, Lab, claim, replied, status_and_detail};
use std::time::Duration;

fn reset() -> Request {
    let (world, seed) = (0, Some(77));
    Request::Reset {
        lease: 1,
        worlds: vec![WorldSeed { world, seed }],
    }
}

#[test]
fn a_world_in_burn_in_refuses_steps_and_delays_other_requests() {
    let (mut lab, jobs) = Lab::in_burn_in(Duration::ZERO);
    let (_, acquired) = lab.wait(1, &claim(0..6, false, None));
    lab.leases[1] = 1;
    assert_eq!(lab.reply(&acquired), None);
    assert_eq!(lab.replies(1, 0..3, 0).0, Status::Resetting);
    lab.finish(jobs);
    let told = lab.reply(&acquired);
    assert!(matches!(told, Some(Reply::Lease(_))), "{told:?}");
    assert_eq!(lab.replies(1, 0..3, 0).0, Status::Ok);

    let (jobs, pending) = lab.wait(1, &reset());
    assert_eq!(lab.reply(&pending), None);
    assert_eq!(lab.replies(1, 0..3, 0).0, Status::Resetting);
    let (observed, _) = lab.request(1, Operation::Observe, 0..1, &[]);
    let (status, _) = status_and_detail(&replied(observed));
    assert_eq!(status, Status::Resetting);
    assert_eq!(lab.ask(1, &reset()).status(), Status::Resetting);
    lab.finish(jobs);
    let Some(Reply::Reset { worlds }) = lab.reply(&pending) else {
        panic!("expected a reset");
    };
    let begun = (worlds[0].seed, worlds[0].step, worlds[0].episode);
    assert_eq!(begun, (77, 0, 1));
    assert_eq!(lab.replies(1, 0..3, 0).0, Status::Ok);
}

#[test]
fn a_lease_lasts_from_its_last_use_or_renewal() {
    let mut lab = Lab::new(Duration::ZERO);
    lab.acquire(1, 0..6, false);
    let almost = LEASE - Duration::from_millis(1);
    lab.now += almost;
    assert_eq!(lab.replies(1, 0..3, 0).0, Status::Ok);
    lab.now += almost;
    lab.ask_for_lease(1, &Request::Renew { lease: 1 });
    assert!(lab.simulator.tick(lab.now + almost).is_empty());
    lab.now += LEASE;
    assert_eq!(lab.replies(1, 0..3, 1).0, Status::LeaseLost);
    assert_eq!(lab.simulator.tick(lab.now), [1]);
}

#[test]
fn a_lease_outlives_the_burn_ins_that_its_client_waits_for() {
    let (mut lab, mut jobs) = Lab::in_burn_in(Duration::ZERO);
    let (_, mut pending) = lab.wait(1, &claim(0..6, false, None));
    for wait_of in ["first burn-in", "burn-in of a reset"] {
        lab.now += 9 * LEASE;
        assert!(lab.simulator.tick(lab.now).is_empty(), "{wait_of}");
        lab.finish(jobs);
        lab.reply(&pending).expect("ready");
        (jobs, pending) = lab.wait(1, &reset());
    }
    // A lease whose client has stopped waiting expires as usual.
    lab.now += 9 * LEASE;
    lab.simulator.cancel_reply(lab.now, &pending);
    let almost = lab.now + LEASE - Duration::from_millis(1);
    assert!(lab.simulator.tick(almost).is_empty());
    assert_eq!(lab.simulator.tick(lab.now + LEASE), [1]);
}

#[test]
fn a_saved_burn_in_begins_again() {
    let (mut lab, _) = Lab::in_burn_in(Duration::ZERO);
    let saved = NewEpisode {
        seed: 77,
        episode: 3,
    };
    let job = lab.simulator.start_with(1, SnapshotWorld::New(saved));
    assert!(lab.simulator.episode(1).is_none());
    lab.finish(vec![job.expect("a burn-in")]);
    let begun = lab.simulator.episode(1).expect("ready").outcome();
    assert_eq!((begun.seed, begun.episode, begun.step), (77, 3, 0));
}
