//! Numbers from the unmodified PyTorch code of the paper's authors (torch 2.15.0, CPU, one thread).
//!
//! As in `tests/golden.rs`, stored uncompressed; of the masked steps the first and the last:
//!
//! ```python
//! for name in "a4_net_weights", "a4_update_nodropout", "a4_masked_step":
//!     z = dict(np.load(f"golden/{name}.npz"))
//!     if name == "a4_masked_step":
//!         z |= {"saved_steps": np.array([0, 5])}
//!         z |= {k: z[k][[0, 5]] for k in ("u_next", "state_est")}
//!     np.savez(f"{name}.npz", **z)
//! ```

use agent::belief::Belief;
use agent::network::adam::AdamSettings;
use agent::network::{Autoencoder, AutoencoderSettings, Dropout, Trajectory, Window};
use candle_core::{Device, Tensor};
use ndarray::{Array, Array1, Array3, Array4, ArrayD, ArrayView2, ArrayView3, Dimension, IxDyn};
use ndarray_npy::{NpzReader, ReadableElement};
use protocol::frame::{Frame, UNOBSERVED};
use protocol::grid::Shape;
use std::fs::File;

struct Golden(NpzReader<File>);

impl Golden {
    fn open(name: &str) -> Self {
        let path = format!("{}/tests/data/{name}.npz", env!("CARGO_MANIFEST_DIR"));
        Self(NpzReader::new(File::open(path).expect("golden file")).expect("npz"))
    }

    fn get<T: ReadableElement, D: Dimension>(&mut self, name: &str) -> Array<T, D> {
        let array = self.0.by_name(&format!("{name}.npy"));
        array.unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    fn names(&mut self) -> Vec<String> {
        let names = self.0.names().expect("names");
        let stems = names.iter().map(|name| name.trim_end_matches(".npy"));
        stems.map(str::to_owned).collect()
    }
}

/// The authors' network with their weights.
fn authors_network() -> Autoencoder {
    let settings = AutoencoderSettings {
        adam: AdamSettings::paper(1e-4),
        ..AutoencoderSettings::paper()
    };
    let mut network = Autoencoder::new(settings, Shape::new(64, 64).expect("shape"), 3, 3, 0);
    let mut golden = Golden::open("a4_net_weights");
    let tensor = |name: String| {
        let array: ArrayD<f32> = golden.get::<f32, IxDyn>(&name);
        let numbers = array.as_slice().expect("row-major").to_vec();
        (
            name,
            Tensor::from_vec(numbers, array.shape(), &Device::Cpu).expect("tensor"),
        )
    };
    let names = Golden::open("a4_net_weights").names();
    let tensors = names.into_iter().map(tensor).collect();
    network.load_weights(tensors).expect("the authors' sizes");
    network
}

fn frame_from(observations: ArrayView2<'_, u8>, mask: ArrayView2<'_, u8>) -> Frame {
    let seen = |(&value, &visited): (&u8, &u8)| if visited > 0 { value } else { UNOBSERVED };
    let bytes: Vec<u8> = observations.iter().zip(mask).map(seen).collect();
    let (height, width) = observations.dim();
    let shape = Shape::new(height, width).expect("shape");
    Frame::from_bytes(shape, 3, &bytes).expect("valid frame")
}

fn frames(golden: &mut Golden) -> Vec<Frame> {
    let observations: Array3<u8> = golden.get("obs");
    let masks: Array3<u8> = golden.get("mask");
    let pairs = observations.outer_iter().zip(masks.outer_iter());
    pairs
        .map(|(observed, mask)| frame_from(observed, mask))
        .collect()
}

/// `[H, W, S]` to a belief.
fn belief_from(channels_last: ArrayView3<'_, f32>) -> Belief {
    let planes = channels_last.permuted_axes([2, 0, 1]);
    Belief::from_probabilities(planes.as_standard_layout().into_owned()).expect("on the simplex")
}

/// The largest difference, relative to the largest number.
fn relative<'a>(
    got: impl IntoIterator<Item = &'a f32>,
    expected: impl IntoIterator<Item = &'a f32>,
) -> f32 {
    let (mut worst, mut largest) = (0.0_f32, 1e-12_f32);
    for (got, expected) in got.into_iter().zip(expected) {
        worst = worst.max((got - expected).abs());
        largest = largest.max(expected.abs());
    }
    worst / largest
}

#[test]
fn masked_steps_reproduce_estimate_prediction_and_hidden_vector() {
    let mut golden = Golden::open("a4_masked_step");
    let mut network = authors_network();
    network.restart(golden.get::<f32, _>("h0").to_vec());
    let first: Array3<f32> = golden.get("u0");
    network.set_prediction(belief_from(first.view()));
    let hidden: Array<f32, ndarray::Ix2> = golden.get("h_next");
    let saved: Array1<i64> = golden.get("saved_steps");
    let estimates: Array4<f32> = golden.get("state_est");
    let predictions: Array4<f32> = golden.get("u_next");
    for (step, frame) in frames(&mut golden).iter().enumerate() {
        let estimate = network.step(frame).expect("possible frame");
        let error = relative(network.hidden(), hidden.row(step));
        assert!(error < 1e-4, "h after step {step}: off by {error}");
        if let Some(index) = saved.iter().position(|&at| at == step as i64) {
            let pairs = [
                (&estimate, &estimates),
                (network.prediction(), &predictions),
            ];
            for (got, expected) in pairs {
                let expected = belief_from(expected.index_axis(ndarray::Axis(0), index));
                let error = relative(got.as_slice(), expected.as_slice());
                assert!(error < 1e-4, "beliefs of step {step}: off by {error}");
            }
        }
    }
}

#[test]
fn an_update_without_dropout_reproduces_loss_gradients_and_parameters() {
    let mut golden = Golden::open("a4_update_nodropout");
    let mut network = authors_network();
    let frames = frames(&mut golden);
    let window = Window::new(&frames);
    let hidden: Array1<f32> = golden.get("h0");
    let dropout = Dropout::off(window.len());
    let trajectory = Trajectory {
        window: &window,
        dropout: &dropout,
        first: &hidden.to_vec(),
    };
    let loss = network.update_with(&[trajectory]).expect("finite");
    let expected: f64 = golden.get::<f64, ndarray::Ix0>("loss").into_scalar();
    assert!(
        (loss / expected - 1.0).abs() < 1e-4,
        "loss {loss}, expected {expected}"
    );
    let gradient = network.gradient().expect("an update");
    for name in golden.names() {
        let (what, tensor) = name.split_once('.').unwrap_or((&name, ""));
        let got = match what {
            "grad" => gradient.get(tensor),
            "after_adam" => network.parameters().get(tensor),
            "after" => network.statistics().get(tensor),
            "gradnorm" => {
                let expected = golden.get::<f64, ndarray::Ix0>(&name).into_scalar();
                let squares = gradient.get(tensor).iter().map(|&d| f64::from(d).powi(2));
                let norm = squares.sum::<f64>().sqrt();
                assert!(
                    (norm / expected - 1.0).abs() < 1e-4,
                    "{name}: {norm}, expected {expected}"
                );
                continue;
            }
            _ => continue,
        };
        let expected: ArrayD<f32> = golden.get(&name);
        let error = relative(got, &expected);
        assert!(error < 1e-4, "{name}: off by {error}");
    }
}
