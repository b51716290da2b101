//! Fuzz targets for models and checkpoints.

use emberwatch_acting::beliefs::LEARNED;
use emberwatch_acting::beliefs::learned::LearnedModel;
use emberwatch_acting::config::AgentConfig;
use emberwatch_acting::learned::Learned;
use emberwatch_acting::policy::LearnedDecisions;
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::parameters::Dimensions;
use emberwatch_belief::estimation::{BayesFilter, Estimator};
use emberwatch_learning::checkpoint::{WrongDigest, decode};
use emberwatch_learning::learners::decisions::{Base, DecisionsLearner, SavedDecisions};
use emberwatch_learning::learners::filter::fit::FilterFit;
use emberwatch_learning::learners::{self, Learner, Worlds};
use emberwatch_network::Device;
use emberwatch_protocol::model::ModelFile;
use emberwatch_protocol::{Airspace, Dynamics, Frame, Model, Shape};
use ndarray::Axis;

/// Number of simulated steps of a model.
const N_STEPS: u64 = 8;

/// Checks that a model file is refused, or that its model can be written, read again, simulated and filtered. The
/// properties of beliefs, states and flights are tested on random models next to the code.
pub fn model(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return false;
    };
    let Ok(model) = Model::from_toml(text) else {
        return false;
    };
    let again = toml::to_string::<ModelFile>(model.file()).expect("models serialise");
    assert_eq!(Model::from_toml(&again).as_ref(), Ok(&model));
    let grids = [(1, 1), (2, 5), (3, 17)].map(|(height, width)| Shape::new(height, width));
    for shape in grids.into_iter().flatten() {
        let fits = model.check_on(shape).is_ok();
        let prior = Belief::uniform(model.n_states(), shape);
        let filter = BayesFilter::known(&model, prior, true);
        let dynamics = Dynamics::new(&model, shape);
        assert_eq!((filter.is_ok(), dynamics.is_ok()), (fits, fits));
        if let (Ok(mut filter), Ok(mut dynamics)) = (filter, dynamics) {
            filter.predict();
            let mut states = dynamics.initial(1);
            (0..N_STEPS).for_each(|step| dynamics.step(1, step, &mut states));
            assert!(
                states
                    .iter()
                    .all(|&state| usize::from(state) < model.n_states())
            );
            model.airspace(shape).expect("it fits");
        }
    }
    true
}

/// Checks that a checkpoint is refused, or that its numbers are finite and a learner either resumes from it or refuses
/// it. First corrects the digest, because it protects only against damage, not against attackers.
pub fn checkpoint(bytes: &[u8]) -> bool {
    let mut bytes = bytes.to_vec();
    let mut learned = learners::from_bytes(&bytes);
    if let Err(error) = &learned
        && let Some(WrongDigest { expected, got }) = error.downcast_ref()
        && expected.len() == got.len()
    {
        let mut words = bytes.windows(got.len());
        let place = words.position(|word| word == expected.as_bytes());
        let place = place.map_or(0..0, |at| at..at + got.len());
        bytes.splice(place, got.bytes());
        learned = learners::from_bytes(&bytes);
    }
    let Ok(learned) = learned else { return false };
    let (kind, contents) = decode(&bytes).expect("read before");
    if let Some(filter) = learned.get::<LearnedModel>() {
        let likelihood = filter.tables.likelihood_array();
        let sums = likelihood.sum_axis(Axis(1));
        assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 1e-3), "{sums}");
        // Checkpoints of the decisions learner also contain a filter, but a filter learner can resume only from its own
        // checkpoints.
        if learners::filter::FILTER.checkpoint == kind {
            let mut fit = FilterFit::new(dimensions(), worlds().shape(), &config());
            if fit.load(&contents).is_ok() {
                see_frames(&mut fit);
            }
        }
    }
    if learned.get::<LearnedDecisions>().is_some() {
        let saved: SavedDecisions = contents.state().expect("read before");
        let base = saved.base(&contents, worlds().shape(), &Device::Cpu);
        let base = base.expect("read before").unwrap_or_else(base_of_filter);
        if let Ok(learner) = DecisionsLearner::new(base, Some(&contents), worlds(), &config()) {
            learner.contents().expect("no device");
        }
    }
    true
}

fn dimensions() -> Dimensions {
    Dimensions {
        n_states: 2,
        n_observations: 2,
        kernel: (1, 3),
    }
}

/// Returns worlds of three cells.
fn worlds() -> Worlds {
    Worlds {
        airspace: Airspace::open(Shape::new(1, 3).expect("a grid")),
        n_observations: 2,
        n_moves: 2,
        numbers: 0..1,
    }
}

fn config() -> AgentConfig {
    let mut config = AgentConfig::default();
    config.learning.window = 2;
    config.learning.block_windows = 1;
    config.learning.streams = 2;
    // Small networks keep the files of the corpus small.
    config.decisions.learning.width = 1;
    config
}

fn base_of_filter() -> Base {
    let fit = FilterFit::new(dimensions(), worlds().shape(), &config());
    let mut learned = Learned::default();
    learned.put(fit.learned());
    Base::new(&LEARNED, None, learned, worlds().shape()).expect("learned")
}

/// Fits a filter to some frames. Learning may fail, because finite numbers can overflow.
fn see_frames(fit: &mut FilterFit) {
    let shape = worlds().shape();
    let belief = Belief::uniform(2, shape);
    fit.start_track(0);
    for value in [0, 1, 1, 0, 1] {
        let frame = Frame::from_bytes(shape, 2, &[value, 255, 1]).expect("a frame");
        let learned = fit.learned();
        fit.see(0, &frame, Some(&belief), &learned);
        fit.earn(&belief, &[0, 2], 0.5);
        if fit.learn().is_err() {
            return;
        }
    }
}
