//! A world's last frames, kept so that the next agent can compute its belief from them.

use protocol::Frame;
use protocol::frame::UNOBSERVED;
use protocol::message::StepResult;
use std::collections::VecDeque;

/// Least room for a world's frames, bytes: full frames share it, however many steps are to be kept.
const LEAST_ROOM: usize = 1 << 20;

/// The frames of consecutive steps, the last one the world's present; bounded in steps and in bytes.
#[derive(Debug, Clone)]
pub struct History {
    n_steps: usize,
    /// Bytes that the frames may take.
    room: usize,
    n_bytes: usize,
    steps: VecDeque<PastStep>,
}

/// What one step showed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PastStep {
    /// The step's result.
    pub result: StepResult,
    /// The observed cells, row-major indices; empty where every cell was observed.
    pub cells: Vec<u32>,
    /// What was observed there.
    pub values: Vec<u8>,
}

impl History {
    /// Room for the frames of `n_steps` paths, at least for the present one.
    pub fn new(n_steps: usize, n_moves: usize) -> Self {
        let n_steps = n_steps.max(1);
        Self {
            n_steps,
            room: LEAST_ROOM.max(n_steps.saturating_mul(size_of::<PastStep>() + 5 * n_moves)),
            n_bytes: 0,
            steps: VecDeque::new(),
        }
    }

    /// Keeps a step; forgets the oldest if there is no room.
    pub fn push(&mut self, result: &StepResult, frame: &Frame, visited: Option<&[usize]>) {
        let mut past = self.make_room().unwrap_or_default();
        let bytes = frame.as_bytes();
        past.result = *result;
        past.cells.clear();
        past.values.clear();
        match visited {
            Some(cells) => {
                past.cells.extend(cells.iter().map(|&cell| cell as u32));
                past.values.extend(cells.iter().map(|&cell| bytes[cell]));
            }
            None => past.values.extend_from_slice(bytes),
        }
        self.keep(past);
    }

    /// Keeps a step, and as many before it as there is room for.
    pub fn keep(&mut self, past: PastStep) {
        self.n_bytes += past.n_bytes();
        self.steps.push_back(past);
        while self.steps.len() > 1 && (self.steps.len() > self.n_steps || self.n_bytes > self.room)
        {
            self.forget();
        }
    }

    /// Removes the oldest step if another one would be too many.
    fn make_room(&mut self) -> Option<PastStep> {
        (self.steps.len() >= self.n_steps).then(|| self.forget())?
    }

    fn forget(&mut self) -> Option<PastStep> {
        let past = self.steps.pop_front()?;
        self.n_bytes -= past.n_bytes();
        Some(past)
    }

    /// Bytes of all frames.
    pub fn n_bytes(&self) -> usize {
        self.n_bytes
    }

    /// The steps that are kept, the oldest first.
    pub fn all(&self) -> impl ExactSizeIterator<Item = &PastStep> {
        self.steps.iter()
    }

    /// What step k showed, if it is kept.
    pub fn step(&self, step: u64) -> Option<&PastStep> {
        let oldest = self.steps.front()?.result.step;
        self.steps
            .get(usize::try_from(step.checked_sub(oldest)?).ok()?)
    }
}

impl PastStep {
    fn n_bytes(&self) -> usize {
        size_of::<Self>() + 4 * self.cells.len() + self.values.len()
    }

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
        let mut history = History::new(3, 6);
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
            let past = history.step(step).expect("kept");
            past.write_frame(&mut bytes);
            assert_eq!(past.result.step, step);
            assert_eq!(bytes, frames[step as usize].as_bytes());
        }
        // At least the present is kept, and no more than there is room for.
        let mut present = History::new(0, 6);
        frames
            .iter()
            .for_each(|frame| present.push(&StepResult::default(), frame, None));
        assert_eq!(present.all().len(), 1);
        let large = Frame::empty(Shape::new(512, 1024).expect("test shape"));
        let mut few = History::new(256, 64);
        for _ in 0..5 {
            few.push(&StepResult::default(), &large, None);
        }
        assert_eq!(
            (few.all().len(), few.n_bytes() / large.as_bytes().len()),
            (1, 1)
        );
    }
}
