//! Planners of one robot, options and filters.

use super::fields::{Field, fields, objectives, paths};
use emberwatch_belief::Belief;
use emberwatch_belief::estimation::{BayesFilter, Estimator};
use emberwatch_belief::planning::{
    Ahead, BeamSearch, CellValues, Integration, Memory, Objective, OptionPlanner, Outlook, Plan,
    Planner, PlanningProblem, RandomWalk, Shooting, Target,
};
use emberwatch_model::frame::{Frame, UNOBSERVED};
use emberwatch_model::path::fly;
use emberwatch_model::randomness::{Purpose, split_mix, stream};
use emberwatch_model::{Airspace, Cell, Grid, Model, Move, Probabilities, Shape};
use proptest::prelude::*;
use rand_chacha::rand_core::Rng;

/// The score from `emberwatch_model::path::fly`, whose flight says nothing of revisits.
fn score_of_flight(values: &CellValues, start: Cell, moves: &[Move]) -> f32 {
    let shape = values.shape();
    let worth = |cell: Cell| values.value()[[cell.row, cell.col]];
    let visited = fly(shape, start, moves).visited;
    let bonus = values.coverage_bonus() * visited.len() as f32;
    if values.revisits() {
        let ends = (1..=moves.len()).map(|n| fly(shape, start, &moves[..n]).end);
        return bonus + ends.map(worth).sum::<f32>();
    }
    bonus
        + visited
            .into_iter()
            .map(|index| worth(shape.cell(index)))
            .sum::<f32>()
}

fn planners() -> [Box<dyn Planner>; 6] {
    [
        Box::new(RandomWalk),
        Box::new(Shooting::new(20, Integration::ClampEachMove)),
        Box::new(Shooting::new(20, Integration::ClampSum)),
        Box::new(BeamSearch::new(1)),
        Box::new(BeamSearch::new(20)),
        Box::new(Ahead::new(20)),
    ]
}

fn assert_close(a: f32, b: f32) {
    assert!(
        (a - b).abs() <= 1e-5 * b.abs().max(1.0),
        "{a}, expected {b}"
    );
}

/// A belief of random numbers on a grid of random sides, and a robot on it.
fn beliefs(n_states: usize) -> impl Strategy<Value = (Belief, Cell, usize)> {
    let sides = (1..=20_usize, 1..=20_usize);
    let sized = sides.prop_flat_map(|(height, width)| {
        let robot = (0..height, 0..width);
        (Just((height, width)), robot, 0..=30_usize, any::<u64>())
    });
    sized.prop_map(move |((height, width), (row, col), n_moves, seed)| {
        let numbers = Probabilities::from_shape_fn((n_states, height, width), |(m, row, col)| {
            let index = (m * height + row) * width + col;
            (split_mix(seed, index as u64) % 4) as f32 + if m == 0 { 0.5 } else { 0.0 }
        });
        let sums = numbers.sum_axis(ndarray::Axis(0));
        let belief = Belief::from_probabilities(numbers / &sums).expect("on the simplex");
        (belief, Cell { row, col }, n_moves)
    })
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

    #[test]
    fn options_are_planned_on_every_grid_with_features_of_their_size(
        (belief, robot, n_moves) in (1..5_usize).prop_flat_map(beliefs),
    ) {
        let n_moves = n_moves.max(1);
        let memory = Memory::new(belief.shape());
        let outlook = {
            let airspace = Airspace::open(belief.shape());
            Outlook::new(&belief, &airspace, belief.n_states() - 1, &memory, n_moves)
        };
        for proposal in OptionPlanner::new(4).propose(&outlook, robot) {
            prop_assert_eq!(proposal.plan.moves.len(), n_moves);
            prop_assert!(proposal.features.iter().all(|number| (0.0..=10.0).contains(number)));
        }
    }

    #[test]
    fn a_plan_has_its_moves_and_the_score_it_reports(
        field in fields(12, 40, 1),
        objective in objectives(),
    ) {
        let values = objective.values(&field.belief);
        for mut planner in planners() {
            let plan = planner.plan(&field.problem(&values));
            prop_assert_eq!(plan.moves.len(), field.n_moves);
            assert_close(plan.score, score_of_flight(&values, field.starts[0], &plan.moves));
            assert_close(values.score(field.starts[0], &plan.moves), plan.score);
        }
    }

    #[test]
    fn a_plan_depends_on_nothing_but_the_problem(
        field in fields(12, 40, 1),
        other in fields(20, 70, 1),
    ) {
        let (values, other_values) = (field.values(), other.values());
        for (mut used, mut fresh) in planners().into_iter().zip(planners()) {
            used.plan(&other.problem(&other_values));
            let problem = field.problem(&values);
            prop_assert_eq!(used.plan(&problem), fresh.plan(&problem));
        }
    }

    #[test]
    fn a_beam_of_one_is_a_greedy_walk(field in fields(12, 40, 1), objective in objectives()) {
        let values = objective.values(&field.belief);
        let moves = BeamSearch::new(1).plan(&field.problem(&values)).moves;
        for t in 0..moves.len() {
            let with = |step: Move| {
                let path: Vec<Move> = moves[..t].iter().copied().chain([step]).collect();
                values.score(field.starts[0], &path)
            };
            let most = Move::ALL.map(with).into_iter().fold(f32::NEG_INFINITY, f32::max);
            prop_assert_eq!(with(moves[t]), most);
        }
    }

    #[test]
    fn beam_search_is_never_worse_than_greedy(field in fields(12, 40, 1)) {
        let values = field.values();
        let problem = field.problem(&values);
        let greedy = BeamSearch::new(1).plan(&problem).score;
        for width in [2, 3, 10] {
            prop_assert!(BeamSearch::new(width).plan(&problem).score >= greedy);
        }
    }

    #[test]
    fn a_wide_beam_finds_the_best_path(field in fields(4, 6, 1), objective in objectives()) {
        let values = objective.values(&field.belief);
        // 4^6 = 4096 paths: the beam holds them all.
        let plan = BeamSearch::new(4096).plan(&field.problem(&values));
        let scores = paths(field.n_moves).into_iter().map(|path| values.score(field.starts[0], &path));
        assert_close(plan.score, scores.fold(f32::NEG_INFINITY, f32::max));
    }

    #[test]
    fn shooting_finds_the_first_of_its_best_samples(field in fields(8, 70, 1)) {
        // Numbers of cells have no rounding and many ties.
        let values = Objective::new(Target::Coverage).values(&field.belief);
        let (problem, shape) = (field.problem(&values), values.shape());
        for integration in [Integration::ClampEachMove, Integration::ClampSum] {
            let mut rng = stream(problem.seed, Purpose::Planner, problem.step);
            let n_words = field.n_moves.div_ceil(32);
            let samples = (0..30).map(|_| {
                let words: Vec<u64> = (0..n_words).map(|_| rng.next_u64()).collect();
                let bits = |t: usize| words[t / 32] >> (2 * (t % 32));
                let sampled = (0..field.n_moves).map(|t| Move::from_low_bits(bits(t)));
                integration.as_flown(shape, field.starts[0], &sampled.collect::<Vec<_>>())
            });
            let score = |moves: &Vec<Move>| values.score(field.starts[0], moves);
            let better = |a: Vec<Move>, b| if score(&b) > score(&a) { b } else { a };
            let first_best = samples.reduce(better).expect("30 samples");
            prop_assert_eq!(Shooting::new(30, integration).plan(&problem).moves, first_best);
        }
    }

    #[test]
    fn correct_stays_on_the_simplex(
        field in fields(6, 0, 1),
        steps in prop::collection::vec(prop::collection::vec(0..6_u8, 36), 1..20),
    ) {
        let shape = field.belief.shape();
        let prior = Belief::uniform(3, shape);
        let mut filter = BayesFilter::known(&Model::wildfire(), prior).expect("valid model");
        for values in steps {
            let values = values.iter().take(shape.n_cells());
            let bytes: Vec<u8> = values.map(|&v| if v < 3 { v } else { UNOBSERVED }).collect();
            let frame = Frame::from_bytes(shape, 3, &bytes).expect("valid frame");
            filter.correct(&frame).expect("no probability is zero");
            let posterior = filter.belief().view().to_owned();
            prop_assert!(Belief::from_probabilities(posterior).is_ok());
            filter.predict();
            let predictor = filter.belief().view().to_owned();
            prop_assert!(Belief::from_probabilities(predictor).is_ok());
        }
    }
}

/// 60 problems of the paper's size, planned with one planner.
fn scores(mut planner: impl Planner) -> Vec<f32> {
    let shape = Shape::new(64, 64).expect("valid sides");
    let score = |seed| {
        let field = Field::new(shape, vec![shape.cell(seed as usize * 67)], 64, seed);
        planner.plan(&field.problem(&field.values())).score
    };
    (0..60).map(score).collect()
}

/// Mean of `a - b`, in standard errors.
fn paired_t(a: &[f32], b: &[f32]) -> f32 {
    let n = a.len() as f32;
    let differences: Vec<f32> = a.iter().zip(b).map(|(a, b)| a - b).collect();
    let mean = differences.iter().sum::<f32>() / n;
    let variance = differences.iter().map(|d| (d - mean).powi(2)).sum::<f32>() / (n - 1.0);
    mean / (variance / n).sqrt()
}

#[test]
fn a_wider_beam_is_better_on_average_and_shooting_worse() {
    let [narrow, middle, wide] = [2, 8, 80].map(|width| scores(BeamSearch::new(width)));
    let shooting = scores(Shooting::new(2048, Integration::ClampEachMove));
    assert!(paired_t(&middle, &narrow) > 3.0);
    assert!(paired_t(&wide, &middle) > 3.0);
    assert!(paired_t(&narrow, &shooting) > 3.0);
}

#[test]
fn each_step_has_its_own_random_numbers() {
    let shape = Shape::new(9, 9).expect("valid sides");
    let field = Field::new(shape, vec![shape.centre()], 30, 1);
    let values = field.values();
    let plan = |step| -> Plan {
        RandomWalk.plan(&PlanningProblem {
            step,
            ..field.problem(&values)
        })
    };
    assert_ne!(plan(0), plan(1));
}

#[test]
fn the_cost_of_a_plan_does_not_grow_with_the_grid() {
    // A corner of a large grid and the same corner cut out: T = 10 moves see no difference.
    let (small, large) = (Shape::new(11, 11), Shape::new(900, 800));
    let (small, large) = (small.expect("valid sides"), large.expect("valid sides"));
    let start = Cell { row: 0, col: 0 };
    let plan = |shape| {
        let belief = Belief::uniform(2, shape);
        let values = Objective::paper(Target::Entropy).values(&belief);
        let field = Field {
            belief,
            starts: vec![start],
            n_moves: 10,
        };
        BeamSearch::new(30).plan(&field.problem(&values))
    };
    assert_eq!(plan(small), plan(large));
}

#[test]
fn a_plan_of_several_paths_sets_out_for_what_one_cannot_reach() {
    let shape = Shape::new(16, 8).expect("valid sides");
    let mut states = Grid::zeros(shape.dim());
    states[[15, 0]] = 1;
    let field = Field {
        belief: Belief::from_states(&states, 2).expect("valid states"),
        starts: vec![Cell { row: 0, col: 0 }],
        n_moves: 4,
    };
    let values = Objective::new(Target::State(1)).values(&field.belief);
    let plan = Ahead::new(50).plan(&field.problem(&values));
    assert_eq!((plan.moves, plan.score), (vec![Move::Down; 4], 0.0));
}
