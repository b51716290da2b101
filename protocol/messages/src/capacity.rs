//! Maximum numbers of clients, worlds, robots and cells, also listed in PROTOCOL.md.

/// Maximum number of clients that can be connected to a channel (`step` or `control`) at a time.
pub const MAX_CLIENTS: usize = 16;

/// Maximum number of worlds of a server.
pub const MAX_WORLDS: usize = 1024;

pub use emberwatch_model::settings::MAX_ROBOTS;

/// Maximum number of robots of a server, over all its worlds.
pub const MAX_ROBOT_NUMBERS: usize = 4096;

/// Maximum total number of cells in the frames of one world's robots.
pub const MAX_TEAM_CELLS: usize = 1 << 24;
