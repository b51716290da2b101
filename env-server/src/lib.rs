//! The Emberwatch server: simulates worlds and serves them to agents over shared memory.
//!
//! One step, in reading order: [`world`] (hidden states), [`sensor`] (noise), [`episode`] (path,
//! reward, frame), [`lease`] (who may act), [`simulator`] (request in, answer out), [`ports`] and
//! [`server`] (shared memory and the loop). [`resets`], [`files`] and [`liveness`] keep slow things off
//! that loop. [`snapshot`] writes worlds down, [`history`] and [`beliefs`] keep what the next agent needs.
//! [`recorder`] keeps what a server publishes; [`replay`] publishes it again.

pub mod autosave;
pub mod beliefs;
pub mod config;
pub mod descriptors;
pub mod episode;
pub mod files;
pub mod history;
pub mod lease;
pub mod liveness;
pub mod ports;
pub mod publications;
pub mod recorder;
pub mod replay;
pub mod resets;
pub mod sensor;
pub mod server;
pub mod simulator;
pub mod snapshot;
pub mod throttle;
pub mod world;
