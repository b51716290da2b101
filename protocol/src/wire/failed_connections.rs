//! Connections that could not be opened, for example as no file descriptors are left: their clients get no answer.

use super::resources::{SERVER_DESCRIPTORS, free_descriptors};
use crate::throttle::Throttle;
use iceoryx2::port::{DegradationAction, DegradationCause, DegradationFn, DegradationInfo};
use rustix::process::{Resource, getrlimit};
use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Counts them, and warns of those for which there were no file descriptors: limits may change, and the system has
/// one too.
#[derive(Debug, Default)]
pub struct FailedConnections {
    count: Arc<AtomicU64>,
    warnings: RefCell<Throttle>,
}

impl FailedConnections {
    /// A handler that counts, for a port.
    pub fn counter(&self) -> impl DegradationFn + 'static {
        let count = self.count.clone();
        move |_: DegradationCause, _: &DegradationInfo| {
            count.fetch_add(1, Ordering::Relaxed);
            DegradationAction::Ignore
        }
    }

    pub(super) fn add(&self) {
        self.count.fetch_add(1, Ordering::Relaxed);
    }

    /// Warns, at most every ten seconds, if there were some since the last call, and descriptors are the reason;
    /// another reason is the death of their clients.
    pub fn warn(&self, now: Instant) {
        if self.count.swap(0, Ordering::Relaxed) == 0 {
            return;
        }
        let Err(problem) = free_descriptors(SERVER_DESCRIPTORS) else {
            return;
        };
        if let Some(n_unsaid) = self.warnings.borrow_mut().pass(now) {
            let limit = getrlimit(Resource::Nofile).current;
            tracing::warn!(
                limit,
                n_unsaid,
                "no file descriptors for a client or an observer, which gets no answer: {problem}"
            );
        }
    }
}
