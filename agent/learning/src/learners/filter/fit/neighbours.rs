//! What the frames of all worlds say of correlations between neighbours, while the filter is learned.

use emberwatch_belief::estimation::Correlations;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::correlations::{Ages, Evidence};
use emberwatch_belief::estimation::parameters::Tables;
use emberwatch_model::Frame;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What is kept of earlier sums with each frame of any world: parameters were worse then.
const KEPT: f64 = 1.0 - 1.0 / 4000.0;

/// Learns the correlations of the state that pays most.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Neighbours {
    correlations: Correlations,
    /// The state that paid most when they were learned.
    state: Option<usize>,
    /// By world.
    ages: BTreeMap<u32, Ages>,
}

impl Neighbours {
    /// What was learned of a state so far.
    pub fn correlations_of(&self, state: usize) -> Correlations {
        if self.state == Some(state) {
            self.correlations.clone()
        } else {
            Correlations::default()
        }
    }

    /// A robot begins an episode in a world of so many cells.
    pub fn begin(&mut self, robot: u32, n_cells: usize) {
        self.ages.insert(robot, Ages::new(n_cells));
    }

    /// Forgets all worlds; what was learned in them stays.
    pub fn forget_robots(&mut self) {
        self.ages.clear();
    }

    /// A robot's next frame, with the belief before it, unless it is the first.
    pub fn see(
        &mut self,
        robot: u32,
        frame: &Frame,
        predictor: Option<&Belief>,
        tables: &Tables,
        state: usize,
    ) {
        let Some(ages) = self.ages.get_mut(&robot) else {
            return;
        };
        ages.grow();
        if let Some(predictor) = predictor {
            if self.state != Some(state) {
                (self.state, self.correlations) = (Some(state), Correlations::default());
            }
            let evidence = Evidence::of(frame, predictor, &tables.likelihood_array(), state, ages);
            self.correlations.fade(KEPT);
            self.correlations.learn(&evidence);
        }
        frame.observed().for_each(|(index, _)| ages.see(index));
    }

    /// Whether these are worlds of so many cells.
    pub fn are_of(&self, n_cells: usize) -> bool {
        self.ages
            .values()
            .all(|ages| ages.as_slice().len() == n_cells)
    }
}
