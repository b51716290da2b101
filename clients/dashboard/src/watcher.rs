//! Watches a running instance: before its server starts, while it runs, after it ended.
//!
//! One thread reads what is published, which needs no server; another asks the server now and then how it is.

use crate::scene::{Info, Stage};
use protocol::channels::{ChannelError, Instance};
use protocol::connection::{Connection, ConnectionError, unexpected};
use protocol::control::{Reply, Request, ServerStatus};
use protocol::message::{AgentHeader, FrameHeader, Header, TruthHeader};
use protocol::observer::{Observer, Sample};
use protocol::outlook::Outlook;
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use thiserror::Error;

/// Time between two looks at the channels: a buffer of 64 frames lasts that long at 32,000 steps a second.
const LOOK_INTERVAL: Duration = Duration::from_millis(2);

/// The same while nothing comes.
const IDLE_INTERVAL: Duration = Duration::from_millis(10);

/// Nothing comes if nothing came for so long.
const IDLE_AFTER: Duration = Duration::from_secs(1);

/// Most samples of a channel taken in at a look, so that browsers get their turn.
const MOST_AT_ONCE: usize = 128;

/// Time between two questions to the server, and between two searches for one.
const ASK_INTERVAL: Duration = Duration::from_millis(250);

/// How long the server may take to answer.
const ASK_TIMEOUT: Duration = Duration::from_secs(2);

/// The name of this program in a server's log.
const CLIENT_NAME: &str = "emberwatch-dashboard";

/// Why an instance cannot be watched.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum WatchError {
    /// A channel cannot be had.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// A thread cannot be had.
    #[error("start a thread: {0}")]
    Thread(#[from] std::io::Error),
}

/// Fills the stage until `stop`.
///
/// # Errors
/// [`WatchError`], also when there are too many observers.
pub fn watch(
    instance: &Instance,
    stage: &Arc<Stage>,
    stop: &Arc<AtomicBool>,
) -> Result<(), WatchError> {
    let (ready, is_ready) = std::sync::mpsc::channel();
    let spawn = |name: &str| std::thread::Builder::new().name(name.into());
    let (place, for_reader, until) = (instance.clone(), stage.clone(), stop.clone());
    // Ports stay on the thread that made them.
    spawn("reader").spawn(move || match Reader::open(&place) {
        Ok(reader) => {
            let _ = ready.send(Ok(()));
            reader.read(&for_reader, &until);
        }
        Err(error) => drop(ready.send(Err(error))),
    })?;
    if let Ok(Err(error)) = is_ready.recv() {
        return Err(error.into());
    }
    let (place, stage, stop) = (instance.clone(), stage.clone(), stop.clone());
    spawn("asker").spawn(move || {
        while !stop.load(Ordering::Relaxed) {
            let problem = ask(&place, &stage, &stop);
            stage.change(|scene| {
                scene.is_serving = false;
                scene.status = None;
                scene.note = problem.err().map(|problem| problem.to_string());
            });
            std::thread::sleep(ASK_INTERVAL);
        }
    })?;
    Ok(())
}

/// Asks a server how it is until it is gone or `stop`.
fn ask(instance: &Instance, stage: &Stage, stop: &AtomicBool) -> Result<(), ConnectionError> {
    let mut connection = Connection::open(instance, CLIENT_NAME, ASK_TIMEOUT)?;
    let info = Info::new(connection.info());
    stage.change(|scene| scene.info = Some(info));
    while !stop.load(Ordering::Relaxed) {
        let status = status(&mut connection)?;
        stage.change(|scene| {
            scene.is_serving = true;
            scene.note = None;
            scene.status = Some(status);
        });
        std::thread::sleep(ASK_INTERVAL);
    }
    Ok(())
}

fn status(connection: &mut Connection) -> Result<ServerStatus, ConnectionError> {
    match connection.control(&Request::Status {}, ASK_TIMEOUT)? {
        Reply::Status(status) => Ok(status),
        other => Err(unexpected("a status", &other)),
    }
}

/// The ports of an observer.
struct Reader {
    frames: Observer<FrameHeader>,
    truth: Observer<TruthHeader>,
    agents: Observer<AgentHeader>,
    frame_gaps: Gaps,
    truth_gaps: Gaps,
    agent_gaps: HashMap<u32, Gaps>,
}

/// Counts what is missing in a row of sequence numbers.
#[derive(Default)]
struct Gaps {
    next: Option<(Option<u32>, u64)>,
}

impl Gaps {
    /// Samples missing right before this one; another publisher begins a new row.
    fn before(&mut self, publisher: Option<u32>, sequence: u64) -> u64 {
        let next = self.next.replace((publisher, sequence + 1));
        match next {
            Some((before, next)) if before == publisher => sequence.saturating_sub(next),
            _ => 0,
        }
    }
}

impl Reader {
    fn open(instance: &Instance) -> Result<Self, ChannelError> {
        Ok(Self {
            frames: Observer::frames(instance)?,
            truth: Observer::truth(instance)?,
            agents: Observer::agents(instance)?,
            frame_gaps: Gaps::default(),
            truth_gaps: Gaps::default(),
            agent_gaps: HashMap::new(),
        })
    }

    fn read(mut self, stage: &Stage, stop: &AtomicBool) {
        let mut last = Instant::now();
        while !stop.load(Ordering::Relaxed) {
            match self.look(stage) {
                Ok(true) => last = Instant::now(),
                Ok(false) => {}
                Err(error) => {
                    tracing::error!("{error}");
                    stage.change(|scene| scene.note = Some(error.to_string()));
                    return;
                }
            }
            std::thread::sleep(match last.elapsed() < IDLE_AFTER {
                true => LOOK_INTERVAL,
                false => IDLE_INTERVAL,
            });
        }
    }

    /// Takes in what is there; whether anything was.
    fn look(&mut self, stage: &Stage) -> Result<bool, ChannelError> {
        // Beliefs first: what they are about was published before them, so it is there when they are added.
        let beliefs = all(&self.agents)?;
        let frames = all(&self.frames)?;
        let truths = all(&self.truth)?;
        if beliefs.is_empty() && frames.is_empty() && truths.is_empty() {
            return Ok(false);
        }
        let outlooks = beliefs.iter().map(Outlook::try_from);
        let outlooks: Vec<Outlook> = outlooks
            .filter_map(|outlook| outlook.inspect_err(|error| tracing::warn!("{error}")).ok())
            .collect();
        let server = self.frames.publisher();
        let now = Instant::now();
        stage.change(|scene| {
            for frame in &frames {
                scene.lost.frames += self.frame_gaps.before(server, frame.header.sequence);
                scene.album.add_frame(frame, now);
            }
            for truth in &truths {
                scene.lost.truth += self.truth_gaps.before(server, truth.header.sequence);
                scene.album.add_truth(truth);
            }
            let states = scene.states();
            for outlook in &outlooks {
                let (pid, sequence) = (outlook.header.pid, outlook.header.sequence);
                let gaps = self.agent_gaps.entry(pid).or_default();
                scene.lost.agent += gaps.before(Some(pid), sequence);
                scene.album.add_belief(outlook, states.as_ref());
            }
        });
        Ok(true)
    }
}

fn all<H: Header>(observer: &Observer<H>) -> Result<Vec<Sample<H>>, ChannelError> {
    let mut samples = Vec::new();
    while samples.len() < MOST_AT_ONCE
        && let Some(sample) = observer.try_receive()?
    {
        samples.push(sample);
    }
    Ok(samples)
}
