//! Tests of planners for one robot on grids without no-fly cells.

use super::fields::{Field, fields, objectives};
use emberwatch_belief::planning::{
    Ahead, BeamSearch, Integration, Objective, Planner, PlanningProblem, RandomWalk, Shooting,
    Target,
};
use emberwatch_model::randomness::{Purpose, stream};
use emberwatch_model::{Move, Shape};
use proptest::prelude::*;
use rand_chacha::rand_core::Rng;

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

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(64) })]

    #[test]
    fn a_plan_depends_on_nothing_but_the_problem(
        field in fields(12, 40, 1),
        other in fields(20, 70, 1),
        objective in objectives(),
    ) {
        let (values, other_values) = (objective.values(&field.belief), other.values());
        for (mut used, mut fresh) in planners().into_iter().zip(planners()) {
            used.plan(&other.problem(&other_values));
            let problem = field.problem(&values);
            let plan = used.plan(&problem);
            prop_assert_eq!(plan.moves.len(), field.n_moves);
            let score = values.score(field.starts[0], &plan.moves);
            prop_assert!((plan.score - score).abs() <= 1e-5 * score.abs().max(1.0));
            prop_assert_eq!(plan, fresh.plan(&problem));
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
    fn shooting_finds_the_first_of_its_best_samples(field in fields(8, 70, 1)) {
        // Coverage scores are whole numbers, so there are no rounding errors, but many ties.
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
}

#[test]
fn each_step_has_its_own_random_numbers() {
    let shape = Shape::new(9, 9).expect("valid sides");
    let field = Field::new(shape, vec![shape.centre()], 30, 1);
    let values = field.values();
    let problem = |step| PlanningProblem {
        step,
        ..field.problem(&values)
    };
    assert_ne!(RandomWalk.plan(&problem(0)), RandomWalk.plan(&problem(1)));
}
