//! The last few thousand steps of each world, joined from the samples of three channels. Does no I/O.

use crate::entry::{Belief, Entry, Key, States};
use emberwatch_protocol::agent_belief::AgentBelief;
use emberwatch_protocol::message::{AgentHeader, FrameHeader, TruthHeader};
use emberwatch_protocol::observer::Sample;
use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

/// Maximum number of kept steps per world.
pub const MAX_ENTRIES: usize = 4096;

/// Maximum size of all kept steps, in bytes: enough for 4,096 steps of three 64 x 64 worlds with hidden states and
/// beliefs, or 800 steps of a 256 x 256 world.
const MAX_BYTES: usize = 256 << 20;

/// Number of latest steps that can still receive hidden states and beliefs.
const MAX_DELAY: usize = 512;

/// Maximum age at which a belief is still shown with a later step.
const MAX_BELIEF_AGE: Duration = Duration::from_secs(5);

/// Maximum number of hidden states held for frames that have not arrived. Channels are read one after the other, and a
/// recording may store a frame and its hidden states in either order.
const MAX_EARLY: usize = 64;

const MAX_EARLY_BYTES: usize = 32 << 20;

#[derive(Debug, Default)]
pub struct Album {
    worlds: BTreeMap<u32, Strip>,
    n_bytes: usize,
    early: VecDeque<(u32, Key, Box<[u8]>)>,
}

/// The kept steps of one world. Their serial numbers follow the order of arrival.
#[derive(Debug, Default)]
pub struct Strip {
    entries: VecDeque<Entry>,
    first_serial: u64,
    /// First robot of the agent whose beliefs are shown, and the arrival time of the last step with its belief.
    believer: Option<(u32, Instant)>,
}

impl Album {
    pub fn strip(&self, world: u32) -> Option<&Strip> {
        self.worlds.get(&world)
    }

    pub fn worlds(&self) -> impl Iterator<Item = u32> + '_ {
        self.worlds.keys().copied()
    }

    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Adds a frame. Ignores an invalid frame, and a repetition of the last one.
    pub fn add_frame(&mut self, sample: &Sample<FrameHeader>, at: Instant) {
        let Some(mut entry) = Entry::from_sample(sample, at) else {
            return;
        };
        let world = sample.header.world;
        let early = self.early_truth(world, entry.key());
        entry.truth = early.filter(|truth| truth.len() == entry.shape.n_cells());
        let strip = self.worlds.entry(world).or_default();
        if strip
            .entries
            .back()
            .is_some_and(|last| last.repeats(&entry))
        {
            return;
        }
        self.n_bytes += entry.n_bytes();
        strip.entries.push_back(entry);
        if strip.entries.len() > MAX_ENTRIES {
            self.n_bytes -= strip.forget_oldest();
        }
        self.make_room();
    }

    /// Adds hidden states to their step, or holds them until its frame arrives.
    pub fn add_truth(&mut self, sample: &Sample<TruthHeader>) {
        let header = &sample.header;
        let key = Key {
            seed: header.seed,
            episode: header.episode,
            step: header.step,
        };
        let strip = self.worlds.get_mut(&header.world);
        let Some((entry, _)) = strip.and_then(|strip| strip.entry(key)) else {
            let early = (header.world, key, sample.payload.clone().into());
            self.early.truncate(MAX_EARLY - 1);
            self.early.push_front(early);
            let held = |early: &VecDeque<(u32, Key, Box<[u8]>)>| -> usize {
                early.iter().map(|(_, _, truth)| truth.len()).sum()
            };
            while held(&self.early) > MAX_EARLY_BYTES {
                self.early.pop_back();
            }
            return;
        };
        if entry.truth.is_none() && sample.payload.len() == entry.shape.n_cells() {
            entry.truth = Some(sample.payload.clone().into());
            self.n_bytes += sample.payload.len();
            self.make_room();
        }
    }

    /// Adds an agent's belief to the step that it is about. Returns `false` if that step has not arrived, or is no
    /// longer kept. `states` are the model's states.
    pub fn add_belief(&mut self, published: &AgentBelief, states: Option<&States>) -> bool {
        let AgentHeader {
            seed,
            episode,
            step,
            world,
            first_robot,
            ..
        } = published.header;
        let key = Key {
            seed,
            episode,
            step,
        };
        let strip = self.worlds.get_mut(&world);
        let Some((entry, believer)) = strip.and_then(|strip| strip.entry(key)) else {
            return false;
        };
        let (_, height, width) = published.belief.dim();
        if (height, width) != entry.shape.dim() {
            return true; // The belief is on another grid, so it can never be shown.
        }
        // Of several agents on a world, the page shows the one with the lowest robot, as long as it publishes beliefs.
        let has_priority = |(first, at): (u32, Instant)| {
            first < first_robot && entry.at.duration_since(at) < MAX_BELIEF_AGE
        };
        if believer.is_some_and(has_priority) {
            return true;
        }
        *believer = Some((first_robot, entry.at));
        let belief = Belief::of(published, entry.truth.as_deref(), states);
        let n_bytes = belief.n_bytes();
        let replaced = entry.belief.replace(belief);
        self.n_bytes = self.n_bytes + n_bytes - replaced.map_or(0, |old| old.n_bytes());
        self.make_room();
        true
    }

    fn make_room(&mut self) {
        while self.n_bytes > MAX_BYTES {
            let worlds = self.worlds.values_mut();
            let longest = worlds.max_by_key(|strip| strip.entries.len());
            self.n_bytes -= longest.map_or(self.n_bytes, Strip::forget_oldest);
        }
        self.worlds.retain(|_, strip| !strip.entries.is_empty());
    }

    fn early_truth(&mut self, world: u32, key: Key) -> Option<Box<[u8]>> {
        let mut places = self.early.iter();
        let place = places.position(|(of, at, _)| (*of, *at) == (world, key))?;
        self.early.remove(place).map(|(_, _, truth)| truth)
    }
}

impl Strip {
    pub fn kept(&self) -> Option<(u64, u64)> {
        let n = self.entries.len() as u64;
        (n > 0).then(|| (self.first_serial, self.first_serial + n - 1))
    }

    /// Returns the step with a serial number, or the nearest kept step.
    pub fn nearest(&self, serial: u64) -> Option<(u64, &Entry)> {
        let (first, last) = self.kept()?;
        let serial = serial.clamp(first, last);
        Some((serial, &self.entries[(serial - first) as usize]))
    }

    pub fn back_from(&self, serial: u64) -> impl Iterator<Item = &Entry> {
        let n = (serial + 1).saturating_sub(self.first_serial) as usize;
        self.entries.iter().take(n).rev()
    }

    /// Returns the steps of the last run up to a serial number, latest first. A new episode, a new server or a restore
    /// starts a new run.
    pub fn run_up_to(&self, serial: u64) -> impl Iterator<Item = &Entry> {
        let mut next: Option<&Entry> = None;
        self.back_from(serial)
            .take_while(move |entry| next.replace(entry).is_none_or(|next| entry.precedes(next)))
    }

    /// Returns the latest step with a belief in the run up to a serial number, unless the belief is too old.
    pub fn believed(&self, serial: u64) -> Option<&Entry> {
        let (_, now) = self.nearest(serial)?;
        let is_recent = |entry: &&Entry| now.at.duration_since(entry.at) < MAX_BELIEF_AGE;
        let mut recent = self.run_up_to(serial).take_while(is_recent);
        recent.find(|entry| entry.belief.is_some())
    }

    pub fn entries(&self) -> impl ExactSizeIterator<Item = &Entry> {
        self.entries.iter()
    }

    fn entry(&mut self, key: Key) -> Option<(&mut Entry, &mut Option<(u32, Instant)>)> {
        let mut latest = self.entries.iter_mut().rev().take(MAX_DELAY);
        let entry = latest.find(|entry| entry.key() == key)?;
        Some((entry, &mut self.believer))
    }

    fn forget_oldest(&mut self) -> usize {
        self.first_serial += 1;
        self.entries.pop_front().map_or(0, |entry| entry.n_bytes())
    }
}
