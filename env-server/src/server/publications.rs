//! Publishes a world after each of its steps, and all worlds when an observer connects.

use super::ports::Ports;
use emberwatch_protocol::channels::FRAME_BUFFER;
use emberwatch_protocol::message::{FrameHeader, TruthHeader, VERSION};
use emberwatch_sim::results::{robot_result, world_result};
use emberwatch_sim::simulator::Simulator;
use emberwatch_sim::world::Episode;
use std::ops::Range;

#[derive(Default)]
pub struct Publications {
    observers: Vec<u128>,
    for_new: Range<usize>,
    n_frames: u64,
    n_truths: u64,
    payload: Vec<u8>,
}

impl Publications {
    pub fn has_new_observers(&self) -> bool {
        !self.for_new.is_empty()
    }

    pub fn publish_to_new(&mut self, ports: &Ports, simulator: &Simulator) {
        let observers = ports.observer_ids();
        let has_new = observers.iter().any(|id| !self.observers.contains(id));
        if observers != self.observers {
            // This also disconnects observers that have left.
            ports.connect_observers();
        }
        self.observers = observers;
        if has_new {
            self.for_new = simulator.worlds();
        }
        // Publishes in batches, because more samples at once would overflow the buffers of new observers.
        let part = self.for_new.start..self.for_new.end.min(self.for_new.start + FRAME_BUFFER);
        self.for_new.start = part.end;
        self.publish(ports, simulator, part);
    }

    /// Publishes the current step of worlds. This costs almost nothing without observers.
    pub fn publish(&mut self, ports: &Ports, simulator: &Simulator, worlds: Range<usize>) {
        let (n_observers, n_readers) = ports.observers();
        if n_observers == 0 && n_readers == 0 {
            return;
        }
        for world in worlds {
            let Some(episode) = simulator.episode(world) else {
                continue;
            };
            if n_readers > 0 {
                self.publish_truth(ports, world, episode);
            }
            if n_observers > 0 {
                self.publish_frame(ports, world, episode);
            }
        }
    }

    fn publish_frame(&mut self, ports: &Ports, world: usize, episode: &Episode) {
        let (height, width) = episode.states().dim();
        let robots = episode.robots();
        let header = FrameHeader {
            version: VERSION,
            world: world as u32,
            sequence: self.n_frames,
            first_robot: (world * robots.len()) as u32,
            n_robots: robots.len() as u32,
            height: height as u32,
            width: width as u32,
            result: world_result(episode.outcome()),
        };
        self.payload.clear();
        for robot in robots {
            self.payload
                .extend_from_slice(bytemuck::bytes_of(&robot_result(robot.outcome())));
        }
        for robot in robots {
            self.payload.extend_from_slice(robot.frame().as_bytes());
        }
        for robot in robots {
            self.payload.extend(robot.path().iter().map(|&m| m as u8));
        }
        ports.publish_frame(header, &self.payload);
        self.n_frames += 1;
    }

    fn publish_truth(&mut self, ports: &Ports, world: usize, episode: &Episode) {
        let (states, outcome) = (episode.states(), episode.outcome());
        let (height, width) = states.dim();
        let header = TruthHeader {
            version: VERSION,
            world: world as u32,
            sequence: self.n_truths,
            episode: outcome.episode,
            step: outcome.step,
            seed: outcome.seed,
            height: height as u32,
            width: width as u32,
        };
        ports.publish_truth(
            header,
            states.as_slice().expect("invariant: states are row-major"),
        );
        self.n_truths += 1;
    }
}
