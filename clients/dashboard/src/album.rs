//! The last few thousand steps of each world, joined from what arrives on three channels. Pure.

use crate::entry::{Belief, Entry, Key, States};
use emberwatch_protocol::agent_belief::AgentBelief;
use emberwatch_protocol::message::{AgentHeader, FrameHeader, TruthHeader};
use emberwatch_protocol::observer::Sample;
use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

/// Most steps that are kept of a world.
pub const MAX_ENTRIES: usize = 4096;

/// Most bytes that are kept of all worlds: 4,096 steps of three 64 x 64 worlds with all there is to see, or
/// 800 of a 256 x 256 world.
const MAX_BYTES: usize = 256 << 20;

/// How many of the last steps late hidden states and beliefs are looked for in.
const MAX_DELAY: usize = 512;

/// How long before a step a belief may have come that is shown beside it.
const MAX_BELIEF_AGE: Duration = Duration::from_secs(5);

/// How many hidden states are held for frames that have not come yet: channels are read one after the
/// other, and a recording may have them in either order.
const MAX_EARLY: usize = 64;

/// Most bytes of those.
const MAX_EARLY_BYTES: usize = 32 << 20;

/// What is known of each world.
#[derive(Debug, Default)]
pub struct Album {
    worlds: BTreeMap<u32, Strip>,
    n_bytes: usize,
    early: VecDeque<(u32, Key, Box<[u8]>)>,
}

/// The kept steps of one world; each has a serial number, in the order of arrival.
#[derive(Debug, Default)]
pub struct Strip {
    entries: VecDeque<Entry>,
    first_serial: u64,
    /// First robot of the agent whose beliefs are shown, and the time of the last step with one.
    believer: Option<(u32, Instant)>,
}

impl Album {
    /// A world's steps.
    pub fn strip(&self, world: u32) -> Option<&Strip> {
        self.worlds.get(&world)
    }

    /// Worlds of which something is known.
    pub fn worlds(&self) -> impl Iterator<Item = u32> + '_ {
        self.worlds.keys().copied()
    }

    /// Forgets everything, as at the start of a recording.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Adds a frame; what makes no sense, and what was shown already, is left out.
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

    /// Adds hidden states to the step that they belong to, if that is kept.
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

    /// Adds what an agent believed of a step; `false` if that step is not there, yet or any more. `states` are
    /// the model's.
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
            return true; // It makes no sense, now or later.
        }
        // Of several agents on a world the one with the first robot is shown, while it tells what it believes.
        let is_told = |(first, at): (u32, Instant)| {
            first < first_robot && entry.at.duration_since(at) < MAX_BELIEF_AGE
        };
        if believer.is_some_and(is_told) {
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

    /// Forgets the oldest steps of the worlds that have most, until all fit.
    fn make_room(&mut self) {
        while self.n_bytes > MAX_BYTES {
            let worlds = self.worlds.values_mut();
            let longest = worlds.max_by_key(|strip| strip.entries.len());
            self.n_bytes -= longest.map_or(self.n_bytes, Strip::forget_oldest);
        }
        self.worlds.retain(|_, strip| !strip.entries.is_empty());
    }

    /// Takes the hidden states that came before their frame.
    fn early_truth(&mut self, world: u32, key: Key) -> Option<Box<[u8]>> {
        let mut places = self.early.iter();
        let place = places.position(|(of, at, _)| (*of, *at) == (world, key))?;
        self.early.remove(place).map(|(_, _, truth)| truth)
    }
}

impl Strip {
    /// Serial numbers of the first and the last step kept.
    pub fn kept(&self) -> Option<(u64, u64)> {
        let n = self.entries.len() as u64;
        (n > 0).then(|| (self.first_serial, self.first_serial + n - 1))
    }

    /// The step of a serial number, or the nearest that is kept.
    pub fn nearest(&self, serial: u64) -> Option<(u64, &Entry)> {
        let (first, last) = self.kept()?;
        let serial = serial.clamp(first, last);
        Some((serial, &self.entries[(serial - first) as usize]))
    }

    /// The steps before a serial number and that one, the latest first.
    pub fn back_from(&self, serial: u64) -> impl Iterator<Item = &Entry> {
        let n = (serial + 1).saturating_sub(self.first_serial) as usize;
        self.entries.iter().take(n).rev()
    }

    /// The steps of one run before a serial number and that one, the latest first: what is older may be of another
    /// server, or from before a restore.
    pub fn run_up_to(&self, serial: u64) -> impl Iterator<Item = &Entry> {
        let mut next: Option<&Entry> = None;
        self.back_from(serial)
            .take_while(move |entry| next.replace(entry).is_none_or(|next| entry.precedes(next)))
    }

    /// The latest step with a belief of those, if that came not long before.
    pub fn believed(&self, serial: u64) -> Option<&Entry> {
        let (_, now) = self.nearest(serial)?;
        let is_recent = |entry: &&Entry| now.at.duration_since(entry.at) < MAX_BELIEF_AGE;
        let mut recent = self.run_up_to(serial).take_while(is_recent);
        recent.find(|entry| entry.belief.is_some())
    }

    /// All steps, the oldest first.
    pub fn entries(&self) -> impl ExactSizeIterator<Item = &Entry> {
        self.entries.iter()
    }

    /// One of the latest steps, and whose beliefs are shown.
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
