//! Tests of the neural belief: comparison with candle's layers, threads, checkpoints and learning.

use crate::synthetic::{find, numbers, rayon_pool, relative};
use candle_core::{Device, Tensor};
use emberwatch_model::grid::Shape;
use emberwatch_model::randomness::split_mix;
use emberwatch_network::{Lesson, NamedTensor, NeuralBelief, Operators, Sightings};
use ndarray::{Array3, Axis};

/// Creates lessons on a grid whose sides the network must pad. Cells in the left half show 1. The other cells show 0
/// and 2 in alternate steps.
fn lessons(n: u64) -> Vec<Lesson> {
    lessons_on(Shape::new(21, 18).expect("test shape"), n)
}

fn lessons_on(shape: Shape, n: u64) -> Vec<Lesson> {
    let (mut before, mut lessons) = (Sightings::new(shape), Vec::new());
    for step in 0..n {
        let cells =
            (0..shape.n_cells()).filter(|&cell| split_mix(step, cell as u64).is_multiple_of(12));
        let other = (step % 2) as u8 * 2;
        let frame: Vec<_> = cells
            .map(|it| (it, if it % 18 < 9 { 1 } else { other }))
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
    let find = |name: &str, dims: &[usize]| find(&saved, name, dims);
    resumed.load(find, network.n_updates()).expect("whole");
    assert!(learn(&mut resumed) == learn(&mut network));
}

/// Creates a network with candle's operators, which a GPU would use.
fn on_a_device() -> NeuralBelief {
    let network = NeuralBelief::with_operators(3, 5, &Device::Cpu, Operators::Stock);
    network.expect("a network")
}

/// Returns a base distribution. In the right half of the grid, two values are equally probable, because the value that
/// a cell shows depends on the step.
fn base_of(cell: usize) -> [f32; 3] {
    if cell % 18 < 9 {
        [0.1, 0.8, 0.1]
    } else {
        [0.45, 0.1, 0.45]
    }
}

fn base() -> Array3<f32> {
    Array3::from_shape_fn((3, 21, 18), |(y, row, col)| base_of(row * 18 + col)[y])
}

/// Adds the base distribution to lessons.
fn with_bases(mut lessons: Vec<Lesson>) -> Vec<Lesson> {
    for lesson in &mut lessons {
        lesson.base = lesson.frame.iter().flat_map(|it| base_of(it.0)).collect();
    }
    lessons
}

#[test]
fn what_a_device_computes_is_what_we_compute() {
    let (ours, other) = (neural(), on_a_device());
    for network in [&ours, &other] {
        // The initial weights of the head are 0, which would hide the gradients of other layers.
        let head = &network.variables()["head.weight"];
        let numbers = (0..head.elem_count()).map(|at| (at as f32 * 0.7).sin());
        let tensor = Tensor::from_vec(numbers.collect(), head.shape(), &Device::Cpu);
        head.set(&tensor.expect("tensor")).expect("the same shape");
    }
    // The network does not pad this grid, so its last rows and columns are at the border of the images.
    let whole = lessons_on(Shape::new(24, 16).expect("test shape"), 20);
    for lessons in [whole, lessons(20), with_bases(lessons(20))] {
        let losses = [&ours, &other].map(|network| network.loss(&lessons).expect("a loss"));
        let [expected, got] = losses.each_ref().map(numbers);
        assert!(relative(&got, &expected) < 1e-5);
        let gradients = losses.map(|loss| loss.backward().expect("gradients"));
        for (name, var) in ours.variables() {
            let of_ours = gradients[0].get(var).expect("a gradient");
            let of_other = gradients[1].get(&other.variables()[name]);
            let error = relative(&numbers(of_other.expect("a gradient")), &numbers(of_ours));
            assert!(error < 1e-4, "gradient of {name}: off by {error}");
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
    let base = base();
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

/// Trains on 50 lessons, and checks the loss of the last 10 before and after.
fn check_learning(lessons: &[Lesson], base: Option<&Array3<f32>>, at_first: f64, n_updates: usize) {
    let mut network = neural();
    let last = &lessons[50..];
    let loss = |network: &NeuralBelief| numbers(&network.loss(last).expect("a loss"))[0];
    let belief = |network: &NeuralBelief| {
        let belief = network.predict(&lessons[50].before, base);
        belief.expect("a belief")
    };
    let difference = loss(&network) - at_first;
    assert!(difference.abs() < 1e-5, "at first {difference}");
    if let Some(base) = base {
        let differences = (&belief(&network) - base).mapv(f32::abs);
        assert!(differences.fold(0.0, |worst: f32, d| worst.max(*d)) < 1e-5);
    }
    for update in 0..n_updates {
        let batch = &lessons[update % 40..][..10];
        network.update(5e-3, batch).expect("finite");
    }
    // Half of the cells always show 1, and the others show one of two values. The best loss of a network that ignores
    // the step is `ln(2) / 2`.
    assert!(loss(&network) < 0.4, "{}", loss(&network));
    let belief = belief(&network);
    assert!(belief.iter().all(|p| (1e-7..=1.0).contains(p)));
    let sums = belief.sum_axis(Axis(0));
    assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 1e-5));
}

#[test]
fn it_learns_alone() {
    check_learning(&lessons(60), None, 3_f64.ln(), 150);
}

#[test]
fn it_corrects_the_distributions_of_another() {
    let lessons = with_bases(lessons(60));
    let seen = || lessons[50..].iter().flat_map(|lesson| &lesson.frame);
    let loss_at = |&(cell, value): &(usize, u8)| -f64::from(base_of(cell)[usize::from(value)]).ln();
    let of_base = seen().map(loss_at).sum::<f64>() / seen().count() as f64;
    check_learning(&lessons, Some(&base()), of_base, 100);
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
    assert!(
        error.to_string().ends_with("in wide.bias after the update"),
        "{error}"
    );
    assert_eq!((first(&network), network.n_updates()), (before, 0));
}
