//! What checkpoints hold, by kind: all that policies on a learned belief need.

use crate::learning::checkpoint::{self, CheckpointError, Contents, Problem};
use crate::learning::learner::{self, LearnedModel};
use crate::learning::student::filter::SavedFilter;
use crate::learning::student::network::LearnedNetwork;
use crate::learning::student::{decisions, network};
use crate::planning::policy::EstimatorKind;
use ::network::Device;
use std::path::Path;
use std::sync::Arc;

/// Kinds of checkpoints that policies act on.
const KINDS: [&str; 3] = [learner::KIND, network::KIND, decisions::KIND];

/// Everything that was learned.
#[derive(Debug, Clone, Default)]
pub struct Learned {
    /// A filter, for policies `learned_*`.
    pub filter: Option<LearnedModel>,
    /// An autoencoder and a DQN, for policies `autoencoder_*`.
    pub network: Option<Arc<LearnedNetwork>>,
    /// Decisions, for `dqn_beam`; they fit a model or not.
    pub decisions: Option<Arc<Contents>>,
}

impl Learned {
    /// What some checkpoints hold, of each kind one at most; networks compute on `device`.
    ///
    /// # Errors
    /// [`CheckpointError`] names the file that cannot be read, or is the second of its kind.
    pub fn read<'a>(
        paths: impl IntoIterator<Item = &'a Path>,
        device: &Device,
    ) -> Result<Self, CheckpointError> {
        let mut learned = Self::default();
        for path in paths {
            let (kind, contents) = checkpoint::read(path, &KINDS)?;
            let added = learned.add(kind, contents, device);
            added.map_err(|problem| problem.of(path))?;
        }
        Ok(learned)
    }

    /// What one checkpoint holds, of whatever kind.
    ///
    /// # Errors
    /// [`Problem`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, Problem> {
        let (kind, contents) = checkpoint::decode(&KINDS, bytes)?;
        let mut learned = Self::default();
        learned.add(kind, contents, &Device::Cpu)?;
        Ok(learned)
    }

    fn add(
        &mut self,
        kind: &'static str,
        contents: Contents,
        device: &Device,
    ) -> Result<(), Problem> {
        let twice = match kind {
            learner::KIND => {
                let saved = contents.state::<SavedFilter>()?.learner;
                let dimensions = saved.dimensions.check();
                let dimensions = dimensions
                    .map_err(|error| Problem::value("dimensions", "those of a filter", error))?;
                let model = saved.progress(&contents, dimensions)?.learned();
                self.filter.replace(model).is_some()
            }
            decisions::KIND => self.decisions.replace(Arc::new(contents)).is_some(),
            _ => {
                let network = network::Progress::read(&contents, device)?.learned();
                self.network.replace(Arc::new(network)).is_some()
            }
        };
        if twice {
            let expected = format!("one checkpoint of {kind}");
            Err(Problem::whole(expected, "two"))
        } else {
            Ok(())
        }
    }
}

impl Learned {
    /// The state that pays most, as the one who learned an estimator's model found it.
    pub fn target(&self, estimator: EstimatorKind) -> Option<usize> {
        match estimator {
            EstimatorKind::Learned | EstimatorKind::LearnedSpatial => {
                self.filter.as_ref().map(|filter| filter.target)
            }
            EstimatorKind::Autoencoder => self.network.as_ref().map(|network| network.target),
            _ => None,
        }
    }
}
