//! The decoder's first transposed convolution: from the hidden vector to a seed of few cells.
//!
//! Its input is one cell, so it is a matrix: `z[channel][cell] = sum over i of h_i W[i][channel][cell]`.

use super::lanes::{Arithmetic, Buffer, LANES, Lanes, whole_lanes};

/// The matrix, each channel's cells padded to whole lanes.
#[derive(Debug)]
pub(crate) struct Seed {
    channels: usize,
    cells: usize,
    /// `[hidden][channel][cell]`.
    weight: Buffer,
}

impl Seed {
    /// From PyTorch's `[hidden][channel][cell]`.
    pub(crate) fn new(hidden: usize, channels: usize, cells: usize, weight: &[f32]) -> Self {
        let plane = whole_lanes(cells);
        let mut padded = Buffer::zeros(hidden * channels * plane);
        for (to, from) in padded
            .chunks_exact_mut(plane)
            .zip(weight.chunks_exact(cells))
        {
            to[..cells].copy_from_slice(from);
        }
        Self {
            channels,
            cells,
            weight: padded,
        }
    }

    pub(crate) fn plane(&self) -> usize {
        whole_lanes(self.cells)
    }

    /// Room for gradients.
    pub(crate) fn gradient(&self) -> Buffer {
        Buffer::zeros(self.weight.len())
    }

    /// Gradients in PyTorch's layout.
    pub(crate) fn unpadded(&self, gradient: &[f32]) -> Vec<f32> {
        let planes = gradient.chunks_exact(self.plane());
        planes
            .flat_map(|plane| &plane[..self.cells])
            .copied()
            .collect()
    }

    fn at(&self, input: usize, channel: u16, first: usize) -> usize {
        (input * self.channels + usize::from(channel)) * self.plane() + first
    }

    /// The kept channels of one frame, one plane each, times `factor`.
    #[inline(always)]
    pub(crate) fn forward<A: Arithmetic>(
        &self,
        h: &[f32],
        kept: &[u16],
        factor: f32,
        u: &mut [f32],
    ) {
        for (u, &channel) in u.chunks_exact_mut(self.plane()).zip(kept) {
            for first in (0..u.len()).step_by(LANES) {
                let mut sum = Lanes::ZERO;
                for (input, h) in h.iter().enumerate() {
                    let weight = Lanes::load(&self.weight[self.at(input, channel, first)..]);
                    sum = sum.add_scaled::<A>(h * factor, weight);
                }
                sum.store(&mut u[first..]);
            }
        }
    }

    /// From `dz` of one kept channel: adds to the gradients of h, whose lanes remain to be summed, and
    /// of the weights.
    #[inline(always)]
    pub(crate) fn backward<A: Arithmetic>(
        &self,
        h: &[f32],
        channel: u16,
        dz: &[f32],
        d_h: &mut [Lanes],
        d_weight: &mut [f32],
    ) {
        for (input, (h, sum)) in h.iter().zip(d_h).enumerate() {
            for first in (0..dz.len()).step_by(LANES) {
                let at = self.at(input, channel, first);
                let dz = Lanes::load(&dz[first..]);
                *sum = sum.add_product::<A>(dz, Lanes::load(&self.weight[at..]));
                let d_weight = &mut d_weight[at..];
                Lanes::load(d_weight)
                    .add_scaled::<A>(*h, dz)
                    .store(d_weight);
            }
        }
    }
}
