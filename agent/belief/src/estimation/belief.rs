//! A [`Belief`] consists of one probability distribution over states for each cell. Its constructors check or guarantee
//! that these are valid distributions.
//!
//! Estimators compute beliefs (the `u` and `p` of paper eqs. 5 and 6), and objectives read them. An exploring robot is
//! attracted to cells with high entropy (eq. 14).

use emberwatch_model::Model;
use emberwatch_model::grid::{Cell, Grid, Probabilities, Shape, ShapeError};
use ndarray::{ArrayView2, ArrayView3, Axis};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use thiserror::Error;

/// Maximum deviation from 1 of the sum of a cell's probabilities: about 400 times the rounding error of an `f32`. The
/// rounding errors of a softmax or normalisation are smaller, and the errors caused by a bug are larger.
const SUM_TOLERANCE: f32 = 5e-5;

/// One distribution over states per cell, shape `[S, H, W]`. The probabilities of each cell sum to one.
#[derive(Debug, Clone, PartialEq)]
pub struct Belief {
    probabilities: Probabilities,
    shape: Shape,
}

/// The reason why an array is not a valid belief.
#[derive(Debug, Error, PartialEq)]
pub enum BeliefError {
    /// [`Shape`] rejects the size of the grid.
    #[error("belief: {0}")]
    Shape(#[from] ShapeError),
    /// A cell's values are not a probability distribution.
    #[error("belief of cell {cell}: expected probabilities >= 0 with sum 1, got {got:?}")]
    Simplex { cell: Cell, got: Vec<f32> },
    /// A cell's state does not exist in the model.
    #[error("belief from states: cell {cell}: expected a state below {n_states}, got {got}")]
    State {
        cell: Cell,
        n_states: usize,
        got: u8,
    },
}

impl Belief {
    /// Creates a belief with the same probability for all states in every cell.
    pub fn uniform(n_states: usize, shape: Shape) -> Self {
        Self::everywhere(&vec![1.0 / n_states as f32; n_states], shape)
    }

    /// Creates a belief with the model's initial distribution in every cell: the distribution before burn-in.
    pub fn from_initial(model: &Model, shape: Shape) -> Self {
        let initial: Vec<f32> = model.initial().iter().map(|&p| p as f32).collect();
        Self::everywhere(&initial, shape)
    }

    /// Creates a belief with probability 1 for each cell's given state, shape `[H, W]`: the belief of an oracle.
    ///
    /// # Errors
    /// If a state is not below `n_states`.
    pub fn from_states(states: &Grid<u8>, n_states: usize) -> Result<Self, BeliefError> {
        let (height, width) = states.dim();
        let shape = Shape::new(height, width)?;
        let mut probabilities = Probabilities::zeros((n_states, height, width));
        for ((row, col), &got) in states.indexed_iter() {
            match probabilities.get_mut((usize::from(got), row, col)) {
                Some(probability) => *probability = 1.0,
                None => {
                    let cell = Cell { row, col };
                    return Err(BeliefError::State {
                        cell,
                        n_states,
                        got,
                    });
                }
            }
        }
        Ok(Self {
            probabilities,
            shape,
        })
    }

    /// Creates a belief from probabilities of shape `[S, H, W]`, such as the output of a network, and checks them.
    ///
    /// # Errors
    /// If a cell's probabilities are not a distribution. The error names the first such cell.
    pub fn from_probabilities(probabilities: Probabilities) -> Result<Self, BeliefError> {
        let (_, height, width) = probabilities.dim();
        let shape = Shape::new(height, width)?;
        let probabilities = probabilities.as_standard_layout().into_owned();
        let sums = probabilities.sum_axis(Axis(0));
        let least = probabilities.fold_axis(Axis(0), f32::INFINITY, |&a, &b| {
            if b >= 0.0 {
                a.min(b)
            } else {
                f32::NEG_INFINITY
            }
        });
        let fine =
            |(&sum, &least): (&f32, &f32)| (sum - 1.0).abs() <= SUM_TOLERANCE && least >= 0.0;
        if let Some(index) = sums.iter().zip(&least).position(|cell| !fine(cell)) {
            let cell = shape.cell(index);
            let got = probabilities.slice(ndarray::s![.., cell.row, cell.col]);
            let got = got.to_vec();
            return Err(BeliefError::Simplex { cell, got });
        }
        Ok(Self {
            probabilities,
            shape,
        })
    }

    /// Returns the probabilities of one cell's states. `index` is the cell's row-major index.
    pub fn states(&self, index: usize) -> Vec<f64> {
        let states = self.as_slice()[index..].iter();
        let states = states.step_by(self.shape.n_cells());
        states.map(|&p| f64::from(p)).collect()
    }

    /// Returns all probabilities, `[S, H, W]` and row-major, as little-endian `f32`.
    pub fn to_bytes(&self) -> Vec<u8> {
        let numbers = self.as_slice().iter();
        numbers.flat_map(|p| p.to_le_bytes()).collect()
    }

    /// Decodes [`Self::to_bytes`]. `None` if the bytes do not fit `dim`, `[S, H, W]`, or are no valid belief.
    pub fn from_bytes(bytes: &[u8], dim: (usize, usize, usize)) -> Option<Self> {
        let (numbers, []) = bytes.as_chunks::<4>() else {
            return None;
        };
        let numbers = numbers.iter().map(|&p| f32::from_le_bytes(p)).collect();
        let probabilities = Probabilities::from_shape_vec(dim, numbers).ok()?;
        Self::from_probabilities(probabilities).ok()
    }

    /// Returns the grid.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Returns the number of states S.
    pub fn n_states(&self) -> usize {
        self.probabilities.dim().0
    }

    /// Returns all probabilities, shape `[S, H, W]`.
    pub fn probabilities(&self) -> &Probabilities {
        &self.probabilities
    }

    /// Returns a view of all probabilities, shape `[S, H, W]`.
    pub fn view(&self) -> ArrayView3<'_, f32> {
        self.probabilities.view()
    }

    /// Returns the probability of one state in each cell, shape `[H, W]`.
    ///
    /// # Panics
    /// If `state` is not below S.
    pub fn probability(&self, state: usize) -> ArrayView2<'_, f32> {
        self.probabilities.index_axis(Axis(0), state)
    }

    /// Computes the Shannon entropy of each cell in nats, `-sum_m p_m log p_m` (eq. 14), shape `[H, W]`. It is at most
    /// `log S`. `0 log 0` counts as 0.
    pub fn entropy(&self) -> Grid<f32> {
        self.scaled_entropy(-1.0)
    }

    /// Computes the mean of the entropy's S terms, as in the authors' code: `1/S` of [`Self::entropy`].
    pub fn mean_entropy(&self) -> Grid<f32> {
        self.scaled_entropy(-1.0 / self.n_states() as f32)
    }

    fn scaled_entropy(&self, scale: f32) -> Grid<f32> {
        let mut entropy = vec![0.0; self.shape.n_cells()];
        for plane in self.as_slice().chunks_exact(entropy.len()) {
            for (sum, &p) in entropy.iter_mut().zip(plane) {
                *sum += scale * p * ln(p);
            }
        }
        Grid::from_shape_vec(self.shape.dim(), entropy).expect("invariant: one value per cell")
    }

    /// Draws each cell's state from the cell's own distribution, shape `[H, W]`.
    ///
    /// # Panics
    /// If there are more than 256 states.
    pub fn sample(&self, rng: &mut ChaCha8Rng) -> Grid<u8> {
        let (cells, n_states) = (0..self.shape.n_cells(), self.n_states());
        assert!(n_states <= 256, "belief: expected states that fit a byte");
        let (numbers, n_cells) = (self.as_slice(), cells.len());
        let state = |cell: usize| {
            let states = numbers[cell..].iter().step_by(n_cells);
            let states = states.map(|&p| f64::from(p)).enumerate();
            // The sum may differ from 1 by rounding.
            let total: f64 = states.clone().map(|(_, p)| p).sum();
            let mut left = (rng.next_u64() >> 11) as f64 * 2f64.powi(-53) * total;
            let mut last = 0;
            for (state, p) in states.filter(|it| it.1 > 0.0) {
                last = state;
                if left < p {
                    break;
                }
                left -= p;
            }
            last as u8
        };
        let states = cells.map(state).collect();
        Grid::from_shape_vec(self.shape.dim(), states).expect("invariant: one state per cell")
    }

    /// Returns the probabilities, shape `[S, H, W]`, row-major.
    pub fn as_slice(&self) -> &[f32] {
        let slice = self.probabilities.as_slice();
        slice.expect("invariant: beliefs are row-major")
    }

    /// Returns a mutable slice of the probabilities for estimators, which must keep each cell on the simplex.
    pub(crate) fn as_mut_slice(&mut self) -> &mut [f32] {
        let slice = self.probabilities.as_slice_mut();
        slice.expect("invariant: beliefs are row-major")
    }

    pub(crate) fn probabilities_mut(&mut self) -> &mut Probabilities {
        &mut self.probabilities
    }

    pub(crate) fn everywhere(distribution: &[f32], shape: Shape) -> Self {
        let (height, width) = shape.dim();
        let dim = (distribution.len(), height, width);
        let probabilities = Probabilities::from_shape_fn(dim, |(state, _, _)| distribution[state]);
        Self {
            probabilities,
            shape,
        }
    }
}

/// Finite at 0, so that `p * ln(p)` is 0 there. Without branches or calls, so that the loop over cells is vectorised.
/// Splits `p = m 2^e` with `m` in `sqrt(1/2)..sqrt(2)`; the polynomial in `m - 1` is from `logf` of the Cephes library
/// (S. Moshier).
#[inline]
fn ln(p: f32) -> f32 {
    const SQRT_HALF_BITS: u32 = 0x3f35_04f3;
    let exponent = (p.to_bits().wrapping_sub(SQRT_HALF_BITS) as i32) >> 23;
    let x = f32::from_bits(p.to_bits().wrapping_sub((exponent << 23) as u32)) - 1.0;
    const COEFFICIENTS: [f32; 9] = [
        7.037_683_6e-2,
        -1.151_461e-1,
        1.167_699_9e-1,
        -1.242_014_1e-1,
        1.424_932_3e-1,
        -1.666_805_7e-1,
        2.000_071_5e-1,
        -2.499_999_4e-1,
        3.333_333e-1,
    ];
    let tail = COEFFICIENTS.iter().fold(0.0, |sum, c| sum * x + c);
    let squared = x * x;
    exponent as f32 * std::f32::consts::LN_2 + (x - 0.5 * squared + squared * x * tail)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape(height: usize, width: usize) -> Shape {
        Shape::new(height, width).expect("test shape")
    }

    #[test]
    fn entropy_of_known_distributions() {
        let (uniform, ln3) = (Belief::uniform(3, shape(2, 5)), 3.0_f32.ln());
        let is_close = |h: &f32, expected: f32| (h - expected).abs() < 1e-6;
        assert!(uniform.entropy().iter().all(|h| is_close(h, ln3)));
        assert!(
            uniform
                .mean_entropy()
                .iter()
                .all(|h| is_close(h, ln3 / 3.0))
        );
        let certain = Belief::from_states(&Grid::from_elem((2, 5), 1), 3).expect("valid states");
        assert!(certain.entropy().iter().all(|h| *h == 0.0));
    }

    #[test]
    fn logarithm_agrees_with_the_standard_library() {
        for i in 1..=2_000 {
            let p = i as f32 / 2_000.0;
            assert!((ln(p) - p.ln()).abs() < 2e-7 * p.ln().abs().max(1.0), "{p}");
        }
        for p in [f32::MIN_POSITIVE, 1e-20, 1e-9, 1.0] {
            assert!((p * ln(p) - p * p.ln()).abs() < 1e-9, "{p}");
        }
        assert_eq!(0.0 * ln(0.0), 0.0);
    }

    #[test]
    fn invalid_probabilities_are_rejected_with_their_cell() {
        let third = 1.0 / 3.0;
        // The last two arrays sum to 1, but contain negative numbers.
        for states in [
            [third, third, 0.5],
            [third, third, 0.3],
            [third, third, f32::NAN],
            [third, third, f32::INFINITY],
            [1.5, 0.0, -0.5],
            [-0.5, 1.5, 0.0],
        ] {
            let mut numbers = Probabilities::from_elem((3, 2, 2), third);
            (0..3).for_each(|state| numbers[[state, 1, 0]] = states[state]);
            match Belief::from_probabilities(numbers) {
                Err(BeliefError::Simplex { cell, got }) => {
                    assert_eq!((cell, got.len()), (Cell { row: 1, col: 0 }, 3));
                }
                other => panic!("{states:?}: expected an error, got {other:?}"),
            }
        }
        assert!(Belief::from_probabilities(Probabilities::from_elem((2, 3, 4), 0.5)).is_ok());
        let states = ndarray::arr2(&[[0, 3], [0, 0]]);
        let error = Belief::from_states(&states, 3).expect_err("state 3 of 3");
        assert!(error.to_string().contains("cell (0, 1)"), "{error}");
    }

    #[test]
    fn the_initial_belief_is_the_initial_distribution() {
        let belief = Belief::from_initial(&Model::wildfire(), shape(3, 4));
        assert!(belief.probability(0).iter().all(|&p| p == 0.99));
        assert!(belief.probability(2).iter().all(|&p| p == 0.0));
    }
}
