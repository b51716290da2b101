//! The agent's end of the wire: acquire worlds, fly paths, receive frames.

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use protocol::channels::{ChannelError, Instance};
use protocol::connection::{ConnectionError, StepAnswer, unexpected};
use protocol::control::{
    LeftPart, MAX_BELIEF_PART, Reply, Request, ServerInfo, WorldInfo, WorldSeed,
};
use protocol::message::{FLAG_FULL_COVERAGE, Operation, Status, StepRequest, StepResult};
use protocol::path::path_to_bytes;
use protocol::{Cell, Connection, Frame, Move, Shape};
use std::fmt::Display;
use std::ops::Range;
use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

/// How this program names itself to servers.
const CLIENT_NAME: &str = concat!("emberwatch-agent ", env!("CARGO_PKG_VERSION"));

/// How long a step may take.
pub const STEP_TIMEOUT: Duration = Duration::from_secs(5);

/// How long to wait between attempts to reach a server that is away.
pub const RETRY_INTERVAL: Duration = Duration::from_millis(200);

/// How long anything else may take; resets simulate the burn-in of all their worlds.
pub const CONTROL_TIMEOUT: Duration = Duration::from_secs(120);

/// What a world shows after a step, or when it is taken over.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    pub result: StepResult,
    pub frame: Frame,
}

/// A connection with a lease on consecutive worlds.
pub struct Client {
    connection: Connection,
    lease: u64,
    worlds: Range<u32>,
    shape: Shape,
}

/// Which worlds to act on, and how to get them.
#[derive(Debug, Clone)]
pub struct Claim {
    pub worlds: Range<u32>,
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
        let StepResult { row, col, .. } = self.result;
        let [row, col] = [row, col].map(u64::from);
        [
            self.result.seed,
            self.result.episode,
            self.result.step,
            row,
            col,
        ]
    }

    pub fn robot(&self) -> Cell {
        Cell {
            row: self.result.row as usize,
            col: self.result.col as usize,
        }
    }
}

impl Client {
    /// Acquires worlds, which stay where they are, and observes them.
    pub fn acquire_and_observe(
        instance: &Instance,
        worlds: Range<u32>,
        takeover: bool,
    ) -> Result<(Self, Vec<Observation>), ConnectionError> {
        let mut client = Self::acquire(
            instance,
            &Claim {
                worlds,
                takeover,
                time_to_live: None,
            },
        )?;
        let observations = client.observe(client.worlds())?;
        Ok((client, observations))
    }

    /// Connects and acquires worlds; they stay where they are.
    ///
    /// # Errors
    /// [`ConnectionError`]; a refusal names the holder of a world that is taken.
    pub fn acquire(instance: &Instance, claim: &Claim) -> Result<Self, ConnectionError> {
        let mut connection = Connection::open(instance, CLIENT_NAME, CONTROL_TIMEOUT)?;
        let shape = shape_of(connection.info())?;
        let request = Request::Acquire {
            first_world: claim.worlds.start,
            n_worlds: claim.worlds.len() as u32,
            takeover: claim.takeover,
            ttl_millis: claim.time_to_live.map(|time| time.as_millis() as u64),
        };
        let lease = match connection.control(&request, CONTROL_TIMEOUT)? {
            Reply::Lease(lease) => lease.lease,
            other => return Err(unexpected("acquire", &other)),
        };
        Ok(Self {
            connection,
            lease,
            worlds: claim.worlds.clone(),
            shape,
        })
    }

    /// What the server said of itself.
    pub fn info(&self) -> &ServerInfo {
        self.connection.info()
    }

    pub fn shape(&self) -> Shape {
        self.shape
    }

    pub fn worlds(&self) -> Range<u32> {
        self.worlds.clone()
    }

    /// Flies one path in each of consecutive worlds.
    ///
    /// # Errors
    /// [`ConnectionError`]; after a timeout, [`Self::observe`] tells whether the step was made.
    pub fn step(
        &mut self,
        worlds: Range<u32>,
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        self.step_with_flags(worlds, paths, 0)
    }

    /// As [`Self::step`], in worlds in ascending order: one message for all that are consecutive.
    pub fn step_some(
        &mut self,
        worlds: &[u32],
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        let mut observations = Vec::with_capacity(worlds.len());
        for run in worlds.chunk_by(|world, next| world + 1 == *next) {
            let (first, n_worlds) = (run[0], run.len());
            let paths = &paths[observations.len()..][..n_worlds];
            observations.extend(self.step(first..first + n_worlds as u32, paths)?);
        }
        Ok(observations)
    }

    /// As [`Self::step`], asking for full frames.
    ///
    /// # Errors
    /// A refusal, unless the server's coverage is `client` or `full`.
    pub fn step_full(
        &mut self,
        worlds: Range<u32>,
        paths: &[Vec<Move>],
    ) -> Result<Vec<Observation>, ConnectionError> {
        self.step_with_flags(worlds, paths, FLAG_FULL_COVERAGE)
    }

    /// The worlds as they are, changing nothing.
    pub fn observe(&mut self, worlds: Range<u32>) -> Result<Vec<Observation>, ConnectionError> {
        let request = self.request(Operation::Observe, &worlds);
        let answer = self.connection.step(request, &[], STEP_TIMEOUT)?;
        self.observations(&answer)
    }

    /// What the worlds showed at an earlier step k.
    ///
    /// # Errors
    /// [`ConnectionError`]; a refusal as `NotKept` tells the nearest step that is kept.
    pub fn recall(
        &mut self,
        worlds: Range<u32>,
        step: u64,
    ) -> Result<Vec<Observation>, ConnectionError> {
        let request = StepRequest {
            step,
            ..self.request(Operation::Recall, &worlds)
        };
        let answer = self.connection.step(request, &[], STEP_TIMEOUT)?;
        self.observations(&answer)
    }

    /// Leaves a belief about a world, as it stands after a result, for the next agent.
    pub fn leave_belief(
        &mut self,
        world: u32,
        at: &StepResult,
        kind: &str,
        bytes: &[u8],
    ) -> Result<(), ConnectionError> {
        for (index, part) in bytes.chunks(MAX_BELIEF_PART).enumerate() {
            let request = Request::LeaveBelief(LeftPart {
                lease: self.lease,
                world,
                episode: at.episode,
                step: at.step,
                kind: kind.into(),
                offset: (index * MAX_BELIEF_PART) as u64,
                length: bytes.len() as u64,
                data: BASE64.encode(part),
            });
            self.connection.control(&request, STEP_TIMEOUT)?;
        }
        Ok(())
    }

    /// The belief that was left about a world as it stands, if it is of a kind.
    pub fn belief(&mut self, world: u32, kind: &str) -> Result<Option<Vec<u8>>, ConnectionError> {
        let (mut first, mut bytes) = (None, Vec::new());
        loop {
            let offset = bytes.len() as u64;
            let request = Request::Belief { world, offset };
            match self.connection.control(&request, STEP_TIMEOUT) {
                Ok(Reply::Belief { info, data, .. }) if info.kind == kind => {
                    let part = BASE64
                        .decode(data)
                        .map_err(|error| garbled("belief", &error))?;
                    bytes.extend_from_slice(&part);
                    let (is_last, is_whole) = (part.is_empty(), bytes.len() as u64 == info.length);
                    if *first.get_or_insert_with(|| info.clone()) != info {
                        return Ok(None); // Another one was left meanwhile.
                    }
                    if is_last || is_whole {
                        return Ok(is_whole.then_some(bytes));
                    }
                }
                // Of another kind, none, or a server that knows no beliefs.
                Ok(Reply::Belief { .. }) | Err(ConnectionError::Refused { .. }) => return Ok(None),
                Ok(other) => return Err(unexpected("belief", &other)),
                Err(error) => return Err(error),
            }
        }
    }

    /// Starts new episodes with the given seeds; returns when burn-in is done.
    pub fn reset(&mut self, seeds: &[WorldSeed]) -> Result<Vec<WorldInfo>, ConnectionError> {
        let request = Request::Reset {
            lease: self.lease,
            worlds: seeds.to_vec(),
        };
        match self.connection.control(&request, CONTROL_TIMEOUT)? {
            Reply::Reset { worlds } => Ok(worlds),
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

    /// Looks whether the server lives, without asking it.
    pub fn check_server(&self) -> Result<(), ConnectionError> {
        self.connection.check_server()
    }

    pub fn release(mut self) -> Result<(), ConnectionError> {
        let request = Request::Release { lease: self.lease };
        self.connection.control(&request, STEP_TIMEOUT).map(|_| ())
    }

    fn step_with_flags(
        &mut self,
        worlds: Range<u32>,
        paths: &[Vec<Move>],
        flags: u32,
    ) -> Result<Vec<Observation>, ConnectionError> {
        let bytes: Vec<u8> = paths.iter().flat_map(|path| path_to_bytes(path)).collect();
        let n_moves = paths.first().map_or(0, Vec::len) as u32;
        let request = StepRequest {
            n_moves,
            flags,
            ..self.request(Operation::Step, &worlds)
        };
        let answer = self.connection.step(request, &bytes, STEP_TIMEOUT)?;
        self.observations(&answer)
    }

    fn request(&self, operation: Operation, worlds: &Range<u32>) -> StepRequest {
        StepRequest {
            operation: operation as u32,
            lease: self.lease,
            first_world: worlds.start,
            n_worlds: worlds.len() as u32,
            ..StepRequest::default()
        }
    }

    fn observations(&self, answer: &StepAnswer) -> Result<Vec<Observation>, ConnectionError> {
        let n_observations = self.info().n_observations;
        let frames = answer.frames.chunks_exact(self.shape.n_cells());
        let observation = |(result, bytes): (&StepResult, &[u8])| {
            let frame = Frame::from_bytes(self.shape, n_observations, bytes);
            Ok(Observation {
                result: *result,
                frame: frame.map_err(|error| garbled("step", &error))?,
            })
        };
        answer.results.iter().zip(frames).map(observation).collect()
    }
}

fn garbled(what: &'static str, problem: &dyn Display) -> ConnectionError {
    ConnectionError::Garbled {
        what,
        problem: problem.to_string(),
    }
}

/// What a server says of itself, from a connection of its own.
pub fn server_info(instance: &Instance) -> Result<ServerInfo, ConnectionError> {
    let connection = Connection::open(instance, CLIENT_NAME, STEP_TIMEOUT)?;
    Ok(connection.info().clone())
}

/// Waits until an instance has a server, and says so once if that is not at once; returns whether it has
/// one: not once `is_over`.
pub fn wait_for_server(
    instance: &Instance,
    limit: Duration,
    is_over: impl Fn() -> bool,
) -> Result<bool, ConnectionError> {
    let (start, mut is_told) = (Instant::now(), false);
    while !is_over() {
        match server_info(instance) {
            Ok(_) => return Ok(true),
            Err(error) if is_away(&error) && start.elapsed() < limit => {
                if !is_told {
                    tracing::info!("{error}; waiting for it, {limit:?} at most");
                }
                is_told = true;
            }
            Err(error) => return Err(error),
        }
        let left = limit.saturating_sub(start.elapsed());
        std::thread::sleep(RETRY_INTERVAL.min(left));
    }
    Ok(false)
}

/// Whether a server is away and may come.
pub fn is_away(error: &ConnectionError) -> bool {
    match error {
        ConnectionError::ServerGone { .. } | ConnectionError::Timeout { .. } => true,
        ConnectionError::Channel(channel) => matches!(channel, ChannelError::NoServer { .. }),
        _ => false,
    }
}

/// Whether something failed because a server is away that may come back.
pub fn is_outage(error: &anyhow::Error) -> bool {
    error.downcast_ref().is_some_and(is_away)
}

/// Status, detail and message, if something failed because a server refused.
pub fn refusal(error: &anyhow::Error) -> Option<(Status, u64, &str)> {
    match error.downcast_ref()? {
        ConnectionError::Refused {
            status,
            detail,
            message,
        } => Some((*status, *detail, message)),
        _ => None,
    }
}

/// The error of what is refused before a server is asked.
pub fn refused(status: Status, detail: u64, message: String) -> ConnectionError {
    ConnectionError::Refused {
        status,
        detail,
        message,
    }
}

/// Whether a belief of a kind was left about a world as it stands; needs no lease.
pub fn is_belief_left(
    instance: &Instance,
    world: u32,
    kind: &str,
) -> Result<bool, ConnectionError> {
    let mut connection = Connection::open(instance, CLIENT_NAME, STEP_TIMEOUT)?;
    let request = Request::Belief { world, offset: 0 };
    match connection.control(&request, STEP_TIMEOUT) {
        Ok(Reply::Belief { info, .. }) => Ok(info.kind == kind),
        Ok(other) => Err(unexpected("belief", &other)),
        Err(ConnectionError::Refused { .. }) => Ok(false),
        Err(error) => Err(error),
    }
}

/// A server's grid.
pub fn shape_of(info: &ServerInfo) -> Result<Shape, ConnectionError> {
    let shape = Shape::new(info.height, info.width);
    shape.map_err(|error| garbled("hello", &error))
}
