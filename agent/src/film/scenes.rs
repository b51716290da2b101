//! Beats in, scenes out: the filter of the known model runs along, also through steps that are not
//! recorded.

use super::FilmError;
use super::story::{Beat, Link, Story};
use crate::belief::Belief;
use crate::config::AgentConfig;
use crate::estimator::BayesFilter;
use protocol::recording::{Record, RecordingError};
use protocol::{Cell, Frame, Grid, Model, Shape};
use std::collections::HashMap;
use std::ops::RangeInclusive;

/// Most steps that are predicted through; behind a longer gap the belief begins anew. The fire of a world
/// forgets itself within about 5,500 steps.
pub const MOST_LOST: u64 = 10_000;

/// Most steps that a first belief is simulated for: more change nothing, as worlds have forgotten their
/// beginning by then.
const MOST_SIMULATED: u64 = 100_000;

/// What is shown of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selection {
    /// Steps k.
    pub steps: RangeInclusive<u64>,
    /// Every so many of them.
    pub every: u64,
}

/// One picture's worth.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// The step k.
    pub step: u64,
    /// Its episode.
    pub episode: u64,
    /// Seed of the world.
    pub seed: u64,
    /// What the step brought; nothing where none was made or it is not recorded.
    pub reward: Option<f64>,
    /// What the robot saw; nothing where it is not recorded.
    pub frame: Option<Frame>,
    /// The robot's cells, the start first; empty where that is not recorded.
    pub path: Vec<Cell>,
    /// The hidden states, if they are recorded.
    pub truth: Option<Grid<u8>>,
    /// The posterior; of a step that is not recorded the predictor.
    pub belief: Belief,
    /// What this scene stands for is not recorded: so many steps, of which it is the last.
    pub n_lost: u64,
    /// What came before.
    pub past: Past,
}

/// What a film has told so far.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Past {
    /// The step at which the belief began.
    pub since: u64,
    /// Steps since then that are not recorded.
    pub n_lost: u64,
    /// Steps since then whose reward is known.
    pub n_rewards: u64,
    /// Sum of those.
    pub reward: f64,
}

impl Past {
    /// Mean of the known rewards.
    pub fn mean(&self) -> f64 {
        self.reward / self.n_rewards.max(1) as f64
    }
}

impl Selection {
    /// Whether a beat is shown.
    pub fn shows(&self, beat: &Beat) -> bool {
        let step = beat.result.step;
        self.steps.contains(&step) && (step - self.steps.start()).is_multiple_of(self.every)
    }

    /// Whether the steps that are not recorded right before a beat are shown, in a scene of their own.
    pub fn shows_gap(&self, beat: &Beat) -> bool {
        let n_lost = n_lost(beat);
        let step = beat.result.step;
        n_lost > 0 && step - n_lost <= *self.steps.end() && step > *self.steps.start()
    }
}

/// Steps right before a beat that are not recorded and are predicted through.
fn n_lost(beat: &Beat) -> u64 {
    match beat.link {
        Link::Follows { n_lost } if n_lost <= MOST_LOST => n_lost,
        _ => 0,
    }
}

/// What follows a story.
pub struct Scenes<'a, R> {
    story: Story<R>,
    selection: &'a Selection,
    filter: BayesFilter,
    priors: Priors<'a>,
    past: Past,
    /// The scene behind that of a gap.
    next: Option<Scene>,
}

/// First beliefs, by the steps that their world has behind it.
struct Priors<'a> {
    model: &'a Model,
    shape: Shape,
    config: &'a AgentConfig,
    burn_in: u64,
    known: HashMap<u64, Belief>,
}

impl Priors<'_> {
    fn at(&mut self, step: u64) -> Result<&Belief, FilmError> {
        let n_steps = self.burn_in.saturating_add(step).min(MOST_SIMULATED);
        if !self.known.contains_key(&n_steps) {
            let prior = self.config.prior(n_steps);
            let belief = prior.belief(self.model, self.shape, self.config.seed)?;
            self.known.insert(n_steps, belief);
        }
        Ok(&self.known[&n_steps])
    }
}

impl<'a, R: Iterator<Item = Result<Record, RecordingError>>> Scenes<'a, R> {
    /// The scenes of a story. `burn_in`: the server's.
    ///
    /// # Errors
    /// [`FilmError`] for a model that no world of this shape has.
    pub fn new(
        story: Story<R>,
        selection: &'a Selection,
        (model, shape, burn_in): (&'a Model, Shape, u64),
        config: &'a AgentConfig,
    ) -> Result<Self, FilmError> {
        Ok(Self {
            story,
            selection,
            filter: BayesFilter::known(model, Belief::uniform(model.n_states(), shape))?,
            priors: Priors {
                model,
                shape,
                config,
                burn_in,
                known: HashMap::new(),
            },
            past: Past::default(),
            next: None,
        })
    }

    fn next_scene(&mut self) -> Result<Option<Scene>, FilmError> {
        if let Some(scene) = self.next.take() {
            return Ok(Some(scene));
        }
        while let Some(beat) = self.story.next() {
            let beat = beat?;
            let shows = self.selection.shows(&beat);
            let gap = self.come_to(&beat)?;
            let scene = self.take_in(beat)?;
            let scene = shows.then_some(scene);
            if gap.is_some() {
                self.next = scene;
                return Ok(gap);
            }
            if scene.is_some() {
                return Ok(scene);
            }
        }
        Ok(None)
    }

    /// Brings the belief to a beat's predictor; gives the scene of what is not recorded before it.
    fn come_to(&mut self, beat: &Beat) -> Result<Option<Scene>, FilmError> {
        let step = beat.result.step;
        let n_lost = match beat.link {
            Link::Follows { n_lost } if n_lost <= MOST_LOST => n_lost,
            _ => {
                self.filter.set_belief(self.priors.at(step)?.clone());
                self.past = Past {
                    since: step,
                    ..Past::default()
                };
                return Ok(None);
            }
        };
        (0..n_lost).for_each(|_| self.filter.predict());
        self.past.n_lost += n_lost;
        let scene = self
            .selection
            .shows_gap(beat)
            .then(|| self.gap(beat, n_lost));
        self.filter.predict();
        Ok(scene)
    }

    fn gap(&self, beat: &Beat, n_lost: u64) -> Scene {
        Scene {
            step: beat.result.step - 1,
            episode: beat.result.episode,
            seed: beat.result.seed,
            reward: None,
            frame: None,
            path: Vec::new(),
            truth: None,
            belief: self.filter.belief().clone(),
            n_lost,
            past: self.past,
        }
    }

    fn take_in(&mut self, beat: Beat) -> Result<Scene, FilmError> {
        let Beat {
            result,
            frame,
            path,
            truth,
            ..
        } = beat;
        let step = result.step;
        let corrected = self.filter.correct(&frame);
        corrected.map_err(|problem| FilmError::Evidence { step, problem })?;
        let reward = (path.len() > 1).then_some(result.reward);
        if let Some(reward) = reward {
            self.past.n_rewards += 1;
            self.past.reward += reward;
        }
        Ok(Scene {
            step,
            episode: result.episode,
            seed: result.seed,
            reward,
            frame: Some(frame),
            path,
            truth,
            belief: self.filter.belief().clone(),
            n_lost: 0,
            past: self.past,
        })
    }
}

impl<R: Iterator<Item = Result<Record, RecordingError>>> Iterator for Scenes<'_, R> {
    type Item = Result<Scene, FilmError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.next_scene().transpose()
    }
}
