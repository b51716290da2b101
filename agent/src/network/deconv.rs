//! A doubling: transposed convolution with a 4 x 4 kernel, stride 2, padding 1, one frame at a time.
//!
//! Output `(2 y + p, 2 x + q)` of phase `(p, q)` depends on 2 x 2 inputs around `(y, x)` through four
//! entries of the kernel, so each phase is an ordinary correlation at the input's size. Only channels
//! that dropout kept are computed: inputs are `x = x' + k`, where `k` is the constant that a lost
//! channel has, so `x'` is zero there and `k` adds [`Doubling::constant_map`], the same for all frames.

mod backward;
mod forward;
mod map;

pub(crate) use map::Map;

use super::correlation::Kernel4x4;
use super::lanes::{Buffer, LANES, Lanes, whole_lanes};

/// Columns to the left, none, to the right.
const COLUMN_SHIFTS: usize = 3;
const PHASES: usize = 4;
const TAPS: usize = 16;
/// Planes of an output gradient: of two row parities and four columns of the kernel.
const GRADIENT_PLANES: usize = 8;
/// Rows and columns of inputs around a pixel that its four outputs depend on.
const SIDE: usize = 3;
/// Sixteen pixels' neighbours and themselves.
type Around = [Lanes; SIDE * SIDE];
/// Pixels whose patches are made at once, to stay in the fastest cache.
const BAND: usize = 64;

/// Sizes and weights of one doubling.
#[derive(Debug)]
pub(crate) struct Doubling {
    /// Before doubling.
    pub(crate) input: Map,
    pub(crate) channels_in: usize,
    pub(crate) channels_out: usize,
    /// `[in][out]`.
    weights: Vec<Kernel4x4>,
}

/// Room for one frame's planes; every plane not written is zero.
#[derive(Debug, Clone)]
pub(crate) struct Scratch {
    /// Per kept input its values, shifted by a column to the right, not, and to the left.
    shifted: Buffer,
    /// Per kept input sixteen pixels' neighbours.
    around: Vec<Around>,
    /// All outputs' gradients, as each tap meets them.
    gradients: Buffer,
    /// Per output and pixel of a band the 4 x 4 gradients that the pixel reached.
    patches: Buffer,
    /// Per kept output the sum of its patches.
    pub(crate) patch_sums: Vec<Lanes>,
    /// One input, in the order of its map.
    map: Buffer,
    /// Per kept input `x'`, row by row.
    values: Buffer,
    /// Per kept input its gradient, row by row.
    pub(crate) dx: Buffer,
}

impl Doubling {
    /// From PyTorch's `[in][out][4][4]`.
    pub(crate) fn new(input: Map, channels: [usize; 2], weight: &[f32]) -> Self {
        let [channels_in, channels_out] = channels;
        Self {
            input,
            channels_in,
            channels_out,
            weights: weight
                .as_chunks()
                .0
                .iter()
                .map(|&kernel| Lanes(kernel))
                .collect(),
        }
    }

    /// Numbers per input plane: its rows, padded to whole lanes.
    pub(crate) fn plane_in(&self) -> usize {
        whole_lanes(self.input.pixels())
    }

    /// After doubling.
    pub(crate) fn output(&self) -> Map {
        Map::phases(self.input.size().map(|side| 2 * side))
    }

    /// Of one column shift: a row of zeros above and below, and what the last lanes read beyond.
    fn shifted_plane(&self) -> usize {
        let [rows, cols] = self.input.size();
        whole_lanes((rows + 2) * cols + LANES)
    }

    fn gradient_plane(&self) -> usize {
        let [rows, cols] = self.input.size();
        whole_lanes((rows + 1) * cols + LANES)
    }

    pub(crate) fn scratch(&self) -> Scratch {
        let plane = self.plane_in();
        let band = self.band_rows() * self.input.size()[1];
        Scratch {
            shifted: Buffer::zeros(self.channels_in * COLUMN_SHIFTS * self.shifted_plane()),
            around: vec![[Lanes::ZERO; SIDE * SIDE]; self.channels_in],
            gradients: Buffer::zeros(self.channels_out * GRADIENT_PLANES * self.gradient_plane()),
            patches: Buffer::zeros(self.channels_out * band * TAPS),
            patch_sums: vec![Lanes::ZERO; self.channels_out],
            map: Buffer::zeros(self.input.length()),
            values: Buffer::zeros(self.channels_in * plane),
            dx: Buffer::zeros(self.channels_in * plane),
        }
    }

    fn band_rows(&self) -> usize {
        let [rows, cols] = self.input.size();
        (BAND / cols).clamp(1, rows)
    }
}
