//! What clients of a replay are told: the recorded server's words, and where its worlds stand by now.

use protocol::control::{Reply, Request, ServerInfo, ServerStatus, WorldInfo, WorldStatus, parse};
use protocol::message::{Status, VERSION};
use protocol::recording::Event;
use std::collections::BTreeMap;
use std::time::Instant;

/// Why nothing can be acted on.
const REFUSAL: &str = "a recording is replayed on this instance: it can be observed, not acted on";

/// What a replay has shown so far.
pub struct Stage {
    info: ServerInfo,
    has_truth: bool,
    worlds: BTreeMap<u32, WorldInfo>,
    began: Instant,
    n_steps: u64,
    n_refused: u64,
}

/// Who is connected.
pub struct Audience {
    /// Clients on the step channel.
    pub n_clients: usize,
    /// Observers of frames.
    pub n_observers: usize,
}

/// What to do behind an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Act {
    /// Go on.
    GoOn,
    /// End.
    End,
}

impl Stage {
    /// Nothing was shown yet of this server.
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

    /// World steps shown.
    pub fn n_steps(&self) -> u64 {
        self.n_steps
    }

    /// Takes note of what is published.
    pub fn show(&mut self, event: &Event) {
        match event {
            Event::Server(info) => {
                self.info = ServerInfo::clone(info);
                self.worlds.clear();
            }
            Event::Frame(sample) => {
                let (header, result) = (&sample.header, &sample.header.result);
                self.n_steps += u64::from(header.n_moves > 0);
                let info = WorldInfo {
                    world: header.world,
                    step: result.step,
                    seed: result.seed,
                    episode: result.episode,
                    robot: [result.row, result.col],
                };
                self.worlds.insert(header.world, info);
            }
            Event::Truth(_) => {}
        }
    }

    /// The status of every step request.
    pub fn refuse_step(&mut self, version: u32) -> Status {
        self.n_refused += 1;
        if version == VERSION {
            Status::NotPermitted
        } else {
            Status::VersionMismatch
        }
    }

    /// The answer to a control request.
    pub fn answer(&mut self, version: u32, text: &[u8], audience: &Audience) -> (Reply, Act) {
        let reply = match parse::<Request>(text) {
            _ if version != VERSION => version_mismatch(version),
            Err(message) => Reply::Error {
                status: Status::Malformed,
                detail: 0,
                message,
            },
            Ok(Request::Hello { protocol, .. }) if protocol != VERSION => {
                version_mismatch(protocol)
            }
            Ok(Request::Hello { .. }) => Reply::Hello(Box::new(ServerInfo {
                pid: std::process::id(),
                publish_truth: self.has_truth,
                ..self.info.clone()
            })),
            Ok(Request::Status {}) => Reply::Status(self.status(audience)),
            Ok(Request::Shutdown {}) => return (Reply::Done, Act::End),
            Ok(_) => Reply::Error {
                status: Status::NotPermitted,
                detail: 0,
                message: REFUSAL.into(),
            },
        };
        self.n_refused += u64::from(reply.status() != Status::Ok);
        (reply, Act::GoOn)
    }

    fn status(&self, audience: &Audience) -> ServerStatus {
        let uptime = self.began.elapsed();
        let shown = self.worlds.values().cloned();
        ServerStatus {
            pid: std::process::id(),
            uptime_millis: uptime.as_millis() as u64,
            n_steps: self.n_steps,
            steps_per_second: self.n_steps as f64 / uptime.as_secs_f64().max(1e-9),
            n_refused: self.n_refused,
            n_clients: audience.n_clients,
            n_observers: audience.n_observers,
            worlds: shown
                .map(|info| WorldStatus {
                    info,
                    holder_pid: None,
                    resetting: false,
                })
                .collect(),
        }
    }
}

fn version_mismatch(client: u32) -> Reply {
    Reply::Error {
        status: Status::VersionMismatch,
        detail: VERSION.into(),
        message: Status::version_mismatch(client, VERSION.into()),
    }
}
