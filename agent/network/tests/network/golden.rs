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
use crate::synthetic::{autoencoder, relative};
use candle_core::{Tensor, Var};
use emberwatch_model::frame::Frame;
use emberwatch_network::{
    AdamSettings, Autoencoder, AutoencoderSettings, Dropout, NetworkError, Pass, Window,
};
use ndarray::{Array, Array1, Array2, Array3, Array4, ArrayD, Axis, IxDyn};
use std::collections::BTreeMap;

/// Returns the authors' network with their weights.
fn authors_network() -> Autoencoder {
    let settings = AutoencoderSettings {
        adam: AdamSettings::paper(1e-4),
        ..AutoencoderSettings::paper()
    };
    let mut network = autoencoder(settings, [64, 64], 0);
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

fn off<'a>(got: &[f32], expected: impl IntoIterator<Item = &'a f32>) -> f64 {
    let got: Vec<f64> = got.iter().copied().map(f64::from).collect();
    let expected: Vec<f64> = expected.into_iter().copied().map(f64::from).collect();
    relative(&got, &expected)
}

#[test]
fn masked_steps_reproduce_prediction_and_hidden_vector() {
    let mut golden = Golden::open("a4_masked_step");
    let network = authors_network();
    let mut hidden = golden.get::<f32, ndarray::Ix1>("h0").to_vec();
    let expected: Array<f32, ndarray::Ix2> = golden.get("h_next");
    let saved: Array1<i64> = golden.get("saved_steps");
    let predictions: Array4<f32> = golden.get("u_next");
    for (step, frame) in frames(&mut golden).iter().enumerate() {
        let window = Window::new([frame]);
        hidden = network.advance(&window, &hidden).expect("finite");
        let error = off(&hidden, expected.row(step).iter());
        assert!(error < 1e-4, "h after step {step}: off by {error}");
        if let Some(index) = saved.iter().position(|&at| at == step as i64) {
            let prediction = network.predict(&hidden).expect("a predictor");
            let expected = predictions.index_axis(Axis(0), index);
            let got = prediction.as_slice().expect("row-major");
            let error = off(got, expected.permuted_axes([2, 0, 1]).iter());
            assert!(error < 1e-4, "prediction of step {step}: off by {error}");
        }
    }
    let weights: Array2<f32> = Golden::open("a4_net_weights").get("W_obs_param");
    let exponentials = weights.mapv(f32::exp);
    let expected = &exponentials / &exponentials.sum_axis(Axis(0));
    let matrix = network.observation_matrix().expect("a matrix");
    assert!(off(&matrix, expected.iter()) < 1e-6);
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
    let values = |tensor: &Tensor| -> Vec<f32> {
        let numbers = tensor.flatten_all().and_then(|flat| flat.to_vec1());
        numbers.expect("numbers")
    };
    let gradient = |(name, var): (&String, &Var)| Some((name.clone(), values(gradients.get(var)?)));
    let gradients: BTreeMap<_, _> = network.variables().iter().filter_map(gradient).collect();
    let loss = network.update_with(&window, &dropout, &hidden.to_vec());
    let loss = loss.expect("finite");
    let expected: f64 = golden.get::<f64, ndarray::Ix0>("loss").into_scalar();
    assert!((loss / expected - 1.0).abs() < 1e-4, "{loss} {expected}");
    for name in golden.0.names().expect("names") {
        let name = name.trim_end_matches(".npy");
        let (what, tensor) = name.split_once('.').unwrap_or((name, ""));
        let got = match what {
            "grad" => gradients[tensor].clone(),
            "after_adam" | "after" => values(&network.variables()[tensor]),
            "gradnorm" => {
                let expected = golden.get::<f64, ndarray::Ix0>(name).into_scalar();
                let squares = gradients[tensor].iter().map(|&d| f64::from(d).powi(2));
                let norm = squares.sum::<f64>().sqrt();
                assert!(
                    (norm / expected - 1.0).abs() < 1e-4,
                    "{name}: {norm} {expected}"
                );
                continue;
            }
            _ => continue,
        };
        let expected: ArrayD<f32> = golden.get(name);
        let error = off(&got, expected.iter());
        assert!(error < 1e-4, "{name}: off by {error}");
    }
}
