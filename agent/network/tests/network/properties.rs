//! Properties of every network: results on several threads, saved state, and numbers that are not finite.

use crate::synthetic::{autoencoder, find, frames, rayon_pool};
use candle_core::Tensor;
use emberwatch_network::{
    AdamSettings, Autoencoder, AutoencoderSettings, Device, NamedTensor, NotFinite, Window,
};

fn network(grid: [usize; 2], seed: u64) -> Autoencoder {
    let settings = AutoencoderSettings {
        encoding: 16,
        hidden: 16,
        adam: AdamSettings::paper(1e-3),
        ..AutoencoderSettings::paper()
    };
    autoencoder(settings, grid, seed)
}

fn window(network: &Autoencoder, n_frames: u64, one_in: u64) -> Window {
    Window::new(&frames(network.shape().grid, 3, n_frames, one_in))
}

fn tensors(network: &Autoencoder) -> Vec<NamedTensor> {
    network.named_tensors().expect("tensors")
}

/// Overwrites the first numbers of a variable.
fn overwrite(network: &Autoencoder, name: &str, numbers: &[f32]) {
    let var = &network.variables()[name];
    let mut all: Vec<f32> = var
        .flatten_all()
        .and_then(|flat| flat.to_vec1())
        .expect("numbers");
    all[..numbers.len()].copy_from_slice(numbers);
    let tensor = Tensor::from_vec(all, var.shape(), &Device::Cpu).expect("tensor");
    var.set(&tensor).expect("the same shape");
}

#[test]
fn one_and_more_threads_give_the_same_bits() {
    let results = |n_threads| {
        rayon_pool(n_threads).install(|| {
            let mut network = network([64, 64], 5);
            let windows = [window(&network, 20, 100), window(&network, 5, 1)];
            let losses = windows.map(|window| network.update(&window).expect("finite").to_bits());
            (losses, tensors(&network))
        })
    };
    let one = results(1);
    assert_eq!(one, results(2));
    assert_eq!(one, results(5));
}

#[test]
fn a_number_that_is_not_finite_is_named_and_changes_nothing() {
    let mut network = network([32, 32], 1);
    let window = window(&network, 8, 20);
    network.update(&window).expect("finite");
    overwrite(&network, "decoder.8.weight", &[f32::NAN]);
    let before = network.variables()["decoder.2.running_mean"].to_vec1::<f32>();
    let error = network.update(&window).expect_err("not finite");
    let (update, tensor) = (1, "decoder.10.running_mean after the update".into());
    assert_eq!(error, NotFinite { update, tensor }.into());
    let after = network.variables()["decoder.2.running_mean"].to_vec1::<f32>();
    assert_eq!(before.expect("numbers"), after.expect("numbers"));
    overwrite(&network, "decoder.8.weight", &[0.0]);
    // A step that overflows is not applied.
    let before = tensors(&network);
    network.set_learning_rate(f32::INFINITY);
    let error = network.update(&window).expect_err("not finite");
    assert!(error.to_string().ends_with(" after the update"), "{error}");
    assert_eq!(tensors(&network), before);
}

#[test]
fn a_loss_at_certainty_is_finite() {
    let mut network = network([32, 32], 1);
    // Every state shows observation 0 with a probability of exactly 1.
    overwrite(&network, "W_obs_param", &[200.0; 3]);
    let window = window(&network, 8, 20);
    // The loss of two thirds of the cells is -2 ln(1e-10).
    let loss = network.update(&window).expect("finite");
    assert!((20.0..46.0).contains(&loss), "{loss}");
}

#[test]
fn a_saved_network_resumes_bit_for_bit() {
    let mut network = network([32, 32], 2);
    let window = window(&network, 10, 10);
    network.update(&window).expect("finite");
    let saved = tensors(&network);
    let find = |name: &str, dims: &[usize]| find(&saved, name, dims);
    let mut resumed = self::network([32, 32], 2);
    resumed
        .load(find, network.counters())
        .expect("the same network");
    assert_eq!(tensors(&resumed), saved);
    let hidden = network.first_hidden();
    for _ in 0..2 {
        assert_eq!(network.update(&window), resumed.update(&window));
        assert_eq!(network.predict(&hidden), resumed.predict(&hidden));
    }
    assert_eq!(tensors(&resumed), tensors(&network));
}

#[test]
fn predictors_are_those_of_the_grid_even_where_it_is_padded() {
    let network = network([20, 33], 1);
    let mut hidden = network.first_hidden();
    for frame in frames(network.shape().grid, 3, 5, 7) {
        hidden = network
            .advance(&Window::new([&frame]), &hidden)
            .expect("finite");
        let prediction = network.predict(&hidden).expect("a predictor");
        assert_eq!(prediction.dim(), (3, 20, 33));
        let sums = prediction.sum_axis(ndarray::Axis(0));
        assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 1e-5), "{sums}");
    }
}
