//! Comparison with results of the unmodified PyTorch code of the paper's authors (torch 2.15.0, CPU, one thread).
//!
//! The files are uncompressed, and contain only the first and the last of the masked steps:
//!
//! ```python
//! for name in "a4_net_weights", "a4_update_nodropout", "a4_masked_step":
//!     z = dict(np.load(f"golden/{name}.npz"))
//!     if name == "a4_masked_step":
//!         z |= {"saved_steps": np.array([0, 5])}
//!         z |= {k: z[k][[0, 5]] for k in ("u_next", "state_est")}
//!     np.savez(f"{name}.npz", **z)
//! ```

use crate::golden_file::{Golden, frame_from};
use candle_core::Tensor;
use emberwatch_model::frame::{Frame, UNOBSERVED};
use emberwatch_model::grid::Shape;
use emberwatch_network::{
    AdamSettings, Autoencoder, AutoencoderSettings, Device, Dropout, NetworkError, NetworkShape,
    Pass, Window,
};
use ndarray::{Array, Array1, Array3, Array4, ArrayD, Axis, IxDyn};
use std::borrow::Borrow;
use std::collections::BTreeMap;

fn names(golden: &mut Golden) -> Vec<String> {
    let names = golden.0.names().expect("names");
    let stems = names.iter().map(|name| name.trim_end_matches(".npy"));
    stems.map(str::to_owned).collect()
}

/// Returns the authors' network with their weights.
fn authors_network() -> Autoencoder {
    let settings = AutoencoderSettings {
        adam: AdamSettings::paper(1e-4),
        ..AutoencoderSettings::paper()
    };
    let shape = NetworkShape {
        grid: Shape::new(64, 64).expect("shape"),
        n_states: 3,
        n_observations: 3,
        encoding: settings.encoding,
        hidden: settings.hidden,
    };
    let mut network = Autoencoder::new(settings, shape, 0, &Device::Cpu).expect("a network");
    let find = |name: &str, dims: &[usize]| {
        if name.starts_with("adam.") {
            return Ok(vec![0.0; dims.iter().product()]);
        }
        let array: ArrayD<f32> = Golden::open("a4_net_weights").get::<f32, IxDyn>(name);
        assert_eq!(array.shape(), dims, "{name}");
        Ok::<_, NetworkError>(array.as_slice().expect("row-major").to_vec())
    };
    network.load(find, [0, 0]).expect("the authors' sizes");
    network
}

fn frames(golden: &mut Golden) -> Vec<Frame> {
    let observations: Array3<u8> = golden.get("obs");
    let masks: Array3<u8> = golden.get("mask");
    let pairs = observations.outer_iter().zip(masks.outer_iter());
    pairs
        .map(|(observed, mask)| frame_from(observed, mask))
        .collect()
}

/// Returns the largest absolute difference, relative to the largest absolute value.
fn relative<'a>(
    got: impl IntoIterator<Item = &'a f32>,
    expected: impl IntoIterator<Item = impl Borrow<f32>>,
) -> f32 {
    let (mut worst, mut largest) = (0.0_f32, 1e-12_f32);
    for (got, expected) in got.into_iter().zip(expected) {
        let expected = expected.borrow();
        worst = worst.max((got - expected).abs());
        largest = largest.max(expected.abs());
    }
    worst / largest
}

/// Applies Bayes' rule (eq. 10) at visited cells to a predictor `[S, H, W]`, in place.
fn correct(prediction: &mut Array3<f32>, frame: &Frame, matrix: &[f32]) {
    for ((row, col), &value) in frame.values().indexed_iter() {
        if value != UNOBSERVED {
            let mut cell = prediction.slice_mut(ndarray::s![.., row, col]);
            let likelihood = &matrix[usize::from(value) * cell.len()..];
            let joint = cell.iter_mut().zip(likelihood);
            joint.for_each(|(p, likelihood)| *p *= likelihood);
            let evidence = cell.sum();
            cell.mapv_inplace(|p| p / evidence);
        }
    }
}

#[test]
fn masked_steps_reproduce_estimate_prediction_and_hidden_vector() {
    let mut golden = Golden::open("a4_masked_step");
    let network = authors_network();
    let matrix = network.observation_matrix().expect("a matrix");
    let mut hidden = golden.get::<f32, ndarray::Ix1>("h0").to_vec();
    let first: Array3<f32> = golden.get("u0");
    let mut prediction = first.permuted_axes([2, 0, 1]);
    let expected: Array<f32, ndarray::Ix2> = golden.get("h_next");
    let saved: Array1<i64> = golden.get("saved_steps");
    let estimates: Array4<f32> = golden.get("state_est");
    let predictions: Array4<f32> = golden.get("u_next");
    for (step, frame) in frames(&mut golden).iter().enumerate() {
        let mut estimate = prediction.clone();
        correct(&mut estimate, frame, &matrix);
        let window = Window::new([frame]);
        hidden = network.advance(&window, &hidden).expect("finite");
        prediction = network.predict(&hidden).expect("a predictor");
        let error = relative(&hidden, expected.row(step).iter());
        assert!(error < 1e-4, "h after step {step}: off by {error}");
        if let Some(index) = saved.iter().position(|&at| at == step as i64) {
            for (got, expected) in [(&estimate, &estimates), (&prediction, &predictions)] {
                let expected = expected.index_axis(Axis(0), index);
                let expected = expected.permuted_axes([2, 0, 1]);
                let error = relative(got, expected.iter());
                assert!(error < 1e-4, "beliefs of step {step}: off by {error}");
            }
        }
    }
}

fn numbers(tensor: &Tensor) -> Vec<f32> {
    let numbers = tensor.flatten_all().and_then(|flat| flat.to_vec1());
    numbers.expect("numbers")
}

#[test]
fn updates_without_dropout_reproduce_loss_and_gradients() {
    let mut golden = Golden::open("a4_update_nodropout");
    let mut network = authors_network();
    let frames = frames(&mut golden);
    let window = Window::new(&frames);
    let hidden: Array1<f32> = golden.get("h0");
    let dropout = Dropout::off(window.len());
    let pass = Pass::training(&window, &dropout);
    let loss = network.network().loss(&pass, &hidden.to_vec());
    let gradients = loss.and_then(|loss| loss.backward()).expect("gradients");
    let names_of = network.variables().keys().cloned();
    let gradients = names_of
        .filter(|name| !name.contains("running"))
        .map(|name| {
            let gradient = gradients.get(&network.variables()[&name]);
            let gradient = numbers(gradient.expect("a gradient"));
            (name, gradient)
        });
    let gradients: BTreeMap<String, Vec<f32>> = gradients.collect();
    let loss = network.update_with(&window, &dropout, &hidden.to_vec());
    let loss = loss.expect("finite");
    let expected: f64 = golden.get::<f64, ndarray::Ix0>("loss").into_scalar();
    let off = (loss / expected - 1.0).abs();
    assert!(off < 1e-4, "loss {loss}, expected {expected}");
    for name in names(&mut golden) {
        let (what, tensor) = name.split_once('.').unwrap_or((&name, ""));
        let got = match what {
            "grad" => gradients[tensor].clone(),
            "after_adam" | "after" => numbers(&network.variables()[tensor]),
            "gradnorm" => {
                let expected = golden.get::<f64, ndarray::Ix0>(&name).into_scalar();
                let squares = gradients[tensor].iter().map(|&d| f64::from(d).powi(2));
                let norm = squares.sum::<f64>().sqrt();
                let off = (norm / expected - 1.0).abs();
                assert!(off < 1e-4, "{name}: {norm}, expected {expected}");
                continue;
            }
            _ => continue,
        };
        let expected: ArrayD<f32> = golden.get(&name);
        let error = relative(&got, expected.iter());
        assert!(error < 1e-4, "{name}: off by {error}");
    }
}
