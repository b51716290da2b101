//! The encoder's dropout, ReLU and normalisation in one pass.

use super::cpu::{frames, numbers, slice, sums_over_frames, tensor};
use super::norm::{Moments, Norm, Sums};
use crate::dropout::Mask;
use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor};

/// Positions whose sum is kept in 32 bits. A variance is a difference of two sums, so longer ones lose digits.
const ROWS: usize = 16;

/// `norm(relu(dropout(z)))`. Arguments: `z [frames, positions, channels]`; `[gamma; beta]`.
pub(crate) struct DropReluNorm {
    pub(crate) mask: Mask,
    pub(crate) moments: Moments,
}

impl DropReluNorm {
    /// The moments of `relu(dropout(z))`.
    pub(crate) fn moments(z: &Tensor, mask: &Mask) -> Result<Moments> {
        let (n_frames, positions, _) = z.dims3()?;
        let z = numbers(z)?;
        let sums = sums_of(
            &z,
            mask,
            #[inline(always)]
            |z, scale, _| {
                let m = (z * scale).max(0.0);
                [m, m * m]
            },
        );
        let count = (n_frames * positions) as f64;
        Ok(Moments::from_sums(&sums.first, &sums.with_z, count))
    }

    fn backward(&self, z: &[f32], weights: &[f32], dy: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let sums = sums_of(
            z,
            &self.mask,
            #[inline(always)]
            |z, scale, at| [dy[at], dy[at] * (z * scale).max(0.0)],
        );
        let norm = Norm::new(weights, &self.moments, 1.0);
        let (gradient, terms) = norm.backward(&sums);
        let (channels, per_frame) = (terms.len(), z.len() / self.mask.n_frames());
        let mut dz = vec![0.0; z.len()];
        let start = |frame| frame * per_frame;
        frames(
            &mut dz,
            self.mask.n_frames(),
            start,
            || (),
            #[inline(always)]
            |(): &mut (), frame: usize, dz: &mut [f32]| {
                let scales = self.mask.scales(frame);
                let z = z[frame * per_frame..][..per_frame].chunks_exact(channels);
                let dy = dy[frame * per_frame..][..per_frame].chunks_exact(channels);
                for (dz, (z, dy)) in dz.chunks_exact_mut(channels).zip(z.zip(dy)) {
                    for c in 0..channels {
                        let m = z[c] * scales[c];
                        let [p, q, r] = terms[c];
                        let d = scales[c] * (p * dy[c] + q * m + r);
                        dz[c] = if m > 0.0 { d } else { 0.0 };
                    }
                }
            },
        );
        (dz, gradient)
    }
}

/// Per channel, the sums of the two numbers that `f(z, its scale, its place)` gives.
#[inline(always)]
fn sums_of(z: &[f32], mask: &Mask, f: impl Fn(f32, f32, usize) -> [f32; 2] + Sync) -> Sums {
    let per_frame = z.len() / mask.n_frames();
    let channels = mask.channels();
    let new = || Sums::new(channels);
    let sums = sums_over_frames(
        mask.n_frames(),
        new,
        #[inline(always)]
        |sums, frame| {
            let scales = mask.scales(frame);
            let mut first = frame * per_frame;
            for rows in z[first..][..per_frame].chunks(ROWS * channels) {
                let (mut s, mut q) = (vec![0.0_f32; channels], vec![0.0_f32; channels]);
                for z in rows.chunks_exact(channels) {
                    for c in 0..channels {
                        let [one, other] = f(z[c], scales[c], first + c);
                        s[c] += one;
                        q[c] += other;
                    }
                    first += channels;
                }
                for c in 0..channels {
                    sums.first[c] += f64::from(s[c]);
                    sums.with_z[c] += f64::from(q[c]);
                }
            }
        },
    );
    Sums::total(sums)
}

impl CustomOp2 for DropReluNorm {
    fn name(&self) -> &'static str {
        "drop-relu-norm"
    }

    fn cpu_fwd(
        &self,
        z: &CpuStorage,
        z_layout: &Layout,
        weights: &CpuStorage,
        weights_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (z, weights) = (slice(z, z_layout)?, slice(weights, weights_layout)?);
        let norm = Norm::new(weights, &self.moments, 1.0);
        let (channels, per_frame) = (norm.a.len(), z.len() / self.mask.n_frames());
        let mut out = vec![0.0; z.len()];
        let start = |frame| frame * per_frame;
        frames(
            &mut out,
            self.mask.n_frames(),
            start,
            || (),
            #[inline(always)]
            |(): &mut (), frame: usize, out: &mut [f32]| {
                let scales = self.mask.scales(frame);
                let rows = z[frame * per_frame..][..per_frame].chunks_exact(channels);
                for (out, row) in out.chunks_exact_mut(channels).zip(rows) {
                    for c in 0..channels {
                        out[c] = norm.a[c] * (row[c] * scales[c]).max(0.0) + norm.b[c];
                    }
                }
            },
        );
        Ok((CpuStorage::F32(out), z_layout.shape().clone()))
    }

    fn bwd(
        &self,
        z: &Tensor,
        weights: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let arguments = [numbers(z)?, numbers(weights)?, numbers(&dy)?];
        let (dz, gradient) = self.backward(&arguments[0], &arguments[1], &arguments[2]);
        let gradient = tensor(gradient, weights.shape())?;
        Ok((Some(tensor(dz, z.shape())?), Some(gradient)))
    }
}
