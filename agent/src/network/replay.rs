//! The rolling memory of frames that the network learns from (paper section III.B).

use super::window::Window;
use protocol::frame::Frame;
use protocol::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use std::collections::VecDeque;

/// The last frames of one world, oldest first.
#[derive(Debug, Clone)]
pub struct Replay {
    capacity: usize,
    frames: VecDeque<Frame>,
}

impl Replay {
    /// An empty memory of `capacity` frames. (The authors': 5,000.)
    pub fn new(capacity: usize) -> Self {
        Self {
            capacity,
            frames: VecDeque::with_capacity(capacity),
        }
    }

    /// Remembers a frame, and forgets the oldest if there are too many.
    pub fn push(&mut self, frame: Frame) {
        if self.frames.len() == self.capacity {
            self.frames.pop_front();
        }
        self.frames.push_back(frame);
    }

    /// Frames remembered.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether nothing is remembered.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Consecutive frames from a random one on, those of an update under a seed; `None` while there are
    /// fewer than `length`.
    pub fn window(&self, length: usize, seed: u64, update: u64) -> Option<Window> {
        let n_starts = (self.len() + 1).checked_sub(length).filter(|&n| n > 0)?;
        let mut rng = stream(seed, Purpose::Replay, update);
        let first = (rng.next_u64() % n_starts as u64) as usize;
        Some(Window::new(self.frames.range(first..first + length)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::grid::Shape;

    #[test]
    fn windows_are_consecutive_and_reach_every_frame() {
        let mut replay = Replay::new(8);
        for cell in 0..20 {
            assert!(cell > 2 || replay.window(4, 0, 0).is_none());
            let mut frame = Frame::empty(Shape::new(4, 5).expect("valid shape"));
            frame.observe(cell, 1);
            replay.push(frame);
        }
        let mut seen = [false; 20];
        for update in 0..100 {
            let window = replay.window(4, 0, update).expect("eight frames");
            let cell = |frame| {
                let visit = window.visits(frame)[0];
                usize::from(visit.row) * 5 + usize::from(visit.col)
            };
            assert!((1..4).all(|frame| cell(frame) == cell(0) + frame));
            seen[cell(0)..=cell(3)].fill(true);
        }
        assert!((0..20).all(|cell| seen[cell] == (cell >= 12)), "{seen:?}");
    }
}
