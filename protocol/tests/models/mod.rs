//! Models other than the wildfire, for tests.

use protocol::Model;
use protocol::model::{KernelEntry, ModelFile};
use protocol::randomness::split_mix;

/// A model with weights `weight(to, from, row, col)` and biases `bias(to)`.
pub fn model(
    n_states: usize,
    kernel_size: [usize; 2],
    weight: impl Fn(usize, usize, usize, usize) -> f64,
    bias: impl Fn(usize) -> f64,
) -> Model {
    let name = |state: usize| format!("s{state}");
    let template = Model::wildfire().file().clone();
    let mut file = ModelFile {
        name: "test".into(),
        kernel_size,
        states: vec![template.states[0].clone(); n_states],
        kernel: Vec::new(),
        ..template
    };
    for (state, entry) in file.states.iter_mut().enumerate() {
        entry.name = name(state);
        entry.initial = 1.0 / n_states as f64;
        entry.bias = bias(state);
    }
    for (to, from) in (0..n_states).flat_map(|to| (0..n_states).map(move |from| (to, from))) {
        let row = |row| {
            (0..kernel_size[1])
                .map(|col| weight(to, from, row, col))
                .collect()
        };
        file.kernel.push(KernelEntry {
            own: None,
            from: name(from),
            to: name(to),
            scale: 1.0,
            weights: (0..kernel_size[0]).map(row).collect(),
        });
    }
    Model::new(file).expect("test models are valid")
}

/// Random weights, a third of them zero, and random biases.
pub fn random_model(key: u64, n_states: usize, [height, width]: [usize; 2]) -> Model {
    let weight = |to, from, row, col| {
        let index = ((to * n_states + from) * height + row) * width + col;
        if split_mix(key, index as u64).is_multiple_of(3) {
            0.0
        } else {
            unit(key + 1, index)
        }
    };
    model(n_states, [height, width], weight, |to| unit(key + 2, to))
}

/// The same with a kernel for each state that a cell itself is in; in some of them neighbours don't count.
#[allow(dead_code, reason = "not every test binary uses it")]
pub fn random_own_model(key: u64, n_states: usize, kernel_size: [usize; 2]) -> Model {
    let mut file = random_model(key, n_states, kernel_size).file().clone();
    file.kernel.clear();
    for own in 0..n_states {
        let of_all = random_model(key + 10 * own as u64, n_states, kernel_size);
        let ignores_neighbours = own > 0 && split_mix(key, own as u64).is_multiple_of(2);
        for entry in &of_all.file().kernel {
            let mut entry = entry.clone();
            entry.own = Some(format!("s{own}"));
            for (row, weights) in entry.weights.iter_mut().enumerate() {
                for (col, weight) in weights.iter_mut().enumerate() {
                    let is_centre = [row, col] == kernel_size.map(|side| side / 2);
                    *weight *= f64::from(u8::from(is_centre || !ignores_neighbours));
                }
            }
            file.kernel.push(entry);
        }
    }
    Model::new(file).expect("test models are valid")
}

/// A number in `[0, 1)`.
pub fn unit(key: u64, index: usize) -> f64 {
    (split_mix(key, index as u64) >> 11) as f64 / 2f64.powi(53)
}
