//! How much the paying state of a cell says of that of another one nearby: correlations, learned from what is seen.
//!
//! One number per pair of ages (steps since a cell was last seen, in `N_AGES` ranges) and per class of offsets, as
//! directions are not told apart. No hidden states are used: where a frame shows two cells near each other,
//! the product of their innovations is an estimate of their covariance.

use crate::estimation::belief::Belief;
use crate::estimation::innovation::Innovation;
use emberwatch_model::{Cell, Frame};
use ndarray::Array2;
use serde::{Deserialize, Serialize};

/// Cells further off than this, in rows or columns, are not corrected.
pub const RADIUS: usize = 4;

/// Rows and columns of a neighbourhood.
pub const SIDE: usize = 2 * RADIUS + 1;

pub(super) const N_AGES: usize = 8;

/// The last age of each range but the last one, steps.
const LAST_AGES: [u8; N_AGES - 1] = [1, 2, 4, 7, 12, 25, 60];

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

/// Classes of offsets: `(a, b)` with `a <= b <= RADIUS`, the cell itself the first.
const N_CLASSES: usize = (RADIUS + 1) * (RADIUS + 2) / 2;

/// Weight of the mean over older cells, in pairs of cells of variance one: ranges that are seldom seen together follow it.
const SHRINKAGE: f64 = 60.0;

/// No two cells are taken to be more alike than this.
const LARGEST: f64 = 0.9;

/// No sum of so many pairs can be seen.
const MOST: f64 = 1e15;

/// Sums over pairs of cells seen in the same frames, and the correlations they give.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Sums", into = "Sums")]
pub struct Correlations {
    sums: Sums,
    /// By age range of the one and of the other cell, and class of offset.
    table: [[[f32; N_CLASSES]; N_AGES]; N_AGES],
}

/// One estimate of a correlation: products of innovations, and what they would sum to were it 1.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Sum {
    products: f64,
    largest: f64,
}

/// By age range of the younger and of the older cell, and class of offset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Sums([[[Sum; N_CLASSES]; N_AGES]; N_AGES]);

/// Steps since each cell of a grid was seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ages(Vec<u8>);

/// What a frame says of one cell's paying state.
#[derive(Debug, Clone)]
pub struct Evidence {
    cell: Cell,
    /// The range of its age before the frame.
    age: usize,
    /// Posterior minus prior probability.
    innovation: f64,
    /// Two such innovations multiply to the product of their scales, on average, if both cells always agree.
    scale: f64,
}

impl Ages {
    /// No cell of a grid was seen.
    pub fn new(n_cells: usize) -> Self {
        Self(vec![u8::MAX; n_cells])
    }

    /// Steps, row-major; 255 for so many or more.
    pub fn as_slice(&self) -> &[u8] {
        &self.0
    }

    pub fn grow(&mut self) {
        for age in &mut self.0 {
            *age = age.saturating_add(1);
        }
    }

    pub fn see(&mut self, index: usize) {
        self.0[index] = 0;
    }
}

impl Evidence {
    /// What a frame says of `state` at each of its cells, with the belief before it, in which cells had some ages.
    /// `likelihood` is `P(y | x)`, shape `[S, O]`.
    ///
    /// # Panics
    /// If the frame or the ages are of another grid.
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
    /// Before anything is seen: cells are independent.
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
            return Err("sums of correlations: expected finite ones, got others");
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
    /// The correlations of a cell of an age range with its neighbours: by their age range, and [`class`] of offset.
    pub fn of(&self, age: usize) -> &[[f32; N_CLASSES]; N_AGES] {
        &self.table[age]
    }

    /// As in a table by age ranges and offsets, of shape `[N_AGES, N_AGES, SIDE, SIDE]`.
    #[cfg(test)]
    pub fn of_table(table: &ndarray::Array4<f32>) -> Self {
        let mut correlations = Self::default();
        for ((one, other, row, col), &number) in table.indexed_iter() {
            let class = class(row.abs_diff(RADIUS), col.abs_diff(RADIUS));
            correlations.table[one][other][class] = number;
        }
        correlations
    }

    /// Learns from what one frame said, in row-major order.
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

    /// Weighs what was learned so far less, by a factor below 1.
    pub fn fade(&mut self, factor: f64) {
        for sum in self.sums.0.as_flattened_mut().as_flattened_mut() {
            sum.products *= factor;
            sum.largest *= factor;
        }
    }

    /// The table of the sums.
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

/// The class of an offset by its distances in rows and columns, [`RADIUS`] at most, in any order.
pub const fn class(one: usize, other: usize) -> usize {
    let (less, more) = if one < other {
        (one, other)
    } else {
        (other, one)
    };
    more * (more + 1) / 2 + less
}
