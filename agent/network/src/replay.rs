//! The replay buffer of frames that the autoencoder learns from (paper section III.B).

use crate::window::Window;
use emberwatch_model::frame::Frame;
use emberwatch_model::randomness::{Purpose, stream};
use rand_chacha::rand_core::Rng;
use std::collections::VecDeque;
use std::ops::Range;

/// The last frames of one robot, the oldest first. A *track* is a sequence of frames without gaps.
#[derive(Debug, Clone)]
pub struct FrameReplay {
    capacity: usize,
    frames: VecDeque<Frame>,
    /// Number of frames added so far, including removed frames.
    n_pushed: u64,
    /// For each track except the oldest, the number of its first frame, counted from the first frame ever added.
    begins: VecDeque<u64>,
}

impl FrameReplay {
    /// Creates an empty buffer for `capacity` frames. The authors use 5,000.
    pub fn new(capacity: usize) -> Self {
        Self {
            capacity,
            frames: VecDeque::new(),
            n_pushed: 0,
            begins: VecDeque::new(),
        }
    }

    /// Starts a new track. No window spans frames of two tracks.
    pub fn start_track(&mut self) {
        self.begins.push_back(self.n_pushed);
    }

    /// Adds a frame. Removes the oldest if the buffer is full.
    pub fn push(&mut self, frame: Frame) {
        if self.frames.len() == self.capacity {
            self.frames.pop_front();
        }
        self.frames.push_back(frame);
        self.n_pushed += 1;
        let oldest = self.n_oldest();
        while self.begins.front().is_some_and(|&begin| begin <= oldest) {
            self.begins.pop_front();
        }
    }

    fn n_oldest(&self) -> u64 {
        self.n_pushed - self.frames.len() as u64
    }

    fn starts(&self, length: usize) -> Vec<Range<usize>> {
        let oldest = self.n_oldest();
        let begins = self.begins.iter().map(|begin| (begin - oldest) as usize);
        let edges: Vec<usize> = [0].into_iter().chain(begins).chain([self.len()]).collect();
        let starts = |track: &[usize]| track[0]..(track[1] + 1).saturating_sub(length);
        let tracks = edges.windows(2).map(starts);
        tracks.filter(|starts| !starts.is_empty()).collect()
    }

    /// Returns the number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Returns whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Returns `length` consecutive frames of one track, from a random start; `None` if no track is as long.
    pub fn window(&self, length: usize, seed: u64, update: u64) -> Option<Window> {
        let starts: Vec<usize> = self.starts(length).into_iter().flatten().collect();
        let mut rng = stream(seed, Purpose::Replay, update);
        let choice = rng.next_u64().checked_rem(starts.len() as u64)?;
        let first = starts[choice as usize];
        Some(Window::new(self.frames.range(first..first + length)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::grid::Shape;

    #[test]
    fn windows_are_consecutive_and_reach_every_frame() {
        let mut replay = FrameReplay::new(8);
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

    #[test]
    fn no_window_spans_two_tracks() {
        let mut replay = FrameReplay::new(10);
        let frame = Frame::empty(Shape::new(4, 5).expect("valid shape"));
        replay.start_track();
        for number in 0..30 {
            if [7, 21, 25, 26].contains(&number) {
                replay.start_track();
            }
            replay.push(frame.clone());
        }
        // Indices 0 to 9 contain frames 20 to 29.
        assert_eq!(replay.starts(1), [0..1, 1..5, 5..6, 6..10]);
        assert_eq!(replay.starts(4), [1..2, 6..7]);
        assert!(replay.window(5, 0, 0).is_none());
    }
}
