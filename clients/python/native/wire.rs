//! The parts that need a server's shared memory: connections and observers.

#[cfg(not(target_os = "linux"))]
mod without;

#[cfg(target_os = "linux")]
pub use emberwatch_protocol::{connection::Connection, observer::Observer};
#[cfg(not(target_os = "linux"))]
pub use without::{Connection, Observer};
