//! Publishes beliefs to observers at the rate of a screen: the agent's side of the channel `agent`.

use super::agent_belief::{BeliefPublisher, Intent};
use super::channels::{AGENT_BUFFER, Instance};
use emberwatch_messages::message::{AgentHeader, WorldResult};
use emberwatch_model::grid::Probabilities;
use std::ops::Range;
use std::time::{Duration, Instant};

/// Time between two published beliefs of a world. Displays need no higher rate, and each published belief costs a copy.
const INTERVAL: Duration = Duration::from_millis(20);

/// Maximum time that [`Feed::end`] waits for readers to receive the last belief. A reader that connects later cannot
/// receive it, because the process has ended.
const FAREWELL: Duration = Duration::from_millis(500);

pub struct Feed {
    publisher: Option<BeliefPublisher>,
    turns: Turns,
}

#[derive(Default)]
struct Turns {
    shown: Option<Instant>,
    n_shown: usize,
}

/// One world's belief, the posterior after the frame of `result`.
pub struct View<'a> {
    pub world: u32,
    pub robots: Range<u32>,
    pub result: &'a WorldResult,
    /// Shape `[S, H, W]`.
    pub belief: &'a Probabilities,
    /// The policy and estimator, and the objective of the path.
    pub intent: Intent,
}

impl Feed {
    /// Opens the channel for beliefs of the same size as `belief`. If the channel cannot be opened, logs one warning
    /// and publishes nothing, because an agent must act even if nobody can watch it.
    pub fn open(instance: &Instance, belief: &Probabilities) -> Self {
        // The intent is a few hundred bytes of text.
        let n_bytes = belief.len() * size_of::<f32>() + 1024;
        let publisher = BeliefPublisher::open(instance, n_bytes)
            .inspect_err(|error| tracing::warn!("beliefs are not published: {error}"))
            .ok();
        Self {
            publisher,
            turns: Turns::default(),
        }
    }

    pub fn closed() -> Self {
        Self {
            publisher: None,
            turns: Turns::default(),
        }
    }

    pub fn is_due(&self) -> bool {
        !self.due(1).is_empty()
    }

    /// Returns the worlds whose beliefs are due, if there are readers.
    pub fn due(&self, n_worlds: usize) -> Vec<usize> {
        let due = self.turns.due(Instant::now(), n_worlds);
        if due.is_empty() || self.is_watched() {
            due
        } else {
            Vec::new()
        }
    }

    pub fn is_watched(&self) -> bool {
        self.publisher
            .as_ref()
            .is_some_and(BeliefPublisher::is_watched)
    }

    pub fn end(self) {
        let began = Instant::now();
        while self.turns.shown.is_some() && self.is_watched() && began.elapsed() < FAREWELL {
            std::thread::sleep(INTERVAL);
        }
    }

    pub fn show(&mut self, view: &View<'_>) {
        let Some(publisher) = &mut self.publisher else {
            return;
        };
        self.turns.pass(Instant::now());
        let about = AgentHeader {
            world: view.world,
            episode: view.result.episode,
            step: view.result.step,
            seed: view.result.seed,
            first_robot: view.robots.start,
            n_robots: view.robots.len() as u32,
            ..AgentHeader::default()
        };
        if let Err(error) = publisher.show(about, view.belief, &view.intent) {
            tracing::warn!("beliefs are no longer published: {error}");
            self.publisher = None;
        }
    }
}

impl Turns {
    /// Returns the worlds whose beliefs are due, in round-robin order. Their number is limited so that their beliefs
    /// and one unread belief fit in a reader's buffer.
    fn due(&self, now: Instant, n_worlds: usize) -> Vec<usize> {
        let share = |shown: Instant| (now - shown).as_secs_f64() / INTERVAL.as_secs_f64();
        let n_due = self
            .shown
            .map_or(1, |shown| (share(shown) * n_worlds as f64) as usize);
        let turn = (self.n_shown..).take(n_due.min(n_worlds).min(AGENT_BUFFER - 1));
        turn.map(|number| number % n_worlds).collect()
    }

    fn pass(&mut self, now: Instant) {
        self.shown = Some(now);
        self.n_shown += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn worlds_take_turns_and_each_is_shown_once_per_interval() {
        let (mut turns, now) = (Turns::default(), Instant::now());
        assert_eq!(turns.due(now, 5), [0], "the first world is due at once");
        turns.pass(now);
        let nothing: [usize; 0] = [];
        assert_eq!(turns.due(now + INTERVAL / 6, 5), nothing);
        assert_eq!(turns.due(now + INTERVAL / 4, 5), [1]);
        assert_eq!(turns.due(now + INTERVAL / 2, 5), [1, 2]);
        assert_eq!(
            turns.due(now + INTERVAL * 9, 5),
            [1, 2, 3],
            "limited by a reader's buffer"
        );
        (1..5).for_each(|_| turns.pass(now));
        assert_eq!(turns.due(now + INTERVAL / 4, 5), [0], "and again from 0");
        let almost = now + INTERVAL - Duration::from_micros(1);
        assert_eq!(turns.due(almost, 1), nothing);
        assert_eq!(turns.due(now + INTERVAL, 1), [0]);
    }
}
