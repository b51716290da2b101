//! Recent frames of several robots, with what each had seen before.
//!
//! A *block* is what one robot saw in some steps in a row. It keeps what had been seen before its first frame, so that all
//! that was known before any of its frames is found by going through those before it.

use crate::checkpoint::{check, check_numbers};
use anyhow::Result;
use emberwatch_model::grid::Probabilities;
use emberwatch_model::{Frame, Shape};
use emberwatch_network::{Lesson, Sightings};
use ndarray::s;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;

/// Frames of a block, at most.
const BLOCK_FRAMES: usize = 256;

/// A frame: the cells that it shows, by row-major index, with their values, and what the filter that the network corrects
/// predicted of each, if there is one, `[cells, O]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SeenFrame {
    cells: Vec<(usize, u8)>,
    base: Vec<f32>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Block {
    before: Sightings,
    frames: Vec<SeenFrame>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LessonReplay {
    max_frames: usize,
    /// Blocks that are full or whose track has ended, oldest first.
    full: VecDeque<Block>,
    /// The block of each robot's frames.
    open: BTreeMap<u32, Block>,
}

impl LessonReplay {
    /// Keeps `max_frames` frames beside those of the last blocks.
    pub fn new(max_frames: usize) -> Self {
        Self {
            max_frames,
            full: VecDeque::new(),
            open: BTreeMap::new(),
        }
    }

    /// Begins a new track of a robot, on a world of which nothing was seen.
    pub fn begin(&mut self, robot: u32, shape: Shape) {
        self.open(robot, Sightings::new(shape));
    }

    fn open(&mut self, robot: u32, before: Sightings) {
        let frames = Vec::new();
        let last = self.open.insert(robot, Block { before, frames });
        self.full.extend(last);
        let mut n_frames: usize = self.full.iter().map(|block| block.frames.len()).sum();
        while n_frames > self.max_frames {
            let oldest = self.full.pop_front();
            n_frames -= oldest.map_or(0, |block| block.frames.len());
        }
    }

    /// Ends the tracks of all robots but these.
    pub fn end_others(&mut self, robots: &Range<u32>) {
        let open = std::mem::take(&mut self.open);
        let (own, ended): (_, BTreeMap<_, _>) = open
            .into_iter()
            .partition(|(robot, _)| robots.contains(robot));
        self.open = own;
        self.full.extend(ended.into_values());
    }

    /// Adds the next frame of a robot. `base`: what the filter that the network corrects predicted, `[O, H, W]`.
    ///
    /// # Panics
    /// If its track was not begun.
    pub fn push(&mut self, robot: u32, frame: &Frame, base: Option<&Probabilities>) {
        let block = self.open.get_mut(&robot).expect("a track that was begun");
        let shape = block.before.shape();
        let cells: Vec<_> = frame.observed().collect();
        let of_cell = |base: &Probabilities, cell: usize| {
            let at = shape.cell(cell);
            base.slice(s![.., at.row, at.col]).to_vec()
        };
        let base = base.iter();
        let base = base.flat_map(|base| cells.iter().flat_map(|it| of_cell(base, it.0)));
        let base = base.collect();
        block.frames.push(SeenFrame { cells, base });
        if block.frames.len() >= BLOCK_FRAMES {
            let before = block.before_frame(BLOCK_FRAMES);
            self.open(robot, before);
        }
    }

    /// All that a robot has seen by now.
    ///
    /// # Panics
    /// If its track was not begun.
    pub fn present(&self, robot: u32) -> Sightings {
        let block = &self.open[&robot];
        block.before_frame(block.frames.len())
    }

    /// Frames drawn from all alike, but those that show nothing; fewer than `n` where there are such.
    pub fn lessons(&self, n: usize, rng: &mut ChaCha8Rng) -> Vec<Lesson> {
        let blocks = || self.full.iter().chain(self.open.values());
        let n_frames: usize = blocks().map(|block| block.frames.len()).sum();
        let mut lesson = || {
            let mut at = rng.next_u64().checked_rem(n_frames as u64)? as usize;
            for block in blocks() {
                match block.frames.get(at) {
                    Some(seen) if seen.cells.is_empty() => return None,
                    Some(seen) => {
                        return Some(Lesson {
                            before: block.before_frame(at),
                            frame: seen.cells.clone(),
                            base: seen.base.clone(),
                        });
                    }
                    None => at -= block.frames.len(),
                }
            }
            None
        };
        (0..n).filter_map(|_| lesson()).collect()
    }

    /// Forgets all frames.
    pub fn forget(&mut self) {
        *self = Self::new(self.max_frames);
    }

    /// Goes on from another replay, with room of its own.
    pub fn resume(&mut self, other: Self) {
        (self.full, self.open) = (other.full, other.open);
    }

    /// Refuses one that is not of a grid and of so many observations, or lacks a robot. `has_base`: whether a filter's
    /// predictions belong to the frames.
    pub fn check(
        &self,
        shape: Shape,
        n_observations: usize,
        has_base: bool,
        mut robots: impl Iterator<Item = u32>,
    ) -> Result<()> {
        let (name, expected) = (
            "replay",
            format!("{n_observations} observations on {shape}"),
        );
        for block in self.full.iter().chain(self.open.values()) {
            let fits = block.before.are_of(shape, n_observations);
            check(fits, name, &expected, "others")?;
            for seen in &block.frames {
                for &(cell, value) in &seen.cells {
                    let fits = cell < shape.n_cells() && usize::from(value) < n_observations;
                    check(fits, name, &expected, format!("{value} in cell {cell}"))?;
                }
                let n = if has_base {
                    seen.cells.len() * n_observations
                } else {
                    0
                };
                check_numbers("replay.base", &seen.base, n)?;
            }
        }
        let lacking = robots.find(|robot| !self.open.contains_key(robot));
        let got = lacking.map_or(String::new(), |robot| format!("none of robot {robot}"));
        check(lacking.is_none(), name, "a track of each robot", got)
    }
}

impl Block {
    /// What had been seen before one of its frames.
    fn before_frame(&self, at: usize) -> Sightings {
        let mut sightings = self.before.clone();
        for frame in &self.frames[..at] {
            for &(cell, value) in &frame.cells {
                sightings.see_cell(cell, value);
            }
            sightings.pass();
        }
        sightings
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::randomness::{Purpose, stream};

    fn shape() -> Shape {
        Shape::new(2, 2).expect("test shape")
    }

    /// Robots 3 and 4 see the steps' numbers, in cells of their own.
    fn replay(n_steps: usize, max_frames: usize) -> LessonReplay {
        let mut replay = LessonReplay::new(max_frames);
        (3..5).for_each(|robot| replay.begin(robot, shape()));
        for step in 0..n_steps {
            for robot in [3, 4] {
                let mut frame = Frame::empty(shape());
                if step % 10 != 9 {
                    frame.observe(robot as usize - 3, (step % 100) as u8);
                }
                replay.push(robot, &frame, None);
            }
        }
        replay
    }

    #[test]
    fn a_lesson_is_a_frame_after_all_that_its_robot_saw_before() {
        let replay = replay(300, 1000);
        assert_eq!(
            (replay.full.len(), replay.present(3).last(0)),
            (2, Some((98, 2)))
        );
        let lessons = replay.lessons(500, &mut stream(1, Purpose::Replay, 0));
        assert!((400..500).contains(&lessons.len()), "a tenth shows nothing");
        for Lesson { before, frame, .. } in lessons {
            let (cell, value) = frame[0];
            match before.last(cell) {
                Some((last, age)) => assert_eq!((u32::from(last) + age) % 100, u32::from(value)),
                None => assert_eq!(value, 0),
            }
            assert_eq!(before.last(1 - cell), None);
        }
        let none = LessonReplay::new(9).lessons(5, &mut stream(1, Purpose::Replay, 0));
        assert!(none.is_empty());
    }

    #[test]
    fn the_oldest_blocks_go_and_others_are_refused() {
        assert_eq!(replay(1100, 1000).full.len(), 3);
        let replay = replay(300, 1000);
        let check = |n_observations, robots: [u32; 2]| {
            let check = replay.check(shape(), n_observations, false, robots.into_iter());
            check.map_err(|error| error.to_string())
        };
        assert_eq!(check(100, [3, 4]), Ok(()));
        for (n_observations, robots, words) in [
            (98, [3, 4], "replay: expected 98 observations on 2"),
            (
                100,
                [4, 5],
                "replay: expected a track of each robot, got none of robot 5",
            ),
        ] {
            let error = check(n_observations, robots).expect_err(words);
            assert!(error.starts_with(words), "{error}");
        }
    }
}
