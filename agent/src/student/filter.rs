//! Learns the filter's parameters on several worlds at once: robots walk at random first, then plan on
//! the belief of the filter as it is.

use super::{Impression, Lesson, NotFinite, Site, Student, StudentError};
use crate::agent::{RANDOM_MOVES, numbered_states};
use crate::belief::Belief;
use crate::checkpoint::{Contents, Problem};
use crate::client::Observation;
use crate::config::AgentConfig;
use crate::estimator::learned_filter::Dimensions;
use crate::learner::{KIND, LearnedModel, Learner, Progress};
use crate::metrics::Tick;
use crate::pilot::{Pilot, Stand};
use crate::planner::Target;
use crate::policy::{EstimatorKind, PlannerKind};
use protocol::Move;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// A filter that is learned.
pub struct FilterStudent {
    site: Site,
    config: AgentConfig,
    learner: Learner,
    learned: LearnedModel,
    pilots: Vec<Pilot>,
    /// Where a checkpoint left the worlds.
    stands: BTreeMap<u32, Stand>,
    is_frozen: bool,
    planning: Duration,
    learning: Duration,
}

impl FilterStudent {
    /// A student before its first frame.
    pub fn new(dimensions: Dimensions, site: Site, config: &AgentConfig) -> Self {
        let progress = Progress::first(dimensions, config.seed);
        let learner = Learner::new(progress, site.shape, config);
        Self::of(learner, BTreeMap::new(), site, config)
    }

    /// Goes on from a checkpoint.
    ///
    /// # Errors
    /// [`Problem`] names what is missing or of another shape.
    pub fn resume(
        contents: &Contents,
        dimensions: Dimensions,
        site: Site,
        config: &AgentConfig,
    ) -> Result<Self, Problem> {
        let learner = Learner::from_contents(contents, dimensions, site.shape, config)?;
        let stands = Stand::restored(dimensions.n_states, site.shape, contents)?;
        Ok(Self::of(learner, stands, site, config))
    }

    fn of(
        learner: Learner,
        stands: BTreeMap<u32, Stand>,
        site: Site,
        config: &AgentConfig,
    ) -> Self {
        Self {
            learned: learner.learned(),
            learner,
            stands,
            site,
            config: config.clone(),
            pilots: Vec::new(),
            is_frozen: false,
            planning: Duration::ZERO,
            learning: Duration::ZERO,
        }
    }

    /// Worlds whose robots walk at random: all at first, some for good; none of a frozen student.
    fn n_walking(&self) -> usize {
        if self.is_frozen {
            return 0;
        }
        let learning = &self.config.learning;
        if self.learner.world_steps() < learning.explore_steps {
            return self.pilots.len();
        }
        (learning.explore_share * self.pilots.len() as f64).round() as usize
    }
}

impl Student for FilterStudent {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn columns(&self) -> &'static [&'static str] {
        &[]
    }

    fn attach(&mut self, observations: Vec<Observation>) -> Result<usize, StudentError> {
        let worlds = self.site.worlds.clone();
        let mut n_gone_on = 0;
        if !Stand::any_is_of(&self.stands, worlds.clone(), &observations) {
            // Frames of other worlds, perhaps of another model.
            self.learner.forget();
        }
        for (world, observation) in worlds.zip(observations) {
            let mut pilot = Pilot::new(&self.learned, self.site.shape, observation, &self.config);
            let stand = self.stands.get(&world);
            n_gone_on += usize::from(pilot.go_on(world, stand, &mut self.learner)?);
            self.pilots.push(pilot);
        }
        Ok(n_gone_on)
    }

    fn begin(&mut self, world: u32, observation: Observation) -> Result<(), StudentError> {
        let mut pilot = Pilot::new(&self.learned, self.site.shape, observation, &self.config);
        pilot.begin(world, &mut self.learner)?;
        self.pilots[(world - self.site.worlds.start) as usize] = pilot;
        Ok(())
    }

    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        if !self.is_frozen {
            self.learned = self.learner.learned();
        }
        let n_walking = self.n_walking();
        let plan = |(index, pilot): (usize, &mut Pilot)| {
            pilot.filter.set(&self.learned.tables);
            let kind = match index < n_walking {
                true => PlannerKind::RandomWalk,
                false => PlannerKind::Beam,
            };
            pilot.plan(kind, self.learned.target, &self.config, self.site.n_moves)
        };
        let paths = self.pilots.par_iter_mut().enumerate().map(plan).collect();
        self.planning += start.elapsed();
        paths
    }

    fn take_in(
        &mut self,
        observations: Vec<Observation>,
        watched: &[usize],
    ) -> Result<(Tick, Vec<Impression>), StudentError> {
        let mut tick = Tick::default();
        let n_walking = self.n_walking();
        let worlds = self.site.worlds.clone().zip(observations);
        for ((world, observation), pilot) in worlds.zip(&mut self.pilots) {
            tick.reward += observation.result.reward;
            tick.score += pilot.take_in(world, observation, &mut self.learner)?;
        }
        let impression = |&index: &usize| Impression {
            belief: self.pilots[index].filter.belief().clone(),
            objective: match index < n_walking {
                true => RANDOM_MOVES.into(),
                false => Target::State(self.learned.target).label(&self.state_names()),
            },
            planning: self.pilots[index].planning,
        };
        let impressions = watched.iter().map(impression).collect();
        self.pilots.par_iter_mut().for_each(Pilot::predict);
        tick.n_worlds = self.pilots.len() as u64;
        tick.world_steps = self.learner.world_steps();
        Ok((tick, impressions))
    }

    fn learn(&mut self) -> Result<Vec<Lesson>, NotFinite> {
        let start = Instant::now();
        let updates = self.learner.learn();
        self.learning += start.elapsed();
        let lesson = |update: crate::estimator::learned_filter::Update| Lesson {
            number: update.number,
            loss: Some(update.loss),
            rate: Some(update.rate),
            more: Vec::new(),
        };
        Ok(updates?.into_iter().map(lesson).collect())
    }

    fn freeze(&mut self) {
        self.is_frozen = true;
    }

    fn world_steps(&self) -> u64 {
        self.learner.world_steps()
    }

    fn n_updates(&self) -> u64 {
        self.learner.n_updates()
    }

    fn estimator(&self) -> EstimatorKind {
        EstimatorKind::Learned
    }

    fn state_names(&self) -> Vec<String> {
        numbered_states(self.learned.tables.dimensions.n_states)
    }

    fn belief(&self) -> Option<(&Belief, usize)> {
        let pilot = self.pilots.first()?;
        Some((pilot.filter.belief(), self.learned.target))
    }

    fn contents(&self) -> Result<Contents, StudentError> {
        let mut contents = self.learner.to_contents();
        let pilots = self.site.worlds.clone().zip(&self.pilots);
        Stand::store(pilots, self.site.shape, &mut contents);
        Ok(contents)
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        vec![("planning", self.planning), ("updates", self.learning)]
    }
}
