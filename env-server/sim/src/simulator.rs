//! All worlds and leases of a server. Answers requests without I/O and without a clock.

mod advance;
mod answer;
mod barrier;
mod beliefs;
mod control;
mod lease;
mod outcome;
mod share;
mod state;
mod step;
#[cfg(test)]
pub(crate) mod tests;
mod worlds;

pub use barrier::Ticket;
pub use lease::ClientId;
pub use outcome::{Outcome, PendingFile, PendingReply, ServerStats};
pub use state::{ResetJob, Simulator};
pub use step::Stepped;
