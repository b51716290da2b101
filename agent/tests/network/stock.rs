//! The network of candle's stock layers in 64 bits, with automatic derivatives, beside ours.
//!
//! Windows of 40 frames with fixed masks, on several grids and numbers of states and observations. Each
//! tensor's gradient passes through every operator behind it, so a wrong operator shows in its own
//! tensors and in those before it.

use crate::synthetic::{coin, dropout, frames};
use agent::network::{
    Autoencoder, AutoencoderSettings, ChannelMask, Dropout, LossKind, LossSettings, NetworkShape,
    Tensors, Trajectory, Window,
};
use candle_core::{D, DType, Device, Result, Tensor, Var};
use candle_nn::ops::{sigmoid, softmax};
use protocol::frame::Frame;
use protocol::grid::Shape;
use std::collections::BTreeMap;

const ENCODER: [(&str, &str, usize); 3] = [
    ("encoder.0", "encoder.3", 4),
    ("encoder.4", "encoder.7", 2),
    ("encoder.8", "encoder.11", 1),
];
const DECODER: [(&str, &str); 4] = [
    ("decoder.0", "decoder.2"),
    ("decoder.4", "decoder.6"),
    ("decoder.8", "decoder.10"),
    ("decoder.12", "decoder.14"),
];

/// The same network of stock layers.
struct Stock {
    vars: BTreeMap<String, Var>,
    shape: NetworkShape,
}

impl Stock {
    fn new(parameters: &Tensors, shape: NetworkShape) -> Result<Self> {
        let var = |(name, dims, numbers): (&str, &[usize], &[f32])| {
            let tensor = Tensor::from_slice(numbers, dims, &Device::Cpu)?;
            Ok((
                name.to_owned(),
                Var::from_tensor(&tensor.to_dtype(DType::F64)?)?,
            ))
        };
        let vars = parameters.iter().map(var).collect::<Result<_>>()?;
        Ok(Self { vars, shape })
    }

    fn get(&self, name: &str) -> &Tensor {
        self.vars[name].as_tensor()
    }

    /// Batch normalisation with the statistics of the batch.
    fn norm(&self, u: &Tensor, name: &str) -> Result<Tensor> {
        let channels = u.dim(1)?;
        let flat = u.transpose(0, 1)?.flatten_from(1)?;
        let mean = flat.mean_keepdim(1)?;
        let variance = flat.broadcast_sub(&mean)?.sqr()?.mean_keepdim(1)?;
        let per_channel = |tensor: &Tensor| tensor.reshape((1, channels, 1, 1));
        let deviation = (variance + 1e-5)?.sqrt()?;
        u.broadcast_sub(&per_channel(&mean)?)?
            .broadcast_div(&per_channel(&deviation)?)?
            .broadcast_mul(&per_channel(self.get(&format!("{name}.weight")))?)?
            .broadcast_add(&per_channel(self.get(&format!("{name}.bias")))?)
    }

    fn encode(&self, frames: &[Frame], dropout: &Dropout) -> Result<Tensor> {
        let mut x = one_hot(frames, &self.shape)?;
        for (stage, (name, norm, stride)) in ENCODER.into_iter().enumerate() {
            let weight = self.get(&format!("{name}.weight"));
            let bias = self.get(&format!("{name}.bias"));
            let z = x.conv2d(weight, 0, stride, 1, 1)?;
            let z = z.broadcast_add(&bias.reshape((1, bias.dim(0)?, 1, 1))?)?;
            let mask = mask_of(
                &dropout.encoder[stage],
                frames.len(),
                z.dim(1)?,
                dropout.scale,
            )?;
            x = self.norm(&z.broadcast_mul(&mask)?.relu()?, norm)?;
        }
        let flat = x.flatten_from(1)?;
        flat.matmul(&self.get("encoder.13.weight").t()?)?
            .broadcast_add(self.get("encoder.13.bias"))
    }

    fn recur(&self, encodings: &Tensor, first: &[f32]) -> Result<Tensor> {
        let weight = |what: &str| self.get(&format!("rnn_layer.{what}_l0"));
        let n = first.len();
        let mut h = Tensor::from_slice(first, (1, n), &Device::Cpu)?.to_dtype(DType::F64)?;
        let inputs = encodings
            .matmul(&weight("weight_ih").t()?)?
            .broadcast_add(weight("bias_ih"))?;
        let mut states = Vec::new();
        for step in 0..encodings.dim(0)? {
            let i = inputs.narrow(0, step, 1)?;
            let g = h
                .matmul(&weight("weight_hh").t()?)?
                .broadcast_add(weight("bias_hh"))?;
            let part = |tensor: &Tensor, part: usize| tensor.narrow(1, part * n, n);
            let r = sigmoid(&(part(&i, 0)? + part(&g, 0)?)?)?;
            let z = sigmoid(&(part(&i, 1)? + part(&g, 1)?)?)?;
            let candidate = (part(&i, 2)? + (r * part(&g, 2)?)?)?.tanh()?;
            h = ((1.0 - &z)? * candidate)?.add(&(z * h)?)?;
            states.push(h.clone());
        }
        Tensor::cat(&states, 0)
    }

    /// Logits of all cells of the padded grid.
    fn decode(&self, hidden: &Tensor, dropout: &Dropout) -> Result<Tensor> {
        let n_frames = hidden.dim(0)?;
        let mut x = hidden.reshape((n_frames, hidden.dim(1)?, 1, 1))?;
        for (level, (name, norm)) in DECODER.into_iter().enumerate() {
            let z = self.transposed(&x, name, level > 0)?;
            let mask = mask_of(&dropout.decoder[level], n_frames, z.dim(1)?, dropout.scale)?;
            x = self.norm(&z.broadcast_mul(&mask)?, norm)?.relu()?;
        }
        self.transposed(&x, "decoder.16", true)
    }

    fn transposed(&self, x: &Tensor, name: &str, doubles: bool) -> Result<Tensor> {
        let weight = self.get(&format!("{name}.weight"));
        if doubles {
            return x.conv_transpose2d(weight, 1, 0, 2, 1);
        }
        // candle's layer has square kernels only; on one cell it is a matrix.
        let (n_frames, n_hidden) = (x.dim(0)?, x.dim(1)?);
        let (_, channels, height, width) = weight.dims4()?;
        x.reshape((n_frames, n_hidden))?
            .matmul(&weight.reshape((n_hidden, channels * height * width))?)?
            .reshape((n_frames, channels, height, width))
    }

    fn loss(
        &self,
        frames: &[Frame],
        dropout: &Dropout,
        first: &[f32],
        settings: LossSettings,
    ) -> Result<Tensor> {
        let hidden = self.recur(&self.encode(frames, dropout)?, first)?;
        let logits = self.decode(&hidden, dropout)?;
        let n_targets = frames.len() - 1;
        // [frames, cells, states], then [.., observations].
        let u = softmax(
            &logits
                .narrow(0, 0, n_targets)?
                .flatten_from(2)?
                .transpose(1, 2)?,
            D::Minus1,
        )?;
        let observation = softmax(self.get("W_obs_param"), 0)?;
        let q = u.contiguous()?.broadcast_matmul(&observation.t()?)?;
        let y = one_hot(&frames[1..], &self.shape)?
            .flatten_from(2)?
            .transpose(1, 2)?;
        let seen = y.sum_keepdim(D::Minus1)?;
        let floor = f64::from(settings.log_floor);
        let hit = (&y * (&q + floor)?.log()?)?;
        let miss = ((1.0 - &y)? * ((1.0 - &q)? + floor)?.log()?)?;
        let entropy = (hit + miss)?.broadcast_mul(&seen)?.sum_all()?;
        let divisor = match settings.kind {
            LossKind::MeanOfCells => seen.sum_all()?.to_scalar::<f64>()?,
            LossKind::SumOfCells => n_targets as f64,
        };
        entropy.neg()? / divisor
    }
}

/// `[frames, observations, rows, cols]` of the padded grid; all zero where nothing was seen.
fn one_hot(frames: &[Frame], shape: &NetworkShape) -> Result<Tensor> {
    let (height, width) = shape.grid.dim();
    let [rows, cols] = [height, width].map(|side| side.next_multiple_of(16));
    let size = shape.n_observations * rows * cols;
    let mut numbers = vec![0.0; frames.len() * size];
    for (index, frame) in frames.iter().enumerate() {
        for (cell, value) in frame.observed() {
            let plane = index * size + usize::from(value) * rows * cols;
            numbers[plane + cell / width * cols + cell % width] = 1.0_f64;
        }
    }
    let dims = (frames.len(), shape.n_observations, rows, cols);
    Tensor::from_vec(numbers, dims, &Device::Cpu)
}

fn mask_of(mask: &ChannelMask, n_frames: usize, channels: usize, scale: f32) -> Result<Tensor> {
    let mut numbers = vec![0.0; n_frames * channels];
    for frame in 0..n_frames {
        for &channel in mask.kept(frame) {
            numbers[frame * channels + usize::from(channel)] = f64::from(scale);
        }
    }
    Tensor::from_vec(numbers, (n_frames, channels, 1, 1), &Device::Cpu)
}

/// The largest difference of two tensors, relative to the largest number.
fn relative(got: &[f32], expected: &[f64]) -> f64 {
    assert_eq!(got.len(), expected.len());
    let pairs = got.iter().zip(expected);
    let worst = pairs.map(|(&got, expected)| (f64::from(got) - expected).abs());
    let largest = expected.iter().map(|expected| expected.abs());
    worst.fold(0.0, f64::max) / largest.fold(1e-30, f64::max)
}

struct Case {
    grid: [usize; 2],
    n_states: usize,
    n_observations: usize,
    n_frames: usize,
    /// One cell in so many is seen.
    one_in: u64,
    drops: bool,
    loss: LossSettings,
}

const CASE: Case = Case {
    grid: [64, 64],
    n_states: 3,
    n_observations: 3,
    n_frames: 40,
    one_in: 100,
    drops: true,
    loss: LossSettings {
        kind: LossKind::MeanOfCells,
        log_floor: 1e-10,
    },
};

fn check(case: Case) {
    let grid = Shape::new(case.grid[0], case.grid[1]).expect("shape");
    let settings = AutoencoderSettings {
        encoding: 6,
        hidden: 5,
        loss: case.loss,
        ..AutoencoderSettings::paper()
    };
    let mut network = Autoencoder::new(settings, grid, case.n_states, case.n_observations, 3);
    let stock = Stock::new(network.parameters(), *network.shape()).expect("stock network");
    let frames = frames(
        grid,
        case.n_observations as u64,
        case.n_frames as u64,
        case.one_in,
    );
    let dropout = match case.drops {
        true => dropout(frames.len(), 2.0, coin),
        false => dropout(frames.len(), 1.0, |_, _, _| true),
    };
    let first = [0.3, -1.2, 0.7, 0.1, 2.0];
    let loss = stock.loss(&frames, &dropout, &first, case.loss);
    let loss = loss.expect("stock loss");
    let exact: f64 = loss.to_scalar().expect("a number");
    let window = Window::new(&frames);
    let got = network
        .update_with(&[Trajectory {
            window: &window,
            dropout: &dropout,
            first: &first,
        }])
        .expect("finite");
    assert!(
        (got / exact - 1.0).abs() < 1e-5,
        "loss {got}, expected {exact}"
    );
    let derivatives = loss.backward().expect("derivatives");
    let mut worst = (0.0, "");
    for (name, _, got) in network.gradient().expect("an update").iter() {
        let expected = derivatives.get(&stock.vars[name]).expect("a derivative");
        let expected: Vec<f64> = expected
            .flatten_all()
            .and_then(|d| d.to_vec1())
            .expect("numbers");
        let error = relative(got, &expected);
        assert!(error < 1e-4, "gradient of {name}: off by {error}");
        worst = if error > worst.0 {
            (error, name)
        } else {
            worst
        };
    }
    eprintln!("worst gradient: {worst:?}");
}

#[test]
fn on_paths() {
    check(CASE);
}

#[test]
fn on_full_frames() {
    check(Case {
        one_in: 1,
        n_frames: 12,
        ..CASE
    });
}

#[test]
fn with_the_sum_of_cells() {
    let kind = LossKind::SumOfCells;
    for one_in in [1, 100] {
        check(Case {
            n_frames: 12,
            one_in,
            loss: LossSettings { kind, ..CASE.loss },
            ..CASE
        });
    }
}

#[test]
fn with_exact_and_with_coarse_logarithms() {
    for log_floor in [0.0, 0.1] {
        check(Case {
            grid: [32, 32],
            n_frames: 20,
            one_in: 5,
            loss: LossSettings {
                log_floor,
                ..CASE.loss
            },
            ..CASE
        });
    }
}

#[test]
fn without_dropout() {
    check(Case {
        drops: false,
        n_frames: 20,
        ..CASE
    });
}

#[test]
fn on_a_smaller_grid_with_other_states_and_observations() {
    check(Case {
        grid: [32, 32],
        n_states: 2,
        n_observations: 4,
        ..CASE
    });
    check(Case {
        grid: [32, 32],
        n_states: 4,
        n_observations: 2,
        one_in: 3,
        ..CASE
    });
}

#[test]
fn on_a_grid_that_is_not_square() {
    check(Case {
        grid: [48, 80],
        n_states: 2,
        n_observations: 2,
        n_frames: 20,
        ..CASE
    });
    check(Case {
        grid: [48, 80],
        n_states: 4,
        n_observations: 4,
        n_frames: 20,
        one_in: 2,
        ..CASE
    });
}

#[test]
fn on_a_grid_that_must_be_padded() {
    check(Case {
        grid: [20, 33],
        one_in: 10,
        ..CASE
    });
    check(Case {
        grid: [6, 6],
        one_in: 2,
        ..CASE
    });
}
