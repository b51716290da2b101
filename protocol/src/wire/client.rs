//! A connection with a lease: acquire robots, fly paths, receive frames.

pub use emberwatch_messages::observation::Observation;

use super::connection::{Connection, ConnectionError, StepAnswer, unexpected, worlds_of};
use emberwatch_messages::control::{Reply, Request, ServerInfo, WorldInfo, WorldSeed};
use emberwatch_messages::errors::garbled;
use emberwatch_messages::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, RobotResult, Status, StepRequest,
};
use emberwatch_messages::payload::write_step_body;
use emberwatch_messages::resend::{Flown, until_moved};
use emberwatch_model::frame::Frame;
use emberwatch_model::grid::Shape;
use emberwatch_model::path::{Move, path_to_bytes};
use std::ops::Range;
use std::time::Duration;

/// How long a step may take, beside the server's deadline.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(5);

/// How long anything else may take; resets simulate the burn-in of all their worlds, on a busy machine for minutes.
pub const CONTROL_TIMEOUT: Duration = Duration::from_secs(600);

/// A connection with a lease on consecutive robots, numbered through: robot r of world w is `w * R + r`.
///
/// Dropping it closes the connection, which ends the lease. Unless another is named, errors are a refusal, which changed
/// nothing, a server that has ended, or no good answer in time.
pub struct Client {
    connection: Connection,
    lease: u64,
    robots: Range<u32>,
    /// The step of each world of these robots, as last seen.
    steps: Vec<u64>,
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

impl Client {
    /// Acquires robots, which stay where they are; returns when their worlds are out of their burn-in.
    ///
    /// # Errors
    /// A refusal as `Busy` names the holder of a robot that is taken.
    pub fn acquire(mut connection: Connection, claim: &Claim) -> Result<Self, ConnectionError> {
        let shape = connection.info().shape();
        let shape = shape.map_err(|error| garbled("hello", error))?;
        let request = Request::Acquire {
            first_robot: claim.robots.start,
            n_robots: claim.robots.len() as u32,
            takeover: claim.takeover,
            ttl_millis: claim.time_to_live.map(|time| time.as_millis() as u64),
        };
        let lease = match connection.control(&request, CONTROL_TIMEOUT)? {
            Reply::Lease(lease) => lease,
            other => return Err(unexpected("acquire", &other)),
        };
        Ok(Self {
            connection,
            lease: lease.lease,
            robots: claim.robots.clone(),
            steps: lease.worlds.iter().map(|world| world.step).collect(),
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
        self.connection.info()
    }

    /// The connection.
    pub fn connection(&self) -> &Connection {
        &self.connection
    }

    /// The connection, for requests that have no method here.
    pub fn connection_mut(&mut self) -> &mut Connection {
        &mut self.connection
    }

    /// The lease, for such requests.
    pub fn lease(&self) -> u64 {
        self.lease
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
        let answer = self.connection.step(request, &[], STEP_TIMEOUT)?;
        self.take_note(&answer);
        self.observations(&answer)
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
        let (steps, mut body) = (vec![step; self.worlds_of(&robots).len()], Vec::new());
        write_step_body(&steps, &[], &mut body);
        let answer = self.connection.step(request, &body, STEP_TIMEOUT)?;
        self.observations(&answer)
    }

    /// Starts new episodes with the given seeds; returns the worlds as they are when burn-in is done.
    ///
    /// # Errors
    /// A refusal as `Busy` if another client holds a robot of these worlds, as `NoLease` if this one holds none.
    pub fn reset(&mut self, seeds: &[WorldSeed]) -> Result<Vec<WorldInfo>, ConnectionError> {
        let request = Request::Reset {
            lease: self.lease,
            worlds: seeds.to_vec(),
        };
        match self.connection.control(&request, CONTROL_TIMEOUT)? {
            Reply::Reset { worlds } => {
                for world in &worlds {
                    self.note(world.world, world.step);
                }
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
        let request = Request::Renew { lease: self.lease };
        self.connection.control(&request, STEP_TIMEOUT).map(|_| ())
    }

    /// Gives the robots back.
    ///
    /// # Errors
    /// A refusal as `LeaseLost` if none of them is held any longer.
    pub fn release(mut self) -> Result<(), ConnectionError> {
        let request = Request::Release { lease: self.lease };
        self.connection.control(&request, STEP_TIMEOUT).map(|_| ())
    }

    /// Sends paths for the step at which their worlds were last seen, see [`until_moved`].
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
        let (steps, mut body) = (self.steps_of(&robots), Vec::new());
        let moves: Vec<u8> = paths.iter().flat_map(|path| path_to_bytes(path)).collect();
        write_step_body(&steps, &moves, &mut body);
        let timeout = STEP_TIMEOUT + Duration::from_millis(self.info().deadline_millis);
        let send = |it: &mut Self| match it.connection.step(request, &body, timeout) {
            Err(ConnectionError::Timeout { .. }) => Ok(None),
            answer => {
                let answer = answer?;
                it.take_note(&answer);
                it.observations(&answer).map(Some)
            }
        };
        let look = |it: &mut Self| {
            let seen = it.observe(robots.clone())?;
            Ok((it.steps_of(&robots) != steps).then_some(seen))
        };
        match until_moved(self, send, look, is_over)? {
            Flown::Answered(seen) => Ok(Some(seen)),
            Flown::Observed(seen) => self.flown(&robots, &steps, seen).map(Some),
            Flown::GivenUp => Ok(None),
        }
    }

    /// What robots show whose worlds have moved, if by the step for which their paths were.
    fn flown(
        &self,
        robots: &Range<u32>,
        steps: &[u64],
        seen: Vec<Observation>,
    ) -> Result<Vec<Observation>, ConnectionError> {
        let (team, first) = (self.info().n_robots.max(1), self.worlds_of(robots).start);
        let has_flown = |(robot, seen): (u32, &Observation)| {
            let before = steps[(robot / team - first) as usize];
            let stayed = seen.world.hovered | seen.world.late;
            seen.world.step == before + 1 && stayed >> (robot % team) & 1 == 0
        };
        let mut pairs = robots.clone().zip(&seen);
        match pairs.find(|&pair| !has_flown(pair)) {
            None => Ok(seen),
            Some((_, missed)) => {
                let (status, detail) = (Status::Late, missed.world.step);
                Err(ConnectionError::Refused {
                    status,
                    detail,
                    message: status.explain(detail),
                })
            }
        }
    }

    fn request(&self, operation: Operation, robots: &Range<u32>) -> StepRequest {
        let flags = if self.shares_frames {
            FLAG_TEAM_FRAMES
        } else {
            0
        };
        StepRequest {
            operation: operation as u32,
            lease: self.lease,
            first_robot: robots.start,
            n_robots: robots.len() as u32,
            flags,
            ..StepRequest::default()
        }
    }

    /// The step at which each world of some robots was last seen.
    fn steps_of(&self, robots: &Range<u32>) -> Vec<u64> {
        let first = self.worlds_of(&self.robots).start;
        let step = |world: u32| {
            let index = world.checked_sub(first).map(|index| index as usize);
            // The server refuses robots that are not the client's.
            index.and_then(|index| self.steps.get(index)).copied()
        };
        let worlds = self.worlds_of(robots);
        worlds
            .map(|world| step(world).unwrap_or_default())
            .collect()
    }

    fn take_note(&mut self, answer: &StepAnswer) {
        let worlds = answer.reply.first_robot / self.info().n_robots.max(1)..;
        for (world, result) in worlds.zip(&answer.worlds) {
            self.note(world, result.step);
        }
    }

    fn note(&mut self, world: u32, step: u64) {
        let index = world.checked_sub(self.worlds_of(&self.robots).start);
        if let Some(last) = index.and_then(|index| self.steps.get_mut(index as usize)) {
            *last = step;
        }
    }

    fn observations(&self, answer: &StepAnswer) -> Result<Vec<Observation>, ConnectionError> {
        let (n_observations, n_cells) = (self.info().n_observations, self.shape.n_cells());
        let (team, first_robot) = (self.info().n_robots.max(1), answer.reply.first_robot);
        let is_shared = answer.reply.flags & FLAG_TEAM_FRAMES != 0;
        let observation = |(index, robot): (usize, &RobotResult)| {
            let world = ((first_robot + index as u32) / team - first_robot / team) as usize;
            let bytes = if is_shared { world } else { index } * n_cells;
            let bytes = answer.frames.get(bytes..bytes + n_cells);
            let frame = Frame::from_bytes(self.shape, n_observations, bytes.unwrap_or_default());
            Ok(Observation {
                world: answer.worlds[world],
                robot: *robot,
                frame: frame.map_err(|error| garbled("step", error))?,
            })
        };
        answer.robots.iter().enumerate().map(observation).collect()
    }
}
