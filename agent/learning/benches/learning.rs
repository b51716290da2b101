//! Duration of updates at the paper's size: 64 x 64 cells, 64 moves, 3 states, 16 streams x 16 frames.

use criterion::{Criterion, criterion_group, criterion_main};
use emberwatch_acting::config::AgentConfig;
use emberwatch_belief::Belief;
use emberwatch_belief::estimation::parameters::{Dimensions, Parameters, Tables};
use emberwatch_belief::estimation::{BayesFilter, Estimator};
use emberwatch_learning::gradient::Optimiser;
use emberwatch_learning::replay::BlockReplay;
use emberwatch_model::path::fly;
use emberwatch_model::randomness::split_mix;
use emberwatch_model::{Cell, Frame, Move, Shape};

const N_MOVES: u64 = 64;

fn shape() -> Shape {
    Shape::new(64, 64).expect("valid shape")
}

fn parameters() -> Parameters {
    let dimensions = Dimensions {
        n_states: 3,
        n_observations: 3,
        kernel: (3, 3),
    };
    Parameters::first(dimensions, 0)
}

fn replay(is_straight: bool) -> BlockReplay {
    let mut replay = BlockReplay::new(64, 64 * 64);
    replay.start_track(0);
    let mut robot = shape().centre();
    for step in 0..64 * 64 {
        let direction = |t: u64| split_mix(step, if is_straight { 0 } else { t }) >> 62;
        let moves: Vec<Move> = (0..N_MOVES)
            .map(|t| Move::from_low_bits(direction(t)))
            .collect();
        let flight = fly(shape(), robot, &moves);
        robot = flight.end;
        let before = Belief::uniform(3, shape());
        replay.push(0, &frame(&flight.visited), Some(&before));
    }
    replay
}

fn frame(visited: &[usize]) -> Frame {
    let mut frame = Frame::empty(shape());
    for &cell in visited {
        let Cell { row, col } = shape().cell(cell);
        frame.observe(
            cell,
            (split_mix((row / 8 * 8 + col / 8) as u64, 0) % 3) as u8,
        );
    }
    frame
}

fn updates(c: &mut Criterion) {
    for (n_threads, is_straight) in [(1, false), (2, false), (1, true), (2, true)] {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(n_threads)
            .build();
        let pool = pool.expect("threads");
        let mut replay = replay(is_straight);
        let config = AgentConfig::default().learning;
        let mut optimiser = Optimiser::new(parameters(), shape(), config, 0);
        let paths = if is_straight {
            "straight flights"
        } else {
            "random walks"
        };
        let name = format!("update 16 x 16, {paths}, {n_threads} threads (target: 2 ms on 2)");
        c.bench_function(&name, |b| {
            b.iter(|| {
                pool.install(|| optimiser.update(&mut replay, Some(2)))
                    .expect("finite")
            });
        });
    }
}

fn filter(c: &mut Criterion) {
    let frame = frame(&(0..40).collect::<Vec<_>>());
    let tables: Tables = parameters().tables();
    let mut filter = BayesFilter::learned(&tables, tables.prior(shape()));
    c.bench_function("learned filter: correct + predict", |b| {
        b.iter(|| {
            filter.correct(&frame).expect("possible");
            filter.predict();
        });
    });
}

criterion_group!(benches, updates, filter);
criterion_main!(benches);
