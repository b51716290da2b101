//! Several cells side by side, one in each lane of a vector, and planes with margins to read them from.
//!
//! Loops are written out, as closures of iterators are not always compiled for the vectors of the processor. Every lane does the same operations in the same order and none is fused, so results are bit-identical on every platform.

use emberwatch_model::Shape;
pub use emberwatch_model::vectors::LANES;

pub type Lanes = [f32; LANES];

/// Where a grid's cells lie in a plane that has a margin of zeros around them.
#[derive(Debug, Clone, Copy)]
pub struct Planes {
    margin: [usize; 2],
    stride: usize,
    pub length: usize,
}

impl Planes {
    /// Margins are as wide as a kernel with such sides reaches.
    pub fn new(shape: Shape, kernel: [usize; 2]) -> Self {
        let margin = kernel.map(|side| side / 2);
        let stride = shape.width().next_multiple_of(LANES) + 2 * margin[1];
        Self {
            margin,
            stride,
            length: (shape.height() + 2 * margin[0]) * stride,
        }
    }

    /// The index of a cell in its plane.
    pub fn place(&self, [row, col]: [usize; 2]) -> usize {
        (row + self.margin[0]) * self.stride + col + self.margin[1]
    }

    /// From a cell's place to the place of the neighbour at a tap of the kernel.
    pub fn offset(&self, [row, col]: [usize; 2]) -> isize {
        (row * self.stride + col) as isize - self.place([0, 0]) as isize
    }

    /// Copies a belief, `[S, H, W]`, into the planes of its states.
    pub fn put(&self, shape: Shape, belief: &[f32], planes: &mut [f32]) {
        let states = belief.chunks_exact(shape.n_cells());
        for (cells, plane) in states.zip(planes.chunks_exact_mut(self.length)) {
            for (row, cells) in cells.chunks_exact(shape.width()).enumerate() {
                plane[self.place([row, 0])..][..shape.width()].copy_from_slice(cells);
            }
        }
    }
}

#[inline(always)]
pub fn lanes_from(planes: &[f32], at: usize) -> &Lanes {
    let lanes = planes[at..].first_chunk();
    lanes.expect("invariant: margins have room for lanes at every neighbour")
}

/// `to += a b`.
#[inline(always)]
pub fn add_product(to: &mut Lanes, a: &Lanes, b: &Lanes) {
    for lane in 0..LANES {
        to[lane] += a[lane] * b[lane];
    }
}

#[inline(always)]
pub fn add(to: &mut Lanes, from: &Lanes) {
    for lane in 0..LANES {
        to[lane] += from[lane];
    }
}

#[inline(always)]
pub fn multiply(to: &mut Lanes, by: &Lanes) {
    for lane in 0..LANES {
        to[lane] *= by[lane];
    }
}

/// `a / b`.
#[inline(always)]
pub fn divided(a: f32, by: &Lanes) -> Lanes {
    let mut to = [0.0; LANES];
    for lane in 0..LANES {
        to[lane] = a / by[lane];
    }
    to
}

#[inline(always)]
pub fn sum(all: &[Lanes]) -> Lanes {
    let mut sum = [0.0; LANES];
    for lanes in all {
        add(&mut sum, lanes);
    }
    sum
}

/// `exp(-a b)` of products that are not negative, to a few units in the last place: a power of two, and a polynomial for
/// the rest.
#[inline(always)]
pub fn exponential(a: &Lanes, b: &Lanes) -> Lanes {
    // A number whose last bits, once another is added to it, hold that one's nearest whole number.
    const ROUNDED: f32 = 12_582_912.0;
    let mut to = [0.0; LANES];
    for lane in 0..LANES {
        let x = (a[lane] * b[lane] * -std::f32::consts::LOG2_E).max(-120.0);
        let rounded = x + ROUNDED;
        let y = (x - (rounded - ROUNDED)) * std::f32::consts::LN_2;
        let polynomial = 1.0
            + y * (1.0
                + y * (0.5 + y * (1.0 / 6.0 + y * (1.0 / 24.0 + y * (1.0 / 120.0 + y / 720.0)))));
        let power = (rounded.to_bits() << 23).wrapping_add(127 << 23);
        to[lane] = polynomial * f32::from_bits(power);
    }
    to
}
