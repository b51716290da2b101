//! Writes the answers to step requests: results of worlds, then results of robots, then frames.

use super::lease::Refusal;
use super::state::{Simulator, within};
use super::step::numbers;
use crate::results::{robot_result, world_result};
use crate::world::Episode;
use emberwatch_messages::message::{FLAG_TEAM_FRAMES, Status, StepReply, StepRequest, VERSION};
use emberwatch_messages::payload::{ROBOT_BYTES, WORLD_BYTES};
use emberwatch_model::UNOBSERVED;
use std::hint::black_box;
use std::ops::Range;

pub(super) struct Part<'a> {
    robots: Range<usize>,
    world: &'a mut [u8],
    results: &'a mut [u8],
    /// One frame per robot, or one shared frame with the observations of all robots of the world.
    frames: &'a mut [u8],
    is_shared: bool,
}

impl Part<'_> {
    pub(super) fn write(self, episode: &Episode) {
        let world = world_result(episode.outcome());
        self.world.copy_from_slice(bytemuck::bytes_of(&world));
        let robots = &episode.robots()[self.robots];
        for (to, robot) in self.results.chunks_exact_mut(ROBOT_BYTES).zip(robots) {
            let result = robot_result(robot.outcome());
            to.copy_from_slice(bytemuck::bytes_of(&result));
        }
        if !self.is_shared {
            let n_cells = self.frames.len() / robots.len().max(1);
            for (to, robot) in self.frames.chunks_exact_mut(n_cells).zip(robots) {
                to.copy_from_slice(robot.frame().as_bytes());
            }
            return;
        }
        self.frames.fill(UNOBSERVED);
        for robot in episode.robots() {
            let seen = robot.frame().as_bytes();
            // All robots have the same reading of a cell, and unobserved cells have the largest value.
            (self.frames.iter_mut().zip(seen)).for_each(|(to, &value)| *to = value.min(*to));
        }
    }
}

impl Simulator {
    pub(super) fn refuse(&mut self, request: &StepRequest, refusal: Refusal) -> StepReply {
        self.n_refused += 1;
        StepReply {
            status: refusal.status as u32,
            detail: refusal.detail,
            ..self.header(request)
        }
    }

    fn header(&self, request: &StepRequest) -> StepReply {
        StepReply {
            version: VERSION,
            sequence: request.sequence,
            first_robot: request.first_robot,
            flags: request.flags,
            height: self.spec.rules.shape.height() as u32,
            width: self.spec.rules.shape.width() as u32,
            ..StepReply::default()
        }
    }

    pub(super) fn answer(&self, request: &StepRequest) -> (StepReply, Range<usize>) {
        let first = request.first_robot as usize;
        let robots = first..first + request.n_robots as usize;
        let reply = StepReply {
            status: Status::Ok as u32,
            n_robots: request.n_robots,
            n_worlds: self.worlds_of(&robots).len() as u32,
            ..self.header(request)
        };
        (reply, robots)
    }

    fn n_bytes(&self, request: &StepRequest) -> usize {
        let (reply, _) = self.answer(request);
        let (n_worlds, n_robots) = (reply.n_worlds as usize, reply.n_robots as usize);
        let n_frames = match request.flags & FLAG_TEAM_FRAMES {
            0 => n_robots,
            _ => n_worlds,
        };
        let n_cells = self.spec.rules.shape.n_cells();
        n_worlds * WORLD_BYTES + n_robots * ROBOT_BYTES + n_frames * n_cells
    }

    /// Resizes a payload to the length of the answer. This happens before any state changes, so that a request refused
    /// for lack of memory has no effect.
    pub(super) fn reserve(
        &self,
        request: &StepRequest,
        payload: &mut Vec<u8>,
    ) -> Result<(), Refusal> {
        let n_bytes = self.n_bytes(request);
        // Tries the allocation first, because a failed allocation in `fit` would abort the process.
        let mut probe = Vec::<u8>::new();
        let n_more = n_bytes.saturating_sub(payload.capacity());
        let reserved = probe.try_reserve_exact(if n_more == 0 { 0 } else { n_bytes });
        black_box(&probe);
        reserved.map_err(|_| Refusal::new(Status::NoMemory, n_bytes as u64))?;
        drop(probe);
        self.fit(request, payload);
        Ok(())
    }

    /// Resizes a payload to the length of the answer, with arbitrary content.
    pub(super) fn fit(&self, request: &StepRequest, payload: &mut Vec<u8>) {
        let n_bytes = self.n_bytes(request);
        if payload.capacity() < n_bytes {
            // Allocates zeroed memory instead of resizing, so that no page is touched before the threads write their
            // parts.
            *payload = vec![0; n_bytes];
        } else {
            payload.resize(n_bytes, 0);
        }
    }

    /// Splits a payload of the length set by [`Self::fit`] into one part for each world of the request.
    pub(super) fn parts<'a>(&self, request: &StepRequest, payload: &'a mut [u8]) -> Vec<Part<'a>> {
        let (reply, robots) = self.answer(request);
        let n_cells = self.spec.rules.shape.n_cells();
        let is_shared = request.flags & FLAG_TEAM_FRAMES != 0;
        let (mut worlds, rest) = payload.split_at_mut(reply.n_worlds as usize * WORLD_BYTES);
        let (mut results, mut frames) = rest.split_at_mut(robots.len() * ROBOT_BYTES);
        let part = |world| {
            let own = within(&robots, self.robots_of(world));
            let n_frames = if is_shared { 1 } else { own.len() };
            Part {
                world: take(&mut worlds, WORLD_BYTES),
                results: take(&mut results, own.len() * ROBOT_BYTES),
                frames: take(&mut frames, n_frames * n_cells),
                robots: own,
                is_shared,
            }
        };
        self.worlds_of(&robots).map(part).collect()
    }

    pub(super) fn write_present(&self, request: &StepRequest, payload: &mut [u8]) -> StepReply {
        let (reply, robots) = self.answer(request);
        let parts = self.parts(request, payload);
        for (world, part) in self.worlds_of(&robots).zip(parts) {
            if let Some(episode) = self.episode(world) {
                part.write(episode);
            }
        }
        reply
    }

    /// Writes the results and frames of the requested robots at past steps, and returns the header. `steps` contains
    /// one step number per world, and the world's history contains that step.
    pub(super) fn write_past(
        &self,
        request: &StepRequest,
        steps: &[u8],
        payload: &mut Vec<u8>,
    ) -> StepReply {
        payload.clear();
        let (reply, robots) = self.answer(request);
        let worlds = self.worlds_of(&robots).zip(numbers(steps));
        let past = worlds.filter_map(|(world, step)| {
            let past = self.episode(world)?.recall(step).ok()?;
            Some((past, within(&robots, self.robots_of(world))))
        });
        let past: Vec<_> = past.collect();
        for (past, _) in &past {
            payload.extend_from_slice(bytemuck::bytes_of(&world_result(&past.outcome)));
        }
        for robot in past
            .iter()
            .flat_map(|(past, own)| &past.robots[own.clone()])
        {
            payload.extend_from_slice(bytemuck::bytes_of(&robot_result(&robot.outcome)));
        }
        let n_cells = self.spec.rules.shape.n_cells();
        for (past, own) in &past {
            if request.flags & FLAG_TEAM_FRAMES == 0 {
                for robot in &past.robots[own.clone()] {
                    robot.write_over(blank(payload, n_cells));
                }
            } else {
                let frame = blank(payload, n_cells);
                past.robots.iter().for_each(|robot| robot.write_over(frame));
            }
        }
        reply
    }
}

fn take<'a>(bytes: &mut &'a mut [u8], n: usize) -> &'a mut [u8] {
    let (first, rest) = std::mem::take(bytes).split_at_mut(n);
    *bytes = rest;
    first
}

fn blank(payload: &mut Vec<u8>, n_cells: usize) -> &mut [u8] {
    let start = payload.len();
    payload.resize(start + n_cells, UNOBSERVED);
    &mut payload[start..]
}
