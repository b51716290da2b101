//! The encoder over a window: three convolutions, each followed by Dropout2d, ReLU and batch
//! normalisation, and a linear layer.
//!
//! Batch normalisation needs sums over all frames, so each layer is a pass of its own.

mod backward;
mod forward;
mod linear;

pub(crate) use linear::Linear;
use linear::LinearGradient;

use super::batch_norm::{Norm, Statistics, Sums};
use super::conv::{Dense, DenseGradient, Sparse};
use super::dropout::ChannelMask;
use super::dropout::Dropout;
use super::lanes::{Arithmetic, Buffer, LANES, Lanes};
use super::parallel::chunks_of;
use super::parameters::{ENCODER, Tensors};
use super::shape::{ConvShape, NetworkShape};
use super::window::Window;
use std::ops::Range;

/// Visits of a frame up to which its first map is computed anew.
const MOST_VISITS: usize = 256;

/// One chunk's frames: their maps, and gradients of everything.
#[derive(Debug)]
pub(crate) struct Chunk {
    frames: Range<usize>,
    /// After ReLU, before normalisation; channels last. Of the first, see [`First`].
    maps: [Buffer; 3],
    /// One frame's first map.
    first: Buffer,
    /// Gradients of the normalised maps.
    d_maps: [Buffer; 3],
    encodings: Vec<f32>,
    sums: Sums,
    d_columns: Buffer,
    d_bias: Buffer,
    dense: [DenseGradient; 2],
    linear: LinearGradient,
    /// One frame's gradient before ReLU.
    dz: Buffer,
}

/// The encoder's weights, ready for a window.
#[derive(Debug)]
pub(crate) struct Encoder {
    shapes: [ConvShape; 3],
    encoding: usize,
    chunks: Vec<Chunk>,
}

/// The first convolution over a window. Where few cells were visited, its map is quicker computed anew than
/// fetched from memory, and only kept of other frames.
#[derive(Clone, Copy)]
struct First<'a> {
    sparse: &'a Sparse,
    window: &'a Window,
    dropout: &'a Dropout,
}

impl First<'_> {
    fn is_kept(&self, frame: usize) -> bool {
        self.window.visits(frame).len() > MOST_VISITS
    }

    #[inline(always)]
    fn compute<A: Arithmetic>(&self, frame: usize, map: &mut [f32]) {
        let mask = multipliers(&self.dropout.encoder[0], frame, self.dropout.scale);
        let visits = self.window.visits(frame);
        self.sparse.forward::<A>(visits, &mask, map);
    }

    /// A frame's map, in its place or in the room for one.
    #[inline(always)]
    fn recall<'m, A: Arithmetic>(
        &self,
        frame: usize,
        place: &'m [f32],
        room: &'m mut [f32],
    ) -> &'m [f32] {
        if self.is_kept(frame) {
            return place;
        }
        self.compute::<A>(frame, room);
        room
    }
}

/// What the backward pass needs beside the chunks.
#[derive(Debug)]
pub(crate) struct EncoderLayers {
    pub(crate) sparse: Sparse,
    pub(crate) dense: [Dense; 2],
    pub(crate) linear: Linear,
    pub(crate) norms: [Norm; 3],
}

impl Encoder {
    /// Room for windows of `n_frames` inputs.
    pub(crate) fn new(shape: &NetworkShape, n_frames: usize) -> Self {
        let shapes = shape.convolutions();
        let largest = shapes.map(|conv| conv.outputs()).into_iter().max();
        let largest = largest.unwrap_or(0);
        let chunk = |frames: Range<usize>| {
            let maps = shapes.map(|conv| Buffer::zeros(frames.len() * conv.outputs()));
            Chunk {
                d_maps: shapes.map(|conv| Buffer::zeros(frames.len() * conv.outputs())),
                maps,
                first: Buffer::zeros(shapes[0].outputs()),
                encodings: vec![0.0; frames.len() * shape.encoding],
                sums: Sums::default(),
                d_columns: Buffer::zeros(
                    shapes[0].channels_out * shapes[0].channels_in * shapes[0].taps(),
                ),
                d_bias: Buffer::zeros(shapes[0].channels_out),
                dense: [
                    DenseGradient::zeros(&shapes[1]),
                    DenseGradient::zeros(&shapes[2]),
                ],
                linear: LinearGradient::zeros(shape.encoding, shapes[2].outputs()),
                dz: Buffer::zeros(largest),
                frames,
            }
        };
        Self {
            shapes,
            encoding: shape.encoding,
            chunks: chunks_of(n_frames).map(chunk).collect(),
        }
    }

    fn n_frames(&self) -> usize {
        self.chunks.iter().map(|chunk| chunk.frames.len()).sum()
    }
}

/// The sum of equally long vectors.
pub(crate) fn total<'a>(parts: impl Iterator<Item = &'a [f32]>) -> Vec<f32> {
    let mut total = Vec::new();
    for part in parts {
        total.resize(part.len(), 0.0);
        for (sum, x) in total.iter_mut().zip(part) {
            *sum += x;
        }
    }
    total
}

/// A stage's normalisation, padded to whole lanes with zeros.
pub(crate) fn encoder_norm(stage: usize, parameters: &Tensors, mut statistics: Statistics) -> Norm {
    let (weight, bias) = parameters.layer(ENCODER[stage][1]);
    let channels = weight.len().next_multiple_of(LANES);
    let padded = |numbers: &[f32]| {
        let mut numbers = numbers.to_vec();
        numbers.resize(channels, 0.0);
        numbers
    };
    statistics.mean.resize(channels, 0.0);
    statistics.variance.resize(channels, 0.0);
    Norm::new(statistics, &padded(weight), &padded(bias))
}

/// What each channel of a frame is multiplied with, in whole lanes.
#[inline(always)]
fn multipliers(mask: &ChannelMask, frame: usize, scale: f32) -> [f32; 2 * LANES] {
    let mut multipliers = [0.0; 2 * LANES];
    for &channel in mask.kept(frame) {
        multipliers[usize::from(channel) % (2 * LANES)] = scale;
    }
    multipliers
}

/// Adds to each channel's sums over one frame's positions of `x - origin` and `(x - origin) y`, where
/// `y` is `x - origin` itself if it is not given.
#[inline(always)]
fn add_sums<A: Arithmetic>(x: &[f32], y: Option<&[f32]>, origin: &[f32], sums: &mut Sums) {
    let channels = origin.len();
    for first in (0..channels).step_by(LANES) {
        let (mut sum, mut product) = (Lanes::ZERO, Lanes::ZERO);
        let minus = Lanes(Lanes::load(&origin[first..]).0.map(|value| -value));
        for position in (first..x.len()).step_by(channels) {
            let x = Lanes::load(&x[position..]).add::<A>(minus);
            let y = y.map_or(x, |y| Lanes::load(&y[position..]));
            sum = sum.add::<A>(x);
            product = product.add_product::<A>(x, y);
        }
        for lane in 0..LANES {
            sums.add(first + lane, (sum.0[lane], product.0[lane]));
        }
    }
}
