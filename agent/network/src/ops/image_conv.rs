//! A convolution with bias and ReLU as one operator: channels last, 32-bit floats on the CPU.
//!
//! No patch is copied: in an image with a frame of zeros, the numbers of each patch lie at the same distances from its
//! first one, so the framed image is a factor of a product as it is. The gradient of the image is a convolution of the
//! gradient of the result, with zeros between its cells where there was a stride.

use super::cpu::{N_CHUNKS, add, numbers, total};
use super::product::{Left, Right, add_product, steps};
use candle_core::{CpuStorage, CustomOp3, Device, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

/// A convolution that keeps the image's size, or divides it by the stride.
///
/// Arguments: images `[batch, rows, cols, channels in]`, weights `[kernel * kernel * channels in, channels out]`, bias
/// `[channels out]`. Result: `[batch, rows / stride, cols / stride, channels out]`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ImageConv {
    /// Side of the kernel, odd.
    pub(crate) kernel: usize,
    pub(crate) stride: usize,
    pub(crate) dilation: usize,
    /// Whether negative results become 0.
    pub(crate) relu: bool,
}

impl CustomOp3 for ImageConv {
    fn name(&self) -> &'static str {
        "image_conv"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weights: &CpuStorage,
        weights_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (batch, out, plan) = self.plan(x_layout.shape(), weights_layout.shape())?;
        let (x, weights) = (slice(x, x_layout)?, slice(weights, weights_layout)?);
        let mut y = slice(bias, bias_layout)?.repeat(batch * plan.positions.len());
        let images = batch.div_ceil(N_CHUNKS);
        let part = |(x, y): (&[f32], &mut [f32])| {
            let mut framed = plan.framed();
            for (x, y) in x.chunks(plan.image).zip(y.chunks_mut(plan.result)) {
                plan.frame(x, &mut framed);
                plan.add_result(&framed, weights, y);
                if self.relu {
                    y.iter_mut().for_each(|y| *y = y.max(0.0));
                }
            }
        };
        if batch == 1 {
            // Handing it to another thread costs more than it gains.
            part((x, &mut y));
        } else {
            let y = y.par_chunks_mut(images * plan.result);
            x.par_chunks(images * plan.image).zip(y).for_each(part);
        }
        Ok((CpuStorage::F32(y), out))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weights: &Tensor,
        bias: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (batch, _, plan) = self.plan(x.shape(), weights.shape())?;
        let (turned, back) = self.turned(weights, y.shape())?;
        let back = Back {
            conv: *self,
            plan,
            turned: &numbers(&turned)?,
            // A tensor that is no result, as the first image, needs no gradient.
            plan_of_image: x.track_op().then_some(back),
        };
        let dy = dy.contiguous()?;
        let (x_numbers, y, dy) = (numbers(x)?, numbers(y)?, numbers(&dy)?);
        let images = batch.div_ceil(N_CHUNKS);
        let [n_x, n_y] = [back.plan.image, back.plan.result].map(|n| n * images);
        let mut dx = vec![0.0; x_numbers.len()];
        let values = x_numbers.par_chunks(n_x).zip(y.par_chunks(n_y));
        let gradients = dy.par_chunks(n_y).zip(dx.par_chunks_mut(n_x));
        let parts = values.zip(gradients);
        let sums: Vec<_> = parts
            .map(|((x, y), (dy, dx))| back.part(x, y, dy, dx))
            .collect();
        let mut d_weights = total(sums);
        let d_bias = d_weights.split_off(weights.elem_count());
        let tensor = |numbers, like: &Tensor| Tensor::from_vec(numbers, like.shape(), &Device::Cpu);
        let dx = x.track_op().then(|| tensor(dx, x)).transpose()?;
        Ok((
            dx,
            Some(tensor(d_weights, weights)?),
            Some(tensor(d_bias, bias)?),
        ))
    }
}

impl ImageConv {
    /// The batch, the result's shape, and how an image becomes its result.
    fn plan(&self, x: &Shape, weights: &Shape) -> Result<(usize, Shape, Plan)> {
        let (batch, rows, cols, channels) = x.dims4()?;
        let (patch, n) = weights.dims2()?;
        let Self { kernel, stride, .. } = *self;
        if patch != kernel * kernel * channels || rows % stride + cols % stride > 0 {
            bail!("weights {weights:?} or stride {stride} do not fit images {x:?}");
        }
        let out = (batch, rows / stride, cols / stride, n).into();
        let plan = Plan::new([rows, cols], [channels, n], self, [1, stride]);
        Ok((batch, out, plan))
    }

    /// Weights and plan by which the gradient of a result becomes that of its image.
    fn turned(&self, weights: &Tensor, y: &Shape) -> Result<(Tensor, Plan)> {
        let (taps, (_, rows, cols, n)) = (self.kernel * self.kernel, y.dims4()?);
        let turned = weights.reshape((taps, (), n))?.flip(&[0])?;
        let turned = turned.transpose(1, 2)?.contiguous()?;
        let channels = [n, turned.dim(2)?];
        let plan = Plan::new([rows, cols], channels, self, [self.stride, 1]);
        Ok((turned, plan))
    }
}

/// What the gradients of a part of the batch need.
struct Back<'a> {
    conv: ImageConv,
    plan: Plan,
    turned: &'a [f32],
    plan_of_image: Option<Plan>,
}

impl Back<'_> {
    /// Writes the gradient of some images; returns that of the weights, then that of the bias.
    fn part(&self, x: &[f32], y: &[f32], dy: &[f32], dx: &mut [f32]) -> Vec<f32> {
        let plan = &self.plan;
        let mut sums = vec![0.0; self.turned.len() + plan.channels_out];
        let (d_weights, d_bias) = sums.split_at_mut(self.turned.len());
        let mut framed = plan.framed();
        let mut dz_framed = self.plan_of_image.as_ref().map(Plan::framed);
        let mut dz = vec![0.0; plan.result];
        let images = x.chunks(plan.image).zip(dx.chunks_mut(plan.image));
        let results = y.chunks(plan.result).zip(dy.chunks(plan.result));
        for ((x, dx), (y, dy)) in images.zip(results) {
            for ((dz, y), dy) in dz.iter_mut().zip(y).zip(dy) {
                *dz = dy * f32::from(!self.conv.relu || *y > 0.0);
            }
            dz.chunks(d_bias.len()).for_each(|dz| add(d_bias, dz));
            plan.frame(x, &mut framed);
            plan.add_gradient(&framed, &dz, d_weights);
            if let (Some(back), Some(framed)) = (&self.plan_of_image, &mut dz_framed) {
                back.frame(&dz, framed);
                back.add_result(framed, self.turned, dx);
            }
        }
        sums
    }
}

/// Where the numbers of a framed image, of its patches and of their results lie.
struct Plan {
    /// Numbers of an image, of what is copied at once, and of the result.
    image: usize,
    run: usize,
    result: usize,
    /// Numbers of a framed image, and where the runs of the image begin there.
    framed: usize,
    runs: Vec<usize>,
    /// Where each patch begins in a framed image, and each number in a patch.
    positions: Vec<usize>,
    numbers: Vec<usize>,
    /// Where the result of each patch begins, and the weights of each number.
    results: Vec<usize>,
    weights: Vec<usize>,
    channels_out: usize,
}

impl Plan {
    /// For images of `[rows, cols]`. `spread`: the step between an image's cells in its frame, with zeros between them;
    /// `stride`: that between patches.
    fn new(
        [rows, cols]: [usize; 2],
        [channels, n]: [usize; 2],
        conv: &ImageConv,
        [spread, stride]: [usize; 2],
    ) -> Self {
        let frame = conv.dilation * (conv.kernel / 2);
        let framed_row = (cols * spread + 2 * frame) * channels;
        let grid = |rows: usize, cols: usize, step: usize| -> Vec<usize> {
            let places = (0..rows * cols).map(|at| at / cols * framed_row + at % cols * channels);
            places.map(|place| place * step).collect()
        };
        let cells_at_once = if spread == 1 { cols } else { 1 };
        let corner = frame * (framed_row + channels);
        let runs = grid(rows, cols, spread).into_iter().step_by(cells_at_once);
        let positions = grid(rows * spread / stride, cols * spread / stride, stride);
        let taps = grid(conv.kernel, conv.kernel, conv.dilation);
        Self {
            image: rows * cols * channels,
            run: cells_at_once * channels,
            result: positions.len() * n,
            framed: (rows * spread + 2 * frame) * framed_row,
            runs: runs.map(|run| corner + run).collect(),
            results: steps(positions.len(), n),
            positions,
            weights: steps(taps.len() * channels, n),
            numbers: taps
                .into_iter()
                .flat_map(|tap| tap..tap + channels)
                .collect(),
            channels_out: n,
        }
    }

    /// An empty frame.
    fn framed(&self) -> Vec<f32> {
        vec![0.0; self.framed]
    }

    fn frame(&self, image: &[f32], framed: &mut [f32]) {
        for (run, from) in self.runs.iter().zip(image.chunks(self.run)) {
            framed[*run..][..self.run].copy_from_slice(from);
        }
    }

    /// Adds the products of patches and weights.
    fn add_result(&self, framed: &[f32], weights: &[f32], result: &mut [f32]) {
        let left = Left {
            numbers: framed,
            rows: &self.positions,
            terms: &self.numbers,
        };
        let right = Right {
            numbers: weights,
            terms: &self.weights,
            cols: self.channels_out,
        };
        add_product(result, &self.results, left, right);
    }

    /// Adds gradients of the weights.
    fn add_gradient(&self, framed: &[f32], d_result: &[f32], d_weights: &mut [f32]) {
        let left = Left {
            numbers: framed,
            rows: &self.numbers,
            terms: &self.positions,
        };
        let right = Right {
            numbers: d_result,
            terms: &self.results,
            cols: self.channels_out,
        };
        add_product(d_weights, &self.weights, left, right);
    }
}

/// The numbers of a contiguous tensor.
fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (CpuStorage::F32(numbers), Some((start, end))) => Ok(&numbers[start..end]),
        _ => bail!("expected contiguous 32-bit floats on the CPU"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::variables::normal;
    use candle_core::{DType, Var};
    use emberwatch_model::randomness::{Purpose, stream};

    fn random(shape: &[usize], seed: u64) -> Var {
        let mut rng = stream(seed, Purpose::Weights, 0);
        let numbers = (0..shape.iter().product()).map(|_| normal(&mut rng));
        let tensor = Tensor::from_vec(numbers.collect(), shape, &Device::Cpu);
        tensor
            .and_then(|it| Var::from_tensor(&it))
            .expect("numbers")
    }

    /// The largest difference, in parts of the largest number.
    fn off(got: &Tensor, expected: &Tensor) -> Result<f64> {
        let got = got.to_dtype(DType::F64)?;
        let largest = |tensor: &Tensor| tensor.abs()?.max_all()?.to_scalar::<f64>();
        Ok(largest(&(got - expected)?)? / largest(expected)?)
    }

    /// The operator in 32 bits and candle's layers in 64: results, and gradients of their sum with random weights.
    fn check(conv: ImageConv, batch: usize, n: usize) -> Result<()> {
        let ImageConv {
            kernel,
            stride,
            dilation,
            relu,
        } = conv;
        let (x, bias) = (random(&[batch, 8, 12, 7], 1), random(&[n], 2));
        let weights = random(&[kernel * kernel * 7, n], 3);
        // A result, so that its gradient is computed.
        let image = (x.as_tensor() * 1.0)?;
        let got = image.apply_op3(&weights, &bias, conv)?;
        let vars = [x, weights, bias];
        let exact = vars.each_ref().map(|var| var.to_dtype(DType::F64));
        let exact = exact.map(|it| it.and_then(|it| Var::from_tensor(&it)));
        let exact: Vec<Var> = exact.into_iter().collect::<Result<_>>()?;
        let kernels = exact[1].reshape((kernel, kernel, 7, n))?;
        let kernels = kernels.permute((3, 2, 0, 1))?.contiguous()?;
        let image = exact[0].permute((0, 3, 1, 2))?.contiguous()?;
        let stock = image.conv2d(&kernels, dilation * (kernel / 2), stride, dilation, 1)?;
        let stock = stock.permute((0, 2, 3, 1))?.broadcast_add(&exact[2])?;
        let stock = if relu { stock.relu()? } else { stock };
        assert!(off(&got, &stock)? < 1e-6, "{conv:?}");
        let factors = random(got.dims(), 4);
        let gradients = (got * factors.as_tensor())?.sum_all()?.backward()?;
        let factors = factors.to_dtype(DType::F64)?;
        let expected = (stock * factors)?.sum_all()?.backward()?;
        for (var, exact) in vars.iter().zip(&exact) {
            let gradients = gradients.get(var).zip(expected.get(exact));
            let (got, expected) = gradients.expect("gradients of both");
            assert!(off(got, expected)? < 3e-6, "{conv:?}: {:?}", var.dims());
        }
        Ok(())
    }

    #[test]
    fn results_and_gradients_are_those_of_candles_layers_in_64_bits() {
        for kernel in [1, 3, 5] {
            for (stride, dilation, relu, n) in [
                (1, 1, true, 5),
                (2, 1, false, 24),
                (1, 2, true, 33),
                (2, 3, true, 1),
            ] {
                let conv = ImageConv {
                    kernel,
                    stride,
                    dilation,
                    relu,
                };
                for batch in [1, 9] {
                    check(conv, batch, n).expect("computed");
                }
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let conv = ImageConv {
            kernel: 3,
            stride: 2,
            dilation: 1,
            relu: true,
        };
        let refused = |x: &[usize], weights: &[usize]| {
            let (x, weights) = (random(x, 1), random(weights, 2));
            x.apply_op3(&weights, &random(&[4], 3), conv).is_err()
        };
        assert!(!refused(&[1, 4, 4, 2], &[18, 4]));
        assert!(refused(&[1, 5, 4, 2], &[18, 4]), "an odd side");
        assert!(refused(&[1, 4, 4, 3], &[18, 4]), "other channels");
    }
}
