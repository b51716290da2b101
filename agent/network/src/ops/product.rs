//! Products of small matrices whose numbers lie anywhere, as those of kept channels do: nothing is copied.

use pulp::{Arch, Simd, WithSimd};

/// The left factor: the number of a row and a term lies at `rows[row] + terms[term]`.
#[derive(Clone, Copy)]
pub(super) struct Left<'a> {
    pub(super) numbers: &'a [f32],
    pub(super) rows: &'a [usize],
    pub(super) terms: &'a [usize],
}

/// The right factor: the row of a term begins at `terms[term]`.
#[derive(Clone, Copy)]
pub(super) struct Right<'a> {
    pub(super) numbers: &'a [f32],
    pub(super) terms: &'a [usize],
    /// Numbers of a row.
    pub(super) cols: usize,
}

/// Multiples of `step`: where the rows of a matrix begin.
pub(super) fn steps(n: usize, step: usize) -> Vec<usize> {
    (0..n).map(|at| at * step).collect()
}

/// `out += left right`; each row of `out` begins at one of `rows`.
///
/// # Panics
/// If a number lies outside its slice.
pub(super) fn add_product(out: &mut [f32], rows: &[usize], left: Left<'_>, right: Right<'_>) {
    let last = |places: &[usize]| places.iter().max().copied();
    let (Some(row), Some(term)) = (last(left.rows), last(left.terms)) else {
        return;
    };
    let (from, to) = (last(right.terms).unwrap_or(0), last(rows).unwrap_or(0));
    assert_eq!(rows.len(), left.rows.len(), "rows of a product");
    assert_eq!(left.terms.len(), right.terms.len(), "terms of a product");
    assert!(row + term < left.numbers.len(), "left factor");
    assert!(from + right.cols <= right.numbers.len(), "right factor");
    assert!(to + right.cols <= out.len(), "product");
    Arch::new().dispatch(Call {
        out,
        rows,
        left,
        right,
    });
}

/// A product whose places are checked.
struct Call<'a> {
    out: &'a mut [f32],
    rows: &'a [usize],
    left: Left<'a>,
    right: Right<'a>,
}

impl WithSimd for Call<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let cols = self.right.cols;
        let wide = 2 * S::F32_LANES;
        let whole = cols / wide * wide;
        for col in (0..whole).step_by(wide) {
            // AVX2 has 16 registers, others of its kind 32.
            match S::F32_LANES {
                _ if self.rows.len() <= 4 => self.columns::<S, 4, 2, true>(simd, col),
                8 => self.columns::<S, 6, 2, true>(simd, col),
                _ => self.columns::<S, 8, 2, true>(simd, col),
            }
        }
        for col in (whole..cols).step_by(S::F32_LANES) {
            match col + S::F32_LANES <= cols {
                true => self.columns::<S, 8, 1, true>(simd, col),
                false => self.columns::<S, 8, 1, false>(simd, col),
            }
        }
    }
}

impl Call<'_> {
    /// `VECTORS` vectors of columns, `ROWS` rows at a time, whose sums stay in registers. The vectors are whole,
    /// or the row ends in the last.
    #[inline(always)]
    #[expect(
        unsafe_code,
        reason = "checks in the innermost loop take as long as it"
    )]
    fn columns<S: Simd, const ROWS: usize, const VECTORS: usize, const WHOLE: bool>(
        &mut self,
        simd: S,
        col: usize,
    ) {
        let left = self.left.numbers.as_ptr();
        let right = self.right.numbers.as_ptr();
        let vector = Vector::<WHOLE>(self.right.cols - col);
        for (places, rows) in self.left.rows.chunks(ROWS).zip(self.rows.chunks(ROWS)) {
            // The last block computes its last row several times.
            let mut from = [places[places.len() - 1]; ROWS];
            from[..places.len()].copy_from_slice(places);
            let mut sums = [[simd.splat_f32s(0.0); VECTORS]; ROWS];
            for (term, at) in self.left.terms.iter().zip(self.right.terms) {
                let mut numbers = [simd.splat_f32s(0.0); VECTORS];
                for (index, numbers) in numbers.iter_mut().enumerate() {
                    // SAFETY: `add_product` has checked all places.
                    let at = unsafe { right.add(at + col + index * S::F32_LANES) };
                    *numbers = vector.load(simd, at);
                }
                for row in 0..ROWS {
                    // SAFETY: as above.
                    let factor = simd.splat_f32s(unsafe { *left.add(from[row] + term) });
                    for index in 0..VECTORS {
                        let sum = sums[row][index];
                        sums[row][index] = simd.mul_add_f32s(factor, numbers[index], sum);
                    }
                }
            }
            for (sums, row) in sums.iter().zip(rows) {
                for (index, sum) in sums.iter().enumerate() {
                    // SAFETY: as above.
                    let to = unsafe { self.out.as_mut_ptr().add(row + col + index * S::F32_LANES) };
                    vector.add(simd, to, *sum);
                }
            }
        }
    }
}

/// How vectors are read and written: whole, or only so many numbers.
#[derive(Clone, Copy)]
struct Vector<const WHOLE: bool>(usize);

#[expect(
    unsafe_code,
    reason = "only `Call::columns` uses it, where its places are checked"
)]
impl<const WHOLE: bool> Vector<WHOLE> {
    #[inline(always)]
    fn load<S: Simd>(self, simd: S, from: *const f32) -> S::f32s {
        // SAFETY: the numbers are within their slice.
        unsafe {
            match WHOLE {
                true => from.cast::<S::f32s>().read_unaligned(),
                false => simd.mask_load_ptr_f32s(simd.mask_between_m32s(0, self.0 as u32), from),
            }
        }
    }

    #[inline(always)]
    fn add<S: Simd>(self, simd: S, to: *mut f32, numbers: S::f32s) {
        let sum = simd.add_f32s(self.load(simd, to), numbers);
        // SAFETY: as above.
        unsafe {
            match WHOLE {
                true => to.cast::<S::f32s>().write_unaligned(sum),
                false => {
                    simd.mask_store_ptr_f32s(simd.mask_between_m32s(0, self.0 as u32), to, sum)
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_scattered_rows_are_those_of_the_definition() {
        for [n_rows, n_terms, cols] in [[1, 1, 1], [8, 3, 16], [13, 5, 32], [7, 9, 50]] {
            let numbers = |n: usize, step: usize| -> Vec<f32> {
                (0..n).map(|i| (i * step % 11) as f32 - 5.0).collect()
            };
            // Rows in reverse order, two numbers apart.
            let rows: Vec<usize> = steps(n_rows, 2 * n_terms).into_iter().rev().collect();
            let to: Vec<usize> = steps(n_rows, cols + 2).into_iter().rev().collect();
            let (left_terms, right_terms) = (steps(n_terms, 2), steps(n_terms, cols + 1));
            let left = numbers(2 * n_rows * n_terms, 3);
            let right = numbers(n_terms * (cols + 1), 7);
            let mut out = numbers(n_rows * (cols + 2), 5);
            let mut expected = out.clone();
            for (row, to) in rows.iter().zip(&to) {
                for col in 0..cols {
                    for (a, b) in left_terms.iter().zip(&right_terms) {
                        expected[to + col] += left[row + a] * right[b + col];
                    }
                }
            }
            let left = Left {
                numbers: &left,
                rows: &rows,
                terms: &left_terms,
            };
            let right = Right {
                numbers: &right,
                terms: &right_terms,
                cols,
            };
            add_product(&mut out, &to, left, right);
            assert_eq!(out, expected, "{n_rows} {n_terms} {cols}");
        }
    }
}
