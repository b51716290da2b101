//! Replies to the clients of a replay: the recorded server's answer to `hello`, and the last published state of the
//! worlds.

use emberwatch_protocol::control::{
    Reply, Request, ServerInfo, ServerStatus, WorldInfo, WorldStatus, parse,
};
use emberwatch_protocol::message::{Status, VERSION};
use emberwatch_protocol::payload::split_frame_payload;
use emberwatch_protocol::program::pid_namespace;
use emberwatch_protocol::recording::Event;
use std::collections::BTreeMap;
use std::time::Instant;

const REFUSAL: &str =
    "this instance replays a recording: it can be observed but accepts no actions";

/// The description of the server and the states of the worlds that a replay has published so far.
pub struct ReplayState {
    info: ServerInfo,
    has_truth: bool,
    worlds: BTreeMap<u32, WorldInfo>,
    began: Instant,
    n_steps: u64,
    n_refused: u64,
}

/// Numbers of connected clients and observers.
pub struct ConnectionCounts {
    /// Number of clients on the step channel.
    pub n_clients: usize,
    /// Number of observers of frames.
    pub n_observers: usize,
}

/// Whether the replay continues after it has answered a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next {
    Continue,
    End,
}

impl ReplayState {
    /// Creates the state of a replay before the first sample of the server.
    pub fn new(info: ServerInfo, has_truth: bool) -> Self {
        Self {
            info,
            has_truth,
            worlds: BTreeMap::new(),
            began: Instant::now(),
            n_steps: 0,
            n_refused: 0,
        }
    }

    /// Returns the number of published world steps.
    pub fn n_steps(&self) -> u64 {
        self.n_steps
    }

    /// Updates the state with a published record.
    pub fn record(&mut self, event: &Event) {
        match event {
            Event::Server(info) => {
                self.info = ServerInfo::clone(info);
                self.worlds.clear();
            }
            Event::Frame(sample) => {
                let (header, result) = (&sample.header, &sample.header.result);
                self.n_steps += u64::from(result.step > 0);
                let robots = split_frame_payload(header, &sample.payload).unwrap_or_default();
                let cells = robots
                    .iter()
                    .map(|robot| [robot.result.row, robot.result.col]);
                let info = WorldInfo {
                    world: header.world,
                    step: result.step,
                    seed: result.seed,
                    episode: result.episode,
                    robots: cells.collect(),
                };
                self.worlds.insert(header.world, info);
            }
            Event::Truth(_) => {}
        }
    }

    /// Counts a step request, and returns the status with which it is refused.
    pub fn refuse_step(&mut self, version: u32) -> Status {
        self.n_refused += 1;
        if version == VERSION {
            Status::NotPermitted
        } else {
            Status::VersionMismatch
        }
    }

    /// Answers a control request.
    pub fn answer(
        &mut self,
        version: u32,
        text: &[u8],
        counts: &ConnectionCounts,
    ) -> (Reply, Next) {
        let reply = match parse::<Request>(text) {
            _ if version != VERSION => Reply::version_mismatch(version),
            Err(message) => Reply::error(Status::Malformed, 0, message),
            Ok(Request::Hello { protocol, .. }) if protocol != VERSION => {
                Reply::version_mismatch(protocol)
            }
            Ok(Request::Hello { .. }) => Reply::Hello(Box::new(ServerInfo {
                pid: std::process::id(),
                pid_namespace: pid_namespace(),
                publish_truth: self.has_truth,
                ..self.info.clone()
            })),
            Ok(Request::Status {}) => Reply::Status(self.status(counts)),
            Ok(Request::Shutdown {}) => return (Reply::Done, Next::End),
            Ok(_) => Reply::error(Status::NotPermitted, 0, REFUSAL.into()),
        };
        self.n_refused += u64::from(reply.status() != Status::Ok);
        (reply, Next::Continue)
    }

    fn status(&self, counts: &ConnectionCounts) -> ServerStatus {
        let uptime = self.began.elapsed();
        let shown = self.worlds.values().cloned();
        ServerStatus {
            pid: std::process::id(),
            uptime_millis: uptime.as_millis() as u64,
            n_steps: self.n_steps,
            steps_per_second: self.n_steps as f64 / uptime.as_secs_f64().max(1e-9),
            n_refused: self.n_refused,
            n_clients: counts.n_clients,
            n_observers: counts.n_observers,
            worlds: shown
                .map(|info| WorldStatus {
                    holder_pids: vec![None; info.robots.len()],
                    info,
                    n_paths: 0,
                    resetting: false,
                })
                .collect(),
        }
    }
}
