//! Vectorised loops over [`LANES`] cells at once.
//!
//! These are plain loops over arrays. They are inlined, so that LLVM compiles them for the same vector instructions as
//! their caller.

use super::super::randomness::split_mix;

/// Number of cells processed at once, both to decide cells by bytes and to find the undecided ones.
pub(super) const LANES: usize = 64;

/// Mark of a cell whose byte escaped, so that it must be drawn from the residual distribution. Its high bit
/// distinguishes it from all states, and its even value from the mark of a rejected cell.
const ESCAPED: u8 = 254;

/// The byte values that stand for one tap.
#[derive(Debug)]
pub(super) struct FastTap {
    offset: usize,
    /// The last byte value that stands for this tap. The tap's first value follows the last value of the previous tap.
    bound: u8,
}

/// Returns the taps that byte values stand for. For each tap, `taps` contains the number of values and the offset.
pub(super) fn fast_taps(taps: impl Iterator<Item = (usize, usize)>) -> Vec<FastTap> {
    let mut end = 0;
    let mut fast = Vec::new();
    for (count, offset) in taps.filter(|(count, _)| *count > 0) {
        end += count;
        let bound = u8::try_from(end - 1).expect("invariant: fast probabilities sum to <= 1");
        fast.push(FastTap { offset, bound });
    }
    fast
}

/// Fills `bytes` with the outputs of the SplitMix64 generator of a key, starting at output `first`. `bytes` must
/// consist of whole 64-bit words.
#[inline(always)]
pub(super) fn fill(bytes: &mut [u8], key: u64, first: usize) {
    let (words, _) = bytes.as_chunks_mut();
    for (index, word) in (first..).zip(words) {
        *word = split_mix(key, index as u64).to_le_bytes();
    }
}

/// A reader of the outputs of a key's SplitMix64 generator, in sequence.
#[derive(Debug)]
pub(super) struct Words {
    key: u64,
    n_drawn: usize,
}

impl Words {
    pub(super) fn new(key: u64) -> Self {
        Self { key, n_drawn: 0 }
    }

    #[inline(always)]
    pub(super) fn fill(&mut self, bytes: &mut [u8]) {
        fill(bytes, self.key, self.n_drawn);
        self.n_drawn += bytes.len() / 8;
    }

    pub(super) fn draw(&mut self) -> u64 {
        self.n_drawn += 1;
        split_mix(self.key, self.n_drawn as u64 - 1)
    }
}

/// Replaces each byte with the state of the neighbour at the tap that the byte stands for, or with [`ESCAPED`].
#[inline(always)]
pub(super) fn blend(lanes: &mut [u8; LANES], fast: &[FastTap], parents: &[u8]) {
    let mut states = [ESCAPED; LANES];
    // A byte within the bound of its tap is also within the bounds of all later taps. So the loop runs backwards, and
    // each tap overwrites the results of later taps.
    for tap in fast.iter().rev() {
        let parent = lanes_from(parents, tap.offset);
        for lane in 0..LANES {
            // Arithmetic instead of an `if`, because LLVM vectorises it.
            let chosen = u8::from(lanes[lane] <= tap.bound).wrapping_neg();
            states[lane] ^= (states[lane] ^ parent[lane]) & chosen;
        }
    }
    *lanes = states;
}

#[inline(always)]
pub(super) fn lanes_from(states: &[u8], at: usize) -> &[u8; LANES] {
    let lanes = states[at..].first_chunk();
    lanes.expect("invariant: every tap reads a whole chunk of places")
}

/// Returns the high bits of all lanes, with the bit of lane `8 w + b` at position `8 b + w`. This order needs only one
/// shift per word, and no multiplication to gather the bits.
#[inline]
pub(super) fn high_bits(lanes: &[u8; LANES]) -> u64 {
    let (words, _) = lanes.as_chunks();
    let high = |word| u64::from_le_bytes(word) >> 7 & 0x0101_0101_0101_0101;
    let bits = words
        .iter()
        .enumerate()
        .map(|(index, word)| high(*word) << index);
    bits.fold(0, |all, bits| all | bits)
}

/// Converts a bit's position in [`high_bits`] to its lane, and a lane to the position of its bit.
#[inline]
pub(super) fn transposed(at: u32) -> u32 {
    at % 8 * 8 + at / 8
}

/// For each set bit of [`high_bits`], writes `first` plus the bit's lane. May overwrite the rest of `to`.
///
/// Always writes eight entries at a time, even if fewer are needed, as simdjson's `flatten_bits` does. With a loop over
/// only the set bits, the processor would mispredict the end of the loop in most chunks.
#[inline]
pub(super) fn list_lanes(mut bits: u64, first: u32, to: &mut [u32; LANES]) {
    for eight in to.as_chunks_mut::<8>().0 {
        for lane in eight {
            *lane = first + transposed(bits.trailing_zeros() % 64);
            bits &= bits.wrapping_sub(1);
        }
        if bits == 0 {
            return;
        }
    }
}
