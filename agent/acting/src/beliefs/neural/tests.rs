use super::*;
use crate::testing::learned_filter;
use emberwatch_network::{Device, Lesson};

fn network(seed: u64) -> NeuralBelief {
    NeuralBelief::new(3, seed, &Device::Cpu).expect("a network")
}

fn estimator_on(network: &NeuralBelief, filter: Option<Box<dyn Filter>>) -> NeuralEstimator {
    NeuralEstimator::new(network, filter, shape()).expect("a belief")
}

fn estimator() -> NeuralEstimator {
    estimator_on(&network(1), None)
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
    learned_filter().estimator(false, shape())
}

#[test]
fn predictions_together_equal_predictions_alone() {
    let networks = [1, 2].map(|seed| {
        let mut network = network(seed);
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
            let mut estimator = estimator_on(&networks[index % 2], below);
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
    let model = |seed, has_filter: bool, target| NeuralModel {
        network: network(seed),
        filter: has_filter.then(|| Box::new(learned_filter())),
        target,
    };
    let first = model(1, true, 1);
    assert!(first == model(1, true, 1));
    assert!(
        first != model(1, true, 2) && first != model(1, false, 1) && first != model(2, true, 1)
    );
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
    assert_ne!(estimator_on(&network(2), None).kind(), first.kind());
}

#[test]
fn a_refused_frame_changes_nothing() {
    for has_filter in [false, true] {
        let new = || estimator_on(&network(1), has_filter.then(filter));
        let (mut one, mut other) = (new(), new());
        for step in 0..3 {
            for estimator in [&mut one, &mut other] {
                let mut seen = [255; 6];
                (seen[step], seen[5]) = (0, 1);
                estimator.correct(&frame(&seen)).expect("possible");
            }
            // The first cell is possible. The last one was seen as another value in this step.
            let refused = one.correct(&frame(&[255, 255, 255, 2, 255, 2]));
            assert!(refused.is_err());
            for _ in 0..2 {
                assert_eq!(one.to_bytes(), other.to_bytes());
                assert!(one.belief() == other.belief());
                one.predict();
                other.predict();
            }
        }
    }
}
