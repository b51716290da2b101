//! Beliefs that an agent stores for the agent that takes over its robot. The server does not interpret the bytes.

use crate::world::WorldOutcome;
use emberwatch_messages::control::{BeliefInfo, MAX_BELIEF_PART};
use std::ops::Range;

/// Minimum number of states for which there is space in a belief, because a learned model can have more states than the
/// true model.
const N_STATES: usize = 18;

/// Maximum size in bytes of the data in a belief besides its `f32` grids.
const MORE_BYTES: u64 = 32 << 10;

#[derive(Debug)]
pub struct Beliefs {
    /// Maximum length of a belief in bytes: one `f32` per state and cell, one more `f32` per cell, and [`MORE_BYTES`].
    longest: u64,
    left: Vec<Option<StoredBelief>>,
}

#[derive(Debug)]
struct StoredBelief {
    info: BeliefInfo,
    bytes: Vec<u8>,
}

#[derive(Debug)]
pub struct BeliefPart<'a> {
    /// The format of the bytes, for other agents.
    pub kind: &'a str,
    pub offset: u64,
    pub length: u64,
    pub bytes: &'a [u8],
}

impl Beliefs {
    pub fn new(n_robots: usize, n_cells: usize, n_states: usize) -> Self {
        let numbers = n_cells * (n_states.max(N_STATES) + 1);
        Self {
            longest: (numbers * size_of::<f32>()) as u64 + MORE_BYTES,
            left: (0..n_robots).map(|_| None).collect(),
        }
    }

    /// Appends a part to the belief about a robot's world at its current step. A part at offset 0 starts a new belief.
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
                "offset: expected bytes from {expected} to at most {length}, got {offset} to {end}"
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

    pub fn of(&self, robot: usize, at: &WorldOutcome) -> Option<(&BeliefInfo, &[u8])> {
        let StoredBelief { info, bytes } = self.left[robot].as_ref()?;
        let is_there = (info.seed, info.episode, info.step) == (at.seed, at.episode, at.step);
        let is_whole = bytes.len() as u64 == info.length;
        (is_there && is_whole).then_some((info, bytes))
    }

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
