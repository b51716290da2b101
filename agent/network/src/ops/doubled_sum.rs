//! Upsampling of an image by a factor of 2, sum with another image, and ReLU as one operator, for 32-bit floats on the
//! CPU. Upsampling repeats each cell.

use super::cpu::{numbers, slice};
use candle_core::{CpuStorage, CustomOp2, Device, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

/// The operator. Its arguments are images `[batch, channels, rows, cols]` and `[batch, channels, 2 rows, 2 cols]`. The
/// result has the shape of the second image.
pub(crate) struct DoubledSum;

impl CustomOp2 for DoubledSum {
    fn name(&self) -> &'static str {
        "doubled_sum"
    }

    fn cpu_fwd(
        &self,
        small: &CpuStorage,
        small_layout: &Layout,
        large: &CpuStorage,
        large_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (batch, channels, rows, cols) = small_layout.shape().dims4()?;
        if large_layout.shape().dims() != [batch, channels, 2 * rows, 2 * cols] {
            let got = large_layout.shape();
            bail!("image: expected twice {rows} x {cols} cells, got {got:?}");
        }
        let (small, mut sum) = (
            slice(small, small_layout)?,
            slice(large, large_layout)?.to_vec(),
        );
        let pairs = sum.par_chunks_mut(4 * cols).zip(small.par_chunks(cols));
        pairs
            .with_min_len(channels * rows)
            .for_each(|(sum, small)| {
                for sum in sum.chunks_exact_mut(2 * cols) {
                    for (sum, small) in sum.as_chunks_mut::<2>().0.iter_mut().zip(small) {
                        *sum = [(sum[0] + small).max(0.0), (sum[1] + small).max(0.0)];
                    }
                }
            });
        Ok((CpuStorage::F32(sum), large_layout.shape().clone()))
    }

    fn bwd(
        &self,
        small: &Tensor,
        large: &Tensor,
        sum: &Tensor,
        d_sum: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (_, channels, rows, cols) = small.dims4()?;
        let d_sum = d_sum.contiguous()?;
        let (sum, d_sum) = (numbers(sum)?, numbers(&d_sum)?);
        let mut d_large = vec![0.0; sum.len()];
        let mut d_small = vec![0.0; small.elem_count()];
        let gradients = d_large
            .par_chunks_mut(4 * cols)
            .zip(d_small.par_chunks_mut(cols));
        let results = sum.par_chunks(4 * cols).zip(d_sum.par_chunks(4 * cols));
        let all = gradients.zip(results).with_min_len(channels * rows);
        all.for_each(|((d_large, d_small), (sum, d_sum))| {
            for (to, (sum, d)) in d_large.iter_mut().zip(sum.iter().zip(d_sum)) {
                *to = d * f32::from(*sum > 0.0);
            }
            for d_large in d_large.chunks_exact(2 * cols) {
                for (d_small, pair) in d_small.iter_mut().zip(d_large.as_chunks::<2>().0) {
                    *d_small += pair[0];
                    *d_small += pair[1];
                }
            }
        });
        let tensor = |numbers, like: &Tensor| Tensor::from_vec(numbers, like.shape(), &Device::Cpu);
        Ok((Some(tensor(d_small, small)?), Some(tensor(d_large, large)?)))
    }
}
