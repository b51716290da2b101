//! Samples: what a server and its agents publish, live or in a recording.

use crate::error::{Error, ErrorInfo, Outcome, guard, invalid};
use crate::fork::watch_forks;
use crate::handle::{duration, give, hold, of, put, text};
use crate::info::{Info, view_of};
use crate::view::{Texts, View, keep};
use emberwatch_messages::agent_belief::AgentBelief;
use emberwatch_messages::errors::ErrorClass;
use emberwatch_messages::instance::Instance;
use emberwatch_messages::message::{AgentHeader, FrameHeader, Published, RobotResult, TruthHeader};
use emberwatch_messages::payload::{ROBOT_BYTES, split_frame_payload, truth_states};
use emberwatch_messages::recording::{Event, Reader, RecordingError};
use emberwatch_messages::sample::Sample as Received;
use emberwatch_protocol::observer::Observer;
use std::ffi::c_char;
use std::fmt::Display;
use std::fs::File;
use std::io::BufReader;
use std::ptr::null_mut;
use std::sync::Mutex;
use std::time::Duration;

/// What an observer reads: the steps of all worlds.
pub const EW_FRAMES: u32 = 1;

/// What an observer reads: hidden states, which only a server with --publish-truth publishes.
pub const EW_TRUTHS: u32 = 2;

/// What an observer reads: the beliefs that agents publish.
pub const EW_BELIEFS: u32 = 3;

/// One step of one world, as the server published it.
#[repr(C)]
pub struct FrameSample {
    /// World, robots, grid and the world's result.
    pub header: FrameHeader,
    /// The result of each robot.
    pub robots: *const RobotResult,
    /// n_robots * H * W bytes.
    pub frames: *const u8,
    /// The path of each robot, robots[i].n_moves bytes each, one after another.
    pub paths: *const u8,
}

/// The hidden states of one world. For evaluation and pictures, never for learners.
#[repr(C)]
pub struct TruthSample {
    /// World, episode, step and grid.
    pub header: TruthHeader,
    /// H * W states.
    pub states: *const u8,
}

/// A belief that an agent published.
#[repr(C)]
pub struct BeliefSample {
    /// World, robots, episode, step, grid, and the agent's process.
    pub header: AgentHeader,
    /// n_states * H * W probabilities, state by state.
    pub belief: *const f32,
    /// Names of the states.
    pub states: *const *const c_char,
    /// Their number, which may differ from n_states.
    pub n_names: u32,
    /// Name of the policy; "" if unknown, as the texts below.
    pub policy: *const c_char,
    /// What computed the belief.
    pub belief_from: *const c_char,
    /// What the last path was planned for.
    pub objective: *const c_char,
    /// Time taken to plan it.
    pub plan_millis: f64,
}

/// A sample. One of the pointers is not NULL, except at the end of a recording.
#[repr(C)]
#[derive(Default)]
pub struct Sample {
    /// Nanoseconds since a recording began; 0 from an observer.
    pub nanos: u64,
    /// Samples that were lost right before this one.
    pub n_lost: u64,
    /// Process that published it; 0 if it is unknown.
    pub pid: u32,
    /// In recordings: the server of the next samples.
    pub server: *const Info,
    /// One step of one world.
    pub frame: *const FrameSample,
    /// Hidden states.
    pub truth: *const TruthSample,
    /// A belief.
    pub belief: *const BeliefSample,
}

/// An observer or a recording. One thread at a time may use it.
pub struct Samples(Mutex<Reading>);

impl Samples {
    fn of(source: Source) -> Self {
        let (last, end) = (None, None);
        Self(Mutex::new(Reading { source, last, end }))
    }
}

struct Reading {
    source: Source,
    last: Option<View<Sample, Memory>>,
    end: Option<String>,
}

enum Source {
    Frames(Observer<FrameHeader>),
    Truths(Observer<TruthHeader>),
    Beliefs(Observer<AgentHeader>),
    Recording(Box<Reader<BufReader<File>>>),
}

type Memory = Box<dyn Send>;

fn bad(problem: impl Display) -> Error {
    Error::of_class(ErrorClass::BadAnswer, problem)
}

impl From<RecordingError> for Error {
    fn from(error: RecordingError) -> Self {
        match error {
            RecordingError::Cut { .. } | RecordingError::Damaged { .. } => bad(error),
            other => Self::of_class(ErrorClass::Invalid, other),
        }
    }
}

fn frame(received: Received<FrameHeader>, to: &mut Sample) -> Outcome<Memory> {
    let Received { header, payload } = received;
    let parts = split_frame_payload(&header, &payload).map_err(bad)?;
    let robots: Vec<RobotResult> = parts.iter().map(|it| it.result).collect();
    let n_frame_bytes = parts.iter().map(|it| it.frame.len()).sum();
    let (frames, paths) = payload[robots.len() * ROBOT_BYTES..].split_at(n_frame_bytes);
    let view = FrameSample {
        header,
        robots: robots.as_ptr(),
        frames: frames.as_ptr(),
        paths: paths.as_ptr(),
    };
    let view = Box::new(View::new(view, (robots, payload)));
    to.frame = view.pointer();
    Ok(view)
}

fn truth(received: Received<TruthHeader>, to: &mut Sample) -> Outcome<Memory> {
    let states = truth_states(&received).map_err(bad)?;
    let view = TruthSample {
        header: received.header,
        states: states.as_ptr(),
    };
    let view = Box::new(View::new(view, states));
    to.truth = view.pointer();
    Ok(view)
}

fn belief(received: Received<AgentHeader>, to: &mut Sample) -> Outcome<Memory> {
    let found = AgentBelief::try_from(&received).map_err(bad)?;
    let (intent, mut texts) = (&found.intent, Texts::default());
    let view = BeliefSample {
        header: found.header,
        belief: found.belief.as_ptr(),
        states: texts.add_all(&intent.states),
        n_names: intent.states.len() as u32,
        policy: texts.add(&intent.policy),
        belief_from: texts.add(&intent.belief_from),
        objective: texts.add(&intent.objective),
        plan_millis: intent.plan_millis,
    };
    let view = Box::new(View::new(view, (found, texts)));
    to.belief = view.pointer();
    Ok(view)
}

fn observed<H: Published>(
    observer: &Observer<H>,
    (world, limit): (Option<u32>, Duration),
    to: &mut Sample,
    fill: impl FnOnce(Received<H>, &mut Sample) -> Outcome<Memory>,
) -> Outcome<Memory> {
    let late = || Error::of_class(ErrorClass::Timeout, "no sample in time");
    let (received, n_lost) = observer.next_of(world, limit)?.ok_or_else(late)?;
    to.n_lost = n_lost;
    to.pid = observer.publisher().unwrap_or(0);
    fill(received, to)
}

fn recorded(
    reader: &mut Reader<BufReader<File>>,
    world: Option<u32>,
    to: &mut Sample,
) -> Outcome<Memory> {
    let is_other = |it: u32| world.is_some_and(|world| world != it);
    while let Some(record) = reader.next().transpose()? {
        (to.nanos, to.n_lost) = (record.nanos, record.n_lost.into());
        match record.event {
            Event::Frame(received) if is_other(received.header.world) => {}
            Event::Truth(received) if is_other(received.header.world) => {}
            Event::Frame(received) => return frame(received, to),
            Event::Truth(received) => return truth(received, to),
            Event::Server(info) => {
                let view = Box::new(view_of(&info));
                to.server = view.pointer();
                return Ok(view);
            }
        }
    }
    Ok(Box::new(()))
}

/// Opens an observer of EW_FRAMES, EW_TRUTHS or EW_BELIEFS. The server never waits for observers, may start later than
/// they, and may be restarted: an observer shows the next server of the instance.
#[unsafe(no_mangle)]
pub extern "C" fn ew_watch(
    instance: *const c_char,
    what: u32,
    out: *mut *mut Samples,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        put(out, null_mut());
        let instance = Instance::new(text("instance", instance)?)?;
        watch_forks();
        let source = match what {
            EW_FRAMES => Source::Frames(Observer::frames(&instance)?),
            EW_TRUTHS => Source::Truths(Observer::truth(&instance)?),
            EW_BELIEFS => Source::Beliefs(Observer::agents(&instance)?),
            got => return Err(invalid("what", "EW_FRAMES, EW_TRUTHS or EW_BELIEFS", got)),
        };
        give(Samples::of(source), out)
    })
}

/// Opens a recording, a file of `emberwatch-server record`. Needs no server.
#[unsafe(no_mangle)]
pub extern "C" fn ew_open_recording(
    path: *const c_char,
    out: *mut *mut Samples,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        put(out, null_mut());
        let path = text("path", path)?;
        let file = File::open(path).map_err(|error| invalid(path, "a recording", error))?;
        let reader = Reader::new(BufReader::new(file));
        let reader = Box::new(reader.map_err(|error| invalid(path, "a recording", error))?);
        give(Samples::of(Source::Recording(reader)), out)
    })
}

/// Returns the next sample about a world, or about any world if `world` is negative. It lives until the next call with
/// these samples. An observer waits for it: EW_FAILURE_TIMEOUT if none came. At the end of a recording, all pointers of
/// the sample are NULL; EW_FAILURE_BAD_ANSWER: it is damaged or cut short here, and all before is good.
#[unsafe(no_mangle)]
pub extern "C" fn ew_next(
    samples: *mut Samples,
    world: i32,
    timeout: f64,
    out: *mut *const Sample,
    error: *mut ErrorInfo,
) -> i32 {
    guard(error, || {
        let Reading { source, last, end } = &mut *hold(&of(samples)?.0)?;
        let wanted = (u32::try_from(world).ok(), duration("timeout", timeout)?);
        let mut sample = Sample::default();
        let to = &mut sample;
        let memory = match source {
            Source::Frames(observer) => observed(observer, wanted, to, frame)?,
            Source::Truths(observer) => observed(observer, wanted, to, truth)?,
            Source::Beliefs(observer) => observed(observer, wanted, to, belief)?,
            Source::Recording(reader) if end.is_none() => {
                let read = recorded(reader, wanted.0, to);
                *end = read.as_ref().err().map(|error| error.message.clone());
                read?
            }
            Source::Recording(_) => return Err(bad(end.as_deref().unwrap_or_default())),
        };
        keep(last, View::new(sample, memory), out);
        Ok(())
    })
}
