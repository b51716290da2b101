//! Decides whether a wait spins or blocks at once, from the success of earlier waits. It reads no clock: the caller
//! passes the current time.
//!
//! If each process has a core, spinning takes about 1 us and blocking about 50 us, mostly to wake an idle core. If
//! other processes keep the cores busy, blocking is faster: a spinning process uses up its time slice, while a blocked
//! one is scheduled ahead of busy ones. No wait yields, because with busy processes each `sched_yield` costs a time
//! slice, which is milliseconds.

use std::time::{Duration, Instant};

/// Time to poll before blocking. It is longer than it takes to wake a process that answers at once, so that two
/// processes that both block can find out that spinning is faster.
const SPIN: Duration = Duration::from_micros(100);

/// If the time between two polls exceeds this limit, another process was running on the core meanwhile. The limit is
/// shorter than a time slice, and longer than short pieces of work, such as handing a snapshot to a writer.
const LOST_CORE: Duration = Duration::from_millis(1);

/// Number of consecutive spins without success (waits longer than [`SPIN`]) after which waits stop spinning.
const VAIN_SPINS: u32 = 3;

/// Time during which waits then block at once. After this time, one wait tries spinning again.
const PAUSE: Duration = Duration::from_millis(100);

/// The record of earlier waits, from which the next ones decide whether to spin.
#[derive(Debug, Clone, Copy, Default)]
pub struct Spinning {
    /// The times when this wait began and last polled. `None` if it does not spin, or has stopped spinning.
    wait: Option<(Instant, Instant)>,
    n_vain: u32,
    not_before: Option<Instant>,
}

impl Spinning {
    pub fn begin(&mut self, now: Instant) {
        let may_spin = self.not_before.is_none_or(|end| now >= end);
        self.wait = may_spin.then_some((now, now));
    }

    /// Called while nothing has arrived. Returns true if the caller should poll again at once, and false if it should
    /// block.
    pub fn keeps_spinning(&mut self, now: Instant) -> bool {
        let Some((start, last)) = self.wait else {
            return false;
        };
        let lost_core = now - last > LOST_CORE;
        if !lost_core && now - start < SPIN {
            self.wait = Some((start, now));
            return true;
        }
        self.wait = None;
        self.n_vain = self.n_vain.saturating_add(1);
        if lost_core || self.n_vain >= VAIN_SPINS {
            self.n_vain = VAIN_SPINS;
            self.not_before = Some(now + PAUSE);
        }
        false
    }

    pub fn arrived(&mut self) {
        if self.wait.is_some() {
            self.n_vain = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// For each wait: its start in microseconds; the times of its unsuccessful polls, relative to the start; the time
    /// of the poll after which it blocks; and whether something arrives in the end.
    type Waits<'a> = &'a [(u64, &'a [u64], Option<u64>, bool)];

    fn check(waits: Waits<'_>) {
        let (mut spinning, origin) = (Spinning::default(), Instant::now());
        let micros = |at: u64| origin + Duration::from_micros(at);
        for &(start, looks, blocked, arrives) in waits {
            spinning.begin(micros(start));
            let mut looks = looks.iter().copied();
            let found = looks.find(|at| !spinning.keeps_spinning(micros(start + at)));
            assert_eq!(found, blocked, "from {start} on");
            let after = looks.find(|at| spinning.keeps_spinning(micros(start + at)));
            assert_eq!(after, None, "it has blocked");
            if arrives {
                spinning.arrived();
            }
        }
    }

    #[test]
    fn after_three_vain_spins_waits_block_at_once() {
        let in_vain = (0, &[1, 50, 99, 100, 101][..], Some(100), false);
        check(&[
            in_vain,
            in_vain,
            in_vain,
            (100, &[0], Some(0), false),
            (100_099, &[0], Some(0), false),
            (100_100, &[0, 100], Some(100), false),
            (100_200, &[0], Some(0), false),
        ]);
        // One lost core is enough to stop spinning.
        let at_once = (4_001, &[0][..], Some(0), false);
        check(&[(0, &[0, 5, 4_000], Some(4_000), false), at_once]);
        // A poll soon after a long block does not count as a lost core.
        let next = (9_000, &[0, 99][..], None, false);
        check(&[(0, &[0, 100, 9_000], Some(100), false), next]);
    }

    #[test]
    fn only_an_arrival_while_spinning_resets_the_vain_spins() {
        let in_vain = (0, &[0, 100][..], Some(100), false);
        let arrives = (0, &[0, 99][..], None, true);
        check(&[in_vain, in_vain, arrives].repeat(10));
        let arrives_late = (0, &[0, 100][..], Some(100), true);
        let at_once = (100, &[0][..], Some(0), false);
        check(&[arrives_late, arrives_late, arrives_late, at_once]);
    }
}
