//! Synthetic frames, masks and networks, and comparisons of tensors.

use candle_core::{DType, Tensor};
use emberwatch_model::frame::Frame;
use emberwatch_model::grid::Shape;
use emberwatch_model::randomness::split_mix;
use emberwatch_network::{
    Autoencoder, AutoencoderSettings, Device, Dropout, Mask, NamedTensor, NetworkError,
    NetworkShape,
};

/// Creates frames that show each cell with probability `1 / one_in`.
pub fn frames(shape: Shape, n_observations: u64, n_frames: u64, one_in: u64) -> Vec<Frame> {
    let frame = |index: u64| {
        let mut frame = Frame::empty(shape);
        for cell in 0..shape.n_cells() {
            let bits = split_mix(index, cell as u64);
            if bits.is_multiple_of(one_in) {
                frame.observe(cell, ((bits >> 32) % n_observations) as u8);
            }
        }
        frame
    };
    (0..n_frames).map(frame).collect()
}

/// Creates masks that keep a channel if `keeps(layer, frame, channel)`.
pub fn dropout(
    n_frames: usize,
    scale: f32,
    keeps: impl Fn(usize, usize, usize) -> bool,
) -> Dropout {
    let mask = |layer: usize, channels: usize| {
        Mask::new(n_frames, channels, scale, |frame, channel| {
            keeps(layer, frame, channel)
        })
    };
    Dropout {
        encoder: [mask(0, 32), mask(1, 16), mask(2, 8)],
        decoder: [mask(3, 128), mask(4, 64), mask(5, 32), mask(6, 16)],
    }
}

/// Returns a fixed pseudo-random bit.
pub fn coin(layer: usize, frame: usize, channel: usize) -> bool {
    split_mix(layer as u64 * 1000 + frame as u64, channel as u64) & 1 == 1
}

/// Creates a pool with the given number of threads. No result may depend on this number.
pub fn rayon_pool(n_threads: usize) -> rayon::ThreadPool {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(n_threads)
        .build();
    pool.expect("threads")
}

pub fn numbers(tensor: &Tensor) -> Vec<f64> {
    let numbers = tensor.to_dtype(DType::F64);
    let numbers = numbers.and_then(|tensor| tensor.flatten_all()?.to_vec1());
    numbers.expect("numbers")
}

/// Returns the largest absolute difference, relative to the largest absolute value.
pub fn relative(got: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(got.len(), expected.len());
    let worst = got.iter().zip(expected).map(|(a, b)| (a - b).abs());
    let largest = expected.iter().map(|number| number.abs());
    worst.fold(0.0, f64::max) / largest.fold(1e-30, f64::max)
}

pub fn autoencoder(
    settings: AutoencoderSettings,
    [height, width]: [usize; 2],
    seed: u64,
) -> Autoencoder {
    let shape = NetworkShape {
        grid: Shape::new(height, width).expect("shape"),
        n_states: 3,
        n_observations: 3,
        encoding: settings.encoding,
        hidden: settings.hidden,
    };
    Autoencoder::new(settings, shape, seed, &Device::Cpu).expect("a network")
}

/// Returns the numbers of a saved tensor. If it is missing, the error names it.
pub fn find(saved: &[NamedTensor], name: &str, dims: &[usize]) -> Result<Vec<f32>, NetworkError> {
    let found = saved.iter().find(|tensor| tensor.0 == name);
    let found = found.ok_or_else(|| NetworkError::Device(format!("{name}: missing")))?;
    assert_eq!(found.1, dims, "{name}");
    Ok(found.2.clone())
}
