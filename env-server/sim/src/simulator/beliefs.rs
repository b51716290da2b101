//! Beliefs that agents leave for the next agents: bytes that the server does not interpret.

use crate::world::WorldOutcome;
use emberwatch_messages::control::{BeliefInfo, MAX_BELIEF_PART};
use std::ops::Range;

/// States that a belief may have under any model, as learned ones have their own. It may have as many as the model.
const N_STATES: usize = 18;

/// Most bytes beside 32-bit numbers: one for each state and cell, and one more for each cell.
const MORE_BYTES: u64 = 32 << 10;

/// The beliefs left, one for each robot at most.
#[derive(Debug)]
pub struct Beliefs {
    /// Most bytes of one.
    longest: u64,
    left: Vec<Option<StoredBelief>>,
}

#[derive(Debug)]
struct StoredBelief {
    info: BeliefInfo,
    bytes: Vec<u8>,
}

/// A part of a belief that an agent leaves.
#[derive(Debug)]
pub struct BeliefPart<'a> {
    /// Tells other agents what the bytes are.
    pub kind: &'a str,
    /// Where the part begins.
    pub offset: u64,
    /// Length of the whole.
    pub length: u64,
    pub bytes: &'a [u8],
}

impl Beliefs {
    /// None yet, for robots in worlds of so many cells and states.
    pub fn new(n_robots: usize, n_cells: usize, n_states: usize) -> Self {
        let numbers = n_cells * (n_states.max(N_STATES) + 1);
        Self {
            longest: (numbers * size_of::<f32>()) as u64 + MORE_BYTES,
            left: (0..n_robots).map(|_| None).collect(),
        }
    }

    /// Adds the next part of a belief for who flies a robot, at the step of its world; the first starts a new one.
    pub fn add(
        &mut self,
        robot: usize,
        at: &WorldOutcome,
        part: &BeliefPart<'_>,
    ) -> Result<(), String> {
        check_at_most("length", self.longest, part.length)?;
        check_at_most("data", MAX_BELIEF_PART as u64, part.bytes.len() as u64)?;
        let info = BeliefInfo {
            kind: part.kind.into(),
            seed: at.seed,
            episode: at.episode,
            step: at.step,
            length: part.length,
        };
        let left = &mut self.left[robot];
        let so_far = left
            .as_ref()
            .filter(|left| left.info == info && part.offset > 0);
        let expected = so_far.map_or(0, |left| left.bytes.len() as u64);
        let end = part.offset.saturating_add(part.bytes.len() as u64);
        if part.offset != expected || end > part.length {
            let (offset, length) = (part.offset, part.length);
            return Err(format!(
                "offset: expected the next bytes, from {expected}, within {length}, got {offset} to {end}"
            ));
        }
        if part.offset == 0 {
            let mut bytes = Vec::new();
            let reserved = bytes.try_reserve_exact(part.length as usize);
            reserved.map_err(|_| {
                format!(
                    "length: expected memory for {} bytes, got less",
                    part.length
                )
            })?;
            *left = Some(StoredBelief { info, bytes });
        }
        if let Some(left) = left {
            left.bytes.extend_from_slice(part.bytes);
        }
        Ok(())
    }

    /// The whole belief for a robot at the step of its world.
    pub fn of(&self, robot: usize, at: &WorldOutcome) -> Option<(&BeliefInfo, &[u8])> {
        let StoredBelief { info, bytes } = self.left[robot].as_ref()?;
        let is_there = (info.seed, info.episode, info.step) == (at.seed, at.episode, at.step);
        let is_whole = bytes.len() as u64 == info.length;
        (is_there && is_whole).then_some((info, bytes))
    }

    /// Drops the beliefs for the robots of a world that was replaced.
    pub fn forget(&mut self, robots: Range<usize>) {
        self.left[robots].fill_with(|| None);
    }
}

fn check_at_most(name: &str, most: u64, got: u64) -> Result<(), String> {
    if got > most {
        return Err(format!("{name}: expected at most {most} bytes, got {got}"));
    }
    Ok(())
}
