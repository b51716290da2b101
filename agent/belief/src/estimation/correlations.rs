//! Correlations between nearby cells, learned from frames, with respect to the *paying state*: the state with the
//! highest reward.
//!
//! There is one correlation for each pair of age ranges and each class of offsets. A cell's age is the number of steps
//! since it was last seen. Ages are divided into `N_AGES` ranges. An offset is the distance between two cells in rows
//! and columns, and a class contains all offsets that differ only in direction. Learning needs no hidden states: if a
//! frame shows two nearby cells, the product of their innovations (posterior minus prior probability of the paying
//! state) estimates their covariance.

use crate::estimation::belief::Belief;
use crate::estimation::innovation::Innovation;
use emberwatch_model::{Cell, Frame};
use ndarray::Array2;
use serde::{Deserialize, Serialize};

/// Maximum distance, in rows and in columns, at which a seen cell corrects another cell.
pub const RADIUS: usize = 4;

/// Number of rows and of columns of a neighbourhood.
pub const SIDE: usize = 2 * RADIUS + 1;

pub(super) const N_AGES: usize = 8;

/// The upper end of each age range in steps. The last range has no upper end.
const LAST_AGES: [u8; N_AGES - 1] = [1, 2, 4, 7, 12, 25, 60];

/// The range of each age.
pub const AGE_RANGES: [usize; 256] = {
    let mut ranges = [0; 256];
    let mut age = 1;
    while age < 256 {
        let last = ranges[age - 1];
        let is_next = last < LAST_AGES.len() && age > LAST_AGES[last] as usize;
        ranges[age] = last + is_next as usize;
        age += 1;
    }
    ranges
};

/// Number of classes of offsets: one for each `(a, b)` with `a <= b <= RADIUS`. Class 0 is the cell itself.
const N_CLASSES: usize = (RADIUS + 1) * (RADIUS + 2) / 2;

/// Weight of the mean correlation over all age ranges of the older cell, as a number of cell pairs with variance 1. The
/// estimate for a pair of age ranges with little data stays close to this mean.
const SHRINKAGE: f64 = 60.0;

const LARGEST: f64 = 0.9;

/// Upper bound of the sums in a valid file. No run observes enough pairs of cells to exceed it.
const MOST: f64 = 1e15;

/// Correlations, and the sums over pairs of cells from which they are estimated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Sums", into = "Sums")]
pub struct Correlations {
    sums: Sums,
    /// The correlations, indexed by the age ranges of the two cells and the class of their offset.
    table: [[[f32; N_CLASSES]; N_AGES]; N_AGES],
}

/// The numerator and denominator of a correlation: the sum of products of innovations, and the value of this sum if the
/// correlation were 1.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Sum {
    products: f64,
    largest: f64,
}

/// Indexed by the age ranges of the younger and of the older cell, and the class of their offset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Sums([[[Sum; N_CLASSES]; N_AGES]; N_AGES]);

/// The number of steps since each cell of a grid was last seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ages(Vec<u8>);

/// The evidence that a frame provides about whether one cell is in the paying state.
#[derive(Debug, Clone)]
pub struct Evidence {
    cell: Cell,
    age: usize,
    /// Posterior minus prior probability of the paying state.
    innovation: f64,
    /// Scale of the innovation. If the states of two cells always agree, the mean product of their innovations is the
    /// product of their scales.
    scale: f64,
}

impl Ages {
    /// Creates the ages of a grid whose cells were never seen.
    pub fn new(n_cells: usize) -> Self {
        Self(vec![u8::MAX; n_cells])
    }

    /// Returns the number of steps since each cell was last seen, row-major, saturating at 255.
    pub fn as_slice(&self) -> &[u8] {
        &self.0
    }

    /// Adds one step to all ages.
    pub fn grow(&mut self) {
        for age in &mut self.0 {
            *age = age.saturating_add(1);
        }
    }

    /// Sets the age of a seen cell to 0.
    pub fn see(&mut self, index: usize) {
        self.0[index] = 0;
    }
}

impl Evidence {
    /// Computes the evidence about `state` for each cell that the frame shows. `belief` and `ages` are the values
    /// before the frame, and `likelihood` is `P(y | x)`, shape `[S, O]`. Omits observations that are impossible under
    /// the belief.
    ///
    /// # Panics
    /// If the grid of the frame or of the ages differs from the belief's.
    pub fn of(
        frame: &Frame,
        belief: &Belief,
        likelihood: &Array2<f64>,
        state: usize,
        ages: &Ages,
    ) -> Vec<Self> {
        let evidence = |(index, observed)| {
            let prior = belief.states(index);
            let innovation = Innovation::of(&prior, likelihood, state, observed)?;
            Some(Self {
                cell: belief.shape().cell(index),
                age: AGE_RANGES[usize::from(ages.0[index])],
                innovation: innovation.value,
                scale: innovation.reduction / innovation.variance.sqrt(),
            })
        };
        frame.observed().filter_map(evidence).collect()
    }
}

impl Sums {
    /// Adds the products of the innovations and of the scales of two seen cells, if these are at most [`RADIUS`]
    /// columns apart. They must be at most [`RADIUS`] rows apart.
    fn add(&mut self, one: &Evidence, other: &Evidence) {
        let down = one.cell.row.abs_diff(other.cell.row);
        let across = one.cell.col.abs_diff(other.cell.col);
        if across <= RADIUS {
            let (younger, older) = (one.age.min(other.age), one.age.max(other.age));
            let sum = &mut self.0[younger][older][class(down, across)];
            sum.products += one.innovation * other.innovation;
            sum.largest += one.scale * other.scale;
        }
    }
}

impl Default for Correlations {
    fn default() -> Self {
        let mut correlations = Self {
            sums: Sums([[[Sum::default(); N_CLASSES]; N_AGES]; N_AGES]),
            table: [[[0.0; N_CLASSES]; N_AGES]; N_AGES],
        };
        correlations.update();
        correlations
    }
}

impl TryFrom<Sums> for Correlations {
    type Error = &'static str;

    fn try_from(sums: Sums) -> Result<Self, Self::Error> {
        let is_possible =
            |sum: &Sum| sum.products.abs() < MOST && (0.0..MOST).contains(&sum.largest);
        if !sums.0.as_flattened().as_flattened().iter().all(is_possible) {
            return Err(
                "sums of correlations: expected products between -1e15 and 1e15 and scales from 0 to 1e15, got others",
            );
        }
        let mut correlations = Self {
            sums,
            ..Self::default()
        };
        correlations.update();
        Ok(correlations)
    }
}

impl From<Correlations> for Sums {
    fn from(correlations: Correlations) -> Self {
        correlations.sums
    }
}

impl Correlations {
    /// Returns the correlations of cells in age range `age`, by the other cell's age range and the offset's [`class`].
    pub fn of(&self, age: usize) -> &[[f32; N_CLASSES]; N_AGES] {
        &self.table[age]
    }

    /// Creates correlations from a table of shape `[N_AGES, N_AGES, SIDE, SIDE]`, indexed by age ranges and offsets.
    #[cfg(test)]
    pub fn of_table(table: &ndarray::Array4<f32>) -> Self {
        let mut correlations = Self::default();
        for ((one, other, row, col), &number) in table.indexed_iter() {
            let class = class(row.abs_diff(RADIUS), col.abs_diff(RADIUS));
            correlations.table[one][other][class] = number;
        }
        correlations
    }

    /// Updates the correlations with the evidence of one frame, which lists the seen cells in row-major order.
    pub fn learn(&mut self, seen: &[Evidence]) {
        for (index, one) in seen.iter().enumerate() {
            let below = seen[index + 1..].iter();
            let below = below.take_while(|other| other.cell.row - one.cell.row <= RADIUS);
            for other in below {
                self.sums.add(one, other);
            }
        }
        self.update();
    }

    /// Multiplies the weight of past evidence by a factor below 1.
    pub fn fade(&mut self, factor: f64) {
        for sum in self.sums.0.as_flattened_mut().as_flattened_mut() {
            sum.products *= factor;
            sum.largest *= factor;
        }
    }

    fn update(&mut self) {
        for younger in 0..N_AGES {
            for class in 1..N_CLASSES {
                let sums = &self.sums.0[younger];
                let older = younger..N_AGES;
                let mut all = Sum::default();
                for row in &sums[older.clone()] {
                    all.products += row[class].products;
                    all.largest += row[class].largest;
                }
                let mean = all.products / (all.largest + SHRINKAGE);
                for older in older {
                    let Sum { products, largest } = sums[older][class];
                    let estimate = (products + SHRINKAGE * mean) / (largest + SHRINKAGE);
                    let estimate = estimate.clamp(0.0, LARGEST) as f32;
                    self.table[younger][older][class] = estimate;
                    self.table[older][younger][class] = estimate;
                }
            }
        }
        for row in self.table.as_flattened_mut() {
            row[0] = 1.0;
        }
    }
}

/// Returns the class of an offset, given its distances in rows and in columns in any order, each at most [`RADIUS`].
pub const fn class(one: usize, other: usize) -> usize {
    let (less, more) = if one < other {
        (one, other)
    } else {
        (other, one)
    };
    more * (more + 1) / 2 + less
}
