//! A world's last frames, kept so that an agent that takes over can make up its belief from them.

use protocol::Frame;
use protocol::frame::UNOBSERVED;
use protocol::message::StepResult;
use std::collections::VecDeque;

/// The frames of consecutive steps, the last one the world's present; bounded.
#[derive(Debug, Clone, Default)]
pub struct History {
    capacity: usize,
    seen: VecDeque<Seen>,
}

/// What one step showed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Seen {
    /// The step's result.
    pub result: StepResult,
    /// The observed cells, row-major indices; empty where every cell was observed.
    pub cells: Vec<u32>,
    /// What was observed there.
    pub values: Vec<u8>,
}

impl History {
    /// Room for the frames of this many steps.
    pub fn new(capacity: usize) -> Self {
        Self {
            capacity,
            seen: VecDeque::new(),
        }
    }

    /// Those frames, the oldest first.
    pub fn with(capacity: usize, seen: impl IntoIterator<Item = Seen>) -> Self {
        let mut history = Self::new(capacity);
        history.seen.extend(seen);
        while history.seen.len() > capacity {
            history.seen.pop_front();
        }
        history
    }

    /// Keeps a step; forgets the oldest if there is no room.
    pub fn push(&mut self, result: &StepResult, frame: &Frame, visited: Option<&[usize]>) {
        if self.capacity == 0 {
            return;
        }
        let mut seen = if self.seen.len() < self.capacity {
            Seen::default()
        } else {
            self.seen.pop_front().unwrap_or_default()
        };
        let bytes = frame.as_bytes();
        seen.result = *result;
        seen.cells.clear();
        seen.values.clear();
        match visited {
            Some(cells) => {
                seen.cells.extend(cells.iter().map(|&cell| cell as u32));
                seen.values.extend(cells.iter().map(|&cell| bytes[cell]));
            }
            None => seen.values.extend_from_slice(bytes),
        }
        self.seen.push_back(seen);
    }

    /// Those kept, the oldest first.
    pub fn all(&self) -> impl ExactSizeIterator<Item = &Seen> {
        self.seen.iter()
    }

    /// What step k showed, if it is kept.
    pub fn step(&self, step: u64) -> Option<&Seen> {
        let oldest = self.seen.front()?.result.step;
        self.seen
            .get(usize::try_from(step.checked_sub(oldest)?).ok()?)
    }
}

impl Seen {
    /// Writes the frame, one byte per cell of `frame`.
    pub fn write_frame(&self, frame: &mut [u8]) {
        if self.cells.is_empty() && !self.values.is_empty() {
            frame.copy_from_slice(&self.values);
            return;
        }
        frame.fill(UNOBSERVED);
        for (&cell, &value) in self.cells.iter().zip(&self.values) {
            frame[cell as usize] = value;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::Shape;

    #[test]
    fn the_last_frames_are_kept_as_they_were() {
        let shape = Shape::new(2, 3).expect("test shape");
        let mut history = History::new(3);
        let mut frames = Vec::new();
        for step in 0..5 {
            let mut frame = Frame::empty(shape);
            let cells = [step as usize % 6, 5];
            for cell in cells {
                frame.observe(cell, (cell % 3) as u8);
            }
            let result = StepResult {
                step,
                ..StepResult::default()
            };
            let visited = (step != 4).then_some(&cells[..]);
            if visited.is_none() {
                (0..6).for_each(|cell| frame.observe(cell, 1));
            }
            history.push(&result, &frame, visited);
            frames.push(frame);
        }
        assert_eq!(history.all().len(), 3);
        assert!(history.step(1).is_none() && history.step(5).is_none());
        for step in 2..5 {
            let mut bytes = [0; 6];
            let seen = history.step(step).expect("kept");
            seen.write_frame(&mut bytes);
            assert_eq!(seen.result.step, step);
            assert_eq!(bytes, frames[step as usize].as_bytes());
        }
        let mut nothing = History::new(0);
        nothing.push(&StepResult::default(), &frames[0], None);
        assert_eq!(nothing.all().len(), 0);
    }
}
