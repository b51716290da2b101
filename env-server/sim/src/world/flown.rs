//! What one step of a world is given.

use emberwatch_model::{Coverage, Move};

/// Which robots of a world fly in a step, and where. Of each mask, bit r is robot r of the world.
#[derive(Debug, Clone, Copy)]
pub struct Flown<'a> {
    /// One path of equal length for each robot of the world, in order; only those of `ready` are flown.
    pub moves: &'a [Move],
    /// The robots that have a path.
    pub ready: u64,
    /// Those that observe every cell, not only their path.
    pub full: u64,
    /// Those that stay because nobody holds them.
    pub hovered: u64,
    /// Those that stay because their path has not come in time.
    pub late: u64,
}

impl Flown<'_> {
    /// What a robot observes.
    pub(super) fn coverage(&self, robot: usize) -> Coverage {
        match (self.ready >> robot & 1, self.full >> robot & 1) {
            (0, _) => Coverage::Empty,
            (_, 0) => Coverage::Path,
            _ => Coverage::Full,
        }
    }
}
