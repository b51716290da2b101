//! Time of the autoencoder at the paper's size: 64 x 64 cells, windows of 1,000 frames, hidden 16.
//!
//! The authors' code on torch with two threads: an update 1,156 to 1,240 ms, an inference step 0.95 ms.

use agent::network::{Autoencoder, AutoencoderSettings, Window};
use criterion::{Criterion, criterion_group, criterion_main};
use protocol::frame::Frame;
use protocol::grid::Shape;
use protocol::path::{Move, fly};
use protocol::randomness::split_mix;

const N_FRAMES: u64 = 1000;

fn shape() -> Shape {
    Shape::new(64, 64).expect("valid shape")
}

/// What a random walk of 64 moves sees: about 33 cells, in patches of one value.
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
    Autoencoder::new(AutoencoderSettings::paper_large(), shape(), 3, 3, 1)
}

fn updates(c: &mut Criterion) {
    let mut group = c.benchmark_group("autoencoder");
    group.sample_size(20);
    let kinds: [(&str, fn(u64) -> Frame); 2] = [
        ("update on paths (authors: 1.2 s)", path_frame),
        ("update on full frames", full_frame),
    ];
    for (name, frame) in kinds {
        let frames: Vec<Frame> = (0..N_FRAMES).map(frame).collect();
        let window = Window::new(&frames);
        let mut network = network();
        group.bench_function(name, |b| {
            b.iter(|| network.update(&window).expect("finite"))
        });
    }
    group.finish();
}

fn steps(c: &mut Criterion) {
    let mut network = network();
    let frame = path_frame(1);
    c.bench_function("autoencoder: inference step (authors: 0.95 ms)", |b| {
        b.iter(|| network.step(&frame).expect("possible frame"));
    });
}

criterion_group!(benches, updates, steps);
criterion_main!(benches);
