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
use emberwatch_protocol::message::{AgentHeader, FrameHeader, Published, TruthHeader};
use emberwatch_protocol::observer::{Observer, Sample};
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

const REOPEN_INTERVAL: Duration = Duration::from_secs(1);

/// How long a belief waits for its frame: an agent's belief may arrive before the server's frame.
const EARLY: Duration = Duration::from_secs(1);

/// Maximum number of samples per channel in one read, so that browsers need not wait long.
const MAX_AT_ONCE: usize = 128;

/// Time between two status requests, and between two attempts to find a server.
const ASK_INTERVAL: Duration = Duration::from_millis(250);

const ASK_TIMEOUT: Duration = Duration::from_secs(2);

const CLIENT_NAME: &str = "emberwatch-dashboard";

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

struct Reader {
    frames: Observer<FrameHeader>,
    truth: Option<Observer<TruthHeader>>,
    agents: Option<Observer<AgentHeader>>,
    /// Beliefs that arrived before their frames, with the times of arrival.
    early: Vec<(AgentBelief, Instant)>,
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

    fn look(&mut self, stage: &Stage) -> Result<bool, ChannelError> {
        // Beliefs are read first. A belief and its frame are published at about the same time, so when the frames are
        // read, the belief's frame has usually arrived.
        let beliefs = self.agents.as_ref().map_or(Ok(Vec::new()), all)?;
        let frames = all(&self.frames)?;
        let truths = self.truth.as_ref().map_or(Ok(Vec::new()), all)?;
        if beliefs.is_empty() && frames.is_empty() && truths.is_empty() {
            return Ok(false);
        }
        let now = Instant::now();
        let (frames_lost, truths_lost) = (self.frames.take_lost(), lost(self.truth.as_ref()));
        let beliefs_lost = lost(self.agents.as_ref());
        stage.change(|scene| {
            scene.lost.frames = scene.lost.frames.saturating_add(frames_lost);
            scene.lost.truth = scene.lost.truth.saturating_add(truths_lost);
            scene.lost.agent = scene.lost.agent.saturating_add(beliefs_lost);
            for frame in &frames {
                scene.album.add_frame(frame, now);
            }
            for truth in &truths {
                scene.album.add_truth(truth);
            }
            for belief in &beliefs {
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

fn lost<H: Published>(observer: Option<&Observer<H>>) -> u64 {
    observer.map_or(0, Observer::take_lost)
}

fn all<H: Published>(observer: &Observer<H>) -> Result<Vec<Sample<H>>, ChannelError> {
    let mut samples = Vec::new();
    while samples.len() < MAX_AT_ONCE
        && let Some(sample) = observer.try_receive()?
    {
        samples.push(sample);
    }
    Ok(samples)
}
