use super::*;
use crate::testing::learned_filter;
use emberwatch_belief::estimation::BayesFilter;
use emberwatch_network::{Device, Lesson};

fn estimator() -> NeuralEstimator {
    let network = NeuralBelief::new(3, 1, &Device::Cpu).expect("a network");
    NeuralEstimator::new(&network, None, shape()).expect("a belief")
}

fn shape() -> Shape {
    Shape::new(2, 3).expect("test shape")
}

fn frame(values: &[u8]) -> Frame {
    Frame::from_bytes(shape(), 3, values).expect("test frame")
}

#[test]
fn visited_cells_are_certain_until_the_next_step() {
    let mut estimator = estimator();
    let check = |estimator: &NeuralEstimator, cell, expected: [f64; 3]| {
        let states = estimator.belief().states(cell);
        let mut pairs = states.iter().zip(expected);
        assert!(pairs.all(|(p, q)| (p - q).abs() < 1e-6), "{states:?}");
    };
    check(&estimator, 1, [1.0 / 3.0; 3]);
    let seen = frame(&[255, 2, 255, 255, 255, 255]);
    estimator.correct(&seen).expect("possible");
    check(&estimator, 1, [0.0, 0.0, 1.0]);
    check(&estimator, 0, [1.0 / 3.0; 3]);
    estimator.predict();
    // An untrained network predicts uniform distributions.
    check(&estimator, 1, [1.0 / 3.0; 3]);
}

fn filter() -> Box<dyn Filter> {
    let model = emberwatch_model::Model::wildfire();
    let filter = BayesFilter::known(&model, Belief::uniform(3, shape()), false);
    Box::new(filter.expect("a filter"))
}

#[test]
fn predictions_together_equal_predictions_alone() {
    let networks = [1, 2].map(|seed| {
        let mut network = NeuralBelief::new(3, seed, &Device::Cpu).expect("a network");
        let lesson = Lesson {
            before: Sightings::new(shape()),
            frame: vec![(0, 1), (4, 2)],
            base: Vec::new(),
        };
        let updates = (0..3).map(|_| network.update(0.05, std::slice::from_ref(&lesson)));
        assert!(updates.into_iter().all(|loss| loss.is_ok()));
        network
    });
    let estimators = || -> Vec<Box<dyn Estimator>> {
        let mut all = Vec::<Box<dyn Estimator>>::new();
        // The two networks alternate, each with and without a filter to correct.
        for index in 0..8 {
            let below = (index % 4 > 1).then(filter);
            let estimator = NeuralEstimator::new(&networks[index % 2], below, shape());
            let mut estimator = estimator.expect("a belief");
            let seen = [255, 255, index as u8 % 3, 255, 1, 255];
            estimator.correct(&frame(&seen)).expect("possible");
            all.push(Box::new(estimator));
        }
        all
    };
    let (mut together, mut alone) = (estimators(), estimators());
    predict_together(together.iter_mut().map(|it| &mut **it).collect());
    for (index, (together, alone)) in together.iter().zip(&mut alone).enumerate() {
        let before = alone.belief().clone();
        alone.predict();
        assert!(together.belief() == alone.belief(), "{index}");
        assert!(*alone.belief() != before, "{index}");
    }
}

#[test]
fn equal_models_have_equal_targets_filters_and_parameters() {
    let model = |seed, filter: Option<LearnedModel>, target| NeuralModel {
        network: NeuralBelief::new(3, seed, &Device::Cpu).expect("a network"),
        filter: filter.map(Box::new),
        target,
    };
    let learned = || Some(learned_filter());
    let first = model(1, learned(), 1);
    assert!(first == model(1, learned(), 1));
    for other in [
        model(1, learned(), 2),
        model(1, None, 1),
        model(2, learned(), 1),
    ] {
        assert!(first != other);
    }
}

#[test]
fn restored_bytes_result_in_the_same_belief() {
    let (mut first, mut second) = (estimator(), estimator());
    for values in [[0, 1, 2, 255, 255, 255], [255, 2, 255, 1, 255, 0]] {
        first.correct(&frame(&values)).expect("possible");
        first.predict();
    }
    let bytes = first.to_bytes();
    assert!(!second.restore(&bytes[1..]) && second.sightings == Sightings::new(shape()));
    assert!(second.restore(&bytes));
    assert_eq!((second.to_bytes(), second.kind()), (bytes, first.kind()));
    let other = NeuralBelief::new(3, 2, &Device::Cpu).expect("a network");
    let other = NeuralEstimator::new(&other, None, shape()).expect("a belief");
    assert_ne!(other.kind(), first.kind());
}
