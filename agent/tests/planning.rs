//! What holds for every planner, filter and summary, on random problems.

use agent::estimation::BayesFilter;
use agent::estimation::belief::Belief;
use agent::estimation::summary::{N_BLOCKS, summarise, summary_length};
use agent::planning::{
    BeamSearch, CellValues, Integration, Objective, Plan, Planner, PlanningProblem, RandomWalk,
    Shooting, Target,
};
use proptest::prelude::*;
use protocol::frame::{Frame, UNOBSERVED};
use protocol::grid::{Cell, Probabilities, Shape};
use protocol::model::Model;
use protocol::path::{Move, fly};
use protocol::randomness::{Purpose, split_mix, stream};
use rand_chacha::rand_core::Rng;

/// A grid of random values in `0..1`, and where the robot starts.
#[derive(Debug, Clone)]
struct Field {
    belief: Belief,
    start: Cell,
    n_moves: usize,
}

impl Field {
    fn new(shape: Shape, start: Cell, n_moves: usize, seed: u64) -> Self {
        let uniform =
            |index: usize| (split_mix(seed, index as u64) >> 40) as f32 / (1 << 24) as f32;
        let (height, width) = shape.dim();
        let numbers = Probabilities::from_shape_fn((2, height, width), |(state, row, col)| {
            let p = uniform(shape.index(Cell { row, col }));
            if state == 0 { p } else { 1.0 - p }
        });
        let belief = Belief::from_probabilities(numbers).expect("on the simplex");
        Self {
            belief,
            start,
            n_moves,
        }
    }

    fn values(&self) -> CellValues {
        Objective::new(Target::State(0)).values(&self.belief)
    }

    fn problem<'a>(&self, values: &'a CellValues, step: u64) -> PlanningProblem<'a> {
        PlanningProblem {
            start: self.start,
            n_moves: self.n_moves,
            values,
            seed: 3,
            step,
        }
    }
}

fn fields(max_side: usize, max_moves: usize) -> impl Strategy<Value = Field> {
    let sides = (1..=max_side, 1..=max_side);
    let sized = sides.prop_flat_map(move |(height, width)| {
        let start = (0..height, 0..width);
        (Just((height, width)), start, 0..=max_moves, any::<u64>())
    });
    sized.prop_map(|((height, width), (row, col), n_moves, seed)| {
        let shape = Shape::new(height, width).expect("valid sides");
        Field::new(shape, Cell { row, col }, n_moves, seed)
    })
}

fn objectives() -> impl Strategy<Value = Objective> {
    let targets = prop_oneof![
        Just(Target::State(0)),
        Just(Target::Entropy),
        Just(Target::Coverage),
    ];
    (targets, any::<bool>(), 0.0..2.0_f32).prop_map(|(target, revisits, coverage_bonus)| {
        Objective {
            revisits,
            coverage_bonus,
            ..Objective::new(target)
        }
    })
}

/// The score from `protocol::path::fly`, whose flight says nothing of revisits.
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

/// The best score of all `4^T` paths.
fn optimum(values: &CellValues, start: Cell, n_moves: usize) -> f32 {
    let path = |code: u64| -> Vec<Move> {
        (0..n_moves)
            .map(|t| Move::from_low_bits(code >> (2 * t)))
            .collect()
    };
    let scores = (0..1_u64 << (2 * n_moves)).map(|code| values.score(start, &path(code)));
    scores.fold(f32::NEG_INFINITY, f32::max)
}

fn planners() -> [Box<dyn Planner>; 5] {
    [
        Box::new(RandomWalk),
        Box::new(Shooting::new(20, Integration::ClampEachMove)),
        Box::new(Shooting::new(20, Integration::ClampSum)),
        Box::new(BeamSearch::new(1)),
        Box::new(BeamSearch::new(20)),
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
    fn a_summary_is_of_its_models_length_and_from_0_to_1(
        (belief, robot, n_moves) in (1..5_usize).prop_flat_map(beliefs),
    ) {
        let n_states = belief.n_states();
        let summary = summarise(&belief, robot, n_moves);
        prop_assert_eq!(summary.len(), summary_length(n_states));
        prop_assert!(summary.iter().all(|number| (0.0..=1.0).contains(number)));
        // The states' means sum to one: over the grid, near the robot and in each block.
        let (n_layers, n_blocks) = (n_states + 1, N_BLOCKS * N_BLOCKS);
        let sums = |first: usize, stride: usize| -> f32 {
            summary[first..].iter().step_by(stride).take(n_states).sum()
        };
        let firsts = [(0, 1), (n_layers, 1)].into_iter();
        let blocks = (0..n_blocks).map(|block| (2 * n_layers + block, n_blocks));
        for (first, stride) in firsts.chain(blocks) {
            let sum = sums(first, stride);
            prop_assert!((sum - 1.0).abs() < 1e-4, "{} at {}", sum, first);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(200) })]

    #[test]
    fn a_plan_has_its_moves_and_the_score_it_reports(
        field in fields(12, 40),
        objective in objectives(),
    ) {
        let values = objective.values(&field.belief);
        for mut planner in planners() {
            let plan = planner.plan(&field.problem(&values, 0));
            prop_assert_eq!(plan.moves.len(), field.n_moves);
            assert_close(plan.score, score_of_flight(&values, field.start, &plan.moves));
            assert_close(values.score(field.start, &plan.moves), plan.score);
        }
    }

    #[test]
    fn a_plan_depends_on_nothing_but_the_problem(
        field in fields(12, 40),
        other in fields(20, 70),
    ) {
        let (values, other_values) = (field.values(), other.values());
        for (mut used, mut fresh) in planners().into_iter().zip(planners()) {
            used.plan(&other.problem(&other_values, 8));
            let problem = field.problem(&values, 5);
            prop_assert_eq!(used.plan(&problem), fresh.plan(&problem));
        }
    }

    #[test]
    fn a_beam_of_one_is_a_greedy_walk(field in fields(12, 40), objective in objectives()) {
        let values = objective.values(&field.belief);
        let moves = BeamSearch::new(1).plan(&field.problem(&values, 0)).moves;
        for t in 0..moves.len() {
            let with = |step: Move| {
                let path: Vec<Move> = moves[..t].iter().copied().chain([step]).collect();
                values.score(field.start, &path)
            };
            let most = Move::ALL.map(with).into_iter().fold(f32::NEG_INFINITY, f32::max);
            prop_assert_eq!(with(moves[t]), most);
        }
    }

    #[test]
    fn beam_search_is_never_worse_than_greedy(field in fields(12, 40)) {
        let values = field.values();
        let problem = field.problem(&values, 0);
        let greedy = BeamSearch::new(1).plan(&problem).score;
        for width in [2, 3, 10] {
            prop_assert!(BeamSearch::new(width).plan(&problem).score >= greedy);
        }
    }

    #[test]
    fn a_wide_beam_finds_the_best_path(field in fields(4, 6), objective in objectives()) {
        let values = objective.values(&field.belief);
        // 4^6 = 4096 paths: the beam holds them all.
        let plan = BeamSearch::new(4096).plan(&field.problem(&values, 0));
        assert_close(plan.score, optimum(&values, field.start, field.n_moves));
    }

    #[test]
    fn shooting_finds_the_first_of_its_best_samples(field in fields(8, 70)) {
        // Numbers of cells have no rounding and many ties.
        let values = Objective::new(Target::Coverage).values(&field.belief);
        let (problem, shape) = (field.problem(&values, 2), values.shape());
        for integration in [Integration::ClampEachMove, Integration::ClampSum] {
            let mut rng = stream(problem.seed, Purpose::Planner, problem.step);
            let n_words = field.n_moves.div_ceil(32);
            let samples = (0..30).map(|_| {
                let words: Vec<u64> = (0..n_words).map(|_| rng.next_u64()).collect();
                let bits = |t: usize| words[t / 32] >> (2 * (t % 32));
                let sampled = (0..field.n_moves).map(|t| Move::from_low_bits(bits(t)));
                integration.as_flown(shape, field.start, &sampled.collect::<Vec<_>>())
            });
            let score = |moves: &Vec<Move>| values.score(field.start, moves);
            let better = |a: Vec<Move>, b| if score(&b) > score(&a) { b } else { a };
            let first_best = samples.reduce(better).expect("30 samples");
            prop_assert_eq!(Shooting::new(30, integration).plan(&problem).moves, first_best);
        }
    }

    #[test]
    fn correct_stays_on_the_simplex(
        field in fields(6, 0),
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
        let field = Field::new(shape, shape.cell(seed as usize * 67), 64, seed);
        planner.plan(&field.problem(&field.values(), 0)).score
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
    let field = Field::new(shape, shape.centre(), 30, 1);
    let values = field.values();
    let plan = |step| -> Plan { RandomWalk.plan(&field.problem(&values, step)) };
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
            start,
            n_moves: 10,
        };
        BeamSearch::new(30).plan(&field.problem(&values, 0))
    };
    assert_eq!(plan(small), plan(large));
}
