//! Tests of agents that are killed or stopped in the middle of a step, which must not change their world.

use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::Claim;
use emberwatch_protocol::control::{Reply, Request};
use emberwatch_protocol::observer::Observer;
use emberwatch_protocol::{Client, Connection};
use rustix::process::Signal;
use std::time::Duration;
use tests::harness::{PATIENCE, Program, Server, eventually, fly_on, frames_until, seen_in};
use tests::wire::{RawClient, Wire, acquire_request, answer, control_header};

/// A grid on which planning takes most of the time of a step.
const FLAGS: &str = "--height 12 --width 9 --moves 8 --burn-in 50";

/// Starts an agent that needs tens of milliseconds per step and acts until it is stopped.
fn start_agent(instance: &Instance, flags: &str) -> Program {
    let slow = "--policy coverage --shooting-samples 100000";
    Program::agent(instance, &format!("{slow} {flags}"))
}

#[test]
fn a_killed_agents_world_is_free_and_unchanged() {
    let server = Server::start(&format!("{FLAGS} --lease-millis 86400000"));
    let observer = Observer::frames(&server.instance).expect("observe");
    let mut frames = frames_until(&observer, 0, 0);
    for _ in 0..3 {
        let next = Wire::open(&server.instance);
        // The agent flies only as many steps as an observer's buffer holds, so that none is lost if the observer reads
        // late.
        let agent = start_agent(&server.instance, "--steps 50");
        let at = frames[frames.len() - 1].header.result.step;
        frames.extend(frames_until(&observer, 0, at + 4));
        server.program.stop();
        agent.kill();
        // When the server resumes, this is the first request that it receives.
        let text = serde_json::to_vec(&acquire_request(0..1)).expect("requests serialise");
        let pending = next.send_control(control_header(1), &text).expect("send");
        server.program.signal(Signal::CONT);
        let (_, reply) = answer(&pending, PATIENCE).expect("an answer");
        drop(pending);
        let Ok(Reply::Lease(lease)) = serde_json::from_slice(&reply) else {
            panic!("expected a lease");
        };
        while let Some(frame) = observer.try_receive().expect("receive") {
            frames.push(frame);
        }
        let last = frames.last().expect("a frame");
        assert_eq!(server.observe(0), seen_in(last));
        let lease = lease.lease;
        assert_eq!(next.ask(&Request::Release { lease }), Reply::Done);
    }
    fly_on(&mut server.acquire(0..1), 5, 10);
    let last = server.step_of(0);
    frames.extend(frames_until(&observer, 0, last));
    let steps = frames.iter().map(|frame| frame.header.result.step);
    let mut steps = Vec::from_iter(steps);
    steps.dedup(); // A world is shown again to a new observer.
    assert_eq!(steps, Vec::from_iter(0..=last), "each step once");
}

#[test]
fn a_stopped_agent_loses_its_lease_and_says_so_when_it_wakes() {
    let server = Server::start(&format!("{FLAGS} --lease-millis 1500"));
    let agent = start_agent(&server.instance, "");
    agent.wait_for_words("acting");
    let refused = start_agent(&server.instance, "").ends(1);
    refused.check_says(&format!("busy: held by pid {}", agent.pid()));
    agent.signal(Signal::STOP);
    agent.until(|| server.holder().is_none());
    let long = Claim {
        time_to_live: Some(Duration::from_secs(3600)),
        ..Claim::new(0..1)
    };
    let mut next = Client::acquire(server.connect(), &long).expect("acquire");
    let before = next.observe(0..1).expect("observe");
    agent.signal(Signal::CONT);
    // The agent has lost its lease, which expired during the pause. This test now holds the robot.
    agent.ends(3).check_says("lease lost");
    let after = next.observe(0..1).expect("observe");
    assert_eq!(after, before, "it stepped nothing");
}

#[test]
fn agents_killed_in_turn_leak_no_place_of_a_client() {
    let server = Server::start(FLAGS);
    let mut before = 0;
    for _ in 0..20 {
        let agent = Program::agent(&server.instance, "--policy random_walk --takeover");
        agent.until(|| server.step_of(0) > before);
        agent.kill();
        before = server.step_of(0);
    }
    let mut clients = Vec::new();
    let all_connect = eventually(PATIENCE, || {
        clients.extend(Connection::open(&server.instance, "tests", PATIENCE).ok());
        clients.len() == 16
    });
    assert!(all_connect, "{} of 16", clients.len());
}
