//! The neural belief: against candle's layers in 64 bits, on threads, through a checkpoint, and that it learns.

use crate::synthetic::rayon_pool;
use candle_core::{DType, Device, IndexOp, Tensor, Var};
use emberwatch_model::grid::Shape;
use emberwatch_model::randomness::split_mix;
use emberwatch_network::variables::{Variables, build};
use emberwatch_network::{
    Lesson, NamedTensor, NetworkError, NeuralBelief, Operators, Sightings, UNet,
};

fn numbers(tensor: &Tensor) -> Vec<f64> {
    let numbers = tensor
        .to_dtype(DType::F64)
        .and_then(|tensor| tensor.flatten_all()?.to_vec1());
    numbers.expect("numbers")
}

/// The largest difference, relative to the largest number.
fn off(got: &Tensor, expected: &Tensor) -> f64 {
    let (got, expected) = (numbers(got), numbers(expected));
    assert_eq!(got.len(), expected.len());
    let worst = got.iter().zip(&expected).map(|(a, b)| (a - b).abs());
    let largest = expected.iter().map(|number| number.abs());
    worst.fold(0.0, f64::max) / largest.fold(1e-30, f64::max)
}

/// A network in whose head no weight is zero.
fn unet(dtype: DType, operators: Operators) -> (UNet, Variables) {
    let model = |vb| UNet::new(&vb, 12, 3, operators);
    let (model, variables) = build(3, dtype, &Device::Cpu, model).expect("a network");
    let head = &variables["head.weight"];
    let numbers = (0..head.elem_count()).map(|at| (at as f32 * 0.7).sin());
    let tensor = Tensor::from_vec(numbers.collect(), head.shape(), &Device::Cpu);
    let tensor = tensor.and_then(|tensor| tensor.to_dtype(dtype));
    head.set(&tensor.expect("tensor")).expect("the same shape");
    (model, variables)
}

fn images(dtype: DType) -> Var {
    let numbers = (0..2 * 12 * 16 * 12).map(|at| (split_mix(5, at) % 100) as f32 / 100.0);
    let images = Tensor::from_vec(numbers.collect::<Vec<_>>(), (2, 12, 16, 12), &Device::Cpu);
    let images = images.and_then(|images| Var::from_tensor(&images.to_dtype(dtype)?));
    images.expect("images")
}

/// Corners, edges, the middle.
const CELLS: [[usize; 3]; 5] = [[0, 0, 0], [0, 15, 11], [1, 7, 0], [1, 8, 6], [1, 0, 11]];

#[test]
fn network_and_gradients_equal_candles_layers_in_64_bits() {
    let (ours, vars) = unet(DType::F32, Operators::Own);
    let (stock, exact) = unet(DType::F64, Operators::Stock);
    let (x, exact_x) = (images(DType::F32), images(DType::F64));
    let got = ours.logits(&x).expect("logits");
    let expected = stock.logits(&exact_x).expect("logits");
    assert_eq!(got.dims(), [2, 3, 16, 12]);
    assert!(off(&got, &expected) < 1e-5);
    let got = ours.logits_at(&x, &CELLS).expect("logits");
    let expected: Vec<_> = CELLS
        .iter()
        .map(|[image, row, col]| {
            let logits = expected.i((*image, .., *row, *col));
            logits.expect("a cell")
        })
        .collect();
    let expected = Tensor::stack(&expected, 0).expect("rows");
    assert!(off(&got, &expected) < 1e-5);
    let gradients = |logits: &Tensor| logits.sqr()?.sum_all()?.backward();
    let (got, expected) = (gradients(&got), gradients(&expected));
    let (got, expected) = (got.expect("gradients"), expected.expect("gradients"));
    for (name, var) in &vars {
        let gradients = got.get(var).zip(expected.get(&exact[name]));
        let (got, expected) = gradients.expect("a gradient of each");
        assert!(off(got, expected) < 1e-4, "{name}");
    }
}

/// What a rectangular grid shows along paths: value 1 left of a column, else 0 or 2 in turn of the steps.
fn lessons(n: u64) -> Vec<Lesson> {
    let shape = Shape::new(21, 18).expect("test shape");
    let (mut before, mut lessons) = (Sightings::new(shape), Vec::new());
    for step in 0..n {
        let cells =
            (0..shape.n_cells() as u64).filter(|cell| split_mix(step, *cell).is_multiple_of(12));
        let value = |cell: usize| {
            if cell % 18 < 9 {
                1
            } else {
                (step % 2) as u8 * 2
            }
        };
        let frame: Vec<_> = cells
            .map(|cell| (cell as usize, value(cell as usize)))
            .collect();
        lessons.push(Lesson {
            before: before.clone(),
            frame: frame.clone(),
            base: Vec::new(),
        });
        for (cell, value) in frame {
            before.see_cell(cell, value);
        }
        before.pass();
    }
    lessons
}

fn neural() -> NeuralBelief {
    NeuralBelief::new(3, 5, &Device::Cpu).expect("a network")
}

fn tensors(network: &NeuralBelief) -> Vec<NamedTensor> {
    network.named_tensors().expect("tensors")
}

#[test]
fn one_and_more_threads_give_the_same_bits_and_so_does_a_resume() {
    let lessons = lessons(30);
    let learn = |network: &mut NeuralBelief| {
        let losses = lessons.chunks(10).map(|batch| network.update(2e-3, batch));
        let losses: Vec<f64> = losses.map(|loss| loss.expect("finite")).collect();
        let belief = network
            .predict(&lessons[20].before, None)
            .expect("a belief");
        (losses, belief, tensors(network))
    };
    let on = |n_threads| rayon_pool(n_threads).install(|| learn(&mut neural()));
    let one = on(1);
    assert!(one == on(2) && one == on(5));
    let mut network = neural();
    learn(&mut network);
    let saved = tensors(&network);
    let mut resumed = NeuralBelief::new(3, 6, &Device::Cpu).expect("a network");
    assert_ne!(tensors(&resumed), saved);
    let find = |name: &str, shape: &[usize]| {
        let found = saved.iter().find(|(saved, ..)| saved == name);
        let (_, of, numbers) = found.expect("saved");
        assert_eq!(of, shape);
        Ok::<_, NetworkError>(numbers.clone())
    };
    resumed.load(find, network.n_updates()).expect("whole");
    assert!(learn(&mut resumed) == learn(&mut network));
}

/// A network of candle's operators, as a GPU uses them.
fn on_a_device() -> NeuralBelief {
    let network = NeuralBelief::with_operators(3, 5, &Device::Cpu, Operators::Stock);
    network.expect("a network")
}

/// Distributions of another, which the network corrects.
fn with_bases(mut lessons: Vec<Lesson>) -> Vec<Lesson> {
    for lesson in &mut lessons {
        let base = lesson.frame.iter().flat_map(|(cell, _)| base_of(*cell));
        lesson.base = base.collect();
    }
    lessons
}

fn base_of(cell: usize) -> [f32; 3] {
    if cell.is_multiple_of(3) {
        [0.1, 0.8, 0.1]
    } else {
        [0.6, 0.3, 0.1]
    }
}

#[test]
fn what_a_device_computes_is_what_we_compute() {
    for lessons in [lessons(40), with_bases(lessons(40))] {
        let (mut ours, mut other) = (neural(), on_a_device());
        for batch in lessons.chunks(10) {
            let losses = [&ours, &other].map(|network| network.loss(batch).expect("a loss"));
            assert!(off(&losses[1], &losses[0]) < 1e-5);
            let gradients = losses.map(|loss| loss.backward().expect("gradients"));
            for (name, var) in ours.variables() {
                let of_ours = gradients[0].get(var).expect("a gradient");
                let of_other = gradients[1].get(&other.variables()[name]);
                let error = off(of_other.expect("a gradient"), of_ours);
                assert!(error < 1e-4, "gradient of {name}: off by {error}");
            }
            let losses = [&mut ours, &mut other].map(|network| network.update(2e-3, batch));
            let [got, expected] = losses.map(|loss| loss.expect("finite"));
            assert!((got - expected).abs() < 1e-5, "{got} {expected}");
            // Where a gradient is almost zero, Adam still takes a step of its full rate, in a direction set by rounding.
            for (name, var) in ours.variables() {
                let moved = (var.as_tensor() - other.variables()[name].as_tensor())
                    .and_then(|moved| moved.abs()?.mean_all()?.to_scalar::<f32>());
                let moved = moved.expect("a number");
                assert!(moved < 2e-5, "{name}: {moved}");
            }
        }
    }
}

#[test]
fn worlds_are_predicted_together_as_each_alone() {
    let (mut ours, mut other) = (neural(), on_a_device());
    let lessons = lessons(30);
    for network in [&mut ours, &mut other] {
        network.update(2e-2, &lessons[..10]).expect("finite");
    }
    let base =
        ndarray::Array3::from_shape_fn((3, 21, 18), |(y, row, col)| base_of(row * 18 + col)[y]);
    for base in [None, Some(&base)] {
        let worlds: Vec<_> = lessons.iter().map(|it| (&it.before, base)).collect();
        let all = ours.predict_all(&worlds).expect("beliefs");
        let of_other = other.predict_all(&worlds).expect("beliefs");
        for ((sightings, base), (got, of_other)) in worlds.iter().zip(all.iter().zip(&of_other)) {
            assert!(*got == ours.predict(sightings, *base).expect("a belief"));
            let differences = got.iter().zip(of_other).map(|(a, b)| (a - b).abs());
            assert!(differences.fold(0.0, f32::max) < 1e-4);
        }
    }
    assert!(ours.predict_all(&[]).expect("none").is_empty());
}

#[test]
fn it_learns_where_what_is_seen() {
    let (mut network, lessons) = (neural(), lessons(60));
    let loss = |network: &NeuralBelief| {
        let loss = network.loss(&lessons[50..]).expect("a loss");
        numbers(&loss)[0]
    };
    assert!(
        (loss(&network) - 3_f64.ln()).abs() < 1e-6,
        "all alike at first"
    );
    for update in 0..150 {
        let batch = &lessons[update % 40..][..10];
        network.update(5e-3, batch).expect("finite");
    }
    // Half of the cells always show 1, the others one of two values: ln 2 / 2 if nothing else is known.
    assert!(loss(&network) < 0.4, "{}", loss(&network));
    let belief = network
        .predict(&lessons[50].before, None)
        .expect("a belief");
    assert_eq!(belief.dim(), (3, 21, 18));
    assert!(belief.iter().all(|p| (1e-7..=1.0).contains(p)));
    let sums = belief.sum_axis(ndarray::Axis(0));
    assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 1e-5));
}

#[test]
fn it_corrects_the_distributions_of_another() {
    let (mut network, mut lessons) = (neural(), lessons(60));
    // Knows all but which of the two values: that the steps tell.
    let base = |cell: usize| {
        if cell % 18 < 9 {
            [0.1, 0.8, 0.1]
        } else {
            [0.45, 0.1, 0.45]
        }
    };
    for lesson in &mut lessons {
        lesson.base = lesson.frame.iter().flat_map(|it| base(it.0)).collect();
    }
    let loss = |network: &NeuralBelief| numbers(&network.loss(&lessons[50..]).expect("a loss"))[0];
    let of_last = lessons[50..].iter().flat_map(|lesson| &lesson.frame);
    let (mut sum, mut n) = (0.0, 0.0);
    for (cell, value) in of_last {
        sum -= f64::from(base(*cell)[usize::from(*value)]).ln();
        n += 1.0;
    }
    let difference = loss(&network) - sum / n;
    assert!(
        difference.abs() < 1e-5,
        "as the other at first: {difference}"
    );
    let of_cells = ndarray::Array3::from_shape_fn((3, 21, 18), |(y, _, col)| base(col)[y]);
    let belief = network.predict(&lessons[50].before, Some(&of_cells));
    let belief = belief.expect("a belief");
    let differences = belief.iter().zip(&of_cells).map(|(a, b)| (a - b).abs());
    assert!(differences.fold(0.0, f32::max) < 1e-5);
    for update in 0..100 {
        let batch = &lessons[update % 40..][..10];
        network.update(5e-3, batch).expect("finite");
    }
    assert!(loss(&network) < 0.4, "{}", loss(&network));
}

#[test]
fn numbers_that_are_not_finite_are_named_and_change_nothing() {
    let mut network = neural();
    let var = &network.variables()["wide.bias"];
    var.set(&Tensor::full(f32::NAN, var.shape(), &Device::Cpu).expect("numbers"))
        .expect("the same shape");
    let first = |network: &NeuralBelief| numbers(&network.variables()["full.weight"]);
    let before = first(&network);
    let error = network.update(1e-3, &lessons(2)).expect_err("a NaN");
    assert!(error.to_string().ends_with("in wide.bias"), "{error}");
    assert_eq!((first(&network), network.n_updates()), (before, 0));
}
