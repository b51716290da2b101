//! The first convolution at visited cells only: its input is zero everywhere else.

use super::cpu::{add, frames, numbers, slice, sums_over_frames, tensor, total};
use crate::shape::ConvShape;
use crate::window::Window;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};

/// The convolution of one-hot observations: sums of rows of the kernels, and the bias.
///
/// Arguments: kernels `[observations * kernel rows * kernel cols, channels out]`; biases `[channels out]`.
/// The result is `[frames, positions, channels out]`.
pub(crate) struct VisitedConv {
    pub(crate) shape: ConvShape,
    pub(crate) window: Window,
}

impl VisitedConv {
    /// Calls `f(position, row of the kernels)` wherever a visited cell is in a patch.
    #[inline(always)]
    fn for_each(&self, frame: usize, mut f: impl FnMut(usize, usize)) {
        let ([rows, cols], stride) = (self.shape.kernel, self.shape.stride);
        let [out_rows, out_cols] = self.shape.output;
        let patches = |at: usize, side: usize, n: usize| {
            let first = (at + 1).saturating_sub(side).div_ceil(stride);
            first..n.min(at / stride + 1)
        };
        for visit in self.window.visits(frame) {
            let (row, col) = (usize::from(visit.row), usize::from(visit.col));
            for i in patches(row, rows, out_rows) {
                for j in patches(col, cols, out_cols) {
                    let tap = (row - i * stride) * cols + col - j * stride;
                    let kernel = usize::from(visit.value) * rows * cols + tap;
                    f(i * out_cols + j, kernel);
                }
            }
        }
    }

    fn positions(&self) -> usize {
        self.shape.output[0] * self.shape.output[1]
    }
}

impl CustomOp2 for VisitedConv {
    fn name(&self) -> &'static str {
        "visited-conv"
    }

    fn cpu_fwd(
        &self,
        kernels: &CpuStorage,
        kernels_layout: &Layout,
        biases: &CpuStorage,
        biases_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let kernels = slice(kernels, kernels_layout)?;
        let biases = slice(biases, biases_layout)?;
        let (n, positions, n_frames) = (biases.len(), self.positions(), self.window.len());
        let mut out = vec![0.0; n_frames * positions * n];
        let start = |frame| frame * positions * n;
        frames(
            &mut out,
            n_frames,
            start,
            || (),
            #[inline(always)]
            |(), frame, out| {
                let places = out.chunks_exact_mut(n);
                places.for_each(|out| out.copy_from_slice(biases));
                self.for_each(frame, |position, row| {
                    add(&mut out[position * n..][..n], &kernels[row * n..][..n]);
                });
            },
        );
        Ok((CpuStorage::F32(out), (n_frames, positions, n).into()))
    }

    fn bwd(
        &self,
        kernels: &Tensor,
        biases: &Tensor,
        _out: &Tensor,
        d_out: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (n, positions) = (biases.dim(0)?, self.positions());
        let d_out = d_out.contiguous()?;
        let d_out = numbers(&d_out)?;
        let d_out: &[f32] = &d_out;
        let new = || (vec![0.0; kernels.elem_count()], vec![0.0; n]);
        let sums = sums_over_frames(
            self.window.len(),
            new,
            #[inline(always)]
            |(d_kernels, d_biases), frame| {
                let d_out = &d_out[frame * positions * n..][..positions * n];
                for d_out in d_out.chunks_exact(n) {
                    add(d_biases, d_out);
                }
                self.for_each(frame, |position, row| {
                    add(&mut d_kernels[row * n..][..n], &d_out[position * n..][..n]);
                });
            },
        );
        let (d_kernels, d_biases): (Vec<_>, Vec<_>) = sums.into_iter().unzip();
        let d_kernels = tensor(total(d_kernels), kernels.shape())?;
        let d_biases = tensor(total(d_biases), biases.shape())?;
        Ok((Some(d_kernels), Some(d_biases)))
    }
}
