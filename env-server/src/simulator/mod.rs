//! All worlds and leases of a server: requests in, answers out, no I/O and no clock.

mod beliefs;
mod control;
mod lease;
#[cfg(test)]
mod lease_tests;
mod outcome;
mod state;
mod step;
#[cfg(test)]
mod tests;
mod worlds;

pub use lease::ClientId;
pub use outcome::{Outcome, PendingFile, PendingReply, ServerStats};
pub use state::{ResetJob, Simulator};
