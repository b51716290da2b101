//! The limit on file descriptors. iceoryx2 opens several descriptors for each client and observer. If none are left, a
//! new client gets no answer at all. So a server starts only if the limit is high enough for the maximum number of
//! clients and observers.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use thiserror::Error;

/// Minimum limit for a server with the maximum number of clients and observers, with a reserve. According to
/// measurements, the server needs 40 descriptors, each of 16 clients 10 (up to 8 more if its requests grow), and each
/// of 16 observers and 4 readers of hidden states 1.
const NEEDED: u64 = 512;

#[derive(Debug, Error, PartialEq, Eq)]
#[error(
    "file descriptors: expected a limit of at least {NEEDED}, got {got}; raise it (`ulimit -Hn`; docker: --ulimit \
     nofile)"
)]
pub struct TooFewDescriptors {
    got: u64,
}

pub fn raise_limit() -> Result<(), TooFewDescriptors> {
    let Some(raised) = enough(getrlimit(Resource::Nofile))? else {
        return Ok(());
    };
    let got = raised.maximum.unwrap_or(0);
    setrlimit(Resource::Nofile, raised).map_err(|_| TooFewDescriptors { got })
}

/// Returns the limits to set, or `None` if the current limits are high enough.
fn enough(limits: Rlimit) -> Result<Option<Rlimit>, TooFewDescriptors> {
    let is_enough = |limit: Option<u64>| limit.is_none_or(|limit| limit >= NEEDED);
    match limits.maximum {
        _ if is_enough(limits.current) => Ok(None),
        maximum if is_enough(maximum) => Ok(Some(Rlimit {
            current: Some(NEEDED),
            maximum,
        })),
        maximum => Err(TooFewDescriptors {
            got: maximum.unwrap_or(0),
        }),
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
