//! The maximum sizes of messages on a server's ports.

use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::payload::ROBOT_BYTES;

/// The instance and the maximum sizes of its messages.
#[derive(Debug, Clone)]
pub struct PortConfig {
    pub instance: Instance,
    /// Maximum number of cells of a grid.
    pub n_cells: usize,
    /// Maximum length of a sample on `frames`, in bytes.
    pub frame_bytes: usize,
    /// Maximum length of an answer on `step`, in bytes.
    pub answer_bytes: usize,
    /// Whether to publish hidden states.
    pub publish_truth: bool,
}

/// Returns the maximum length of a sample on `frames`, in bytes.
pub(super) fn frame_bytes(n_robots: u32, n_cells: usize, n_moves: usize) -> usize {
    n_robots as usize * (ROBOT_BYTES + n_cells + n_moves)
}
