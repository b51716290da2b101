//! The input of a step: the paths of a world's robots.

use emberwatch_model::{Coverage, Move};

/// The paths that the robots of a world fly in a step. In each mask, bit r stands for robot r of the world.
#[derive(Debug, Clone, Copy, Default)]
pub struct Flown<'a> {
    /// One path per robot of the world, in order and of equal length. Only paths of robots in `ready` are flown.
    pub moves: &'a [Move],
    pub ready: u64,
    pub full: u64,
    /// Robots that stay because no client holds them.
    pub hovered: u64,
    /// Robots that stay because their path missed the deadline.
    pub late: u64,
}

impl Flown<'_> {
    pub(super) fn coverage(&self, robot: usize) -> Coverage {
        match (self.ready >> robot & 1, self.full >> robot & 1) {
            (0, _) => Coverage::Empty,
            (_, 0) => Coverage::Path,
            _ => Coverage::Full,
        }
    }
}
