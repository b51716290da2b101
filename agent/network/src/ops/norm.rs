//! The arithmetic of batch normalisation: `y = a z + b` per channel.

use super::cpu::{frames, numbers, sums_over_frames, total};
use super::planes::Planes;
use crate::dropout::Mask;
use candle_core::{Result, Tensor};

/// Added to the variance, as PyTorch does.
pub(crate) const EPSILON: f64 = 1e-5;

/// Mean and variance of each channel, over all frames and positions.
#[derive(Debug, Clone)]
pub(crate) struct Moments {
    pub(crate) mean: Vec<f64>,
    /// Of the population: divided by the number of values.
    pub(crate) variance: Vec<f64>,
    /// Values per channel.
    pub(crate) count: f64,
}

impl Moments {
    /// Of a tensor `[planes, rows, cols]` after dropout: lost channels are zeros, whatever the tensor has there.
    pub(crate) fn of(z: &Tensor, mask: &Mask) -> Result<Self> {
        let (_, rows, cols) = z.dims3()?;
        let (n_frames, area, z) = (mask.n_frames(), rows * cols, numbers(z)?);
        let planes = Planes::new(&z, area, mask);
        let new = || Sums::new(mask.channels());
        let sums = sums_over_frames(
            n_frames,
            new,
            #[inline(always)]
            |sums, frame| {
                for (channel, plane) in planes.kept(frame) {
                    sums.add(channel, plane, plane);
                }
            },
        );
        let mut sums = Sums::total(sums);
        let scale = f64::from(mask.scale());
        sums.first.iter_mut().for_each(|sum| *sum *= scale);
        let squares = sums.with_z.iter_mut();
        squares.for_each(|sum| *sum *= scale * scale);
        Ok(Self::from_sums(
            &sums.first,
            &sums.with_z,
            (n_frames * area) as f64,
        ))
    }

    /// From sums of values and of their squares.
    pub(crate) fn from_sums(sums: &[f64], squares: &[f64], count: f64) -> Self {
        let mean: Vec<f64> = sums.iter().map(|sum| sum / count).collect();
        let variance = squares.iter().zip(&mean);
        let variance = variance.map(|(square, mean)| (square / count - mean * mean).max(0.0));
        Self {
            variance: variance.collect(),
            mean,
            count,
        }
    }
}

/// Per channel, sums over all positions.
#[derive(Debug, Clone)]
pub(crate) struct Sums {
    /// Of `dy` at kept positions.
    pub(crate) first: Vec<f64>,
    /// Of `dy z` at kept positions.
    pub(crate) with_z: Vec<f64>,
    /// Of `dy` at lost positions.
    pub(crate) lost: Vec<f64>,
}

impl Sums {
    pub(crate) fn new(channels: usize) -> Self {
        let zeros = vec![0.0; channels];
        Self {
            first: zeros.clone(),
            with_z: zeros.clone(),
            lost: zeros,
        }
    }

    /// Adds a plane of a kept channel.
    #[inline(always)]
    pub(crate) fn add(&mut self, channel: usize, dy: &[f32], z: &[f32]) {
        let (mut s, mut q) = ([0.0_f32; 8], [0.0_f32; 8]);
        let ((dy, dy_rest), (z, z_rest)) = (dy.as_chunks::<8>(), z.as_chunks::<8>());
        for (dy, z) in dy_rest.iter().zip(z_rest) {
            s[0] += dy;
            q[0] += dy * z;
        }
        for (dy, z) in dy.iter().zip(z) {
            for lane in 0..8 {
                s[lane] += dy[lane];
                q[lane] += dy[lane] * z[lane];
            }
        }
        self.first[channel] += f64::from(s.iter().sum::<f32>());
        self.with_z[channel] += f64::from(q.iter().sum::<f32>());
    }

    pub(crate) fn total(chunks: Vec<Self>) -> Self {
        let of = |part: fn(&Self) -> &Vec<f64>| total(chunks.iter().map(|sums| part(sums).clone()));
        Self {
            first: of(|sums| &sums.first),
            with_z: of(|sums| &sums.with_z),
            lost: of(|sums| &sums.lost),
        }
    }
}

/// A normalisation whose moments are known. At kept positions `y = a z + b`; at lost ones `y = b`.
pub(crate) struct Norm {
    pub(crate) a: Vec<f32>,
    pub(crate) b: Vec<f32>,
    gamma: Vec<f64>,
    /// One by the deviation.
    inverse: Vec<f64>,
    moments: Moments,
    scale: f64,
}

impl Norm {
    /// From `[gamma; beta]`, and what dropout multiplies kept values with.
    pub(crate) fn new(weights: &[f32], moments: &Moments, scale: f32) -> Self {
        let channels = moments.mean.len();
        let scale = f64::from(scale);
        let inverse = moments.variance.iter();
        let inverse: Vec<f64> = inverse.map(|v| 1.0 / (v + EPSILON).sqrt()).collect();
        let gamma: Vec<f64> = weights[..channels].iter().map(|&g| f64::from(g)).collect();
        let a = |c: usize| (scale * gamma[c] * inverse[c]) as f32;
        let b = |c: usize| {
            (f64::from(weights[channels + c]) - gamma[c] * inverse[c] * moments.mean[c]) as f32
        };
        Self {
            a: (0..channels).map(a).collect(),
            b: (0..channels).map(b).collect(),
            moments: moments.clone(),
            gamma,
            inverse,
            scale,
        }
    }

    /// The gradient of `[gamma; beta]`, and per channel `[p, q, r]` with `dz = p dy + q z + r` at kept
    /// positions.
    pub(crate) fn backward(&self, sums: &Sums) -> (Vec<f32>, Vec<[f32; 3]>) {
        let (channels, count) = (self.a.len(), self.moments.count);
        let mut gradient = vec![0.0; 2 * channels];
        let terms = (0..channels).map(|c| {
            let (inverse, mean) = (self.inverse[c], self.moments.mean[c]);
            let dy = sums.first[c] + sums.lost[c];
            let dy_x = inverse * (self.scale * sums.with_z[c] - mean * dy);
            (gradient[c], gradient[channels + c]) = (dy_x as f32, dy as f32);
            let p = self.scale * self.gamma[c] * inverse;
            let q = -p * dy_x / count * inverse * self.scale;
            let r = -p * (dy / count - mean * inverse * dy_x / count);
            [p as f32, q as f32, r as f32]
        });
        let terms = terms.collect();
        (gradient, terms)
    }
}

/// Puts `dz` in place of `dy` at kept channels.
pub(super) fn finish(terms: &[[f32; 3]], z: &Planes<'_>, dy: &mut [f32]) {
    let start = |frame| z.start(frame);
    frames(
        dy,
        z.mask().n_frames(),
        start,
        || (),
        #[inline(always)]
        |(): &mut (), frame: usize, dy: &mut [f32]| {
            for (index, (channel, z_plane)) in z.kept(frame).enumerate() {
                let [p, q, r] = terms[channel];
                let dy = &mut dy[z.place(frame, index)..][..z_plane.len()];
                for (dy, z) in dy.iter_mut().zip(z_plane) {
                    *dy = p * *dy + q * z + r;
                }
            }
        },
    );
}
