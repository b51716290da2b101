//! A dense convolution of the encoder, frame by frame: a product of the frame's patches and the kernels.

use super::product::{Left, Right, add_product, steps};
use crate::shape::ConvShape;

/// Frames are `[rows, cols, channels in]`, results `[positions, channels out]`.
pub(super) struct Conv<'a> {
    /// `[kernel rows * kernel cols * channels in, channels out]`.
    kernels: &'a [f32],
    channels_out: usize,
    /// Numbers of one row of a patch, which lie side by side in the frame.
    run: usize,
    /// Where in the frame each patch begins.
    positions: Vec<usize>,
    /// Where in the frame the rows of a patch begin, after its first number.
    runs: Vec<usize>,
    /// Where in the frame each number of a patch lies, after its first.
    numbers: Vec<usize>,
    /// Where in the result each position's numbers begin.
    outputs: Vec<usize>,
    /// Where the kernels of each number of a patch begin.
    rows: Vec<usize>,
    /// Where the turned kernels of each channel begin.
    turned_rows: Vec<usize>,
    channels: Vec<usize>,
}

impl<'a> Conv<'a> {
    pub(super) fn new(shape: &ConvShape, kernels: &'a [f32]) -> Self {
        let (channels, n, cols) = (shape.channels_in, shape.channels_out, shape.input[1]);
        let n_cols = shape.output[1];
        let position = |at: usize| (at / n_cols * cols + at % n_cols) * shape.stride * channels;
        let positions: Vec<usize> = (0..shape.output[0] * n_cols).map(position).collect();
        let (run, patch) = (shape.kernel[1] * channels, kernels.len() / n);
        let runs = steps(shape.kernel[0], cols * channels);
        Self {
            kernels,
            channels_out: n,
            run,
            outputs: steps(positions.len(), n),
            positions,
            numbers: runs.iter().flat_map(|first| *first..first + run).collect(),
            runs,
            rows: steps(patch, n),
            turned_rows: steps(n, patch),
            channels: steps(n, 1),
        }
    }

    /// The kernels as `[channels out, kernel rows * kernel cols * channels in]`.
    pub(super) fn turned(&self) -> Vec<f32> {
        let (patch, n) = (self.rows.len(), self.channels_out);
        let places = 0..self.kernels.len();
        places
            .map(|at| self.kernels[at % patch * n + at / patch])
            .collect()
    }

    /// Adds a frame's result.
    #[inline(always)]
    pub(super) fn forward(&self, x: &[f32], out: &mut [f32]) {
        let left = Left {
            numbers: x,
            rows: &self.positions,
            terms: &self.numbers,
        };
        let right = Right {
            numbers: self.kernels,
            terms: &self.rows,
            cols: self.channels_out,
        };
        add_product(out, &self.outputs, left, right);
    }

    /// Adds gradients of the kernels.
    #[inline(always)]
    pub(super) fn add_gradient(&self, x: &[f32], d_out: &[f32], d_kernels: &mut [f32]) {
        let left = Left {
            numbers: x,
            rows: &self.numbers,
            terms: &self.positions,
        };
        let right = Right {
            numbers: d_out,
            terms: &self.outputs,
            cols: self.channels_out,
        };
        add_product(d_kernels, &self.rows, left, right);
    }

    /// Adds the gradient of a frame, with the turned kernels.
    #[inline(always)]
    pub(super) fn backward(&self, turned: &[f32], d_out: &[f32], dx: &mut [f32]) {
        let left = Left {
            numbers: d_out,
            rows: &self.outputs,
            terms: &self.channels,
        };
        for (index, from) in self.runs.iter().enumerate() {
            let right = Right {
                numbers: &turned[index * self.run..],
                terms: &self.turned_rows,
                cols: self.run,
            };
            add_product(&mut dx[*from..], &self.positions, left, right);
        }
    }
}
