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

    /// A wait whose looks come at these microseconds after its beginning, in vain: at which it blocked.
    fn blocks_at(spinning: &mut Spinning, begin: Instant, looks: &[u64]) -> Option<u64> {
        spinning.begin(begin);
        let micros = |at: u64| begin + Duration::from_micros(at);
        looks
            .iter()
            .copied()
            .find(|&at| !spinning.goes_on(micros(at)))
    }

    #[test]
    fn a_wait_spins_for_a_while_then_blocks() {
        let mut spinning = Spinning::default();
        let blocked = blocks_at(&mut spinning, Instant::now(), &[1, 50, 99, 100]);
        assert_eq!(blocked, Some(100));
        assert!(!spinning.goes_on(Instant::now()));
    }

    #[test]
    fn after_three_vain_spins_waits_block_at_once() {
        let (mut spinning, begin) = (Spinning::default(), Instant::now());
        for _ in 0..VAIN_SPINS {
            assert_eq!(blocks_at(&mut spinning, begin, &[0, 100]), Some(100));
        }
        let paused = begin + Duration::from_micros(100);
        assert_eq!(blocks_at(&mut spinning, paused, &[0]), Some(0));
        let late = paused + PAUSE - Duration::from_micros(1);
        assert_eq!(blocks_at(&mut spinning, late, &[0]), Some(0));
        let again = paused + PAUSE;
        assert_eq!(blocks_at(&mut spinning, again, &[0, 100]), Some(100));
        let paused = again + Duration::from_micros(100);
        assert_eq!(blocks_at(&mut spinning, paused, &[0]), Some(0));
    }

    #[test]
    fn what_arrives_while_spinning_makes_up_for_spins_in_vain() {
        let (mut spinning, begin) = (Spinning::default(), Instant::now());
        for _ in 0..10 {
            for _ in 1..VAIN_SPINS {
                assert_eq!(blocks_at(&mut spinning, begin, &[0, 100]), Some(100));
            }
            assert_eq!(blocks_at(&mut spinning, begin, &[0, 99]), None);
            spinning.arrived();
        }
    }

    #[test]
    fn what_arrives_after_blocking_does_not() {
        let (mut spinning, begin) = (Spinning::default(), Instant::now());
        for _ in 0..VAIN_SPINS {
            assert_eq!(blocks_at(&mut spinning, begin, &[0, 100]), Some(100));
            spinning.arrived();
        }
        let paused = begin + Duration::from_micros(100);
        assert_eq!(blocks_at(&mut spinning, paused, &[0]), Some(0));
    }

    #[test]
    fn one_lost_core_is_enough() {
        let (mut spinning, begin) = (Spinning::default(), Instant::now());
        assert_eq!(blocks_at(&mut spinning, begin, &[0, 5, 4_000]), Some(4_000));
        let paused = begin + Duration::from_micros(4_001);
        assert_eq!(blocks_at(&mut spinning, paused, &[0]), Some(0));
    }

    #[test]
    fn a_look_soon_after_a_long_block_tells_nothing() {
        let (mut spinning, begin) = (Spinning::default(), Instant::now());
        assert_eq!(blocks_at(&mut spinning, begin, &[0, 100]), Some(100));
        assert!(!spinning.goes_on(begin + Duration::from_millis(9)));
        let next = begin + Duration::from_millis(9);
        assert_eq!(blocks_at(&mut spinning, next, &[0, 99]), None);
    }
}
