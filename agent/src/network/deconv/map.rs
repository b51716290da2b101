//! How the pixels of a channel lie in memory.

use crate::network::lanes::{Arithmetic, LANES, Lanes, whole_lanes};

/// Rows of a multiple of this many pixels are woven with whole vectors.
const PART: usize = LANES / 2;

/// Rows and columns, and their order. A doubling leaves its four phases one behind the other, each padded
/// to whole lanes: as it computes them, so that nothing has to be woven before all frames are normalised.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Map {
    rows: usize,
    cols: usize,
    in_phases: bool,
}

impl Map {
    /// Row by row.
    pub(crate) fn rows([rows, cols]: [usize; 2]) -> Self {
        Self {
            rows,
            cols,
            in_phases: false,
        }
    }

    /// A doubling's output: pixels `(2 y + p, 2 x + q)` of phase `(p, q)` together.
    pub(crate) fn phases([rows, cols]: [usize; 2]) -> Self {
        Self {
            rows,
            cols,
            in_phases: true,
        }
    }

    pub(crate) fn size(&self) -> [usize; 2] {
        [self.rows, self.cols]
    }

    pub(crate) fn pixels(&self) -> usize {
        self.rows * self.cols
    }

    fn phase(&self) -> usize {
        whole_lanes(self.pixels() / 4)
    }

    /// Numbers per channel.
    pub(crate) fn length(&self) -> usize {
        match self.in_phases {
            true => 4 * self.phase(),
            false => whole_lanes(self.pixels()),
        }
    }

    /// Where a pixel lies.
    #[inline(always)]
    pub(crate) fn at(&self, row: usize, col: usize) -> usize {
        if !self.in_phases {
            return row * self.cols + col;
        }
        (row % 2 * 2 + col % 2) * self.phase() + row / 2 * (self.cols / 2) + col / 2
    }

    /// One channel, row by row.
    #[inline(always)]
    pub(crate) fn to_rows<A: Arithmetic>(self, from: &[f32], to: &mut [f32]) {
        let to = &mut to[..self.pixels()];
        if !self.in_phases {
            return to.copy_from_slice(&from[..self.pixels()]);
        }
        for (parity, phases) in from.chunks_exact(2 * self.phase()).enumerate() {
            let (even, odd) = phases.split_at(self.phase());
            let rows = to.chunks_exact_mut(self.cols).skip(parity).step_by(2);
            if !self.cols.is_multiple_of(PART) {
                for (pixel, to) in rows.flatten().enumerate() {
                    *to = [even, odd][pixel % 2][pixel / 2];
                }
                continue;
            }
            let mut parts = rows.flat_map(|row| row.as_chunks_mut::<PART>().0);
            for (even, odd) in even.as_chunks().0.iter().zip(odd.as_chunks().0) {
                let woven = A::interleave(Lanes(*even), Lanes(*odd)).map(|lanes| lanes.0);
                let woven = woven.as_flattened().as_chunks().0;
                for (to, from) in (&mut parts).take(woven.len()).zip(woven) {
                    *to = *from;
                }
            }
        }
    }

    /// One channel from its rows; padding is left as it is, or zero.
    #[inline(always)]
    pub(crate) fn take_rows<A: Arithmetic>(self, from: &[f32], to: &mut [f32]) {
        let from = &from[..self.pixels()];
        if !self.in_phases {
            return to[..self.pixels()].copy_from_slice(from);
        }
        for (parity, phases) in to.chunks_exact_mut(2 * self.phase()).enumerate() {
            let (even, odd) = phases.split_at_mut(self.phase());
            let rows = from.chunks_exact(self.cols).skip(parity).step_by(2);
            if !self.cols.is_multiple_of(PART) {
                for (pixel, from) in rows.flatten().enumerate() {
                    [&mut *even, &mut *odd][pixel % 2][pixel / 2] = *from;
                }
                continue;
            }
            let mut parts = rows.flat_map(|row| row.as_chunks::<PART>().0);
            let lanes = even.as_chunks_mut().0.iter_mut();
            for (even, odd) in lanes.zip(odd.as_chunks_mut().0) {
                let mut woven = [[0.0; PART]; 2 * LANES / PART];
                for (to, from) in woven.iter_mut().zip(&mut parts) {
                    *to = *from;
                }
                let woven = [0, LANES].map(|first| Lanes::load(&woven.as_flattened()[first..]));
                [*even, *odd] = A::deinterleave(woven[0], woven[1]).map(|lanes| lanes.0);
            }
        }
    }

    /// Makes one channel's padding zero.
    #[inline(always)]
    pub(crate) fn clear_padding(self, numbers: &mut [f32]) {
        let (part, pixels) = match self.in_phases {
            true => (self.phase(), self.pixels() / 4),
            false => (self.length(), self.pixels()),
        };
        if part > pixels {
            for part in numbers.chunks_exact_mut(part) {
                part[pixels..].fill(0.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::lanes::Portable;

    #[test]
    fn pixels_lie_where_they_are_said_to_lie() {
        for size in [[4, 4], [2, 6], [6, 10], [6, 8], [16, 32]] {
            for map in [Map::rows(size), Map::phases(size)] {
                let rows: Vec<f32> = (1..=map.pixels()).map(|pixel| pixel as f32).collect();
                let mut numbers = vec![-1.0; map.length()];
                map.take_rows::<Portable>(&rows, &mut numbers);
                map.clear_padding(&mut numbers);
                for (pixel, &expected) in rows.iter().enumerate() {
                    let got = numbers[map.at(pixel / size[1], pixel % size[1])];
                    assert_eq!(got, expected, "{map:?}, pixel {pixel}");
                }
                let total: f32 = numbers.iter().sum();
                assert_eq!(total, rows.iter().sum::<f32>(), "{map:?}: padding");
                let mut back = vec![0.0; rows.len()];
                map.to_rows::<Portable>(&numbers, &mut back);
                assert_eq!(back, rows, "{map:?}");
            }
        }
    }
}
