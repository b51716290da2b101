//! What the operators share: tensors as slices, frames in parallel, sums.

use candle_core::{CpuStorage, Device, Layout, Result, Shape, Storage, Tensor};
use protocol::vectors::vectorised;
use rayon::prelude::*;
use std::mem::take;
use std::ops::{AddAssign, Deref, Range};

/// Parts of a window that are worked on at the same time, each with sums of its own, which are added in
/// their order: the number of threads changes no bit of the result.
const N_CHUNKS: usize = 8;

/// The numbers of an operator's argument.
pub(super) fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let Some((start, end)) = layout.contiguous_offsets() else {
        candle_core::bail!("expected a contiguous tensor, got {layout:?}");
    };
    Ok(&storage.as_slice::<f32>()?[start..end])
}

/// The numbers of a contiguous tensor on the CPU, which is locked meanwhile.
pub(super) fn numbers(tensor: &Tensor) -> Result<impl Deref<Target = [f32]> + '_> {
    let (storage, layout) = tensor.storage_and_layout();
    let range = match (&*storage, layout.contiguous_offsets()) {
        (Storage::Cpu(CpuStorage::F32(_)), Some((start, end))) => start..end,
        _ => candle_core::bail!("expected contiguous 32-bit floats on the CPU"),
    };
    Ok(Numbers { storage, range })
}

struct Numbers<G> {
    storage: G,
    range: Range<usize>,
}

impl<G: Deref<Target = Storage>> Deref for Numbers<G> {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        match &*self.storage {
            Storage::Cpu(CpuStorage::F32(numbers)) => &numbers[self.range.clone()],
            _ => unreachable!("invariant: `numbers` has looked"),
        }
    }
}

/// A tensor on the CPU.
pub(super) fn tensor(numbers: Vec<f32>, shape: impl Into<Shape>) -> Result<Tensor> {
    Tensor::from_vec(numbers, shape.into(), &Device::Cpu)
}

/// Calls `f(sums, frame, its part of numbers)` for all frames, whose parts begin at `start(frame)`; returns the
/// sums of each chunk of frames.
pub(super) fn frames<A: Send>(
    mut numbers: &mut [f32],
    n_frames: usize,
    start: impl Fn(usize) -> usize + Sync,
    new: impl Fn() -> A + Sync,
    f: impl Fn(&mut A, usize, &mut [f32]) + Sync,
) -> Vec<A> {
    let length = n_frames.div_ceil(N_CHUNKS).max(1);
    let mut chunks = Vec::with_capacity(N_CHUNKS);
    for first in (0..n_frames).step_by(length) {
        let frames = first..(first + length).min(n_frames);
        let (part, rest) = numbers.split_at_mut(start(frames.end) - start(frames.start));
        chunks.push((frames, part));
        numbers = rest;
    }
    let run = |(frames, mut part): (Range<usize>, &mut [f32])| {
        let mut sums = new();
        vectorised(
            #[inline(always)]
            || {
                for frame in frames.clone() {
                    let (own, rest) = take(&mut part).split_at_mut(start(frame + 1) - start(frame));
                    f(&mut sums, frame, own);
                    part = rest;
                }
            },
        );
        sums
    };
    chunks.into_par_iter().with_max_len(1).map(run).collect()
}

/// As [`frames`] for sums alone.
pub(super) fn sums_over_frames<A: Send>(
    n_frames: usize,
    new: impl Fn() -> A + Sync,
    f: impl Fn(&mut A, usize) + Sync,
) -> Vec<A> {
    frames(
        &mut [],
        n_frames,
        |_| 0,
        new,
        #[inline(always)]
        |sums, frame, _| f(sums, frame),
    )
}

/// Adds the chunks' sums, in their order.
pub(super) fn total<T: Copy + AddAssign>(sums: impl IntoIterator<Item = Vec<T>>) -> Vec<T> {
    let mut sums = sums.into_iter();
    let mut total = sums.next().unwrap_or_default();
    for sum in sums {
        add(&mut total, &sum);
    }
    total
}

/// `to += numbers`.
#[inline(always)]
pub(super) fn add<T: Copy + AddAssign>(to: &mut [T], numbers: &[T]) {
    for (to, number) in to.iter_mut().zip(numbers) {
        *to += *number;
    }
}

/// `to += factor numbers`.
#[inline(always)]
pub(super) fn add_scaled(to: &mut [f32], factor: f32, numbers: &[f32]) {
    for (to, number) in to.iter_mut().zip(numbers) {
        *to += factor * number;
    }
}

/// A dot product in eight lanes.
#[inline(always)]
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0; 8];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    for (a, b) in a.iter().zip(b) {
        for lane in 0..8 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    rest + lanes.iter().sum::<f32>()
}
