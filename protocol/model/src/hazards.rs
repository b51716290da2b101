//! Models of hazards: each neighbour causes a transition independently of all others.
//!
//! A transition of a cell happens in a step with probability `P = 1 - (1 - b) prod (1 - p)`. Here `b` is the probability
//! without neighbours, and the product is over the neighbours, each with the probability `p` of its state and place. The
//! *hazard* of a probability is `h = -log(1 - p)`, so hazards add up: `P = 1 - exp(-sum h)`. Most published models of
//! fires, epidemics and crop diseases have this form.
//!
//! The transitions of a state are in order, and the first that happens wins. So with the sums `H_k` of the hazards of
//! the first `k` transitions, transition `k` is the next one with probability `exp(-H_{k-1}) - exp(-H_k)`.

use super::grid::{Cell, Grid, Shape};
use super::maps::Maps;
use ndarray::{Array4, ArrayD, Ix2, Ix4};

#[derive(Debug, Clone, PartialEq)]
pub struct Hazards {
    /// Number of rows and columns of the smallest table that contains all neighbours.
    pub(super) size: [usize; 2],
    pub(super) transitions: Vec<Vec<Transition>>,
    pub(super) maps: Maps,
    pub(super) shape: Option<Shape>,
}

/// A transition of the cells in one state.
#[derive(Debug, Clone, PartialEq)]
pub struct Transition {
    pub to: usize,
    /// The hazard without neighbours; infinite if the transition is certain.
    pub base: f64,
    pub near: Vec<Near>,
    pub factors: Factors,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Near {
    pub state: usize,
    /// Row and column of the neighbour, relative to the cell.
    pub offset: [isize; 2],
    /// The hazard, more than 0; infinite if the transition is certain.
    pub hazard: f64,
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct Factors {
    /// The factors of all hazards, shape `[H, W]`.
    of_cells: Option<Grid<f32>>,
    /// The factors of the neighbours' hazards, shape `[KH, KW, H, W]`.
    of_neighbours: Option<Array4<f32>>,
}

impl Hazards {
    /// Returns the number of rows and columns of the smallest table that contains all neighbours, both odd.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// Returns the transitions of cells in a state, in order.
    pub fn transitions(&self, from: usize) -> &[Transition] {
        &self.transitions[from]
    }

    /// Returns all numbers on which the transitions depend. Models with the same numbers are equal.
    pub fn numbers(&self) -> Vec<f64> {
        let mut numbers = Vec::new();
        for (from, transitions) in self.transitions.iter().enumerate() {
            for it in transitions {
                numbers.extend([from as f64, it.to as f64, it.base]);
                for near in &it.near {
                    let [row, col] = near.offset;
                    numbers.extend([near.state as f64, row as f64, col as f64, near.hazard]);
                }
                let factors = it.factors.of_cells.iter().flatten();
                let factors = factors.chain(it.factors.of_neighbours.iter().flatten());
                numbers.extend(factors.map(|factor| f64::from(*factor)));
            }
        }
        numbers
    }

    pub fn maps(&self) -> &Maps {
        &self.maps
    }

    /// Returns the grid of the maps, if there are maps.
    pub fn shape(&self) -> Option<Shape> {
        self.shape
    }
}

impl Factors {
    /// Returns whether all factors are 1.
    pub fn are_one(&self) -> bool {
        self.of_cells.is_none() && self.of_neighbours.is_none()
    }

    /// Returns whether the neighbours of a cell have factors of their own.
    pub fn differ_by_place(&self) -> bool {
        self.of_neighbours.is_some()
    }

    /// Returns the factor of a transition's hazard without neighbours in a cell.
    pub fn of_base(&self, Cell { row, col }: Cell) -> f64 {
        self.of_cells
            .as_ref()
            .map_or(1.0, |map| map[[row, col]].into())
    }

    /// Returns the factor of a neighbour's hazard in a cell. The offset is that of the neighbour.
    pub fn of_neighbour(&self, offset: [isize; 2], cell: Cell) -> f64 {
        let by_place = self.of_neighbours.as_ref().map_or(1.0, |map| {
            let (height, width, ..) = map.dim();
            let place = |side: usize, offset: isize| (side / 2).wrapping_add_signed(offset);
            let [row, col] = [place(height, offset[0]), place(width, offset[1])];
            map[[row, col, cell.row, cell.col]].into()
        });
        self.of_base(cell) * by_place
    }

    /// Multiplies the factors by a map of shape `[H, W]` or `[KH, KW, H, W]`.
    pub(super) fn multiply(&mut self, map: &ArrayD<f32>) {
        // No product overflows, so that 0 times any factor stays 0.
        let multiply = |factor: &mut f32, by: &f32| *factor = (*factor * by).min(f32::MAX);
        if let Ok(map) = map.view().into_dimensionality::<Ix2>() {
            match &mut self.of_cells {
                Some(factors) => factors.zip_mut_with(&map, multiply),
                none => *none = Some(map.to_owned()),
            }
        }
        if let Ok(map) = map.view().into_dimensionality::<Ix4>() {
            match &mut self.of_neighbours {
                Some(factors) => factors.zip_mut_with(&map, multiply),
                none => *none = Some(map.to_owned()),
            }
        }
    }
}

/// Multiplies a hazard by a factor. A factor of 0 makes even a certain transition impossible.
pub fn scaled(hazard: f64, factor: f64) -> f64 {
    if factor == 0.0 { 0.0 } else { hazard * factor }
}

/// Returns `-log(1 - p)` for a probability, infinite for 1. The relative error is below 1e-14.
///
/// The result has the same bits on every platform, because the function uses only `+`, `-`, `*` and `/`.
pub fn hazard(probability: f64) -> f64 {
    if probability >= 1.0 {
        return f64::INFINITY;
    }
    // -log(1 - p) = n log 2 - log(2^n (1 - p)), with 2^n (1 - p) from .5 to 1.
    let (mut halvings, mut left, mut p) = (0.0, 1.0 - probability, probability);
    while left < 0.5 {
        left *= 2.0;
        p = 1.0 - left;
        halvings += 1.0;
    }
    // -log(1 - p) = 2 atanh(p / (2 - p)), with an argument of at most 1/3.
    let x = p / (2.0 - p);
    let square = x * x;
    let mut sum = 0.0;
    for n in (0..17).rev() {
        sum = sum * square + 1.0 / f64::from(2 * n + 1);
    }
    halvings * std::f64::consts::LN_2 + 2.0 * x * sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hazards_are_logarithms() {
        assert_eq!((hazard(0.0), hazard(1.0)), (0.0, f64::INFINITY));
        for exponent in -300..0 {
            for mantissa in 1..20 {
                let p = f64::from(mantissa) / 20.0 * 2_f64.powi(exponent / 5);
                for p in [p, 1.0 - p].into_iter().filter(|p| 0.0 < *p && *p < 1.0) {
                    let expected = -(-p).ln_1p();
                    assert!((hazard(p) / expected - 1.0).abs() < 1e-14, "{p}");
                }
            }
        }
    }
}
