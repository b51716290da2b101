//! One step of a world: its result, its robots' paths and observations, and an agent's belief. Does no I/O.

use emberwatch_protocol::agent_belief::{AgentBelief, Intent};
use emberwatch_protocol::frame::UNOBSERVED;
use emberwatch_protocol::message::{FrameHeader, RobotResult, WorldResult};
use emberwatch_protocol::observer::Sample;
use emberwatch_protocol::path::path_from_bytes;
use emberwatch_protocol::payload::split_frame_payload;
use emberwatch_protocol::{Airspace, Cell, Move, Shape};
use std::time::Instant;

#[derive(Debug)]
pub struct Entry {
    pub shape: Shape,
    pub result: WorldResult,
    pub robots: Vec<Robot>,
    /// Cells that at least one robot saw, row by row, with the observed values.
    pub seen: Vec<(u32, u8)>,
    /// Hidden states, row by row, if they are published.
    pub truth: Option<Box<[u8]>>,
    /// An agent's belief about this step, if one was published.
    pub belief: Option<Belief>,
    pub at: Instant,
}

#[derive(Debug, PartialEq)]
pub struct Robot {
    pub result: RobotResult,
    /// The path that it flew; empty if it did not fly.
    pub moves: Vec<Move>,
}

#[derive(Debug)]
pub struct Belief {
    /// Probabilities p as `round(255 p)`: one grid per state, each row by row.
    pub levels: Box<[u8]>,
    /// Entropy of each cell as a share of `ln S`, stored as `round(255 share)`.
    pub entropy: Box<[u8]>,
    pub intent: Intent,
    pub pid: u32,
    pub first_robot: u32,
    pub n_robots: u32,
    pub score: Option<Score>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// Negative log probability of the true state, in nats, averaged over cells.
    pub log_loss: f64,
    /// Squared error of the target state's probability, averaged over cells.
    pub brier: f64,
}

/// The names of the model's states, and the index of the state with the highest reward.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct States {
    pub names: Vec<String>,
    pub target: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Key {
    pub(crate) seed: u64,
    pub(crate) episode: u64,
    pub(crate) step: u64,
}

impl Entry {
    pub(crate) fn from_sample(sample: &Sample<FrameHeader>, at: Instant) -> Option<Self> {
        let header = &sample.header;
        let shape = Shape::new(header.height as usize, header.width as usize).ok()?;
        let mut union = vec![UNOBSERVED; shape.n_cells()];
        let mut robots = Vec::new();
        for robot in split_frame_payload(header, &sample.payload).ok()? {
            // Robots that see the same cell observe the same value there.
            for (cell, &value) in union.iter_mut().zip(robot.frame) {
                *cell = value.min(*cell);
            }
            robots.push(Robot {
                result: robot.result,
                moves: path_from_bytes(robot.path).ok()?,
            });
        }
        let seen = (0..).zip(union).filter(|&(_, value)| value != UNOBSERVED);
        let mut seen: Vec<(u32, u8)> = seen.collect();
        seen.shrink_to_fit();
        let are_inside = robots
            .iter()
            .all(|robot| shape.contains(robot.result.start()));
        are_inside.then_some(Self {
            shape,
            result: header.result,
            robots,
            seen,
            truth: None,
            belief: None,
            at,
        })
    }

    /// Returns whether any robot flew. In a reset or a restore, no robot flies.
    pub fn is_step(&self) -> bool {
        self.robots.iter().any(|robot| !robot.moves.is_empty())
    }

    pub(crate) fn key(&self) -> Key {
        Key {
            seed: self.result.seed,
            episode: self.result.episode,
            step: self.result.step,
        }
    }

    /// Returns whether this is an earlier step of the same episode, on the same grid.
    pub(crate) fn precedes(&self, other: &Self) -> bool {
        let of = |entry: &Self| (entry.result.seed, entry.result.episode, entry.shape);
        of(self) == of(other) && self.result.step < other.result.step
    }

    /// Returns whether `next` repeats this entry. Servers repeat the last frame for a new observer.
    pub(crate) fn repeats(&self, next: &Self) -> bool {
        self.result == next.result && self.robots == next.robots
    }

    pub(crate) fn n_bytes(&self) -> usize {
        let truth = self.truth.as_ref().map_or(0, |truth| truth.len());
        let belief = self.belief.as_ref().map_or(0, Belief::n_bytes);
        let moves: usize = self.robots.iter().map(|robot| robot.moves.len()).sum();
        let robots = size_of_val(&*self.robots) + moves;
        size_of::<Self>() + robots + self.seen.len() * 8 + truth + belief
    }
}

impl Robot {
    pub fn path(&self, airspace: &Airspace) -> Vec<Cell> {
        let mut cells = vec![self.result.start()];
        for step in &self.moves {
            cells.push(airspace.after(*step, cells[cells.len() - 1]));
        }
        cells
    }
}

impl Belief {
    pub(crate) fn of(
        published: &AgentBelief,
        truth: Option<&[u8]>,
        states: Option<&States>,
    ) -> Self {
        let states = states.filter(|states| states.names == published.intent.states);
        let score = truth.zip(states);
        Self {
            levels: published.belief.iter().map(|&p| level(p)).collect(),
            entropy: entropy(published),
            intent: published.intent.clone(),
            pid: published.header.pid,
            first_robot: published.header.first_robot,
            n_robots: published.header.n_robots,
            score: score.and_then(|(truth, states)| score_of(published, truth, states.target)),
        }
    }

    pub(crate) fn n_bytes(&self) -> usize {
        let intent = &self.intent;
        let words = [&intent.policy, &intent.belief_from, &intent.objective];
        let words = words.into_iter().chain(&intent.states);
        let n_words: usize = words.map(|word| size_of::<String>() + word.len()).sum();
        self.levels.len() + self.entropy.len() + n_words
    }
}

fn level(share: f32) -> u8 {
    (share * 255.0).round() as u8
}

fn entropy(published: &AgentBelief) -> Box<[u8]> {
    let (n_states, height, width) = published.belief.dim();
    let mut sums = vec![0f32; height * width];
    for plane in published.belief.outer_iter() {
        for (sum, &p) in sums.iter_mut().zip(plane) {
            *sum -= if p > 0.0 { p * p.ln() } else { 0.0 };
        }
    }
    let greatest = (n_states as f32).ln().max(f32::MIN_POSITIVE);
    sums.iter().map(|sum| level(sum / greatest)).collect()
}

/// Scores a belief. Returns `None` if a hidden state is not among the belief's states.
fn score_of(published: &AgentBelief, truth: &[u8], target: usize) -> Option<Score> {
    let n_cells = truth.len();
    let numbers = published.belief.as_slice()?;
    let (mut log_loss, mut brier) = (0.0, 0.0);
    for (cell, &state) in truth.iter().enumerate() {
        let p = f64::from(*numbers.get(usize::from(state) * n_cells + cell)?);
        log_loss -= p.max(f64::from(f32::MIN_POSITIVE)).ln();
        let of_target = f64::from(*numbers.get(target * n_cells + cell)?);
        let miss = of_target - f64::from(u8::from(usize::from(state) == target));
        brier += miss * miss;
    }
    let mean = |sum: f64| sum / n_cells as f64;
    Some(Score {
        log_loss: mean(log_loss),
        brier: mean(brier),
    })
}
