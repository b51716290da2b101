//! The parts of a policy, and the objective and checkpoints that they imply.

use super::decisions::LearnedDecisions;
use super::goals::Goal;
use super::planners::{BEAM, BY_OPTIONS, PlannerKind, SHOOTING};
use crate::beliefs::{AUTOENCODER, BeliefKind};
use crate::learned::Learned;
use anyhow::{Context, Result, ensure};
use emberwatch_belief::planning::{Objective, Target};

/// A belief to plan on, a planner, and a goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    /// Name in commands, tables and files.
    pub name: String,
    pub belief: &'static BeliefKind,
    pub planner: &'static PlannerKind,
    pub goal: Goal,
}

impl Policy {
    /// Returns the policy that learners act with: beam search for the state with the highest reward.
    pub fn exploiting(belief: &'static BeliefKind) -> Self {
        Self {
            name: format!("{}/beam/exploit", belief.name),
            belief,
            planner: &BEAM,
            goal: Goal::Exploit,
        }
    }

    /// Whether a DQN chooses among options.
    pub fn chooses_options(&self) -> bool {
        self.goal == Goal::Learned && *self.planner == BY_OPTIONS
    }

    /// Whether the policy needs a checkpoint from `train`.
    pub fn needs_checkpoint(&self) -> bool {
        self.goal == Goal::Learned || self.belief.learned_by.is_some()
    }

    /// Checks that the checkpoints contain everything that the policy uses.
    ///
    /// # Errors
    /// If something is missing. The error names the learner that creates it.
    pub fn check(&self, learned: &Learned) -> Result<()> {
        let of_policy = || format!("policy {:?} needs --checkpoint FILE", self.name);
        self.belief.learned(learned).with_context(of_policy)?;
        if self.chooses_options() {
            self.decisions(learned).with_context(of_policy)?;
        }
        Ok(())
    }

    /// Returns the decisions that were learned on the policy's belief.
    ///
    /// # Errors
    /// If there are no learned decisions, or they were learned on another belief.
    pub fn decisions<'a>(&self, learned: &'a Learned) -> Result<&'a LearnedDecisions> {
        let decisions = learned.get::<LearnedDecisions>();
        let decisions =
            decisions.context("expected a checkpoint of `train --learner decisions`, got none")?;
        let [expected, got] = [self.belief, decisions.belief].map(|belief| belief.name);
        ensure!(
            got == expected,
            "expected decisions on the belief {expected}, got decisions on {got}"
        );
        Ok(decisions)
    }

    /// Returns the objective. `target` is the index of the state with the highest reward.
    pub fn objective(&self, target: usize) -> Objective {
        let target = match self.goal {
            Goal::Coverage => Target::Coverage,
            Goal::Explore => Target::Entropy,
            Goal::State(state) => Target::State(state),
            Goal::Exploit | Goal::ExploitOnly | Goal::Learned | Goal::Rule | Goal::Option(_) => {
                Target::State(target)
            }
        };
        let coverage_bonus = match self.goal {
            Goal::Coverage => 1.0,
            Goal::ExploitOnly => 0.0,
            _ => self.planner.bonus,
        };
        Objective {
            target,
            coverage_bonus,
        }
    }
}

/// Returns the policies among which the DQN of Algorithm 1 chooses (paper section IV, the actions `a_k`): one for the
/// probability of each state, then one for the belief's entropy.
pub fn network_choices(n_states: usize) -> Vec<Policy> {
    let states = (0..n_states).map(Goal::State);
    let goals = states.chain([Goal::Explore]);
    let choice = |goal| Policy {
        name: "choice".into(),
        belief: &AUTOENCODER,
        planner: &SHOOTING,
        goal,
    };
    goals.map(choice).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_belief::planning::objective::BEAM_BONUS;
    use emberwatch_model::Model;

    fn objective(name: &str) -> Objective {
        let policy = Policy::named(name, &Model::wildfire()).expect("a known name");
        policy.objective(2)
    }

    #[test]
    fn default_bonuses_are_the_authors_and_small_for_beam() {
        let [fire, entropy] = [Target::State(2), Target::Entropy].map(Objective::paper);
        assert_eq!(objective("shooting"), fire);
        assert_eq!(objective("known/shooting/explore"), entropy);
        let of_beam = objective("beam");
        assert_eq!(of_beam.coverage_bonus, BEAM_BONUS);
        let choices = network_choices(3);
        assert_eq!(choices[2].objective(0), fire);
        assert_eq!(choices[3].objective(0), entropy);
        for (name, bonus, target) in [
            ("known/shooting/latent", 1.0, Target::State(1)),
            ("known/shooting/exploit_only", 0.0, Target::State(2)),
            ("coverage", 1.0, Target::Coverage),
        ] {
            let got = objective(name);
            assert_eq!((got.coverage_bonus, got.target), (bonus, target), "{name}");
        }
    }
}
