//! Tests of the barrier: paths in any order, deadlines, and clients that give up or lose their robots. Time is
//! simulated.

use super::barrier::Ticket;
use super::lease::ClientId;
use super::outcome::{Outcome, ServerStats};
use super::state::Simulator;
use super::step::Stepped;
use super::test_worlds::{finish, new_simulator};
use crate::config::ServerConfig;
use crate::results::world_result;
use crate::world::{Episode, Flown};
use emberwatch_messages::control::{Reply, Request, WorldSeed};
use emberwatch_messages::message::{
    FLAG_TEAM_FRAMES, Operation, Status, StepReply, StepRequest, VERSION, WorldResult,
};
use emberwatch_messages::payload::{split_step_payload, write_step_body};
use emberwatch_model::Move;
use emberwatch_model::settings::WorldSettings;
use std::collections::HashSet;
use std::time::{Duration, Instant};

const N_MOVES: usize = 2;
const LEASE: Duration = Duration::from_secs(20);
const DEADLINE: Duration = Duration::from_millis(50);

struct Lab {
    simulator: Simulator,
    now: Instant,
}

fn client(pid: u32) -> ClientId {
    let node = u128::from(pid);
    ClientId { node, pid }
}

fn path(robot: u32) -> [u8; N_MOVES] {
    [(robot % 4) as u8, (robot / 2 % 4) as u8]
}

impl Lab {
    fn new(deadline: Duration) -> Self {
        let config = ServerConfig {
            worlds: 2,
            deadline_millis: deadline.as_millis() as u64,
            lease_millis: LEASE.as_millis() as u64,
            world: WorldSettings {
                robots: 3,
                height: 4,
                width: 5,
                moves: N_MOVES,
                burn_in: 200,
                ..WorldSettings::default()
            },
            ..ServerConfig::default()
        };
        let (mut simulator, jobs) = new_simulator(config);
        finish(&mut simulator, jobs);
        let now = Instant::now();
        Self { simulator, now }
    }

    fn ask(&mut self, pid: u32, request: &Request) -> Reply {
        let text = serde_json::to_vec(request).expect("requests serialise");
        let stats = ServerStats::default();
        let outcome = self
            .simulator
            .control(self.now, client(pid), VERSION, &text, &stats);
        match outcome {
            Outcome::Answer(reply) | Outcome::Changed(_, reply) => reply,
            Outcome::Pending(jobs, pending) => {
                finish(&mut self.simulator, jobs);
                let reply = self.simulator.pending_reply(self.now, &pending);
                reply.expect("ready")
            }
            _ => panic!("{request:?}: expected an answer"),
        }
    }

    fn acquire(&mut self, pid: u32, first_robot: u32, n_robots: u32, takeover: bool) -> u64 {
        let request = Request::Acquire {
            first_robot,
            n_robots,
            takeover,
            ttl_millis: None,
        };
        match self.ask(pid, &request) {
            Reply::Lease(lease) => lease.lease,
            other => panic!("expected a lease, got {other:?}"),
        }
    }

    /// Starts three clients, 1 to 3. Client r + 1 holds robot r of world 0.
    fn of_three(deadline: Duration) -> (Self, [u64; 3]) {
        let mut lab = Self::new(deadline);
        let leases = [0, 1, 2].map(|robot| lab.acquire(robot + 1, robot, 1, false));
        (lab, leases)
    }

    fn send(&mut self, pid: u32, lease: u64, robots: (u32, u32), k: u64) -> Stepped {
        let (first_robot, n_robots) = robots;
        let request = StepRequest {
            version: VERSION,
            operation: Operation::Step as u32,
            lease,
            first_robot,
            n_robots,
            n_moves: N_MOVES as u32,
            flags: FLAG_TEAM_FRAMES,
            ..StepRequest::default()
        };
        let robots = first_robot..first_robot + n_robots;
        let paths: Vec<u8> = robots.clone().flat_map(path).collect();
        let worlds = self
            .simulator
            .worlds_of(&(robots.start as usize..robots.end as usize));
        let mut body = Vec::new();
        write_step_body(&vec![k; worlds.len()], &paths, &mut body);
        self.simulator
            .step(self.now, client(pid), &request, &body, &mut Vec::new())
    }

    fn waits(&mut self, pid: u32, lease: u64, robots: (u32, u32), k: u64) -> Ticket {
        match self.send(pid, lease, robots, k) {
            Stepped::Waits(ticket) => ticket,
            Stepped::Reply(reply) => panic!("expected a ticket, got {reply:?}"),
        }
    }

    fn replies(&mut self, pid: u32, lease: u64, robots: (u32, u32), k: u64) -> (Status, u64) {
        match self.send(pid, lease, robots, k) {
            Stepped::Reply(reply) => status_and_detail(&reply),
            Stepped::Waits(_) => panic!("expected an answer, got a ticket"),
        }
    }

    /// Returns the answers to waiting requests: ticket, status, and the new step or the refusal's detail.
    fn answers(&mut self) -> Vec<(Ticket, Status, u64)> {
        let mut payload = Vec::new();
        let mut answers = Vec::new();
        while let Some((ticket, reply)) = self.simulator.next_answer(&mut payload) {
            let parts =
                split_step_payload(&reply, &payload).expect("a length that fits the header");
            let (status, detail) = status_and_detail(&reply);
            let step = parts.worlds.first().map_or(detail, |world| world.step);
            answers.push((ticket, status, step));
        }
        answers
    }

    fn world(&self) -> WorldResult {
        world_result(self.episode().outcome())
    }

    fn episode(&self) -> &Episode {
        self.simulator.episode(0).expect("ready")
    }

    /// Checks that world 0 equals a world that is stepped directly. `steps` contains, for each step, the masks of the
    /// robots that fly, hover and are late.
    fn assert_is_as_after(&self, steps: &[(u64, u64, u64)]) {
        let spec = self.simulator.spec();
        let mut expected = Episode::new(&spec.rules, 0);
        let moves: Vec<Move> = (0..3)
            .flat_map(path)
            .map(|byte| Move::from_low_bits(byte.into()))
            .collect();
        for &(ready, hovered, late) in steps {
            let flown = Flown {
                moves: &moves,
                ready,
                full: 0,
                hovered,
                late,
            };
            expected.step(&spec.rules, &flown);
        }
        let got = self.episode();
        assert_eq!(got.outcome(), expected.outcome());
        assert_eq!(got.states(), expected.states());
        for (got, expected) in got.robots().iter().zip(expected.robots()) {
            assert_eq!(got.outcome(), expected.outcome());
            assert_eq!(got.frame(), expected.frame());
            assert_eq!(got.path(), expected.path());
        }
    }
}

fn status_and_detail(reply: &StepReply) -> (Status, u64) {
    let status = Status::try_from(reply.status).expect("a known status");
    (status, reply.detail)
}

#[test]
fn a_world_moves_with_its_last_path_whatever_the_order() {
    for order in [
        [0, 1, 2],
        [0, 2, 1],
        [1, 0, 2],
        [1, 2, 0],
        [2, 0, 1],
        [2, 1, 0],
    ] {
        let (mut lab, leases) = Lab::of_three(Duration::ZERO);
        for k in 0..2 {
            let send = |lab: &mut Lab, robot: u32| {
                lab.waits(robot + 1, leases[robot as usize], (robot, 1), k)
            };
            let [first, second, last] = order;
            let tickets = [send(&mut lab, first), send(&mut lab, second)];
            assert!(lab.answers().is_empty());
            let lease = leases[last as usize];
            let (status, _) = lab.replies(last + 1, lease, (last, 1), k);
            assert_eq!(status, Status::Ok);
            let expected = tickets.map(|ticket| (ticket, Status::Ok, k + 1));
            assert_eq!(lab.answers(), expected, "in the order of arrival");
        }
        assert!(lab.simulator.take_moved().is_empty(), "moved by requests");
        lab.assert_is_as_after(&[(0b111, 0, 0); 2]);
    }
}

#[test]
fn one_client_with_all_robots_is_equivalent_to_three() {
    let mut lab = Lab::new(Duration::ZERO);
    let lease = lab.acquire(1, 0, 6, false);
    for k in 0..2 {
        assert_eq!(lab.replies(1, lease, (0, 6), k).0, Status::Ok);
    }
    lab.assert_is_as_after(&[(0b111, 0, 0); 2]);
}

#[test]
fn a_robot_without_a_holder_hovers() {
    let mut lab = Lab::new(Duration::ZERO);
    let lease = lab.acquire(1, 1, 1, false);
    assert_eq!(lab.replies(1, lease, (1, 1), 0).0, Status::Ok);
    lab.assert_is_as_after(&[(0b010, 0b101, 0)]);
}

#[test]
fn a_path_is_flown_in_its_step_or_not_at_all() {
    let (mut lab, leases) = Lab::of_three(DEADLINE);
    assert_eq!(
        lab.replies(1, leases[0], (0, 1), 1),
        (Status::Early, 0),
        "ahead"
    );
    let waiting = lab.waits(1, leases[0], (0, 1), 0);
    lab.now += DEADLINE;
    assert!(lab.simulator.tick(lab.now).is_empty());
    assert_eq!(lab.answers(), [(waiting, Status::Ok, 1)]);
    assert_eq!(lab.simulator.take_moved(), [0]);
    assert_eq!(
        lab.replies(2, leases[1], (1, 1), 0),
        (Status::Late, 1),
        "behind"
    );
    lab.assert_is_as_after(&[(0b001, 0, 0b110)]);
    lab.waits(2, leases[1], (1, 1), 1);
}

#[test]
fn a_deadline_begins_with_the_first_path() {
    let (mut lab, leases) = Lab::of_three(DEADLINE);
    assert_eq!(lab.simulator.next_deadline(), None);
    let begin = lab.now;
    lab.waits(1, leases[0], (0, 1), 0);
    lab.now += DEADLINE / 2;
    lab.waits(3, leases[2], (2, 1), 0);
    assert_eq!(lab.simulator.next_deadline(), Some(begin + DEADLINE));
    lab.now = begin + DEADLINE - Duration::from_nanos(1);
    lab.simulator.tick(lab.now);
    assert!(lab.answers().is_empty());
    lab.now = begin + DEADLINE;
    lab.simulator.tick(lab.now);
    assert_eq!(lab.answers().len(), 2);
    assert_eq!(lab.simulator.next_deadline(), None);
    lab.assert_is_as_after(&[(0b101, 0, 0b010)]);
}

#[test]
fn without_a_deadline_a_world_waits_for_the_end_of_a_lease() {
    let (mut lab, leases) = Lab::of_three(Duration::ZERO);
    lab.waits(1, leases[0], (0, 1), 0);
    lab.now += LEASE - Duration::from_nanos(1);
    lab.waits(2, leases[1], (1, 1), 0);
    assert!(lab.simulator.tick(lab.now).is_empty());
    assert!(lab.answers().is_empty());
    lab.now += Duration::from_nanos(1);
    assert_eq!(
        lab.simulator.tick(lab.now),
        [3],
        "a waiting client keeps its lease"
    );
    assert_eq!(lab.answers().len(), 2);
    lab.assert_is_as_after(&[(0b011, 0b100, 0)]);
    lab.now += LEASE - Duration::from_nanos(1);
    assert!(lab.simulator.tick(lab.now).is_empty(), "since the answer");
}

#[test]
fn the_path_of_a_process_that_ended_is_dropped_without_delay() {
    let (mut lab, leases) = Lab::of_three(Duration::ZERO);
    lab.waits(1, leases[0], (0, 1), 0);
    let waiting = lab.waits(2, leases[1], (1, 1), 0);
    assert_eq!(lab.simulator.end_of_process(lab.now, 1), 1);
    let answers = lab.answers();
    assert!(matches!(answers[..], [(_, Status::LeaseLost, _)]));
    lab.simulator.end_of_process(lab.now, 3);
    assert_eq!(lab.answers(), [(waiting, Status::Ok, 1)]);
    lab.assert_is_as_after(&[(0b010, 0b101, 0)]);

    // The client's connection closes, but its process is still running.
    let lease = lab.acquire(4, 0, 1, false);
    let waiting = lab.waits(4, lease, (0, 1), 1);
    lab.simulator
        .end_of_connections(lab.now, &HashSet::from([4]));
    assert_eq!(lab.answers(), [(waiting, Status::Ok, 2)]);
}

#[test]
fn an_abandoned_request_withdraws_its_path() {
    let (mut lab, leases) = Lab::of_three(DEADLINE);
    let ticket = lab.waits(1, leases[0], (0, 1), 0);
    lab.simulator.cancel_step(lab.now, ticket);
    assert_eq!(lab.simulator.next_deadline(), None, "no request waits");
    lab.now += DEADLINE;
    lab.simulator.tick(lab.now);
    assert!(lab.answers().is_empty());
    assert_eq!(lab.world().step, 0);
    lab.waits(1, leases[0], (0, 1), 0);
    lab.waits(2, leases[1], (1, 1), 0);
    assert_eq!(lab.replies(3, leases[2], (2, 1), 0).0, Status::Ok);
    lab.assert_is_as_after(&[(0b111, 0, 0)]);
}

#[test]
fn a_robot_has_one_path_at_a_time() {
    let (mut lab, leases) = Lab::of_three(Duration::ZERO);
    let waiting = lab.waits(1, leases[0], (0, 1), 0);
    let refused = lab.replies(1, leases[0], (0, 1), 0);
    assert_eq!(refused, (Status::Busy, 1));
    lab.waits(2, leases[1], (1, 1), 0);
    assert_eq!(lab.replies(3, leases[2], (2, 1), 0).0, Status::Ok);
    assert_eq!(lab.answers()[0], (waiting, Status::Ok, 1));
    lab.assert_is_as_after(&[(0b111, 0, 0)]);
}

#[test]
fn a_takeover_withdraws_the_path_and_waits_for_the_new_holder() {
    let (mut lab, leases) = Lab::of_three(Duration::ZERO);
    let first = lab.waits(1, leases[0], (0, 1), 0);
    let second = lab.waits(2, leases[1], (1, 1), 0);
    let taken = lab.acquire(4, 0, 1, true);
    assert_eq!(lab.answers(), [(first, Status::LeaseLost, 4)]);
    let taken_too = lab.acquire(4, 2, 1, true);
    assert!(lab.answers().is_empty());
    let refused = lab.replies(3, leases[2], (2, 1), 0);
    assert_eq!(refused, (Status::LeaseLost, 4));
    let incomplete = lab.replies(4, taken, (0, 1), 0);
    assert_eq!(
        incomplete,
        (Status::Incomplete, 2),
        "it must fly all its robots at once"
    );
    let _ = taken_too;
    let both = lab.acquire(4, 0, 3, true);
    assert_eq!(lab.answers(), [(second, Status::LeaseLost, 4)]);
    assert_eq!(lab.replies(4, both, (0, 3), 0).0, Status::Ok);
    lab.assert_is_as_after(&[(0b111, 0, 0)]);
}

#[test]
fn a_client_that_loses_one_of_two_robots_flies_neither() {
    let mut lab = Lab::new(Duration::ZERO);
    let two = lab.acquire(1, 0, 2, false);
    let one = lab.acquire(2, 2, 1, false);
    let waiting = lab.waits(1, two, (0, 2), 0);
    let taken = lab.acquire(3, 1, 1, true);
    assert_eq!(lab.answers(), [(waiting, Status::LeaseLost, 3)]);
    lab.waits(2, one, (2, 1), 0);
    lab.waits(3, taken, (1, 1), 0);
    assert_eq!(lab.replies(1, two, (0, 1), 0).0, Status::Ok, "one is left");
    lab.assert_is_as_after(&[(0b111, 0, 0)]);
}

#[test]
fn a_release_lets_the_other_robots_fly() {
    let (mut lab, leases) = Lab::of_three(Duration::ZERO);
    lab.waits(1, leases[0], (0, 1), 0);
    lab.waits(2, leases[1], (1, 1), 0);
    let release = Request::Release { lease: leases[2] };
    assert_eq!(lab.ask(3, &release), Reply::Done);
    assert_eq!(lab.answers().len(), 2);
    lab.assert_is_as_after(&[(0b011, 0b100, 0)]);
}

#[test]
fn a_step_of_several_worlds_needs_all_their_held_robots() {
    let mut lab = Lab::new(Duration::ZERO);
    let four = lab.acquire(1, 0, 4, false);
    let one = lab.acquire(2, 5, 1, false);
    let refused = lab.replies(1, four, (0, 4), 0);
    assert_eq!(refused, (Status::Incomplete, 5));
    assert_eq!(lab.replies(1, four, (0, 3), 0).0, Status::Ok);
    let release = Request::Release { lease: one };
    assert_eq!(lab.ask(2, &release), Reply::Done);
    assert_eq!(lab.replies(1, four, (0, 4), 0), (Status::Late, 1));
    assert_eq!(lab.replies(1, four, (3, 1), 0).0, Status::Ok);
    assert_eq!(lab.replies(1, four, (0, 4), 1).0, Status::Ok);
    assert_eq!(lab.replies(1, four, (4, 1), 2), (Status::NoLease, 4));
    assert_eq!(lab.replies(1, four, (5, 2), 2), (Status::NoSuchRobot, 6));
}

#[test]
fn a_world_is_reset_only_by_the_holder_of_all_held_robots() {
    let (mut lab, leases) = Lab::of_three(Duration::ZERO);
    let reset = |lease| Request::Reset {
        lease,
        worlds: vec![WorldSeed {
            world: 0,
            seed: Some(9),
        }],
    };
    let refused = lab.ask(1, &reset(leases[0]));
    assert_eq!(refused.status(), Status::Busy);
    let waiting = lab.waits(1, leases[0], (0, 1), 0);
    for (pid, lease) in [(2, leases[1]), (3, leases[2])] {
        // Client 1 takes each robot over before its lease is released; otherwise the last release would move the world.
        lab.acquire(1, pid - 1, 1, true);
        let release = Request::Release { lease };
        assert_eq!(lab.ask(pid, &release).status(), Status::LeaseLost);
    }
    assert!(
        lab.answers().is_empty(),
        "it waits for the other robots of client 1"
    );
    assert_eq!(lab.ask(1, &reset(leases[0])).status(), Status::Ok);
    assert_eq!(lab.answers(), [(waiting, Status::Resetting, 0)]);
    assert_eq!((lab.world().seed, lab.world().step), (9, 0));
}

#[test]
fn a_team_frame_joins_the_frames_of_a_world_s_robots() {
    let mut lab = Lab::new(Duration::ZERO);
    let lease = lab.acquire(1, 0, 3, false);
    assert_eq!(lab.replies(1, lease, (0, 3), 0).0, Status::Ok);
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
        let request = StepRequest {
            version: VERSION,
            operation: operation as u32,
            first_robot: 1,
            n_robots: 1,
            flags: FLAG_TEAM_FRAMES,
            ..StepRequest::default()
        };
        let (client, mut payload) = (client(9), Vec::new());
        let stepped = (lab.simulator).step(lab.now, client, &request, body, &mut payload);
        let Stepped::Reply(reply) = stepped else {
            panic!("expected an answer");
        };
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
        let request = Request::Acquire {
            first_robot: 0,
            n_robots: 6,
            takeover: false,
            ttl_millis: asked,
        };
        let Reply::Lease(lease) = lab.ask(1, &request) else {
            panic!("expected a lease");
        };
        assert_eq!(lease.ttl_millis, given, "{asked:?}");
    }
    let lease = lab.acquire(1, 0, 6, false);
    lab.acquire(2, 0, 4, true);
    let Reply::Lease(renewed) = lab.ask(1, &Request::Renew { lease }) else {
        panic!("expected a lease");
    };
    assert_eq!((renewed.lease, renewed.robots), (lease, vec![4, 5]));
    assert!(renewed.worlds.iter().map(|world| world.world).eq([1]));
}
