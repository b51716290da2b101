//! The last few thousand steps of each world, joined from what arrives on three channels. Pure.

use protocol::agent_belief::{AgentBelief, Intent};
use protocol::frame::UNOBSERVED;
use protocol::message::{AgentHeader, FrameHeader, StepResult, TruthHeader};
use protocol::observer::Sample;
use protocol::path::path_from_bytes;
use protocol::{Cell, Move, Shape};
use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

/// Most steps that are kept of a world.
pub const MAX_ENTRIES: usize = 4096;

/// Most bytes that are kept of all worlds: 4,096 steps of three 64 x 64 worlds with all there is to see, or
/// 800 of a 256 x 256 world.
const MAX_BYTES: usize = 256 << 20;

/// How many of the last steps late hidden states and beliefs are looked for in.
const MAX_DELAY: usize = 512;

/// How long before a step a belief may have come that is shown beside it.
const MAX_BELIEF_AGE: Duration = Duration::from_secs(5);

/// How many hidden states are held for frames that have not come yet: channels are read one after the
/// other, and a recording may have them in either order.
const MAX_EARLY: usize = 64;

/// Most bytes of those.
const MAX_EARLY_BYTES: usize = 32 << 20;

/// What is known of each world.
#[derive(Debug, Default)]
pub struct Album {
    worlds: BTreeMap<u32, Strip>,
    n_bytes: usize,
    early: VecDeque<(u32, Key, Box<[u8]>)>,
}

/// The kept steps of one world; each has a serial number, in the order of arrival.
#[derive(Debug, Default)]
pub struct Strip {
    entries: VecDeque<Entry>,
    first_serial: u64,
}

/// One step of a world.
#[derive(Debug)]
pub struct Entry {
    /// The grid.
    pub shape: Shape,
    /// The step's result.
    pub result: StepResult,
    /// Where the path began.
    pub start: Cell,
    /// The path; empty after a reset.
    pub moves: Vec<Move>,
    /// Cells seen, row by row, and what they showed.
    pub seen: Vec<(u32, u8)>,
    /// Hidden states, row by row, if they are published.
    pub truth: Option<Box<[u8]>>,
    /// What an agent made of it, if one shows that.
    pub belief: Option<Belief>,
    /// When it came.
    pub at: Instant,
}

/// An agent's belief, as bytes.
#[derive(Debug)]
pub struct Belief {
    /// `round(255 p)`, state by state, each row by row.
    pub levels: Box<[u8]>,
    /// Entropy as a share of `ln S`, `round(255 share)`.
    pub entropy: Box<[u8]>,
    /// What the agent wants.
    pub intent: Intent,
    /// Its process.
    pub pid: u32,
    /// How good it is, where that is known.
    pub score: Option<Score>,
}

/// How a belief compares with the hidden states.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// Minus the mean over cells of the logarithm of the true state's probability, nats.
    pub log_loss: f64,
    /// Mean over cells of the squared error of the target state's probability.
    pub brier: f64,
}

/// A step of an episode of a seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Key {
    seed: u64,
    episode: u64,
    step: u64,
}

/// The model's states, if the server reveals them: names, and which pays most.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct States {
    /// The names.
    pub names: Vec<String>,
    /// The state that pays most.
    pub target: usize,
}

impl Album {
    /// A world's steps.
    pub fn strip(&self, world: u32) -> Option<&Strip> {
        self.worlds.get(&world)
    }

    /// Worlds of which something is known.
    pub fn worlds(&self) -> impl Iterator<Item = u32> + '_ {
        self.worlds.keys().copied()
    }

    /// Forgets everything, as at the start of a recording.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Adds a frame; what makes no sense, and what was shown already, is left out.
    pub fn add_frame(&mut self, sample: &Sample<FrameHeader>, at: Instant) {
        let Some(mut entry) = Entry::from_sample(sample, at) else {
            return;
        };
        let world = sample.header.world;
        let early = self.early_truth(world, entry.key());
        entry.truth = early.filter(|truth| truth.len() == entry.shape.n_cells());
        let strip = self.worlds.entry(world).or_default();
        if strip
            .entries
            .back()
            .is_some_and(|last| last.repeats(&entry))
        {
            return;
        }
        self.n_bytes += entry.n_bytes();
        strip.entries.push_back(entry);
        if strip.entries.len() > MAX_ENTRIES {
            self.n_bytes -= strip.forget_oldest();
        }
        self.make_room();
    }

    /// Adds hidden states to the step that they belong to, if that is kept.
    pub fn add_truth(&mut self, sample: &Sample<TruthHeader>) {
        let header = &sample.header;
        let key = Key {
            seed: header.seed,
            episode: header.episode,
            step: header.step,
        };
        let Some(entry) = self.entry(header.world, key) else {
            let early = (header.world, key, sample.payload.clone().into());
            self.early.truncate(MAX_EARLY - 1);
            self.early.push_front(early);
            let held = |early: &VecDeque<(u32, Key, Box<[u8]>)>| -> usize {
                early.iter().map(|(_, _, truth)| truth.len()).sum()
            };
            while held(&self.early) > MAX_EARLY_BYTES {
                self.early.pop_back();
            }
            return;
        };
        if entry.truth.is_none() && sample.payload.len() == entry.shape.n_cells() {
            entry.truth = Some(sample.payload.clone().into());
            self.n_bytes += sample.payload.len();
            self.make_room();
        }
    }

    /// Adds what an agent believed of a step; `false` if that step is not there, yet or any more. `states` are
    /// the model's.
    pub fn add_belief(&mut self, published: &AgentBelief, states: Option<&States>) -> bool {
        let AgentHeader {
            seed,
            episode,
            step,
            world,
            pid,
            ..
        } = published.header;
        let Some(entry) = self.entry(
            world,
            Key {
                seed,
                episode,
                step,
            },
        ) else {
            return false;
        };
        let (_, height, width) = published.belief.dim();
        if (height, width) != entry.shape.dim() {
            return true; // It makes no sense, now or later.
        }
        let states = states.filter(|states| states.names == published.intent.states);
        let truth = entry.truth.as_deref();
        let score = truth.zip(states);
        let belief = Belief {
            levels: published.belief.iter().map(|&p| level(p)).collect(),
            entropy: entropy(published),
            intent: published.intent.clone(),
            pid,
            score: score.and_then(|(truth, states)| score_of(published, truth, states.target)),
        };
        let n_bytes = belief.n_bytes();
        let replaced = entry.belief.replace(belief);
        self.n_bytes = self.n_bytes + n_bytes - replaced.map_or(0, |old| old.n_bytes());
        self.make_room();
        true
    }

    /// Forgets the oldest steps of the worlds that have most, until all fit.
    fn make_room(&mut self) {
        while self.n_bytes > MAX_BYTES {
            let worlds = self.worlds.values_mut();
            let longest = worlds.max_by_key(|strip| strip.entries.len());
            self.n_bytes -= longest.map_or(self.n_bytes, Strip::forget_oldest);
        }
        self.worlds.retain(|_, strip| !strip.entries.is_empty());
    }

    /// Takes the hidden states that came before their frame.
    fn early_truth(&mut self, world: u32, key: Key) -> Option<Box<[u8]>> {
        let mut places = self.early.iter();
        let place = places.position(|(of, at, _)| (*of, *at) == (world, key))?;
        self.early.remove(place).map(|(_, _, truth)| truth)
    }

    fn entry(&mut self, world: u32, key: Key) -> Option<&mut Entry> {
        let entries = &mut self.worlds.get_mut(&world)?.entries;
        let mut latest = entries.iter_mut().rev().take(MAX_DELAY);
        latest.find(|entry| entry.key() == key)
    }
}

impl Strip {
    /// Serial numbers of the first and the last step kept.
    pub fn kept(&self) -> Option<(u64, u64)> {
        let n = self.entries.len() as u64;
        (n > 0).then(|| (self.first_serial, self.first_serial + n - 1))
    }

    /// The step of a serial number, or the nearest that is kept.
    pub fn nearest(&self, serial: u64) -> Option<(u64, &Entry)> {
        let (first, last) = self.kept()?;
        let serial = serial.clamp(first, last);
        Some((serial, &self.entries[(serial - first) as usize]))
    }

    /// The steps before a serial number and that one, the latest first.
    pub fn back_from(&self, serial: u64) -> impl Iterator<Item = &Entry> {
        let n = (serial + 1).saturating_sub(self.first_serial) as usize;
        self.entries.iter().take(n).rev()
    }

    /// The steps of one run before a serial number and that one, the latest first: what is older may be of another
    /// server, or from before a restore.
    pub fn run_up_to(&self, serial: u64) -> impl Iterator<Item = &Entry> {
        let mut next: Option<&Entry> = None;
        self.back_from(serial)
            .take_while(move |entry| next.replace(entry).is_none_or(|next| entry.precedes(next)))
    }

    /// The latest step with a belief of those, if that came not long before.
    pub fn believed(&self, serial: u64) -> Option<&Entry> {
        let (_, now) = self.nearest(serial)?;
        let is_recent = |entry: &&Entry| now.at.duration_since(entry.at) < MAX_BELIEF_AGE;
        let mut recent = self.run_up_to(serial).take_while(is_recent);
        recent.find(|entry| entry.belief.is_some())
    }

    /// All steps, the oldest first.
    pub fn entries(&self) -> impl ExactSizeIterator<Item = &Entry> {
        self.entries.iter()
    }

    fn forget_oldest(&mut self) -> usize {
        self.first_serial += 1;
        self.entries.pop_front().map_or(0, |entry| entry.n_bytes())
    }
}

impl Entry {
    fn from_sample(sample: &Sample<FrameHeader>, at: Instant) -> Option<Self> {
        let header = &sample.header;
        let shape = Shape::new(header.height as usize, header.width as usize).ok()?;
        let start = Cell {
            row: header.start_row as usize,
            col: header.start_col as usize,
        };
        let (values, path) = sample.payload.split_at_checked(shape.n_cells())?;
        let moves = path_from_bytes(path).ok()?;
        let is_seen = |(_, value): &(u32, &u8)| **value != UNOBSERVED;
        let seen = (0..).zip(values).filter(is_seen);
        let mut seen: Vec<(u32, u8)> = seen.map(|(cell, &value)| (cell, value)).collect();
        seen.shrink_to_fit();
        (shape.contains(start) && moves.len() == header.n_moves as usize).then_some(Self {
            shape,
            result: header.result,
            start,
            moves,
            seen,
            truth: None,
            belief: None,
            at,
        })
    }

    /// The cells of the path, its start first.
    pub fn path(&self) -> Vec<Cell> {
        let mut cells = vec![self.start];
        let mut cell = self.start;
        for step in &self.moves {
            cell = step.apply(cell, self.shape);
            cells.push(cell);
        }
        cells
    }

    fn key(&self) -> Key {
        Key {
            seed: self.result.seed,
            episode: self.result.episode,
            step: self.result.step,
        }
    }

    /// Whether it is an earlier step of the same episode, on the same grid.
    fn precedes(&self, other: &Self) -> bool {
        let of = |entry: &Self| (entry.result.seed, entry.result.episode, entry.shape);
        of(self) == of(other) && self.result.step < other.result.step
    }

    /// Whether it is the same again, as a server shows it to an observer who has just come.
    fn repeats(&self, next: &Self) -> bool {
        (self.result, self.start) == (next.result, next.start) && self.moves == next.moves
    }

    fn n_bytes(&self) -> usize {
        let truth = self.truth.as_ref().map_or(0, |truth| truth.len());
        let belief = self.belief.as_ref().map_or(0, Belief::n_bytes);
        size_of::<Self>() + self.moves.len() + self.seen.len() * 8 + truth + belief
    }
}

impl Belief {
    fn n_bytes(&self) -> usize {
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

/// Entropy of each cell as a share of the greatest, `ln S`.
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

/// `None` if the hidden states are not among the belief's.
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
