//! The encoder's dense convolutions, frame by frame: a product of the frame's patches and the kernels.

use super::cpu::{frames, numbers, slice, tensor, total};
use super::product::{Left, Right, add_product, steps};
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};

/// Arguments: `x [frames, rows, cols, channels in]`; kernels `[kernel rows * kernel cols * channels in,
/// channels out]`. The result is `[frames, positions, channels out]`.
pub(crate) struct Conv {
    /// Rows and columns.
    pub(crate) kernel: [usize; 2],
    pub(crate) stride: usize,
}

/// Sizes and places of one call.
struct Sizes {
    per_input: usize,
    /// Numbers of one row of a patch, which lie side by side in the frame.
    run: usize,
    /// Numbers of a patch.
    patch: usize,
    channels_out: usize,
    /// Where in the frame each patch begins.
    positions: Vec<usize>,
    /// Where in the frame the rows of a patch begin, after its first number.
    runs: Vec<usize>,
}

impl Sizes {
    /// Where in the frame each number of a patch lies, after its first.
    fn numbers(&self) -> Vec<usize> {
        let numbers = self.runs.iter().flat_map(|run| *run..run + self.run);
        numbers.collect()
    }

    fn per_output(&self) -> usize {
        self.positions.len() * self.channels_out
    }

    /// Where in the result each position's numbers begin.
    fn outputs(&self) -> Vec<usize> {
        steps(self.positions.len(), self.channels_out)
    }
}

impl Conv {
    fn sizes(&self, x: &[usize], kernels: &[usize]) -> Sizes {
        let [_, rows, cols, channels] = *x else {
            unreachable!("invariant: four dimensions");
        };
        let n = |side: usize, kernel: usize| (side - kernel) / self.stride + 1;
        let (n_rows, n_cols) = (n(rows, self.kernel[0]), n(cols, self.kernel[1]));
        let position = |at: usize| (at / n_cols * cols + at % n_cols) * self.stride * channels;
        Sizes {
            per_input: rows * cols * channels,
            run: self.kernel[1] * channels,
            patch: kernels[0],
            channels_out: kernels[1],
            positions: (0..n_rows * n_cols).map(position).collect(),
            runs: steps(self.kernel[0], cols * channels),
        }
    }

    fn forward(&self, sizes: &Sizes, x: &[f32], kernels: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; x.len() / sizes.per_input * sizes.per_output()];
        let (numbers, outputs) = (sizes.numbers(), sizes.outputs());
        let right = Right {
            numbers: kernels,
            terms: &steps(sizes.patch, sizes.channels_out),
            cols: sizes.channels_out,
        };
        let one = |(): &mut (), frame: usize, out: &mut [f32]| {
            let left = Left {
                numbers: &x[frame * sizes.per_input..][..sizes.per_input],
                rows: &sizes.positions,
                terms: &numbers,
            };
            add_product(out, &outputs, left, right);
        };
        let start = |frame| frame * sizes.per_output();
        frames(&mut out, x.len() / sizes.per_input, start, || (), one);
        out
    }

    /// Gradients of `x` and the kernels.
    fn backward(&self, sizes: &Sizes, x: &[f32], kernels: &[f32], d_out: &[f32]) -> [Vec<f32>; 2] {
        let (patch, n, run) = (sizes.patch, sizes.channels_out, sizes.run);
        let turned: Vec<f32> = (0..kernels.len())
            .map(|at| kernels[at % patch * n + at / patch])
            .collect();
        let (numbers, outputs) = (sizes.numbers(), sizes.outputs());
        let (channels, rows) = (steps(n, 1), steps(patch, n));
        let mut dx = vec![0.0; x.len()];
        let new = || vec![0.0; kernels.len()];
        let one = |d_kernels: &mut Vec<f32>, frame: usize, dx: &mut [f32]| {
            let d_out = &d_out[frame * sizes.per_output()..][..sizes.per_output()];
            let patches = Left {
                numbers: &x[frame * sizes.per_input..][..sizes.per_input],
                rows: &numbers,
                terms: &sizes.positions,
            };
            let right = Right {
                numbers: d_out,
                terms: &outputs,
                cols: n,
            };
            add_product(d_kernels, &rows, patches, right);
            let left = Left {
                numbers: d_out,
                rows: &outputs,
                terms: &channels,
            };
            for (index, from) in sizes.runs.iter().enumerate() {
                let right = Right {
                    numbers: &turned[index * run..],
                    terms: &steps(n, patch),
                    cols: run,
                };
                add_product(&mut dx[*from..], &sizes.positions, left, right);
            }
        };
        let start = |frame| frame * sizes.per_input;
        let sums = frames(&mut dx, x.len() / sizes.per_input, start, new, one);
        [dx, total(sums)]
    }
}

impl CustomOp2 for Conv {
    fn name(&self) -> &'static str {
        "conv"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        kernels: &CpuStorage,
        kernels_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let sizes = self.sizes(x_layout.dims(), kernels_layout.dims());
        let (x, kernels) = (slice(x, x_layout)?, slice(kernels, kernels_layout)?);
        let out = self.forward(&sizes, x, kernels);
        let dims = (
            x_layout.dims()[0],
            sizes.positions.len(),
            sizes.channels_out,
        );
        Ok((CpuStorage::F32(out), dims.into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        kernels: &Tensor,
        _out: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let sizes = self.sizes(x.dims(), kernels.dims());
        let d_out = d_out.contiguous()?;
        let [dx, d_kernels] =
            self.backward(&sizes, &numbers(x)?, &numbers(kernels)?, &numbers(&d_out)?);
        let d_kernels = tensor(d_kernels, kernels.shape())?;
        Ok((Some(tensor(dx, x.shape())?), Some(d_kernels)))
    }
}
