//! Maximum numbers of clients, worlds, robots and cells, also listed in PROTOCOL.md.

/// Maximum number of clients at a time on each of `step` and `control`.
pub const MAX_CLIENTS: usize = 16;

/// Maximum number of worlds of a server.
pub const MAX_WORLDS: usize = 1024;

/// Maximum number of robots of a world.
pub const MAX_ROBOTS: usize = 64;

/// Maximum number of robots of a server, over all its worlds.
pub const MAX_ROBOT_NUMBERS: usize = 4096;

/// Maximum number of cells in all frames of one world together.
pub const MAX_TEAM_CELLS: usize = 1 << 24;
