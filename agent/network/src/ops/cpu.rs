//! Common code of the operators: tensors as slices, parallel loops over frames, and tensors with custom gradients.

use candle_core::{CpuStorage, CustomOp1, Device, Layout, Result, Shape, Storage, Tensor};
use emberwatch_model::vectors::vectorised;
use rayon::prelude::*;
use std::ops::{AddAssign, Deref, Range};
use std::sync::Mutex;

/// Maximum number of chunks of a window that are processed in parallel. Each chunk has separate sums, which are added
/// in a fixed order, so the result does not depend on the number of threads.
const N_CHUNKS: usize = 32;

/// Returns the values of a contiguous tensor on the CPU. The tensor is locked until the result is dropped.
pub(crate) fn numbers(tensor: &Tensor) -> Result<impl Deref<Target = [f32]> + '_> {
    let (storage, layout) = tensor.storage_and_layout();
    let range = match (&*storage, layout.contiguous_offsets()) {
        (Storage::Cpu(CpuStorage::F32(_)), Some((start, end))) => start..end,
        _ => candle_core::bail!("expected contiguous 32-bit floats on the CPU"),
    };
    Ok(Numbers { storage, range })
}

pub(super) fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (CpuStorage::F32(numbers), Some((start, end))) => Ok(&numbers[start..end]),
        _ => candle_core::bail!("expected contiguous 32-bit floats on the CPU"),
    }
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
            _ => unreachable!("invariant: `numbers` has checked the storage"),
        }
    }
}

/// `backward` converts the gradient of the result into the concatenated gradients of `from`, in the same order.
pub(crate) fn derived(
    from: &[&Tensor],
    shape: impl Into<Shape>,
    numbers: Vec<f32>,
    backward: impl Fn(&[f32]) -> Vec<f32> + Send + Sync + 'static,
) -> Result<Tensor> {
    let flat = from.iter().map(|tensor| tensor.flatten_all());
    let op = Derived {
        shape: shape.into(),
        numbers: Mutex::new(numbers),
        backward,
    };
    Tensor::cat(&flat.collect::<Result<Vec<_>>>()?, 0)?.apply_op1(op)
}

struct Derived<F> {
    shape: Shape,
    /// The tensor's values, until the forward pass moves them into the tensor.
    numbers: Mutex<Vec<f32>>,
    backward: F,
}

impl<F: Fn(&[f32]) -> Vec<f32> + Send + Sync> CustomOp1 for Derived<F> {
    fn name(&self) -> &'static str {
        "derived"
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        let mut numbers = self
            .numbers
            .lock()
            .expect("invariant: no thread panics with the lock");
        let numbers = std::mem::take(&mut *numbers);
        Ok((CpuStorage::F32(numbers), self.shape.clone()))
    }

    fn bwd(&self, from: &Tensor, _: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let gradient = gradient.contiguous()?;
        let gradients = (self.backward)(&numbers(&gradient)?);
        Tensor::from_vec(gradients, from.shape(), &Device::Cpu).map(Some)
    }
}

pub(crate) struct Frames {
    chunks: Vec<Chunk>,
    length: usize,
}

struct Chunk {
    numbers: Vec<f32>,
    /// The index in `numbers` at which each frame's values end.
    ends: Vec<usize>,
}

/// Calls `f(sums, frame, numbers)` for each frame, where `numbers` contains `n(frame)` zeros to overwrite. Returns the
/// numbers of all frames, and the sums of each chunk of frames.
pub(super) fn frames<A: Send>(
    n_frames: usize,
    n: impl Fn(usize) -> usize + Sync,
    new: impl Fn() -> A + Sync,
    f: impl Fn(&mut A, usize, &mut [f32]) + Sync,
) -> (Frames, Vec<A>) {
    let length = n_frames.div_ceil(N_CHUNKS).max(1);
    let run = |first: usize| {
        let frames = first..(first + length).min(n_frames);
        let mut sums = new();
        let mut ends = Vec::with_capacity(length);
        let mut numbers = Vec::with_capacity(frames.clone().map(&n).sum());
        vectorised(
            #[inline(always)]
            || {
                for frame in frames.clone() {
                    let start = numbers.len();
                    numbers.resize(start + n(frame), 0.0);
                    f(&mut sums, frame, &mut numbers[start..]);
                    ends.push(numbers.len());
                }
            },
        );
        (Chunk { numbers, ends }, sums)
    };
    let firsts: Vec<usize> = (0..n_frames).step_by(length).collect();
    let chunks = firsts.into_par_iter().with_max_len(1).map(run);
    let (chunks, sums) = chunks.unzip();
    (Frames { chunks, length }, sums)
}

impl Frames {
    pub(crate) fn of(n_frames: usize, numbers: &[f32]) -> Self {
        let n = numbers.len() / n_frames;
        let copy = |_: &mut (), frame: usize, to: &mut [f32]| {
            to.copy_from_slice(&numbers[frame * n..][..n])
        };
        frames(n_frames, |_| n, || (), copy).0
    }

    #[inline(always)]
    pub(super) fn frame(&self, frame: usize) -> &[f32] {
        let (chunk, at) = (&self.chunks[frame / self.length], frame % self.length);
        let start = at.checked_sub(1).map_or(0, |before| chunk.ends[before]);
        &chunk.numbers[start..chunk.ends[at]]
    }

    pub(crate) fn concat(mut self) -> Vec<f32> {
        match self.chunks.len() {
            1 => self.chunks.remove(0).numbers,
            _ => {
                let chunks = self.chunks.iter().map(|chunk| &chunk.numbers[..]);
                chunks.collect::<Vec<_>>().concat()
            }
        }
    }
}

/// Adds the sums of all chunks, in their order.
pub(super) fn total<T: Copy + AddAssign>(sums: impl IntoIterator<Item = Vec<T>>) -> Vec<T> {
    let mut sums = sums.into_iter();
    let mut total = sums.next().unwrap_or_default();
    for sum in sums {
        add(&mut total, &sum);
    }
    total
}

#[inline(always)]
pub(super) fn add<T: Copy + AddAssign>(to: &mut [T], numbers: &[T]) {
    for (to, number) in to.iter_mut().zip(numbers) {
        *to += *number;
    }
}

#[inline(always)]
pub(super) fn add_scaled(to: &mut [f32], factor: f32, numbers: &[f32]) {
    for (to, number) in to.iter_mut().zip(numbers) {
        *to += factor * number;
    }
}

#[inline(always)]
pub(super) fn sum(numbers: &[f32]) -> f32 {
    let (numbers, rest) = numbers.as_chunks::<16>();
    let mut lanes = [0.0; 16];
    for numbers in numbers {
        add(&mut lanes, numbers);
    }
    rest.iter().sum::<f32>() + lanes.iter().sum::<f32>()
}
