//! Whether a wait spins or blocks at once, from what came of it before. It knows no clock.
//!
//! Where both processes have a core, spinning answers in about 1 us and blocking in about 50 us, most of it the
//! wake-up of an idle core. Where others keep the cores busy it is the other way round: who spins uses up its time
//! slice; who blocks is woken ahead of the busy ones. No wait yields: beside a busy process each `sched_yield`
//! costs a time slice, milliseconds.

use std::time::{Duration, Instant};

/// How long to poll before blocking: longer than the wake-up of a process that answers at once, so that two that
/// block find out that spinning pays.
const SPIN: Duration = Duration::from_micros(100);

/// A look that comes so long after the one before it: a busy process had the core meanwhile. Less than a time slice;
/// more than short pieces of work need, such as a snapshot's way to its file.
const LOST_CORE: Duration = Duration::from_millis(1);

/// After so many waits in a row that were longer than the spin, spinning does not pay.
const VAIN_SPINS: u32 = 3;

/// How long to block at once then, before one wait tries again.
const PAUSE: Duration = Duration::from_millis(100);

/// Decides when to spin, from what came of it before. It knows no clock.
#[derive(Debug, Clone, Copy, Default)]
pub struct Spinning {
    /// When this wait began, and its last look; `None` where it does not spin, or no more.
    wait: Option<(Instant, Instant)>,
    n_vain: u32,
    not_before: Option<Instant>,
}

impl Spinning {
    /// A wait begins.
    pub fn begin(&mut self, now: Instant) {
        let may_spin = self.not_before.is_none_or(|end| now >= end);
        self.wait = may_spin.then_some((now, now));
    }

    /// Nothing has arrived yet: whether to look again at once. If not, block.
    pub fn goes_on(&mut self, now: Instant) -> bool {
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

    /// The wait is over: something has arrived.
    pub fn arrived(&mut self) {
        if self.wait.is_some() {
            self.n_vain = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Waits: when each begins in microseconds, when it looks in vain from then on, at which look it blocks, and whether
    /// something arrives then.
    type Waits<'a> = &'a [(u64, &'a [u64], Option<u64>, bool)];

    fn check(waits: Waits<'_>) {
        let (mut spinning, origin) = (Spinning::default(), Instant::now());
        let micros = |at: u64| origin + Duration::from_micros(at);
        for &(start, looks, blocked, arrives) in waits {
            spinning.begin(micros(start));
            let mut looks = looks.iter().copied();
            let found = looks.find(|at| !spinning.goes_on(micros(start + at)));
            assert_eq!(found, blocked, "from {start} on");
            let after = looks.find(|at| spinning.goes_on(micros(start + at)));
            assert_eq!(after, None, "it has blocked");
            if arrives {
                spinning.arrived();
            }
        }
    }

    #[test]
    fn a_wait_spins_for_a_while_and_waits_block_at_once_after_three_in_vain() {
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
        // One lost core is enough.
        let at_once = (4_001, &[0][..], Some(0), false);
        check(&[(0, &[0, 5, 4_000], Some(4_000), false), at_once]);
        // A look soon after a long block tells nothing.
        let next = (9_000, &[0, 99][..], None, false);
        check(&[(0, &[0, 100, 9_000], Some(100), false), next]);
    }

    #[test]
    fn what_arrives_while_spinning_alone_makes_up_for_spins_in_vain() {
        let in_vain = (0, &[0, 100][..], Some(100), false);
        let arrives = (0, &[0, 99][..], None, true);
        check(&[in_vain, in_vain, arrives].repeat(10));
        let arrives_late = (0, &[0, 100][..], Some(100), true);
        let at_once = (100, &[0][..], Some(0), false);
        check(&[arrives_late, arrives_late, arrives_late, at_once]);
    }
}
