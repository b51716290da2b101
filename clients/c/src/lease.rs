//! Leases: the right to fly consecutive robots.

use crate::error::{Error, ErrorInfo, Outcome, guard, invalid};
use crate::handle::{array, duration, give, hold, of, put};
use crate::server::{Core, Server};
use crate::view::{View, keep};
use emberwatch_messages::backend::StepAnswer;
use emberwatch_messages::client::STEP_TIMEOUT;
use emberwatch_messages::control::WorldSeed;
use emberwatch_messages::errors::{ConnectionError, ErrorClass, garbled};
use emberwatch_messages::lease::{Call, Claim, Lease};
use emberwatch_messages::message::{
    FLAG_FULL_COVERAGE, FLAG_TEAM_FRAMES, Operation, RobotResult, WorldResult, worlds_of,
};
use emberwatch_messages::payload::split_step_payload;
use emberwatch_model::path::{MoveError, check_moves};
use std::ops::Range;
use std::ptr::null_mut;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Frames show every cell, if the server's coverage allows it.
pub const EW_FULL_COVERAGE: u32 = 1;

/// One frame per world, of what all its robots saw, instead of one per robot.
pub const EW_TEAM_FRAMES: u32 = 2;

/// If a world moved without these paths, returns what it shows now instead of EW_STATUS_LATE.
pub const EW_ACCEPT_LATE: u32 = 1 << 16;

const _: () = assert!(EW_FULL_COVERAGE == FLAG_FULL_COVERAGE && EW_TEAM_FRAMES == FLAG_TEAM_FRAMES);

/// A lease. One thread at a time may use it; threads may use different leases of one server.
pub struct LeaseHandle {
    pub core: Arc<Core>,
    pub robots: Range<u32>,
    lease: Lease,
    /// The last answer, to which C has a pointer, and the results of the last one that was no recall.
    last: Mutex<(Option<AnswerView>, Vec<WorldResult>)>,
}

/// The results of worlds and robots, and the frames.
#[repr(C)]
pub struct Answer {
    /// Number of the first robot.
    pub first_robot: u32,
    /// Robots, in the order of their numbers.
    pub n_robots: u32,
    /// Number of the first world.
    pub first_world: u32,
    /// Worlds of these robots.
    pub n_worlds: u32,
    /// Frames: one per robot, or one per world with EW_TEAM_FRAMES.
    pub n_frames: u32,
    /// Rows of the grid, H.
    pub height: u32,
    /// Columns of the grid, W.
    pub width: u32,
    /// Number of the lease, for ew_control.
    pub lease: u64,
    /// The result of each world.
    pub worlds: *const WorldResult,
    /// The result of each robot.
    pub robots: *const RobotResult,
    /// n_frames * H * W bytes: an observation, or 255 where nothing was observed.
    pub frames: *const u8,
    /// Steps before this one that were missed, with EW_ACCEPT_LATE; otherwise 0.
    pub n_skipped: u64,
    /// Time that the server worked, nanoseconds.
    pub simulation_nanos: u64,
}

type Seen = (StepAnswer, u64);

type AnswerView = View<Answer, (Vec<WorldResult>, Vec<RobotResult>, Vec<u8>)>;

impl LeaseHandle {
    pub fn number(&self) -> u64 {
        self.lease.number()
    }

    /// Returns the world of a robot of the lease, and its result in the last answer.
    pub fn last_result(&self, robot: u32) -> Outcome<(u32, WorldResult)> {
        if !self.robots.contains(&robot) {
            let expected = format!("a robot of the lease, {:?}", self.robots);
            return Err(invalid("robot", expected, robot));
        }
        let world = worlds_of(robot, 1, self.core.info.n_robots).start;
        let index = (world - self.lease.worlds().start) as usize;
        let last = hold(&self.last)?;
        let result = last.1.get(index);
        let missing = || invalid("belief", "ew_reset, ew_step or ew_observe before", "none");
        Ok((world, *result.ok_or_else(missing)?))
    }

    fn view(&self, ((reply, payload), n_skipped): Seen) -> Outcome<AnswerView> {
        let parts = split_step_payload(&reply, &payload)
            .map_err(|expected| garbled("step", format!("expected {expected} bytes")))?;
        let view = Answer {
            first_robot: reply.first_robot,
            n_robots: reply.n_robots,
            first_world: self.lease.worlds().start,
            n_worlds: reply.n_worlds,
            n_frames: match reply.flags & EW_TEAM_FRAMES {
                0 => reply.n_robots,
                _ => reply.n_worlds,
            },
            height: reply.height,
            width: reply.width,
            lease: self.number(),
            worlds: parts.worlds.as_ptr(),
            robots: parts.robots.as_ptr(),
            frames: parts.frames.as_ptr(),
            n_skipped,
            simulation_nanos: reply.simulation_nanos,
        };
        let (worlds, robots) = (parts.worlds, parts.robots);
        Ok(View::new(view, (worlds, robots, payload)))
    }

    fn send(&self, call: &mut Call<'_>) -> Result<StepAnswer, ConnectionError> {
        self.core.with(|backend| self.lease.send(backend, call))
    }

    fn look(&self, step: Option<u64>, flags: u32, limit: Duration) -> Outcome<Seen> {
        let operation = step.map_or(Operation::Observe, |_| Operation::Recall);
        let request = self.lease.request(operation, &self.robots, flags);
        let steps = step.map_or(Vec::new(), |step| vec![step; self.lease.worlds().len()]);
        Ok((self.send(&mut Call::of_past(request, steps, limit))?, 0))
    }

    fn reset(&self, seeds: *const u64, n_seeds: usize, limit: Duration) -> Outcome<Seen> {
        let start = Instant::now();
        let worlds = self.lease.worlds();
        if n_seeds != (if seeds.is_null() { 0 } else { worlds.len() }) {
            let expected = format!("{} seeds, or NULL and 0", worlds.len());
            return Err(invalid("seeds", expected, n_seeds));
        }
        let given = match array("seeds", seeds, n_seeds)? {
            [] => vec![None; worlds.len()],
            seeds => seeds.iter().copied().map(Some).collect(),
        };
        let worlds = worlds.zip(given);
        let worlds = worlds.map(|(world, seed)| WorldSeed { world, seed });
        self.core
            .with(|backend| self.lease.reset(backend, worlds.collect(), limit))?;
        self.look(
            None,
            0,
            limit.saturating_sub(start.elapsed()).max(STEP_TIMEOUT),
        )
    }

    fn fly(&self, moves: *const u8, n: usize, flags: u32, limit: Duration) -> Outcome<Seen> {
        let start = Instant::now();
        let n_moves = self.core.info.n_moves;
        let expected = self.robots.len() * n_moves;
        if n != expected {
            let expected = format!("{expected} bytes, {n_moves} moves for each robot");
            return Err(invalid("paths", expected, n));
        }
        let moves = array("paths", moves, n)?;
        if let Err(MoveError { index, value }) = check_moves(moves) {
            let (robot, index) = (
                self.robots.start as usize + index / n_moves,
                index % n_moves,
            );
            let got = format!("{value} for move {index} of robot {robot}");
            return Err(invalid("paths", "moves 0 to 3", got));
        }
        let (accepts_late, flags) = (flags & EW_ACCEPT_LATE != 0, flags & !EW_ACCEPT_LATE);
        let request = self.lease.request(Operation::Step, &self.robots, flags);
        // Splits a long wait into equal parts. After each, the lease asks whether the worlds have moved.
        let n_parts = limit.as_secs_f64().div_euclid(STEP_TIMEOUT.as_secs_f64()) as u32 + 1;
        let paths = Call::new(request, moves, limit / n_parts);
        let send = |call: &mut Call<'_>| self.send(call);
        let is_over = || Ok(start.elapsed() >= limit);
        let flown = self.lease.send_paths(paths, accepts_late, send, is_over)?;
        flown.ok_or_else(|| {
            let text = "the world still waits for other robots' paths; yours were withdrawn";
            Error::of_class(ErrorClass::Timeout, text)
        })
    }
}

impl Drop for LeaseHandle {
    /// Releases the robots, so that another client need not wait until the lease expires.
    fn drop(&mut self) {
        let limit = Duration::from_secs(1);
        let _ = self.core.with(|worlds| self.lease.release(worlds, limit));
    }
}

fn answer(
    lease: *mut LeaseHandle,
    out: *mut *const Answer,
    error: *mut ErrorInfo,
    is_recall: bool,
    ask: impl FnOnce(&LeaseHandle) -> Outcome<Seen>,
) -> i32 {
    guard(error, || {
        let lease = of(lease)?;
        let mut last = hold(&lease.last)?;
        let view = lease.view(ask(lease)?)?;
        if !is_recall {
            last.1.clone_from(&view.owned.0);
        }
        keep(&mut last.0, view, out);
        Ok(())
    })
}

/// Acquires the right to fly consecutive robots, and waits for the burn-in of their worlds. Robots of other clients are
/// refused with EW_STATUS_BUSY, or taken over if `takeover` is set. The lease ends `seconds_to_live` after its last
/// use; 0: the server's default. To continue an episode, call ew_observe; to begin one, ew_reset.
#[unsafe(no_mangle)]
pub extern "C" fn ew_acquire(
    server: *mut Server,
    first_robot: u32,
    n_robots: u32,
    takeover: bool,
    seconds_to_live: f64,
    timeout: f64,
    out: *mut *mut LeaseHandle,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        put(out, null_mut());
        let core = of(server)?.core.clone();
        let (limit, life) = (
            duration("timeout", timeout)?,
            duration("seconds_to_live", seconds_to_live)?,
        );
        let robots = first_robot..first_robot.saturating_add(n_robots);
        let claim = Claim {
            robots: robots.clone(),
            takeover,
            time_to_live: Some(life).filter(|life| !life.is_zero()),
        };
        let (lease, _) = core.with(|it| Lease::acquire(it, &claim, limit))?;
        let lease = LeaseHandle {
            core,
            robots,
            lease,
            last: Mutex::default(),
        };
        give(lease, out)
    })
}

/// Starts a new episode in each world of the lease. `seeds` has one seed per world, or is NULL: then the server derives
/// them. Waits for the burn-in, which can take a while: use a timeout of minutes. The answer shows the robots' cells
/// and empty frames. This answer, and those of the functions below, live until the next call with the lease.
#[unsafe(no_mangle)]
pub extern "C" fn ew_reset(
    lease: *mut LeaseHandle,
    seeds: *const u64,
    n_seeds: usize,
    timeout: f64,
    out: *mut *const Answer,
    error: *mut ErrorInfo,
) -> i32 {
    answer(lease, out, error, false, |lease| {
        lease.reset(seeds, n_seeds, duration("timeout", timeout)?)
    })
}

/// Flies one path with each robot of the lease. `paths` has `n_moves` moves (ew_move) for each robot, one byte each.
/// `flags` is a sum of EW_FULL_COVERAGE, EW_TEAM_FRAMES and EW_ACCEPT_LATE, or 0. EW_FAILURE_TIMEOUT tells in its
/// message whether the paths were withdrawn; if the server did not answer at all, ew_observe shows whether they were
/// flown.
#[unsafe(no_mangle)]
pub extern "C" fn ew_step(
    lease: *mut LeaseHandle,
    paths: *const u8,
    n_bytes: usize,
    flags: u32,
    timeout: f64,
    out: *mut *const Answer,
    error: *mut ErrorInfo,
) -> i32 {
    answer(lease, out, error, false, |lease| {
        lease.fly(paths, n_bytes, flags, duration("timeout", timeout)?)
    })
}

/// Returns the last results and frames of the lease's robots again. `flags` is EW_TEAM_FRAMES or 0.
#[unsafe(no_mangle)]
pub extern "C" fn ew_observe(
    lease: *mut LeaseHandle,
    flags: u32,
    timeout: f64,
    out: *mut *const Answer,
    error: *mut ErrorInfo,
) -> i32 {
    answer(lease, out, error, false, |lease| {
        lease.look(None, flags, duration("timeout", timeout)?)
    })
}

/// Returns the results and frames of an earlier step k of the episode. EW_STATUS_NOT_KEPT has the nearest step that the
/// server keeps as its detail.
#[unsafe(no_mangle)]
pub extern "C" fn ew_recall(
    lease: *mut LeaseHandle,
    step: u64,
    flags: u32,
    timeout: f64,
    out: *mut *const Answer,
    error: *mut ErrorInfo,
) -> i32 {
    answer(lease, out, error, true, |lease| {
        lease.look(Some(step), flags, duration("timeout", timeout)?)
    })
}

/// Restarts the time until the lease ends, without flying.
#[unsafe(no_mangle)]
pub extern "C" fn ew_renew(lease: *mut LeaseHandle, timeout: f64, error: *mut ErrorInfo) -> i32 {
    guard(error, || {
        let lease = of(lease)?;
        let (_held, limit) = (hold(&lease.last)?, duration("timeout", timeout)?);
        Ok(lease.core.with(|it| lease.lease.renew(it, limit))?)
    })
}

/// Returns the robots to the server. The handle must still be freed.
#[unsafe(no_mangle)]
pub extern "C" fn ew_release(lease: *mut LeaseHandle, timeout: f64, error: *mut ErrorInfo) -> i32 {
    guard(error, || {
        let lease = of(lease)?;
        let (_held, limit) = (hold(&lease.last)?, duration("timeout", timeout)?);
        Ok(lease.core.with(|it| lease.lease.release(it, limit))?)
    })
}
