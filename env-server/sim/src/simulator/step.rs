//! Step requests: checks of the whole request, then a step, an observation or a recall.
//!
//! A refused request changes nothing. Clients are not trusted: no bytes or numbers in a request may cause a panic.
//!
//! The checks run in this order. Version, operation, robots and flags come first, and the memory for the answer comes
//! last. In between, a step request is checked for path length, payload length, moves, coverage, lease, completeness,
//! readiness (`resetting`, `episode_over`), k and waiting paths (`busy`). An `observe` request is checked for payload
//! length and readiness. A `recall` request is checked for the same, and for whether the steps are still in the
//! history.

use super::barrier::{Ticket, Waiter, mask};
use super::lease::{ClientId, Refusal};
use super::state::{Simulator, within};
use emberwatch_messages::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, Status, StepReply, StepRequest, VERSION,
};
use emberwatch_model::Coverage;
use emberwatch_model::path::{MoveError, check_moves};
use std::ops::Range;
use std::time::{Duration, Instant};

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Stepped {
    Reply(StepReply),
    /// The request waits until its world moves. [`Simulator::next_answer`] then returns the answer.
    Waits(Ticket),
}

enum Granted<'a> {
    /// The payload already contains the answer.
    Written,
    Present,
    /// The answer shows past steps. Contains one step number for each world, as bytes.
    Past(&'a [u8]),
    Waits(Ticket),
}

impl Simulator {
    /// Answers a step request or makes it wait. Writes results and frames, if any, to `payload`.
    pub fn step(
        &mut self,
        now: Instant,
        client: ClientId,
        request: &StepRequest,
        body: &[u8],
        payload: &mut Vec<u8>,
    ) -> Stepped {
        match self.try_step(now, client, request, body, payload) {
            Ok(Granted::Waits(ticket)) => {
                payload.clear();
                Stepped::Waits(ticket)
            }
            Ok(Granted::Written) => Stepped::Reply(self.answer(request).0),
            Ok(Granted::Present) => Stepped::Reply(self.write_present(request, payload)),
            Ok(Granted::Past(steps)) => Stepped::Reply(self.write_past(request, steps, payload)),
            Err(refusal) => {
                payload.clear();
                Stepped::Reply(self.refuse(request, refusal))
            }
        }
    }

    fn try_step<'a>(
        &mut self,
        now: Instant,
        client: ClientId,
        request: &StepRequest,
        body: &'a [u8],
        payload: &mut Vec<u8>,
    ) -> Result<Granted<'a>, Refusal> {
        if request.version != VERSION {
            return Err(Refusal::new(Status::VersionMismatch, VERSION.into()));
        }
        let operation = Operation::try_from(request.operation)
            .map_err(|unknown| Refusal::new(Status::UnknownOperation, unknown.value.into()))?;
        let robots = self.robot_range(request.first_robot, request.n_robots)?;
        check_flags(operation, request.flags)?;
        match operation {
            Operation::Observe => {
                check_length(body, 0)?;
                self.check_present(&self.worlds_of(&robots))?;
                self.reserve(request, payload)?;
                Ok(Granted::Present)
            }
            Operation::Recall => {
                let worlds = self.worlds_of(&robots);
                check_length(body, worlds.len() * size_of::<u64>())?;
                self.check_present(&worlds)?;
                self.check_kept(worlds, body)?;
                self.reserve(request, payload)?;
                Ok(Granted::Past(body))
            }
            Operation::Step => {
                let coverage = self.check_paths(&robots, request, body)?;
                self.leases.use_lease(now, request.lease, client, &robots)?;
                self.check_whole(client, &robots)?;
                self.check_ready(&robots, body)?;
                self.check_new(client, &robots)?;
                self.reserve(request, payload)?;
                let waiting = self.put_paths(now, client, request, body, coverage, payload);
                Ok(waiting.map_or(Granted::Written, Granted::Waits))
            }
        }
    }

    /// Stores the paths of a checked request. If no path is missing, moves the request's worlds, writes the answer and
    /// returns `None`. Otherwise returns the ticket of the waiting request.
    fn put_paths(
        &mut self,
        now: Instant,
        client: ClientId,
        request: &StepRequest,
        body: &[u8],
        coverage: Coverage,
        payload: &mut [u8],
    ) -> Option<Ticket> {
        let (first, n_robots) = (request.first_robot as usize, request.n_robots as usize);
        let worlds = self.worlds_of(&(first..first + n_robots));
        let n_moves = self.spec.rules.n_moves;
        let mut paths = &body[worlds.len() * size_of::<u64>()..];
        let is_full = coverage == Coverage::Full;
        for world in worlds.clone() {
            let robots = within(&(first..first + n_robots), self.robots_of(world));
            let (own, rest) = paths.split_at(robots.len() * n_moves);
            let barrier = &mut self.places[world].barrier;
            barrier.put(robots.start, n_moves, own, is_full);
            paths = rest;
        }
        // A request for several worlds includes all held robots of these worlds, so no path is missing.
        if worlds.len() > 1 || self.is_complete(now, worlds.start) {
            let parts = self.parts(request, payload);
            self.advance(now, worlds, Some(parts));
            return None;
        }
        self.leases.begin_wait(request.lease);
        Some(self.wait(now, client, request, worlds.start))
    }

    fn wait(
        &mut self,
        now: Instant,
        client: ClientId,
        request: &StepRequest,
        world: usize,
    ) -> Ticket {
        let ticket = self.new_ticket();
        let first_robot = self.robots_of(world).start;
        let barrier = &mut self.places[world].barrier;
        barrier.waiters.push(Waiter {
            ticket,
            client,
            request: *request,
            robots: mask(
                request.first_robot as usize - first_robot,
                request.n_robots as usize,
            ),
        });
        let deadline_millis = self.checked.config.deadline_millis;
        if barrier.deadline.is_none() && deadline_millis > 0 {
            barrier.deadline = Some(now + Duration::from_millis(deadline_millis));
        }
        if barrier.waiters.len() == 1 {
            self.waiting_worlds.push(world);
        }
        ticket
    }

    fn check_kept(&self, worlds: Range<usize>, steps: &[u8]) -> Result<(), Refusal> {
        let mut episodes = worlds
            .filter_map(|world| self.episode(world))
            .zip(numbers(steps));
        let missing = episodes.find_map(|(episode, step)| episode.recall(step).err());
        missing.map_or(Ok(()), |nearest| {
            Err(Refusal::new(Status::NotKept, nearest))
        })
    }

    fn check_paths(
        &self,
        robots: &Range<usize>,
        request: &StepRequest,
        body: &[u8],
    ) -> Result<Coverage, Refusal> {
        let n_moves = self.spec.rules.n_moves;
        if request.n_moves as usize != n_moves {
            return Err(Refusal::new(Status::WrongPathLength, n_moves as u64));
        }
        let n_steps = self.worlds_of(robots).len() * size_of::<u64>();
        check_length(body, n_steps + robots.len() * n_moves)?;
        check_moves(&body[n_steps..]).map_err(|MoveError { index, .. }| {
            Refusal::new(Status::BadMove, (n_steps + index) as u64)
        })?;
        let asks_full = request.flags & FLAG_FULL_COVERAGE != 0;
        let coverage = self.checked.config.coverage.coverage(asks_full);
        coverage.map_err(|status| Refusal::new(status, 0))
    }

    /// Checks that a request for one world includes all robots that its client holds there, and that a request for
    /// several worlds includes all held robots of these worlds. Looks only at the first and the last world, because the
    /// robots of a request are consecutive.
    fn check_whole(&self, client: ClientId, robots: &Range<usize>) -> Result<(), Refusal> {
        let (team, worlds) = (self.spec.rules.n_robots, self.worlds_of(robots));
        for world in [worlds.start, worlds.end - 1] {
            let all = world * team..(world + 1) * team;
            let mut others = all.filter(|robot| !robots.contains(robot));
            let missing = others.find(|&robot| {
                let holder = self.leases.holder(robot);
                holder.is_some_and(|holder| worlds.len() > 1 || holder.client == client)
            });
            if let Some(robot) = missing {
                return Err(Refusal::new(Status::Incomplete, robot as u64));
            }
        }
        Ok(())
    }

    /// Checks that none of these robots already has a path for the next step. A client with two ports could otherwise
    /// send a second path.
    fn check_new(&self, client: ClientId, robots: &Range<usize>) -> Result<(), Refusal> {
        for world in self.worlds_of(robots) {
            let own = within(robots, self.robots_of(world));
            if self.places[world].barrier.ready & mask(own.start, own.len()) != 0 {
                return Err(Refusal::new(Status::Busy, client.pid.into()));
            }
        }
        Ok(())
    }

    fn check_ready(&self, robots: &Range<usize>, body: &[u8]) -> Result<(), Refusal> {
        for (world, step) in self.worlds_of(robots).zip(numbers(body)) {
            let Some(episode) = self.episode(world) else {
                return Err(Refusal::new(Status::Resetting, world as u64));
            };
            if episode.is_over() {
                return Err(Refusal::new(Status::EpisodeOver, world as u64));
            }
            let present = episode.outcome().step;
            if step < present {
                return Err(Refusal::new(Status::Late, present));
            }
            if step > present {
                return Err(Refusal::new(Status::Early, present));
            }
        }
        Ok(())
    }
}

fn check_flags(operation: Operation, flags: u32) -> Result<(), Refusal> {
    let allowed = match operation {
        Operation::Step => FLAG_FULL_COVERAGE | FLAG_TEAM_FRAMES,
        Operation::Observe | Operation::Recall => FLAG_TEAM_FRAMES,
    };
    if flags & !allowed != 0 {
        return Err(Refusal::new(Status::UnknownFlags, flags.into()));
    }
    Ok(())
}

fn check_length(body: &[u8], expected: usize) -> Result<(), Refusal> {
    if body.len() == expected {
        return Ok(());
    }
    Err(Refusal::new(Status::WrongLength, expected as u64))
}

pub(super) fn numbers(bytes: &[u8]) -> impl Iterator<Item = u64> {
    let (numbers, _) = bytes.as_chunks::<8>();
    numbers.iter().map(|&bytes| u64::from_ne_bytes(bytes))
}
