//! The parts that need a server's shared memory: connections, observers, and the channel on which beliefs are
//! published.

#[cfg(not(target_os = "linux"))]
mod without;

#[cfg(target_os = "linux")]
pub use emberwatch_protocol::{
    connection::Connection,
    feed::{Feed, View},
    observer::Observer,
};
#[cfg(not(target_os = "linux"))]
pub use without::{Connection, Feed, Observer, View};
