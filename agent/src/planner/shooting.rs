//! Random shooting: the best of N uniformly random move sequences (the end of paper section III.D).

use super::window::Window;
use super::{Plan, Planner, PlanningProblem};
use protocol::grid::{Cell, Shape};
use protocol::path::Move;
use protocol::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use serde::{Deserialize, Serialize};

/// The paper's N: 2048 samples.
pub const PAPER_SAMPLES: usize = 2048;

/// Moves in one word of random bits.
const MOVES_PER_WORD: usize = 32;

/// Row and column that each [`Move`] adds, in the order of its wire value.
const OFFSETS: [(i32, i32); 4] = [(-1, 0), (1, 0), (0, -1), (0, 1)];

/// How a sample's moves become cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Integration {
    /// Each move is clamped to the grid on its own: what the robot does.
    #[default]
    ClampEachMove,
    /// The moves are added up without regard to the grid and each sum is clamped, as in the authors'
    /// code. A sample that leaves the grid by five cells stays at the border until it has come back
    /// five; the robot is sent against the border instead, to the same cells.
    ClampSum,
}

/// Random shooting; ties go to the sample drawn first.
#[derive(Debug)]
pub struct Shooting {
    n_samples: usize,
    integration: Integration,
    window: Window,
    slots: Vec<Slot>,
    stamp: u32,
}

/// A cell of the window, with all that a visit reads or writes in one place.
#[derive(Debug, Clone, Copy)]
struct Slot {
    /// Score of the first visit.
    first: f32,
    /// The sample that was last here.
    stamp: u32,
}

impl Integration {
    /// The moves that take the robot, which clamps each move, over the cells of a sample.
    ///
    /// Clamped sums follow each other at a distance of one cell or none. Where there is none the sum
    /// is beyond a border, so the robot flies against that border to stay in place.
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
    /// Shooting with `n_samples` samples, at least one.
    pub fn new(n_samples: usize, integration: Integration) -> Self {
        assert!(n_samples > 0, "shooting: expected at least one sample");
        Self {
            n_samples,
            integration,
            window: Window::default(),
            slots: Vec::new(),
            stamp: 0,
        }
    }

    /// What the authors' code does: 2048 samples, clamped after the sum. Its objective is
    /// [`super::Objective::paper`].
    pub fn paper() -> Self {
        Self::new(PAPER_SAMPLES, Integration::ClampSum)
    }

    /// Makes room for one stamp per sample; stamps of earlier plans never equal a later one.
    fn prepare(&mut self, problem: &PlanningProblem<'_>) {
        self.window.look_at(problem);
        let slot = |&first| Slot { first, stamp: 0 };
        self.slots.clear();
        self.slots.extend(self.window.first.iter().map(slot));
        self.stamp = 0;
    }

    /// Score of one sample, two bits a move from the low end of each word.
    ///
    /// Without branches that depend on the random moves: a mispredicted one costs as much as four
    /// moves. `CLAMP_SUM` is known at compile time, so the robot's position is the only chain of
    /// dependent operations besides the score.
    #[inline(always)]
    fn score<const CLAMP_SUM: bool>(&mut self, words: &[u64], n_moves: usize) -> f32 {
        self.stamp += 1;
        let Window {
            rows, cols, start, ..
        } = self.window;
        let (bottom, right) = (rows as i32 - 1, cols as i32 - 1);
        let (mut row, mut col) = (start.0 as i32, start.1 as i32);
        let mut score = 0.0;
        for (word_index, &word) in words.iter().enumerate() {
            let n_left = (n_moves - word_index * MOVES_PER_WORD).min(MOVES_PER_WORD);
            let mut bits = word;
            for _ in 0..n_left {
                let (down, along) = OFFSETS[(bits & 3) as usize];
                bits >>= 2;
                (row, col) = (row + down, col + along);
                let inside = (row.clamp(0, bottom), col.clamp(0, right));
                if !CLAMP_SUM {
                    (row, col) = inside;
                }
                let slot = &mut self.slots[inside.0 as usize * cols + inside.1 as usize];
                let again = self.window.again(slot.first);
                score += if slot.stamp == self.stamp {
                    again
                } else {
                    slot.first
                };
                slot.stamp = self.stamp;
            }
        }
        score
    }

    /// The random bits of the best sample, and its score.
    fn best<const CLAMP_SUM: bool>(&mut self, problem: &PlanningProblem<'_>) -> (Vec<u64>, f32) {
        let mut rng = stream(problem.seed, Purpose::Planner, problem.step);
        let mut words = vec![0; problem.n_moves.div_ceil(MOVES_PER_WORD)];
        let (mut best, mut best_score) = (words.clone(), f32::NEG_INFINITY);
        for _ in 0..self.n_samples {
            words.fill_with(|| rng.next_u64());
            let score = self.score::<CLAMP_SUM>(&words, problem.n_moves);
            if score > best_score {
                best_score = score;
                best.copy_from_slice(&words);
            }
        }
        (best, best_score)
    }
}

impl Planner for Shooting {
    fn plan(&mut self, problem: &PlanningProblem<'_>) -> Plan {
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
