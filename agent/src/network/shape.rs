//! The sizes of every stage, from the grid and the numbers of states and observations.
//!
//! The authors' network is for 64 x 64 cells. Ours fits any grid by two rules that leave theirs as it is:
//!
//! - The decoder doubles a seed of `ceil(H / 16) x ceil(W / 16)` cells four times; what hangs over the
//!   grid's lower and right edge is cut off. (64 x 64: 4 x 4.)
//! - The encoder sees a grid of that padded size, unseen beyond the edge, and no kernel is larger than
//!   its input.

use super::lanes::whole_lanes;
use protocol::grid::Shape;

/// Channels after each convolution of the encoder.
pub const ENCODER_CHANNELS: [usize; 3] = [32, 16, 8];

/// Channels after each transposed convolution of the decoder but the last.
pub const DECODER_CHANNELS: [usize; 4] = [128, 64, 32, 16];

/// Kernel side and stride of the encoder's convolutions.
const ENCODER_KERNELS: [(usize, usize); 3] = [(8, 4), (4, 2), (3, 1)];

/// Side of the decoder's doubling kernels.
pub(crate) const DOUBLING_KERNEL: usize = 4;

/// Cells of the padded grid per side of a seed cell: four doublings.
const SEED_CELL: usize = 16;

/// Everything that decides a tensor's size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NetworkShape {
    /// The grid, H x W.
    pub grid: Shape,
    /// Number of states S.
    pub n_states: usize,
    /// Number of observations O.
    pub n_observations: usize,
    /// Length of the encoder's output.
    pub encoding: usize,
    /// Length of the hidden vector h.
    pub hidden: usize,
}

/// One convolution of the encoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ConvShape {
    pub(crate) channels_in: usize,
    pub(crate) channels_out: usize,
    /// Rows and columns.
    pub(crate) kernel: [usize; 2],
    pub(crate) stride: usize,
    pub(crate) input: [usize; 2],
    pub(crate) output: [usize; 2],
}

impl ConvShape {
    /// Output positions.
    pub(crate) fn positions(&self) -> usize {
        self.output[0] * self.output[1]
    }

    /// Kernel entries per pair of channels.
    pub(crate) fn taps(&self) -> usize {
        self.kernel[0] * self.kernel[1]
    }

    /// Numbers per output position: its channels, padded to whole lanes.
    pub(crate) fn lanes_out(&self) -> usize {
        whole_lanes(self.channels_out)
    }

    /// Numbers per frame of output.
    pub(crate) fn outputs(&self) -> usize {
        self.positions() * self.lanes_out()
    }
}

impl NetworkShape {
    /// The decoder's first cells, `ceil(H / 16) x ceil(W / 16)`.
    pub(crate) fn seed(&self) -> [usize; 2] {
        let (height, width) = self.grid.dim();
        [height.div_ceil(SEED_CELL), width.div_ceil(SEED_CELL)]
    }

    /// Cells after `doublings` of the decoder's seed; after four, the padded grid.
    pub(crate) fn doubled(&self, doublings: usize) -> [usize; 2] {
        self.seed().map(|side| side << doublings)
    }

    /// The encoder's convolutions.
    pub(crate) fn convolutions(&self) -> [ConvShape; 3] {
        let mut input = self.doubled(DECODER_CHANNELS.len());
        let mut channels_in = self.n_observations;
        std::array::from_fn(|stage| {
            let (side, stride) = ENCODER_KERNELS[stage];
            let kernel = input.map(|length| side.min(length));
            let conv = ConvShape {
                channels_in,
                channels_out: ENCODER_CHANNELS[stage],
                kernel,
                stride,
                input,
                output: [0, 1].map(|axis| (input[axis] - kernel[axis]) / stride + 1),
            };
            (input, channels_in) = (conv.output, conv.channels_out);
            conv
        })
    }

    /// Length of the encoder's last map, flattened.
    pub(crate) fn features(&self) -> usize {
        let [.., last] = self.convolutions();
        last.channels_out * last.positions()
    }

    /// Channels into and out of doubling `level` (0 to 3); the last one's output are the states.
    pub(crate) fn doubling_channels(&self, level: usize) -> [usize; 2] {
        let after = DECODER_CHANNELS.get(level + 1).copied();
        [DECODER_CHANNELS[level], after.unwrap_or(self.n_states)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape(height: usize, width: usize) -> NetworkShape {
        NetworkShape {
            grid: Shape::new(height, width).expect("valid shape"),
            n_states: 3,
            n_observations: 3,
            encoding: 4,
            hidden: 4,
        }
    }

    #[test]
    fn the_paper_s_grid_gives_the_authors_sizes() {
        let shape = shape(64, 64);
        assert_eq!(shape.seed(), [4, 4]);
        let outputs = shape.convolutions().map(|conv| conv.output);
        assert_eq!(outputs, [[15, 15], [6, 6], [4, 4]]);
        assert_eq!(shape.features(), 128);
    }

    #[test]
    fn other_grids_are_padded_and_their_kernels_cut() {
        let sizes = |height, width| {
            let shape = shape(height, width);
            let [.., last] = shape.convolutions();
            (shape.doubled(4), last.kernel, last.output)
        };
        assert_eq!(sizes(32, 32), ([32, 32], [2, 2], [1, 1]));
        assert_eq!(sizes(48, 80), ([48, 80], [3, 3], [2, 6]));
        assert_eq!(sizes(6, 6), ([16, 16], [1, 1], [1, 1]));
        assert_eq!(sizes(20, 33), ([32, 48], [2, 3], [1, 2]));
    }
}
