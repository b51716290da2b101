//! A client: acquires robots, flies paths, receives frames.

pub use crate::backend::Backend;
pub use crate::observation::Observation;

use crate::backend::StepAnswer;
use crate::control::{Reply, Request, ServerInfo, WorldInfo, WorldSeed};
use crate::errors::{ConnectionError, garbled, unexpected};
use crate::lease::{Call, Lease};
use crate::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, RobotResult, StepRequest, worlds_of,
};
use crate::payload::split_step_payload;
use emberwatch_model::frame::Frame;
use emberwatch_model::grid::Shape;
use emberwatch_model::path::{Move, path_to_bytes};
use std::ops::Range;
use std::time::Duration;

/// How long a step may take, in addition to the server's deadline.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(5);

/// How long anything else may take; resets simulate the burn-in of all their worlds, on a busy machine for minutes.
pub const CONTROL_TIMEOUT: Duration = Duration::from_secs(600);

/// A lease on consecutive robots of a server, or of worlds in this process. Robots are numbered through: robot r of world
/// w is `w * R + r`.
///
/// Dropping it drops the backend; a dropped connection ends its leases. Unless another is named, errors are a refusal,
/// which changed nothing, a server that has ended, or no good answer in time.
pub struct Client<B> {
    backend: B,
    lease: Lease,
    robots: Range<u32>,
    shape: Shape,
    shares_frames: bool,
}

/// Which robots to fly, and how to get them.
#[derive(Debug, Clone)]
pub struct Claim {
    /// Their numbers, at least one.
    pub robots: Range<u32>,
    /// Take them from their holders.
    pub takeover: bool,
    /// The lease ends this long after its last use, at least 0.1 s and at most a day; `None`: the server's default.
    pub time_to_live: Option<Duration>,
}

impl Claim {
    /// Robots that nobody else holds, for the server's default time.
    pub fn new(robots: Range<u32>) -> Self {
        Self {
            robots,
            takeover: false,
            time_to_live: None,
        }
    }
}

impl<B: Backend> Client<B> {
    /// Acquires robots, which stay where they are; returns when their worlds are out of their burn-in.
    ///
    /// # Errors
    /// A refusal as `Busy` names the holder of a robot that is taken.
    pub fn acquire(mut backend: B, claim: &Claim) -> Result<Self, ConnectionError> {
        let shape = backend.info().shape();
        let shape = shape.map_err(|error| garbled("hello", error))?;
        let request = Request::Acquire {
            first_robot: claim.robots.start,
            n_robots: claim.robots.len() as u32,
            takeover: claim.takeover,
            ttl_millis: claim.time_to_live.map(|time| time.as_millis() as u64),
        };
        let given = match backend.control(&request, CONTROL_TIMEOUT)? {
            Reply::Lease(given) => given,
            other => return Err(unexpected("acquire", &other)),
        };
        let lease = Lease::new(backend.info(), given.lease, &claim.robots);
        lease.note_all(&given.worlds);
        Ok(Self {
            backend,
            lease,
            robots: claim.robots.clone(),
            shape,
            shares_frames: false,
        })
    }

    /// Whether frames show from here on what all robots of a world saw, teammates that others fly among them.
    pub fn share_frames(&mut self, shares: bool) {
        self.shares_frames = shares;
    }

    /// What the server said of itself.
    pub fn info(&self) -> &ServerInfo {
        self.backend.info()
    }

    /// The connection or the worlds, for requests that have no method here.
    pub fn backend(&mut self) -> &mut B {
        &mut self.backend
    }

    /// The lease, for such requests.
    pub fn lease(&self) -> u64 {
        self.lease.number()
    }

    /// Height and width of the grid.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// The numbers of its robots.
    pub fn robots(&self) -> Range<u32> {
        self.robots.clone()
    }

    /// The worlds that some robots are in.
    pub fn worlds_of(&self, robots: &Range<u32>) -> Range<u32> {
        worlds_of(robots.start, robots.len() as u32, self.info().n_robots)
    }

    /// Flies a path of `n_moves` moves with each of consecutive robots of the lease. A world moves when all of its held
    /// robots have a path, or at the server's deadline. Returns what each robot shows then.
    ///
    /// # Errors
    /// A refusal as `Late` if a world has moved on without these paths, as `LeaseLost` if a robot is held no longer, as
    /// `WrongPathLength` or `WrongLength` if there is not one path of `n_moves` moves for each robot.
    pub fn step(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        let observations = self.step_unless(robots, paths, 0, &|| false)?;
        Ok(observations.expect("invariant: it is never over"))
    }

    /// As [`Self::step`]; `None` if `is_over` before the worlds have moved. That is checked each [`STEP_TIMEOUT`] and
    /// deadline.
    ///
    /// # Errors
    /// As [`Self::step`].
    pub fn step_until(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
        is_over: &dyn Fn() -> bool,
    ) -> Result<Option<Vec<Observation>>, ConnectionError> {
        self.step_unless(robots, paths, 0, is_over)
    }

    /// As [`Self::step`], with frames that show every cell.
    ///
    /// # Errors
    /// As [`Self::step`]; a refusal if the server's coverage is `path`.
    pub fn step_full(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        let observations = self.step_unless(robots, paths, FLAG_FULL_COVERAGE, &|| false)?;
        Ok(observations.expect("invariant: it is never over"))
    }

    /// What robots and their worlds show now, changing nothing; they may be others' as well.
    ///
    /// # Errors
    /// A refusal if the server has no such robot.
    pub fn observe(&mut self, robots: Range<u32>) -> Result<Vec<Observation>, ConnectionError> {
        let request = self.request(Operation::Observe, &robots);
        self.send(Call::new(request, &[], STEP_TIMEOUT))
    }

    /// What they showed at an earlier step k.
    ///
    /// # Errors
    /// A refusal as `NotKept` tells the nearest step that is kept.
    pub fn recall(
        &mut self,
        robots: Range<u32>,
        step: u64,
    ) -> Result<Vec<Observation>, ConnectionError> {
        let request = self.request(Operation::Recall, &robots);
        let steps = vec![step; self.worlds_of(&robots).len()];
        self.send(Call::of_past(request, steps, STEP_TIMEOUT))
    }

    /// Starts new episodes with the given seeds; returns the worlds as they are when burn-in is done.
    ///
    /// # Errors
    /// A refusal as `Busy` if another client holds a robot of these worlds, as `NoLease` if this one holds none.
    pub fn reset(&mut self, seeds: &[WorldSeed]) -> Result<Vec<WorldInfo>, ConnectionError> {
        let request = Request::Reset {
            lease: self.lease(),
            worlds: seeds.to_vec(),
        };
        match self.backend.control(&request, CONTROL_TIMEOUT)? {
            Reply::Reset { worlds } => {
                self.lease.note_all(&worlds);
                Ok(worlds)
            }
            other => Err(unexpected("reset", &other)),
        }
    }

    /// Extends the lease without acting.
    ///
    /// # Errors
    /// A refusal as `LeaseLost` if none of the robots is held any longer.
    pub fn renew(&mut self) -> Result<(), ConnectionError> {
        let lease = self.lease();
        let renewed = self
            .backend
            .control(&Request::Renew { lease }, STEP_TIMEOUT);
        renewed.map(|_| ())
    }

    /// Gives the robots back.
    ///
    /// # Errors
    /// A refusal as `LeaseLost` if none of them is held any longer.
    pub fn release(mut self) -> Result<(), ConnectionError> {
        let lease = self.lease();
        let released = self
            .backend
            .control(&Request::Release { lease }, STEP_TIMEOUT);
        released.map(|_| ())
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
        request.n_moves = wrong.unwrap_or(n_moves) as u32; // The server refuses others.
        request.flags |= flags;
        let moves: Vec<u8> = paths.iter().flat_map(|path| path_to_bytes(path)).collect();
        let paths = Call::new(request, &moves, STEP_TIMEOUT);
        let (lease, backend) = (&self.lease, &mut self.backend);
        let send = |call: &mut Call<'_>| lease.send(backend, call);
        let answer = lease.fly(paths, false, send, || Ok(is_over()))?;
        answer
            .map(|(answer, _)| self.observations(&answer))
            .transpose()
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
