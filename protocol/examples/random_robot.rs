//! A complete client, which flies random paths in the first world of a running server.
//!
//! `emberwatch-server --instance lab &`, then
//! `cargo run -p emberwatch-protocol --example random_robot -- lab`

#![expect(clippy::print_stdout, reason = "the rewards are the output")]

use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::{Claim, STEP_TIMEOUT};
use emberwatch_protocol::control::WorldSeed;
use emberwatch_protocol::{Client, Connection, Move};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let name = std::env::args().nth(1).unwrap_or("default".into());
    fly_at_random(&Instance::new(&name)?, 10).map(|_| ())
}

/// Begins an episode with robot 0, flies paths, and returns their rewards.
pub fn fly_at_random(instance: &Instance, n_steps: u64) -> Result<Vec<f64>, Box<dyn Error>> {
    let connection = Connection::open(instance, "random robot", STEP_TIMEOUT)?;
    let mut client = Client::acquire(connection, &Claim::new(0..1))?;
    let (world, seed) = (0, Some(1000));
    client.reset(&[WorldSeed { world, seed }])?;
    let (n_moves, mut rng) = (client.info().n_moves, ChaCha8Rng::seed_from_u64(0));
    let mut rewards = Vec::new();
    for step in 1..=n_steps {
        let path = (0..n_moves).map(|_| Move::from_low_bits(rng.random()));
        let seen = &client.step(0..1, &[path.collect()])?[0];
        let (n_cells, reward) = (seen.frame.observed().count(), seen.robot.reward);
        println!("step {step}: saw {n_cells} cells, reward {reward}");
        rewards.push(reward);
    }
    client.release()?;
    Ok(rewards)
}
