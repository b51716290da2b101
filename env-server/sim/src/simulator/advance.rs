//! Moves worlds by one step when a request brings the last missing path, when a deadline passes, or when a robot's
//! holder leaves.

use super::answer::Part;
use super::barrier::{Barrier, Ticket, Waiter};
use super::lease::Refusal;
use super::share::share;
use super::state::{Place, Simulator, Slot};
use crate::world::{Episode, Flown, Rules};
use emberwatch_messages::message::{Status, StepReply};
use std::ops::Range;
use std::time::Instant;

/// Minimum number of cells in a batch that several threads step. For smaller batches, waking a thread (tens of
/// microseconds) costs more than it saves (about 2 ns per cell).
const PARALLEL_CELLS: usize = 1 << 15;

impl Simulator {
    pub fn next_deadline(&self) -> Option<Instant> {
        let waiting = self.waiting_worlds.iter();
        let deadlines = waiting.filter_map(|&world| self.places[world].barrier.deadline);
        deadlines.min()
    }

    /// Withdraws a step request whose client has stopped waiting for the answer.
    pub fn cancel_step(&mut self, now: Instant, ticket: Ticket) {
        for &world in &self.waiting_worlds {
            let barrier = &mut self.places[world].barrier;
            for waiter in barrier.withdraw(|waiter| waiter.ticket == ticket) {
                self.leases.end_wait(now, waiter.request.lease);
            }
        }
        self.forget_idle_worlds();
    }

    /// Returns the next answer to a request that waited, and writes its results and frames to `payload`. Call this
    /// until it returns `None` before handling the next request, because an answer shows the current step of its
    /// worlds, which the next request may change.
    pub fn next_answer(&mut self, payload: &mut Vec<u8>) -> Option<(Ticket, StepReply)> {
        let (waiter, outcome) = self.settled.pop_front()?;
        payload.clear();
        let reply = match outcome {
            Ok(()) => {
                self.fit(&waiter.request, payload);
                self.write_present(&waiter.request, payload)
            }
            Err(refusal) => self.refuse(&waiter.request, refusal),
        };
        Some((waiter.ticket, reply))
    }

    /// Returns the worlds that have moved since the last call for another reason than a step request, such as a
    /// deadline.
    pub fn take_moved(&mut self) -> Vec<usize> {
        std::mem::take(&mut self.moved)
    }

    /// Refuses waiting requests whose lease has lost a robot, and moves the worlds for which no path is missing any
    /// more.
    pub(super) fn settle(&mut self, now: Instant) {
        for world in self.waiting_worlds.clone() {
            let robots = self.robots_of(world);
            let (barrier, leases) = (&mut self.places[world].barrier, &self.leases);
            let missing = |waiter: &Waiter| {
                waiter.robots & !leases.held_under(waiter.request.lease, robots.clone())
            };
            let lost = barrier.withdraw(|waiter| missing(waiter) != 0);
            let refusal = |waiter: Waiter| {
                let robot = robots.start + missing(&waiter).trailing_zeros() as usize;
                let lease = waiter.request.lease;
                (waiter, leases.not_held(lease, waiter.client, robot))
            };
            let refused: Vec<(Waiter, Refusal)> = lost.into_iter().map(refusal).collect();
            for (waiter, lost) in refused {
                self.settle_waiter(now, waiter, Err(lost));
            }
            if self.is_complete(now, world) {
                self.advance(now, world..world + 1, None);
                self.moved.push(world);
            }
        }
        self.forget_idle_worlds();
    }

    pub(super) fn refuse_waiting(&mut self, now: Instant, world: usize) {
        for waiter in self.places[world].barrier.withdraw(|_| true) {
            let refusal = Refusal::new(Status::Resetting, world as u64);
            self.settle_waiter(now, waiter, Err(refusal));
        }
        self.forget_idle_worlds();
    }

    pub(super) fn is_complete(&self, now: Instant, world: usize) -> bool {
        let held = self.leases.held(self.robots_of(world));
        self.places[world].barrier.is_complete(held, now)
    }

    /// Moves worlds by one step with the paths that have arrived. If `parts` is given, it contains one part of an
    /// answer for each world, which is written by the thread that steps the world.
    pub(super) fn advance(
        &mut self,
        now: Instant,
        worlds: Range<usize>,
        parts: Option<Vec<Part<'_>>>,
    ) {
        let (rules, leases) = (&self.spec.rules, &self.leases);
        let team = rules.n_robots;
        let step = |(world, place, part): (usize, &mut Place, Option<Part<'_>>)| {
            let held = leases.held(world * team..(world + 1) * team);
            if let Slot::Ready(episode) = &mut place.slot {
                step(rules, episode, &place.barrier, held);
                if let Some(part) = part {
                    part.write(episode);
                }
            }
        };
        let n_cells = rules.shape.n_cells() + team * rules.n_moves;
        let places = self.places[worlds.clone()].iter_mut();
        let parts = parts.into_iter().flatten().map(Some);
        let parts = parts.chain(std::iter::repeat_with(|| None));
        let jobs = worlds.clone().zip(places).zip(parts);
        let jobs = jobs.map(|((world, place), part)| (world, place, part));
        if worlds.len() > 1 && worlds.len() * n_cells >= PARALLEL_CELLS {
            share(&self.threads, worlds.len(), jobs, step);
        } else {
            jobs.for_each(step);
        }
        self.n_steps += worlds.len() as u64;
        for world in worlds {
            for waiter in self.places[world].barrier.clear() {
                self.settle_waiter(now, waiter, Ok(()));
            }
        }
        self.forget_idle_worlds();
    }

    pub(super) fn new_ticket(&mut self) -> Ticket {
        self.n_tickets += 1;
        Ticket(self.n_tickets)
    }

    fn settle_waiter(&mut self, now: Instant, waiter: Waiter, outcome: Result<(), Refusal>) {
        self.leases.end_wait(now, waiter.request.lease);
        self.settled.push_back((waiter, outcome));
    }

    fn forget_idle_worlds(&mut self) {
        let places = &self.places;
        self.waiting_worlds
            .retain(|&world| !places[world].barrier.waiters.is_empty());
    }
}

fn step(rules: &Rules, episode: &mut Episode, barrier: &Barrier, held: u64) {
    let all = u64::MAX >> (64 - rules.n_robots);
    let ready = barrier.ready;
    let flown = Flown {
        moves: &barrier.moves,
        ready,
        full: barrier.full,
        hovered: all & !(held | ready),
        late: held & !ready,
    };
    episode.step(rules, &flown);
}
