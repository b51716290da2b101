//! Which belief paths are planned on: the paper's estimate `p_k` of where the world stands (eqs. 13 to 15),
//! or the predictor `u_{k+1}` of where it stands when the path is observed.

use crate::estimation::belief::Belief;
use serde::{Deserialize, Serialize};

/// A belief that paths may be planned on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BasisKind {
    /// The predictor `u_{k+1}`, as in the authors' code: the world moves before it is seen.
    Predictor,
    /// The estimate `p_k` (the paper as printed).
    Estimate,
}

/// What plans are based on: keeps the estimate where it is wanted.
#[derive(Debug, Clone)]
pub struct PlanBasis {
    kind: BasisKind,
    estimate: Option<Belief>,
}

impl PlanBasis {
    pub fn new(kind: BasisKind) -> Self {
        Self {
            kind,
            estimate: None,
        }
    }

    pub fn kind(&self) -> BasisKind {
        self.kind
    }

    /// Takes in an estimate `p_k`, before or after what follows is predicted from it.
    pub fn see(&mut self, estimate: &Belief) {
        if self.kind == BasisKind::Estimate {
            self.estimate = Some(estimate.clone());
        }
    }

    /// The last estimate, if paths are planned on it.
    pub fn estimate(&self) -> Option<&Belief> {
        self.estimate.as_ref()
    }

    /// The belief to plan on, given the predictor; that itself before the first estimate.
    pub fn belief<'a>(&'a self, predictor: &'a Belief) -> &'a Belief {
        self.estimate.as_ref().unwrap_or(predictor)
    }
}
