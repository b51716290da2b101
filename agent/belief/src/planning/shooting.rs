//! Random shooting: the best of N uniformly random move sequences (the end of paper section III.D).

use crate::planning::planner::{Plan, Planner, PlanningProblem};
use crate::planning::reach::Reach;
use emberwatch_model::grid::{Cell, Shape};
use emberwatch_model::path::Move;
use emberwatch_model::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use serde::{Deserialize, Serialize};

/// The paper's N: 2048 samples.
pub const PAPER_SAMPLES: usize = 2048;

const MOVES_PER_WORD: usize = 32;

/// Number of samples whose positions are computed in parallel: two SSE registers of `i16`.
const LANES: usize = 16;

/// Change in row and column for each [`Move`], in the order of the moves' wire values.
const OFFSETS: [(i32, i32); 4] = [(-1, 0), (1, 0), (0, -1), (0, 1)];

/// The rule that converts a sample's moves to cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Integration {
    /// Each move is clamped to the grid separately, as in a flight.
    #[default]
    ClampEachMove,
    /// The moves are summed without regard to the grid, and each partial sum is clamped, as in the authors' code. A
    /// sample whose sum is five cells beyond the border stays at the border until five moves back. The robot visits the
    /// same cells by moving against the border.
    ClampSum,
}

/// A planner that draws random paths and keeps the best. If scores tie, the sample drawn first wins.
#[derive(Debug)]
pub struct Shooting {
    n_samples: usize,
    integration: Integration,
    reach: Reach,
    slots: Vec<Slot>,
    stamp: u32,
    /// The random bits of [`LANES`] samples, stored sample by sample.
    words: Vec<u64>,
    /// The cells that these samples visit, stored move by move.
    cells: Vec<[(i16, i16); LANES]>,
}

#[derive(Debug, Clone, Copy)]
struct Slot {
    gains: [f32; 2],
    stamp: u32,
}

impl Integration {
    /// Returns the moves with which the robot visits the cells of a sample, given that each move is clamped in flight.
    ///
    /// Successive clamped sums are one cell apart, or equal. If they are equal, the sum is beyond a border, and the
    /// robot moves against that border to stay in place.
    pub fn as_flown(self, shape: Shape, start: Cell, sampled: &[Move]) -> Vec<Move> {
        if self == Self::ClampEachMove {
            return sampled.to_vec();
        }
        let (bottom, right) = (shape.height() as i32 - 1, shape.width() as i32 - 1);
        let clamp = |(row, col): (i32, i32)| (row.clamp(0, bottom), col.clamp(0, right));
        let mut sum = (start.row as i32, start.col as i32);
        let fly = |&step: &Move| {
            let before = clamp(sum);
            let offset = OFFSETS[step as usize];
            sum = (sum.0 + offset.0, sum.1 + offset.1);
            match step {
                _ if clamp(sum) != before => step,
                Move::Up | Move::Down if before.0 == 0 => Move::Up,
                Move::Up | Move::Down => Move::Down,
                Move::Left | Move::Right if before.1 == 0 => Move::Left,
                Move::Left | Move::Right => Move::Right,
            }
        };
        sampled.iter().map(fly).collect()
    }
}

impl Shooting {
    /// Creates a planner that draws `n_samples` samples.
    ///
    /// # Panics
    /// If `n_samples` is 0.
    pub fn new(n_samples: usize, integration: Integration) -> Self {
        assert!(
            n_samples > 0,
            "shooting: expected at least one sample, got 0"
        );
        Self {
            n_samples,
            integration,
            reach: Reach::default(),
            slots: Vec::new(),
            stamp: 0,
            words: Vec::new(),
            cells: Vec::new(),
        }
    }

    /// Creates the planner of the authors' code. Its objective is [`super::Objective::paper`].
    pub fn paper() -> Self {
        Self::new(PAPER_SAMPLES, Integration::ClampSum)
    }

    fn prepare(&mut self, problem: &PlanningProblem<'_>) {
        self.reach.look_at(problem);
        let slot = |&gains| Slot { gains, stamp: 0 };
        self.slots.clear();
        self.slots.extend(self.reach.gains.iter().map(slot));
        self.stamp = 0;
        self.words.clear();
        self.words
            .resize(LANES * problem.n_moves.div_ceil(MOVES_PER_WORD), 0);
        self.cells.clear();
        self.cells.resize(problem.n_moves, [(0, 0); LANES]);
    }

    /// All lanes do the same arithmetic on `i16`, which the compiler translates into vector instructions.
    fn integrate<const CLAMP_SUM: bool>(&mut self) {
        let Reach {
            rows, cols, start, ..
        } = self.reach;
        let (bottom, right) = (rows as i16 - 1, cols as i16 - 1);
        let (mut row, mut col) = ([start.0 as i16; LANES], [start.1 as i16; LANES]);
        let n_words = self.words.len() / LANES;
        let mut bits = [0_u16; LANES];
        for (t, cells) in self.cells.iter_mut().enumerate() {
            if t % 8 == 0 {
                let (word, shift) = (t / MOVES_PER_WORD, 2 * (t % MOVES_PER_WORD));
                bits =
                    std::array::from_fn(|lane| (self.words[lane * n_words + word] >> shift) as u16);
            }
            for lane in 0..LANES {
                // As in `OFFSETS`: the lower bit selects -1 or 1, and the higher bit selects the row (0) or column (1).
                let offset = 2 * (bits[lane] & 1) as i16 - 1;
                let along_rows = (bits[lane] >> 1 & 1) as i16 - 1;
                bits[lane] >>= 2;
                row[lane] += offset & along_rows;
                col[lane] += offset & !along_rows;
                let inside = (row[lane].max(0).min(bottom), col[lane].max(0).min(right));
                if !CLAMP_SUM {
                    (row[lane], col[lane]) = inside;
                }
                cells[lane] = inside;
            }
        }
    }

    /// Whether a cell is new is as unpredictable as the moves, so a branch makes the loop 3.5 times slower (measured).
    /// The compiler would turn an `if` or a mask into a branch, so the code uses the condition as an index.
    fn score(&mut self, lane: usize) -> f32 {
        self.stamp += 1;
        let mut score = 0.0;
        for cells in &self.cells {
            let (row, col) = cells[lane];
            let slot = &mut self.slots[row as usize * self.reach.cols + col as usize];
            score += slot.gains[usize::from(slot.stamp == self.stamp)];
            slot.stamp = self.stamp;
        }
        score
    }

    fn best<const CLAMP_SUM: bool>(&mut self, problem: &PlanningProblem<'_>) -> (Vec<u64>, f32) {
        let mut rng = stream(problem.seed, Purpose::Planner, problem.step);
        let n_words = self.words.len() / LANES;
        let (mut best, mut best_score) = (vec![0; n_words], f32::NEG_INFINITY);
        for first in (0..self.n_samples).step_by(LANES) {
            self.words.fill_with(|| rng.next_u64());
            self.integrate::<CLAMP_SUM>();
            for lane in 0..LANES.min(self.n_samples - first) {
                let score = self.score(lane);
                if score > best_score {
                    best_score = score;
                    best.copy_from_slice(&self.words[lane * n_words..][..n_words]);
                }
            }
        }
        (best, best_score)
    }
}

/// Plans by random shooting if there are no-fly cells, or if cells in sight count. The function replaces moves into
/// no-fly cells, clamps each move, and scores one path at a time.
fn best_of_flown(problem: &PlanningProblem<'_>, n_samples: usize) -> Plan {
    let mut rng = stream(problem.seed, Purpose::Planner, problem.step);
    let n_words = problem.n_moves.div_ceil(MOVES_PER_WORD);
    let sample = |_| {
        let words: Vec<u64> = (0..n_words).map(|_| rng.next_u64()).collect();
        let bits = |t: usize| words[t / MOVES_PER_WORD] >> (2 * (t % MOVES_PER_WORD));
        let moves = (0..problem.n_moves).map(|t| Move::from_low_bits(bits(t)));
        let mut moves: Vec<Move> = moves.collect();
        problem
            .values
            .airspace()
            .fly_around(problem.start, &mut moves);
        let score = problem.values.score(problem.start, &moves);
        Plan { moves, score }
    };
    let plans = (0..n_samples).map(sample);
    let better = |best: Plan, plan: Plan| if plan.score > best.score { plan } else { best };
    plans
        .reduce(better)
        .expect("invariant: at least one sample")
}

impl Planner for Shooting {
    fn plan(&mut self, problem: &PlanningProblem<'_>) -> Plan {
        let values = problem.values;
        if !values.airspace().is_open() || values.in_sight().is_some() {
            return best_of_flown(problem, self.n_samples);
        }
        self.prepare(problem);
        let (words, score) = match self.integration {
            Integration::ClampEachMove => self.best::<false>(problem),
            Integration::ClampSum => self.best::<true>(problem),
        };
        let bits = |t: usize| words[t / MOVES_PER_WORD] >> (2 * (t % MOVES_PER_WORD));
        let sampled = (0..problem.n_moves).map(|t| Move::from_low_bits(bits(t)));
        let (shape, sampled) = (problem.values.shape(), sampled.collect::<Vec<_>>());
        let moves = self.integration.as_flown(shape, problem.start, &sampled);
        Plan { moves, score }
    }
}
