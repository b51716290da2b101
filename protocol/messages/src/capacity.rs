//! Maximum numbers of clients, robots and cells, which PROTOCOL.md lists.

/// Most clients at a time on each of `step` and `control`.
pub const MAX_CLIENTS: usize = 16;

/// Most robots of a world.
pub const MAX_ROBOTS: usize = 64;

/// Most robots of a server, over all its worlds.
pub const MAX_ROBOT_NUMBERS: usize = 4096;

/// Most cells of the frames of one world's robots together.
pub const MAX_TEAM_CELLS: usize = 1 << 24;
