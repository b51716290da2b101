//! Tests of the paths of a lease, with a backend that gives scripted answers.

use emberwatch_messages::backend::{Backend, StepAnswer};
use emberwatch_messages::control::ServerInfo;
use emberwatch_messages::errors::{ConnectionError, refused};
use emberwatch_messages::lease::{Call, Lease};
use emberwatch_messages::message::{Operation, Status, StepReply, StepRequest, WorldResult};
use std::collections::VecDeque;
use std::time::Duration;

/// The operation of a request, and the step for which it is sent.
type Asked = (Operation, Option<u64>);

/// An answer of the backend.
#[derive(Clone, Copy)]
enum Say {
    Nothing,
    Late,
    Step(u64),
    /// A world's step, a bit mask of the robots that hovered, and a bit mask of the late robots.
    Stayed(u64, u64, u64),
}
use Say::{Late, Nothing, Stayed, Step};

/// A world of two robots.
struct Script {
    info: ServerInfo,
    says: VecDeque<Say>,
    asked: Vec<Asked>,
}

impl Backend for Script {
    fn info(&self) -> &ServerInfo {
        &self.info
    }

    fn step(
        &mut self,
        request: StepRequest,
        body: &[u8],
        timeout: Duration,
    ) -> Result<StepAnswer, ConnectionError> {
        let operation = Operation::try_from(request.operation).expect("an operation");
        let step = body.first_chunk().map(|step| u64::from_ne_bytes(*step));
        self.asked.push((operation, step));
        let (step, hovered, late) = match self.says.pop_front().expect("no more requests") {
            Nothing => {
                let (what, instance) = ("step", String::new());
                return Err(ConnectionError::Timeout {
                    what,
                    instance,
                    timeout,
                });
            }
            Late => return Err(refused(Status::Late, 9)),
            Step(step) => (step, 0, 0),
            Stayed(step, hovered, late) => (step, hovered, late),
        };
        let result = WorldResult {
            step,
            hovered,
            late,
            ..WorldResult::default()
        };
        let reply = StepReply {
            n_worlds: 1,
            n_robots: 1,
            ..StepReply::default()
        };
        Ok((reply, bytemuck::bytes_of(&result).to_vec()))
    }

    fn control_text(&mut self, _: &[u8], _: Duration) -> Result<Vec<u8>, ConnectionError> {
        unreachable!("a lease sends only step requests")
    }
}

/// Returns a lease on robot 1, whose world is at step 4, and a backend with these answers.
fn lease(says: &[Say]) -> (Lease, Script) {
    let info = crate::server(1, 3, 1, 1);
    let lease = Lease::new(&info, 7, &(1..2));
    lease.note(0, 4);
    let says = says.iter().copied().collect();
    let asked = Vec::new();
    (lease, Script { info, says, asked })
}

fn call(lease: &Lease, operation: Operation) -> Call<'static> {
    let is_step = operation == Operation::Step;
    let moves: &[u8] = if is_step { &[3] } else { &[] };
    let request = lease.request(operation, &(1..2), 0);
    Call::new(request, moves, Duration::ZERO)
}

/// Flies until the worlds have moved, or gives up after two observations. Returns the observed step and the number of
/// earlier steps that the client did not see.
fn send_paths(
    lease: &Lease,
    script: &mut Script,
    accepts_late: bool,
) -> Result<Option<(u64, u64)>, Status> {
    let paths = call(lease, Operation::Step);
    let send = |call: &mut Call<'_>| lease.send(script, call);
    let mut patience = 2;
    let gives_up = || {
        patience -= 1;
        Ok(patience == 0)
    };
    match lease.send_paths(paths, accepts_late, send, gives_up) {
        Ok(flown) => Ok(flown.map(|(_, n_skipped)| (lease.steps()[0], n_skipped))),
        Err(ConnectionError::Refused { status, .. }) => Err(status),
        Err(other) => panic!("expected a refusal, got {other}"),
    }
}

fn check(
    says: &[Say],
    accepts_late: bool,
    expected: Result<Option<(u64, u64)>, Status>,
) -> Vec<Asked> {
    let (lease, mut script) = lease(says);
    assert_eq!(send_paths(&lease, &mut script, accepts_late), expected);
    assert!(script.says.is_empty(), "{} left", script.says.len());
    script.asked
}

#[test]
fn paths_are_sent_until_the_world_has_moved() {
    let (sent, look) = ((Operation::Step, Some(4)), (Operation::Observe, None));
    let asked = check(&[Step(5)], false, Ok(Some((5, 0))));
    assert_eq!(asked, [sent]);
    let asked = check(&[Nothing, Step(4), Step(5)], false, Ok(Some((5, 0))));
    assert_eq!(asked, [sent, look, sent], "for the same step");
    check(&[Nothing, Step(5)], false, Ok(Some((5, 0))));
    check(&[Nothing, Stayed(5, 0b01, 0)], false, Ok(Some((5, 0))));
    // `gives_up` can end the flight.
    check(&[Nothing, Step(4), Nothing, Step(4)], false, Ok(None));
}

#[test]
fn paths_that_did_not_move_the_world_are_late() {
    for seen in [Step(6), Stayed(5, 0b10, 0), Stayed(5, 0, 0b10)] {
        check(&[Nothing, seen], false, Err(Status::Late));
    }
    check(&[Late], false, Err(Status::Late));
    // With `accepts_late`, the answer shows the current world.
    check(&[Late, Step(7)], true, Ok(Some((7, 2))));
    check(&[Nothing, Step(6)], true, Ok(Some((6, 1))));
    check(&[Nothing, Stayed(5, 0, 0b10)], true, Ok(Some((5, 0))));
}

/// Flies, and lets another thread send one request as soon as the flying thread has sent `after` requests.
fn fly_beside(other: Operation, after: usize, says: &[Say]) -> Result<(), Status> {
    let (lease, mut script) = lease(says);
    let mut others = call(&lease, other);
    let mut n_sent = 0;
    let send = |call: &mut Call<'_>| {
        let answer = lease.send(&mut script, call);
        n_sent += 1;
        if n_sent == after {
            drop(lease.send(&mut script, &mut others));
        }
        answer
    };
    match lease.send_paths(call(&lease, Operation::Step), false, send, || Ok(false)) {
        Err(ConnectionError::Refused { status, .. }) => Err(status),
        flown => {
            assert!(flown.expect("an answer").is_some());
            Ok(())
        }
    }
}

#[test]
fn a_step_with_paths_of_another_thread_is_not_its_own() {
    let beside = |says: &[Say]| fly_beside(Operation::Step, 1, says);
    assert_eq!(beside(&[Nothing, Step(5), Step(5)]), Err(Status::Late));
    // The other thread's answer is lost.
    assert_eq!(beside(&[Nothing, Nothing, Step(5)]), Err(Status::Late));
    assert_eq!(beside(&[Nothing, Late, Step(5)]), Ok(()));
    // The first thread's refusal is lost.
    let says = [Nothing, Step(4), Step(5), Nothing, Step(5)];
    let refused = fly_beside(Operation::Step, 2, &says);
    assert_eq!(refused, Err(Status::Late));
}

#[test]
fn what_another_thread_observes_may_be_its_own_step() {
    let seen = fly_beside(Operation::Observe, 1, &[Nothing, Step(5), Step(5)]);
    assert_eq!(seen, Ok(()));
}
