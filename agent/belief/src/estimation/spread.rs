//! The arithmetic of one correction: how the observation of a cell changes the beliefs about its neighbours.

use crate::estimation::belief::Belief;
use crate::estimation::correlations::{AGE_RANGES, Ages, Correlations, RADIUS, SIDE, class};
use crate::estimation::innovation::Innovation;
use emberwatch_model::vectors::vectorised;
use emberwatch_model::{Cell, Shape};

/// Bound on probabilities that are corrected by a neighbour's observation. Such an observation is never conclusive, so
/// the probability of the paying state stays between `LEAST` and `1 - LEAST`.
const LEAST: f32 = 1e-5;

const CENTRE: usize = RADIUS * WIDTH + 2 * RADIUS;

const CLASSES: [[usize; SIDE]; SIDE] = {
    let mut classes = [[0; SIDE]; SIDE];
    let mut at = 0;
    while at < SIDE * SIDE {
        let (row, col) = (at / SIDE, at % SIDE);
        classes[row][col] = class(row.abs_diff(RADIUS), col.abs_diff(RADIUS));
        at += 1;
    }
    classes
};

const WIDTH: usize = SIDE + 2 * RADIUS;

/// Covariances of a seen cell with each cell of its neighbourhood, row-major. Each row has margins, so that a single
/// offset aligns the patches of two nearby cells.
type Patch = [f32; WIDTH * SIDE];

/// Work space of a correction. Per-cell buffers are row-major, with a margin of [`RADIUS`] cells around the grid. The
/// covariance of a margin cell with any cell is 0.
#[derive(Debug, Clone)]
pub struct Spread {
    shape: Shape,
    state: usize,
    stride: usize,
    probability: Vec<f32>,
    /// For each cell, the standard deviation of "the cell is in the paying state" (1 or 0) before the frame.
    deviation: Vec<f32>,
    ages: Vec<u8>,
    seen: Vec<SeenCell>,
    patches: Vec<Patch>,
}

#[derive(Debug, Clone)]
struct SeenCell {
    cell: Cell,
    observed: u8,
    posterior: Vec<f64>,
}

impl Spread {
    /// Allocates the work space for a grid.
    pub fn new(shape: Shape, state: usize) -> Self {
        let stride = shape.width() + 2 * RADIUS;
        let n_cells = stride * (shape.height() + 2 * RADIUS);
        Self {
            shape,
            state,
            stride,
            probability: vec![0.0; n_cells],
            deviation: vec![0.0; n_cells],
            ages: vec![0; n_cells],
            seen: Vec::new(),
            patches: Vec::new(),
        }
    }

    /// Starts a correction of a belief. `seen` lists the row-major index and the observation of each seen cell.
    pub fn start(
        &mut self,
        belief: &Belief,
        ages: &Ages,
        seen: impl Iterator<Item = (usize, u8)>,
        correlations: &Correlations,
    ) {
        let shape = self.shape;
        let probability = belief.probability(self.state);
        let ages = ages.as_slice().chunks_exact(shape.width());
        for (row, (numbers, ages)) in probability.rows().into_iter().zip(ages).enumerate() {
            let start = self.place(Cell { row, col: 0 });
            self.ages[start..start + ages.len()].copy_from_slice(ages);
            let cells = start..start + ages.len();
            let deviations = self.deviation[cells.clone()].iter_mut();
            let cells = self.probability[cells].iter_mut().zip(deviations);
            for ((probability, deviation), &p) in cells.zip(numbers) {
                *probability = p;
                *deviation = (p * (1.0 - p)).max(0.0).sqrt();
            }
        }
        let seen = seen.map(|(index, observed)| SeenCell {
            cell: shape.cell(index),
            observed,
            posterior: Vec::new(),
        });
        self.seen.clear();
        self.seen.extend(seen);
        let patches = self
            .seen
            .iter()
            .map(|seen| self.patch(seen.cell, correlations));
        self.patches = patches.collect();
    }

    fn patch(&self, cell: Cell, correlations: &Correlations) -> Patch {
        let own = self.deviation[self.place(cell)];
        let age = self.ages[self.place(cell)];
        let table = correlations.of(AGE_RANGES[usize::from(age)]);
        let mut patch = [0.0; WIDTH * SIDE];
        let rows = patch.chunks_exact_mut(WIDTH);
        for (offset, (row, classes)) in rows.zip(&CLASSES).enumerate() {
            let start = self.corner(cell) + offset * self.stride;
            let others = start..start + SIDE;
            let deviations = &self.deviation[others.clone()];
            let ages = &self.ages[others];
            for (((to, class), deviation), &age) in row[RADIUS..]
                .iter_mut()
                .zip(classes)
                .zip(deviations)
                .zip(ages)
            {
                *to = table[AGE_RANGES[usize::from(age)]][*class] * deviation * own;
            }
        }
        patch
    }

    pub fn n_seen(&self) -> usize {
        self.seen.len()
    }

    /// Returns a seen cell, its observation, and the belief about the cell after the corrections so far.
    pub fn prior(&self, index: usize, belief: &Belief) -> (Cell, u8, Vec<f64>) {
        let SeenCell { cell, observed, .. } = self.seen[index];
        let now = f64::from(self.probability[self.place(cell)]);
        let mut states = belief.states(self.shape.index(cell));
        let rest: f64 = states.iter().sum::<f64>() - states[self.state];
        // If no neighbour changed the probability, keep all probabilities: computing `1 - now` could lose a tiny
        // remainder to rounding.
        if rest > 0.0 && now != states[self.state] {
            states.iter_mut().for_each(|p| *p *= (1.0 - now) / rest);
            states[self.state] = now;
        }
        (cell, observed, states)
    }

    /// Corrects a seen cell, its neighbours, and the covariances of the seen cells that are corrected later.
    pub fn spread(&mut self, index: usize, innovation: &Innovation, posterior: Vec<f64>) {
        let own = posterior[self.state] as f32;
        vectorised(
            #[inline(always)]
            || self.correct(index, innovation, own),
        );
        self.seen[index].posterior = posterior;
    }

    #[inline(always)] // So that `vectorised` compiles it for this processor's vector instructions.
    fn correct(&mut self, index: usize, innovation: &Innovation, posterior: f32) {
        let cell = self.seen[index].cell;
        let (corner, place) = (self.corner(cell), self.place(cell));
        let (done, to_come) = self.patches.split_at_mut(index + 1);
        let patch = &mut done[index];
        let own = self.probability[place];
        let gain = (innovation.value / innovation.variance) as f32;
        let own_variance = patch[CENTRE];
        for (offset, row) in patch.chunks_exact_mut(WIDTH).enumerate() {
            // The margins contain stale values that belong to no cell.
            row[..RADIUS].fill(0.0);
            row[RADIUS + SIDE..].fill(0.0);
            let start = corner + offset * self.stride;
            let others = &mut self.probability[start..start + SIDE];
            for (covariance, p) in row[RADIUS..].iter_mut().zip(others) {
                // The joint probability of two events is at most min(p, q) and at least max(0, p + q - 1).
                let both = *p * own;
                let least = (*p + own - 1.0).max(0.0) - both;
                *covariance = covariance.max(least).min(p.min(own) - both);
                let moved = (*p + *covariance * gain).clamp(LEAST, 1.0 - LEAST);
                // With a covariance of 0, keep the exact probability of the plain filter.
                *p = if *covariance == 0.0 { *p } else { moved };
            }
        }
        patch[CENTRE] = own_variance;
        self.probability[place] = posterior;
        let share = -innovation.reduction / innovation.variance.powi(2);
        for (seen, other) in self.seen[index + 1..].iter().zip(to_come) {
            let down = seen.cell.row as isize - cell.row as isize;
            let across = seen.cell.col as isize - cell.col as isize;
            if down.unsigned_abs().max(across.unsigned_abs()) <= RADIUS {
                reduce(other, patch, share, (down, across));
            }
        }
    }

    /// Ends a correction: writes the result to the belief, and sets the ages of the seen cells to 0.
    pub fn end(&self, belief: &mut Belief, ages: &mut Ages) {
        let n_cells = self.shape.n_cells();
        let numbers = belief.as_mut_slice();
        for SeenCell {
            cell, posterior, ..
        } in &self.seen
        {
            let index = self.shape.index(*cell);
            let states = numbers[index..].iter_mut().step_by(n_cells);
            states.zip(posterior).for_each(|(to, &p)| *to = p as f32);
            ages.see(index);
        }
        let width = self.shape.width();
        vectorised(
            #[inline(always)]
            || {
                for row in 0..self.shape.height() {
                    let start = self.place(Cell { row, col: 0 });
                    let now = &self.probability[start..start + width];
                    set_state(&mut numbers[row * width..], n_cells, self.state, now);
                }
            },
        );
    }

    fn place(&self, cell: Cell) -> usize {
        (cell.row + RADIUS) * self.stride + cell.col + RADIUS
    }

    fn corner(&self, cell: Cell) -> usize {
        cell.row * self.stride + cell.col
    }
}

/// A cell whose other states all have probability 0 is left unchanged.
#[inline(always)]
fn set_state(numbers: &mut [f32], n_cells: usize, state: usize, now: &[f32]) {
    let own = state * n_cells;
    if numbers[own..].starts_with(now) {
        return;
    }
    let n_states = numbers.len().div_ceil(n_cells);
    let others = (0..n_states).filter(|&other| other != state);
    let mut scales = vec![0.0_f64; now.len()];
    for other in others.clone() {
        let cells = scales.iter_mut().zip(&numbers[other * n_cells..]);
        cells.for_each(|(rest, &p)| *rest += f64::from(p));
    }
    let cells = scales.iter_mut().zip(&mut numbers[own..]).zip(now);
    cells.for_each(|((scale, own), &now)| {
        let (rest, is_new) = (*scale, now != *own);
        *own = if rest > 0.0 { now } else { *own };
        let kept = (1.0 - f64::from(now)) / rest;
        *scale = if rest > 0.0 && is_new { kept } else { 1.0 };
    });
    for other in others {
        let cells = numbers[other * n_cells..].iter_mut().zip(&scales);
        cells.for_each(|(p, scale)| *p = (f64::from(*p) * scale) as f32);
    }
}

/// The patch lies `down` rows and `across` columns from the patch of the seen cell.
#[inline(always)]
fn reduce(patch: &mut Patch, seen: &Patch, share: f64, (down, across): (isize, isize)) {
    let offset = down * WIDTH as isize + across;
    let covariance = seen[CENTRE.wrapping_add_signed(offset)];
    let factor = (share * f64::from(covariance)) as f32;
    let (skip, skip_seen) = ((-offset).max(0) as usize, offset.max(0) as usize);
    for (to, from) in patch[skip..].iter_mut().zip(&seen[skip_seen..]) {
        *to += factor * from;
    }
}
