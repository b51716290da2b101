//! Measures the server's work for one step request without the channel: checks, paths, world transitions, sensor,
//! results and frames.
//!
//! For comparison: the authors' PyTorch environment takes 1.1 ms for one 64 x 64 step on one CPU thread.
//! `cargo bench -p emberwatch-sim --bench step -- --warm-up-time 0.5 --measurement-time 1`

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use emberwatch_messages::control::{Reply, Request};
use emberwatch_messages::message::{Operation, Status, StepReply, StepRequest, VERSION};
use emberwatch_messages::payload::write_step_body;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::settings::WorldSettings;
use emberwatch_sim::config::ServerConfig;
use emberwatch_sim::simulator::{ClientId, Outcome, ServerStats, Simulator, Stepped};
use emberwatch_sim::snapshot::decode;
use rayon::ThreadPoolBuilder;
use std::time::Instant;

const CLIENT: ClientId = ClientId { node: 1, pid: 1 };

/// A simulator, and a client that holds a lease on every robot and prepares the next request.
struct Session {
    simulator: Simulator,
    request: StepRequest,
    /// Many random paths, because a CPU learns to predict the branches of a single path that is repeated.
    paths: Vec<Vec<u8>>,
    steps: Vec<u64>,
    body: Vec<u8>,
    payload: Vec<u8>,
}

impl Session {
    /// Creates worlds at k = 0 on grids of 64 x 64 cells, with paths of 64 moves.
    fn new(n_worlds: u32, team: u32) -> Self {
        Self::of(ServerConfig {
            worlds: n_worlds,
            world: WorldSettings {
                robots: team,
                ..WorldSettings::default()
            },
            ..ServerConfig::default()
        })
    }

    fn of(config: ServerConfig) -> Self {
        let (n_worlds, n_robots) = (config.worlds, config.worlds * config.world.robots);
        let config = ServerConfig {
            world: WorldSettings {
                burn_in: 2_000,
                ..config.world
            },
            ..config
        };
        let n_moves = config.world.moves as u32;
        let checked = config.check().expect("bench settings");
        let threads = ThreadPoolBuilder::new().num_threads(1).build();
        let threads = threads.expect("bench threads");
        let (mut simulator, jobs) =
            Simulator::new(checked, threads, Box::new(|| 1)).expect("bench model");
        for job in jobs {
            let (world, episode) = job.run(&simulator.spec().rules);
            simulator.put(world, episode);
        }
        let request = StepRequest {
            version: VERSION,
            operation: Operation::Step as u32,
            lease: acquire(&mut simulator, n_robots),
            n_robots,
            n_moves,
            ..StepRequest::default()
        };
        let n_bytes = u64::from(n_robots * n_moves);
        let path = |key| (0..n_bytes).map(move |at| (split_mix(key, at) >> 62) as u8);
        Self {
            simulator,
            request,
            paths: (0..256).map(|key| path(key).collect()).collect(),
            steps: vec![0; n_worlds as usize],
            body: Vec::new(),
            payload: Vec::new(),
        }
    }

    fn step(&mut self) -> usize {
        let path = &self.paths[self.request.sequence as usize % self.paths.len()];
        self.body.clear();
        write_step_body(&self.steps, path, &mut self.body);
        let (now, request) = (Instant::now(), &self.request);
        let stepped = self
            .simulator
            .step(now, CLIENT, request, &self.body, &mut self.payload);
        let is_ok = |reply: StepReply| reply.status == Status::Ok as u32;
        assert!(matches!(stepped, Stepped::Reply(reply) if is_ok(reply)));
        self.request.sequence += 1;
        self.steps.iter_mut().for_each(|step| *step += 1);
        self.payload.len()
    }
}

fn acquire(simulator: &mut Simulator, n_robots: u32) -> u64 {
    let request = Request::Acquire {
        first_robot: 0,
        n_robots,
        takeover: false,
        ttl_millis: Some(3_600_000),
    };
    let text = serde_json::to_vec(&request).expect("requests serialise");
    let now = Instant::now();
    let Outcome::Pending(_, pending) =
        simulator.control(now, CLIENT, VERSION, &text, &ServerStats::default())
    else {
        panic!("no lease");
    };
    match simulator.pending_reply(now, &pending) {
        Some(Reply::Lease(lease)) => lease.lease,
        _ => panic!("no lease"),
    }
}

fn simulator_step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("simulator_step");
    for (n_worlds, team) in [(1, 1), (64, 1), (1, 8)] {
        let mut session = Session::new(n_worlds, team);
        group.throughput(Throughput::Elements(n_worlds.into()));
        group.bench_function(format!("{n_worlds} x {team}"), |bencher| {
            bencher.iter(|| session.step());
        });
    }
    let default = ServerConfig::default;
    let models = ["wildfire-burnout", "wildfire-terrain"];
    let models = models.map(|model| {
        (
            model.to_owned(),
            ServerConfig {
                world: WorldSettings {
                    model: model.into(),
                    ..WorldSettings::default()
                },
                ..default()
            },
        )
    });
    let radii = [1, 2, 8].map(|sensor_radius| {
        (
            format!("radius {sensor_radius}"),
            ServerConfig {
                world: WorldSettings {
                    sensor_radius,
                    ..WorldSettings::default()
                },
                ..default()
            },
        )
    });
    for (name, config) in models.into_iter().chain(radii) {
        let mut session = Session::of(config);
        group.throughput(Throughput::Elements(1));
        group.bench_function(name, |bencher| {
            bencher.iter(|| session.step());
        });
    }
    group.finish();
}

fn snapshot(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("snapshot (target: 100 us each)");
    let mut session = Session::new(1, 1);
    // Enough steps to fill the history (256 by default).
    (0..300).for_each(|_| _ = session.step());
    let simulator = &session.simulator;
    let bytes = simulator.snapshot(0..1).expect("a world that is ready");
    group.throughput(Throughput::Bytes(bytes.len() as u64));
    group.bench_function("to bytes", |bencher| {
        bencher.iter(|| simulator.snapshot(0..1));
    });
    let spec = simulator.spec();
    group.bench_function("from bytes", |bencher| {
        bencher.iter(|| {
            let snapshot = decode(&bytes).expect("a snapshot");
            snapshot.restore(spec)
        });
    });
    group.finish();
}

criterion_group!(benches, simulator_step, snapshot);
criterion_main!(benches);
