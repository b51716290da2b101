//! Dropout2d: in training, each frame loses each channel with probability one half.
//!
//! Kept channels are scaled by two, so that their mean stays. The kernels skip lost channels, so
//! masks are lists of channels and not numbers to multiply with.

use super::shape::{DECODER_CHANNELS, ENCODER_CHANNELS};
use protocol::randomness::{Purpose, stream};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

/// The channels kept and lost in each frame behind one layer.
#[derive(Debug, Clone)]
pub struct ChannelMask {
    channels: usize,
    /// Per frame every channel: the kept ones first.
    order: Vec<u16>,
    n_kept: Vec<u16>,
}

impl ChannelMask {
    /// A mask from a rule: whether a frame keeps a channel.
    pub fn new(n_frames: usize, channels: usize, keeps: impl Fn(usize, usize) -> bool) -> Self {
        let mut order = vec![0; n_frames * channels];
        let mut n_kept = Vec::with_capacity(n_frames);
        for (frame, order) in order.chunks_exact_mut(channels.max(1)).enumerate() {
            let first_lost = (0..channels).filter(|&at| keeps(frame, at)).count();
            let (mut kept, mut lost) = (0, first_lost);
            // Without a branch, which coins would mislead half of the time.
            for channel in 0..channels {
                let keep = keeps(frame, channel);
                order[if keep { kept } else { lost }] = channel as u16;
                kept += usize::from(keep);
                lost += usize::from(!keep);
            }
            n_kept.push(first_lost as u16);
        }
        Self {
            channels,
            order,
            n_kept,
        }
    }

    /// Channels that a frame keeps, ascending.
    pub fn kept(&self, frame: usize) -> &[u16] {
        &self.order[frame * self.channels..][..usize::from(self.n_kept[frame])]
    }

    /// Channels that a frame loses, ascending.
    pub fn lost(&self, frame: usize) -> &[u16] {
        &self.order[frame * self.channels..][usize::from(self.n_kept[frame])..self.channels]
    }
}

/// The masks of one window behind all seven layers that have dropout.
#[derive(Debug, Clone)]
pub struct Dropout {
    /// What kept channels are multiplied with.
    pub scale: f32,
    /// After the encoder's convolutions.
    pub encoder: [ChannelMask; ENCODER_CHANNELS.len()],
    /// After the decoder's transposed convolutions but the last.
    pub decoder: [ChannelMask; DECODER_CHANNELS.len()],
}

impl Dropout {
    /// Every channel kept, as outside training.
    pub fn off(n_frames: usize) -> Self {
        let keep = |channels| ChannelMask::new(n_frames, channels, |_, _| true);
        Self {
            scale: 1.0,
            encoder: ENCODER_CHANNELS.map(keep),
            decoder: DECODER_CHANNELS.map(keep),
        }
    }

    /// Fair coins: the first of update `update` under a seed.
    pub fn draw(n_frames: usize, seed: u64, update: u64) -> Self {
        Self::draw_from(n_frames, &mut stream(seed, Purpose::Dropout, update))
    }

    /// Fair coins: the next of a stream.
    pub(crate) fn draw_from(n_frames: usize, rng: &mut ChaCha8Rng) -> Self {
        let mut toss = |channels: usize| {
            let words_each = channels.div_ceil(64);
            let words: Vec<u64> = (0..n_frames * words_each).map(|_| rng.next_u64()).collect();
            ChannelMask::new(n_frames, channels, |frame, channel| {
                words[frame * words_each + channel / 64] >> (channel % 64) & 1 == 1
            })
        };
        Self {
            scale: 2.0,
            encoder: ENCODER_CHANNELS.map(&mut toss),
            decoder: DECODER_CHANNELS.map(&mut toss),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_channel_is_kept_or_lost_and_half_are_kept() {
        let dropout = Dropout::draw(200, 1, 0);
        let mut n_kept = 0;
        for frame in 0..200 {
            let mask = &dropout.decoder[0];
            let mut all = [mask.kept(frame), mask.lost(frame)].concat();
            n_kept += mask.kept(frame).len();
            all.sort_unstable();
            assert!(all.iter().copied().eq(0..128));
        }
        // 25,600 fair coins: a deviation of 400 is five standard deviations.
        assert!(n_kept.abs_diff(12_800) < 400, "{n_kept}");
    }

    #[test]
    fn masks_depend_on_seed_and_update() {
        let kept = |seed, update| Dropout::draw(4, seed, update).decoder[0].order.clone();
        assert_eq!(kept(1, 2), kept(1, 2));
        assert_ne!(kept(1, 2), kept(2, 2));
        assert_ne!(kept(1, 2), kept(1, 3));
    }
}
