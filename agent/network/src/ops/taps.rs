//! Where the taps of a transposed convolution of kernel 4, stride 2 and padding 1 fall.

/// Taps of a kernel.
pub(super) const TAPS: usize = 16;

/// Sizes of one doubling.
#[derive(Clone, Copy)]
pub(super) struct Sizes {
    pub(super) channels_in: usize,
    pub(super) channels_out: usize,
    pub(super) rows: usize,
    pub(super) cols: usize,
}

impl Sizes {
    /// Of an input `[frames, channels in, rows, cols]` and kernels `[channels in, channels out, 4, 4]`.
    pub(super) fn new(z: &[usize], kernels: &[usize]) -> Self {
        Self {
            channels_in: z[1],
            channels_out: kernels[1],
            rows: z[2],
            cols: z[3],
        }
    }

    /// Cells of the input.
    pub(super) fn area(&self) -> usize {
        self.rows * self.cols
    }

    pub(super) fn per_input(&self) -> usize {
        self.channels_in * self.area()
    }

    pub(super) fn per_output(&self) -> usize {
        self.channels_out * 4 * self.area()
    }
}

/// The rows of taps that meet at a row of the output, `(tap's row, input's row)`; the same of columns.
#[inline(always)]
pub(super) fn meeting(row: usize, rows: usize) -> impl Iterator<Item = (usize, usize)> {
    let (near, far) = match row % 2 {
        0 => ((1, row / 2), (3, (row / 2).wrapping_sub(1))),
        _ => ((2, row / 2), (0, row / 2 + 1)),
    };
    [near, far].into_iter().filter(move |(_, at)| *at < rows)
}

/// Adds taps `[4, 4, rows, cols]` of one channel to where they fall in `out [2 rows, 2 cols]`.
#[inline(always)]
pub(super) fn join(taps: &[f32], out: &mut [f32], cols: usize) {
    // With their length known, rows become vectors.
    match cols {
        4 => join_rows::<4>(taps, out, cols),
        8 => join_rows::<8>(taps, out, cols),
        16 => join_rows::<16>(taps, out, cols),
        _ => join_rows::<0>(taps, out, cols),
    }
}

/// The other way: `taps` are what each tap meets in `d_out`.
#[inline(always)]
pub(super) fn split(taps: &mut [f32], d_out: &[f32], cols: usize) {
    match cols {
        4 => split_rows::<4>(taps, d_out, cols),
        8 => split_rows::<8>(taps, d_out, cols),
        16 => split_rows::<16>(taps, d_out, cols),
        _ => split_rows::<0>(taps, d_out, cols),
    }
}

/// `COLS` is `cols`, or 0 if not known.
#[inline(always)]
fn join_rows<const COLS: usize>(taps: &[f32], out: &mut [f32], cols: usize) {
    let cols = if COLS > 0 { COLS } else { cols };
    let area = out.len() / 4;
    for (row, out) in out.chunks_exact_mut(2 * cols).enumerate() {
        for (tap, at) in meeting(row, area / cols) {
            let part = |col: usize| &taps[(tap * 4 + col) * area + at * cols..][..cols];
            let [left, even, odd, right] = [part(0), part(1), part(2), part(3)];
            for col in 0..cols {
                out[2 * col] += even[col] + if col > 0 { right[col - 1] } else { 0.0 };
                out[2 * col + 1] += odd[col] + if col + 1 < cols { left[col + 1] } else { 0.0 };
            }
        }
    }
}

#[inline(always)]
fn split_rows<const COLS: usize>(taps: &mut [f32], d_out: &[f32], cols: usize) {
    let cols = if COLS > 0 { COLS } else { cols };
    let area = d_out.len() / 4;
    // The first and the last row of the input each have one tap outside.
    let planes = |taps: &mut [f32], at: std::ops::Range<usize>| {
        let planes = taps.chunks_exact_mut(area);
        planes.for_each(|plane| plane[at.clone()].fill(0.0));
    };
    planes(&mut taps[..4 * area], 0..cols);
    planes(&mut taps[12 * area..], area - cols..area);
    for (row, d_out) in d_out.chunks_exact(2 * cols).enumerate() {
        for (tap, at) in meeting(row, area / cols) {
            let (left, rest) = taps[tap * 4 * area..][..4 * area].split_at_mut(area);
            let (even, rest) = rest.split_at_mut(area);
            let (odd, right) = rest.split_at_mut(area);
            let [left, even, odd, right] =
                [left, even, odd, right].map(|part| &mut part[at * cols..][..cols]);
            for col in 0..cols {
                even[col] = d_out[2 * col];
                odd[col] = d_out[2 * col + 1];
            }
            left[0] = 0.0;
            left[1..].copy_from_slice(&odd[..cols - 1]);
            right[cols - 1] = 0.0;
            right[..cols - 1].copy_from_slice(&even[1..]);
        }
    }
}
