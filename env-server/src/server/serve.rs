//! The server's main loop: receives requests, answers them, and publishes frames.

use super::ports::ActiveStep;
use super::state::Server;
use anyhow::Result;
use emberwatch_protocol::channels::ipc_error;
use emberwatch_protocol::control::Reply;
use emberwatch_protocol::message::{Operation, StepReply};
use emberwatch_protocol::program::WatchedProcess;
use emberwatch_protocol::responder::{ActiveControl, listener_id, wait_until_taken};
use emberwatch_protocol::wait::sleep_until_event;
use emberwatch_sim::config::Checked;
use emberwatch_sim::simulator::{Outcome, ServerStats, Stepped};
use iceoryx2::prelude::PayloadHeader;
use std::cell::Cell;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How often an idle server checks for expired leases and new observers.
const IDLE_TICK: Duration = Duration::from_millis(250);

/// How often a busy server checks for expired leases, new observers and dead clients.
const BUSY_TICK: Duration = Duration::from_millis(50);

/// One round in this many checks for a control request before a step request.
const CONTROL_FIRST: u64 = 64;

/// How often a server publishes the next batch of worlds for new observers.
const NEW_OBSERVER_TICK: Duration = Duration::from_millis(5);

pub fn serve(checked: Checked, stop: &Arc<AtomicBool>, exit_with: Option<i32>) -> Result<()> {
    let mut server = Server::start(checked, exit_with)?;
    let mut outcome = Ok(());
    while outcome.is_ok() && !stop.load(Ordering::Relaxed) && !server.is_over {
        outcome = server.run_once();
    }
    let n_steps = server.simulator.n_steps();
    server.end()?;
    outcome?;
    tracing::info!(n_steps, "stopped");
    Ok(())
}

enum Found {
    Step(ActiveStep),
    Control(ActiveControl),
    /// Any other event: a wake-up without a request, the end of a process, or a finished reset or file job.
    Event,
}

impl Server {
    fn run_once(&mut self) -> Result<()> {
        let woken = Cell::new(false);
        let tick = if self.publications.has_new_observers() {
            NEW_OBSERVER_TICK
        } else {
            IDLE_TICK
        };
        let deadline = self.simulator.next_deadline();
        let tick = deadline.map_or(tick, |at| {
            tick.min(at.saturating_duration_since(Instant::now()))
        });
        // In some rounds control requests come first, so that a constant stream of step requests cannot block them.
        self.n_rounds = self.n_rounds.wrapping_add(1);
        if self.n_rounds.is_multiple_of(CONTROL_FIRST)
            && let Some(request) = self.ports.receive_control()
        {
            self.answer_control(Instant::now(), request);
            return Ok(());
        }
        let found = self.waiter.wait(
            tick,
            || Ok(self.poll(&woken)),
            |limit| {
                woken.set(self.sleep(limit)?);
                Ok::<_, anyhow::Error>(())
            },
        )?;
        let now = Instant::now();
        match found {
            Some(Found::Step(request)) => self.answer_step(now, request),
            Some(Found::Control(request)) => self.answer_control(now, request),
            Some(Found::Event) | None => self.check_everything(now)?,
        }
        if now - self.last_tick > BUSY_TICK || deadline.is_some_and(|at| at <= now) {
            self.check_everything(now)?;
        }
        Ok(())
    }

    fn poll(&self, woken: &Cell<bool>) -> Option<Found> {
        if let Some(request) = self.ports.receive_step() {
            return Some(Found::Step(request));
        }
        if let Some(request) = self.ports.receive_control() {
            return Some(Found::Control(request));
        }
        woken.get().then_some(Found::Event)
    }

    /// Sleeps for at most `limit`, until a wake-up, a signal, the end of a process, or a finished reset or file job.
    /// Returns whether any of these events ended the sleep.
    fn sleep(&self, limit: Duration) -> Result<bool> {
        let own = [
            self.ports.descriptor(),
            self.resets.descriptor(),
            self.files.descriptor(),
        ];
        let exit_with = self.exit_with.iter().map(WatchedProcess::descriptor);
        let others = exit_with.chain(self.clients.descriptors());
        let descriptors: Vec<BorrowedFd<'_>> = own.into_iter().chain(others).collect();
        let woken = sleep_until_event(&descriptors, limit).map_err(ipc_error("sleep"))?;
        // Discards pending wake-ups, because they would end the next sleep immediately.
        self.ports.drain()?;
        Ok(woken)
    }

    fn answer_step(&mut self, now: Instant, request: ActiveStep) {
        let client = self.clients.identify(request.header().node_id().value());
        let (header, body) = (request.user_header().0, request.payload());
        match self
            .simulator
            .step(now, client, &header, body, &mut self.payload)
        {
            Stepped::Waits(ticket) => self.waiting_steps.push((ticket, request)),
            Stepped::Reply(reply) => {
                self.send_step(now, &request, reply);
                self.answer_settled(now);
                if header.operation == Operation::Step as u32 && reply.n_robots > 0 {
                    let first = reply.first_robot as usize;
                    let robots = first..first + reply.n_robots as usize;
                    self.publish(self.simulator.worlds_of(&robots));
                    self.save_if_due();
                }
            }
        }
    }

    /// Answers waiting requests that can now be answered: their world has moved, or they are refused because their
    /// lease has lost a robot. Publishes the worlds that moved.
    pub(super) fn answer_settled(&mut self, now: Instant) {
        while let Some((ticket, reply)) = self.simulator.next_answer(&mut self.payload) {
            let mut waiting = self.waiting_steps.iter();
            if let Some(index) = waiting.position(|(own, _)| *own == ticket) {
                let (_, request) = self.waiting_steps.swap_remove(index);
                self.send_step(now, &request, reply);
            }
        }
        let moved = self.simulator.take_moved();
        for &world in &moved {
            self.publish(world..world + 1);
        }
        if !moved.is_empty() {
            self.save_if_due();
        }
    }

    fn send_step(&mut self, now: Instant, request: &ActiveStep, mut reply: StepReply) {
        reply.simulation_nanos = now.elapsed().as_nanos() as u64;
        let header = request.user_header().0;
        let listener = listener_id(header.listener_low, header.listener_high);
        self.ports
            .answers()
            .send(request, reply, &self.payload, listener);
    }

    fn answer_control(&mut self, now: Instant, request: ActiveControl) {
        // First frees the robots of clients that have just died, so that this request can acquire them.
        self.forget_ended_clients(now);
        let client = self.clients.identify(request.header().node_id().value());
        let stats = ServerStats {
            uptime: self.started.elapsed(),
            steps_per_second: self.rate.per_second,
            n_clients: self.ports.n_clients(),
            n_observers: self.ports.observers().0,
        };
        let version = request.user_header().0.version;
        match self
            .simulator
            .control(now, client, version, request.payload(), &stats)
        {
            Outcome::Answer(reply) => self.send_reply(&request, &self.ports.with_memory(reply)),
            Outcome::Pending(jobs, pending) => {
                self.resets.start(jobs);
                self.pending_replies.push((request, pending));
                self.answer_pending(now);
            }
            Outcome::Changed(worlds, reply) => {
                self.send_reply(&request, &reply);
                self.publish(worlds);
            }
            Outcome::File(job, pending) => self.start_file(now, request, job, pending),
            Outcome::Shutdown => {
                self.send_reply(&request, &Reply::Done);
                wait_until_taken(&[request]);
                tracing::info!(client = client.pid, "a client asked to shut down");
                self.is_over = true;
            }
        }
        self.answer_settled(now);
    }

    fn check_everything(&mut self, now: Instant) -> Result<()> {
        self.last_tick = now;
        self.cancel_abandoned(now);
        self.forget_ended_clients(now);
        self.take_resets(now);
        self.take_files(now);
        self.is_over |= self
            .exit_with
            .as_ref()
            .is_some_and(WatchedProcess::has_ended);
        for pid in self.simulator.tick(now) {
            if let Some(n_unsaid) = self.expired_leases.pass(now) {
                tracing::warn!(pid, n_unsaid, "a lease expired");
            }
        }
        self.answer_settled(now);
        self.ports.warn_of_descriptors(now);
        self.publications
            .publish_to_new(&self.ports, &self.simulator);
        self.rate.update(now, self.simulator.n_steps());
        Ok(self.ports.check_entries()?)
    }

    fn forget_ended_clients(&mut self, now: Instant) {
        for pid in self.clients.take_dead(&self.ports.nodes()) {
            let n_leases = self.simulator.end_of_process(now, pid);
            tracing::info!(pid, n_leases, "a client or observer ended");
        }
        let n_leases = self
            .simulator
            .end_of_connections(now, &self.ports.client_nodes());
        if n_leases > 0 {
            tracing::info!(n_leases, "a connection was closed without a release");
        }
        // Each of these answers must show the step for which its request waited, so it is sent before the worlds change
        // again.
        self.answer_settled(now);
    }
}
