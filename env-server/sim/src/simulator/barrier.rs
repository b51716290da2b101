//! The barrier of a world, which collects the paths and the waiting requests for the next step. It knows neither leases
//! nor a clock.

use super::lease::ClientId;
use emberwatch_messages::message::StepRequest;
use emberwatch_model::Move;
use std::time::Instant;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ticket(pub(super) u64);

#[derive(Debug, Clone, Copy)]
pub(super) struct Waiter {
    pub ticket: Ticket,
    pub client: ClientId,
    pub request: StepRequest,
    /// Bit r stands for robot r of the world.
    pub robots: u64,
}

/// The paths for a world's next step. In each mask, bit r stands for robot r of the world.
#[derive(Debug)]
pub(super) struct Barrier {
    /// One path per robot, in order. Only paths of robots in `ready` are valid.
    pub moves: Vec<Move>,
    pub ready: u64,
    pub full: u64,
    /// The time at which the world moves even if paths are missing.
    pub deadline: Option<Instant>,
    /// Waiting requests in the order of arrival. No robot belongs to two requests.
    pub waiters: Vec<Waiter>,
}

impl Barrier {
    pub fn new(n_robots: usize, n_moves: usize) -> Self {
        Self {
            moves: vec![Move::Up; n_robots * n_moves],
            ready: 0,
            full: 0,
            deadline: None,
            waiters: Vec::new(),
        }
    }

    /// Stores the paths of consecutive robots, starting with robot `first`. Each byte of `paths` is a move.
    pub fn put(&mut self, first: usize, n_moves: usize, paths: &[u8], is_full: bool) {
        let n_robots = paths.len() / n_moves;
        let places = self.moves[first * n_moves..][..paths.len()].iter_mut();
        for (place, &byte) in places.zip(paths) {
            *place = Move::from_low_bits(byte.into());
        }
        let robots = mask(first, n_robots);
        self.ready |= robots;
        self.full &= !robots;
        if is_full {
            self.full |= robots;
        }
    }

    /// Removes and returns the requests for which `is_over` returns true, and removes their paths.
    pub fn withdraw(&mut self, is_over: impl Fn(&Waiter) -> bool) -> Vec<Waiter> {
        let over: Vec<Waiter> = self
            .waiters
            .extract_if(.., |waiter| is_over(waiter))
            .collect();
        for waiter in &over {
            self.ready &= !waiter.robots;
        }
        if self.ready == 0 {
            self.deadline = None;
        }
        over
    }

    /// Returns whether the world can move: at least one path has arrived, and either no path is missing or the deadline
    /// has passed.
    pub fn is_complete(&self, held: u64, now: Instant) -> bool {
        let is_due = self.deadline.is_some_and(|deadline| deadline <= now);
        self.ready != 0 && (held & !self.ready == 0 || is_due)
    }

    /// Removes all paths after a step, so that paths for the next step can arrive. Returns the requests that waited for
    /// the step.
    pub fn clear(&mut self) -> Vec<Waiter> {
        (self.ready, self.full, self.deadline) = (0, 0, None);
        std::mem::take(&mut self.waiters)
    }
}

pub(super) fn mask(first: usize, n: usize) -> u64 {
    u64::MAX.unbounded_shr(64 - n as u32) << first
}
