//! Dropout, normalisation and ReLU between two convolutions, forward and backward.
//!
//! The code has one step before the normalisation and one step after it. [`Order`] determines which of the two is ReLU,
//! and the other step does nothing.
//!
//! Only the planes of channels that dropout keeps are stored. Dropout sets a dropped channel to zero, which
//! normalisation and ReLU map to a constant, the channel's *floor*. [`Activation::apply`] subtracts the floors, so that
//! dropped channels are zero and need no computation. The next convolution adds the contribution of the floors to its
//! result ([`super::stage`]).

use super::cpu::{Frames, frames, sum};
use super::norm::{Norm, Sums};
use crate::dropout::Mask;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Order {
    /// First ReLU, then the normalisation, as in the encoder. The scale of dropout must be positive.
    ReluFirst,
    /// First the normalisation, then ReLU, as in the decoder.
    NormFirst,
}

pub(super) struct Activation {
    pub(super) order: Order,
    /// `None` for the input of the encoder, which is not normalised.
    pub(super) norm: Option<Norm>,
    pub(super) mask: Mask,
    /// The floor of each channel: its value in frames that drop the channel. All floors are 0 without dropout.
    pub(super) floors: Vec<f32>,
}

pub(super) enum ResultGradient<'a> {
    Given(Frames),
    /// Computed from the next activation: `dy` is the gradient of its normalisation's output.
    Through {
        activation: &'a Activation,
        z: &'a Frames,
        dy: Frames,
        terms: Vec<[f32; 3]>,
    },
}

impl ResultGradient<'_> {
    #[inline(always)]
    pub(super) fn write(&self, frame: usize, to: &mut [f32]) {
        match self {
            Self::Given(numbers) => to.copy_from_slice(numbers.frame(frame)),
            Self::Through {
                activation,
                z,
                dy,
                terms,
            } => activation.normalise_gradient(terms, frame, [z.frame(frame), dy.frame(frame)], to),
        }
    }
}

impl Order {
    #[inline(always)]
    fn first(self, z: f32) -> f32 {
        match self {
            Self::ReluFirst => z.max(0.0),
            Self::NormFirst => z,
        }
    }

    #[inline(always)]
    pub(super) fn second(self, y: f32) -> f32 {
        match self {
            Self::ReluFirst => y,
            Self::NormFirst => y.max(0.0),
        }
    }

    #[inline(always)]
    pub(super) fn add_moments(self, sums: &mut Sums, channel: usize, z: &[f32]) {
        sums.add(
            channel,
            [z, z],
            #[inline(always)]
            |z, _| [self.first(z), self.first(z) * self.first(z)],
        );
    }
}

impl Activation {
    pub(super) fn new(norm: Option<Norm>, mask: Mask, order: Order) -> Self {
        let mut floors = vec![0.0; mask.channels()];
        if let Some(norm) = norm.as_ref().filter(|_| !mask.keeps_all()) {
            floors = norm.b.iter().map(|b| order.second(*b)).collect();
        }
        Self {
            order,
            norm,
            mask,
            floors,
        }
    }

    /// Computes a kept plane `x` of the activation, minus the floor, from the convolution's result `z`.
    #[inline(always)]
    pub(super) fn apply(&self, channel: usize, z: &[f32], x: &mut [f32]) {
        let Some(norm) = &self.norm else {
            return x.copy_from_slice(z);
        };
        let (a, b, order) = (norm.a[channel], norm.b[channel], self.order);
        let floor = self.floors[channel];
        for (x, z) in x.iter_mut().zip(z) {
            *x = order.second(a * order.first(*z) + b) - floor;
        }
    }

    /// Computes the gradient `dy` of the normalisation's output from the gradient `dx` of the activation, and adds it
    /// to the sums from which the normalisation's gradient is computed.
    #[inline(always)]
    pub(super) fn backward(
        &self,
        norm: &Norm,
        channel: usize,
        [z, dx]: [&[f32]; 2],
        (dy, sums): (&mut [f32], &mut Sums),
    ) {
        let (a, b, order) = (norm.a[channel], norm.b[channel], self.order);
        for (dy, (z, dx)) in dy.iter_mut().zip(z.iter().zip(dx)) {
            let passes = order == Order::ReluFirst || a * z + b > 0.0;
            *dy = if passes { *dx } else { 0.0 };
        }
        sums.add(
            channel,
            [dy, z],
            #[inline(always)]
            |dy, z| [dy, dy * order.first(z)],
        );
        if !self.mask.keeps_all() {
            // The gradient at dropped positions is the gradient at all positions, which `Stage::finish` adds, minus the
            // gradient at kept positions.
            sums.lost[channel] -= f64::from(sum(dx));
        }
    }

    #[inline(always)]
    fn normalise_gradient(
        &self,
        terms: &[[f32; 3]],
        frame: usize,
        [z, dy]: [&[f32]; 2],
        dz: &mut [f32],
    ) {
        let (kept, order) = (self.mask.kept(frame), self.order);
        let area = (z.len() / kept.len().max(1)).max(1);
        let planes = z.chunks_exact(area).zip(dy.chunks_exact(area));
        let planes = planes.zip(dz.chunks_exact_mut(area));
        for (channel, ((z, dy), dz)) in kept.iter().zip(planes) {
            let [p, q, r] = terms[*channel];
            for (dz, (z, dy)) in dz.iter_mut().zip(z.iter().zip(dy)) {
                let d = p * dy + q * order.first(*z) + r;
                let passes = order == Order::NormFirst || *z > 0.0;
                *dz = if passes { d } else { 0.0 };
            }
        }
    }

    /// Returns the gradient `[frames, channels, cells]`, with zeros in dropped channels.
    pub(super) fn dense(&self, area: usize, gradient: &ResultGradient<'_>) -> Vec<f32> {
        let channels = self.mask.channels();
        let (dense, _) = frames(
            self.mask.n_frames(),
            |_| channels * area,
            || vec![0.0; channels * area],
            #[inline(always)]
            |kept, frame, to| {
                let n = self.mask.kept(frame).len() * area;
                gradient.write(frame, &mut kept[..n]);
                for (channel, from) in self.mask.kept(frame).iter().zip(kept.chunks_exact(area)) {
                    to[channel * area..][..area].copy_from_slice(from);
                }
            },
        );
        dense.concat()
    }
}

pub(super) fn kept_planes(maps: &[f32], mask: &Mask, order: Order) -> (Frames, Sums) {
    let area = maps.len() / (mask.n_frames() * mask.channels());
    let (planes, sums) = frames(
        mask.n_frames(),
        |frame| mask.kept(frame).len() * area,
        || Sums::new(mask.channels()),
        #[inline(always)]
        |sums, frame, to| {
            for (channel, to) in mask.kept(frame).iter().zip(to.chunks_exact_mut(area)) {
                let first = (frame * mask.channels() + channel) * area;
                to.copy_from_slice(&maps[first..][..area]);
                order.add_moments(sums, *channel, to);
            }
        },
    );
    (planes, Sums::total(&sums))
}
