//! The decoder over a window: a seed, doubled four times, with Dropout2d, batch normalisation and ReLU
//! between; and the loss behind it.
//!
//! `u` are maps after dropout, before normalisation, of the kept channels only: one plane each, in the
//! order of [`ChannelMask::kept`].

mod backward;
mod forward;
mod loss;

use super::batch_norm::{Norm, Sums};
use super::correlation::Kernel4x4;
use super::deconv::{Doubling, Map, Scratch};
use super::dropout::{ChannelMask, Dropout};
use super::lanes::{Buffer, Lanes};
use super::loss::CellLoss;
use super::parallel::chunks_of;
use super::parameters::{DECODER, Tensors};
use super::seed::Seed;
use super::shape::{DECODER_CHANNELS, NetworkShape};
use super::visited::{LastLayer, Touched};
use protocol::frame::UNOBSERVED;
use std::ops::Range;

const LEVELS: usize = DECODER_CHANNELS.len();

/// One chunk's frames: their maps, and gradients of everything.
#[derive(Debug)]
pub(crate) struct Chunk {
    frames: Range<usize>,
    u: [Buffer; LEVELS],
    /// Gradients of the normalised maps, before ReLU; of the last, `touched` has those of most frames.
    dy: [Buffer; LEVELS],
    /// Per frame what the last doubling touched, where it was evaluated at visited cells only.
    touched: Vec<Option<Vec<Touched>>>,
    /// One frame's `dy` of the last map.
    spread: Buffer,
    sums: Sums,
    scratch: [Scratch; LEVELS],
    d_seed: Buffer,
    d_weights: [Vec<Kernel4x4>; LEVELS],
    /// Per output channel of each doubling, over all frames.
    patch_sums: [Vec<Lanes>; LEVELS],
    /// Of the last doubling, where it was evaluated at visited cells only.
    d_last: Vec<Lanes>,
    d_hidden: Vec<f32>,
    loss: CellLoss,
    /// One frame's logits, then their gradients, and its observations; all cells.
    logits: Buffer,
    values: Vec<u8>,
    /// One channel of the seed.
    dz: Buffer,
}

/// Room for a window.
#[derive(Debug)]
pub(crate) struct Decoder {
    shape: NetworkShape,
    chunks: Vec<Chunk>,
}

/// The decoder's weights and normalisations, ready for a window.
#[derive(Debug)]
pub(crate) struct DecoderLayers {
    pub(crate) seed: Seed,
    pub(crate) doublings: [Doubling; LEVELS],
    pub(crate) norms: Vec<Norm>,
}

impl DecoderLayers {
    /// Without normalisations yet.
    pub(crate) fn new(shape: &NetworkShape, parameters: &Tensors) -> Self {
        let weight = |level: usize| parameters.get(&format!("{}.weight", DECODER[level]));
        let cells = shape.seed().iter().product();
        Self {
            seed: Seed::new(shape.hidden, DECODER_CHANNELS[0], cells, weight(0)),
            doublings: std::array::from_fn(|level| {
                let channels = shape.doubling_channels(level);
                let size = shape.doubled(level);
                let input = match level {
                    0 => Map::rows(size),
                    _ => Map::phases(size),
                };
                Doubling::new(input, channels, weight(level + 1))
            }),
            norms: Vec::with_capacity(LEVELS),
        }
    }

    /// What dropout leaves of each channel that it takes before a doubling.
    fn floors(&self, level: usize) -> Vec<f32> {
        let channels = 0..DECODER_CHANNELS[level];
        channels
            .map(|channel| self.norms[level].floor(channel))
            .collect()
    }
}

/// What a doubling does to each frame of a window.
struct Level<'a> {
    level: usize,
    layers: &'a DecoderLayers,
    dropout: &'a Dropout,
    floors: Vec<f32>,
    constants: Buffer,
}

impl<'a> Level<'a> {
    fn new(level: usize, layers: &'a DecoderLayers, dropout: &'a Dropout) -> Self {
        let floors = layers.floors(level);
        Self {
            level,
            layers,
            dropout,
            constants: layers.doublings[level].constant_map(&floors),
            floors,
        }
    }

    fn doubling(&self) -> &Doubling {
        &self.layers.doublings[self.level]
    }

    fn norm(&self) -> &Norm {
        &self.layers.norms[self.level]
    }

    fn mask(&self) -> &ChannelMask {
        &self.dropout.decoder[self.level]
    }

    /// Numbers per frame of the maps before.
    fn length_in(&self) -> usize {
        self.doubling().channels_in * self.doubling().input.length()
    }

    /// Numbers per frame of the maps after.
    fn length_out(&self) -> usize {
        self.doubling().channels_out * self.doubling().output().length()
    }
}

impl Decoder {
    /// Room for windows of `n_frames` inputs.
    pub(crate) fn new(shape: &NetworkShape, n_frames: usize, layers: &DecoderLayers) -> Self {
        let maps = |frames: &Range<usize>| {
            std::array::from_fn(|level| {
                let length = layers.doublings[level].input.length();
                Buffer::zeros(frames.len() * DECODER_CHANNELS[level] * length)
            })
        };
        let chunk = |frames: Range<usize>| {
            let last = &layers.doublings[LEVELS - 1];
            let channels_out = |level: usize| layers.doublings[level].channels_out;
            Chunk {
                dy: maps(&frames),
                u: maps(&frames),
                touched: frames.clone().map(|_| None).collect(),
                spread: Buffer::zeros(DECODER_CHANNELS[LEVELS - 1] * last.input.length()),
                sums: Sums::default(),
                scratch: std::array::from_fn(|level| layers.doublings[level].scratch()),
                d_seed: layers.seed.gradient(),
                d_weights: std::array::from_fn(|level| {
                    vec![Lanes::ZERO; DECODER_CHANNELS[level] * channels_out(level)]
                }),
                patch_sums: std::array::from_fn(|level| vec![Lanes::ZERO; channels_out(level)]),
                d_last: LastLayer::gradient(shape.n_states),
                d_hidden: vec![0.0; frames.len() * shape.hidden],
                loss: CellLoss::new(&[], shape.n_states, 0),
                logits: Buffer::zeros(shape.n_states * last.output().length()),
                values: vec![UNOBSERVED; last.output().length()],
                dz: Buffer::zeros(layers.seed.plane()),
                frames,
            }
        };
        Self {
            shape: *shape,
            chunks: chunks_of(n_frames).map(chunk).collect(),
        }
    }
}

impl Chunk {
    /// Forgets a doubling's gradients, and sums, before a backward pass.
    fn clear(&mut self, level: usize) {
        self.sums = Sums::zeros(DECODER_CHANNELS[level]);
        self.d_weights[level].fill(Lanes::ZERO);
        self.patch_sums[level].fill(Lanes::ZERO);
    }
}
