//! The replay in a checkpoint: what was seen, five bytes a cell, and where each block starts from.

use crate::learning::checkpoint::{Bytes, Contents, Problem, Tensor};
use crate::learning::replay::{Block, Replay, Sighting};

/// Names in checkpoints.
const SIGHTINGS: &str = "replay.sightings";
const FRAMES: &str = "replay.frames";
const BLOCKS: &str = "replay.blocks";
const STARTS: &str = "replay.starts";
const OPENED: &str = "replay.opened";

/// Bytes of a sighting: its cell, little-endian, and its value.
const SIGHTING: usize = 5;

/// Numbers of a block: its own, that of the next, frames, a [`StartKind`], and its world or [`FULL`].
const BLOCK: usize = 5;

/// In place of the world of a block that is full.
const FULL: u64 = u64::MAX;

/// How a block starts.
const AT_TRACK: u64 = 0;
const TO_BE_GIVEN: u64 = 1;
const GIVEN: u64 = 2;

/// What the frames of a replay may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Form {
    /// Shape `[S, H, W]` of beliefs.
    pub belief: [usize; 3],
    /// Number of values of a seen cell.
    pub n_observations: usize,
}

impl Replay {
    /// Puts everything into a checkpoint.
    pub fn store(&self, form: Form, contents: &mut Contents) {
        let full = self
            .full
            .iter()
            .map(|(&number, block)| (FULL, number, block));
        let open = self.open.iter();
        let open = open.map(|(&world, (number, block))| (u64::from(world), *number, block));
        let blocks: Vec<(u64, u64, &Block)> = full.chain(open).collect();
        let frames = blocks.iter().flat_map(|(_, _, block)| &block.frames);
        let lengths = frames.clone().map(|frame| frame.len() as u64);
        let sightings = frames.flatten().flat_map(|sighting| {
            let [a, b, c, d] = sighting.cell.to_le_bytes();
            [a, b, c, d, sighting.value]
        });
        let starts = blocks
            .iter()
            .filter_map(|(_, _, block)| block.start.as_deref());
        let starts: Vec<&[f32]> = starts.filter(|start| !start.is_empty()).collect();
        let rows = blocks.iter().flat_map(|&(world, number, block)| {
            let start = match block.start.as_deref() {
                None => AT_TRACK,
                Some([]) => TO_BE_GIVEN,
                Some(_) => GIVEN,
            };
            [number, block.next, block.frames.len() as u64, start, world]
        });
        let [states, height, width] = form.belief;
        let starts = Tensor {
            shape: vec![starts.len(), states, height, width],
            numbers: starts.concat(),
        };
        let sightings = Bytes::of_rows(SIGHTING, sightings.collect());
        contents.bytes.insert(SIGHTINGS.into(), sightings);
        let lengths = Bytes::of_counts(lengths);
        contents.bytes.insert(FRAMES.into(), lengths);
        contents.bytes.insert(BLOCKS.into(), Bytes::of_counts(rows));
        contents.tensors.insert(STARTS.into(), starts);
        let opened = self.n_opened.to_string();
        contents.texts.insert(OPENED.into(), opened);
    }

    /// Takes what [`Self::store`] put there, into a replay of the same block length.
    ///
    /// # Errors
    /// [`Problem`] names what is not of that form; nothing was changed then.
    pub fn restore(&mut self, form: Form, contents: &Contents) -> Result<(), Problem> {
        let mut stored = Stored::open(form, contents)?;
        let mut replay = Self {
            block_length: self.block_length,
            max_blocks: self.max_blocks,
            full: Default::default(),
            open: Default::default(),
            n_opened: contents.count(OPENED)?,
        };
        for row in contents.counts(BLOCKS)?.chunks(BLOCK) {
            let &[number, next, n_frames, start, world] = row else {
                return Err(wrong(BLOCKS, "rows of five numbers", row.len()));
            };
            if number >= replay.n_opened {
                return Err(wrong(BLOCKS, "numbers of blocks that were opened", number));
            }
            let block = Block {
                frames: stored.frames(n_frames)?,
                start: stored.start(start)?,
                next,
            };
            replay.put(world, number, block)?;
        }
        while replay.full.len() > replay.max_blocks {
            replay.full.pop_first();
        }
        stored.is_used_up()?;
        *self = replay;
        Ok(())
    }

    fn put(&mut self, world: u64, number: u64, block: Block) -> Result<(), Problem> {
        let (n_frames, length) = (block.frames.len(), self.block_length);
        if (world == FULL && n_frames != length) || n_frames > length {
            let expected = format!("blocks of {length} frames");
            return Err(wrong(BLOCKS, &expected, n_frames));
        }
        let former = match u32::try_from(world) {
            Ok(world) => self.open.insert(world, (number, block)).is_some(),
            Err(_) if world == FULL => self.full.insert(number, block).is_some(),
            Err(_) => return Err(wrong(BLOCKS, "numbers of worlds", world)),
        };
        match former {
            false => Ok(()),
            true => Err(wrong(BLOCKS, "each block once", format!("{number} twice"))),
        }
    }
}

/// What is still to be read.
struct Stored<'a> {
    form: Form,
    lengths: std::vec::IntoIter<u64>,
    sightings: &'a [[u8; SIGHTING]],
    starts: &'a [f32],
}

impl<'a> Stored<'a> {
    fn open(form: Form, contents: &'a Contents) -> Result<Self, Problem> {
        let (sightings, _) = contents.rows(SIGHTINGS, SIGHTING)?.as_chunks();
        let [states, height, width] = form.belief;
        let starts = contents.tensors.get(STARTS);
        let n_starts = starts.and_then(|starts| starts.shape.first().copied());
        let shape = [n_starts.unwrap_or(0), states, height, width];
        Ok(Self {
            form,
            lengths: contents.counts(FRAMES)?.into_iter(),
            sightings,
            starts: contents.tensor(STARTS, &shape)?,
        })
    }

    fn frames(&mut self, n_frames: u64) -> Result<Vec<Vec<Sighting>>, Problem> {
        (0..n_frames).map(|_| self.frame()).collect()
    }

    fn frame(&mut self) -> Result<Vec<Sighting>, Problem> {
        let missing = || wrong(FRAMES, "the frames of all blocks", "fewer");
        let length = self.lengths.next().ok_or_else(missing)?;
        let missing = || wrong(SIGHTINGS, "the cells of all frames", "fewer");
        let length = usize::try_from(length).map_err(|_| missing())?;
        let (sightings, rest) = self
            .sightings
            .split_at_checked(length)
            .ok_or_else(missing)?;
        self.sightings = rest;
        sightings
            .iter()
            .map(|&bytes| self.sighting(bytes))
            .collect()
    }

    fn sighting(&self, [a, b, c, d, value]: [u8; SIGHTING]) -> Result<Sighting, Problem> {
        let cell = u32::from_le_bytes([a, b, c, d]);
        let [_, height, width] = self.form.belief;
        if cell as usize >= height * width {
            let expected = format!("cells of {height} x {width}");
            return Err(wrong(SIGHTINGS, &expected, cell));
        }
        if usize::from(value) >= self.form.n_observations {
            let expected = format!("values below {}", self.form.n_observations);
            return Err(wrong(SIGHTINGS, &expected, value));
        }
        Ok(Sighting { cell, value })
    }

    fn start(&mut self, kind: u64) -> Result<Option<Vec<f32>>, Problem> {
        match kind {
            AT_TRACK => Ok(None),
            TO_BE_GIVEN => Ok(Some(Vec::new())),
            GIVEN => {
                let missing = || wrong(STARTS, "the beliefs of all blocks", "fewer");
                let length = self.form.belief.iter().product();
                let (start, rest) = self.starts.split_at_checked(length).ok_or_else(missing)?;
                self.starts = rest;
                Ok(Some(start.to_vec()))
            }
            other => Err(wrong(BLOCKS, "starts of kind 0 to 2", other)),
        }
    }

    fn is_used_up(&self) -> Result<(), Problem> {
        let left = [
            (FRAMES, self.lengths.len()),
            (SIGHTINGS, self.sightings.len()),
            (STARTS, self.starts.len()),
        ];
        match left.into_iter().find(|&(_, left)| left > 0) {
            None => Ok(()),
            Some((name, left)) => Err(wrong(name, "those of the blocks", format!("{left} more"))),
        }
    }
}

fn wrong(name: &str, expected: &str, got: impl ToString) -> Problem {
    Problem::Value {
        name: name.into(),
        expected: expected.into(),
        got: got.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Frame, Shape};

    const FORM: Form = Form {
        belief: [2, 1, 3],
        n_observations: 9,
    };

    fn frame(value: u8) -> Frame {
        let shape = Shape::new(1, 3).expect("test shape");
        Frame::from_bytes(shape, 9, &[255, value, value]).expect("test frame")
    }

    /// Two worlds' frames in turn, blocks of 2, room for 3.
    fn replay(n_frames: u8) -> Replay {
        let mut replay = Replay::new(2, 7);
        replay.begin(0);
        replay.begin(5);
        (0..n_frames).for_each(|value| push(&mut replay, value));
        replay
    }

    fn push(replay: &mut Replay, value: u8) {
        for world in [0, 5] {
            if replay.wants_belief(world) {
                replay.give_belief(world, &[0.1 * f32::from(value); 6]);
            }
            replay.push(world, &frame(value));
        }
    }

    fn stored(replay: &Replay) -> Contents {
        let mut contents = Contents::default();
        replay.store(FORM, &mut contents);
        contents
    }

    #[test]
    fn a_replay_comes_back_and_goes_on_alike() {
        for n_frames in 0..9 {
            let mut before = replay(n_frames);
            let mut after = Replay::new(2, 7);
            after.restore(FORM, &stored(&before)).expect("whole");
            for value in 0..4 {
                assert_eq!(before, after, "{n_frames} frames, then {value}");
                push(&mut before, value);
                push(&mut after, value);
            }
        }
    }

    #[test]
    fn what_no_replay_holds_is_named() {
        let check = |change: fn(&mut Contents), words: &str| {
            let mut contents = stored(&replay(5));
            change(&mut contents);
            let mut replay = Replay::new(2, 7);
            let error = replay.restore(FORM, &contents).expect_err(words);
            assert_eq!(error.to_string(), words);
            assert_eq!(replay, Replay::new(2, 7));
        };
        fn bytes<'a>(contents: &'a mut Contents, name: &str) -> &'a mut Bytes {
            contents.bytes.get_mut(name).expect("stored")
        }
        check(
            |c| bytes(c, SIGHTINGS).bytes[0] = 3,
            "replay.sightings: expected cells of 1 x 3, got 3",
        );
        check(
            |c| bytes(c, SIGHTINGS).bytes[4] = 9,
            "replay.sightings: expected values below 9, got 9",
        );
        check(
            |c| bytes(c, FRAMES).bytes[0] = 1,
            "replay.sightings: expected those of the blocks, got 1 more",
        );
        check(
            |c| bytes(c, BLOCKS).bytes[0] = 77,
            "replay.blocks: expected numbers of blocks that were opened, got 77",
        );
        check(
            |c| bytes(c, BLOCKS).bytes[16] = 3,
            "replay.blocks: expected blocks of 2 frames, got 3",
        );
        check(
            |c| bytes(c, BLOCKS).bytes[24] = 3,
            "replay.blocks: expected starts of kind 0 to 2, got 3",
        );
        check(
            |c| c.tensors.get_mut(STARTS).expect("stored").shape[3] = 4,
            "replay.starts: expected shape [4, 2, 1, 3], got [4, 2, 1, 4]",
        );
    }
}
