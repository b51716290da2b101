//! Products of small matrices: columns in lanes, no transposes.
//!
//! The left factor is read number by number, so it may be stored either way round.

use super::lanes::{Arithmetic, LANES, Lanes};

/// Rows of a block.
const ROWS: usize = 4;

/// Vectors of columns of a block, where there are as many. 4 x 4 sums fit the 32 registers of AVX-512.
const WIDE: usize = 4;

/// A matrix to be read number by number.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Left<'a> {
    numbers: &'a [f32],
    row_step: usize,
    inner_step: usize,
}

impl<'a> Left<'a> {
    /// A matrix whose rows have `length` numbers.
    pub(crate) fn rows(numbers: &'a [f32], length: usize) -> Self {
        Self {
            numbers,
            row_step: length,
            inner_step: 1,
        }
    }

    /// The transpose of a matrix whose rows have `length` numbers.
    pub(crate) fn columns(numbers: &'a [f32], length: usize) -> Self {
        Self {
            numbers,
            row_step: 1,
            inner_step: length,
        }
    }
}

/// `start + left right`, row by row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Product<'a> {
    pub(crate) left: Left<'a>,
    /// Row-major.
    pub(crate) right: &'a [f32],
    /// Terms of each number.
    pub(crate) n_inner: usize,
    /// In whole lanes.
    pub(crate) n_columns: usize,
    /// What is added to each row.
    pub(crate) start: Option<&'a [f32]>,
}

impl Product<'_> {
    /// Writes as many rows as `to` has.
    #[inline(always)]
    pub(crate) fn write<A: Arithmetic>(&self, to: &mut [f32]) {
        let whole = self.n_columns / (WIDE * LANES) * (WIDE * LANES);
        for column in (0..whole).step_by(WIDE * LANES) {
            self.write_columns::<A, WIDE>(column, to);
        }
        for column in (whole..self.n_columns).step_by(LANES) {
            self.write_columns::<A, 1>(column, to);
        }
    }

    #[inline(always)]
    fn write_columns<A: Arithmetic, const VECTORS: usize>(&self, column: usize, to: &mut [f32]) {
        for (index, to) in to.chunks_mut(ROWS * self.n_columns).enumerate() {
            let (row, to) = (index * ROWS, &mut to[column..]);
            match to.len().div_ceil(self.n_columns) {
                1 => self.block::<A, 1, VECTORS>(row, column, to),
                2 => self.block::<A, 2, VECTORS>(row, column, to),
                3 => self.block::<A, 3, VECTORS>(row, column, to),
                _ => self.block::<A, ROWS, VECTORS>(row, column, to),
            }
        }
    }

    /// `ROWS` times `VECTORS` sums; `to` begins at the first.
    #[inline(always)]
    fn block<A: Arithmetic, const ROWS: usize, const VECTORS: usize>(
        &self,
        row: usize,
        column: usize,
        to: &mut [f32],
    ) {
        let Left {
            numbers,
            row_step,
            inner_step,
        } = self.left;
        let mut left = [numbers; ROWS];
        for (at, left) in left.iter_mut().enumerate() {
            *left = &numbers[(row + at) * row_step..];
        }
        let start = match self.start {
            Some(start) => Lanes::load_all::<VECTORS>(&start[column..]),
            None => [Lanes::ZERO; VECTORS],
        };
        let mut sums = [start; ROWS];
        let right = self.right.chunks_exact(self.n_columns).take(self.n_inner);
        for (inner, right) in right.enumerate() {
            let right = Lanes::load_all::<VECTORS>(&right[column..]);
            for at in 0..ROWS {
                let factor = left[at][inner * inner_step];
                for vector in 0..VECTORS {
                    sums[at][vector] = sums[at][vector].add_scaled::<A>(factor, right[vector]);
                }
            }
        }
        for (at, sums) in sums.iter().enumerate() {
            for (vector, sum) in sums.iter().enumerate() {
                sum.store(&mut to[at * self.n_columns + vector * LANES..]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::lanes::Portable;
    use super::*;

    fn check(n_rows: usize, n_inner: usize, n_columns: usize) {
        let numbers = |length: usize, step: usize| -> Vec<f32> {
            (0..length).map(|i| (i * step % 11) as f32 - 5.0).collect()
        };
        let (left, right) = (
            numbers(n_rows * n_inner, 3),
            numbers(n_inner * n_columns, 7),
        );
        let start = numbers(n_columns, 5);
        let term = |row: usize, column: usize| {
            let terms =
                (0..n_inner).map(|i| left[row * n_inner + i] * right[i * n_columns + column]);
            start[column] + terms.sum::<f32>()
        };
        let places = (0..n_rows * n_columns).map(|at| term(at / n_columns, at % n_columns));
        let expected: Vec<f32> = places.collect();
        let mut turned = vec![0.0; left.len()];
        for (at, number) in left.iter().enumerate() {
            turned[at % n_inner * n_rows + at / n_inner] = *number;
        }
        for left in [Left::rows(&left, n_inner), Left::columns(&turned, n_rows)] {
            let mut got = vec![f32::NAN; expected.len()];
            let product = Product {
                left,
                right: &right,
                n_inner,
                n_columns,
                start: Some(&start),
            };
            product.write::<Portable>(&mut got);
            assert_eq!(got, expected, "{n_rows} x {n_inner} x {n_columns}");
        }
    }

    #[test]
    fn products_are_sums_of_products_however_the_left_factor_is_stored() {
        for n_rows in 1..=9 {
            check(n_rows, 3, 16);
            check(n_rows, 1, 80);
        }
        check(64, 16, 128);
    }
}
