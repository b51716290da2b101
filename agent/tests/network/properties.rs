//! What holds of every network: seeds, threads, checkpoints, numbers that are not finite, learning.

use crate::synthetic::{coin, dropout, frames};
use agent::network::{
    Autoencoder, AutoencoderSettings, CheckpointError, LossSettings, Trajectory, Window,
};
use protocol::grid::Shape;

fn network(grid: [usize; 2], seed: u64) -> Autoencoder {
    let grid = Shape::new(grid[0], grid[1]).expect("shape");
    Autoencoder::new(AutoencoderSettings::paper_large(), grid, 3, 3, seed)
}

fn window(network: &Autoencoder, n_frames: u64, one_in: u64) -> Window {
    Window::new(&frames(network.shape().grid, 3, n_frames, one_in))
}

#[test]
fn one_and_two_threads_give_the_same_bits() {
    let losses = |n_threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(n_threads)
            .build();
        pool.expect("threads").install(|| {
            let mut network = network([64, 64], 5);
            let windows = [window(&network, 50, 100), window(&network, 9, 1)];
            let losses = windows.map(|window| network.update(&window).expect("finite").to_bits());
            (
                losses,
                network
                    .parameters()
                    .iter()
                    .map(|(_, _, numbers)| numbers.to_vec())
                    .collect::<Vec<_>>(),
            )
        })
    };
    assert_eq!(losses(1), losses(2));
}

#[test]
fn a_number_that_is_not_finite_is_named_and_changes_nothing() {
    let mut network = network([32, 32], 1);
    let window = window(&network, 8, 20);
    network.update(&window).expect("finite");
    let before = network.statistics().get("decoder.2.running_mean").to_vec();
    network.parameters_mut().get_mut("decoder.8.weight")[3] = f32::NAN;
    let error = network.update(&window).expect_err("not finite");
    assert_eq!(
        (error.update, error.tensor.as_str()),
        (1, "decoder.8.weight")
    );
    assert_eq!(network.statistics().get("decoder.2.running_mean"), before);
    // A finite parameter whose gradient is not.
    network.parameters_mut().get_mut("decoder.8.weight")[3] = 0.0;
    network.parameters_mut().get_mut("W_obs_param")[0] = 3e38;
    network
        .parameters_mut()
        .get_mut("encoder.13.bias")
        .fill(f32::MAX);
    if let Err(error) = network.update(&window) {
        assert!(
            error.tensor.starts_with("gradient of") || error.tensor == "loss",
            "{error}"
        );
    }
}

#[test]
fn an_infinite_loss_is_named_and_changes_nothing() {
    let settings = |log_floor| AutoencoderSettings {
        loss: LossSettings {
            log_floor,
            ..LossSettings::paper()
        },
        ..AutoencoderSettings::paper()
    };
    let update = |log_floor| {
        let grid = Shape::new(32, 32).expect("shape");
        let mut network = Autoencoder::new(settings(log_floor), grid, 3, 3, 1);
        // Every state looks like observation 0, to the last bit.
        network.parameters_mut().get_mut("W_obs_param")[..3].fill(200.0);
        let before = network.to_safetensors().expect("bytes");
        let result = network.update(&window(&network, 8, 20));
        (result, before == network.to_safetensors().expect("bytes"))
    };
    let (result, is_unchanged) = update(0.0);
    let error = result.expect_err("not finite");
    assert!(
        error.tensor.starts_with("gradient of") || error.tensor == "loss",
        "{error}"
    );
    assert!(is_unchanged);
    let (result, is_unchanged) = update(1e-10);
    assert!(result.expect("finite").is_finite() && !is_unchanged);
}

#[test]
fn an_update_on_two_trajectories_follows_the_mean_of_their_gradients() {
    let network = || network([32, 32], 3);
    // Of other numbers of cells: each trajectory counts alike all the same.
    let windows = [(9, 10), (9, 3)].map(|(n_frames, one_in)| {
        Window::new(&frames(network().shape().grid, 3, n_frames, one_in)[1..])
    });
    let dropout = dropout(8, 2.0, coin);
    let hidden = [[0.5; 16], [-1.0; 16]];
    let trajectory = |index: usize| Trajectory {
        window: &windows[index],
        dropout: &dropout,
        first: &hidden[index],
    };
    let update = |trajectories: &[Trajectory<'_>]| {
        let mut network = network();
        let loss = network.update_with(trajectories).expect("finite");
        (loss, network)
    };
    let first = network();
    let (both, one, other) = (
        update(&[trajectory(0), trajectory(1)]),
        update(&[trajectory(0)]),
        update(&[trajectory(1)]),
    );
    assert_ne!(one.0, other.0);
    assert_eq!(both.0, (one.0 + other.0) / 2.0);
    let gradient = |network: &Autoencoder, name: &str| {
        network.gradient().expect("an update").get(name).to_vec()
    };
    for (name, ..) in first.parameters().iter() {
        let [both, one, other] = [&both, &one, &other].map(|of| gradient(&of.1, name));
        let mean = one.iter().zip(&other).map(|(a, b)| (a + b) / 2.0);
        assert_eq!(both, mean.collect::<Vec<f32>>(), "{name}");
    }
    // Each moves the running statistics by its own, the second after the first.
    for (name, _, first) in first.statistics().iter() {
        let [both, one, other] = [&both, &one, &other].map(|of| of.1.statistics().get(name));
        for index in 0..first.len() {
            let expected =
                one[index] + other[index] - first[index] - 0.1 * (one[index] - first[index]);
            let error = (both[index] - expected).abs();
            assert!(
                error < 1e-5 * (1.0 + expected.abs()),
                "{name}: off by {error}"
            );
        }
    }
    // One step of Adam, not two.
    assert_eq!(both.1.counters(), [1, 1]);
    assert_eq!(both.1.n_updates(), 1);
}

#[test]
fn trajectories_of_an_update_have_masks_and_hidden_vectors_of_their_own() {
    let update = |n_windows: usize| {
        let mut network = network([32, 32], 3);
        let window = window(&network, 8, 10);
        let loss = network.update_on(&vec![window; n_windows]).expect("finite");
        (loss, network.parameters().get("decoder.8.weight").to_vec())
    };
    assert_eq!(update(2), update(2));
    // The mean over two that are alike would be that of one.
    assert!((update(2).0 - update(1).0).abs() > 1e-4);
}

#[test]
fn a_saved_network_resumes_bit_for_bit() {
    let mut network = network([32, 32], 2);
    let window = window(&network, 10, 10);
    let seen = frames(network.shape().grid, 3, 3, 9);
    network.update(&window).expect("finite");
    network.step(&seen[0]).expect("possible");
    let bytes = network.to_safetensors().expect("bytes");
    let mut resumed = self::network([32, 32], 2);
    resumed.load_safetensors(&bytes).expect("the same network");
    assert_eq!(resumed.to_safetensors().expect("bytes"), bytes);
    for _ in 0..2 {
        assert_eq!(network.update(&window), resumed.update(&window));
        assert_eq!(network.step(&seen[1]), resumed.step(&seen[1]));
    }
    assert_eq!(network.hidden(), resumed.hidden());
}

#[test]
fn a_checkpoint_of_another_network_is_refused_by_name() {
    let bytes = network([32, 32], 2).to_safetensors().expect("bytes");
    let mut other = network([32, 48], 2);
    let error = other.load_safetensors(&bytes).expect_err("another grid");
    assert!(
        matches!(&error, CheckpointError::Shape { name, .. } if name == "encoder.8.weight"),
        "{error}"
    );
    let mut same = network([32, 32], 2);
    for length in [0, 7, 100, bytes.len() - 1] {
        let error = same
            .load_safetensors(&bytes[..length])
            .expect_err("cut off");
        assert!(matches!(error, CheckpointError::Damaged(_)), "{error}");
    }
}

#[test]
fn updates_lower_the_loss_of_what_repeats() {
    let mut network = network([32, 32], 4);
    network.set_learning_rate(1e-3);
    let mut frames = frames(network.shape().grid, 1, 24, 5);
    for frame in &mut frames {
        let cells: Vec<usize> = frame.observed().map(|(cell, _)| cell).collect();
        for cell in cells {
            frame.observe(cell, (cell % 32 / 16) as u8);
        }
    }
    let window = Window::new(&frames);
    let dropout = dropout(24, 2.0, coin);
    let trajectory = Trajectory {
        window: &window,
        dropout: &dropout,
        first: &[0.0; 16],
    };
    let mut losses = Vec::new();
    for _ in 0..60 {
        losses.push(network.update_with(&[trajectory]).expect("finite"));
    }
    assert!(
        losses[59] < 0.8 * losses[0],
        "from {} to {}",
        losses[0],
        losses[59]
    );
}

#[test]
fn beliefs_are_those_of_the_grid_even_where_it_is_padded() {
    let mut network = network([20, 33], 1);
    for frame in frames(network.shape().grid, 3, 5, 7) {
        let estimate = network.step(&frame).expect("possible frame");
        assert_eq!(estimate.shape(), network.shape().grid);
        assert_eq!(network.prediction().shape(), network.shape().grid);
    }
}
