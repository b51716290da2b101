//! Tests of the barrier: paths in any order, deadlines, and clients that give up or lose their robots.

use super::lab::{LEASE, Lab, claim, replied};
use emberwatch_messages::control::{Request, WorldSeed};
use emberwatch_messages::message::{Operation, Status};
use emberwatch_messages::payload::split_step_payload;
use std::collections::HashSet;
use std::time::Duration;

const DEADLINE: Duration = Duration::from_millis(50);

#[test]
fn a_world_moves_with_its_last_path_whatever_the_order() {
    for [first, second, last] in [[0, 1, 2], [1, 2, 0], [2, 0, 1]] {
        let mut lab = Lab::of_three(Duration::ZERO);
        for k in 0..2 {
            let tickets = [first, second].map(|robot| lab.waits(robot + 1, robot..robot + 1, k));
            assert!(lab.answers().is_empty());
            assert_eq!(lab.replies(last + 1, last..last + 1, k).0, Status::Ok);
            let expected = tickets.map(|ticket| (ticket, Status::Ok, k + 1));
            assert_eq!(lab.answers(), expected, "in the order of arrival");
        }
        assert!(lab.simulator.take_moved().is_empty(), "moved by requests");
        lab.assert_is_as_after(&[(0b111, 0, 0); 2]);
    }
}

#[test]
fn a_deadline_begins_with_the_first_path_and_later_paths_are_late() {
    let mut lab = Lab::of_three(DEADLINE);
    assert_eq!(lab.replies(1, 0..1, 1), (Status::Early, 0));
    assert_eq!(lab.simulator.next_deadline(), None);
    let begin = lab.now;
    let first = lab.waits(1, 0..1, 0);
    lab.now += DEADLINE / 2;
    let second = lab.waits(3, 2..3, 0);
    assert_eq!(lab.simulator.next_deadline(), Some(begin + DEADLINE));
    lab.now = begin + DEADLINE - Duration::from_nanos(1);
    lab.simulator.tick(lab.now);
    assert!(lab.answers().is_empty());
    lab.now = begin + DEADLINE;
    assert!(lab.simulator.tick(lab.now).is_empty());
    let moved = [first, second].map(|ticket| (ticket, Status::Ok, 1));
    assert_eq!(lab.answers(), moved);
    assert_eq!(lab.simulator.take_moved(), [0]);
    assert_eq!(lab.simulator.next_deadline(), None);
    assert_eq!(lab.replies(2, 1..2, 0), (Status::Late, 1));
    lab.assert_is_as_after(&[(0b101, 0, 0b010)]);
    lab.waits(2, 1..2, 1);
}

#[test]
fn without_a_deadline_a_world_waits_for_the_end_of_a_lease() {
    let mut lab = Lab::of_three(Duration::ZERO);
    lab.waits(1, 0..1, 0);
    lab.now += LEASE - Duration::from_nanos(1);
    lab.waits(2, 1..2, 0);
    assert!(lab.simulator.tick(lab.now).is_empty());
    assert!(lab.answers().is_empty());
    lab.now += Duration::from_nanos(1);
    let expired = lab.simulator.tick(lab.now);
    assert_eq!(expired, [3], "a waiting client keeps its lease");
    assert_eq!(lab.answers().len(), 2);
    lab.assert_is_as_after(&[(0b011, 0b100, 0)]);
    lab.now += LEASE - Duration::from_nanos(1);
    assert!(lab.simulator.tick(lab.now).is_empty(), "since the answer");
}

#[test]
fn a_world_does_not_wait_for_clients_that_left() {
    let mut lab = Lab::of_three(Duration::ZERO);
    lab.waits(1, 0..1, 0);
    let waiting = lab.waits(2, 1..2, 0);
    assert_eq!(lab.simulator.end_of_process(lab.now, 1), 1);
    let answers = lab.answers();
    assert!(matches!(answers[..], [(_, Status::LeaseLost, _)]));
    lab.release(3);
    assert_eq!(lab.answers(), [(waiting, Status::Ok, 1)]);
    lab.assert_is_as_after(&[(0b010, 0b101, 0)]);

    lab.acquire(4, 0..1, false);
    let waiting = lab.waits(4, 0..1, 1);
    lab.simulator.end_of_process(lab.now, 2);
    assert_eq!(lab.answers(), [(waiting, Status::Ok, 2)]);

    // The client's connection closes, but its process is still running.
    lab.acquire(3, 2..3, false);
    let waiting = lab.waits(4, 0..1, 2);
    let connected = HashSet::from([4]);
    lab.simulator.end_of_connections(lab.now, &connected);
    assert_eq!(lab.answers(), [(waiting, Status::Ok, 3)]);
}

#[test]
fn a_robot_has_one_path_at_a_time_which_an_abandoned_request_withdraws() {
    let mut lab = Lab::of_three(DEADLINE);
    let ticket = lab.waits(1, 0..1, 0);
    assert_eq!(lab.replies(1, 0..1, 0), (Status::Busy, 1));
    lab.simulator.cancel_step(lab.now, ticket);
    assert_eq!(lab.simulator.next_deadline(), None, "no request waits");
    lab.now += DEADLINE;
    lab.simulator.tick(lab.now);
    assert!(lab.answers().is_empty());
    assert_eq!(lab.episode().outcome().step, 0);
    lab.waits(1, 0..1, 0);
    lab.waits(2, 1..2, 0);
    assert_eq!(lab.replies(3, 2..3, 0).0, Status::Ok);
    lab.assert_is_as_after(&[(0b111, 0, 0)]);
}

#[test]
fn a_takeover_withdraws_the_path_and_waits_for_the_new_holder() {
    let mut lab = Lab::of_three(Duration::ZERO);
    let first = lab.waits(1, 0..1, 0);
    let second = lab.waits(2, 1..2, 0);
    lab.acquire(4, 0..1, true);
    assert_eq!(lab.answers(), [(first, Status::LeaseLost, 4)]);
    lab.acquire(4, 2..3, true);
    assert!(lab.answers().is_empty());
    assert_eq!(lab.replies(3, 2..3, 0), (Status::LeaseLost, 4));
    let refused = lab.replies(4, 2..3, 0);
    let expected = (Status::Incomplete, 0);
    assert_eq!(refused, expected, "it must fly all its robots at once");
    lab.acquire(4, 0..3, true);
    assert_eq!(lab.answers(), [(second, Status::LeaseLost, 4)]);
    assert_eq!(lab.replies(4, 0..3, 0).0, Status::Ok);
    lab.assert_is_as_after(&[(0b111, 0, 0)]);
}

#[test]
fn a_client_that_loses_one_of_two_robots_flies_neither() {
    let mut lab = Lab::new(Duration::ZERO);
    lab.acquire(1, 0..2, false);
    lab.acquire(2, 2..3, false);
    let waiting = lab.waits(1, 0..2, 0);
    lab.acquire(3, 1..2, true);
    assert_eq!(lab.answers(), [(waiting, Status::LeaseLost, 3)]);
    lab.waits(2, 2..3, 0);
    lab.waits(3, 1..2, 0);
    assert_eq!(lab.replies(1, 0..1, 0).0, Status::Ok, "one is left");
    lab.assert_is_as_after(&[(0b111, 0, 0)]);
}

#[test]
fn a_step_of_several_worlds_needs_all_their_held_robots() {
    let mut lab = Lab::new(Duration::ZERO);
    lab.acquire(1, 0..4, false);
    lab.acquire(2, 5..6, false);
    assert_eq!(lab.replies(1, 0..4, 0), (Status::Incomplete, 5));
    assert_eq!(lab.replies(1, 0..3, 0).0, Status::Ok);
    lab.release(2);
    assert_eq!(lab.replies(1, 0..4, 0), (Status::Late, 1));
    assert_eq!(lab.replies(1, 3..4, 0).0, Status::Ok);
    assert_eq!(lab.replies(1, 0..4, 1).0, Status::Ok);
    lab.assert_is_as_after(&[(0b111, 0, 0); 2]);
    assert_eq!(lab.replies(1, 4..5, 2), (Status::NoLease, 4));
    assert_eq!(lab.replies(1, 5..7, 2), (Status::NoSuchRobot, 6));
}

#[test]
fn a_reset_ends_the_wait_of_its_own_client() {
    let mut lab = Lab::of_three(Duration::ZERO);
    let reset = Request::Reset {
        lease: lab.leases[1],
        worlds: vec![WorldSeed {
            world: 0,
            seed: Some(9),
        }],
    };
    let waiting = lab.waits(1, 0..1, 0);
    assert_eq!(lab.ask(1, &reset).status(), Status::Busy);
    lab.acquire(1, 1..3, true);
    assert!(lab.answers().is_empty(), "it waits for its other robots");
    assert_eq!(lab.ask(1, &reset).status(), Status::Ok);
    assert_eq!(lab.answers(), [(waiting, Status::Resetting, 0)]);
    let begun = lab.episode().outcome();
    assert_eq!((begun.seed, begun.step), (9, 0));
}

#[test]
fn a_team_frame_joins_the_frames_of_a_world_s_robots() {
    let mut lab = Lab::new(Duration::ZERO);
    lab.acquire(1, 0..3, false);
    assert_eq!(lab.replies(1, 0..3, 0).0, Status::Ok);
    let robots = lab.episode().robots();
    let joined = |cell: usize| {
        robots
            .iter()
            .map(|robot| robot.frame().as_bytes()[cell])
            .min()
    };
    let joined: Vec<u8> = (0..4 * 5).filter_map(joined).collect();
    let step_1 = 1_u64.to_ne_bytes();
    for (operation, body) in [
        (Operation::Observe, &[][..]),
        (Operation::Recall, &step_1[..]),
    ] {
        let (stepped, payload) = lab.request(4, operation, 1..2, body);
        let reply = replied(stepped);
        let parts = split_step_payload(&reply, &payload).expect("a whole payload");
        assert_eq!(parts.frames, joined, "{operation:?}");
    }
}

#[test]
fn a_lease_has_the_length_asked_for_and_lists_the_robots_that_it_still_holds() {
    let mut lab = Lab::new(Duration::ZERO);
    let usual = LEASE.as_millis() as u64;
    for (asked, given) in [
        (Some(150), 150),
        (Some(0), 100),
        (Some(u64::MAX), 86_400_000),
        (None, usual),
    ] {
        let lease = lab.ask_for_lease(1, &claim(0..6, false, asked));
        assert_eq!(lease.ttl_millis, given, "{asked:?}");
        lab.leases[1] = lease.lease;
    }
    lab.acquire(2, 0..4, true);
    let lease = lab.leases[1];
    let renewed = lab.ask_for_lease(1, &Request::Renew { lease });
    assert_eq!((renewed.lease, renewed.robots), (lease, vec![4, 5]));
    assert!(renewed.worlds.iter().map(|world| world.world).eq([1]));
}
