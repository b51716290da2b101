//! Arithmetic on [`LANES`] cells at once, one per lane of a vector.
//!
//! Loops are written out, because iterator closures are not always compiled to vector instructions. Every lane runs the
//! same operations in the same order, without fused multiply-adds, so results are bit-identical on every platform.

pub use emberwatch_model::vectors::LANES;

/// One value for each cell of a chunk.
pub type Lanes = [f32; LANES];

/// Returns the [`LANES`] values that start at an index.
#[inline(always)]
pub fn lanes_from(numbers: &[f32], at: usize) -> &Lanes {
    let lanes = numbers[at..].first_chunk();
    lanes.expect("invariant: planes hold LANES numbers after every neighbour")
}

/// Computes `to += a b`.
#[inline(always)]
pub fn add_product(to: &mut Lanes, a: &Lanes, b: &Lanes) {
    for lane in 0..LANES {
        to[lane] += a[lane] * b[lane];
    }
}

/// Computes `to += from`.
#[inline(always)]
pub fn add(to: &mut Lanes, from: &Lanes) {
    for lane in 0..LANES {
        to[lane] += from[lane];
    }
}
