//! A replay buffer for the neural belief: recent frames of several robots, and for each frame the *sightings* before
//! it, which are the latest observations of every cell.
//!
//! A *block* contains consecutive frames of one robot. It stores the sightings before its first frame. The sightings
//! before a later frame are computed from the stored sightings and the frames in between.

use emberwatch_model::grid::Probabilities;
use emberwatch_model::{Frame, Shape};
use emberwatch_network::{Lesson, Sightings};
use ndarray::s;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use std::collections::{BTreeMap, VecDeque};

const BLOCK_FRAMES: usize = 256;

/// A frame: its observed cells (row-major index and value), and the corrected filter's predictions for these cells,
/// `[cells, O]`, if there is a filter.
#[derive(Debug, Clone, PartialEq)]
struct SeenFrame {
    cells: Vec<(usize, u8)>,
    base: Vec<f32>,
}

#[derive(Debug, Clone, PartialEq)]
struct Block {
    before: Sightings,
    frames: Vec<SeenFrame>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct LessonReplay {
    max_frames: usize,
    /// Blocks that are full or whose track has ended, oldest first.
    full: VecDeque<Block>,
    open: BTreeMap<u32, Block>,
}

impl LessonReplay {
    /// Creates a buffer for `max_frames` frames, not counting the open blocks.
    pub fn new(max_frames: usize) -> Self {
        Self {
            max_frames,
            full: VecDeque::new(),
            open: BTreeMap::new(),
        }
    }

    /// Begins a new track for a robot, without sightings.
    pub fn start_track(&mut self, robot: u32, shape: Shape) {
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

    /// Adds a robot's next frame. `base` is the distribution over observations that the corrected filter predicted,
    /// `[O, H, W]`.
    ///
    /// # Panics
    /// If the robot has no track.
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

    /// Returns a robot's sightings so far.
    ///
    /// # Panics
    /// If the robot has no track.
    pub fn present(&self, robot: u32) -> Sightings {
        let block = &self.open[&robot];
        block.before_frame(block.frames.len())
    }

    /// Draws `n` frames uniformly. Frames without observed cells are skipped, so that the result may be shorter.
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
}

impl Block {
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

    /// Robots 3 and 4 observe the step number, each in a different cell.
    fn replay(n_steps: usize, max_frames: usize) -> LessonReplay {
        let mut replay = LessonReplay::new(max_frames);
        (3..5).for_each(|robot| replay.start_track(robot, shape()));
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
    fn a_lesson_contains_all_earlier_sightings_of_its_robot() {
        let replay = replay(300, 1000);
        assert_eq!(replay.full.len(), 2);
        assert_eq!(replay.present(3).last(0), Some((98, 2)));
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
    fn old_blocks_are_dropped() {
        assert_eq!(replay(1100, 1000).full.len(), 3);
    }
}
