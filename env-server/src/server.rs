//! The server: its main loop, its ports on the channels, and the threads that do slow work.

mod autosave;
mod completions;
mod descriptors;
mod files;
mod liveness;
mod memory;
mod pending;
mod port_config;
mod ports;
mod publications;
mod resets;
mod serve;
mod state;
mod taken;

pub use ports::Ports;
pub use serve::serve;
pub use state::announce_settings;
