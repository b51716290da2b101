//! A learner that acts, and whose beliefs are published to observers.

use crate::client::view::view;
use anyhow::Result;
use emberwatch_acting::rollout::{Actor, AgentObservation, StepRecord};
use emberwatch_learning::learners::{Learner, LearnerKind};
use emberwatch_protocol::Move;
use emberwatch_protocol::client::{Backend, Client};
use emberwatch_protocol::feed::Feed;
use std::ops::Range;
use std::time::{Duration, Instant};

/// A learner that acts, and whose beliefs are published to observers.
pub struct ShownLearner<'a> {
    learner: &'a mut dyn Learner,
    kind: &'static LearnerKind,
    feed: &'a mut Feed,
    robots: Range<u32>,
    team: u32,
    planning: Duration,
}

impl<'a> ShownLearner<'a> {
    pub fn new(
        learner: &'a mut dyn Learner,
        kind: &'static LearnerKind,
        feed: &'a mut Feed,
        client: &Client<impl Backend>,
    ) -> Self {
        Self {
            learner,
            kind,
            feed,
            robots: client.robots(),
            team: client.info().n_robots,
            planning: Duration::ZERO,
        }
    }

    fn show(&mut self) {
        let planning = self.planning / self.robots.len().max(1) as u32;
        for index in self.feed.due(self.robots.len()) {
            let number = self.robots.start + index as u32;
            let agent = self.learner.agent(index);
            let mut view = view(agent, number / self.team, number..number + 1, planning);
            view.intent.policy = format!("train {}", self.kind.name);
            self.feed.show(&view);
        }
    }
}

impl Actor for ShownLearner<'_> {
    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        let paths = self.learner.plan();
        self.planning = start.elapsed();
        paths
    }

    fn see(&mut self, seen: Vec<AgentObservation>) -> Result<Vec<StepRecord>> {
        let records = self.learner.see(seen)?;
        self.show();
        Ok(records)
    }

    fn predict(&mut self) {
        self.learner.predict();
    }
}
