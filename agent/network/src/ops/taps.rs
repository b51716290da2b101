//! Where the taps of a transposed convolution of kernel 4, stride 2 and padding 1 fall.
//!
//! Row `2 r + p` of the output meets two rows of the input, `r + p - 1` and `r + p`, through rows `3 - p` and
//! `1 - p` of the kernel; columns alike. So each of the four phases `(p, q)` of the output is an ordinary
//! convolution at the input's size, of shifted inputs.

/// Side of a kernel.
const SIDE: usize = 4;

/// Taps of a kernel.
pub(super) const TAPS: usize = SIDE * SIDE;

/// Phases of the output, and terms of each of its numbers.
pub(super) const PHASES: usize = 4;

/// Sizes of one doubling.
#[derive(Clone, Copy)]
pub(super) struct Sizes {
    pub(super) channels_in: usize,
    pub(super) channels_out: usize,
    pub(super) rows: usize,
    pub(super) cols: usize,
}

impl Sizes {
    /// Cells of the input.
    pub(super) fn area(&self) -> usize {
        self.rows * self.cols
    }

    /// Cells of the output.
    pub(super) fn out_area(&self) -> usize {
        PHASES * self.area()
    }

    /// Numbers of an input that [`Self::shift`] has written.
    pub(super) fn shifted(&self) -> usize {
        3 * (self.rows + 2) * self.cols
    }

    /// Where an input itself begins among these.
    pub(super) fn unshifted(&self) -> usize {
        (self.rows + 2) * self.cols + self.cols
    }

    /// Writes an input three times: shifted to the right, not, to the left; each between two rows of zeros.
    #[inline(always)]
    pub(super) fn shift(&self, x: &[f32], shifted: &mut [f32]) {
        let (cols, area) = (self.cols, self.area());
        let (right, rest) = shifted.split_at_mut(area + 2 * cols);
        let (same, left) = rest.split_at_mut(area + 2 * cols);
        same[cols..][..area].copy_from_slice(x);
        right[cols + 1..][..area - 1].copy_from_slice(&x[..area - 1]);
        left[cols..][..area - 1].copy_from_slice(&x[1..]);
        for row in 1..=self.rows {
            right[row * cols] = 0.0;
            left[row * cols + cols - 1] = 0.0;
        }
    }

    /// The four terms of a phase: a tap, and where its shifted input begins.
    pub(super) fn terms(&self, phase: usize) -> [(usize, usize); PHASES] {
        let ([p, q], cols) = ([phase / 2, phase % 2], self.cols);
        [[0, 0], [0, 1], [1, 0], [1, 1]].map(|[down, right]| {
            let tap = (3 - p - 2 * down) * SIDE + 3 - q - 2 * right;
            let shifted = (q + right) * (self.rows + 2) * cols + (p + down) * cols;
            (tap, shifted)
        })
    }

    /// The input cells that an output cell meets, each through a tap.
    #[inline(always)]
    pub(super) fn meets(&self, row: usize, col: usize) -> impl Iterator<Item = (usize, usize)> {
        let (rows, cols) = (self.rows, self.cols);
        // Rows and columns of the input, from one on.
        let first = [row, col].map(|at| at / 2 + at % 2);
        [[0, 0], [0, 1], [1, 0], [1, 1]]
            .into_iter()
            .filter_map(move |[down, right]| {
                let tap = (3 - row % 2 - 2 * down) * SIDE + 3 - col % 2 - 2 * right;
                let (row, col) = (first[0] + down, first[1] + right);
                let is_inside = (1..=rows).contains(&row) && (1..=cols).contains(&col);
                is_inside.then(|| (tap, (row - 1) * cols + col - 1))
            })
    }

    /// Puts an output's phases together, each between `start`'s numbers.
    #[inline(always)]
    pub(super) fn interleave(&self, phases: &[f32], start: &[f32], out: &mut [f32]) {
        let (area, cols) = (self.area(), self.cols);
        let rows = out
            .chunks_exact_mut(2 * cols)
            .zip(start.chunks_exact(2 * cols));
        for (row, (out, start)) in rows.enumerate() {
            let part = |q: usize| &phases[(row % 2 * 2 + q) * area + row / 2 * cols..][..cols];
            let (even, odd) = (part(0), part(1));
            let (out, start) = (out.as_chunks_mut::<2>().0, start.as_chunks::<2>().0);
            for col in 0..cols {
                out[col] = [start[col][0] + even[col], start[col][1] + odd[col]];
            }
        }
    }

    /// Numbers of an output's gradient that [`Self::split`] has written.
    pub(super) fn views(&self) -> usize {
        2 * SIDE * (self.rows + 1) * self.cols
    }

    /// Writes an output's gradient as each column of the kernel meets it: odd rows below a row of zeros, then
    /// even rows above one.
    #[inline(always)]
    pub(super) fn split(&self, d_out: &[f32], views: &mut [f32]) {
        let (cols, length) = (self.cols, (self.rows + 1) * self.cols);
        let (odd, even) = views.split_at_mut(SIDE * length);
        for (row, d_out) in d_out.chunks_exact(2 * cols).enumerate() {
            let (views, at) = match row % 2 {
                0 => (&mut *even, row / 2 * cols),
                _ => (&mut *odd, (row / 2 + 1) * cols),
            };
            let (d_out, _) = d_out.as_chunks::<2>();
            let mut views = views
                .chunks_exact_mut(length)
                .map(|view| &mut view[at..][..cols]);
            let mut next = || views.next().expect("invariant: a view for each column");
            let [left, middle, odd, right] = [next(), next(), next(), next()];
            for col in 0..cols {
                [middle[col], odd[col]] = d_out[col];
            }
            left[1..].copy_from_slice(&odd[..cols - 1]);
            right[..cols - 1].copy_from_slice(&middle[1..]);
        }
    }

    /// Where the view of a tap begins.
    pub(super) fn view(&self, tap: usize) -> usize {
        let (row, col) = (tap / SIDE, tap % SIDE);
        let length = (self.rows + 1) * self.cols;
        let first = (row % 2 * SIDE + col) * length;
        first + if row < 2 { 0 } else { self.cols }
    }

    /// Writes what each cell's taps meet of an output's gradient, `[cells, taps]`. `padded` is room with zeros
    /// around `2 rows + 2` rows.
    #[inline(always)]
    pub(super) fn patches(&self, d_out: &[f32], padded: &mut [f32], patches: &mut [f32]) {
        let width = 2 * self.cols + 2;
        let rows = padded[width..].chunks_exact_mut(width);
        for (padded, d_out) in rows.zip(d_out.chunks_exact(2 * self.cols)) {
            padded[1..=2 * self.cols].copy_from_slice(d_out);
        }
        let (patches, _) = patches.as_chunks_mut::<TAPS>();
        for (row, patches) in patches.chunks_exact_mut(self.cols).enumerate() {
            for tap in 0..SIDE {
                let padded = &padded[(2 * row + tap) * width..][..width];
                for (col, patch) in patches.iter_mut().enumerate() {
                    patch[tap * SIDE..][..SIDE].copy_from_slice(&padded[2 * col..][..SIDE]);
                }
            }
        }
    }

    /// Numbers of its padded room.
    pub(super) fn padded(&self) -> usize {
        (2 * self.rows + 2) * (2 * self.cols + 2)
    }
}
