//! Products of small matrices whose rows lie at arbitrary offsets, such as the planes of kept channels. The matrices
//! are not copied.

use pulp::{Arch, Simd, WithSimd};

/// The left factor of a product. The element in row `row` and column `term` is at index `rows[row] + terms[term]`.
#[derive(Clone, Copy)]
pub(super) struct Left<'a> {
    numbers: &'a [f32],
    rows: &'a [usize],
    terms: &'a [usize],
}

/// The right factor of a product. Row `term` starts at index `terms[term]`.
#[derive(Clone, Copy)]
pub(super) struct Right<'a> {
    numbers: &'a [f32],
    terms: &'a [usize],
    cols: usize,
}

pub(super) fn left_factor<'a>(
    numbers: &'a [f32],
    rows: &'a [usize],
    terms: &'a [usize],
) -> Left<'a> {
    Left {
        numbers,
        rows,
        terms,
    }
}

pub(super) fn right_factor<'a>(numbers: &'a [f32], terms: &'a [usize], cols: usize) -> Right<'a> {
    Right {
        numbers,
        terms,
        cols,
    }
}

pub(super) fn steps(n: usize, step: usize) -> Vec<usize> {
    (0..n).map(|at| at * step).collect()
}

/// `rows` contains the start of each row in `out`. Panics if an index is outside its slice.
pub(super) fn product(out: &mut [f32], rows: &[usize], left: Left<'_>, right: Right<'_>) {
    compute(out, rows, left, right, false);
}

pub(super) fn add_product(out: &mut [f32], rows: &[usize], left: Left<'_>, right: Right<'_>) {
    compute(out, rows, left, right, true);
}

fn compute(out: &mut [f32], rows: &[usize], left: Left<'_>, right: Right<'_>, adds: bool) {
    // One more than the largest offset.
    let end = |places: &[usize]| places.iter().max().map_or(0, |last| last + 1);
    let (n_left, n_right) = (end(left.rows) + end(left.terms), end(right.terms));
    assert_eq!(
        rows.len(),
        left.rows.len(),
        "product: rows of the result and of the left factor"
    );
    assert_eq!(
        left.terms.len(),
        right.terms.len(),
        "product: terms of the two factors"
    );
    assert!(
        n_left <= left.numbers.len() + 1,
        "product: index outside the left factor"
    );
    assert!(
        n_right + right.cols <= right.numbers.len() + 1,
        "product: index outside the right factor"
    );
    assert!(
        end(rows) + right.cols <= out.len() + 1,
        "product: index outside the result"
    );
    Arch::new().dispatch(Call {
        out,
        rows,
        left,
        right,
        adds,
    });
}

struct Call<'a> {
    out: &'a mut [f32],
    rows: &'a [usize],
    left: Left<'a>,
    right: Right<'a>,
    adds: bool,
}

impl WithSimd for Call<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (cols, wide) = (self.right.cols, 2 * S::F32_LANES);
        let whole = cols / wide * wide;
        for col in (0..whole).step_by(wide) {
            // AVX2 has 16 vector registers, the other instruction sets have 32.
            let max_rows = if S::F32_LANES == 8 { 6 } else { 8 };
            self.columns::<S, 2, true>(simd, col, max_rows);
        }
        for col in (whole..cols).step_by(S::F32_LANES) {
            if col + S::F32_LANES <= cols {
                self.columns::<S, 1, true>(simd, col, 8);
            } else {
                self.columns::<S, 1, false>(simd, col, 8);
            }
        }
    }
}

impl Call<'_> {
    #[inline(always)]
    fn columns<S: Simd, const VECTORS: usize, const WHOLE: bool>(
        &mut self,
        simd: S,
        col: usize,
        max_rows: usize,
    ) {
        let n_rows = self.rows.len();
        let n_blocks = n_rows.div_ceil(max_rows).max(1);
        for block in 0..n_blocks {
            let first = n_rows * block / n_blocks;
            match n_rows * (block + 1) / n_blocks - first {
                0 => {}
                1 => self.block::<S, 1, VECTORS, WHOLE>(simd, col, first),
                2 => self.block::<S, 2, VECTORS, WHOLE>(simd, col, first),
                3 => self.block::<S, 3, VECTORS, WHOLE>(simd, col, first),
                4 => self.block::<S, 4, VECTORS, WHOLE>(simd, col, first),
                5 => self.block::<S, 5, VECTORS, WHOLE>(simd, col, first),
                6 => self.block::<S, 6, VECTORS, WHOLE>(simd, col, first),
                7 => self.block::<S, 7, VECTORS, WHOLE>(simd, col, first),
                _ => self.block::<S, 8, VECTORS, WHOLE>(simd, col, first),
            }
        }
    }

    /// Computes a block of `ROWS` rows, whose sums stay in registers. With `WHOLE`, all vectors lie inside the row.
    #[inline(always)]
    #[expect(
        unsafe_code,
        reason = "bounds checks would double the time of the innermost loop"
    )]
    fn block<S: Simd, const ROWS: usize, const VECTORS: usize, const WHOLE: bool>(
        &mut self,
        simd: S,
        col: usize,
        first: usize,
    ) {
        let right = self.right.numbers.as_ptr();
        let vector = Vector::<WHOLE>(self.right.cols - col);
        let mut left = [self.left.numbers.as_ptr(); ROWS];
        for (left, row) in left.iter_mut().zip(&self.left.rows[first..]) {
            // SAFETY: `compute` has checked all indices.
            *left = unsafe { left.add(*row) };
        }
        let mut sums = [[simd.splat_f32s(0.0); VECTORS]; ROWS];
        for (term, at) in self.left.terms.iter().zip(self.right.terms) {
            let mut numbers = [simd.splat_f32s(0.0); VECTORS];
            for (index, numbers) in numbers.iter_mut().enumerate() {
                // SAFETY: as above.
                let at = unsafe { right.add(at + col + index * S::F32_LANES) };
                *numbers = vector.load(simd, at);
            }
            for row in 0..ROWS {
                // SAFETY: as above.
                let factor = simd.splat_f32s(unsafe { *left[row].add(*term) });
                for index in 0..VECTORS {
                    let sum = sums[row][index];
                    sums[row][index] = simd.mul_add_f32s(factor, numbers[index], sum);
                }
            }
        }
        for (sums, row) in sums.iter().zip(&self.rows[first..]) {
            for (index, sum) in sums.iter().enumerate() {
                // SAFETY: as above.
                let to = unsafe { self.out.as_mut_ptr().add(row + col + index * S::F32_LANES) };
                let before = self.adds.then(|| vector.load(simd, to));
                let sum = before.map_or(*sum, |before| simd.add_f32s(before, *sum));
                vector.store(simd, to, sum);
            }
        }
    }
}

/// Access to a vector in memory. With `WHOLE`, it reads and writes all lanes, otherwise only the given number of lanes.
#[derive(Clone, Copy)]
struct Vector<const WHOLE: bool>(usize);

#[expect(
    unsafe_code,
    reason = "only `Call::block` uses it, with checked indices"
)]
impl<const WHOLE: bool> Vector<WHOLE> {
    #[inline(always)]
    fn load<S: Simd>(self, simd: S, from: *const f32) -> S::f32s {
        // SAFETY: the numbers are within their slice.
        unsafe {
            if WHOLE {
                from.cast::<S::f32s>().read_unaligned()
            } else {
                simd.mask_load_ptr_f32s(simd.mask_between_m32s(0, self.0 as u32), from)
            }
        }
    }

    #[inline(always)]
    fn store<S: Simd>(self, simd: S, to: *mut f32, numbers: S::f32s) {
        // SAFETY: as above.
        unsafe {
            if WHOLE {
                to.cast::<S::f32s>().write_unaligned(numbers)
            } else {
                let mask = simd.mask_between_m32s(0, self.0 as u32);
                simd.mask_store_ptr_f32s(mask, to, numbers);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_scattered_rows_agree_with_the_definition() {
        for [n_rows, n_terms, cols] in [[1, 1, 1], [8, 3, 16], [13, 5, 32], [7, 9, 50]] {
            let numbers = |n: usize, step: usize| -> Vec<f32> {
                (0..n).map(|i| (i * step % 11) as f32 - 5.0).collect()
            };
            // Rows in reverse order, with gaps.
            let rows: Vec<usize> = steps(n_rows, 2 * n_terms).into_iter().rev().collect();
            let to: Vec<usize> = steps(n_rows, cols + 2).into_iter().rev().collect();
            let (left_terms, right_terms) = (steps(n_terms, 2), steps(n_terms, cols + 1));
            let left = numbers(2 * n_rows * n_terms, 3);
            let right = numbers(n_terms * (cols + 1), 7);
            let before = numbers(n_rows * (cols + 2), 5);
            let (mut expected, mut sums) = (before.clone(), before.clone());
            for (row, to) in rows.iter().zip(&to) {
                for col in 0..cols {
                    let terms = left_terms.iter().zip(&right_terms);
                    let terms = terms.map(|(a, b)| left[row + a] * right[b + col]);
                    expected[to + col] = terms.sum();
                    sums[to + col] += expected[to + col];
                }
            }
            let left = left_factor(&left, &rows, &left_terms);
            let right = right_factor(&right, &right_terms, cols);
            let mut out = before.clone();
            add_product(&mut out, &to, left, right);
            assert_eq!(out, sums, "{n_rows} {n_terms} {cols}");
            product(&mut out, &to, left, right);
            assert_eq!(out, expected, "{n_rows} {n_terms} {cols}");
        }
    }
}
