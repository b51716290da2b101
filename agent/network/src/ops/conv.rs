//! The arithmetic of every convolution, one frame at a time: the forward pass and both gradients.
//!
//! A convolution reads a *large* map and produces a *small* one (of equal size at stride 1). A transposed convolution
//! does the reverse. Each is the gradient of the other, so [`Conv::down`], [`Conv::up`] and
//! [`Conv::add_weight_gradient`] serve both. Maps are `[channels, rows, cols]`, weights
//! `[kernel rows, kernel cols, large channels, small channels]`.
//!
//! All three functions are matrix products without an im2col copy ([`super::product`]). Each plane is copied once into
//! a zero-padded buffer. In this buffer, the cells that one position of the kernel (a *tap*) reads for all output cells
//! are contiguous and form one *run*. With a stride `s`, the large plane is split into `s * s` parts by the remainders
//! of row and column modulo `s`, so that runs stay contiguous.
//!
//! Channels are passed as lists, so that channels removed by dropout are neither read nor computed.

use super::cpu::add;
use super::product::{add_product, left_factor, product, right_factor, steps};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Sizes {
    /// Channels, rows and columns of the large map.
    pub(crate) large: [usize; 3],
    /// Channels, rows and columns of the small map.
    pub(crate) small: [usize; 3],
    pub(crate) kernel: [usize; 2],
    pub(crate) stride: usize,
    pub(crate) padding: usize,
    pub(crate) dilation: usize,
}

#[derive(Debug, Clone)]
pub(crate) struct Conv {
    pub(crate) sizes: Sizes,
    taps: Vec<Tap>,
    part: [usize; 2],
    /// Number of rows of zeros above a small plane, and of columns of zeros left of it.
    margin: [usize; 2],
    framed_cols: usize,
    framed: usize,
}

#[derive(Debug, Clone, Copy)]
struct Tap {
    part: usize,
    shift: [usize; 2],
}

pub(crate) struct Buffers {
    large: Vec<f32>,
    small: Vec<f32>,
    /// The small map with channels last, `[cells, channels]`.
    channels_last: Vec<f32>,
    /// Results, with padding between their rows.
    wide: Vec<f32>,
}

impl Conv {
    /// Panics if the sizes of the two maps do not match the kernel, stride, padding and dilation.
    pub(crate) fn new(sizes: Sizes) -> Self {
        for axis in [0, 1] {
            let reach = sizes.dilation * (sizes.kernel[axis] - 1) + 1;
            let padded = sizes.large[axis + 1] + 2 * sizes.padding;
            let n = padded
                .checked_sub(reach)
                .map_or(0, |rest| rest / sizes.stride + 1);
            assert!(
                n > 0 && n == sizes.small[axis + 1],
                "convolution: inconsistent sizes: {sizes:?}"
            );
        }
        let Sizes {
            stride, dilation, ..
        } = sizes;
        let part = [1, 2].map(|axis| (sizes.large[axis] + 2 * sizes.padding).div_ceil(stride));
        let margin = sizes.kernel.map(|side| dilation * (side - 1) / stride);
        let tap = |at: usize| {
            let at = [at / sizes.kernel[1], at % sizes.kernel[1]].map(|at| at * dilation);
            Tap {
                part: at[0] % stride * stride + at[1] % stride,
                shift: at.map(|at| at / stride),
            }
        };
        let framed_cols = part[1] + margin[1];
        Self {
            taps: (0..sizes.kernel[0] * sizes.kernel[1]).map(tap).collect(),
            part,
            margin,
            framed_cols,
            framed: (part[0] + margin[0]) * framed_cols,
            sizes,
        }
    }

    pub(crate) fn n_weights(&self) -> usize {
        self.sizes.small[0] * self.sizes.large[0] * self.taps.len()
    }

    pub(crate) fn large_area(&self) -> usize {
        self.sizes.large[1] * self.sizes.large[2]
    }

    pub(crate) fn small_area(&self) -> usize {
        self.sizes.small[1] * self.sizes.small[2]
    }

    fn split(&self) -> usize {
        self.sizes.stride * self.sizes.stride * self.part[0] * self.part[1]
    }

    pub(crate) fn buffers(&self) -> Buffers {
        let Sizes { large, small, .. } = self.sizes;
        let wide = (small[0] * small[1] * self.part[1]).max(large[0] * self.framed);
        Buffers {
            large: vec![0.0; large[0] * self.split()],
            small: vec![0.0; small[0] * self.framed],
            channels_last: vec![0.0; self.small_area() * small[0]],
            wide: vec![0.0; wide],
        }
    }

    /// Copies a large plane to position `index` of the buffer. The zeros around the plane stay in place.
    #[inline(always)]
    pub(crate) fn put_large(&self, buffers: &mut Buffers, index: usize, plane: &[f32]) {
        let Sizes {
            stride, padding, ..
        } = self.sizes;
        let [part_rows, part_cols] = self.part;
        let to = &mut buffers.large[index * self.split()..][..self.split()];
        for (row, from) in plane.chunks_exact(self.sizes.large[2]).enumerate() {
            let row = row + padding;
            let first = row % stride * stride * part_rows + row / stride;
            if stride == 1 {
                to[first * part_cols + padding..][..from.len()].copy_from_slice(from);
                continue;
            }
            for col in padding..(padding + stride).min(padding + from.len()) {
                let first = (first + col % stride * part_rows) * part_cols + col / stride;
                every(stride, &from[col - padding..], &mut to[first..]);
            }
        }
    }

    #[inline(always)]
    pub(crate) fn put_all_large(&self, buffers: &mut Buffers, map: &[f32]) {
        for (index, plane) in map.chunks_exact(self.large_area()).enumerate() {
            self.put_large(buffers, index, plane);
        }
    }

    pub(crate) fn channels(&self) -> [Vec<usize>; 2] {
        [self.sizes.large[0], self.sizes.small[0]].map(|n| (0..n).collect())
    }

    #[inline(always)]
    pub(crate) fn put_small(&self, buffers: &mut Buffers, index: usize, plane: &[f32]) {
        let cols = self.sizes.small[2];
        let first = self.margin[0] * self.framed_cols + self.margin[1];
        let to = buffers.small[index * self.framed + first..].chunks_mut(self.framed_cols);
        for (to, from) in to.zip(plane.chunks_exact(cols)) {
            to[..cols].copy_from_slice(from);
        }
    }

    /// Other channels keep the values of earlier frames until [`Self::clear_transposed`] is called.
    #[inline(always)]
    pub(crate) fn transpose_small(&self, buffers: &mut Buffers, channel: usize, plane: &[f32]) {
        let to = buffers.channels_last[channel..]
            .iter_mut()
            .step_by(self.sizes.small[0]);
        to.zip(plane).for_each(|(to, from)| *to = *from);
    }

    #[inline(always)]
    pub(crate) fn transpose_all_small(&self, buffers: &mut Buffers, map: &[f32]) {
        /// Number of cells per block. A block fits into the first-level cache.
        const CELLS: usize = 64;
        let n = self.sizes.small[0];
        for (block, to) in buffers.channels_last.chunks_mut(CELLS * n).enumerate() {
            for (channel, plane) in map.chunks_exact(self.small_area()).enumerate() {
                let to = to[channel..].iter_mut().step_by(n);
                to.zip(&plane[block * CELLS..])
                    .for_each(|(to, from)| *to = *from);
            }
        }
    }

    #[inline(always)]
    pub(crate) fn clear_transposed(&self, buffers: &mut Buffers) {
        buffers.channels_last.fill(0.0);
    }

    pub(crate) fn channels_last<'a>(&self, buffers: &'a Buffers) -> &'a [f32] {
        &buffers.channels_last
    }

    /// Computes the given small channels from the given large channels in `buffers`, and adds them to `out`.
    #[inline(always)]
    pub(crate) fn down(
        &self,
        weights: &[f32],
        buffers: &mut Buffers,
        [large, small]: [&[usize]; 2],
        out: &mut [f32],
    ) {
        let [n, rows, cols] = self.sizes.small;
        let (mut factors, mut runs) = (Vec::new(), Vec::new());
        for tap in 0..self.taps.len() {
            for (index, channel) in large.iter().enumerate() {
                factors.push((tap * self.sizes.large[0] + channel) * n);
                runs.push(index * self.split() + self.run(tap));
            }
        }
        let width = self.part[1];
        let to = steps(small.len(), rows * width);
        let left = left_factor(weights, small, &factors);
        let right = right_factor(&buffers.large, &runs, (rows - 1) * width + cols);
        product(&mut buffers.wide, &to, left, right);
        let wide = buffers.wide.chunks_exact(rows * width);
        for (out, wide) in out
            .chunks_exact_mut(rows * cols)
            .zip(wide)
            .take(small.len())
        {
            let rows = out.chunks_exact_mut(cols).zip(wide.chunks_exact(width));
            rows.for_each(|(out, wide)| add(out, &wide[..cols]));
        }
    }

    /// Computes the given large channels from the given small channels in `buffers`, and adds them to `out`.
    #[inline(always)]
    pub(crate) fn up(
        &self,
        weights: &[f32],
        buffers: &mut Buffers,
        [large, small]: [&[usize]; 2],
        out: &mut [f32],
    ) {
        let stride = self.sizes.stride;
        let [channels, rows, cols] = self.sizes.large;
        let (n, width) = (self.sizes.small[0], self.framed_cols);
        if self.small_area() == 1 && self.sizes.padding == 0 && self.sizes.dilation == 1 {
            return self.up_of_one_cell(weights, buffers, [large, small], out);
        }
        let rows_of: Vec<usize> = large.iter().map(|channel| channel * n).collect();
        for part in 0..stride * stride {
            let (first_row, n_rows) = self.inside(part / stride, rows);
            let (first_col, n_cols) = self.inside(part % stride, cols);
            let (mut factors, mut runs) = (Vec::new(), Vec::new());
            let taps = self.taps.iter().enumerate().rev();
            for (tap, Tap { shift, .. }) in taps.filter(|(_, tap)| tap.part == part) {
                let row = self.margin[0] + first_row - shift[0];
                let first = row * width + self.margin[1] + first_col - shift[1];
                for (index, channel) in small.iter().enumerate() {
                    factors.push(tap * channels * n + channel);
                    runs.push(index * self.framed + first);
                }
            }
            if n_rows == 0 || n_cols == 0 || runs.is_empty() {
                continue;
            }
            let to = steps(large.len(), n_rows * width);
            let left = left_factor(weights, &rows_of, &factors);
            let right = right_factor(&buffers.small, &runs, (n_rows - 1) * width + n_cols);
            product(&mut buffers.wide, &to, left, right);
            let corner = |first: usize, rest: usize| first * stride + rest - self.sizes.padding;
            let top = corner(first_row, part / stride);
            let left = corner(first_col, part % stride);
            let wide = buffers.wide.chunks_exact(n_rows * width);
            for (out, wide) in out
                .chunks_exact_mut(rows * cols)
                .zip(wide)
                .take(large.len())
            {
                let out = out.chunks_exact_mut(cols).skip(top).step_by(stride);
                for (out, wide) in out.zip(wide.chunks_exact(width)) {
                    add_to_every(stride, &wide[..n_cols], &mut out[left..]);
                }
            }
        }
    }

    /// Computes [`Self::up`] for a small map of one cell. Each tap writes a different cell of the large map.
    fn up_of_one_cell(
        &self,
        weights: &[f32],
        buffers: &Buffers,
        [large, small]: [&[usize]; 2],
        out: &mut [f32],
    ) {
        let ([channels, _, cols], n) = (self.sizes.large, self.sizes.small[0]);
        let first = self.margin[0] * self.framed_cols + self.margin[1];
        let cell: Vec<f32> = (0..small.len())
            .map(|index| buffers.small[index * self.framed + first])
            .collect();
        for (tap, weights) in weights.chunks_exact(channels * n).enumerate() {
            let at = tap / self.sizes.kernel[1] * cols + tap % self.sizes.kernel[1];
            for (channel, out) in large.iter().zip(out.chunks_exact_mut(self.large_area())) {
                let weights = &weights[channel * n..][..n];
                let products = small
                    .iter()
                    .zip(&cell)
                    .map(|(channel, x)| weights[*channel] * x);
                out[at] += products.sum::<f32>();
            }
        }
    }

    /// Returns the first row (or column) with the given remainder that lies inside the large plane, and their number.
    fn inside(&self, remainder: usize, side: usize) -> (usize, usize) {
        let Sizes {
            stride, padding, ..
        } = self.sizes;
        let first = padding.saturating_sub(remainder).div_ceil(stride);
        let end = (side + padding).saturating_sub(remainder).div_ceil(stride);
        (first, end.saturating_sub(first))
    }

    #[inline(always)]
    pub(crate) fn add_weight_gradient(&self, buffers: &Buffers, large: &[usize], to: &mut [f32]) {
        let ([n, rows, cols], width) = (self.sizes.small, self.part[1]);
        let (mut from, mut into) = (Vec::new(), Vec::new());
        for (index, channel) in large.iter().enumerate() {
            for tap in 0..self.taps.len() {
                from.push(index * self.split() + self.run(tap));
                into.push((tap * self.sizes.large[0] + channel) * n);
            }
        }
        let cells = 0..rows * cols;
        let cells: Vec<usize> = cells.map(|at| at / cols * width + at % cols).collect();
        let cell_rows = steps(rows * cols, n);
        let left = left_factor(&buffers.large, &from, &cells);
        add_product(
            to,
            &into,
            left,
            right_factor(&buffers.channels_last, &cell_rows, n),
        );
    }

    fn run(&self, tap: usize) -> usize {
        let Tap { part, shift } = self.taps[tap];
        (part * self.part[0] + shift[0]) * self.part[1] + shift[1]
    }
}

#[inline(always)]
fn every(n: usize, from: &[f32], to: &mut [f32]) {
    #[inline(always)]
    fn constant<const N: usize>(from: &[f32], to: &mut [f32]) {
        let (from, rest) = from.as_chunks::<N>();
        let last = rest.first().into_iter();
        let all = from.iter().map(|numbers| &numbers[0]).chain(last);
        to.iter_mut().zip(all).for_each(|(to, from)| *to = *from);
    }
    match n {
        2 => constant::<2>(from, to),
        4 => constant::<4>(from, to),
        _ => (to.iter_mut().zip(from.iter().step_by(n))).for_each(|(to, from)| *to = *from),
    }
}

#[inline(always)]
fn add_to_every(n: usize, numbers: &[f32], to: &mut [f32]) {
    match n {
        1 => add(to, numbers),
        2 => {
            let (pairs, rest) = to.as_chunks_mut::<2>();
            let all = pairs
                .iter_mut()
                .map(|pair| &mut pair[0])
                .chain(rest.first_mut());
            all.zip(numbers).for_each(|(to, number)| *to += number);
        }
        _ => (to.iter_mut().step_by(n).zip(numbers)).for_each(|(to, number)| *to += number),
    }
}
