//! The sizes of all layers, computed from the grid and the numbers of states and observations.
//!
//! The authors' network is for 64 x 64 cells. Ours fits any grid, thanks to two rules that leave the network for 64 x
//! 64 cells unchanged:
//!
//! - The decoder doubles a seed of `ceil(H / 16) x ceil(W / 16)` cells four times (4 x 4 cells for 64 x 64). The result
//!   beyond the grid's lower and right edges is cut off.
//! - The encoder reads a grid of the size that the decoder produces, without observations beyond the original edges.
//!   Kernels larger than their input are reduced to its size.

use emberwatch_model::grid::Shape;

/// Number of channels after each convolution of the encoder.
pub const ENCODER_CHANNELS: [usize; 3] = [32, 16, 8];

/// Number of channels after each transposed convolution of the decoder except the last.
pub const DECODER_CHANNELS: [usize; 4] = [128, 64, 32, 16];

/// Kernel side and stride of the encoder's convolutions.
const ENCODER_KERNELS: [(usize, usize); 3] = [(8, 4), (4, 2), (3, 1)];

/// Number of rows (and of columns) of the padded grid that one seed cell becomes after four doublings.
const SEED_CELL: usize = 16;

/// The sizes that determine all tensor shapes.
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
pub struct ConvShape {
    /// Number of input channels.
    pub channels_in: usize,
    /// Number of output channels.
    pub channels_out: usize,
    /// Rows and columns of the kernel.
    pub kernel: [usize; 2],
    /// The stride of rows and columns.
    pub stride: usize,
    /// Rows and columns of the input.
    pub input: [usize; 2],
    /// Rows and columns of the output.
    pub output: [usize; 2],
}

impl NetworkShape {
    /// Returns the size of the decoder's seed, `ceil(H / 16) x ceil(W / 16)`.
    pub fn seed(&self) -> [usize; 2] {
        let (height, width) = self.grid.dim();
        [height.div_ceil(SEED_CELL), width.div_ceil(SEED_CELL)]
    }

    /// Returns the rows and columns of the padded grid, the size of the decoder's output.
    pub fn padded(&self) -> [usize; 2] {
        self.seed().map(|side| side * SEED_CELL)
    }

    /// Returns the names and shapes of the tensors whose size depends on the grid.
    pub fn grid_tensors(&self) -> [(&'static str, Vec<usize>); 2] {
        let [rows, cols] = self.seed();
        let seed = vec![self.hidden, DECODER_CHANNELS[0], rows, cols];
        [
            ("decoder.0.weight", seed),
            ("encoder.13.weight", vec![self.encoding, self.features()]),
        ]
    }

    /// Returns the encoder's convolutions.
    pub fn convolutions(&self) -> [ConvShape; 3] {
        let (mut input, mut channels_in) = (self.padded(), self.n_observations);
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

    /// Returns the length of the encoder's last map, flattened.
    pub fn features(&self) -> usize {
        let [.., last] = self.convolutions();
        last.channels_out * last.output[0] * last.output[1]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_grids_are_padded_and_their_kernels_reduced() {
        let sizes = |height, width| {
            let shape = NetworkShape {
                grid: Shape::new(height, width).expect("valid shape"),
                n_states: 3,
                n_observations: 3,
                encoding: 4,
                hidden: 4,
            };
            let [.., last] = shape.convolutions();
            (shape.padded(), last.kernel, last.output)
        };
        assert_eq!(sizes(32, 32), ([32, 32], [2, 2], [1, 1]));
        assert_eq!(sizes(48, 80), ([48, 80], [3, 3], [2, 6]));
        assert_eq!(sizes(6, 6), ([16, 16], [1, 1], [1, 1]));
        assert_eq!(sizes(20, 33), ([32, 48], [2, 3], [1, 2]));
    }
}
