//! Shows beliefs to whoever looks on, at the pace of eyes: the agent's side of the channel `agent`.

use crate::belief::Belief;
use protocol::channels::Instance;
use protocol::message::{AgentHeader, StepResult};
use protocol::outlook::{Intent, Showcase};
use std::time::{Duration, Instant};

/// Time between two beliefs of a world that are shown: no screen is faster, and each costs a copy.
const INTERVAL: Duration = Duration::from_millis(20);

/// How long readers may take to fetch what was shown last: it goes with the process.
const FAREWELL: Duration = Duration::from_millis(100);

/// What agents of one process show.
pub struct Feed {
    showcase: Option<Showcase>,
    shown: Option<Instant>,
    /// Worlds that were shown.
    n_shown: usize,
}

/// One world's belief, the posterior after the frame of `result`.
pub struct View<'a> {
    /// The world.
    pub world: u32,
    /// Where it stands.
    pub result: &'a StepResult,
    /// What is believed of it.
    pub belief: &'a Belief,
    /// Who believes it, and what the path was for.
    pub intent: Intent,
}

impl Feed {
    /// Opens the channel for beliefs like this one. Without a channel, which is told once, nothing is shown:
    /// acting does not depend on being seen.
    pub fn open(instance: &Instance, belief: &Belief) -> Self {
        // The intent is some hundred bytes of text.
        let n_bytes = belief.probabilities().len() * size_of::<f32>() + 1024;
        let showcase = Showcase::open(instance, n_bytes)
            .inspect_err(|error| tracing::warn!("beliefs are not shown: {error}"))
            .ok();
        Self {
            showcase,
            shown: None,
            n_shown: 0,
        }
    }

    /// Whether it is time to show beliefs, and anybody looks.
    pub fn is_due(&self) -> bool {
        self.turn(1).is_some()
    }

    /// Which of several worlds is to be shown now, if any: one after the other, as a reader keeps few beliefs.
    pub fn turn(&self, n_worlds: usize) -> Option<usize> {
        let interval = INTERVAL / n_worlds.max(1) as u32;
        let is_due = self.shown.is_none_or(|shown| shown.elapsed() >= interval);
        (is_due && n_worlds > 0 && self.is_watched()).then(|| self.n_shown % n_worlds)
    }

    /// Whether anybody looks.
    pub fn is_watched(&self) -> bool {
        self.showcase.as_ref().is_some_and(Showcase::is_watched)
    }

    /// Ends, when readers have had time to fetch what was shown last.
    pub fn end(self) {
        if self.shown.is_some() && self.is_watched() {
            std::thread::sleep(FAREWELL);
        }
    }

    /// Shows a world's belief.
    pub fn show(&mut self, view: &View<'_>) {
        let Some(showcase) = &mut self.showcase else {
            return;
        };
        self.shown = Some(Instant::now());
        self.n_shown += 1;
        let about = AgentHeader {
            world: view.world,
            episode: view.result.episode,
            step: view.result.step,
            seed: view.result.seed,
            ..AgentHeader::default()
        };
        if let Err(error) = showcase.show(about, view.belief.probabilities(), &view.intent) {
            tracing::warn!("beliefs are no longer shown: {error}");
            self.showcase = None;
        }
    }
}
