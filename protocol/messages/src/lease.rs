//! A lease on robots. It records the step k for which each path is sent, and finds out whether the path was flown.

use crate::backend::{Backend, StepAnswer};
use crate::control::{LeaseInfo, Reply, Request, ServerInfo, WorldInfo, WorldSeed};
use crate::errors::{ConnectionError, refused, unexpected};
use crate::message::{FLAG_TEAM_FRAMES, Operation, Status, StepRequest, WorldResult, worlds_of};
use crate::payload::{WORLD_BYTES, write_step_body};
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// The right to fly consecutive robots, and the step of each of their worlds.
///
/// Threads may share a lease if only one at a time calls [`Self::send`].
#[derive(Debug)]
pub struct Lease {
    number: u64,
    team: u32,
    n_moves: u32,
    deadline: Duration,
    worlds: Range<u32>,
    known: Vec<Known>,
    /// Number of times that paths were sent. It serves as the sequence number of a call.
    n_sent: AtomicU64,
}

/// The robots to fly, and how to acquire them.
#[derive(Debug, Clone)]
pub struct Claim {
    /// The numbers of the robots, at least one.
    pub robots: Range<u32>,
    pub takeover: bool,
    /// Time from the last use of the lease until it ends, 0.1 s to one day; `None` for the server's default.
    pub time_to_live: Option<Duration>,
}

impl Claim {
    /// Claims robots that no other client holds. The lease has the server's default duration.
    pub fn new(robots: Range<u32>) -> Self {
        Self {
            robots,
            takeover: false,
            time_to_live: None,
        }
    }
}

#[derive(Debug, Default)]
struct Known {
    step: AtomicU64,
    /// The `n_sent` of the last paths for the world that were not refused. Only paths that were not refused can have
    /// moved the world.
    sent: AtomicU64,
}

/// A step request of a lease. When a call is sent again, its paths are still for the same steps.
#[derive(Debug)]
pub struct Call<'a> {
    request: StepRequest,
    moves: &'a [u8],
    /// For each world, the step that its paths are for; empty until the call is first sent.
    steps: Vec<u64>,
    timeout: Duration,
    /// The `n_sent` at which these paths were last sent. For an observation, the `n_sent` of the paths whose effect
    /// should be observed.
    sent: u64,
    /// Whether the observation may show the effect of other paths of the lease instead of these paths.
    shows_others: bool,
}

impl<'a> Call<'a> {
    pub fn new(request: StepRequest, moves: &'a [u8], timeout: Duration) -> Self {
        Self {
            request,
            moves,
            steps: Vec::new(),
            timeout,
            sent: 0,
            shows_others: false,
        }
    }

    /// Makes a call for a `Recall` request. `steps` contains the earlier step of each world that the server should
    /// return.
    pub fn of_past(request: StepRequest, steps: Vec<u64>, timeout: Duration) -> Self {
        let call = Self::new(request, &[], timeout);
        Self { steps, ..call }
    }

    /// Returns the request, without the fields that [`Backend::step`] fills in.
    pub fn request(&self) -> &StepRequest {
        &self.request
    }
}

impl Lease {
    /// Acquires robots without moving them. Returns when the burn-in of their worlds is done.
    ///
    /// # Errors
    /// If another client holds a robot, a `Busy` refusal names its process. Otherwise the same as [`Backend::step`], as
    /// for the other requests of a lease; a refused request changes nothing.
    pub fn acquire(
        backend: &mut dyn Backend,
        claim: &Claim,
        timeout: Duration,
    ) -> Result<(Self, LeaseInfo), ConnectionError> {
        let lives = Duration::from_millis(100)..=Duration::from_secs(86_400);
        if let Some(got) = claim.time_to_live.filter(|it| !lives.contains(it)) {
            let problem = format!("expected 0.1 s to one day, got {got:?}");
            let what = "time to live";
            return Err(ConnectionError::Invalid { what, problem });
        }
        let request = Request::Acquire {
            first_robot: claim.robots.start,
            n_robots: claim.robots.len() as u32,
            takeover: claim.takeover,
            ttl_millis: claim.time_to_live.map(|time| time.as_millis() as u64),
        };
        let given = match backend.control(&request, timeout)? {
            Reply::Lease(given) => given,
            other => return Err(unexpected("acquire", &other)),
        };
        let lease = Self::new(backend.info(), given.lease, &claim.robots);
        lease.note_all(&given.worlds);
        Ok((lease, given))
    }

    /// Starts new episodes with the given seeds. Returns the worlds when the burn-in is done.
    ///
    /// # Errors
    /// `Busy` if another client holds a robot of these worlds, and `NoLease` if this lease holds none.
    pub fn reset(
        &self,
        backend: &mut dyn Backend,
        worlds: Vec<WorldSeed>,
        timeout: Duration,
    ) -> Result<Vec<WorldInfo>, ConnectionError> {
        let lease = self.number;
        self.replace(backend, &Request::Reset { lease, worlds }, timeout)
    }

    /// Replaces consecutive worlds with worlds of a snapshot file on the server's machine, from index `from` of the
    /// file on. `path` must be absolute.
    ///
    /// # Errors
    /// As for [`Self::reset`], and `BadFile` for a file that is missing, damaged or of other worlds.
    pub fn restore(
        &self,
        backend: &mut dyn Backend,
        worlds: &Range<u32>,
        (path, from): (String, u32),
        timeout: Duration,
    ) -> Result<Vec<WorldInfo>, ConnectionError> {
        let request = Request::Restore {
            lease: self.number,
            first_world: worlds.start,
            n_worlds: worlds.len() as u32,
            from,
            path,
        };
        self.replace(backend, &request, timeout)
    }

    /// Replaces the world `to` with a copy of the world `from`. With the same paths, both have the same future.
    ///
    /// # Errors
    /// As for [`Self::reset`].
    pub fn fork(
        &self,
        backend: &mut dyn Backend,
        (from, to): (u32, u32),
        timeout: Duration,
    ) -> Result<Vec<WorldInfo>, ConnectionError> {
        let lease = self.number;
        self.replace(backend, &Request::Fork { lease, from, to }, timeout)
    }

    /// Restarts the time until the lease expires, without flying.
    ///
    /// # Errors
    /// `LeaseLost` if the lease no longer holds any robot.
    pub fn renew(
        &self,
        backend: &mut dyn Backend,
        timeout: Duration,
    ) -> Result<(), ConnectionError> {
        let lease = self.number;
        backend
            .control(&Request::Renew { lease }, timeout)
            .map(drop)
    }

    /// Returns the robots to the server.
    ///
    /// # Errors
    /// `LeaseLost` if the lease no longer holds any robot.
    pub fn release(
        &self,
        backend: &mut dyn Backend,
        timeout: Duration,
    ) -> Result<(), ConnectionError> {
        let lease = self.number;
        backend
            .control(&Request::Release { lease }, timeout)
            .map(drop)
    }

    fn replace(
        &self,
        backend: &mut dyn Backend,
        request: &Request,
        timeout: Duration,
    ) -> Result<Vec<WorldInfo>, ConnectionError> {
        match backend.control(request, timeout)? {
            Reply::Reset { worlds } | Reply::Restored { worlds } => {
                self.note_all(&worlds);
                Ok(worlds)
            }
            other => Err(unexpected("a request for new worlds", &other)),
        }
    }

    /// Makes the lease with a number that the server has given, on these robots. Their worlds are at step 0 until
    /// [`Self::note`] tells another.
    pub fn new(info: &ServerInfo, number: u64, robots: &Range<u32>) -> Self {
        let worlds = worlds_of(robots.start, robots.len() as u32, info.n_robots);
        Self {
            number,
            team: info.n_robots.max(1),
            n_moves: info.n_moves as u32,
            deadline: Duration::from_millis(info.deadline_millis),
            known: worlds.clone().map(|_| Known::default()).collect(),
            worlds,
            n_sent: AtomicU64::new(0),
        }
    }

    pub fn number(&self) -> u64 {
        self.number
    }

    pub fn worlds(&self) -> Range<u32> {
        self.worlds.clone()
    }

    pub fn steps(&self) -> Vec<u64> {
        self.steps_of(self.worlds()).collect()
    }

    /// Records the step of a world after a reset or a similar request. Ignores worlds outside the lease.
    pub fn note(&self, world: u32, step: u64) {
        if let Some(known) = self.known(world) {
            known.step.store(step, Ordering::Relaxed);
        }
    }

    pub fn note_all(&self, worlds: &[WorldInfo]) {
        for world in worlds {
            self.note(world.world, world.step);
        }
    }

    pub fn request(&self, operation: Operation, robots: &Range<u32>, flags: u32) -> StepRequest {
        let flies = operation == Operation::Step;
        StepRequest {
            operation: operation as u32,
            lease: self.number,
            first_robot: robots.start,
            n_robots: robots.len() as u32,
            n_moves: if flies { self.n_moves } else { 0 },
            flags,
            ..StepRequest::default()
        }
    }

    /// Sends a request once, and records the steps in its answer. When a call is first sent, its paths are assigned to
    /// the last known steps of their worlds.
    ///
    /// # Errors
    /// The same as [`Backend::step`].
    pub fn send(
        &self,
        backend: &mut dyn Backend,
        call: &mut Call<'_>,
    ) -> Result<StepAnswer, ConnectionError> {
        let request = call.request;
        let worlds = worlds_of(request.first_robot, request.n_robots, self.team);
        let flies = request.operation == Operation::Step as u32;
        if flies {
            call.sent = self.n_sent.fetch_add(1, Ordering::Relaxed) + 1;
            if call.steps.is_empty() {
                call.steps.extend(self.steps_of(worlds.clone()));
            }
        }
        let mut body = Vec::new();
        write_step_body(&call.steps, call.moves, &mut body);
        let answer = backend.step(request, &body, call.timeout);
        if flies && !matches!(answer, Err(ConnectionError::Refused { .. })) {
            self.note_sent(worlds.clone(), call);
        } else {
            // Worlds outside the lease, which an observation may include, are not tracked.
            let known = worlds.clone().filter_map(|world| self.known(world));
            let mut sent = known.map(|known| known.sent.load(Ordering::Relaxed));
            call.shows_others = sent.any(|sent| sent != call.sent);
        }
        let answer = answer?;
        if request.operation != Operation::Recall as u32 {
            for (world, result) in worlds.zip(results(&answer)) {
                self.note(world, result.step);
            }
        }
        Ok(answer)
    }

    /// Sends paths and waits until their worlds have moved. After each timeout, observes the worlds, and resends the
    /// paths if the worlds have not moved. Thus a slow teammate only delays the step, but a silent server makes it
    /// fail. Returns the answer, and the number of steps before it that the client did not see. Returns `None` if
    /// `gives_up` returns true after an observation.
    ///
    /// `send` must call [`Self::send`] with the backend. If `accepts_late` is set, the answer shows the current worlds
    /// even if they moved without these paths.
    ///
    /// # Errors
    /// The errors of `send` and `gives_up`, and a `Late` refusal if worlds moved without the paths.
    pub fn send_paths<'a>(
        &self,
        mut paths: Call<'a>,
        accepts_late: bool,
        mut send: impl FnMut(&mut Call<'a>) -> Result<StepAnswer, ConnectionError>,
        mut gives_up: impl FnMut() -> Result<bool, ConnectionError>,
    ) -> Result<Option<(StepAnswer, u64)>, ConnectionError> {
        let mut look = self.look(&paths);
        // A request that times out before the server's deadline withdraws its path, which may be the path that started
        // the deadline.
        paths.timeout = paths.timeout.saturating_add(self.deadline);
        loop {
            match send(&mut paths) {
                Err(ConnectionError::Timeout { .. }) => {}
                Err(ConnectionError::Refused { status, .. })
                    if accepts_late && status == Status::Late => {}
                answer => return answer.map(|answer| Some((answer, 0))),
            }
            look.sent = paths.sent;
            let seen = send(&mut look)?;
            let steps = results(&seen).map(|result| result.step).zip(&paths.steps);
            let n_moved = steps
                .map(|(step, before)| step.saturating_sub(*before))
                .max();
            if let Some(n_moved @ 1..) = n_moved {
                if !accepts_late {
                    self.check_flown(&paths, &seen, look.shows_others)?;
                }
                return Ok(Some((seen, n_moved - 1)));
            }
            if gives_up()? {
                return Ok(None);
            }
        }
    }

    /// Records that paths were sent and not refused. Skips worlds that are known to have moved already: there the paths
    /// may have been refused, and the refusal lost.
    fn note_sent(&self, worlds: Range<u32>, paths: &Call<'_>) {
        for (world, step) in worlds.zip(&paths.steps) {
            let known = self.known(world);
            if let Some(known) = known.filter(|it| it.step.load(Ordering::Relaxed) == *step) {
                known.sent.store(paths.sent, Ordering::Relaxed);
            }
        }
    }

    fn look<'a>(&self, paths: &Call<'a>) -> Call<'a> {
        let request = StepRequest {
            operation: Operation::Observe as u32,
            n_moves: 0,
            flags: paths.request.flags & FLAG_TEAM_FRAMES,
            ..paths.request
        };
        Call::new(request, &[], paths.timeout)
    }

    /// Checks that these paths, and no other paths, moved their worlds to the observed steps.
    fn check_flown(
        &self,
        paths: &Call<'_>,
        seen: &StepAnswer,
        shows_others: bool,
    ) -> Result<(), ConnectionError> {
        let (first, n_robots) = (paths.request.first_robot, paths.request.n_robots);
        let worlds: Vec<WorldResult> = results(seen).collect();
        let index = |robot: u32| (robot / self.team - first / self.team) as usize;
        let missed = (first..first + n_robots).map(|robot| (robot % self.team, index(robot)));
        let mut missed = missed.filter(|&(member, index)| {
            let (world, before) = (&worlds[index], paths.steps[index]);
            let stayed = (world.hovered | world.late) >> member & 1 == 1;
            shows_others || stayed || world.step.checked_sub(before) != Some(1)
        });
        missed.next().map_or(Ok(()), |(_, index)| {
            Err(refused(Status::Late, worlds[index].step))
        })
    }

    fn steps_of(&self, worlds: Range<u32>) -> impl Iterator<Item = u64> {
        // For a world outside the lease, any step will do, because the server refuses the request.
        let step = |known: &Known| known.step.load(Ordering::Relaxed);
        worlds.map(move |world| self.known(world).map_or(0, step))
    }

    fn known(&self, world: u32) -> Option<&Known> {
        let index = world.checked_sub(self.worlds.start)?;
        self.known.get(index as usize)
    }
}

fn results((reply, payload): &StepAnswer) -> impl Iterator<Item = WorldResult> {
    let results = payload
        .chunks_exact(WORLD_BYTES)
        .take(reply.n_worlds as usize);
    results.map(bytemuck::pod_read_unaligned)
}
