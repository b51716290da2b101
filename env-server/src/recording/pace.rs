//! The times at which the samples of a recording are published. The functions here are pure: the current time is an
//! argument.

use emberwatch_protocol::channels::FRAME_BUFFER;
use std::time::{Duration, Instant};

/// Maximum number of samples published without a pause. An observer's buffer has space for two such bursts.
const BURST: usize = FRAME_BUFFER / 2;

/// Minimum time between the beginnings of two bursts. It leaves a margin for busy machines, because observers poll
/// every 500 us.
const BURST_TIME: Duration = Duration::from_millis(1);

/// The pace of a replay.
pub struct Pace {
    /// Speed relative to the recording.
    speed: f64,
    round_began: Instant,
    n_in_burst: usize,
    burst_began: Instant,
}

impl Pace {
    /// Creates the pace of a replay that begins now. If `speed` is `None`, the replay is as fast as observers can
    /// follow.
    pub fn new(speed: Option<f64>, now: Instant) -> Self {
        Self {
            speed: speed.unwrap_or(f64::INFINITY),
            round_began: now,
            n_in_burst: 0,
            burst_began: now,
        }
    }

    /// Restarts the recording from its beginning.
    pub fn begin_round(&mut self, now: Instant) {
        self.round_began = now;
    }

    /// Converts a time in the recording to the time at which its sample is due, or `None` if that is too late to
    /// represent.
    pub fn due(&self, time: Duration) -> Option<Instant> {
        let after = Duration::try_from_secs_f64(time.as_secs_f64() / self.speed).ok()?;
        self.round_began.checked_add(after)
    }

    /// Returns the earliest time at which the next sample may be published so that observers can follow, or `None` if
    /// it need not wait.
    pub fn pause(&self) -> Option<Instant> {
        (self.n_in_burst == BURST).then(|| self.burst_began + BURST_TIME)
    }

    /// Counts a published sample.
    pub fn publish(&mut self, now: Instant) {
        if self.n_in_burst == BURST {
            (self.n_in_burst, self.burst_began) = (0, now);
        }
        self.n_in_burst += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_due_at_its_recorded_time_divided_by_the_speed() {
        let now = Instant::now();
        let due = |speed, seconds| {
            let due = Pace::new(speed, now).due(Duration::from_secs(seconds))?;
            Some((due - now).as_millis())
        };
        assert_eq!(due(Some(1.0), 6), Some(6_000));
        assert_eq!(due(Some(4.0), 6), Some(1_500));
        assert_eq!(due(Some(0.5), 6), Some(12_000));
        assert_eq!(due(None, 1 << 40), Some(0));
        assert_eq!(due(Some(1e-300), 1), None);
        let mut second_round = Pace::new(Some(1.0), now);
        second_round.begin_round(now + Duration::from_secs(9));
        let due = second_round.due(Duration::from_secs(1));
        assert_eq!(due, Some(now + Duration::from_secs(10)));
    }

    #[test]
    fn at_most_one_burst_is_published_per_burst_time() {
        let began = Instant::now();
        let mut pace = Pace::new(None, began);
        for _ in 0..BURST {
            assert_eq!(pace.pause(), None);
            pace.publish(began);
        }
        assert_eq!(pace.pause(), Some(began + BURST_TIME));
        let late = began + 3 * BURST_TIME;
        for _ in 0..BURST {
            pace.publish(late);
        }
        assert_eq!(
            pace.pause(),
            Some(late + BURST_TIME),
            "measured from the beginning of the burst"
        );
    }
}
