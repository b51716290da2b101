//! Benchmarks of the networks at the paper's size, 64 x 64 cells. The autoencoder uses windows of 1,000 frames and
//! hidden vectors of length 16.
//!
//! For comparison, the authors' PyTorch code with two threads takes 1,156 to 1,240 ms for an update and 0.95 ms for an
//! inference step.

use criterion::{Criterion, criterion_group};
use emberwatch_model::frame::Frame;
use emberwatch_model::grid::Shape;
use emberwatch_model::path::{Move, fly};
use emberwatch_model::randomness::split_mix;
use emberwatch_network::{
    AdamSettings, Autoencoder, AutoencoderSettings, Device, Dqn, DqnSettings, DqnShape, Lesson,
    NetworkShape, NeuralBelief, Sightings, Transition, Window,
};

#[path = "../../src/process.rs"]
mod process;

use process::{Allocator, set_up_process};

#[global_allocator]
static ALLOCATOR: Allocator = Allocator;

const N_FRAMES: u64 = 1000;

fn shape() -> Shape {
    Shape::new(64, 64).expect("valid shape")
}

fn path_frame(step: u64) -> Frame {
    let moves: Vec<Move> = (0..64)
        .map(|t| Move::from_low_bits(split_mix(step, t) >> 62))
        .collect();
    let start = shape().cell((split_mix(step, 1000) % 4096) as usize);
    let mut frame = Frame::empty(shape());
    for index in fly(shape(), start, &moves).visited {
        frame.observe(index, (split_mix(index as u64 / 5, step / 50) % 3) as u8);
    }
    frame
}

fn full_frame(step: u64) -> Frame {
    let mut frame = Frame::empty(shape());
    for index in 0..shape().n_cells() {
        frame.observe(index, (split_mix(index as u64 / 5, step / 50) % 3) as u8);
    }
    frame
}

fn network() -> Autoencoder {
    let settings = AutoencoderSettings {
        encoding: 16,
        hidden: 16,
        adam: AdamSettings::paper(1e-3),
        ..AutoencoderSettings::paper()
    };
    let shape = NetworkShape {
        grid: shape(),
        n_states: 3,
        n_observations: 3,
        encoding: settings.encoding,
        hidden: settings.hidden,
    };
    Autoencoder::new(settings, shape, 1, &Device::Cpu).expect("a network")
}

/// Returns a network after some updates, because the first updates allocate memory that the process then keeps.
fn warm_network(window: &Window) -> Autoencoder {
    let mut network = network();
    for _ in 0..5 {
        network.update(window).expect("finite");
    }
    network
}

fn updates(c: &mut Criterion) {
    let mut group = c.benchmark_group("autoencoder");
    group.sample_size(20);
    let mut bench = |name: &str, frame: fn(u64) -> Frame| {
        let frames: Vec<Frame> = (0..N_FRAMES).map(frame).collect();
        let window = Window::new(&frames);
        let mut warm = None;
        group.bench_function(name, |b| {
            let network = warm.get_or_insert_with(|| warm_network(&window));
            b.iter(|| network.update(&window).expect("finite"));
        });
    };
    bench("update on paths (authors: 1.2 s)", path_frame);
    bench("update on full frames", full_frame);
    group.finish();
}

fn steps(c: &mut Criterion) {
    let (network, frame) = (network(), path_frame(1));
    let mut hidden = network.first_hidden();
    c.bench_function("autoencoder: inference step (authors: 0.95 ms)", |b| {
        b.iter(|| {
            let window = Window::new([&frame]);
            hidden = network.advance(&window, &hidden).expect("finite");
            network.predict(&hidden).expect("a predictor")
        });
    });
}

fn dqn(c: &mut Criterion) {
    let number = |index: u64| (split_mix(7, index) >> 40) as f32 / (1 << 24) as f32;
    let vector = |first: u64| (0..16).map(|i| number(first + i)).collect::<Vec<f32>>();
    let mut dqn = Dqn::new(DqnSettings::paper(), DqnShape::of_actions(16, 4), 1);
    for row in 0..1000 {
        dqn.remember(Transition {
            input: vector(row * 100),
            action: (row % 4) as usize,
            reward: number(row * 100 + 50),
            next: vector(row * 100 + 20),
            discount: 0.99,
        });
    }
    c.bench_function("dqn: update (torch: 0.65 ms)", |b| {
        b.iter(|| dqn.update().expect("finite"));
    });
    let input = vector(1);
    c.bench_function("dqn: act (candle: 3.5 us)", |b| {
        b.iter(|| dqn.act(&input, 3))
    });
}

fn flight_frame(step: u64) -> Frame {
    let directions = match step % 4 {
        0 => [Move::Right, Move::Down],
        1 => [Move::Up, Move::Left],
        2 => [Move::Left, Move::Down],
        _ => [Move::Up, Move::Right],
    };
    let moves = directions.map(|direction| [direction; 32]).concat();
    let start = shape().cell((split_mix(step, 1000) % 4096) as usize);
    let mut frame = Frame::empty(shape());
    for index in fly(shape(), start, &moves).visited {
        frame.observe(index, (split_mix(index as u64 / 5, step / 50) % 3) as u8);
    }
    frame
}

/// Measures the neural belief as in training. An update uses 16 of the 64 lessons (`neural.batch`). These 16 lessons
/// fill a batch, because long flights need crops of the whole grid.
fn neural_belief(c: &mut Criterion) {
    let mut network = NeuralBelief::new(3, 1, &Device::Cpu).expect("a network");
    let (mut before, mut lessons) = (Sightings::new(shape()), Vec::new());
    for step in 0..200 {
        let frame: Vec<_> = flight_frame(step).observed().collect();
        if step >= 136 {
            lessons.push(Lesson {
                before: before.clone(),
                frame: frame.clone(),
                base: Vec::new(),
            });
        }
        for (cell, value) in frame {
            before.see_cell(cell, value);
        }
        before.pass();
    }
    let mut group = c.benchmark_group("neural belief");
    group.sample_size(20);
    group.bench_function("update", |b| {
        b.iter(|| network.update(2e-3, &lessons).expect("finite"));
    });
    for n in [1, 16, 64] {
        let worlds = vec![(&before, None); n];
        group.bench_function(format!("prediction of {n}"), |b| {
            b.iter(|| network.predict_all(&worlds).expect("predictions"));
        });
    }
    group.finish();
}

criterion_group!(benches, updates, steps, dqn, neural_belief);

fn main() {
    set_up_process();
    benches();
    Criterion::default().configure_from_args().final_summary();
}
