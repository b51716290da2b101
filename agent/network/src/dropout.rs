//! Dropout2d: in training, each channel of each frame is dropped with probability one half.
//!
//! Kept channels are scaled by two, which preserves the mean. A mask contains factors for candle's operators, and a
//! list of kept channels for our operators, which skip dropped channels.

use crate::shape::{DECODER_CHANNELS, ENCODER_CHANNELS};
use candle_core::{DType, Device, Result, Tensor};
use emberwatch_model::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use std::sync::Arc;

/// The kept and dropped channels of each frame after one layer. Clones share the data.
#[derive(Debug, Clone)]
pub struct Mask {
    scale: f32,
    channels: usize,
    /// The factor of each frame and channel: `scale`, or 0 for a dropped channel.
    scales: Arc<[f32]>,
    kept: Arc<[usize]>,
    /// For each frame, the index in `kept` at which its channels start, followed by the end of the last frame's
    /// channels.
    starts: Arc<[usize]>,
}

impl Mask {
    /// Creates a mask that multiplies the channels with `keeps(frame, channel)` by `scale`, and drops the others.
    pub fn new(
        n_frames: usize,
        channels: usize,
        scale: f32,
        keeps: impl Fn(usize, usize) -> bool,
    ) -> Self {
        let mut scales = vec![0.0; n_frames * channels];
        let (mut kept, mut starts) = (Vec::with_capacity(scales.len()), vec![0]);
        for frame in 0..n_frames {
            kept.extend((0..channels).filter(|&channel| keeps(frame, channel)));
            for channel in &kept[starts[frame]..] {
                scales[frame * channels + channel] = scale;
            }
            starts.push(kept.len());
        }
        let (scales, kept, starts) = (scales.into(), kept.into(), starts.into());
        Self {
            scale,
            channels,
            scales,
            kept,
            starts,
        }
    }

    /// Creates a mask that keeps all channels of all frames unscaled.
    pub fn all(n_frames: usize, channels: usize) -> Self {
        Self::new(n_frames, channels, 1.0, |_, _| true)
    }

    /// Returns the number of frames.
    pub fn n_frames(&self) -> usize {
        self.starts.len() - 1
    }

    /// Returns the factor of kept channels.
    pub fn scale(&self) -> f32 {
        self.scale
    }

    /// Returns the number of channels.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Returns the channels that a frame keeps, in ascending order.
    pub fn kept(&self, frame: usize) -> &[usize] {
        &self.kept[self.starts[frame]..self.starts[frame + 1]]
    }

    /// Returns whether all frames keep all channels.
    pub fn keeps_all(&self) -> bool {
        self.kept.len() == self.scales.len()
    }

    /// Returns the factors of all channels, `[frames, channels]`.
    pub fn tensor(&self, dtype: DType, device: &Device) -> Result<Tensor> {
        let dims = (self.n_frames(), self.channels);
        Tensor::from_slice(&self.scales, dims, device)?.to_dtype(dtype)
    }
}

/// The masks of one window for all seven layers with dropout.
#[derive(Debug, Clone)]
pub struct Dropout {
    /// The masks after the encoder's convolutions.
    pub encoder: [Mask; ENCODER_CHANNELS.len()],
    /// The masks after the decoder's transposed convolutions, except the last.
    pub decoder: [Mask; DECODER_CHANNELS.len()],
}

impl Dropout {
    /// Returns masks that keep all channels, as in inference.
    pub fn off(n_frames: usize) -> Self {
        Self {
            encoder: ENCODER_CHANNELS.map(|channels| Mask::all(n_frames, channels)),
            decoder: DECODER_CHANNELS.map(|channels| Mask::all(n_frames, channels)),
        }
    }

    /// Draws the masks of an update by tossing a fair coin for each frame and channel.
    pub fn draw(n_frames: usize, seed: u64, update: u64) -> Self {
        let mut rng = stream(seed, Purpose::Dropout, update);
        let mut toss = |channels: usize| {
            let words_each = channels.div_ceil(64);
            let words: Vec<u64> = (0..n_frames * words_each).map(|_| rng.next_u64()).collect();
            Mask::new(n_frames, channels, 2.0, |frame, channel| {
                words[frame * words_each + channel / 64] >> (channel % 64) & 1 == 1
            })
        };
        Self {
            encoder: ENCODER_CHANNELS.map(&mut toss),
            decoder: DECODER_CHANNELS.map(&mut toss),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_of_the_channels_are_kept_and_scaled() {
        let mask = &Dropout::draw(200, 1, 0).decoder[0];
        let mut n_kept = 0;
        for frame in 0..200 {
            let scales = &mask.scales[frame * 128..][..128];
            let scaled = (0..128).filter(|&channel| scales[channel] == 2.0);
            assert!(scaled.eq(mask.kept(frame).iter().copied()));
            n_kept += mask.kept(frame).len();
        }
        // For 25,600 fair coins, a deviation of 400 is five standard deviations.
        assert!(n_kept.abs_diff(12_800) < 400, "{n_kept}");
    }

    #[test]
    fn masks_depend_on_seed_and_update() {
        let kept = |seed, update| Dropout::draw(4, seed, update).decoder[0].kept.clone();
        assert_eq!(kept(1, 2), kept(1, 2));
        assert_ne!(kept(1, 2), kept(2, 2));
        assert_ne!(kept(1, 2), kept(1, 3));
    }
}
