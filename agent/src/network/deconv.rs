//! A doubling: transposed convolution with a 4 x 4 kernel, stride 2, padding 1, one frame at a time.
//!
//! Output `(2 y + p, 2 x + q)` of phase `(p, q)` depends on 2 x 2 inputs around `(y, x)` through four
//! entries of the kernel, so each phase is an ordinary correlation at the input's size. Only channels
//! that dropout kept are computed: inputs are `x = x' + k`, where `k` is the constant that a lost
//! channel has, so `x'` is zero there and `k` adds [`Doubling::constant_map`], the same for all frames.

mod backward;
mod forward;

use super::correlation::Kernel4x4;
use super::lanes::{LANES, Lanes, whole_lanes};

/// Columns to the left, none, to the right.
const COLUMN_SHIFTS: usize = 3;
const PHASES: usize = 4;
const TAPS: usize = 16;
/// Planes of an output gradient: of two row parities and four columns of the kernel.
const GRADIENT_PLANES: usize = 8;
/// Pixels whose patches are made at once, to stay in the fastest cache.
const BAND: usize = 64;

/// Sizes and weights of one doubling.
#[derive(Debug)]
pub(crate) struct Doubling {
    /// Rows and columns before doubling.
    pub(crate) input: [usize; 2],
    pub(crate) channels_in: usize,
    pub(crate) channels_out: usize,
    /// `[in][out]`.
    weights: Vec<Kernel4x4>,
}

/// Room for one frame's planes; every plane not written is zero.
#[derive(Debug, Clone)]
pub(crate) struct Scratch {
    /// Per kept input its values, shifted by a column to the right, not, and to the left.
    shifted: Vec<f32>,
    /// Per kept output its four phases.
    phases: Vec<f32>,
    /// Per kept output its gradient, with a border of zeros.
    bordered: Vec<f32>,
    /// All outputs' gradients, as each tap meets them.
    gradients: Vec<f32>,
    /// Per output and pixel of a band the 4 x 4 gradients that the pixel reached.
    patches: Vec<f32>,
    /// Per kept output the sum of its patches.
    pub(crate) patch_sums: Vec<Lanes>,
    /// Per kept input `x'`.
    pub(crate) values: Vec<f32>,
    /// Per kept input its gradient.
    pub(crate) dx: Vec<f32>,
}

impl Doubling {
    /// From PyTorch's `[in][out][4][4]`.
    pub(crate) fn new(input: [usize; 2], channels: [usize; 2], weight: &[f32]) -> Self {
        let [channels_in, channels_out] = channels;
        Self {
            input,
            channels_in,
            channels_out,
            weights: weight.as_chunks().0.to_vec(),
        }
    }

    /// Numbers per input plane: its pixels, padded to whole lanes.
    pub(crate) fn plane_in(&self) -> usize {
        whole_lanes(self.input[0] * self.input[1])
    }

    /// Numbers per output plane.
    pub(crate) fn plane_out(&self) -> usize {
        whole_lanes(4 * self.input[0] * self.input[1])
    }

    /// Of one column shift: a row of zeros above and below, and what the last lanes read beyond.
    fn shifted_plane(&self) -> usize {
        whole_lanes((self.input[0] + 2) * self.input[1] + LANES)
    }

    fn gradient_plane(&self) -> usize {
        whole_lanes((self.input[0] + 1) * self.input[1] + LANES)
    }

    pub(crate) fn scratch(&self) -> Scratch {
        let [rows, cols] = self.input;
        let plane = self.plane_in();
        let band = self.band_rows() * cols;
        Scratch {
            shifted: vec![0.0; self.channels_in * COLUMN_SHIFTS * self.shifted_plane()],
            phases: vec![0.0; self.channels_out * PHASES * plane],
            bordered: vec![0.0; self.channels_out * (2 * rows + 2) * (2 * cols + 2)],
            gradients: vec![0.0; self.channels_out * GRADIENT_PLANES * self.gradient_plane()],
            patches: vec![0.0; self.channels_out * band * TAPS],
            patch_sums: vec![Lanes::ZERO; self.channels_out],
            values: vec![0.0; self.channels_in * plane],
            dx: vec![0.0; self.channels_in * plane],
        }
    }

    fn band_rows(&self) -> usize {
        (BAND / self.input[1]).clamp(1, self.input[0])
    }
}
