//! What the programs read from files: models, checkpoints.

use super::target::Seed;
use agent::estimation::parameters::Dimensions;
use agent::learning::checkpoint::{Contents, Problem, encode};
use agent::learning::learned::Learned;
use agent::learning::{learner, student};
use ndarray::{Array3, Axis};
use protocol::model::ModelFile;
use protocol::{Dynamics, Model, Shape, Transition};

/// Steps that a model is simulated for.
const N_STEPS: u64 = 8;

/// A model file: refused, or it can be written, read, simulated and filtered.
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
        let transition = Transition::<f32>::new(&model, shape);
        let dynamics = Dynamics::new(&model, shape);
        assert_eq!((transition.is_ok(), dynamics.is_ok()), (fits, fits));
        if let (Ok(transition), Ok(dynamics)) = (transition, dynamics) {
            beliefs_stay_beliefs(&model, shape, transition);
            states_stay_states(&model, dynamics);
        }
    }
    true
}

/// Certain beliefs and the one that knows nothing.
fn beliefs_stay_beliefs(model: &Model, shape: Shape, mut transition: Transition<f32>) {
    let dim = (model.n_states(), shape.height(), shape.width());
    let mut next = Array3::zeros(dim);
    for certain in 0..=dim.0 {
        let belief = Array3::from_shape_fn(dim, |(state, _, _)| match certain {
            all if all == dim.0 => 1.0 / dim.0 as f32,
            one if one == state => 1.0,
            _ => 0.0,
        });
        transition.apply(&belief, &mut next);
        let sums = next.sum_axis(Axis(0));
        assert!(
            sums.iter().all(|sum| (sum - 1.0).abs() < 1e-3),
            "beliefs sum to {sums}"
        );
        assert!(next.iter().all(|p| (0.0..=1.001).contains(p)), "{next}");
    }
}

fn states_stay_states(model: &Model, mut dynamics: Dynamics) {
    let mut states = dynamics.initial(1);
    for step in 0..N_STEPS {
        dynamics.step(1, step, &mut states);
    }
    assert!(
        states
            .iter()
            .all(|state| usize::from(*state) < model.n_states())
    );
    let reward: f64 = states
        .iter()
        .map(|state| model.reward()[usize::from(*state)])
        .sum();
    assert!(reward.is_finite(), "the reward sums to {reward}");
}

/// A checkpoint: refused, or what it holds is finite. Its digest is mended, which keeps damage out but
/// nobody who means harm.
pub fn checkpoint(bytes: &[u8]) -> bool {
    let learned = match Learned::from_bytes(bytes) {
        Err(Problem::Digest { expected, got }) if expected.len() == got.len() => {
            let place = bytes
                .windows(got.len())
                .position(|word| word == expected.as_bytes());
            let mut mended = bytes.to_vec();
            mended.splice(
                place.map_or(0..0, |at| at..at + got.len()),
                got.into_bytes(),
            );
            Learned::from_bytes(&mended)
        }
        learned => learned,
    };
    let Ok(learned) = learned else { return false };
    if let Some(filter) = learned.filter {
        let likelihood = filter.tables.likelihood_array();
        let sums = likelihood.sum_axis(Axis(1));
        assert!(
            sums.iter().all(|sum| (sum - 1.0).abs() < 1e-3),
            "likelihoods sum to {sums}"
        );
    }
    true
}

pub fn model_seeds() -> Vec<Seed> {
    let written = |file: &ModelFile| {
        toml::to_string(file)
            .expect("models serialise")
            .into_bytes()
    };
    let wildfire = Model::wildfire();
    let built_in = |name| written(Model::built_in(name).expect("a built-in model").file());
    vec![
        ("wildfire.toml", written(wildfire.file())),
        ("sparse.toml", built_in("wildfire-sparse")),
        ("line.toml", LINE.into()),
    ]
}

/// A small model with everything in it: a bias, rewards, a kernel of one row.
const LINE: &str = r##"name = "line"
kernel_size = [1, 3]
states = [
    { name = "a", color = "#000000", initial = 0.5, reward = 1.0, bias = 0.25, observed_as = [0.75, 0.25] },
    { name = "b", color = "#ffffff", initial = 0.5, observed_as = [0.0, 1.0] },
]
observations = [{ name = "x", color = "#000000" }, { name = "y", color = "#123abc" }]
kernel = [
    { from = "a", to = "b", scale = 0.5, weights = [[0.0, 1.0, 0.5]] },
    { from = "b", to = "b", weights = [[1.0, 2.0, 1.0]] },
]
"##;

pub fn checkpoint_seeds() -> Vec<Seed> {
    let dimensions = Dimensions {
        n_states: 2,
        n_observations: 2,
        kernel: (1, 3),
    };
    let filter = learner::Progress::first(dimensions, 5).to_contents();
    let texts = |texts: &[(&str, &str)]| Contents {
        texts: texts
            .iter()
            .map(|(name, text)| ((*name).into(), (*text).into()))
            .collect(),
        ..Contents::default()
    };
    // Its tensors would be too long for a corpus: as far as the sizes that it asks for.
    let autoencoder = |side: &str, length: usize| {
        let settings = format!("[autoencoder]\nencoding = {length}\nhidden = {length}\n");
        texts(&[
            ("settings", &*settings),
            ("height", side),
            ("width", side),
            ("observations", "3"),
            ("adam_steps", "0"),
            ("updates", "0"),
        ])
    };
    let decisions = texts(&[("states", "3"), ("world_steps", "100")]);
    let encoded = |kind, contents| encode(kind, &contents).expect("checkpoints serialise");
    vec![
        ("filter", encoded(learner::KIND, filter)),
        (
            "autoencoder",
            encoded(student::network::KIND, autoencoder("8", 4)),
        ),
        // Asked for 30 GiB once.
        (
            "autoencoder_large",
            encoded(student::network::KIND, autoencoder("4096", 256)),
        ),
        ("decisions", encoded(student::decisions::KIND, decisions)),
    ]
}
