//! The measured rate of world steps.

use std::time::{Duration, Instant};

const RATE_WINDOW: Duration = Duration::from_secs(1);

/// A measurement of world steps per second over the last window.
pub struct Rate {
    since: Instant,
    n_steps: u64,
    pub per_second: f64,
}

impl Rate {
    pub fn since(now: Instant) -> Self {
        Self {
            since: now,
            n_steps: 0,
            per_second: 0.0,
        }
    }

    pub fn update(&mut self, now: Instant, n_steps: u64) {
        let elapsed = now - self.since;
        if elapsed >= RATE_WINDOW {
            let per_second = (n_steps - self.n_steps) as f64 / elapsed.as_secs_f64();
            *self = Self {
                since: now,
                n_steps,
                per_second,
            };
        }
    }
}
