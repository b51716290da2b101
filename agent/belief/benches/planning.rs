//! Benchmarks of an agent's work in one step, at the paper's size: 64 x 64 cells, 64 moves, 3 states.
//!
//! For comparison, the authors' PyTorch code on one CPU thread takes 1.5 s for 2048 samples and 0.12 ms for a Bayes
//! update.

use criterion::{Criterion, criterion_group, criterion_main};
use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::{BayesFilter, Correlations, Estimator, SpatialFilter};
use emberwatch_belief::planning::team::{ROUNDS, plan_team};
use emberwatch_belief::planning::{
    BeamSearch, CellValues, Objective, Planner, PlanningProblem, RandomWalk, Shooting, Target,
};
use emberwatch_model::Model;
use emberwatch_model::frame::Frame;
use emberwatch_model::grid::{Cell, Shape};
use emberwatch_model::path::{Move, fly};
use emberwatch_model::randomness::split_mix;
use std::hint::black_box;

const N_MOVES: usize = 64;

fn shape() -> Shape {
    Shape::new(64, 64).expect("valid shape")
}

fn filter() -> BayesFilter {
    BayesFilter::known(&Model::wildfire(), Belief::uniform(3, shape()), false).expect("valid model")
}

/// Updates an estimator with the frames of 40 random walks, so that its belief is as uneven as in a real run.
fn settled<E: Estimator>(mut estimator: E) -> E {
    for step in 0..40 {
        advance(&mut estimator, &frame(step));
    }
    estimator
}

fn advance(estimator: &mut dyn Estimator, frame: &Frame) {
    estimator.correct(frame).expect("possible frame");
    estimator.predict();
}

fn frame(step: u64) -> Frame {
    let bits = |t: u64| split_mix(step, t) >> 62;
    let moves: Vec<Move> = (0..512).map(|t| Move::from_low_bits(bits(t))).collect();
    let mut frame = Frame::empty(shape());
    for index in fly(shape(), shape().centre(), &moves)
        .visited
        .into_iter()
        .take(N_MOVES)
    {
        frame.observe(index, (split_mix(index as u64 / 5, 0) % 3) as u8);
    }
    frame
}

fn planners(c: &mut Criterion) {
    let values: CellValues = Objective::new(Target::State(2)).values(settled(filter()).belief());
    let mut bench = |name: &str, planner: &mut dyn Planner| {
        let mut step = 0;
        c.bench_function(name, |b| {
            b.iter(|| {
                step += 1;
                planner.plan(&PlanningProblem {
                    start: Cell { row: 20, col: 30 },
                    n_moves: N_MOVES,
                    values: &values,
                    seed: 1,
                    step,
                })
            });
        });
    };
    bench("random walk", &mut RandomWalk);
    bench(
        "shooting 2048 (authors: 1.5 s)",
        &mut Shooting::new(2048, Default::default()),
    );
    bench(
        "shooting 2048, paper preset (authors: 1.5 s)",
        &mut Shooting::paper(),
    );
    for width in [50, 100, 200] {
        bench(&format!("beam search {width}"), &mut BeamSearch::new(width));
    }
}

fn teams(c: &mut Criterion) {
    let values = Objective::new(Target::State(2)).values(settled(filter()).belief());
    for n_robots in [1, 4, 8] {
        let starts: Vec<Cell> = (0..n_robots)
            .map(|robot| shape().cell(517 * robot + 100))
            .collect();
        let (mut planner, mut step) = (BeamSearch::default(), 0);
        c.bench_function(&format!("one plan for {n_robots} robots"), |b| {
            b.iter(|| {
                step += 1;
                plan_team(&mut planner, &values, &starts, N_MOVES, (1, step), ROUNDS)
            });
        });
    }
}

fn estimators(c: &mut Criterion) {
    let mut filter = settled(filter());
    let spatial = SpatialFilter::new(self::filter(), 2, Correlations::default());
    let mut spatial = settled(spatial);
    let estimators: [(&str, &mut dyn Estimator); 2] = [
        ("filter: correct + predict (authors: 120 us)", &mut filter),
        ("spatial filter: correct + predict", &mut spatial),
    ];
    let frames: Vec<Frame> = (40..104).map(frame).collect();
    for (name, estimator) in estimators {
        let mut frames = frames.iter().cycle();
        c.bench_function(name, |b| {
            b.iter(|| advance(estimator, black_box(frames.next().expect("endless"))));
        });
    }
    c.bench_function("entropy", |b| b.iter(|| filter.belief().entropy()));
}

fn predictions(c: &mut Criterion) {
    for name in [
        "wildfire-burnout",
        "wildfire-terrain",
        "wildfire-sparse",
        "crop-disease",
    ] {
        let model = Model::built_in(name).expect("bench model");
        for (cavities, suffix) in [(false, ""), (true, ", with cavities")] {
            if cavities && name == "crop-disease" {
                continue;
            }
            let prior = Belief::from_initial(&model, shape());
            let mut filter = BayesFilter::known(&model, prior, cavities).expect("valid model");
            c.bench_function(&format!("prediction of {name}{suffix}"), |b| {
                b.iter(|| filter.predict());
            });
        }
    }
}

criterion_group!(benches, planners, teams, estimators, predictions);
criterion_main!(benches);
