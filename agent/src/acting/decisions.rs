//! Serves decisions: a learner outside says what each path is for, this program does the rest.
//!
//! One request after the other, each answered before the next is taken; between them the lease is kept
//! alive. Without the worlds there is nothing to serve, so a lost lease or a server that ends is the end.

use crate::acting::decider::{Assignment, Decider};
use crate::acting::mission::prepare;
use crate::client::errors::{is_outage, refusal};
use crate::estimation::first_belief::first_belief;
use anyhow::{Result, ensure};
use emberwatch_belief::estimation::Prior;
use emberwatch_protocol::Model;
use emberwatch_protocol::channels::{ChannelError, ipc_error};
use emberwatch_protocol::control::parse;
use emberwatch_protocol::decisions::{Reply, Request};
use emberwatch_protocol::message::{Status, VERSION};
use emberwatch_protocol::program::WatchedProcess;
use emberwatch_protocol::responder::{ActiveControl, Responder, wait_until_taken};
use emberwatch_protocol::wait::{Waiter, sleep_until_event};
use std::cell::Cell;
use std::fmt::Display;
use std::os::fd::BorrowedFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How often to look around without being asked: bounds how late a signal is noticed.
const TICK: Duration = Duration::from_millis(250);

/// Serves until `stop` is set, a client asks to shut down, or the process `exit_with` ends; then
/// releases the worlds. `model` is for servers that do not reveal theirs.
pub fn serve_decisions(
    task: &Assignment,
    model: Option<&Model>,
    exit_with: Option<WatchedProcess>,
    stop: &AtomicBool,
) -> Result<()> {
    let mut service = Service::start(task, model, exit_with)?;
    match service.serve(stop) {
        Ok(asked) => service.stop(asked),
        Err(error) => {
            service.desk.refuse_everybody(&reply_to(&error));
            Err(error)
        }
    }
}

struct Service {
    desk: Desk,
    decider: Decider,
    exit_with: Option<WatchedProcess>,
    waiter: Waiter,
    last_look: Instant,
}

/// Where requests come in and answers go out.
struct Desk {
    responder: Responder,
    /// The last requests, whose clients may still be reading.
    answered: Vec<ActiveControl>,
}

impl Service {
    fn start(
        task: &Assignment,
        model: Option<&Model>,
        exit_with: Option<WatchedProcess>,
    ) -> Result<Self> {
        // What takes long is done before anybody can ask and before the lease begins to run.
        let knows_model = task.estimator.knows_model();
        let (info, model) = prepare(&task.instance, &task.worlds, model, knows_model)?;
        ensure!(
            info.n_robots == 1,
            "serve-decisions flies one robot a world: expected a server with --robots 1, got {}",
            info.n_robots
        );
        let shape = info.shape()?;
        let prior = if knows_model {
            task.config.prior(info.burn_in)
        } else {
            Prior::Initial
        };
        let prior = first_belief(prior, &model, shape, task.config.seed)?;
        let responder = Responder::open(&task.instance, task.worlds.start)?;
        let decider = Decider::attach(task, model, prior)?;
        tracing::info!(
            instance = task.instance.name(),
            pid = std::process::id(),
            world = task.worlds.start,
            n_worlds = task.worlds.len(),
            "serving decisions"
        );
        Ok(Self {
            desk: Desk {
                responder,
                answered: Vec::new(),
            },
            decider,
            exit_with,
            waiter: Waiter::default(),
            last_look: Instant::now(),
        })
    }

    /// Serves to the end; returns the request that asked for it, if it was one.
    fn serve(&mut self, stop: &AtomicBool) -> Result<Option<ActiveControl>> {
        while !stop.load(Ordering::Relaxed) && !self.watched_has_ended() {
            if let Some(request) = self.wait()? {
                match self.handle(&request) {
                    Ok(Some(reply)) => self.desk.answer(&request, &reply),
                    Ok(None) => return Ok(Some(request)),
                    Err(error) => {
                        self.desk.answer(&request, &reply_to(&error));
                        if is_the_end(&error) {
                            self.desk.answered.push(request);
                            return Err(error);
                        }
                    }
                }
            }
            let now = Instant::now();
            if now - self.last_look > TICK || self.decider.until_renewal(now).is_zero() {
                self.last_look = now;
                self.decider.keep_alive(now)?;
            }
        }
        Ok(None)
    }

    /// The next request; `None` after a while or an event.
    fn wait(&mut self) -> Result<Option<ActiveControl>> {
        let woken = Cell::new(false);
        let tick = TICK.min(self.decider.until_renewal(Instant::now()));
        let look = || match self.desk.responder.receive() {
            Some(request) => Ok(Some(Some(request))),
            // A wake-up without a request, or a death.
            None => Ok(woken.get().then_some(None)),
        };
        let found = self.waiter.wait(tick, look, |limit| {
            woken.set(self.sleep(limit)?);
            Ok::<_, ChannelError>(())
        })?;
        let request = found.flatten();
        if request.is_none() {
            self.decider.keep_alive(Instant::now())?;
        }
        Ok(request)
    }

    /// Sleeps until a wake-up, a signal or a death; returns whether there was one.
    fn sleep(&self, limit: Duration) -> Result<bool, ChannelError> {
        if self.desk.responder.drain()? {
            return Ok(true);
        }
        let own = [
            self.desk.responder.descriptor(),
            self.decider.server_process(),
        ];
        let exit_with = self.exit_with.iter().map(WatchedProcess::descriptor);
        let descriptors: Vec<BorrowedFd<'_>> = own.into_iter().chain(exit_with).collect();
        sleep_until_event(&descriptors, limit).map_err(ipc_error("sleep"))
    }

    /// The reply; `None` to a request to shut down.
    fn handle(&mut self, request: &ActiveControl) -> Result<Option<Reply>> {
        let version = request.user_header().version;
        if version != VERSION {
            return Ok(Some(mismatch(version)));
        }
        let reply = match parse(request.payload()) {
            Err(message) => error_reply(Status::Malformed, 0, message),
            Ok(Request::Hello { protocol, .. }) if protocol != VERSION => mismatch(protocol),
            Ok(Request::Hello { client, .. }) => {
                tracing::info!(client, "hello");
                Reply::Hello(Box::new(self.decider.info().clone()))
            }
            Ok(Request::Reset { worlds }) => {
                let decisions = self.decider.reset(&worlds)?;
                tracing::info!(n_worlds = worlds.len(), "reset");
                Reply::Decisions { worlds: decisions }
            }
            Ok(Request::Decide { objectives }) => {
                let worlds = self.decider.decide(&objectives)?;
                tracing::debug!(?objectives, "decided");
                Reply::Decisions { worlds }
            }
            Ok(Request::Last {}) => Reply::Decisions {
                worlds: self.decider.last(),
            },
            Ok(Request::Shutdown {}) => return Ok(None),
        };
        Ok(Some(reply))
    }

    /// Releases the worlds, then answers the client that asked for it.
    fn stop(self, asked: Option<ActiveControl>) -> Result<()> {
        let Self {
            mut desk, decider, ..
        } = self;
        let released = decider.release();
        if let Some(request) = asked {
            desk.answer(&request, &Reply::Done);
            desk.answered.push(request);
        }
        let told = because("it was told to stop");
        desk.refuse_everybody(&error_reply(Status::AgentEnds, 0, told));
        match released {
            Err(error) if !is_outage(&error) => Err(error),
            _ => Ok(()),
        }
    }

    fn watched_has_ended(&self) -> bool {
        self.exit_with
            .as_ref()
            .is_some_and(WatchedProcess::has_ended)
    }
}

impl Desk {
    fn answer(&mut self, request: &ActiveControl, reply: &Reply) {
        if reply.status() != Status::Ok {
            tracing::debug!(status = ?reply.status(), "refused a request");
        }
        self.responder.answer(request, reply.status(), reply);
    }

    /// Refuses those who still ask, and lets clients read before the channel closes.
    fn refuse_everybody(&mut self, reply: &Reply) {
        while let Some(request) = self.responder.receive() {
            self.answer(&request, reply);
            self.answered.push(request);
        }
        wait_until_taken(&self.answered);
    }
}

/// A refusal passes through; whatever else fails ends the agent.
fn reply_to(error: &anyhow::Error) -> Reply {
    match refusal(error) {
        Some((status, detail, message)) => error_reply(status, detail, message.into()),
        None => error_reply(Status::AgentEnds, 0, because(error)),
    }
}

/// Whether the agent cannot go on after an error.
fn is_the_end(error: &anyhow::Error) -> bool {
    refusal(error).is_none_or(|(status, ..)| matches!(status, Status::LeaseLost | Status::NoLease))
}

fn because(reason: impl Display) -> String {
    format!("{}: {reason}", Status::AgentEnds.explain(0))
}

fn error_reply(status: Status, detail: u64, message: String) -> Reply {
    Reply::Error {
        status,
        detail,
        message,
    }
}

/// The refusal of a client that speaks another version.
fn mismatch(client: u32) -> Reply {
    let detail = u64::from(VERSION);
    let message = Status::version_mismatch(client, detail);
    error_reply(Status::VersionMismatch, detail, message)
}
