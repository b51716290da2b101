//! Shows beliefs to observers, as often as a screen shows: the agent's side of the channel `agent`.

use super::agent_belief::{BeliefPublisher, Intent};
use super::channels::{AGENT_BUFFER, Instance};
use emberwatch_messages::message::{AgentHeader, WorldResult};
use emberwatch_model::grid::Probabilities;
use std::ops::Range;
use std::time::{Duration, Instant};

/// Time between two beliefs of a world that are shown: no screen is faster, and each costs a copy.
const INTERVAL: Duration = Duration::from_millis(20);

/// How long readers may take to fetch what was shown last, unless they leave before: it goes with the process
/// where a reader has not met it yet.
const FAREWELL: Duration = Duration::from_millis(500);

/// What agents of one process show.
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
    /// The world's number.
    pub world: u32,
    /// Numbers of the robots that are flown on it.
    pub robots: Range<u32>,
    /// The result of the step.
    pub result: &'a WorldResult,
    /// Shape `[S, H, W]`.
    pub belief: &'a Probabilities,
    /// Who believes it, and what the path was for.
    pub intent: Intent,
}

impl Feed {
    /// Opens the channel for beliefs like this one. Without a channel, which is told once, nothing is shown:
    /// acting does not depend on being seen.
    pub fn open(instance: &Instance, belief: &Probabilities) -> Self {
        // The intent is some hundred bytes of text.
        let n_bytes = belief.len() * size_of::<f32>() + 1024;
        let publisher = BeliefPublisher::open(instance, n_bytes)
            .inspect_err(|error| tracing::warn!("beliefs are not shown: {error}"))
            .ok();
        Self {
            publisher,
            turns: Turns::default(),
        }
    }

    /// Whether it is time to show beliefs, and anybody looks.
    pub fn is_due(&self) -> bool {
        !self.due(1).is_empty()
    }

    /// Which of several worlds are to be shown now, if anybody looks.
    pub fn due(&self, n_worlds: usize) -> Vec<usize> {
        let due = self.turns.due(Instant::now(), n_worlds);
        if due.is_empty() || self.is_watched() {
            due
        } else {
            Vec::new()
        }
    }

    /// Whether there are readers.
    pub fn is_watched(&self) -> bool {
        self.publisher
            .as_ref()
            .is_some_and(BeliefPublisher::is_watched)
    }

    /// Ends, when readers have had time to fetch what was shown last.
    pub fn end(self) {
        let began = Instant::now();
        while self.turns.shown.is_some() && self.is_watched() && began.elapsed() < FAREWELL {
            std::thread::sleep(INTERVAL);
        }
    }

    /// Publishes a belief, unless the channel is not open.
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
            tracing::warn!("beliefs are no longer shown: {error}");
            self.publisher = None;
        }
    }
}

impl Turns {
    /// Which of several worlds are due: one after the other, and no more at once than a reader keeps beside one that
    /// is still to be read.
    fn due(&self, now: Instant, n_worlds: usize) -> Vec<usize> {
        let share = |shown: Instant| (now - shown).as_secs_f64() / INTERVAL.as_secs_f64();
        let n_due = self
            .shown
            .map_or(1, |shown| (share(shown) * n_worlds as f64) as usize);
        let turn = (self.n_shown..).take(n_due.min(n_worlds).min(AGENT_BUFFER - 1));
        turn.map(|number| number % n_worlds).collect()
    }

    /// Takes note of a world that is shown.
    fn pass(&mut self, now: Instant) {
        self.shown = Some(now);
        self.n_shown += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn worlds_take_turns_and_each_is_shown_once_in_an_interval() {
        let (mut turns, now) = (Turns::default(), Instant::now());
        assert_eq!(turns.due(now, 5), [0], "the first at once");
        turns.pass(now);
        let nothing: [usize; 0] = [];
        assert_eq!(turns.due(now + INTERVAL / 6, 5), nothing);
        assert_eq!(turns.due(now + INTERVAL / 4, 5), [1]);
        assert_eq!(turns.due(now + INTERVAL / 2, 5), [1, 2]);
        assert_eq!(
            turns.due(now + INTERVAL * 9, 5),
            [1, 2, 3],
            "a reader's buffer"
        );
        (1..5).for_each(|_| turns.pass(now));
        assert_eq!(turns.due(now + INTERVAL / 4, 5), [0], "and from the start");
        let almost = now + INTERVAL - Duration::from_micros(1);
        assert_eq!(turns.due(almost, 1), nothing);
        assert_eq!(turns.due(now + INTERVAL, 1), [0]);
    }
}
