//! A client that acquires robots, flies paths and receives frames.

pub use crate::backend::Backend;
pub use crate::lease::Claim;
pub use crate::observation::Observation;

use crate::backend::StepAnswer;
use crate::control::{ServerInfo, WorldInfo, WorldSeed};
use crate::errors::{ConnectionError, garbled};
use crate::lease::{Call, Lease};
use crate::left_belief;
use crate::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, RobotResult, StepRequest, WorldResult,
    worlds_of,
};
use crate::payload::split_step_payload;
use emberwatch_model::frame::Frame;
use emberwatch_model::grid::Shape;
use emberwatch_model::path::{Move, path_to_bytes};
use std::ops::Range;
use std::time::Duration;

/// Maximum duration of a step, in addition to the server's deadline.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(5);

/// Maximum duration of any other request. A reset simulates the burn-in of all its worlds, which takes minutes on a
/// busy machine.
pub const CONTROL_TIMEOUT: Duration = Duration::from_secs(600);

/// A lease on consecutive robots of a server, or of worlds in this process. Robots are numbered across all worlds:
/// robot r of world w is `w * R + r`.
///
/// Dropping the client drops its backend, and dropping a connection ends its leases. Unless a method documents other
/// errors, it fails if the server has ended, refuses the request, or sends no valid answer in time. A refused request
/// changes nothing.
pub struct Client<B> {
    backend: B,
    lease: Lease,
    robots: Range<u32>,
    shape: Shape,
    shares_frames: bool,
}

impl<B: Backend> Client<B> {
    /// Acquires robots without moving them. Returns when the burn-in of their worlds is done.
    ///
    /// # Errors
    /// If another client holds a robot, a `Busy` refusal names its process.
    pub fn acquire(mut backend: B, claim: &Claim) -> Result<Self, ConnectionError> {
        let shape = backend.info().shape();
        let shape = shape.map_err(|error| garbled("hello", error))?;
        let (lease, _) = Lease::acquire(&mut backend, claim, CONTROL_TIMEOUT)?;
        Ok(Self {
            backend,
            lease,
            robots: claim.robots.clone(),
            shape,
            shares_frames: false,
        })
    }

    /// Sets whether later frames show what all robots of a world saw, including robots of other clients.
    pub fn share_frames(&mut self, shares: bool) {
        self.shares_frames = shares;
    }

    pub fn info(&self) -> &ServerInfo {
        self.backend.info()
    }

    /// Returns the backend (a connection, or worlds in this process), for requests that have no method here.
    pub fn backend(&mut self) -> &mut B {
        &mut self.backend
    }

    /// Returns the lease's number, for requests that have no method here.
    pub fn lease(&self) -> u64 {
        self.lease.number()
    }

    /// Leaves a belief with the server (see [`left_belief::leave`]).
    ///
    /// # Errors
    /// A refusal if the server has a newer step of the robot's world, or keeps no belief of this size.
    pub fn leave_belief(
        &mut self,
        robot: u32,
        at: &WorldResult,
        kind: &str,
        bytes: &[u8],
    ) -> Result<(), ConnectionError> {
        let place = (self.lease(), robot);
        left_belief::leave(&mut self.backend, place, at, kind, bytes, STEP_TIMEOUT)
    }

    /// Returns the belief of this kind that was left for a robot (see [`left_belief::load`]).
    pub fn left_belief(
        &mut self,
        robot: u32,
        kind: &str,
    ) -> Result<Option<Vec<u8>>, ConnectionError> {
        let left = left_belief::load(&mut self.backend, robot, Some(kind), STEP_TIMEOUT)?;
        Ok(left.map(|left| left.bytes))
    }

    pub fn shape(&self) -> Shape {
        self.shape
    }

    pub fn robots(&self) -> Range<u32> {
        self.robots.clone()
    }

    pub fn worlds_of(&self, robots: &Range<u32>) -> Range<u32> {
        worlds_of(robots.start, robots.len() as u32, self.info().n_robots)
    }

    /// Flies a path of `n_moves` moves with each of these consecutive robots of the lease. A world moves when all its
    /// held robots have a path, or at the server's deadline. Returns each robot's observation after the move.
    ///
    /// # Errors
    /// `Late` if a world moved without these paths, `LeaseLost` if a robot is no longer held, and `WrongPathLength` or
    /// `WrongLength` unless each robot has one path of `n_moves` moves.
    pub fn step(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        let observations = self.step_unless(robots, paths, 0, &|| false)?;
        Ok(observations.expect("invariant: it is never over"))
    }

    /// Flies as [`Self::step`] does, but returns `None` if `is_over` returns true before the worlds have moved.
    /// `is_over` is called periodically, at intervals of [`STEP_TIMEOUT`] plus the server's deadline.
    ///
    /// # Errors
    /// The same as [`Self::step`].
    pub fn step_until(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
        is_over: &dyn Fn() -> bool,
    ) -> Result<Option<Vec<Observation>>, ConnectionError> {
        self.step_unless(robots, paths, 0, is_over)
    }

    /// Flies as [`Self::step`] does, but the frames show every cell.
    ///
    /// # Errors
    /// The same as [`Self::step`], and a refusal if the server's coverage is `path`.
    pub fn step_full(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        let observations = self.step_unless(robots, paths, FLAG_FULL_COVERAGE, &|| false)?;
        Ok(observations.expect("invariant: it is never over"))
    }

    /// Observes robots and their worlds without changing anything. The robots may be held by other clients.
    ///
    /// # Errors
    /// A refusal if the server has no such robot.
    pub fn observe(&mut self, robots: Range<u32>) -> Result<Vec<Observation>, ConnectionError> {
        let request = self.request(Operation::Observe, &robots);
        self.send(Call::new(request, &[], STEP_TIMEOUT))
    }

    /// Returns the observations of robots at an earlier step k.
    ///
    /// # Errors
    /// A `NotKept` refusal contains the nearest step that the server keeps.
    pub fn recall(
        &mut self,
        robots: Range<u32>,
        step: u64,
    ) -> Result<Vec<Observation>, ConnectionError> {
        let request = self.request(Operation::Recall, &robots);
        let steps = vec![step; self.worlds_of(&robots).len()];
        self.send(Call::of_past(request, steps, STEP_TIMEOUT))
    }

    /// Starts new episodes with the given seeds. Returns the worlds when the burn-in is done.
    ///
    /// # Errors
    /// `Busy` if another client holds a robot of these worlds, and `NoLease` if this client holds none.
    pub fn reset(&mut self, seeds: &[WorldSeed]) -> Result<Vec<WorldInfo>, ConnectionError> {
        let worlds = seeds.to_vec();
        self.lease.reset(&mut self.backend, worlds, CONTROL_TIMEOUT)
    }

    /// Extends the lease without flying.
    ///
    /// # Errors
    /// `LeaseLost` if the lease no longer holds any robot.
    pub fn renew(&mut self) -> Result<(), ConnectionError> {
        self.lease.renew(&mut self.backend, STEP_TIMEOUT)
    }

    /// Returns the robots to the server.
    ///
    /// # Errors
    /// `LeaseLost` if the lease no longer holds any robot.
    pub fn release(mut self) -> Result<(), ConnectionError> {
        self.lease.release(&mut self.backend, STEP_TIMEOUT)
    }

    /// Flies as [`Self::step`] does, with the moves of all paths as bytes. Returns the answer's bytes, without a copy
    /// for each robot: the fastest way to step.
    ///
    /// # Errors
    /// The same as [`Self::step`].
    pub fn step_bytes(
        &mut self,
        robots: &Range<u32>,
        moves: &[u8],
    ) -> Result<StepAnswer, ConnectionError> {
        let request = self.request(Operation::Step, robots);
        let answer = self.send_paths(Call::new(request, moves, STEP_TIMEOUT), &|| false)?;
        Ok(answer.expect("invariant: it is never over"))
    }

    fn step_unless(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
        flags: u32,
        is_over: &dyn Fn() -> bool,
    ) -> Result<Option<Vec<Observation>>, ConnectionError> {
        let mut request = self.request(Operation::Step, &robots);
        let n_moves = self.info().n_moves;
        let wrong = paths.iter().map(Vec::len).find(|len| *len != n_moves);
        request.n_moves = wrong.unwrap_or(n_moves) as u32; // The server refuses a wrong length.
        request.flags |= flags;
        let moves: Vec<u8> = paths.iter().flat_map(|path| path_to_bytes(path)).collect();
        let answer = self.send_paths(Call::new(request, &moves, STEP_TIMEOUT), is_over)?;
        answer.map(|it| self.observations(&it)).transpose()
    }

    fn send_paths(
        &mut self,
        paths: Call<'_>,
        is_over: &dyn Fn() -> bool,
    ) -> Result<Option<StepAnswer>, ConnectionError> {
        let (lease, backend) = (&self.lease, &mut self.backend);
        let send = |call: &mut Call<'_>| lease.send(backend, call);
        let flown = lease.send_paths(paths, false, send, || Ok(is_over()))?;
        Ok(flown.map(|(answer, _)| answer))
    }

    fn request(&self, operation: Operation, robots: &Range<u32>) -> StepRequest {
        let flags = if self.shares_frames {
            FLAG_TEAM_FRAMES
        } else {
            0
        };
        self.lease.request(operation, robots, flags)
    }

    fn send(&mut self, mut call: Call<'_>) -> Result<Vec<Observation>, ConnectionError> {
        let answer = self.lease.send(&mut self.backend, &mut call)?;
        self.observations(&answer)
    }

    fn observations(
        &self,
        (reply, payload): &StepAnswer,
    ) -> Result<Vec<Observation>, ConnectionError> {
        let parts = split_step_payload(reply, payload).map_err(|expected| {
            garbled("step", format!("expected a payload of {expected} bytes"))
        })?;
        let (n_observations, n_cells) = (self.info().n_observations, self.shape.n_cells());
        let (team, first_robot) = (self.info().n_robots.max(1), reply.first_robot);
        let is_shared = reply.flags & FLAG_TEAM_FRAMES != 0;
        let observation = |(index, robot): (usize, &RobotResult)| {
            let world = ((first_robot + index as u32) / team - first_robot / team) as usize;
            let bytes = if is_shared { world } else { index } * n_cells;
            let bytes = parts.frames.get(bytes..bytes + n_cells);
            let frame = Frame::from_bytes(self.shape, n_observations, bytes.unwrap_or_default());
            Ok(Observation {
                world: parts.worlds[world],
                robot: *robot,
                frame: frame.map_err(|error| garbled("step", error))?,
            })
        };
        parts.robots.iter().enumerate().map(observation).collect()
    }
}
