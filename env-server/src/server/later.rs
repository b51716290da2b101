//! What is answered or done later: requests that wait for resets and files, and snapshots of its own accord.

use super::{ServeError, Server};
use crate::files::{Done, Job};
use crate::simulator::FileOrder;
use crate::snapshot::folder::FileError;
use protocol::control::Reply;
use protocol::message::Status;
use protocol::responder::ActiveControl;
use std::time::{Duration, Instant};

/// How long a server that ends waits for its files.
const LAST_FILES: Duration = Duration::from_secs(10);

impl Server {
    pub(super) fn answer_awaiting(&mut self, now: Instant) {
        for (request, awaited) in std::mem::take(&mut self.awaiting) {
            match self.simulator.answer_awaited(now, &awaited) {
                Some(reply) => self.send_reply(&request, &reply),
                None => self.awaiting.push((request, awaited)),
            }
        }
    }

    /// Has a file read or written for a request that is answered afterwards.
    pub(super) fn order_file(
        &mut self,
        now: Instant,
        request: ActiveControl,
        job: Job,
        order: FileOrder,
    ) {
        if self.files.has_room() {
            let number = self.files.order(job);
            self.file_orders.insert(number, (request, order));
            return;
        }
        self.simulator.forget_file(now, &order);
        let message = "too many files at a time: try again later".into();
        self.send_reply(&request, &bad_file(message));
    }

    pub(super) fn take_resets(&mut self, now: Instant) {
        let finished = self.resets.finished();
        if finished.is_empty() {
            return;
        }
        for (world, episode) in finished {
            self.simulator.finish_reset(world, episode);
            self.publish(world..world + 1);
        }
        self.answer_awaiting(now);
    }

    pub(super) fn save_if_due(&mut self) {
        let n_steps = self.simulator.n_steps();
        if self
            .autosave
            .as_ref()
            .is_some_and(|autosave| autosave.is_due(n_steps))
        {
            self.save(false);
        }
    }

    fn save(&mut self, is_last: bool) {
        let Some(autosave) = &mut self.autosave else {
            return;
        };
        let n_steps = self.simulator.n_steps();
        match self.simulator.snapshot(self.simulator.worlds()) {
            Ok(bytes) => autosave.order(n_steps, bytes, is_last, &mut self.files),
            Err(error) => {
                autosave.skip(n_steps);
                autosave.warn(&error);
            }
        }
    }

    /// Leaves a last snapshot, and everything in order, before others may take the instance.
    pub(super) fn end(mut self) -> Result<(), ServeError> {
        self.save(true);
        let (finished, is_late) = match self.files.finish(LAST_FILES) {
            Ok(finished) => (finished, false),
            Err(finished) => (finished, true),
        };
        if is_late {
            tracing::warn!("files were not written within {LAST_FILES:?}");
        }
        self.ports.leave();
        let failed = finished
            .into_iter()
            .filter_map(|(_, outcome)| outcome.err());
        match failed.last() {
            Some(error) if self.autosave.is_some() => Err(error.into()),
            _ => Ok(()),
        }
    }

    pub(super) fn take_files(&mut self, now: Instant) {
        for (number, outcome) in self.files.finished() {
            if let Some(autosave) = &mut self.autosave
                && autosave.is_done(number, &outcome)
            {
                self.save_if_due(); // Steps may have gone on meanwhile, and stopped.
                continue;
            }
            let Some((request, order)) = self.file_orders.remove(&number) else {
                continue; // Its client gave up.
            };
            let reply = self.file_reply(now, &order, outcome);
            self.send_reply(&request, &reply);
            if let (FileOrder::Restored { worlds, .. }, Status::Ok) = (order, reply.status()) {
                self.publish(worlds);
            }
        }
    }

    fn file_reply(
        &mut self,
        now: Instant,
        order: &FileOrder,
        outcome: Result<Done, FileError>,
    ) -> Reply {
        match outcome {
            Ok(Done::Loaded(episodes)) => self.simulator.finish_restore(now, order, episodes),
            Ok(Done::Saved { path, n_bytes }) => self.simulator.saved(order, &path, n_bytes),
            Err(error) => {
                self.simulator.forget_file(now, order);
                bad_file(error.to_string())
            }
        }
    }

    /// Lets go of requests whose clients no longer wait: until then, iceoryx2 hands out none of the
    /// same client's next ones.
    pub(super) fn forget_abandoned(&mut self, now: Instant) {
        let simulator = &mut self.simulator;
        self.awaiting.retain(|(request, awaited)| {
            let is_awaited = request.is_connected();
            if !is_awaited {
                simulator.forget_awaited(now, awaited);
            }
            is_awaited
        });
        self.file_orders.retain(|_, (request, order)| {
            let is_awaited = request.is_connected();
            if !is_awaited {
                simulator.forget_file(now, order);
            }
            is_awaited
        });
    }
}

fn bad_file(message: String) -> Reply {
    Reply::Error {
        status: Status::BadFile,
        detail: 0,
        message,
    }
}
