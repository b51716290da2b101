//! Recorded hidden states. A world's seed selects a sequence, the symmetry applied to it, and the recorded step at
//! which the episode begins.

use emberwatch_model::randomness::{Purpose, stream};
use emberwatch_model::{Grid, Shape};
use ndarray::{Array3, ArrayView2, Axis};
use rand::RngExt;

#[derive(Debug)]
pub struct Recorded {
    /// Each has shape `[K, H, W]`, row-major, with K at least 2.
    sequences: Vec<Array3<u8>>,
    shape: Shape,
    with_symmetries: bool,
    /// The latest recorded step at which an episode may begin.
    most_offset: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Choice {
    sequence: usize,
    symmetry: u64,
    offset: u64,
}

impl Recorded {
    /// Checks and stores the sequences. An episode begins at a recorded step in `0..=most_offset`.
    ///
    /// # Errors
    /// If an episode could begin at the last recorded step of a sequence. The error is the maximum valid offset.
    ///
    /// # Panics
    /// If there is no sequence, or a sequence has a different grid or fewer than two recorded steps.
    pub fn new(
        sequences: Vec<Array3<u8>>,
        shape: Shape,
        with_symmetries: bool,
        most_offset: u64,
    ) -> Result<Self, u64> {
        let is_right = |sequence: &Array3<u8>| {
            let (n_recorded, height, width) = sequence.dim();
            n_recorded >= 2 && (height, width) == shape.dim()
        };
        assert!(!sequences.is_empty() && sequences.iter().all(is_right));
        let recorded = Self {
            sequences,
            shape,
            with_symmetries,
            most_offset,
        };
        let possible = recorded.shortest() - 2;
        (most_offset <= possible)
            .then_some(recorded)
            .ok_or(possible)
    }

    pub fn n_sequences(&self) -> usize {
        self.sequences.len()
    }

    pub fn n_steps(&self) -> u64 {
        self.shortest() - 1 - self.most_offset
    }

    pub(super) fn last_step(&self, seed: u64) -> u64 {
        let Choice {
            sequence, offset, ..
        } = self.choice(seed);
        self.sequences[sequence].len_of(Axis(0)) as u64 - 1 - offset
    }

    /// Returns the hidden states at a step of the episode with this seed, shape `[H, W]`.
    pub(super) fn states(&self, seed: u64, step: u64) -> Grid<u8> {
        let mut states = Grid::zeros(self.shape.dim());
        self.show(seed, step, &mut states);
        states
    }

    pub(super) fn show(&self, seed: u64, step: u64, states: &mut Grid<u8>) {
        let choice = self.choice(seed);
        let recorded = self.sequences[choice.sequence].view();
        let recorded = recorded.index_axis_move(Axis(0), (choice.offset + step) as usize);
        states.assign(&turned(recorded, choice.symmetry));
    }

    fn shortest(&self) -> u64 {
        let lengths = self.sequences.iter().map(|it| it.len_of(Axis(0)) as u64);
        lengths.min().expect("invariant: there is a sequence")
    }

    fn choice(&self, seed: u64) -> Choice {
        let n_sequences = self.sequences.len() as u64;
        let n_symmetries = if !self.with_symmetries {
            1
        } else if self.shape.height() == self.shape.width() {
            8
        } else {
            4
        };
        let mut random = stream(seed, Purpose::Offset, 0);
        Choice {
            sequence: (seed % n_sequences) as usize,
            symmetry: seed / n_sequences % n_symmetries,
            offset: random.random_range(0..=self.most_offset),
        }
    }
}

/// Applies a symmetry of the square, given as three bits. Bit 2 transposes the grid. Then bit 0 reverses the order of
/// the rows, and bit 1 that of the columns.
fn turned(states: ArrayView2<'_, u8>, symmetry: u64) -> ArrayView2<'_, u8> {
    let mut turned = match symmetry & 4 {
        0 => states,
        _ => states.reversed_axes(),
    };
    for axis in [0, 1].into_iter().filter(|axis| symmetry >> axis & 1 != 0) {
        turned.invert_axis(Axis(axis));
    }
    turned
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::hidden::{Source, World};
    use ndarray::{Axis, array};
    use std::sync::Arc;
    use std::sync::atomic::AtomicBool;

    fn recorded(lengths: &[usize], (height, width): (usize, usize), symmetries: bool) -> Recorded {
        let sequence = |(index, &length): (usize, &usize)| {
            Array3::from_shape_fn((length, height, width), |(k, row, col)| {
                (50 * index + 10 * k + width * row + col) as u8
            })
        };
        let sequences = lengths.iter().enumerate().map(sequence).collect();
        let shape = Shape::new(height, width).expect("test shape");
        Recorded::new(sequences, shape, symmetries, 0).expect("valid")
    }

    #[test]
    fn symmetries_are_the_eight_of_a_square() {
        let states = array![[1, 2], [3, 4]];
        let expected = [
            [[1, 2], [3, 4]],
            [[3, 4], [1, 2]],
            [[2, 1], [4, 3]],
            [[4, 3], [2, 1]],
            [[1, 3], [2, 4]],
            [[2, 4], [1, 3]],
            [[3, 1], [4, 2]],
            [[4, 2], [3, 1]],
        ];
        for (symmetry, expected) in (0..).zip(expected) {
            let expected = ndarray::arr2(&expected);
            assert_eq!(turned(states.view(), symmetry), expected, "{symmetry}");
        }
    }

    #[test]
    fn seeds_go_through_sequences_then_symmetries() {
        for (side, symmetries, n_symmetries) in
            [((2, 2), true, 8), ((1, 3), true, 4), ((2, 2), false, 1)]
        {
            let recorded = recorded(&[2, 3], side, symmetries);
            for seed in 0..40 {
                let choice = recorded.choice(seed);
                let chosen = (choice.sequence as u64, choice.symmetry);
                assert_eq!(chosen, (seed % 2, seed / 2 % n_symmetries));
                assert_eq!(recorded.last_step(seed), 1 + seed % 2);
            }
        }
    }

    #[test]
    fn a_world_shows_its_sequence_to_the_end() {
        let recorded = Arc::new(recorded(&[4, 5], (1, 3), false));
        let source = Source::Recorded(Arc::clone(&recorded));
        let mut world = World::new(source, 7, 0, &AtomicBool::new(false));
        for k in 0..4 {
            let expected = recorded.sequences[1].index_axis(Axis(0), k);
            assert_eq!(world.states(), expected);
            world.advance();
        }
        assert_eq!(world.step(), recorded.last_step(7));
    }

    #[test]
    fn offsets_are_uniform_and_leave_a_step() {
        let recorded = recorded(&[5, 9], (1, 1), false);
        let new = |offset| Recorded::new(recorded.sequences.clone(), recorded.shape, false, offset);
        assert_eq!(new(4).err(), Some(3));
        let recorded = new(3).expect("a step is left");
        assert_eq!(recorded.n_steps(), 1);
        let mut counts = [0.0_f64; 4];
        for seed in 0..4000 {
            let Choice {
                offset, sequence, ..
            } = recorded.choice(seed);
            counts[offset as usize] += 1.0;
            assert_eq!(recorded.last_step(seed), [4, 8][sequence] - offset);
            let first = recorded.states(seed, 0)[[0, 0]];
            assert_eq!(u64::from(first), 50 * sequence as u64 + 10 * offset);
        }
        // 4,000 independent draws of 4 values. By chance, a count deviates by more than 4.5 standard errors in 1 of
        // 150,000 runs.
        let bound = 4.5 * (4000.0_f64 * 0.25 * 0.75).sqrt();
        let is_likely = |count: &f64| (count - 1000.0).abs() < bound;
        assert!(counts.iter().all(is_likely), "{counts:?}");
    }
}
