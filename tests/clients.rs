//! The example of a client.

use crate::random_robot::fly_at_random;
use tests::harness::{SMALL, Server};

#[test]
fn the_example_of_a_client_flies_an_episode() {
    let server = Server::start(SMALL);
    let rewards = fly_at_random(&server.instance, 5).expect("five steps");
    let (world, robot, _) = server.observe(0);
    assert_eq!((world.seed, world.step), (1000, 5));
    assert_eq!((rewards.len(), rewards[4]), (5, robot.reward));
}
