//! All worlds and leases of a server. Answers requests without I/O and without a clock.

mod advance;
mod answer;
mod barrier;
#[cfg(test)]
mod barrier_tests;
mod beliefs;
mod control;
mod lease;
#[cfg(test)]
mod lease_tests;
mod outcome;
mod share;
mod state;
mod step;
#[cfg(test)]
mod test_worlds;
#[cfg(test)]
mod tests;
mod worlds;

pub use barrier::Ticket;
pub use lease::ClientId;
pub use outcome::{Outcome, PendingFile, PendingReply, ServerStats};
pub use state::{ResetJob, Simulator};
pub use step::Stepped;
