//! The maximum sizes of messages on a server's ports.

use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::payload::ROBOT_BYTES;

#[derive(Debug, Clone)]
pub struct PortConfig {
    pub instance: Instance,
    pub n_cells: usize,
    pub frame_bytes: usize,
    pub answer_bytes: usize,
    pub publish_truth: bool,
}

pub(super) fn frame_bytes(n_robots: u32, n_cells: usize, n_moves: usize) -> usize {
    n_robots as usize * (ROBOT_BYTES + n_cells + n_moves)
}
