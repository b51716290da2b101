//! A replay buffer for sequences: recent frames of one or more robots, in blocks.
//!
//! A *track* is the sequence of frames of one robot in one episode, without gaps. It is divided into blocks of equal
//! length; the last block may be shorter. A block stores the belief before its first frame. A learner updates this
//! belief whenever it has processed the preceding block. A block is replayed once it is full or its track has ended.
//! When the buffer is full, the oldest blocks are dropped.

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_gradient::Sighting;
use emberwatch_model::Frame;
use std::collections::BTreeMap;

/// Consecutive frames of one track, at least one.
#[derive(Debug, Clone, PartialEq)]
pub struct Block {
    pub frames: Vec<Vec<Sighting>>,
    /// The belief before the first frame, shape `[S, H, W]`; `None` at the start of a track.
    pub start: Option<Vec<f32>>,
    next: u64,
}

#[derive(Debug, Clone, PartialEq)]
pub struct BlockReplay {
    block_length: usize,
    max_frames: usize,
    full: BTreeMap<u64, Block>,
    open: BTreeMap<u32, (u64, Block)>,
    n_opened: u64,
}

impl BlockReplay {
    /// Creates a buffer for `max_frames` frames in blocks of at most `block_length`. At least one block is kept.
    pub fn new(block_length: usize, max_frames: usize) -> Self {
        Self {
            block_length,
            max_frames,
            full: BTreeMap::new(),
            open: BTreeMap::new(),
            n_opened: 0,
        }
    }

    /// Begins a new track for a robot, and ends the robot's previous track.
    pub fn start_track(&mut self, robot: u32) {
        let block = self.new_block(None);
        if let Some((number, last)) = self.open.insert(robot, block)
            && !last.frames.is_empty()
        {
            self.keep(number, last);
        }
    }

    /// Adds the next frame of a robot's track. `before` is the belief before the frame, if there is one.
    ///
    /// # Panics
    /// If the robot has no track.
    pub fn push(&mut self, robot: u32, frame: &Frame, before: Option<&Belief>) {
        let sighting = |(cell, value)| Sighting {
            cell: cell as u32,
            value,
        };
        let sightings = frame.observed().map(sighting).collect();
        let (_, block) = self.open.get_mut(&robot).expect("a track that was begun");
        if block.frames.is_empty() && block.start.is_some() {
            block.start = before.map(|belief| belief.as_slice().to_vec());
        }
        block.frames.push(sightings);
        if block.frames.len() == self.block_length {
            // An empty belief is a placeholder until the block receives its first frame.
            let following = self.new_block(Some(Vec::new()));
            let next = following.0;
            if let Some((id, mut block)) = self.open.insert(robot, following) {
                block.next = next;
                self.keep(id, block);
            }
        }
    }

    pub fn n_blocks(&self) -> usize {
        self.full.len()
    }

    /// Returns the numbers of the blocks that can be replayed, oldest first.
    pub fn blocks(&self) -> impl Iterator<Item = u64> + '_ {
        self.full.keys().copied()
    }

    /// Returns a block that can be replayed. `None` if it is still open or was dropped.
    pub fn block(&self, number: u64) -> Option<&Block> {
        self.full.get(&number)
    }

    /// Stores the belief at the end of a block as the start of the track's next block, if that block can be replayed.
    pub fn hand_on(&mut self, number: u64, belief: &[f32]) {
        let Some(next) = self.full.get(&number).map(|block| block.next) else {
            return;
        };
        if let Some(block) = self.full.get_mut(&next) {
            block.start = Some(belief.to_vec());
        }
    }

    fn keep(&mut self, number: u64, block: Block) {
        self.full.insert(number, block);
        self.drop_oldest();
    }

    fn drop_oldest(&mut self) {
        let mut n_frames: usize = self.full.values().map(|block| block.frames.len()).sum();
        while n_frames > self.max_frames && self.full.len() > 1 {
            let oldest = self.full.pop_first();
            n_frames -= oldest.map_or(0, |(_, block)| block.frames.len());
        }
    }

    fn new_block(&mut self, start: Option<Vec<f32>>) -> (u64, Block) {
        let number = self.n_opened;
        self.n_opened += 1;
        let block = Block {
            frames: Vec::with_capacity(self.block_length),
            start,
            next: u64::MAX,
        };
        (number, block)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::{Probabilities, Shape};

    fn frame(value: u8) -> Frame {
        let shape = Shape::new(1, 3).expect("test shape");
        Frame::from_bytes(shape, 9, &[255, value, 255]).expect("test frame")
    }

    /// A belief about two states on three cells, different for each number.
    fn belief(number: u8) -> Belief {
        let p = f32::from(number) / 16.0;
        let states = Probabilities::from_shape_fn((2, 1, 3), |(state, _, _)| [p, 1.0 - p][state]);
        Belief::from_probabilities(states).expect("valid")
    }

    /// A buffer for 3 blocks of 2 frames, with frames of two robots in alternation.
    fn replay(n_frames: u8) -> BlockReplay {
        let mut replay = BlockReplay::new(2, 7);
        replay.start_track(0);
        replay.start_track(5);
        (0..n_frames).for_each(|value| see(&mut replay, value));
        replay
    }

    fn see(replay: &mut BlockReplay, value: u8) {
        for robot in [0, 5] {
            replay.push(robot, &frame(value), Some(&belief(value)));
        }
    }

    #[test]
    fn frames_are_stored_in_blocks_until_the_buffer_is_full() {
        let three = replay(3);
        assert!(three.blocks().eq([0, 1]));
        let block = three.block(1).expect("kept");
        let seen = |value| vec![Sighting { cell: 1, value }];
        assert_eq!(block.frames, [seen(0), seen(1)]);
        assert_eq!(block.start, None);
        assert_eq!(three.block(2), None, "not full");
        assert!(replay(6).blocks().eq([3, 4, 5]));
        let mut short = BlockReplay::new(2, 7);
        for _ in 0..9 {
            short.start_track(0);
            short.push(0, &frame(1), None);
        }
        assert!(short.blocks().eq(1..8));
    }

    #[test]
    fn beliefs_are_passed_on_along_a_track() {
        let mut replay = replay(4);
        let start =
            |replay: &BlockReplay, number| replay.block(number).and_then(|it| it.start.clone());
        let given = Some(belief(2).as_slice().to_vec());
        assert_eq!(start(&replay, 2), given);
        replay.hand_on(1, &[9.0]);
        assert_eq!(start(&replay, 2), given);
        assert_eq!(start(&replay, 3), Some(vec![9.0]));
        replay.hand_on(2, &[8.0]); // The next block is not full.
        replay.hand_on(77, &[8.0]);
    }

    #[test]
    fn a_track_ends_with_a_shorter_block() {
        let mut replay = replay(3);
        replay.start_track(0);
        replay.push(0, &frame(7), Some(&belief(7)));
        replay.push(0, &frame(8), None);
        let kept = replay.blocks().map(|number| {
            let block = replay.block(number).expect("kept");
            let start = block.start.as_deref().map(|start| start[0]);
            (number, block.frames.len(), start)
        });
        let full = |number| (number, 2, None);
        assert!(kept.eq([full(0), full(1), (2, 1, Some(0.125)), full(4)]));
        replay.hand_on(2, &[8.0]); // There is no next block.
        replay.start_track(0);
        replay.start_track(0);
        assert_eq!(replay.blocks().last(), Some(4), "no block without frames");
    }
}
