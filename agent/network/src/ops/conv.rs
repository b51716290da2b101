//! The encoder's dense convolutions, frame by frame: a product of the frame's patches and the kernels.

use super::cpu::{add, frames, matrix, numbers, product, slice, tensor, total};
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};

/// Arguments: `x [frames, rows, cols, channels in]`; kernels `[kernel rows * kernel cols * channels in,
/// channels out]`. The result is `[frames, positions, channels out]`.
pub(crate) struct Conv {
    /// Rows and columns.
    pub(crate) kernel: [usize; 2],
    pub(crate) stride: usize,
}

/// Sizes of one call.
struct Sizes {
    input: [usize; 3],
    output: [usize; 2],
    /// Numbers of a patch.
    patch: usize,
    channels_out: usize,
}

impl Sizes {
    fn per_input(&self) -> usize {
        self.input.iter().product()
    }

    fn positions(&self) -> usize {
        self.output[0] * self.output[1]
    }
}

impl Conv {
    fn sizes(&self, x: &[usize], kernels: &[usize]) -> Sizes {
        let output = [0, 1].map(|axis| (x[axis + 1] - self.kernel[axis]) / self.stride + 1);
        Sizes {
            input: [x[1], x[2], x[3]],
            output,
            patch: kernels[0],
            channels_out: kernels[1],
        }
    }

    /// Numbers of one row of a patch, which lie side by side in the frame.
    fn run(&self, sizes: &Sizes) -> usize {
        self.kernel[1] * sizes.input[2]
    }

    /// Where each of them begins in the frame, patch by patch.
    fn runs(&self, sizes: &Sizes) -> impl Iterator<Item = usize> {
        let ([_, cols, channels], [_, out_cols]) = (sizes.input, sizes.output);
        let (stride, rows) = (self.stride, self.kernel[0]);
        (0..sizes.positions() * rows).map(move |run| {
            let (position, row) = (run / rows, run % rows);
            let (i, j) = (position / out_cols, position % out_cols);
            ((i * stride + row) * cols + j * stride) * channels
        })
    }

    fn gather(&self, sizes: &Sizes, x: &[f32], patches: &mut [f32]) {
        let run = self.run(sizes);
        for (at, to) in self.runs(sizes).zip(patches.chunks_exact_mut(run)) {
            to.copy_from_slice(&x[at..][..run]);
        }
    }

    /// Gradients of `x` and the kernels.
    fn backward(&self, sizes: &Sizes, x: &[f32], kernels: &[f32], d_out: &[f32]) -> [Vec<f32>; 2] {
        let (positions, patch, channels) = (sizes.positions(), sizes.patch, sizes.channels_out);
        let mut dx = vec![0.0; x.len()];
        let new = || (vec![0.0; positions * patch], vec![0.0; kernels.len()]);
        let sums = frames(
            &mut dx,
            sizes.per_input(),
            new,
            |(patches, d_kernels), frame, dx| {
                let d_out = &d_out[frame * positions * channels..];
                let d_out = matrix(d_out, positions, channels);
                self.gather(sizes, &x[frame * dx.len()..][..dx.len()], patches);
                product(
                    d_kernels,
                    matrix(patches, positions, patch).t(),
                    d_out,
                    true,
                );
                product(patches, d_out, matrix(kernels, patch, channels).t(), false);
                let run = self.run(sizes);
                for (at, from) in self.runs(sizes).zip(patches.chunks_exact(run)) {
                    add(&mut dx[at..][..run], from);
                }
            },
        );
        let d_kernels = total(sums.into_iter().map(|(_, d_kernels)| d_kernels));
        [dx, d_kernels]
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
        let (positions, patch, channels) = (sizes.positions(), sizes.patch, sizes.channels_out);
        let (per_input, n_frames) = (sizes.per_input(), x_layout.dims()[0]);
        let mut out = vec![0.0; n_frames * positions * channels];
        let new = || vec![0.0; positions * patch];
        frames(
            &mut out,
            positions * channels,
            new,
            |patches, frame, out| {
                self.gather(&sizes, &x[frame * per_input..][..per_input], patches);
                let patches = matrix(patches, positions, patch);
                product(out, patches, matrix(kernels, patch, channels), false);
            },
        );
        Ok((CpuStorage::F32(out), (n_frames, positions, channels).into()))
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
