//! What a recording tells of one world, step by step: records in, beats out. Pure.

use super::FilmError;
use protocol::control::ServerInfo;
use protocol::grid::ShapeError;
use protocol::message::{FrameHeader, StepResult, TruthHeader};
use protocol::observer::Sample;
use protocol::path::{MoveError, path_from_bytes};
use protocol::recording::{Event, Record, RecordingError};
use protocol::{Cell, Frame, Grid, Move, Shape, frame::FrameError};
use std::collections::VecDeque;
use std::path::Path;
use thiserror::Error;

/// Most cells of hidden states that wait for their frames: 16,000 grids of 64 x 64 cells.
const MOST_AHEAD: usize = 64 << 20;

/// One recorded step.
#[derive(Debug, Clone, PartialEq)]
pub struct Beat {
    /// What it brought.
    pub result: StepResult,
    /// What the robot saw.
    pub frame: Frame,
    /// The robot's cells, the start first; after a reset only that.
    pub path: Vec<Cell>,
    /// The hidden states, if they are recorded.
    pub truth: Option<Grid<u8>>,
    /// How it follows the beat before it.
    pub link: Link,
}

/// How a beat follows the one before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Link {
    /// Nothing is known from before.
    Begins,
    /// So many steps between the two are not recorded.
    Follows {
        /// How many.
        n_lost: u64,
    },
}

/// A sample that no server publishes.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StoryError {
    /// A grid of no world.
    #[error(transparent)]
    Shape(#[from] ShapeError),
    /// Values that are no observations.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// A path that is none.
    #[error(transparent)]
    Move(#[from] MoveError),
    /// A robot beside the grid.
    #[error("robot: expected a cell on the {shape} grid, got {cell}")]
    Robot {
        /// The grid.
        shape: Shape,
        /// Where it should be.
        cell: Cell,
    },
    /// The recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
}

impl StoryError {
    /// The same of a file.
    pub(super) fn of(self, path: &Path) -> FilmError {
        let path = path.to_owned();
        match self {
            Self::Recording(problem) => FilmError::File { path, problem },
            problem => FilmError::Sample { path, problem },
        }
    }
}

/// Reads records; an iterator of beats.
#[derive(Debug)]
pub struct Story<R> {
    records: R,
    world: u32,
    /// The server that the samples are from.
    server: Option<ServerInfo>,
    /// Hidden states that came before their frame, as a recorder that falls behind writes them.
    truths: VecDeque<Sample<TruthHeader>>,
    /// The last beat, whose hidden states may come behind it.
    held: Option<Beat>,
    /// Episode and step of the last frame.
    last: Option<(u64, u64)>,
    /// Why there is nothing more to tell before the recording's end.
    end: Option<End>,
}

/// What ends a story that is not told to the recording's end.
#[derive(Debug)]
pub enum End {
    /// The file lacks its end, or is damaged from here on.
    Early(RecordingError),
    /// The next server's worlds are of another kind.
    OtherWorlds,
}

impl<R: Iterator<Item = Result<Record, RecordingError>>> Story<R> {
    /// The story of a world.
    pub fn new(records: R, world: u32) -> Self {
        Self {
            records,
            world,
            server: None,
            truths: VecDeque::new(),
            held: None,
            last: None,
            end: None,
        }
    }

    /// The first server, as soon as a beat was told.
    pub fn server(&self) -> Option<&ServerInfo> {
        self.server.as_ref()
    }

    /// Why the story ended, unless it was told to the recording's end.
    pub fn into_end(self) -> Option<End> {
        self.end
    }

    fn next_beat(&mut self) -> Result<Option<Beat>, StoryError> {
        while self.end.is_none() {
            let record = match self.records.next() {
                Some(Ok(record)) => record,
                Some(Err(error)) if error.leaves_good_records() => {
                    self.end = Some(End::Early(error));
                    break;
                }
                Some(Err(error)) => return Err(error.into()),
                None => break,
            };
            match record.event {
                Event::Server(info) => self.meet(*info),
                Event::Truth(sample) if sample.header.world == self.world => self.learn(sample),
                Event::Frame(sample) if sample.header.world == self.world => {
                    let beat = self.beat(&sample)?;
                    let told = beat.and_then(|beat| self.held.replace(beat));
                    if told.is_some() {
                        return Ok(told);
                    }
                }
                Event::Truth(_) | Event::Frame(_) => {}
            }
        }
        Ok(self.held.take())
    }

    /// Another process simulates from here on: what was known of its worlds counts no more.
    fn meet(&mut self, info: ServerInfo) {
        self.last = None;
        self.truths.clear();
        match &self.server {
            Some(first) if kind(first) != kind(&info) => self.end = Some(End::OtherWorlds),
            Some(_) => {}
            None => self.server = Some(info),
        }
    }

    fn learn(&mut self, sample: Sample<TruthHeader>) {
        let header = &sample.header;
        let is_of = |beat: &&mut Beat| is_of(header, &beat.result);
        match self.held.as_mut().filter(is_of) {
            Some(beat) => beat.truth = beat.truth.take().or_else(|| states(&sample)),
            None => {
                let n_cells = sample.payload.len();
                self.truths.push_back(sample);
                if self.truths.len() * n_cells > MOST_AHEAD {
                    self.truths.pop_front();
                }
            }
        }
    }

    /// `None` for a frame that is published again.
    fn beat(&mut self, sample: &Sample<FrameHeader>) -> Result<Option<Beat>, StoryError> {
        let result = sample.header.result;
        let now = place(&result);
        if self.last == Some(now) {
            return Ok(None);
        }
        let link = match self.last.replace(now) {
            Some((episode, step)) if episode == now.0 && step < now.1 => Link::Follows {
                n_lost: now.1 - step - 1,
            },
            _ => Link::Begins,
        };
        let n_observations = self.server.as_ref().map_or(0, |info| info.n_observations);
        let (frame, path) = decoded(sample, n_observations)?;
        let mut truths = self.truths.iter();
        let found = truths.position(|truth| is_of(&truth.header, &result));
        // Those before it are of frames that are not recorded.
        let truth = found.and_then(|at| self.truths.drain(..=at).next_back());
        Ok(Some(Beat {
            result,
            frame,
            path,
            truth: truth.as_ref().and_then(states),
            link,
        }))
    }
}

impl<R: Iterator<Item = Result<Record, RecordingError>>> Iterator for Story<R> {
    type Item = Result<Beat, StoryError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.next_beat().transpose()
    }
}

/// What must be alike for one filter to follow two servers' worlds.
fn kind(info: &ServerInfo) -> (usize, usize, usize, &Option<String>) {
    (info.height, info.width, info.n_observations, &info.model)
}

/// Whether hidden states are those of a step.
fn is_of(truth: &TruthHeader, result: &StepResult) -> bool {
    (truth.episode, truth.step) == place(result) && truth.seed == result.seed
}

fn place(result: &StepResult) -> (u64, u64) {
    (result.episode, result.step)
}

fn decoded(
    sample: &Sample<FrameHeader>,
    n_observations: usize,
) -> Result<(Frame, Vec<Cell>), StoryError> {
    let header = &sample.header;
    let shape = Shape::new(header.height as usize, header.width as usize)?;
    let (values, moves) = sample.payload.split_at(shape.n_cells());
    let frame = Frame::from_bytes(shape, n_observations, values)?;
    let start = match moves.is_empty() {
        true => (header.result.row, header.result.col),
        false => (header.start_row, header.start_col),
    };
    let start = Cell {
        row: start.0 as usize,
        col: start.1 as usize,
    };
    if !shape.contains(start) {
        return Err(StoryError::Robot { shape, cell: start });
    }
    let fly = |cell: &mut Cell, step: Move| {
        *cell = step.apply(*cell, shape);
        Some(*cell)
    };
    let moves = path_from_bytes(moves)?;
    let flown = moves.into_iter().scan(start, fly);
    Ok((frame, std::iter::once(start).chain(flown).collect()))
}

fn states(sample: &Sample<TruthHeader>) -> Option<Grid<u8>> {
    let dim = (sample.header.height as usize, sample.header.width as usize);
    Grid::from_shape_vec(dim, sample.payload.clone()).ok()
}
