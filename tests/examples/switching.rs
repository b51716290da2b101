//! How much switching between actions of beam search can give: always the same action, and a rule made by
//! hand that flies to where most is to be found, on the same worlds, in one process.
//!
//! `cargo run --release -p tests --example switching -- MODEL MOVES BURN_IN FIRST_SEED WORLDS STEPS`

use emberwatch_belief::estimation::belief::Belief;
use emberwatch_belief::estimation::{BayesFilter, Estimator, Prior};
use emberwatch_belief::planning::BeamSearch;
use emberwatch_belief::planning::action::{ActionSet, Region};
use env_server::world::{Episode, Flown, Rules, Start};
use protocol::{Cell, Model, Shape};
use std::io::Write;

/// Worth of what lies a path's length further off.
const DECAY: f32 = 0.8;

/// Worlds simulated for the first belief.
const PRIOR_WORLDS: usize = 32;

/// What all runs share.
struct Setup {
    rules: Rules,
    actions: ActionSet,
    prior: Belief,
    model: Model,
    n_moves: usize,
    steps: u64,
}

/// A robot in a world.
#[derive(Clone)]
struct Robot {
    filter: BayesFilter,
    episode: Episode,
}

impl Robot {
    fn new(setup: &Setup, seed: u64) -> Self {
        let mut filter =
            BayesFilter::known(&setup.model, setup.prior.clone()).expect("a valid model");
        filter.predict();
        let episode = Episode::new(&setup.rules, seed);
        Self { filter, episode }
    }

    fn cell(&self) -> Cell {
        self.episode.robots()[0].cell()
    }

    /// Mean reward per step of an action by index, or of the rule.
    fn run(mut self, setup: &Setup, action: Option<usize>) -> f64 {
        let mut beam = BeamSearch::default();
        let mut sum = 0.0;
        for step in 0..setup.steps {
            let action = action.unwrap_or_else(|| rule(setup, self.filter.belief(), self.cell()));
            let action = &setup.actions.actions()[action];
            let random = (self.episode.result().seed, step);
            let belief = self.filter.belief();
            let plans = action.plan(&mut beam, belief, &[self.cell()], setup.n_moves, random);
            let flown = Flown {
                moves: &plans[0].moves,
                ready: 1,
                full: 0,
                hovered: 0,
                late: 0,
            };
            self.episode.step(&setup.rules, &flown);
            self.filter
                .correct(self.episode.robots()[0].frame(), None)
                .expect("a possible frame");
            self.filter.predict();
            sum += self.episode.result().reward;
        }
        sum / setup.steps as f64
    }
}

/// Exploits where the robot is, unless a block of the grid promises more even at its distance.
fn rule(setup: &Setup, belief: &Belief, robot: Cell) -> usize {
    let (shape, n_moves) = (setup.rules.shape, setup.n_moves);
    let near = |cell: Cell| {
        cell.row.abs_diff(robot.row) <= n_moves / 2 && cell.col.abs_diff(robot.col) <= n_moves / 2
    };
    let here = promise(setup, belief, near);
    let away = Region::all().map(|region| {
        let promised = promise(setup, belief, |cell| region.distance(cell, shape) == 0);
        let paths = region.distance(robot, shape) as f32 / n_moves as f32;
        (promised * DECAY.powf(paths), region)
    });
    let (most, region) = away.max_by(|a, b| a.0.total_cmp(&b.0)).expect("a block");
    if here >= most {
        return 0;
    }
    let actions = setup.actions.actions().iter();
    let mut actions = actions.map(|action| action.region);
    actions
        .position(|own| own == Some(region))
        .expect("an action per block")
}

/// What the best cells of an area promise, as many as a path has.
fn promise(setup: &Setup, belief: &Belief, is_in: impl Fn(Cell) -> bool) -> f32 {
    let cells = belief.probability(setup.model.target_state());
    let inside = |&((row, col), _): &((usize, usize), &f32)| is_in(Cell { row, col });
    let inside = cells.indexed_iter().filter(inside);
    let mut chances: Vec<f32> = inside.map(|(_, chance)| *chance).collect();
    chances.sort_by(|a, b| b.total_cmp(a));
    chances.iter().take(setup.n_moves).sum()
}

fn main() -> std::io::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, numbers @ ..] = &arguments[..] else {
        panic!("expected MODEL MOVES BURN_IN FIRST_SEED WORLDS STEPS");
    };
    let numbers = numbers
        .iter()
        .map(|text| text.parse().expect("a whole number"));
    let numbers: Vec<u64> = numbers.collect();
    let [n_moves, burn_in, first, n_worlds, steps] = numbers[..] else {
        panic!("expected MODEL MOVES BURN_IN FIRST_SEED WORLDS STEPS");
    };
    let model = Model::built_in(model).expect("a built-in model");
    let shape = Shape::new(64, 64).expect("a grid");
    let prior = Prior::Simulated {
        n_worlds: PRIOR_WORLDS,
        burn_in,
    };
    let setup = Setup {
        rules: Rules::new(&model, shape, burn_in, 0, Start::Corner).expect("a valid model"),
        actions: ActionSet::beam(&model),
        prior: prior.belief(&model, shape, 0).expect("a valid model"),
        n_moves: n_moves as usize,
        steps,
        model,
    };
    let robots: Vec<Robot> = (first..first + n_worlds)
        .map(|seed| Robot::new(&setup, seed))
        .collect();
    let mut out = std::io::stdout();
    let mut exploit = Vec::new();
    let actions = setup.actions.actions().iter().enumerate();
    let constant = actions.filter(|(_, action)| action.region.is_none());
    let rows = constant.map(|(index, action)| (action.name.as_str(), Some(index)));
    for (name, action) in rows.chain([("rule", None)]) {
        let rewards: Vec<f64> = std::thread::scope(|scope| {
            let run = |robot: &Robot| {
                let (robot, setup) = (robot.clone(), &setup);
                scope.spawn(move || robot.run(setup, action))
            };
            let runs: Vec<_> = robots.iter().map(run).collect();
            runs.into_iter()
                .map(|run| run.join().expect("a run"))
                .collect()
        });
        if exploit.is_empty() {
            exploit.clone_from(&rewards);
        }
        let paired: Vec<f64> = rewards.iter().zip(&exploit).map(|(a, b)| a - b).collect();
        let ([mean, error], [more, paired_error]) = (summary(&rewards), summary(&paired));
        writeln!(
            out,
            "{name:20} {mean:6.2} ± {error:.2}  {more:+6.2} ± {paired_error:.2}"
        )?;
    }
    Ok(())
}

/// Mean, and its standard error over worlds.
fn summary(rewards: &[f64]) -> [f64; 2] {
    let n = rewards.len() as f64;
    let mean = rewards.iter().sum::<f64>() / n;
    let squares: f64 = rewards.iter().map(|reward| (reward - mean).powi(2)).sum();
    [mean, (squares / (n - 1.0) / n).sqrt()]
}
