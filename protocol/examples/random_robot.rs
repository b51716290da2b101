//! A whole client: flies random paths in the first world of a running server.
//!
//! `emberwatch-server --instance lab &`, then
//! `cargo run -p emberwatch-protocol --example random_robot -- lab`

#![expect(clippy::print_stdout, reason = "what the robot found is the output")]

use protocol::channels::Instance;
use protocol::connection::{Connection, unexpected};
use protocol::control::{Reply, Request, WorldSeed};
use protocol::message::{Operation, StepRequest};
use protocol::payload::write_step_body;
use protocol::{Frame, Shape};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::error::Error;
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(60);

fn main() -> Result<(), Box<dyn Error>> {
    let name = std::env::args().nth(1).unwrap_or("default".into());
    fly_at_random(&Instance::new(&name)?, 10).map(|_| ())
}

/// Begins an episode with robot 0, flies paths, and returns their rewards.
pub fn fly_at_random(instance: &Instance, n_steps: u64) -> Result<Vec<f64>, Box<dyn Error>> {
    let mut connection = Connection::open(instance, "random robot", PATIENCE)?;
    let info = connection.info().clone();
    let acquire = Request::Acquire {
        first_robot: 0,
        n_robots: 1,
        takeover: false,
        ttl_millis: None,
    };
    let lease = match connection.control(&acquire, PATIENCE)? {
        Reply::Lease(lease) => lease.lease,
        other => return Err(unexpected("acquire", &other).into()),
    };
    let (world, seed) = (0, Some(1000));
    let worlds = vec![WorldSeed { world, seed }];
    connection.control(&Request::Reset { lease, worlds }, PATIENCE)?;

    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut rewards = Vec::new();
    for step in 0..n_steps {
        let path: Vec<u8> = (0..info.n_moves).map(|_| rng.random_range(0..4)).collect();
        let mut body = Vec::new();
        write_step_body(&[step], &path, &mut body);
        let request = StepRequest {
            operation: Operation::Step as u32,
            lease,
            n_robots: 1,
            n_moves: info.n_moves as u32,
            ..StepRequest::default()
        };
        let answer = connection.step(request, &body, PATIENCE)?;
        let shape = Shape::new(info.height, info.width)?;
        let frame = Frame::from_bytes(shape, info.n_observations, &answer.frames)?;
        let (n_seen, reward) = (frame.observed().count(), answer.robots[0].reward);
        println!("step {}: saw {n_seen} cells, reward {reward}", step + 1);
        rewards.push(reward);
    }
    connection.control(&Request::Release { lease }, PATIENCE)?;
    Ok(rewards)
}
