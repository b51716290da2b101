//! The maximum sizes of messages on a server's ports.

use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::control::ServerInfo;
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

impl PortConfig {
    /// Returns the message sizes of an instance without worlds.
    pub fn empty(instance: Instance) -> Self {
        Self {
            instance,
            n_cells: 0,
            frame_bytes: 0,
            answer_bytes: 0,
            publish_truth: false,
        }
    }

    /// Increases the sizes to fit the samples of a server's worlds.
    pub fn fit(&mut self, info: &ServerInfo) {
        let n_cells = info.height * info.width;
        let n_bytes = frame_bytes(info.n_robots, n_cells, info.n_moves);
        self.n_cells = self.n_cells.max(n_cells);
        self.frame_bytes = self.frame_bytes.max(n_bytes);
    }
}

/// Returns the maximum length of a sample on `frames`, in bytes.
pub(super) fn frame_bytes(n_robots: u32, n_cells: usize, n_moves: usize) -> usize {
    n_robots as usize * (ROBOT_BYTES + n_cells + n_moves)
}
