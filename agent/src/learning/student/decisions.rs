//! Learns which action of [`ActionSet::beam`] to take (paper section III.E): beam search plans on the
//! known-model filter's belief, and a DQN that sees a summary of it chooses what each path is for.

use crate::config::{AgentConfig, DecisionsConfig};
use crate::learning::checkpoint::{Contents, check, check_counts};
use crate::learning::metrics::{ModelUpdate, Tick};
use crate::learning::student::base::{Student, Worlds, without_truth};
use crate::policy::Policy;
use crate::rollout::{Rollout, in_parallel, predict_all, see_all};
use ::network::{Dqn, SavedDqn, Track, Transition};
use anyhow::Result;
use emberwatch_belief::estimation::BayesFilter;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::summary::{spread_summary, summary_length};
use emberwatch_belief::planning::action::{Action, ActionSet};
use protocol::client::Observation;
use protocol::{Cell, Model, Move};
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};

pub const KIND: &str = "decisions";

/// A DQN over the actions of a model.
#[derive(Debug)]
pub struct Decisions {
    pub dqn: Dqn,
    /// The actions, in the order of the values.
    pub actions: ActionSet,
    /// World steps that were learned from.
    pub world_steps: u64,
    n_states: usize,
}

/// All of a checkpoint of decisions but the tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedDecisions {
    pub n_states: usize,
    pub actions: Vec<String>,
    /// World steps that were learned from.
    pub world_steps: u64,
    pub dqn: SavedDqn,
}

/// A DQN that learns on several worlds.
pub struct DecisionsStudent {
    worlds: Worlds,
    config: AgentConfig,
    policy: Policy,
    decisions: Decisions,
    filter: BayesFilter,
    target: usize,
    state_names: Vec<String>,
    runs: Vec<Run>,
    owed: f64,
    is_frozen: bool,
    times: [(&'static str, Duration); 2],
}

struct Run {
    rollout: Rollout,
    /// What the last decision went by, and what it was.
    input: Vec<f32>,
    action: usize,
    track: Track,
}

impl Decisions {
    /// Before the first step, for worlds of a model.
    pub fn first(model: &Model, config: &DecisionsConfig, seed: u64) -> Self {
        let actions = ActionSet::beam(model);
        let (n_states, n_actions) = (model.n_states(), actions.actions().len());
        Self {
            dqn: Dqn::new(config.settings(), summary_length(n_states), n_actions, seed),
            actions,
            world_steps: 0,
            n_states,
        }
    }

    /// The action that is worth most on a belief.
    pub fn best_action(&self, belief: &Belief, robot: Cell, n_moves: usize) -> &Action {
        &self.actions.actions()[self.dqn.best(&spread_summary(belief, robot, n_moves))]
    }

    pub fn to_contents(&self) -> Contents {
        let state = SavedDecisions {
            n_states: self.n_states,
            actions: self.actions.names(),
            world_steps: self.world_steps,
            dqn: self.dqn.saved(),
        };
        Contents::new(self.dqn.named_tensors(), &state)
    }

    pub fn load(&mut self, contents: &Contents) -> Result<()> {
        let saved: SavedDecisions = contents.state()?;
        let [expected, got] = [self.n_states, saved.n_states];
        check(got == expected, "states", expected, got)?;
        let [expected, got] = [self.actions.names(), saved.actions].map(|names| names.join(" "));
        check(got == expected, "actions", &expected, &got)?;
        let (updates, world_steps) = (saved.dqn.n_updates, saved.world_steps);
        check_counts(&[("dqn.n_updates", updates), ("world_steps", world_steps)])?;
        contents.check_squares()?;
        let find = |name: &str, shape: &[usize]| contents.tensor(name, shape);
        self.dqn.load(find, &saved.dqn)?;
        self.world_steps = world_steps;
        Ok(())
    }
}

impl DecisionsStudent {
    /// Goes on from some decisions, or begins. `filter` is that of the worlds' model before its first frame.
    pub fn new(
        decisions: Decisions,
        filter: BayesFilter,
        model: &Model,
        worlds: Worlds,
        config: &AgentConfig,
    ) -> Self {
        Self {
            worlds,
            config: config.clone(),
            policy: Policy::named("dqn_beam", model).expect("invariant: every model has it"),
            decisions,
            filter,
            target: model.target_state(),
            state_names: model.state_names(),
            runs: Vec::new(),
            owed: 0.0,
            is_frozen: false,
            times: ["planning", "learning"].map(|part| (part, Duration::ZERO)),
        }
    }

    /// A robot that has taken in what its world shows.
    fn run(&self, observation: Observation) -> Result<Run> {
        let (filter, names) = (Box::new(self.filter.clone()), self.state_names.clone());
        let (policy, config) = (&self.policy, &self.config);
        let mut rollout = self
            .worlds
            .rollout(config, policy, filter, names, observation);
        rollout.correct()?;
        rollout.agent.predict();
        Ok(Run {
            input: input(&rollout, self.worlds.n_moves),
            rollout,
            action: 0,
            track: self.decisions.dqn.track(),
        })
    }
}

fn input(rollout: &Rollout, n_moves: usize) -> Vec<f32> {
    spread_summary(
        rollout.agent.belief(),
        rollout.observation().robot.cell(),
        n_moves,
    )
}

impl Run {
    /// Takes in what an action brought, and gives the transition that is complete by then.
    fn bring(&mut self, reward_scale: f32, n_moves: usize) -> Option<Transition> {
        let next = input(&self.rollout, n_moves);
        self.track.add(Transition {
            input: std::mem::replace(&mut self.input, next.clone()),
            action: self.action,
            reward: self.rollout.observation().robot.reward as f32 * reward_scale,
            next,
        })
    }
}

impl Student for DecisionsStudent {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn columns(&self) -> &'static [&'static str] {
        &["dqn_loss", "dqn_rate", "epsilon"]
    }

    fn attach(&mut self, observations: Vec<Observation>) -> Result<usize> {
        let runs = observations.into_iter().map(|seen| self.run(seen));
        self.runs = runs.collect::<Result<_, _>>()?;
        // Beliefs begin again, wherever the worlds stand.
        Ok(0)
    }

    fn begin(&mut self, robot: u32, observation: Observation) -> Result<()> {
        let run = self.run(observation)?;
        self.runs[(robot - self.worlds.numbers.start) as usize] = run;
        Ok(())
    }

    fn plan(&mut self) -> Vec<Vec<Move>> {
        let start = Instant::now();
        let (decisions, is_frozen) = (&self.decisions, self.is_frozen);
        let runs = self.runs.iter_mut().enumerate();
        let paths = in_parallel(runs, |(index, run)| {
            run.action = if is_frozen {
                decisions.dqn.best(&run.input)
            } else {
                let step = decisions.world_steps + index as u64;
                decisions.dqn.act(&run.input, step)
            };
            let action = &decisions.actions.actions()[run.action];
            let (cells, step) = (run.rollout.cells(), run.rollout.step());
            let mut plans = run.rollout.agent.plan_action(action, &cells, step);
            plans.remove(0).moves
        });
        self.times[0].1 += start.elapsed();
        paths
    }

    fn see(&mut self, observations: Vec<Observation>) -> Result<Tick> {
        let seen = without_truth(observations);
        let turns = see_all(self.runs.iter_mut().map(|run| &mut run.rollout), seen)?;
        let mut tick = Tick::default();
        for (run, turn) in self.runs.iter().zip(turns) {
            tick.reward += run.rollout.observation().robot.reward;
            tick.score += turn.score.unwrap_or_default();
        }
        tick.n_worlds = self.runs.len() as u64;
        self.decisions.world_steps += tick.n_worlds;
        tick.world_steps = self.decisions.world_steps;
        self.owed += tick.n_worlds as f64 * self.config.decisions.updates_per_step;
        Ok(tick)
    }

    fn rollout(&self, index: usize) -> &Rollout {
        &self.runs[index].rollout
    }

    fn predict(&mut self) {
        predict_all(self.runs.iter_mut().map(|run| &mut run.rollout));
        let (n_moves, scale) = (self.worlds.n_moves, self.config.decisions.reward_scale);
        let transitions = in_parallel(&mut self.runs, |run| run.bring(scale, n_moves));
        for transition in transitions.into_iter().flatten() {
            self.decisions.dqn.remember(transition);
        }
    }

    fn learn(&mut self) -> Result<Vec<ModelUpdate>> {
        let start = Instant::now();
        let settings = self.config.decisions.settings();
        let epsilon = f64::from(settings.epsilon_at(self.decisions.world_steps));
        let mut updates = Vec::new();
        while self.owed >= 1.0 {
            self.owed -= 1.0;
            let Some(loss) = self.decisions.dqn.update()? else {
                continue;
            };
            updates.push(ModelUpdate {
                number: self.n_updates(),
                loss: None,
                rate: None,
                more: vec![
                    Some(f64::from(loss)),
                    Some(f64::from(settings.adam.learning_rate)),
                    Some(epsilon),
                ],
            });
        }
        self.times[1].1 += start.elapsed();
        Ok(updates)
    }

    fn freeze(&mut self) {
        self.is_frozen = true;
    }

    fn world_steps(&self) -> u64 {
        self.decisions.world_steps
    }

    fn n_updates(&self) -> u64 {
        self.decisions.dqn.n_updates()
    }

    fn belief(&self) -> Option<(&Belief, usize)> {
        let run = self.runs.first()?;
        Some((run.rollout.agent.belief(), self.target))
    }

    fn contents(&self) -> Result<Contents> {
        Ok(self.decisions.to_contents())
    }

    fn times(&self) -> Vec<(&'static str, Duration)> {
        self.times.to_vec()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decisions_survive_a_checkpoint_and_others_are_refused_by_name() {
        let model = Model::wildfire();
        let config = AgentConfig::default().decisions;
        let decisions = Decisions::first(&model, &config, 3);
        let contents = decisions.to_contents();
        let mut again = Decisions::first(&model, &config, 4);
        again.load(&contents).expect("of the same model");
        assert_eq!(again.to_contents(), contents);
        let mut refused = |change: fn(&mut SavedDecisions), words: &str| {
            let (mut other, mut saved) = (contents.clone(), contents.state().expect("its state"));
            change(&mut saved);
            other.set_state(&saved);
            let error = again.load(&other).expect_err(words).to_string();
            assert!(error.starts_with(words), "{error}");
        };
        refused(|saved| saved.n_states = 4, "states: expected 3, got 4");
        refused(
            |saved| saved.actions.truncate(1),
            "actions: expected exploit exploit_explore",
        );
        refused(
            |saved| saved.dqn.n_updates = u64::MAX,
            "dqn.n_updates: expected at most",
        );
    }
}
