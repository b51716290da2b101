//! Watches an instance: before its server starts, while the server runs, and after it has ended.
//!
//! One thread reads the published samples, even if no server runs. Another thread regularly asks the server for its
//! status.

use crate::scene::{Info, Stage};
use anyhow::{Context, Result, bail};
use emberwatch_protocol::agent_belief::AgentBelief;
use emberwatch_protocol::channels::{AGENT_BUFFER, ChannelError, FRAME_BUFFER, Instance};
use emberwatch_protocol::connection::{Connection, ConnectionError, unexpected};
use emberwatch_protocol::control::{Reply, Request, ServerStatus};
use emberwatch_protocol::message::{AgentHeader, FrameHeader, Header, TruthHeader};
use emberwatch_protocol::observer::{Observer, Sample};
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Minimum time between two reads of the channels. A buffer of 64 frames lasts that long at 32,000 steps per second.
const MIN_INTERVAL: Duration = Duration::from_millis(2);

/// Maximum time between two reads. Longer intervals cost the simulator less processor time.
const MAX_INTERVAL: Duration = Duration::from_millis(10);

/// Numbers of frames and beliefs in one read above which the next read follows soon, before buffers overflow.
const MANY: (usize, usize) = (FRAME_BUFFER / 3, AGENT_BUFFER / 3);

/// How long to read at the minimum interval after a large read.
const BUSY: Duration = Duration::from_secs(1);

/// Time after which failed channels are reopened.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);

/// How long a belief waits for its frame: an agent's belief may arrive before the server's frame.
const EARLY: Duration = Duration::from_secs(1);

/// Maximum number of samples per channel in one read, so that browsers need not wait long.
const MAX_AT_ONCE: usize = 128;

/// Time between two status requests, and between two attempts to find a server.
const ASK_INTERVAL: Duration = Duration::from_millis(250);

/// Timeout of requests to the server.
const ASK_TIMEOUT: Duration = Duration::from_secs(2);

/// The name of this program in a server's log.
const CLIENT_NAME: &str = "emberwatch-dashboard";

/// Starts threads that fill the stage until `stop`. Returns the threads.
///
/// # Errors
/// If the frames cannot be read, for example because there are too many observers, or if a thread cannot start.
pub fn watch(
    instance: &Instance,
    stage: &Arc<Stage>,
    stop: &Arc<AtomicBool>,
) -> Result<[JoinHandle<()>; 2]> {
    let (ready, is_ready) = std::sync::mpsc::channel();
    let spawn = |name: &str| std::thread::Builder::new().name(name.into());
    let (place, on, until) = (instance.clone(), stage.clone(), stop.clone());
    // Ports must stay on the thread that created them.
    let reader = spawn("reader").spawn(move || {
        let opened = Reader::open(&place, &on);
        let _ = ready.send(opened.as_ref().err().map(ToString::to_string));
        if let Ok(reader) = opened {
            read(reader, &place, &on, &until);
        }
    });
    let reader = reader.context("start a thread")?;
    if let Some(problem) = is_ready.recv().context("the reader ended at once")? {
        bail!(problem);
    }
    let (place, stage, stop) = (instance.clone(), stage.clone(), stop.clone());
    let asker = spawn("asker").spawn(move || {
        while !stop.load(Ordering::Relaxed) {
            let problem = ask(&place, &stage, &stop);
            stage.change(|scene| {
                scene.is_serving = false;
                scene.status = None;
                scene.note = problem.err().map(|problem| problem.to_string());
            });
            std::thread::sleep(ASK_INTERVAL);
        }
    });
    Ok([reader, asker.context("start a thread")?])
}

/// Reads until `stop`. Reopens channels that fail.
fn read(reader: Reader, instance: &Instance, stage: &Stage, stop: &AtomicBool) {
    let mut reader = Ok(reader);
    while !stop.load(Ordering::Relaxed) {
        let failed = match reader {
            Ok(reader) => reader.read(stage, stop).err(),
            Err(error) => Some(error),
        };
        let Some(error) = failed else { return };
        tracing::error!("{error}");
        stage.change(|scene| scene.trouble = Some(error.to_string()));
        std::thread::sleep(REOPEN_INTERVAL);
        reader = Reader::open(instance, stage);
    }
}

/// Asks a server for its status until it is gone or `stop`.
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

/// The subscribers to the channels.
struct Reader {
    frames: Observer<FrameHeader>,
    truth: Option<Observer<TruthHeader>>,
    agents: Option<Observer<AgentHeader>>,
    /// Beliefs that arrived before their frames, with the times of arrival.
    early: Vec<(AgentBelief, Instant)>,
    frame_gaps: Gaps,
    truth_gaps: Gaps,
    agent_gaps: HashMap<u32, Gaps>,
}

/// Counts gaps in sequence numbers.
#[derive(Default)]
struct Gaps {
    next: Option<(Option<u32>, u64)>,
}

impl Gaps {
    /// Returns the number of samples missing right before this one. A new publisher begins a new sequence.
    fn before(&mut self, publisher: Option<u32>, sequence: u64) -> u64 {
        let next = self.next.replace((publisher, sequence.wrapping_add(1)));
        match next {
            Some((before, next)) if before == publisher => sequence.saturating_sub(next),
            _ => 0,
        }
    }
}

impl Reader {
    /// Opens the channels. If the channel of hidden states or of beliefs cannot be opened, reports that and reads the
    /// remaining channels.
    fn open(instance: &Instance, stage: &Stage) -> Result<Self, ChannelError> {
        let frames = Observer::frames(instance)?;
        let (truth, agents) = (Observer::truth(instance), Observer::agents(instance));
        let trouble = [truth.as_ref().err(), agents.as_ref().err()];
        let trouble: Vec<String> = trouble
            .into_iter()
            .flatten()
            .map(ToString::to_string)
            .collect();
        trouble
            .iter()
            .for_each(|problem| tracing::warn!("{problem}"));
        stage.change(|scene| scene.trouble = (!trouble.is_empty()).then(|| trouble.join("; ")));
        Ok(Self {
            frames,
            truth: truth.ok(),
            agents: agents.ok(),
            early: Vec::new(),
            frame_gaps: Gaps::default(),
            truth_gaps: Gaps::default(),
            agent_gaps: HashMap::new(),
        })
    }

    fn read(mut self, stage: &Stage, stop: &AtomicBool) -> Result<(), ChannelError> {
        let mut busy = Instant::now();
        while !stop.load(Ordering::Relaxed) {
            if self.look(stage)? {
                busy = Instant::now();
            }
            std::thread::sleep(if busy.elapsed() < BUSY {
                MIN_INTERVAL
            } else {
                MAX_INTERVAL
            });
        }
        Ok(())
    }

    /// Reads the available samples. Returns true if there were many.
    fn look(&mut self, stage: &Stage) -> Result<bool, ChannelError> {
        // Beliefs are read first. A belief and its frame are published at about the same time, so when the frames are
        // read, the belief's frame has usually arrived.
        let beliefs = self.agents.as_ref().map_or(Ok(Vec::new()), all)?;
        let frames = all(&self.frames)?;
        let truths = self.truth.as_ref().map_or(Ok(Vec::new()), all)?;
        if beliefs.is_empty() && frames.is_empty() && truths.is_empty() {
            return Ok(false);
        }
        let server = self.frames.publisher();
        let now = Instant::now();
        stage.change(|scene| {
            for frame in &frames {
                let lost = self.frame_gaps.before(server, frame.header.sequence);
                scene.lost.frames = scene.lost.frames.saturating_add(lost);
                scene.album.add_frame(frame, now);
            }
            for truth in &truths {
                let lost = self.truth_gaps.before(server, truth.header.sequence);
                scene.lost.truth = scene.lost.truth.saturating_add(lost);
                scene.album.add_truth(truth);
            }
            for belief in &beliefs {
                let (pid, sequence) = (belief.header.pid, belief.header.sequence);
                let gaps = self.agent_gaps.entry(pid).or_default();
                let lost = gaps.before(Some(pid), sequence);
                scene.lost.agent = scene.lost.agent.saturating_add(lost);
                match AgentBelief::try_from(belief) {
                    Ok(published) => self.early.push((published, now)),
                    Err(error) => tracing::warn!("{error}"),
                }
            }
            let states = scene.states();
            self.early.retain(|(published, came)| {
                let is_there = scene.album.add_belief(published, states.as_ref());
                !is_there && now.duration_since(*came) < EARLY
            });
        });
        Ok(frames.len() > MANY.0 || beliefs.len() > MANY.1)
    }
}

fn all<H: Header>(observer: &Observer<H>) -> Result<Vec<Sample<H>>, ChannelError> {
    let mut samples = Vec::new();
    while samples.len() < MAX_AT_ONCE
        && let Some(sample) = observer.try_receive()?
    {
        samples.push(sample);
    }
    Ok(samples)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_counted_per_publisher() {
        let mut gaps = Gaps::default();
        let row = [(1, 7), (1, 8), (1, 11), (1, 11), (2, 90), (2, 92), (1, 12)];
        let missing = row.map(|(publisher, sequence)| gaps.before(Some(publisher), sequence));
        assert_eq!(missing, [0, 0, 2, 0, 0, 1, 0]);
    }
}
