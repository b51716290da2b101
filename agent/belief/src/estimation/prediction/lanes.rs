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

/// Computes `to *= by`.
#[inline(always)]
pub fn multiply(to: &mut Lanes, by: &Lanes) {
    for lane in 0..LANES {
        to[lane] *= by[lane];
    }
}

/// Returns `a / by`.
#[inline(always)]
pub fn divided(a: f32, by: &Lanes) -> Lanes {
    let mut to = [0.0; LANES];
    for lane in 0..LANES {
        to[lane] = a / by[lane];
    }
    to
}

/// Returns the sum of several vectors, lane by lane.
#[inline(always)]
pub fn sum(all: &[Lanes]) -> Lanes {
    let mut sum = [0.0; LANES];
    for lanes in all {
        add(&mut sum, lanes);
    }
    sum
}

/// Returns `exp(-a b)` for `a b >= 0`, with an error of a few units in the last place.
///
/// Writes `exp(-a b)` as `2^n exp(y)` with an integer `n` and `|y| <= ln(2) / 2`, and computes `exp(y)` by its Taylor
/// polynomial of degree 6.
#[inline(always)]
pub fn exponential(a: &Lanes, b: &Lanes) -> Lanes {
    // Adding 1.5 * 2^23 rounds a number to an integer. The lowest bits of the sum contain this integer.
    const ROUNDING: f32 = 12_582_912.0;
    let mut to = [0.0; LANES];
    for lane in 0..LANES {
        let x = (a[lane] * b[lane] * -std::f32::consts::LOG2_E).max(-120.0);
        let rounded = x + ROUNDING;
        let y = (x - (rounded - ROUNDING)) * std::f32::consts::LN_2;
        let polynomial = 1.0
            + y * (1.0
                + y * (0.5 + y * (1.0 / 6.0 + y * (1.0 / 24.0 + y * (1.0 / 120.0 + y / 720.0)))));
        let power = (rounded.to_bits() << 23).wrapping_add(127 << 23);
        to[lane] = polynomial * f32::from_bits(power);
    }
    to
}
