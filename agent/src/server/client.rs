//! The agent's end of the wire: acquire robots, fly paths, receive frames.

use crate::server::errors::refused;
use protocol::channels::Instance;
use protocol::connection::{ConnectionError, StepAnswer, unexpected, worlds_of};
use protocol::control::{Reply, Request, ServerInfo, WorldInfo, WorldSeed};
use protocol::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, RobotResult, Status, StepRequest, WorldResult,
};
use protocol::path::path_to_bytes;
use protocol::payload::write_step_body;
use protocol::{Cell, Connection, Frame, Move, Shape};
use std::fmt::Display;
use std::ops::Range;
use std::os::fd::BorrowedFd;
use std::time::Duration;

/// How this program names itself to servers.
pub const CLIENT_NAME: &str = concat!("emberwatch-agent ", env!("CARGO_PKG_VERSION"));

/// How long a step may take, beside the server's deadline.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(5);

/// How long anything else may take; resets simulate the burn-in of all their worlds.
pub const CONTROL_TIMEOUT: Duration = Duration::from_secs(120);

/// What a robot's world shows after a step, or when the robot is taken over.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    pub world: WorldResult,
    pub robot: RobotResult,
    /// What the robot saw, or all robots of its world where a client asks for that.
    pub frame: Frame,
}

/// A connection with a lease on consecutive robots, numbered through: robot r of world w is `w * R + r`.
pub struct Client {
    pub(super) connection: Connection,
    pub(super) lease: u64,
    robots: Range<u32>,
    /// The step of each world of these robots, as last seen.
    steps: Vec<u64>,
    shape: Shape,
    shares_frames: bool,
}

/// Which robots to fly, and how to get them.
#[derive(Debug, Clone)]
pub struct Claim {
    pub robots: Range<u32>,
    /// Take them from their holder.
    pub takeover: bool,
    /// The lease ends this long after its last use; `None`: the server's default.
    pub time_to_live: Option<Duration>,
}

/// Which step of which run a world shows, and from where: seed, episode, step k, the robot's row and column.
pub type Place = [u64; 5];

impl Observation {
    /// Which step of which run this is.
    pub fn place(&self) -> Place {
        let (world, [row, col]) = (&self.world, [self.robot.row, self.robot.col]);
        [
            world.seed,
            world.episode,
            world.step,
            row.into(),
            col.into(),
        ]
    }

    /// Where the robot is.
    pub fn cell(&self) -> Cell {
        cell(&self.robot)
    }
}

/// Where a robot is.
pub fn cell(robot: &RobotResult) -> Cell {
    Cell {
        row: robot.row as usize,
        col: robot.col as usize,
    }
}

/// Where a robot's last path began.
pub fn start(robot: &RobotResult) -> Cell {
    Cell {
        row: robot.start_row as usize,
        col: robot.start_col as usize,
    }
}

impl Client {
    /// Acquires robots, which stay where they are, and observes them.
    pub fn acquire_and_observe(
        instance: &Instance,
        robots: Range<u32>,
        takeover: bool,
    ) -> Result<(Self, Vec<Observation>), ConnectionError> {
        let mut client = Self::acquire(
            instance,
            &Claim {
                robots,
                takeover,
                time_to_live: None,
            },
        )?;
        let observations = client.observe(client.robots())?;
        Ok((client, observations))
    }

    /// Connects and acquires robots; they stay where they are.
    ///
    /// # Errors
    /// [`ConnectionError`]; a refusal names the holder of a robot that is taken.
    pub fn acquire(instance: &Instance, claim: &Claim) -> Result<Self, ConnectionError> {
        let mut connection = Connection::open(instance, CLIENT_NAME, CONTROL_TIMEOUT)?;
        let shape = shape_of(connection.info())?;
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

    /// Flies a path with each of consecutive robots. Their world moves when everybody has sent a path who holds one of
    /// its robots.
    ///
    /// # Errors
    /// [`ConnectionError`]; `Late` if the world has moved on without these paths.
    pub fn step(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        let observations = self.step_unless(robots, paths, 0, &|| false)?;
        Ok(observations.expect("invariant: it is never over"))
    }

    /// As [`Self::step`]; `None` if `is_over` before the world has moved, which is checked after each timeout.
    pub fn step_until(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
        is_over: &dyn Fn() -> bool,
    ) -> Result<Option<Vec<Observation>>, ConnectionError> {
        self.step_unless(robots, paths, 0, is_over)
    }

    /// As [`Self::step`], with robots in ascending order: one message for all that are consecutive.
    pub fn step_some(
        &mut self,
        robots: &[u32],
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        let mut observations = Vec::with_capacity(robots.len());
        for run in robots.chunk_by(|robot, next| robot + 1 == *next) {
            let (first, n_robots) = (run[0], run.len());
            let paths = &paths[observations.len()..][..n_robots];
            observations.extend(self.step(first..first + n_robots as u32, paths)?);
        }
        Ok(observations)
    }

    /// As [`Self::step`], asking for full frames.
    ///
    /// # Errors
    /// A refusal, unless the server's coverage is `client` or `full`.
    pub fn step_full(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        let observations = self.step_unless(robots, paths, FLAG_FULL_COVERAGE, &|| false)?;
        Ok(observations.expect("invariant: it is never over"))
    }

    /// What robots and their worlds show now, changing nothing.
    pub fn observe(&mut self, robots: Range<u32>) -> Result<Vec<Observation>, ConnectionError> {
        let request = self.request(Operation::Observe, &robots);
        let answer = self.connection.step(request, &[], STEP_TIMEOUT)?;
        self.take_note(&answer);
        self.observations(&answer)
    }

    /// What they showed at an earlier step k.
    ///
    /// # Errors
    /// [`ConnectionError`]; a refusal as `NotKept` tells the nearest step that is kept.
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

    /// Starts new episodes with the given seeds; returns when burn-in is done.
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
    pub fn renew(&mut self) -> Result<(), ConnectionError> {
        let request = Request::Renew { lease: self.lease };
        self.connection.control(&request, STEP_TIMEOUT).map(|_| ())
    }

    /// The server's process: readable when it has ended.
    pub fn server_process(&self) -> BorrowedFd<'_> {
        self.connection.server_process()
    }

    /// Checks whether the server lives, without asking it.
    pub fn check_server(&self) -> Result<(), ConnectionError> {
        self.connection.check_server()
    }

    pub fn release(mut self) -> Result<(), ConnectionError> {
        let request = Request::Release { lease: self.lease };
        self.connection.control(&request, STEP_TIMEOUT).map(|_| ())
    }

    /// Sends paths for the step at which their worlds were last seen, again after each timeout: a slow teammate is waited
    /// for, a silent server is not.
    fn step_unless(
        &mut self,
        robots: Range<u32>,
        paths: &[Vec<Move>],
        flags: u32,
        is_over: &dyn Fn() -> bool,
    ) -> Result<Option<Vec<Observation>>, ConnectionError> {
        let mut request = self.request(Operation::Step, &robots);
        request.n_moves = paths.first().map_or(0, Vec::len) as u32;
        request.flags |= flags;
        let (steps, mut body) = (self.steps_of(&robots), Vec::new());
        let moves: Vec<u8> = paths.iter().flat_map(|path| path_to_bytes(path)).collect();
        write_step_body(&steps, &moves, &mut body);
        let timeout = STEP_TIMEOUT + Duration::from_millis(self.info().deadline_millis);
        loop {
            match self.connection.step(request, &body, timeout) {
                Err(ConnectionError::Timeout { .. }) => {}
                answer => {
                    let answer = answer?;
                    self.take_note(&answer);
                    return self.observations(&answer).map(Some);
                }
            }
            let seen = self.observe(robots.clone())?;
            if self.steps_of(&robots) != steps {
                return self.flown(&robots, &steps, seen).map(Some);
            }
            if is_over() {
                return Ok(None);
            }
        }
    }

    /// What robots show whose worlds have moved, if by the step for which their paths were.
    fn flown(
        &self,
        robots: &Range<u32>,
        steps: &[u64],
        seen: Vec<Observation>,
    ) -> Result<Vec<Observation>, ConnectionError> {
        let (team, first) = (self.info().n_robots, self.worlds_of(robots).start);
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
                Err(refused(status, detail, status.explain(detail)))
            }
        }
    }

    fn request(&self, operation: Operation, robots: &Range<u32>) -> StepRequest {
        let flags = match self.shares_frames {
            true => FLAG_TEAM_FRAMES,
            false => 0,
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
                frame: frame.map_err(|error| garbled("step", &error))?,
            })
        };
        answer.robots.iter().enumerate().map(observation).collect()
    }
}

pub(super) fn garbled(what: &'static str, problem: &dyn Display) -> ConnectionError {
    ConnectionError::Garbled {
        what,
        problem: problem.to_string(),
    }
}

/// A server's grid.
pub fn shape_of(info: &ServerInfo) -> Result<Shape, ConnectionError> {
    let shape = Shape::new(info.height, info.width);
    shape.map_err(|error| garbled("hello", &error))
}
