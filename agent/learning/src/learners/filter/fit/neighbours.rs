//! Estimates correlations between neighbouring cells from the frames of all worlds, while the filter is learned.

use emberwatch_belief::estimation::Correlations;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::correlations::{Ages, Evidence};
use emberwatch_belief::estimation::parameters::Tables;
use emberwatch_model::Frame;
use std::collections::BTreeMap;

/// Factor by which the sums decay with each frame of any world. Old frames must lose weight, because they were
/// evaluated with worse parameters.
const KEPT: f64 = 1.0 - 1.0 / 4000.0;

/// Learns the correlations of the state with the highest reward.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Neighbours {
    correlations: Correlations,
    state: Option<usize>,
    ages: BTreeMap<u32, Ages>,
}

impl Neighbours {
    /// Continues from the learned correlations of a state, without robots.
    pub fn of(correlations: Correlations, state: usize) -> Self {
        Self {
            correlations,
            state: Some(state),
            ages: BTreeMap::new(),
        }
    }

    /// Returns the learned correlations of a state, or default values if another state's correlations were learned.
    pub fn correlations_of(&self, state: usize) -> Correlations {
        if self.state == Some(state) {
            self.correlations.clone()
        } else {
            Correlations::default()
        }
    }

    /// Begins an episode of a robot.
    pub fn start_track(&mut self, robot: u32, n_cells: usize) {
        self.ages.insert(robot, Ages::new(n_cells));
    }

    /// Adds a robot's next frame. `predictor` is the belief before the frame, or `None` for the first frame.
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
}
