//! Round trip of a step from a Rust client to a server process and back, the simulation's own time
//! subtracted: `cargo bench -p tests --bench round_trip`.

use agent::client::{Claim, Client};
use protocol::Move;
use protocol::channels::Instance;
use protocol::connection::ConnectionError;
use protocol::control::{Reply, Request};
use protocol::message::{Operation, StepRequest};
use std::time::{Duration, Instant};
fn main() {
    let instance =
        Instance::new(&std::env::args().nth(1).unwrap_or("default".into())).expect("name");
    let mut connection =
        protocol::Connection::open(&instance, "bench", Duration::from_secs(5)).expect("server");
    let acquire = Request::Acquire {
        first_world: 0,
        n_worlds: 1,
        takeover: false,
        ttl_millis: None,
    };
    let Ok(Reply::Lease(lease)) = connection.control(&acquire, Duration::from_secs(20)) else {
        panic!("no lease")
    };
    let n_moves = connection.info().n_moves;
    let request = StepRequest {
        operation: Operation::Step as u32,
        lease: lease.lease,
        n_worlds: 1,
        n_moves: n_moves as u32,
        ..StepRequest::default()
    };
    let path: Vec<u8> = (0..n_moves).map(|i| (i * 7 % 4) as u8).collect();
    for _ in 0..3 {
        let (mut total, mut sim) = (vec![], vec![]);
        let t0 = Instant::now();
        for _ in 0..100_000 {
            let t = Instant::now();
            let answer = connection
                .step(request, &path, Duration::from_secs(5))
                .expect("step");
            let all = t.elapsed().as_nanos() as u64;
            total.push(all - answer.reply.simulation_nanos.min(all));
            sim.push(answer.reply.simulation_nanos);
        }
        let rate = 100_000.0 / t0.elapsed().as_secs_f64();
        total.sort();
        sim.sort();
        let p = |v: &Vec<u64>, q: f64| v[(v.len() as f64 * q) as usize] as f64 / 1000.0;
        println!(
            "ipc p50 {:.2} p99 {:.2} p99.9 {:.2} us; simulation p50 {:.2} p99 {:.2} us; {rate:.0} steps/s",
            p(&total, 0.5),
            p(&total, 0.99),
            p(&total, 0.999),
            p(&sim, 0.5),
            p(&sim, 0.99)
        );
    }
}
