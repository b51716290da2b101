//! What checkpoints hold, by kind: all that policies on a learned belief need.

use crate::belief::LearnedBelief;
use crate::checkpoint::{self, Contents};
use crate::learners::decisions::{self, LearnedDecisions};
use crate::learners::filter::SavedFilter;
use crate::learners::filter::fit::{self, LearnedModel};
use crate::learners::filter::form::Form;
use crate::learners::network;
use crate::learners::neural::{self, NeuralModel};
use crate::policy::{Choice, EstimatorKind, Policy};
use anyhow::{Context, Result, ensure};
use emberwatch_belief::estimation::parameters::Dimensions;
use emberwatch_model::Model;
use emberwatch_network::Device;
use std::path::Path;
use std::sync::Arc;

/// Kinds of checkpoints that policies act on.
const KINDS: [&str; 5] = [
    fit::KIND,
    fit::OWN_KIND,
    neural::KIND,
    network::KIND,
    decisions::KIND,
];

#[derive(Debug, Clone, Default)]
pub struct Learned {
    /// A filter, for policies `learned_*`.
    pub filter: Option<LearnedModel>,
    /// One whose kernels see the cell's own state, for policies `learned_own_*`.
    pub own_filter: Option<LearnedModel>,
    /// A neural belief, for policies `neural_*`.
    pub neural: Option<NeuralModel>,
    /// An autoencoder and a DQN, for policies `autoencoder_*`.
    pub network: Option<Arc<network::Progress>>,
    /// Decisions, for `learned_policy` and others on the belief that they were learned on.
    pub decisions: Option<LearnedDecisions>,
    /// Of each checkpoint, in the order read.
    pub digests: Vec<String>,
}

impl Learned {
    /// What some checkpoints hold, of each kind one at most; networks compute on `device`.
    pub fn read<'a>(paths: impl IntoIterator<Item = &'a Path>, device: &Device) -> Result<Self> {
        let mut learned = Self::default();
        for path in paths {
            let (kind, contents) = checkpoint::read(path, &KINDS)?;
            let added = learned.add(kind, contents, device);
            added.with_context(|| format!("checkpoint {}", path.display()))?;
        }
        Ok(learned)
    }

    /// What one checkpoint holds, of whatever kind.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        let (kind, contents) = checkpoint::decode(&KINDS, bytes)?;
        let mut learned = Self::default();
        learned.add(kind, contents, &Device::Cpu)?;
        Ok(learned)
    }

    fn add(&mut self, kind: &'static str, contents: Contents, device: &Device) -> Result<()> {
        let twice = match kind {
            fit::KIND => self.add_belief(filter(&contents, false)?),
            fit::OWN_KIND => self.add_belief(filter(&contents, true)?),
            neural::KIND => {
                let model = NeuralModel::read(&contents, device)?;
                self.add_belief(LearnedBelief::Neural(model))
            }
            decisions::KIND => self.add_decisions(&contents, device)?,
            _ => {
                let network = network::Progress::read(&contents, device)?;
                self.network.replace(Arc::new(network)).is_some()
            }
        };
        ensure!(!twice, "expected one checkpoint of {kind}, got two");
        self.digests.push(contents.digest());
        Ok(())
    }

    /// A belief; returns whether there was another before: decisions bring the one that they were learned on.
    fn add_belief(&mut self, belief: LearnedBelief) -> bool {
        fn put<T: PartialEq>(slot: &mut Option<T>, model: T) -> bool {
            let is_other = slot.as_ref().is_some_and(|before| *before != model);
            *slot = Some(model);
            is_other
        }
        match belief {
            LearnedBelief::Neural(model) => put(&mut self.neural, model),
            LearnedBelief::Filter(model) if model.tables.dimensions.sees_own_state => {
                put(&mut self.own_filter, *model)
            }
            LearnedBelief::Filter(model) => put(&mut self.filter, *model),
        }
    }

    /// Decisions, with the belief that was learned for them; returns whether there were some before.
    fn add_decisions(&mut self, contents: &Contents, device: &Device) -> Result<bool> {
        let (decisions, belief) = LearnedDecisions::read(contents, device)?;
        if let Some(belief) = belief {
            ensure!(
                !self.add_belief(belief),
                "expected one belief of a kind, got two: that of the decisions, and another"
            );
        }
        Ok(self.decisions.replace(decisions).is_some())
    }
}

impl Learned {
    /// What was learned for an estimator.
    pub fn belief(&self, estimator: EstimatorKind) -> Option<LearnedBelief> {
        let filter = match estimator {
            EstimatorKind::Learned { is_own: false, .. } => &self.filter,
            EstimatorKind::Learned { is_own: true, .. } => &self.own_filter,
            EstimatorKind::Neural => return self.neural.clone().map(LearnedBelief::Neural),
            _ => return None,
        };
        let filter = filter.clone().map(Box::new);
        filter.map(LearnedBelief::Filter)
    }

    /// What options are planned on unless it is said: what decisions were learned on, or else the belief that was learned;
    /// without one the known model's.
    pub fn estimator(&self) -> EstimatorKind {
        let decided = self.decisions.as_ref().map(|decisions| decisions.estimator);
        let learned = [
            EstimatorKind::LEARNED,
            EstimatorKind::learned(true),
            EstimatorKind::Neural,
        ];
        let mut learned = learned.into_iter();
        let found = learned.find(|&kind| self.belief(kind).is_some());
        decided.or(found).unwrap_or(EstimatorKind::KNOWN)
    }

    /// The policies that act on it: those of beliefs, of the autoencoder, and of decisions.
    pub fn policies(&self, model: &Model) -> Vec<Policy> {
        let mut policies = Policy::all(model);
        policies.retain(|policy| {
            policy.needs_checkpoint() && !policy.is_option() && self.suits(policy)
        });
        policies.sort_by_key(|policy| policy.estimator.knows_model());
        policies
    }

    /// Whether what a policy acts on was learned, if anything has to be.
    pub fn suits(&self, policy: &Policy) -> bool {
        let mut decisions = self.decisions.iter();
        let is_decided = policy.choice != Choice::Scorer
            || decisions.any(|decisions| decisions.estimator == policy.estimator);
        is_decided
            && match policy.estimator {
                EstimatorKind::Autoencoder => self.network.is_some(),
                kind if kind.is_learned() => self.belief(kind).is_some(),
                _ => true,
            }
    }

    /// The state that pays most, as the one who learned an estimator's model found it.
    pub fn target(&self, estimator: EstimatorKind) -> Option<usize> {
        match estimator {
            EstimatorKind::Autoencoder => self.network.as_ref().map(|network| network.target()),
            _ => self.belief(estimator).map(|belief| belief.target()),
        }
    }
}

fn filter(contents: &Contents, sees_own_state: bool) -> Result<LearnedBelief> {
    let mut saved = contents.state::<SavedFilter>()?.fit;
    let dimensions = Dimensions {
        sees_own_state,
        ..saved.optimiser.dimensions()
    };
    let form = Form::read(dimensions, &contents.part(""))?;
    saved.load(contents, &form)?;
    Ok(LearnedBelief::Filter(Box::new(saved.learned())))
}
