//! The first convolution at visited cells only: its input is zero everywhere else.

use super::cpu::add;
use crate::shape::ConvShape;
use crate::window::Visit;

/// The convolution of a frame's one-hot observations: sums of rows of the kernels `[observations * kernel rows
/// * kernel cols, channels out]`. The result is `[positions, channels out]`.
pub(super) struct VisitedConv(pub(super) ConvShape);

impl VisitedConv {
    /// Adds a frame's result.
    #[inline(always)]
    pub(super) fn forward(&self, visits: &[Visit], kernels: &[f32], out: &mut [f32]) {
        let n = self.0.channels_out;
        self.for_each(visits, |position, row| {
            add(&mut out[position * n..][..n], &kernels[row * n..][..n]);
        });
    }

    /// Adds gradients of the kernels.
    #[inline(always)]
    pub(super) fn backward(&self, visits: &[Visit], d_out: &[f32], d_kernels: &mut [f32]) {
        let n = self.0.channels_out;
        self.for_each(visits, |position, row| {
            add(&mut d_kernels[row * n..][..n], &d_out[position * n..][..n]);
        });
    }

    /// Calls `f(position, row of the kernels)` wherever a visited cell is in a patch.
    #[inline(always)]
    fn for_each(&self, visits: &[Visit], mut f: impl FnMut(usize, usize)) {
        let ([rows, cols], stride) = (self.0.kernel, self.0.stride);
        let [out_rows, out_cols] = self.0.output;
        let patches = |at: usize, side: usize, n: usize| {
            let first = (at + 1).saturating_sub(side).div_ceil(stride);
            first..n.min(at / stride + 1)
        };
        for visit in visits {
            let (row, col) = (usize::from(visit.row), usize::from(visit.col));
            for i in patches(row, rows, out_rows) {
                for j in patches(col, cols, out_cols) {
                    let tap = (row - i * stride) * cols + col - j * stride;
                    f(
                        i * out_cols + j,
                        usize::from(visit.value) * rows * cols + tap,
                    );
                }
            }
        }
    }
}
