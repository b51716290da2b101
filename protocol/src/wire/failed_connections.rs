//! Connections that could not be opened, for example because no file descriptors are free. Their clients get no answer.

use super::resources::{SERVER_DESCRIPTORS, free_descriptors};
use crate::throttle::Throttle;
use iceoryx2::port::{DegradationAction, DegradationCause, DegradationFn, DegradationInfo};
use rustix::process::{Resource, getrlimit};
use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Counts failed connections. Warns when file descriptors ran out, by the process's limit or by the system's.
#[derive(Debug, Default)]
pub struct FailedConnections {
    count: Arc<AtomicU64>,
    warnings: RefCell<Throttle>,
}

impl FailedConnections {
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

    /// Warns, at most every ten seconds, if connections failed since the last call because file descriptors ran out. A
    /// connection can also fail because its client died; then there is no warning.
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
                "no file descriptors for a client or an observer, which will get no answer: {problem}"
            );
        }
    }
}
