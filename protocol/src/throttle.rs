//! Limits repeated warnings: logs one, and later the number that were suppressed. It reads no clock: the caller passes
//! the current time.

use std::time::{Duration, Instant};

const INTERVAL: Duration = Duration::from_secs(10);

#[derive(Debug, Default)]
pub struct Throttle {
    last: Option<Instant>,
    n_unsaid: u64,
}

impl Throttle {
    /// Counts a warning. If it should be logged, returns the number of warnings suppressed since the last logged one.
    pub fn pass(&mut self, now: Instant) -> Option<u64> {
        if self.last.is_some_and(|last| now < last + INTERVAL) {
            self.n_unsaid += 1;
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.n_unsaid))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_warning_is_logged_and_later_the_number_suppressed() {
        let (mut throttle, start) = (Throttle::default(), Instant::now());
        let moments = [0, 1, 2, 9_999, 10_000, 10_001, 30_000, 60_000];
        let said = moments.map(|millis| throttle.pass(start + Duration::from_millis(millis)));
        let expected = [Some(0), None, None, None, Some(3), None, Some(1), Some(0)];
        assert_eq!(said, expected);
    }
}
