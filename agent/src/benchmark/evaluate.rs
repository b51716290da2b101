//! Scores how well learned beliefs predict observations, compared with the known model and with the frequencies of the
//! observation values.
//!
//! All beliefs receive the same frames, from the paths of a guide: a random walk, or beam search with the known model.
//! The score is each frame's log-likelihood per visited cell, under the prediction made before the frame.

use crate::benchmark::arena::Arena;
use anyhow::Result;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::scoring::Score;
use emberwatch_learning::beliefs::first_belief::first_belief;
use emberwatch_learning::config::AgentConfig;
use emberwatch_learning::learned::Learned;
use emberwatch_learning::policy::Policy;
use emberwatch_learning::rollout::agent::Agent;
use emberwatch_learning::rollout::{self, Rollout, Seen};
use emberwatch_protocol::Frame;
use rayon::prelude::*;
use std::ops::Range;

#[derive(Debug, Clone)]
pub struct Evaluation<'a> {
    pub guide: &'a str,
    pub seeds: Range<u64>,
    pub steps: u64,
    pub config: &'a AgentConfig,
    /// Policies whose estimators are scored. Their planners are not used.
    pub policies: &'a [Policy],
    pub learned: &'a Learned,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Scores {
    pub seed: u64,
    pub scores: Vec<Score>,
    /// Number of times that each observation value was seen.
    pub counts: Vec<u64>,
}

/// Flies the guide's paths and scores each estimator's prediction of every frame.
pub fn evaluate(arena: &mut Arena, evaluation: &Evaluation<'_>) -> Result<Vec<Scores>> {
    let config = evaluation.config;
    let prior = config.prior(arena.info().burn_in);
    let prior = first_belief(prior, arena.known_model(), arena.shape(), config.seed)?;
    let seeds: Vec<u64> = evaluation.seeds.clone().collect();
    let mut scores = Vec::new();
    for batch in seeds.chunks(arena.batch_size()) {
        let (mut guides, mut worlds) = (Vec::new(), Vec::new());
        let seen = arena.reset(batch)?;
        for (&seed, seen) in batch.iter().zip(seen) {
            let (guide, candidates) = candidates(arena, evaluation, &prior, seed, seen)?;
            guides.push(guide);
            worlds.push(candidates);
        }
        for step in 1..=evaluation.steps {
            rollout::step(&mut guides, &mut arena.batch(batch, step))?;
            let frames = guides
                .iter()
                .map(|guide: &Rollout| &guide.observation().frame);
            let frames: Vec<&Frame> = frames.collect();
            let both = worlds.par_iter_mut().zip(frames);
            both.try_for_each(|(candidates, frame)| candidates.look(frame))?;
            let all = worlds.iter_mut().flat_map(|world| &mut world.estimators);
            Agent::predict_all(all);
        }
        scores.extend(worlds.into_iter().map(|candidates| candidates.scores));
    }
    Ok(scores)
}

/// Returns the score of predicting the same value frequencies for every cell. The frequencies are counted in hindsight,
/// over the observations of all worlds, separately for each sensor matrix.
pub fn score_of_frequencies(all: &[Scores], counts: &[u64], n_matrices: usize) -> Score {
    let total = |value: usize| all.iter().map(|scores| scores.counts[value]).sum::<u64>();
    let totals: Vec<u64> = (0..counts.len()).map(total).collect();
    let of_matrix = counts.len() / n_matrices;
    let mut score = Score::default();
    for (value, &count) in counts.iter().enumerate().filter(|(_, count)| **count > 0) {
        let first = value / of_matrix * of_matrix;
        let sum: u64 = totals[first..first + of_matrix].iter().sum();
        score.log_likelihood += count as f64 * (totals[value] as f64 / sum as f64).ln();
        score.n_seen += count;
    }
    score
}

/// The estimators on one world, and their scores.
struct Candidates {
    estimators: Vec<Agent>,
    scores: Scores,
}

/// Creates the guide that chooses the paths on a world, and the estimators to be scored.
fn candidates(
    arena: &Arena,
    evaluation: &Evaluation<'_>,
    prior: &Belief,
    seed: u64,
    seen: Seen,
) -> Result<(Rollout, Candidates)> {
    let model = arena.model();
    let (config, learned) = (evaluation.config, evaluation.learned);
    let agent = |policy: &Policy| arena.agent(policy, config, prior, (seed, 0), learned);
    let guide = Rollout::begun(agent(&Policy::named(evaluation.guide, model)?)?, seen)?;
    let estimators = evaluation.policies.iter().map(agent);
    let mut candidates = Candidates {
        estimators: estimators.collect::<Result<_, _>>()?,
        scores: Scores {
            seed,
            scores: vec![Score::default(); evaluation.policies.len()],
            counts: vec![0; model.n_observations()],
        },
    };
    candidates.correct(&guide.observation().frame)?;
    Agent::predict_all(&mut candidates.estimators);
    Ok((guide, candidates))
}

impl Candidates {
    /// Scores each estimator's prediction of a frame, then updates the estimators with the frame.
    fn look(&mut self, frame: &Frame) -> Result<()> {
        let scores = self.scores.scores.iter_mut().zip(&self.estimators);
        for (sum, agent) in scores {
            *sum += agent.score(frame).unwrap_or_default();
        }
        for (_, value) in frame.observed() {
            self.scores.counts[usize::from(value)] += 1;
        }
        self.correct(frame)
    }

    fn correct(&mut self, frame: &Frame) -> Result<()> {
        let mut agents = self.estimators.iter_mut();
        agents.try_for_each(|agent| agent.correct(frame, None))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn score_of_frequencies_is_minus_their_entropy() {
        let scores = |counts: &[u64]| Scores {
            seed: 0,
            scores: Vec::new(),
            counts: counts.to_vec(),
        };
        let all = [scores(&[3, 0, 1]), scores(&[1, 0, 3])];
        let score = score_of_frequencies(&all, &all[0].counts, 1);
        assert_eq!(score.n_seen, 4);
        assert!((score.mean() - 0.5_f64.ln()).abs() < 1e-12);
        // Two matrices: the first shows both values equally often, the second only one value.
        let all = [scores(&[3, 1, 8, 0]), scores(&[1, 3, 0, 0])];
        let score = score_of_frequencies(&all, &all[0].counts, 2);
        assert_eq!(score.n_seen, 12);
        assert!((score.log_likelihood - 4.0 * 0.5_f64.ln()).abs() < 1e-12);
    }
}
