//! What there is to show of a recording, before any of it is drawn.

use super::story::{Beat, End, Link, Story, StoryError};
use super::{FilmError, Order, Product, open};
use protocol::control::ServerInfo;
use protocol::recording::Event;
use std::collections::BTreeSet;
use std::ops::RangeInclusive;

/// Most runs of steps that an error names.
const MOST_NAMED: usize = 6;

/// What one look through the whole file tells.
pub struct Survey {
    /// The first server.
    pub server: ServerInfo,
    /// Whether any hidden states of what is shown are recorded.
    pub has_truth: bool,
    /// Pictures to come.
    pub n_pictures: u32,
    /// Steps between those of the recording that are not recorded.
    pub n_lost: u64,
    /// Episodes that have steps which are shown.
    n_episodes: usize,
    end: Option<End>,
}

impl Survey {
    /// Looks through an order's recording.
    ///
    /// # Errors
    /// [`FilmError`], also where nothing of what is asked for is there.
    pub fn of(order: &Order) -> Result<Self, FilmError> {
        let mut known = BTreeSet::new();
        let records = open(&order.recording)?.inspect(|record| {
            if let Ok(Event::Frame(sample)) = record.as_ref().map(|record| &record.event) {
                known.insert(sample.header.world);
            }
        });
        let mut story = Story::new(records, order.world);
        let mut tally = Tally::new(order);
        for beat in story.by_ref() {
            tally.add(&beat.map_err(|problem| problem.of(&order.recording))?);
        }
        let server = story.server().cloned();
        let end = story.into_end();
        let Some(server) = server.filter(|_| !tally.runs.is_empty()) else {
            let got = order.world;
            return Err(match end {
                Some(End::Early(problem)) => StoryError::from(problem).of(&order.recording),
                _ => FilmError::World { known, got },
            });
        };
        if tally.n_beats == 0 {
            return Err(tally.nothing(&order.product));
        }
        let is_film = matches!(order.product, Product::Film { .. });
        Ok(Self {
            server,
            has_truth: tally.has_truth,
            n_pictures: if is_film { tally.n_pictures() } else { 1 },
            n_lost: tally.n_lost,
            n_episodes: tally.episodes.len(),
            end,
        })
    }

    /// Says what the pictures cannot.
    pub fn warn(&self, order: &Order) {
        match &self.end {
            Some(End::Early(problem)) => tracing::warn!("{problem}; showing these"),
            Some(End::OtherWorlds) => tracing::warn!(
                "the recording goes on with another server's worlds, of another kind; showing the first's"
            ),
            None => {}
        }
        if self.n_lost > 0 {
            let steps = self.n_lost;
            tracing::warn!(steps, "not recorded; the belief is predicted through them");
        }
        if let Product::Still { step } = order.product
            && self.n_episodes > 1
        {
            let episodes = self.n_episodes;
            tracing::warn!(step, episodes, "recorded more than once; showing the first");
        }
    }
}

/// Counts over a story.
struct Tally {
    selection: super::Selection,
    /// Steps without a gap.
    runs: Vec<RangeInclusive<u64>>,
    episodes: BTreeSet<u64>,
    has_truth: bool,
    n_beats: u32,
    n_gaps: u32,
    n_lost: u64,
}

impl Tally {
    fn new(order: &Order) -> Self {
        Self {
            selection: order.product.selection(),
            runs: Vec::new(),
            episodes: BTreeSet::new(),
            has_truth: false,
            n_beats: 0,
            n_gaps: 0,
            n_lost: 0,
        }
    }

    fn add(&mut self, beat: &Beat) {
        let step = beat.result.step;
        match (self.runs.last_mut(), beat.link) {
            (Some(run), Link::Follows { n_lost: 0 }) => *run = *run.start()..=step,
            _ => self.runs.push(step..=step),
        }
        if let Link::Follows { n_lost } = beat.link {
            self.n_lost += n_lost;
        }
        self.n_gaps += u32::from(self.selection.shows_gap(beat));
        if self.selection.shows(beat) {
            self.n_beats += 1;
            self.has_truth |= beat.truth.is_some();
            self.episodes.insert(beat.result.episode);
        }
    }

    fn n_pictures(&self) -> u32 {
        self.n_beats + self.n_gaps
    }

    fn nothing(&self, product: &Product) -> FilmError {
        let named = self.runs.iter().take(MOST_NAMED).map(range);
        let mut known = named.collect::<Vec<_>>().join(", ");
        if self.runs.len() > MOST_NAMED {
            known += ", ...";
        }
        let (flag, got) = match product {
            Product::Still { step } => ("--step", step.to_string()),
            Product::Film { selection, .. } => ("--from, --to", range(&selection.steps)),
        };
        FilmError::Steps { flag, known, got }
    }
}

fn range(steps: &RangeInclusive<u64>) -> String {
    match (*steps.start(), *steps.end()) {
        (first, last) if first == last => first.to_string(),
        (first, u64::MAX) => format!("{first} and later"),
        (first, last) => format!("{first} to {last}"),
    }
}
