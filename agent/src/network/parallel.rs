//! Passes over a window, in a fixed number of chunks of frames.
//!
//! Each chunk owns its frames' maps and its own sums, which are added up in the order of the chunks.
//! So the number of threads changes no bit of the result.

use super::lanes::{Arithmetic, Kernel, dispatch};
use rayon::prelude::*;
use std::ops::Range;

/// Parts of a window. More balance better on busy machines, but each has its own gradient to add up.
const N_CHUNKS: usize = 4;

/// The frames of each chunk.
pub(crate) fn chunks_of(n_frames: usize) -> impl Iterator<Item = Range<usize>> {
    let bound = move |chunk: usize| n_frames * chunk / N_CHUNKS;
    (0..N_CHUNKS).map(move |chunk| bound(chunk)..bound(chunk + 1))
}

/// One pass over a chunk's frames.
pub(crate) trait Pass<C>: Sync {
    /// Does it.
    fn run<A: Arithmetic>(&self, chunk: &mut C);
}

/// Runs a pass on all chunks, on the threads of the current rayon pool.
pub(crate) fn for_each_chunk<C: Send, P: Pass<C>>(chunks: &mut [C], pass: &P) {
    chunks
        .par_iter_mut()
        .with_max_len(1)
        .for_each(|chunk| dispatch(OnChunk { pass, chunk }));
}

struct OnChunk<'a, C, P> {
    pass: &'a P,
    chunk: &'a mut C,
}

impl<C, P: Pass<C>> Kernel for OnChunk<'_, C, P> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        self.pass.run::<A>(self.chunk);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_cover_every_frame_once() {
        for n_frames in [1, 2, 7, 1000] {
            let frames: Vec<usize> = chunks_of(n_frames).flatten().collect();
            assert!(frames.into_iter().eq(0..n_frames), "{n_frames}");
        }
    }
}
