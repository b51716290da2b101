//! Measures one transition of a world, and one prediction of a belief by the paper's rule, on one core.
//!
//! For comparison: the authors' PyTorch environment takes 1.1 ms for one 64 x 64 step on one CPU thread.
//!
//! `cargo bench -p emberwatch-model --bench transition -- --warm-up-time 0.5 --measurement-time 1`

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use emberwatch_model::{Dynamics, Model, Probabilities, Shape, Transition};

/// Number of steps before the measurement, after which all three states form clusters, as in a typical world.
const BURN_IN: u64 = 2_000;

fn square(side: usize) -> Shape {
    Shape::new(side, side).expect("bench shape")
}

/// Returns the default model and models of hazards. For 64 x 64 cells, also returns one with maps.
fn models(side: usize) -> impl Iterator<Item = (Model, &'static str)> {
    let named = |name| Model::built_in(name).expect("bench model");
    let all = [
        (Model::wildfire(), ""),
        (named("wildfire-burnout"), "_burnout"),
        (named("crop-disease"), "_crop_disease"),
        (named("wildfire-terrain"), "_terrain"),
    ];
    all.into_iter().take(if side == 64 { 4 } else { 3 })
}

fn product<const N: usize>(
    sides: [usize; N],
) -> impl Iterator<Item = (usize, (Model, &'static str))> {
    let with_models = |side| models(side).map(move |model| (side, model));
    sides.into_iter().flat_map(with_models)
}

fn dynamics_step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("dynamics_step");
    for (side, (model, suffix)) in product([64, 256, 1024]) {
        let shape = square(side);
        let mut dynamics = Dynamics::new(&model, shape).expect("bench model");
        let mut states = dynamics.initial(1);
        let burn_in = if side > 256 { BURN_IN / 10 } else { BURN_IN };
        (0..burn_in).for_each(|n| dynamics.step(1, n, &mut states));
        let mut n = burn_in;
        group.throughput(Throughput::Elements(shape.n_cells() as u64));
        group.bench_function(format!("{side}{suffix}"), |bencher| {
            bencher.iter(|| {
                dynamics.step(1, n, &mut states);
                n += 1;
            });
        });
    }
    group.finish();
}

fn transition_apply(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("transition_apply");
    let model = Model::wildfire();
    let ratio = model.ratio().expect("a kernel");
    for side in [64, 256] {
        let bias = ratio.bias().to_vec();
        let mut transition = Transition::new(ratio.kernel(), &bias, None, square(side));
        let mut belief = Probabilities::from_elem((3, side, side), 1.0 / 3.0);
        let mut predictor = belief.clone();
        group.throughput(Throughput::Elements((side * side) as u64));
        group.bench_function(side.to_string(), |bencher| {
            bencher.iter(|| {
                transition.apply(&belief, &mut predictor);
                std::mem::swap(&mut belief, &mut predictor);
            });
        });
    }
    group.finish();
}

criterion_group!(benches, dynamics_step, transition_apply);
criterion_main!(benches);
