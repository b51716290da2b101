//! File descriptors. iceoryx2 takes some for each client and observer; where none are left, whoever comes is not
//! heard, and cannot be told so. So there must be enough for all before a server begins.

use crate::throttle::Throttle;
use rustix::event::{EventfdFlags, eventfd};
use rustix::io::Errno;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use std::os::fd::OwnedFd;
use std::time::Instant;
use thiserror::Error;

/// What a server and all who may come take, and some to spare: 40 alone, 10 for each of 16 clients, up to 8 more where
/// its requests grow, 1 for each of 16 observers and 4 readers (measured).
pub const NEEDED: u64 = 512;

/// What a client takes that has just come.
const OF_A_CLIENT: usize = 10;

/// A limit that is too low for all who may come.
#[derive(Debug, Error, PartialEq, Eq)]
#[error(
    "file descriptors: expected a limit of at least {NEEDED}, got {got}; raise it (`ulimit -Hn`; docker: --ulimit \
     nofile)"
)]
pub struct TooFew {
    got: u64,
}

/// Makes room for all who may come: raises the soft limit if need be.
///
/// # Errors
/// [`TooFew`] if the hard limit is lower.
pub fn make_room() -> Result<(), TooFew> {
    let Some(raised) = enough(getrlimit(Resource::Nofile))? else {
        return Ok(());
    };
    let got = raised.maximum.unwrap_or(0);
    setrlimit(Resource::Nofile, raised).map_err(|_| TooFew { got })
}

/// The limits to set; `None` if these will do.
fn enough(limits: Rlimit) -> Result<Option<Rlimit>, TooFew> {
    let is_enough = |limit: Option<u64>| limit.is_none_or(|limit| limit >= NEEDED);
    match limits.maximum {
        _ if is_enough(limits.current) => Ok(None),
        maximum if is_enough(maximum) => Ok(Some(Rlimit {
            current: Some(NEEDED),
            maximum,
        })),
        maximum => Err(TooFew {
            got: maximum.unwrap_or(0),
        }),
    }
}

/// Says, now and then, that there are too few after all: limits may change, and the system's own be reached.
#[derive(Debug, Default)]
pub struct Shortage(Throttle);

impl Shortage {
    /// Says so if connections that could not be opened are due to it; others are those of clients that died.
    pub fn warn(&mut self, now: Instant, n_connections: u64) {
        if n_connections == 0 {
            return;
        }
        let free: Result<Vec<OwnedFd>, Errno> = (0..OF_A_CLIENT)
            .map(|_| eventfd(0, EventfdFlags::CLOEXEC))
            .collect();
        let Err(problem) = free else { return };
        if let Some(unsaid) = self.0.pass(now) {
            let limit = getrlimit(Resource::Nofile).current;
            tracing::warn!(
                limit,
                unsaid,
                "no file descriptors for a client or an observer, which gets no answer: {problem}"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_low_limit_is_raised_as_far_as_needed_and_allowed() {
        let limits = |current, maximum| Rlimit { current, maximum };
        assert_eq!(enough(limits(None, None)), Ok(None));
        assert_eq!(enough(limits(Some(NEEDED), Some(4 * NEEDED))), Ok(None));
        for maximum in [Some(NEEDED), None] {
            let raised = limits(Some(NEEDED), maximum);
            assert_eq!(enough(limits(Some(64), maximum)), Ok(Some(raised)));
        }
        let refused = enough(limits(Some(64), Some(100))).expect_err("too few");
        assert!(refused.to_string().contains("got 100"), "{refused}");
    }
}
