//! Comparison with results of the unmodified PyTorch code of the paper's authors (torch 2.15.0, CPU, one thread).
//!
//! The authors' beliefs have shape `[H, W, S]`, and so do the arrays in `data/`. The files are uncompressed copies of
//! the originals, because `ndarray-npy` then needs no codec:
//!
//! ```python
//! for name in "a3_bayes", "a4_masked_small", "a5_planner":
//!     z = np.load(f"golden/{name}.npz")
//!     np.savez(f"{name}.npz", **{k: z[k] for k in z.files if z[k].dtype.kind != "U"})
//! ```

#[path = "../../network/tests/network/golden_file.rs"]
mod golden_file;

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::{BayesFilter, Estimator};
use emberwatch_belief::planning::{Integration, Objective, Target};
use emberwatch_model::Model;
use emberwatch_model::grid::{Cell, Shape};
use emberwatch_model::path::Move;
use golden_file::{Golden, frame_from};
use ndarray::{Array1, Array2, Array3, Array4, ArrayView3, Axis};

fn shape_of(dim: (usize, usize)) -> Shape {
    Shape::new(dim.0, dim.1).expect("test shape")
}

/// Converts an array `[H, W, S]` to a belief.
fn belief_from(channels_last: ArrayView3<'_, f32>) -> Belief {
    let planes = channels_last.permuted_axes([2, 0, 1]);
    Belief::from_probabilities(planes.to_owned()).expect("on the simplex")
}

fn assert_close(belief: &Belief, channels_last: ArrayView3<'_, f32>, what: &str) {
    let off = &belief.view() - &channels_last.permuted_axes([2, 0, 1]);
    let worst = off.iter().fold(0.0_f32, |worst, d| worst.max(d.abs()));
    assert!(worst < 1e-6, "{what}: off by {worst}");
}

/// Case A3: every cell is observed, starting from `u_0 = 1/3`. The reference calls the predictor `u_{k+1}` its
/// estimate.
#[test]
fn the_filter_reproduces_posterior_and_predictor() {
    let mut golden = Golden::open("a3_bayes");
    for case in ["2x2", "3x3", "7x4", "64x64"] {
        let observations: Array3<u8> = golden.get(&format!("{case}_obs"));
        let saved: Array1<i64> = golden.get(&format!("{case}_saved_steps"));
        let posteriors: Array4<f32> = golden.get(&format!("{case}_posterior"));
        let predictors: Array4<f32> = golden.get(&format!("{case}_estimate"));
        let (_, height, width) = observations.dim();
        let prior = Belief::uniform(3, shape_of((height, width)));
        let mut filter = BayesFilter::known(&Model::wildfire(), prior, false).expect("valid model");
        let everything = Array2::from_elem((height, width), 1);
        for (step, observed) in observations.outer_iter().enumerate() {
            let index = saved.iter().position(|&at| at == step as i64);
            let check = |belief: &Belief, all: &Array4<f32>| {
                if let Some(index) = index {
                    let expected = all.index_axis(Axis(0), index);
                    assert_close(belief, expected, &format!("{case} step {step}"));
                }
            };
            let frame = frame_from(observed, everything.view());
            filter.correct(&frame).expect("possible frame");
            check(filter.belief(), &posteriors);
            filter.predict();
            check(filter.belief(), &predictors);
        }
    }
}

/// Case A4 without the network: Bayes' rule on visited cells only, with the likelihood that the reference's network
/// learned. Its weights have shape `[O, S]`, and the softmax is over observations.
#[test]
fn the_masked_posterior_agrees() {
    let mut small = Golden::open("a4_masked_small");
    let mut cases = Vec::from(["3x3", "4x6"].map(|case| {
        let weights: Array2<f32> = small.get(&format!("{case}_W"));
        let prior: Array3<f32> = small.get(&format!("{case}_u"));
        let observations: Array2<u8> = small.get(&format!("{case}_obs"));
        let mask: Array2<u8> = small.get(&format!("{case}_mask"));
        let posterior: Array3<f32> = small.get(&format!("{case}_state_est"));
        (case, weights, prior, observations, mask, posterior)
    }));
    let mut large = Golden::open("../../../network/tests/data/a4_masked_step");
    let first = |steps: Array3<u8>| steps.index_axis_move(Axis(0), 0);
    let (observations, mask) = (first(large.get("obs")), first(large.get("mask")));
    let posteriors: Array4<f32> = large.get("state_est");
    let posterior = posteriors.index_axis_move(Axis(0), 0);
    let (weights, prior) = (large.get("W_obs_param"), large.get("u0"));
    cases.push(("64x64", weights, prior, observations, mask, posterior));
    for (case, weights, prior, observations, mask, posterior) in cases {
        let mut file = Model::wildfire().file().clone();
        for (state, column) in file.states.iter_mut().zip(weights.columns()) {
            let exponentials = column.mapv(|w| f64::from(w).exp());
            state.observed_as = (&exponentials / exponentials.sum()).to_vec();
        }
        let model = Model::new(file).expect("a softmax is a distribution");
        let prior = belief_from(prior.view());
        let mut filter = BayesFilter::known(&model, prior, false).expect("valid model");
        let frame = frame_from(observations.view(), mask.view());
        filter.correct(&frame).expect("possible frame");
        assert_close(filter.belief(), posterior.view(), case);
    }
}

/// Returns the objective for an action of one of the reference's planner types. The last action stands for entropy.
fn objective(planner_type: usize, action: usize) -> Objective {
    const DEFAULT: usize = 0;
    const RANDOM: usize = 1; // number of distinct cells, whatever the action
    Objective::paper(match planner_type {
        DEFAULT if action < 3 => Target::State(action),
        RANDOM => Target::Coverage,
        // Planner type "Default" with action 3, and "VisitingGrayArea" with any action.
        _ => Target::Entropy,
    })
}

/// Case A5: scores of every sample for three planner types and four actions, and the winners. The reference clamps the
/// sums of the sampled moves. The test converts them to moves by which our robot visits the same cells.
///
/// The reference writes the visit mask at `[position[1], position[0]]`. The second coordinate of a position is
/// therefore the row, and the basis (1,0), (-1,0), (0,1), (0,-1) is right, left, down, up. The reference's environment
/// receives the same mask, so only the names of the axes are swapped.
///
/// With a zero probability, the reference's entropy is `0 * log 0 = NaN`. The reference multiplies the whole grid by
/// the visit mask, so the score of every path is NaN, and `torch.argmax` returns the first NaN. Our entropy is 0 there.
/// Case p3 checks that the reference has NaN exactly in this situation.
///
/// Summing up to 64 numbers between 1 and 2 in a different order changes the result by up to 64 rounding errors of a
/// number near 128. The difference is 5e-4 in the worst case, and below 5e-5 in these data. If the reference's best two
/// scores differ by less, either may win.
#[test]
fn path_scores_and_winners_agree() {
    const TOLERANCE: f32 = 5e-5;
    let basis = [Move::Right, Move::Left, Move::Down, Move::Up];
    let mut golden = Golden::open("a5_planner");
    for name in [
        "p1_6x6_hand_start00",
        "p2_6x6_hand_start53",
        "p3_6x6_zero_prob",
        "p4_64x64_n64",
        "p5_8x8_n40_T64",
        "p7_64x64_n256_bayes",
    ] {
        let belief: Array3<f32> = golden.get(&format!("{name}_belief"));
        let start: Array1<i64> = golden.get(&format!("{name}_start"));
        let samples: Array2<u8> = golden.get(&format!("{name}_moves"));
        let scores: Array3<f32> = golden.get(&format!("{name}_scores"));
        let winners: Array2<i64> = golden.get(&format!("{name}_argmax"));
        let shape = shape_of((belief.dim().0, belief.dim().1));
        let (row, col) = (start[1] as usize, start[0] as usize);
        let start = Cell { row, col };
        let paths = samples.outer_iter().map(|sample| {
            let sampled: Vec<Move> = sample.iter().map(|&m| basis[usize::from(m)]).collect();
            Integration::ClampSum.as_flown(shape, start, &sampled)
        });
        let paths: Vec<Vec<Move>> = paths.collect();
        let has_zero = belief.iter().any(|&p| p == 0.0);
        let belief = belief_from(belief.view());
        for (planner_type, action) in (0..3).flat_map(|p| (0..4).map(move |a| (p, a))) {
            let what = format!("{name} planner type {planner_type} action {action}");
            let objective = objective(planner_type, action);
            let values = objective.values(&belief);
            let ours: Vec<f32> = paths.iter().map(|it| values.score(start, it)).collect();
            let theirs = scores.slice(ndarray::s![planner_type, action, ..]);
            let winner = winners[[planner_type, action]] as usize;
            if has_zero && objective.target == Target::Entropy {
                assert!(theirs.iter().all(|score| score.is_nan()), "{what}");
                assert_eq!(winner, 0, "{what}: the first NaN");
                continue;
            }
            for (sample, (a, b)) in ours.iter().zip(theirs).enumerate() {
                assert!((a - b).abs() < TOLERANCE, "{what} {sample}: {a}, not {b}");
            }
            let best = ours.iter().copied().fold(f32::MIN, f32::max);
            assert!(best - ours[winner] < TOLERANCE, "{what}");
        }
    }
}
