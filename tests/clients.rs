//! Tests of the number of clients, and of the example client.

use crate::random_robot::fly_at_random;
use emberwatch_protocol::Connection;
use tests::harness::{PATIENCE, Paths, SMALL, Server, send_paths};
use tests::wire::Wire;

#[test]
fn a_seventeenth_client_is_told_the_limit_and_others_go_on() {
    let server = Server::start(SMALL);
    let mut holder = server.acquire(0..1);
    let others: Vec<Wire> = (0..15).map(|_| Wire::open(&server.instance)).collect();
    let refused = Connection::open(&server.instance, "tests", PATIENCE);
    let problem = refused.err().expect("a seventeenth client").to_string();
    assert!(
        problem.contains("at most 16 clients at a time"),
        "{problem}"
    );
    send_paths(&mut holder, Paths::new(0).next(6));
    drop(others);
    server.connect();
}

#[test]
fn the_example_of_a_client_flies_an_episode() {
    let server = Server::start(SMALL);
    let rewards = fly_at_random(&server.instance, 5).expect("five steps");
    let (world, robot, _) = server.observe(0);
    assert_eq!((world.seed, world.step), (1000, 5));
    assert_eq!((rewards.len(), rewards[4]), (5, robot.reward));
}
