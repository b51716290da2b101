//! Learns the filter's parameters on several worlds at once: robots walk at random first, then plan on
//! the belief of the filter as it is.

use super::{Lesson, NotFinite, Site, Student};
use crate::checkpoint::Contents;
use crate::client::Observation;
use crate::config::AgentConfig;
use crate::estimator::ZeroEvidence;
use crate::learner::{KIND, LearnedModel, Learner, Progress};
use crate::metrics::Tick;
use crate::pilot::Pilot;
use crate::policy::PlannerKind;
use protocol::Move;
use rayon::prelude::*;
use std::time::{Duration, Instant};

/// A filter that is learned.
pub struct FilterStudent {
    site: Site,
    config: AgentConfig,
    learner: Learner,
    learned: LearnedModel,
    pilots: Vec<Pilot>,
    planning: Duration,
    learning: Duration,
}

impl FilterStudent {
    /// Goes on from some progress, or begins.
    pub fn new(progress: Progress, site: Site, config: &AgentConfig) -> Self {
        Self {
            learned: progress.learned(),
            learner: Learner::new(progress, site.shape, config),
            site,
            config: config.clone(),
            pilots: Vec::new(),
            planning: Duration::ZERO,
            learning: Duration::ZERO,
        }
    }

    /// Worlds whose robots walk at random: all at first, some for good.
    fn n_walking(&self) -> usize {
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

    fn begin(&mut self, world: usize, observation: Observation) -> Result<(), ZeroEvidence> {
        let mut pilot = Pilot::new(&self.learned, self.site.shape, observation, &self.config);
        pilot.begin(world as u32, &mut self.learner)?;
        match self.pilots.get_mut(world) {
            Some(former) => *former = pilot,
            None => self.pilots.push(pilot),
        }
        Ok(())
    }

    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        self.learned = self.learner.learned();
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

    fn take_in(&mut self, observations: Vec<Observation>) -> Result<Tick, ZeroEvidence> {
        let mut tick = Tick::default();
        let worlds = observations.into_iter().zip(&mut self.pilots).enumerate();
        for (world, (observation, pilot)) in worlds {
            tick.reward += observation.result.reward;
            tick.score += pilot.take_in(world as u32, observation, &mut self.learner)?;
        }
        self.pilots
            .par_iter_mut()
            .for_each(|pilot| pilot.filter.predict());
        tick.n_worlds = self.pilots.len() as u64;
        tick.world_steps = self.learner.world_steps();
        Ok(tick)
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

    fn n_updates(&self) -> u64 {
        self.learner.n_updates()
    }

    fn contents(&self) -> Contents {
        self.learner.progress().to_contents("")
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        vec![("planning", self.planning), ("updates", self.learning)]
    }
}
