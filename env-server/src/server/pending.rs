//! Requests that must wait for resets or files before they are answered.

use super::state::Server;
use emberwatch_protocol::control::Reply;
use emberwatch_protocol::message::Status;
use emberwatch_protocol::responder::ActiveControl;
use emberwatch_sim::simulator::PendingFile;
use emberwatch_sim::snapshot::Job;
use emberwatch_sim::world::Episode;
use std::time::Instant;

impl Server {
    pub(super) fn answer_pending(&mut self, now: Instant) {
        for (request, pending) in std::mem::take(&mut self.pending_replies) {
            match self.simulator.pending_reply(now, &pending) {
                Some(reply) => self.send_reply(&request, &reply),
                None => self.pending_replies.push((request, pending)),
            }
        }
    }

    pub(super) fn start_file(
        &mut self,
        now: Instant,
        request: ActiveControl,
        job: Job,
        pending: PendingFile,
    ) {
        if self.files.has_capacity() {
            let number = self.files.add(job);
            self.pending_files.insert(number, (request, pending));
            return;
        }
        self.simulator.cancel_file(now, &pending);
        let message = "too many file jobs at a time: try again later".into();
        self.send_reply(&request, &Reply::error(Status::BadFile, 0, message));
    }

    pub(super) fn take_resets(&mut self, now: Instant) {
        let finished = self.resets.finished();
        if finished.is_empty() {
            return;
        }
        for (world, episode) in finished {
            self.warn_of_barren(world, &episode);
            self.simulator.put(world, episode);
            self.publish(world..world + 1);
        }
        self.answer_pending(now);
    }

    fn warn_of_barren(&mut self, world: usize, episode: &Episode) {
        let is_recorded = self.simulator.is_recorded();
        if self.has_warned_of_barren || is_recorded || episode.outcome().n_target_cells > 0 {
            return;
        }
        self.has_warned_of_barren = true;
        tracing::warn!(
            world,
            seed = episode.outcome().seed,
            "no cell is in the state with the highest reward: raise --burn-in, enlarge the grid, or use a model for \
             small grids, such as --model wildfire-small"
        );
    }

    pub(super) fn take_files(&mut self, now: Instant) {
        for (number, outcome) in self.files.finished() {
            if let Some(autosave) = &mut self.autosave
                && autosave.finish(number, &outcome)
            {
                self.save_if_due(); // The next snapshot may have become due meanwhile.
                continue;
            }
            let Some((request, pending)) = self.pending_files.remove(&number) else {
                continue; // The client has stopped waiting.
            };
            let reply = self.simulator.file_reply(now, &pending, outcome);
            self.send_reply(&request, &reply);
            if let (PendingFile::Restored { worlds, .. }, Status::Ok) = (pending, reply.status()) {
                self.publish(worlds);
            }
        }
    }

    /// Drops requests whose clients have stopped waiting. This must be done, because iceoryx2 delivers no new requests
    /// from such a client before.
    pub(super) fn cancel_abandoned(&mut self, now: Instant) {
        let simulator = &mut self.simulator;
        self.waiting_steps.retain(|(ticket, request)| {
            let is_awaited = request.is_connected();
            if !is_awaited {
                simulator.cancel_step(now, *ticket);
            }
            is_awaited
        });
        self.pending_replies.retain(|(request, pending)| {
            let is_awaited = request.is_connected();
            if !is_awaited {
                simulator.cancel_reply(now, pending);
            }
            is_awaited
        });
        self.pending_files.retain(|_, (request, pending)| {
            let is_awaited = request.is_connected();
            if !is_awaited {
                simulator.cancel_file(now, pending);
            }
            is_awaited
        });
    }
}
