//! The arithmetic of batch normalisation: `y = a z + b` per channel.

use super::cpu::total;

/// A constant that is added to the variance, as in PyTorch.
pub(crate) const EPSILON: f64 = 1e-5;

#[derive(Debug, Clone)]
pub(crate) struct Moments {
    pub(crate) mean: Vec<f64>,
    /// The population variance, divided by the number of values.
    pub(crate) variance: Vec<f64>,
    pub(crate) count: f64,
}

impl Moments {
    /// Computes moments from sums of values and of their squares, both taken before values are multiplied by `scale`.
    pub(super) fn new(sums: &Sums, scale: f32, count: usize) -> Self {
        let (scale, count) = (f64::from(scale), count as f64);
        let mean: Vec<f64> = sums.first.iter().map(|sum| scale * sum / count).collect();
        let variance = sums.with_z.iter().zip(&mean);
        let variance = variance.map(|(sum, mean)| scale * scale * sum / count - mean * mean);
        Self {
            variance: variance.map(|variance| variance.max(0.0)).collect(),
            mean,
            count,
        }
    }
}

/// Sums over all positions, per channel. The backward pass sums `dy` and `dy z`. For moments, the sums are over `z` and
/// `z^2` instead.
#[derive(Debug, Clone)]
pub(super) struct Sums {
    /// The sum of `dy` at kept positions.
    pub(super) first: Vec<f64>,
    /// The sum of `dy z` at kept positions.
    pub(super) with_z: Vec<f64>,
    /// The sum of `dy` at dropped positions.
    pub(super) lost: Vec<f64>,
}

impl Sums {
    pub(super) fn new(channels: usize) -> Self {
        let zeros = vec![0.0; channels];
        Self {
            first: zeros.clone(),
            with_z: zeros.clone(),
            lost: zeros,
        }
    }

    #[inline(always)]
    pub(super) fn add(
        &mut self,
        channel: usize,
        [a, b]: [&[f32]; 2],
        f: impl Fn(f32, f32) -> [f32; 2],
    ) {
        const LANES: usize = 16;
        // Keep 32-bit sums short: a variance is a difference of two sums, and long sums have large rounding errors.
        for (a, b) in a.chunks(16 * LANES).zip(b.chunks(16 * LANES)) {
            let (mut first, mut second) = ([0.0_f32; LANES], [0.0_f32; LANES]);
            let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
            for (a, b) in a_rest.iter().zip(b_rest) {
                let [one, other] = f(*a, *b);
                first[0] += one;
                second[0] += other;
            }
            for (a, b) in a.iter().zip(b) {
                for lane in 0..LANES {
                    let [one, other] = f(a[lane], b[lane]);
                    first[lane] += one;
                    second[lane] += other;
                }
            }
            self.first[channel] += f64::from(first.iter().sum::<f32>());
            self.with_z[channel] += f64::from(second.iter().sum::<f32>());
        }
    }

    pub(super) fn total(chunks: &[Self]) -> Self {
        let of = |part: fn(&Self) -> &Vec<f64>| total(chunks.iter().map(|sums| part(sums).clone()));
        Self {
            first: of(|sums| &sums.first),
            with_z: of(|sums| &sums.with_z),
            lost: of(|sums| &sums.lost),
        }
    }
}

/// A normalisation with known moments. `y = a z + b` at kept positions, and `y = b` at dropped positions.
pub(super) struct Norm {
    pub(super) a: Vec<f32>,
    pub(super) b: Vec<f32>,
    gamma: Vec<f64>,
    /// The inverse of the standard deviation.
    inverse: Vec<f64>,
    moments: Moments,
    scale: f64,
}

pub(super) struct NormGradient {
    pub(super) gamma: Vec<f32>,
    pub(super) beta: Vec<f32>,
    /// For each channel, the coefficients `[p, q, r]` of `dz = p dy + q z + r` at kept positions.
    pub(super) terms: Vec<[f32; 3]>,
}

impl Norm {
    pub(super) fn new([gamma, beta]: [&[f32]; 2], moments: Moments, scale: f32) -> Self {
        let scale = f64::from(scale);
        let inverse = moments.variance.iter();
        let inverse: Vec<f64> = inverse.map(|v| 1.0 / (v + EPSILON).sqrt()).collect();
        let gamma: Vec<f64> = gamma.iter().map(|&gamma| f64::from(gamma)).collect();
        let a = |c: usize| (scale * gamma[c] * inverse[c]) as f32;
        let b = |c: usize| (f64::from(beta[c]) - gamma[c] * inverse[c] * moments.mean[c]) as f32;
        Self {
            a: (0..gamma.len()).map(a).collect(),
            b: (0..gamma.len()).map(b).collect(),
            moments,
            gamma,
            inverse,
            scale,
        }
    }

    pub(super) fn backward(&self, sums: &Sums) -> NormGradient {
        let (channels, count) = (self.a.len(), self.moments.count);
        let mut gradient = NormGradient {
            gamma: Vec::with_capacity(channels),
            beta: Vec::with_capacity(channels),
            terms: Vec::with_capacity(channels),
        };
        for c in 0..channels {
            let (inverse, mean) = (self.inverse[c], self.moments.mean[c]);
            let dy = sums.first[c] + sums.lost[c];
            let dy_x = inverse * (self.scale * sums.with_z[c] - mean * dy);
            gradient.gamma.push(dy_x as f32);
            gradient.beta.push(dy as f32);
            let p = self.scale * self.gamma[c] * inverse;
            let q = -p * dy_x / count * inverse * self.scale;
            let r = -p * (dy / count - mean * inverse * dy_x / count);
            gradient.terms.push([p as f32, q as f32, r as f32]);
        }
        gradient
    }
}
