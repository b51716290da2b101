//! Shows beliefs to whoever looks on, at the pace of eyes: the agent's side of the channel `agent`.

use crate::belief::Belief;
use protocol::channels::{AGENT_BUFFER, Instance};
use protocol::message::{AgentHeader, StepResult};
use protocol::outlook::{Intent, Showcase};
use std::time::{Duration, Instant};

/// Time between two beliefs of a world that are shown: no screen is faster, and each costs a copy.
const INTERVAL: Duration = Duration::from_millis(20);

/// How long readers may take to fetch what was shown last, unless they leave before: it goes with the process
/// where a reader has not met it yet.
const FAREWELL: Duration = Duration::from_millis(500);

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
        !self.turn(1).is_empty()
    }

    /// Which of several worlds are to be shown now: one after the other, and no more at once than a reader keeps
    /// beside one that is still to be read.
    pub fn turn(&self, n_worlds: usize) -> Vec<usize> {
        let share = |shown: Instant| shown.elapsed().as_secs_f64() / INTERVAL.as_secs_f64();
        let n_due = self
            .shown
            .map_or(1, |shown| (share(shown) * n_worlds as f64) as usize);
        if n_due == 0 || !self.is_watched() {
            return Vec::new();
        }
        let turn = (self.n_shown..).take(n_due.min(n_worlds).min(AGENT_BUFFER - 1));
        turn.map(|number| number % n_worlds).collect()
    }

    /// Whether anybody looks.
    pub fn is_watched(&self) -> bool {
        self.showcase.as_ref().is_some_and(Showcase::is_watched)
    }

    /// Ends, when readers have had time to fetch what was shown last.
    pub fn end(self) {
        let began = Instant::now();
        while self.shown.is_some() && self.is_watched() && began.elapsed() < FAREWELL {
            std::thread::sleep(INTERVAL);
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
