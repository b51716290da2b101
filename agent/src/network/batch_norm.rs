//! Batch normalisation: `y = scale u + shift` per channel, over all frames and cells of a window.
//!
//! Statistics of a window while training, running ones else. Both passes are linear in their inputs
//! once a few sums per channel are known, so layers hand in sums and get back coefficients.

/// Added to the variance, as PyTorch does.
const EPSILON: f64 = 1e-5;

/// Share of a new window in the running statistics, as in PyTorch.
const MOMENTUM: f64 = 0.1;

/// Per channel, the sums of two quantities.
///
/// Forward: of `u - origin` and of its square. Backward: of the gradient `dy` and of `dy u`.
#[derive(Debug, Clone, Default)]
pub(crate) struct Sums {
    pub(crate) first: Vec<f64>,
    pub(crate) second: Vec<f64>,
}

impl Sums {
    pub(crate) fn zeros(channels: usize) -> Self {
        Self {
            first: vec![0.0; channels],
            second: vec![0.0; channels],
        }
    }

    #[inline(always)]
    pub(crate) fn add(&mut self, channel: usize, (first, second): (f32, f32)) {
        self.first[channel] += f64::from(first);
        self.second[channel] += f64::from(second);
    }

    /// The sums over chunks of frames, in their order.
    pub(crate) fn total<'a>(chunks: impl Iterator<Item = &'a Self>) -> Self {
        let mut total = Self::default();
        for chunk in chunks {
            total.first.resize(chunk.first.len(), 0.0);
            total.second.resize(chunk.first.len(), 0.0);
            for channel in 0..chunk.first.len() {
                total.first[channel] += chunk.first[channel];
                total.second[channel] += chunk.second[channel];
            }
        }
        total
    }
}

/// Mean and variance of each channel.
#[derive(Debug, Clone)]
pub(crate) struct Statistics {
    pub(crate) mean: Vec<f64>,
    /// Of the population: divided by the number of values.
    pub(crate) variance: Vec<f64>,
    /// Values per channel.
    pub(crate) count: f64,
}

impl Statistics {
    /// From sums around an origin per channel, which avoids the cancellation of `E[u^2] - E[u]^2`.
    pub(crate) fn new(sums: &Sums, origin: &[f32], count: f64) -> Self {
        let from_origin: Vec<f64> = sums.first.iter().map(|sum| sum / count).collect();
        let variance = sums.second.iter().zip(&from_origin);
        Self {
            variance: variance
                .map(|(square, mean)| (square / count - mean * mean).max(0.0))
                .collect(),
            mean: from_origin
                .iter()
                .zip(origin)
                .map(|(mean, &origin)| mean + f64::from(origin))
                .collect(),
            count,
        }
    }

    /// Running ones, as stored.
    pub(crate) fn running(mean: &[f32], variance: &[f32]) -> Self {
        let exact = |values: &[f32]| values.iter().map(|&value| f64::from(value)).collect();
        Self {
            mean: exact(mean),
            variance: exact(variance),
            count: f64::INFINITY,
        }
    }

    /// Moves stored running statistics towards these.
    pub(crate) fn update_running(&self, mean: &mut [f32], variance: &mut [f32]) {
        let towards = |old: &mut f32, new: f64| {
            *old = (f64::from(*old) * (1.0 - MOMENTUM) + new * MOMENTUM) as f32;
        };
        // PyTorch stores the variance of the sample, divided by the number of values less one.
        let sample = self.count / (self.count - 1.0).max(1.0);
        for channel in 0..mean.len() {
            towards(&mut mean[channel], self.mean[channel]);
            towards(&mut variance[channel], self.variance[channel] * sample);
        }
    }
}

/// `y = scale u + shift` per channel; what a layer's forward pass needs.
#[derive(Debug, Clone)]
pub(crate) struct Norm {
    pub(crate) scale: Vec<f32>,
    pub(crate) shift: Vec<f32>,
    statistics: Statistics,
}

/// `du = dy_factor dy + u_factor u + constant` per channel, and the gradients of the parameters.
#[derive(Debug, Clone)]
pub(crate) struct NormGradient {
    pub(crate) dy_factor: Vec<f32>,
    pub(crate) u_factor: Vec<f32>,
    pub(crate) constant: Vec<f32>,
    pub(crate) weight: Vec<f32>,
    pub(crate) bias: Vec<f32>,
}

impl Norm {
    /// `weight (u - mean) / deviation + bias`.
    pub(crate) fn new(statistics: Statistics, weight: &[f32], bias: &[f32]) -> Self {
        let channels = 0..weight.len();
        let scale = |channel: usize| {
            f64::from(weight[channel]) / (statistics.variance[channel] + EPSILON).sqrt()
        };
        let shift =
            |channel: usize| f64::from(bias[channel]) - statistics.mean[channel] * scale(channel);
        Self {
            scale: channels
                .clone()
                .map(|channel| scale(channel) as f32)
                .collect(),
            shift: channels.map(|channel| shift(channel) as f32).collect(),
            statistics,
        }
    }

    pub(crate) fn statistics(&self) -> &Statistics {
        &self.statistics
    }

    /// What is passed on for `u = 0`, after ReLU: the value of channels that dropout took.
    pub(crate) fn floor(&self, channel: usize) -> f32 {
        self.shift[channel].max(0.0)
    }

    /// The backward pass, from the sums of `dy` and `dy u`.
    pub(crate) fn gradient(&self, sums: &Sums) -> NormGradient {
        let channels = self.scale.len();
        let mut gradient = NormGradient {
            dy_factor: self.scale.clone(),
            u_factor: Vec::with_capacity(channels),
            constant: Vec::with_capacity(channels),
            weight: Vec::with_capacity(channels),
            bias: Vec::with_capacity(channels),
        };
        let Statistics {
            mean,
            variance,
            count,
        } = &self.statistics;
        for channel in 0..channels {
            let precision = 1.0 / (variance[channel] + EPSILON).sqrt();
            let scale = f64::from(self.scale[channel]);
            let dy = sums.first[channel];
            let dy_normed = precision * (sums.second[channel] - mean[channel] * dy);
            let slope = precision * dy_normed / count;
            gradient.u_factor.push((-scale * slope) as f32);
            let constant = -scale * (dy / count - mean[channel] * slope);
            gradient.constant.push(constant as f32);
            gradient.weight.push(dy_normed as f32);
            gradient.bias.push(dy as f32);
        }
        gradient
    }
}
