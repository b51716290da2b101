//! Moves worlds: at once for the request that completes them, or when a deadline passes or a holder leaves. Writes the
//! answers to all requests.

use super::barrier::{Barrier, Ticket, Waiter};
use super::lease::Refusal;
use super::state::{Place, Simulator, Slot, within};
use super::step::numbers;
use crate::world::{Episode, Flown, Rules};
use emberwatch_messages::message::{
    FLAG_TEAM_FRAMES, RobotResult, Status, StepReply, StepRequest, VERSION, WorldResult,
};
use emberwatch_model::UNOBSERVED;
use rayon::iter::{IndexedParallelIterator, IntoParallelRefMutIterator, ParallelIterator};
use std::ops::Range;
use std::time::Instant;

/// Batches of at least so many cells are stepped by several threads: for smaller ones, waking them (tens of
/// microseconds) costs more than it saves at about 1 ns a cell.
const PARALLEL_CELLS: usize = 1 << 17;

impl Simulator {
    /// The next deadline of a world that waits for paths.
    pub fn next_deadline(&self) -> Option<Instant> {
        let waiting = self.waiting_worlds.iter();
        let deadlines = waiting.filter_map(|&world| self.places[world].barrier.deadline);
        deadlines.min()
    }

    /// Withdraws a request whose client no longer waits for its answer.
    pub fn cancel_step(&mut self, now: Instant, ticket: Ticket) {
        for &world in &self.waiting_worlds {
            let barrier = &mut self.places[world].barrier;
            for waiter in barrier.withdraw(|waiter| waiter.ticket == ticket) {
                self.leases.end_wait(now, waiter.request.lease);
            }
        }
        self.forget_idle_worlds();
    }

    /// The next answer to a request that waited; its results and frames go to `payload`. Take all of them before the
    /// next request, so that each shows its own step.
    pub fn next_answer(&mut self, payload: &mut Vec<u8>) -> Option<(Ticket, StepReply)> {
        let (waiter, outcome) = self.settled.pop_front()?;
        payload.clear();
        let reply = match outcome {
            Ok(()) => self.write_present(&waiter.request, payload),
            Err(refusal) => self.refuse(&waiter.request, refusal),
        };
        Some((waiter.ticket, reply))
    }

    /// The worlds that moved without a request of their own since the last call.
    pub fn take_moved(&mut self) -> Vec<usize> {
        std::mem::take(&mut self.moved)
    }

    /// Withdraws the paths of those who have lost their robots, and moves the worlds that wait for nobody any more.
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
                self.advance(now, world..world + 1);
                self.moved.push(world);
            }
        }
        self.forget_idle_worlds();
    }

    /// Refuses all requests that wait for a world which is reset or replaced.
    pub(super) fn refuse_waiting(&mut self, now: Instant, world: usize) {
        for waiter in self.places[world].barrier.withdraw(|_| true) {
            let refusal = Refusal::new(Status::Resetting, world as u64);
            self.settle_waiter(now, waiter, Err(refusal));
        }
        self.forget_idle_worlds();
    }

    /// Whether a world moves now.
    pub(super) fn is_complete(&self, now: Instant, world: usize) -> bool {
        let held = self.leases.held(self.robots_of(world));
        self.places[world].barrier.is_complete(held, now)
    }

    /// Moves worlds once, with the paths that they have.
    pub(super) fn advance(&mut self, now: Instant, worlds: Range<usize>) {
        let (rules, leases) = (&self.spec.rules, &self.leases);
        let team = rules.n_robots;
        let step = |(world, place): (usize, &mut Place)| {
            let held = leases.held(world * team..(world + 1) * team);
            if let Slot::Ready(episode) = &mut place.slot {
                step(rules, episode, &place.barrier, held);
            }
        };
        let n_cells = rules.shape.n_cells() + team * rules.n_moves;
        let places = &mut self.places[worlds.clone()];
        if places.len() > 1 && places.len() * n_cells >= PARALLEL_CELLS {
            self.threads.install(|| {
                let places = places.par_iter_mut().enumerate();
                places.for_each(|(index, place)| step((worlds.start + index, place)));
            });
        } else {
            worlds.clone().zip(places).for_each(step);
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

    pub(super) fn refuse(&mut self, request: &StepRequest, refusal: Refusal) -> StepReply {
        self.n_refused += 1;
        StepReply {
            status: refusal.status as u32,
            detail: refusal.detail,
            ..self.header(request)
        }
    }

    fn header(&self, request: &StepRequest) -> StepReply {
        StepReply {
            version: VERSION,
            sequence: request.sequence,
            first_robot: request.first_robot,
            flags: request.flags,
            height: self.spec.rules.shape.height() as u32,
            width: self.spec.rules.shape.width() as u32,
            ..StepReply::default()
        }
    }

    /// The header of a good answer, and the robots that it is about.
    fn answer(&self, request: &StepRequest) -> (StepReply, Range<usize>) {
        let first = request.first_robot as usize;
        let robots = first..first + request.n_robots as usize;
        let reply = StepReply {
            status: Status::Ok as u32,
            n_robots: request.n_robots,
            n_worlds: self.worlds_of(&robots).len() as u32,
            ..self.header(request)
        };
        (reply, robots)
    }

    /// Writes robots as they are now.
    pub(super) fn write_present(&self, request: &StepRequest, payload: &mut Vec<u8>) -> StepReply {
        let (reply, robots) = self.answer(request);
        let worlds = self.worlds_of(&robots);
        let episodes = || worlds.clone().filter_map(|world| self.episode(world));
        let own = || {
            let (worlds, robots) = (worlds.clone(), robots.clone());
            let all = worlds.filter_map(|world| Some((world, self.episode(world)?)));
            all.flat_map(move |(world, episode)| {
                &episode.robots()[within(&robots, self.robots_of(world))]
            })
        };
        for episode in episodes() {
            payload.extend_from_slice(bytemuck::bytes_of::<WorldResult>(episode.result()));
        }
        for robot in own() {
            payload.extend_from_slice(bytemuck::bytes_of::<RobotResult>(robot.result()));
        }
        if request.flags & FLAG_TEAM_FRAMES == 0 {
            own().for_each(|robot| payload.extend_from_slice(robot.frame().as_bytes()));
            return reply;
        }
        for episode in episodes() {
            let frame = blank(payload, self.spec.rules.shape.n_cells());
            for robot in episode.robots() {
                let seen = robot.frame().as_bytes();
                // Two readings of one cell in one step are the same.
                (frame.iter_mut().zip(seen)).for_each(|(to, &value)| *to = value.min(*to));
            }
        }
        reply
    }

    /// Writes robots as they were at steps that are kept.
    pub(super) fn write_past(
        &self,
        request: &StepRequest,
        steps: &[u8],
        payload: &mut Vec<u8>,
    ) -> StepReply {
        let (reply, robots) = self.answer(request);
        let worlds = self.worlds_of(&robots).zip(numbers(steps));
        let past = worlds.filter_map(|(world, step)| {
            let past = self.episode(world)?.recall(step).ok()?;
            Some((past, within(&robots, self.robots_of(world))))
        });
        let past: Vec<_> = past.collect();
        for (past, _) in &past {
            payload.extend_from_slice(bytemuck::bytes_of(&past.result));
        }
        for robot in past
            .iter()
            .flat_map(|(past, own)| &past.robots[own.clone()])
        {
            payload.extend_from_slice(bytemuck::bytes_of(&robot.result));
        }
        let n_cells = self.spec.rules.shape.n_cells();
        for (past, own) in &past {
            if request.flags & FLAG_TEAM_FRAMES == 0 {
                for robot in &past.robots[own.clone()] {
                    robot.write_over(blank(payload, n_cells));
                }
            } else {
                let frame = blank(payload, n_cells);
                past.robots.iter().for_each(|robot| robot.write_over(frame));
            }
        }
        reply
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

/// Appends a frame in which nothing was observed.
fn blank(payload: &mut Vec<u8>, n_cells: usize) -> &mut [u8] {
    let start = payload.len();
    payload.resize(start + n_cells, UNOBSERVED);
    &mut payload[start..]
}
