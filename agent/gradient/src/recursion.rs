//! The filter's recursion through one window of frames, and its derivatives by backpropagation.
//!
//! For each frame, the forward pass computes `p = B(y) u / (b(y)' u)` on visited cells (paper eq. 5), then
//! `u = Phi_w(p)` (eq. 6). The result is the log-likelihood, the sum of `ln b(y)' u` over visited cells. The backward
//! pass runs the same steps in reverse, and stops at the window's first predictor (truncated backpropagation).
//! Gradients are zero far from the cells that later frames visit, so only the remaining region is computed.

use crate::convolution::Region;
use crate::layout::Layout;
use crate::operator::Operator;
use emberwatch_belief::estimation::parameters::Tables;
use emberwatch_model::Shape;
use pulp::{Arch, Simd, WithSimd};

/// The observation of one cell in a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sighting {
    /// Index of the cell in the grid, row by row.
    pub cell: u32,
    /// Index of the observation, below the model's number of observations.
    pub value: u8,
}

/// The result of one pass through a window.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Derivatives of `-log_likelihood` with respect to the kernel, the likelihood and the first belief, each with as
    /// many numbers as this table of [`Tables`] has.
    pub gradient: [Vec<f64>; 3],
    /// Sum of `ln P(y)` over visited cells, in nats.
    pub log_likelihood: f64,
    /// Number of visited cells, counted once per frame.
    pub n_seen: usize,
}

/// The recursion with its buffers. Each thread needs its own recursion.
#[derive(Debug, Clone)]
pub struct Recursion {
    operator: Operator,
    tables: Tables,
    /// Posterior of each frame, and the predictor after the last frame.
    planes: Vec<Vec<f32>>,
    /// Normalising factors of each predictor: the reciprocals of the weights' sums.
    factors: Vec<Vec<f32>>,
    seen: Vec<Visit>,
    /// Predictors of the seen cells before their correction, S values per cell.
    predictors: Vec<f32>,
    /// Derivatives with respect to the belief: `dL/dp` or `dL/du`.
    by_belief: Vec<f32>,
    /// Derivatives with respect to the weights' sums: `dL/dv`.
    by_weights: Vec<f32>,
}

#[derive(Debug, Clone, Copy)]
struct Visit {
    frame: usize,
    cell: usize,
    place: usize,
    value: usize,
}

impl Recursion {
    /// Creates a recursion for windows of up to `n_frames` frames.
    pub fn new(tables: Tables, shape: Shape, n_frames: usize) -> Self {
        let dimensions = tables.dimensions;
        let layout = Layout::new(shape, dimensions.n_states, dimensions.kernel);
        Self {
            by_weights: layout.planes(),
            operator: Operator::new(layout, &tables.kernel),
            tables,
            planes: vec![layout.planes(); n_frames + 1],
            factors: vec![vec![0.0; layout.plane]; n_frames + 1],
            seen: Vec::new(),
            predictors: Vec::new(),
            by_belief: layout.planes(),
        }
    }

    /// Replaces the parameters with others of the same dimensions.
    pub fn set(&mut self, tables: &Tables) {
        self.operator = Operator::new(self.operator.layout, &tables.kernel);
        self.tables.clone_from(tables);
    }

    /// Runs through frames from `start`, the belief `[S, H, W]` at the end of an earlier window, or from the learned
    /// first belief if `start` is `None`. Writes the predictor after the last frame to `end`.
    ///
    /// # Panics
    /// If there are more frames than [`Self::new`] allowed, or if a cell is off the grid.
    pub fn run(
        &mut self,
        start: Option<&[f32]>,
        frames: &[Vec<Sighting>],
        end: &mut [f32],
    ) -> Outcome {
        Arch::new().dispatch(Pass {
            recursion: self,
            start,
            frames,
            end,
        })
    }

    fn reset(&mut self, start: Option<&[f32]>) {
        let layout = self.operator.layout;
        let first = || self.tables.prior(layout.shape).as_slice().to_vec();
        let belief = start.map_or_else(first, <[f32]>::to_vec);
        layout.load(&belief, &mut self.planes[0]);
        self.seen.clear();
        self.predictors.clear();
    }

    /// Applies eq. 5 to a frame's cells. Returns the sum of `ln b(y)' u`.
    fn correct(&mut self, frame: usize, sightings: &[Sighting]) -> f64 {
        let layout = self.operator.layout;
        let n_states = layout.n_states;
        let n_observations = self.tables.dimensions.n_observations;
        let planes = &mut self.planes[frame];
        let mut log_likelihood = 0.0;
        for sighting in sightings {
            let (cell, value) = (sighting.cell as usize, usize::from(sighting.value));
            let place = layout.place(cell);
            let seen_as = |state: usize| self.tables.likelihood[state * n_observations + value];
            let mut evidence = 0.0;
            for state in 0..n_states {
                let u = planes[state * layout.plane + place];
                self.predictors.push(u);
                evidence += u * seen_as(state);
            }
            for state in 0..n_states {
                let p = &mut planes[state * layout.plane + place];
                *p = *p * seen_as(state) / evidence;
            }
            log_likelihood += f64::from(evidence).ln();
            self.seen.push(Visit {
                frame,
                cell,
                place,
                value,
            });
        }
        log_likelihood
    }

    /// Computes the predictor after a frame (eq. 6).
    #[inline(always)]
    fn predict<S: Simd>(&mut self, simd: S, frame: usize) {
        let (before, after) = self.planes.split_at_mut(frame + 1);
        let factors = &mut self.factors[frame + 1];
        let (p, u) = (&before[frame], &mut after[0]);
        self.operator.forward(simd, p, u, factors);
    }

    #[inline(always)]
    fn backward<S: Simd>(&mut self, simd: S, n_frames: usize, outcome: &mut Outcome) {
        self.by_belief.fill(0.0);
        self.by_weights.fill(0.0);
        let mut region = Region::default();
        for frame in (0..n_frames).rev() {
            self.uncorrect(frame, outcome, &mut region);
            if frame > 0 && !region.rows.is_empty() {
                region = self.unpredict(simd, frame, &region, outcome);
            }
        }
    }

    /// Backpropagates through eq. 5: converts `dL/dp` of a frame's cells to `dL/du`, and restores their predictors.
    fn uncorrect(&mut self, frame: usize, outcome: &mut Outcome, region: &mut Region) {
        let layout = self.operator.layout;
        let (n_states, width) = (layout.n_states, layout.shape.width());
        let n_observations = self.tables.dimensions.n_observations;
        let planes = &mut self.planes[frame];
        while let Some(seen) = self.seen.pop_if(|seen| seen.frame == frame) {
            region.add(seen.cell / width, seen.cell % width);
            let first = self.predictors.len() - n_states;
            let at = |state: usize| state * layout.plane + seen.place;
            let entry = |state: usize| state * n_observations + seen.value;
            let (mut evidence, mut mean) = (0.0, 0.0);
            for state in 0..n_states {
                evidence += self.predictors[first + state] * self.tables.likelihood[entry(state)];
                mean += self.by_belief[at(state)] * planes[at(state)];
            }
            for state in 0..n_states {
                let u = self.predictors[first + state];
                // The term -1 is the derivative of -ln(evidence) itself.
                let by_joint = (self.by_belief[at(state)] - mean - 1.0) / evidence;
                outcome.gradient[1][entry(state)] += f64::from(by_joint * u);
                self.by_belief[at(state)] = by_joint * self.tables.likelihood[entry(state)];
                planes[at(state)] = u;
            }
            self.predictors.truncate(first);
        }
    }

    /// Backpropagates through eqs. 2 and 3, from `dL/du` of a frame to `dL/dp` of the previous frame. Returns the
    /// region of `dL/dp`.
    #[inline(always)]
    fn unpredict<S: Simd>(
        &mut self,
        simd: S,
        frame: usize,
        region: &Region,
        outcome: &mut Outcome,
    ) -> Region {
        let (p, u) = (&self.planes[frame - 1], &self.planes[frame]);
        let factors = &self.factors[frame];
        let (g, h) = (&mut self.by_belief, &mut self.by_weights);
        let operator = &self.operator;
        operator.backward_normalise(simd, u, factors, (g, h), region);
        operator.add_weight_gradient(simd, p, h, region, &mut outcome.gradient[0]);
        let reached = region.reached(&operator.layout);
        operator.backward_correlate(simd, h, g, reached.rows.clone());
        reached
    }

    fn add_initial_gradient(&self, outcome: &mut Outcome) {
        let layout = self.operator.layout;
        for row in 0..layout.shape.height() {
            for (state, sum) in outcome.gradient[2].iter_mut().enumerate() {
                let at = state * layout.plane + layout.row(row);
                let cells = &self.by_belief[at..][..layout.shape.width()];
                *sum += cells.iter().map(|&x| f64::from(x)).sum::<f64>();
            }
        }
    }
}

struct Pass<'a> {
    recursion: &'a mut Recursion,
    start: Option<&'a [f32]>,
    frames: &'a [Vec<Sighting>],
    end: &'a mut [f32],
}

/// Everything is inlined, down to the innermost loop, so that it is compiled for each processor's vector instructions.
/// Results can differ in the last bits between processor types, but not between runs or numbers of threads.
impl WithSimd for Pass<'_> {
    type Output = Outcome;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Outcome {
        let (recursion, n_frames) = (self.recursion, self.frames.len());
        let mut outcome = Outcome {
            gradient: recursion.tables.dimensions.lengths().map(|n| vec![0.0; n]),
            log_likelihood: 0.0,
            n_seen: 0,
        };
        recursion.reset(self.start);
        for (frame, sightings) in self.frames.iter().enumerate() {
            outcome.log_likelihood += recursion.correct(frame, sightings);
            outcome.n_seen += sightings.len();
            recursion.predict(simd, frame);
        }
        recursion
            .operator
            .layout
            .unload(&recursion.planes[n_frames], self.end);
        recursion.backward(simd, n_frames, &mut outcome);
        if self.start.is_none() {
            recursion.add_initial_gradient(&mut outcome);
        }
        outcome
    }
}
