//! What a high-level decision chooses among (the actions `a_k` of paper section III.E): what a path is
//! for, how much exploring counts beside it, how far ahead a plan looks, and where it is drawn to. Pure.

use crate::estimation::belief::{Belief, EntropyKind};
use crate::estimation::summary::{N_BLOCKS, block};
use crate::planning::objective::{BEAM_BONUS, CellValues, Objective, Target};
use crate::planning::planner::{Plan, Planner};
use crate::planning::team::{ROUNDS, plan_team};
use protocol::{Cell, Grid, Model, Shape};

/// Rise in a cell's value per cell nearer to an action's region. A straight flight of T = 12 moves gains
/// 23 more than one to and fro, so the robot goes there whatever burns on its way, by the way that burns most.
/// A path of more moves than the block has cells leaves it again.
pub const REGION_SLOPE: f32 = 0.3;

#[derive(Debug, Clone, PartialEq)]
pub struct Action {
    /// Its name in tables and files, unique in its set.
    pub name: String,
    pub objective: Objective,
    /// Weight of each cell's entropy, as a share of the greatest, beside that; 0 or more.
    pub exploration: f32,
    /// Paths that a plan looks ahead, at least 1; only the first is flown.
    pub horizon: usize,
    pub region: Option<Region>,
}

/// A block of the grid, of `N_BLOCKS` by `N_BLOCKS` as in [`crate::estimation::summary`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Region {
    /// Row of the block, from the top.
    pub row: usize,
    /// Column of the block, from the left.
    pub col: usize,
}

/// The actions of a decision maker, at least one.
#[derive(Debug, Clone, PartialEq)]
pub struct ActionSet {
    actions: Vec<Action>,
}

impl Action {
    /// A plain objective: no exploring beside it, one path ahead, no region.
    pub fn plain(name: &str, objective: Objective) -> Self {
        Self {
            name: name.into(),
            objective,
            exploration: 0.0,
            horizon: 1,
            region: None,
        }
    }

    /// What the cells are worth under a belief.
    pub fn values(&self, belief: &Belief) -> CellValues {
        let mut values = self.objective.values(belief);
        if self.exploration > 0.0 {
            let greatest = (belief.n_states() as f32).ln().max(f32::MIN_POSITIVE);
            values.add(
                self.exploration / greatest,
                &belief.entropy(EntropyKind::Sum),
            );
        }
        if let Some(region) = self.region {
            values.add(REGION_SLOPE, &region.nearness(belief.shape()));
        }
        values
    }

    /// The paths that a planner finds for this action, one for each start, `n_moves` long; scores are those of the whole
    /// horizon. `random`: seed and step of the planner's random numbers.
    pub fn plan(
        &self,
        planner: &mut dyn Planner,
        belief: &Belief,
        starts: &[Cell],
        n_moves: usize,
        random: (u64, u64),
    ) -> Vec<Plan> {
        let (values, n_ahead) = (self.values(belief), n_moves * self.horizon);
        let mut plans = plan_team(planner, &values, starts, n_ahead, random, ROUNDS);
        for plan in &mut plans {
            plan.moves.truncate(n_moves);
        }
        plans
    }
}

impl Region {
    pub fn all() -> impl Iterator<Item = Self> {
        let region = |index| Self {
            row: index / N_BLOCKS,
            col: index % N_BLOCKS,
        };
        (0..N_BLOCKS * N_BLOCKS).map(region)
    }

    /// Moves from a cell to the block's nearest cell.
    pub fn distance(self, cell: Cell, shape: Shape) -> usize {
        let away = |at: usize, index: usize, side: usize| {
            let block = block(index, side);
            block.start.saturating_sub(at) + (at + 1).saturating_sub(block.end)
        };
        away(cell.row, self.row, shape.height()) + away(cell.col, self.col, shape.width())
    }

    /// Height plus width less each cell's distance, shape `[H, W]`; nowhere negative.
    fn nearness(self, shape: Shape) -> Grid<f32> {
        let farthest = shape.height() + shape.width();
        Grid::from_shape_fn(shape.dim(), |(row, col)| {
            (farthest - self.distance(Cell { row, col }, shape)) as f32
        })
    }
}

impl ActionSet {
    /// For beam search: what pays most, alone, with exploring beside it, and further ahead; each other
    /// state; exploring alone; and what pays most on the way to each block of the grid.
    pub fn beam(model: &Model) -> Self {
        let objective = |target| Objective {
            coverage_bonus: BEAM_BONUS,
            ..Objective::new(target)
        };
        let target = model.target_state();
        let exploit = Action::plain("exploit", objective(Target::State(target)));
        let exploring = |weight: f32| Action {
            name: format!("exploit_explore_{weight}"),
            exploration: weight,
            ..exploit.clone()
        };
        let ahead = |horizon: usize| Action {
            name: format!("exploit_ahead_{horizon}"),
            horizon,
            ..exploit.clone()
        };
        let states = model.file().states.iter().enumerate();
        let others = states.filter(|(state, _)| *state != target);
        let others = others
            .map(|(state, entry)| Action::plain(&entry.name, objective(Target::State(state))));
        let region = |region: Region| Action {
            name: format!("exploit_at_{}_{}", region.row, region.col),
            region: Some(region),
            ..exploit.clone()
        };
        let few = [
            exploit.clone(),
            exploring(0.1),
            exploring(0.3),
            ahead(3),
            Action::plain("explore", objective(Target::Entropy)),
        ];
        let actions = few
            .into_iter()
            .chain(others)
            .chain(Region::all().map(region));
        Self {
            actions: actions.collect(),
        }
    }

    /// The actions, in the order of the network's outputs.
    pub fn actions(&self) -> &[Action] {
        &self.actions
    }

    pub fn names(&self) -> Vec<String> {
        self.actions
            .iter()
            .map(|action| action.name.clone())
            .collect()
    }

    pub fn named(&self, name: &str) -> Option<&Action> {
        self.actions.iter().find(|action| action.name == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::policy::Policy;

    fn shape() -> Shape {
        Shape::new(16, 8).expect("test shape")
    }

    #[test]
    fn beam_actions_have_names_of_their_own_and_exploit_first() {
        let model = Model::wildfire();
        let set = ActionSet::beam(&model);
        let names = set.names();
        let distinct: std::collections::BTreeSet<&String> = names.iter().collect();
        assert_eq!((names.len(), distinct.len()), (23, 23));
        let exploit = Policy::named("beam_exploit", &model).expect("known");
        assert_eq!(set.actions()[0].objective, exploit.objective);
        assert!(names.iter().all(|name| !name.contains(' ')), "{names:?}");
    }

    #[test]
    fn distance_is_to_the_blocks_nearest_cell() {
        // Blocks of 4 rows and 2 columns.
        let region = Region { row: 1, col: 2 };
        let distance = |row, col| region.distance(Cell { row, col }, shape());
        assert_eq!([distance(4, 4), distance(7, 5)], [0, 0]);
        assert_eq!([distance(3, 4), distance(8, 4)], [1, 1]);
        assert_eq!([distance(0, 0), distance(15, 7)], [8, 10]);
    }

    #[test]
    fn a_region_draws_the_robot_there() {
        let model = Model::wildfire();
        let set = ActionSet::beam(&model);
        let shape = Shape::new(32, 32).expect("test shape");
        let (belief, start) = (Belief::uniform(3, shape), Cell { row: 16, col: 16 });
        for region in Region::all() {
            let name = format!("exploit_at_{}_{}", region.row, region.col);
            let action = set.named(&name).expect("an action");
            let mut planner = crate::planning::BeamSearch::default();
            let plan = &action.plan(&mut planner, &belief, &[start], 16, (0, 0))[0];
            let end = protocol::path::fly(shape, start, &plan.moves).end;
            let left = region.distance(start, shape).saturating_sub(16);
            assert_eq!(region.distance(end, shape), left, "{name}: {end}");
        }
    }

    #[test]
    fn a_longer_horizon_flies_towards_what_one_path_cannot_reach() {
        let mut states = Grid::zeros((16, 8));
        states[[10, 0]] = 2;
        let belief = Belief::from_states(&states, 3).expect("valid states");
        let set = ActionSet::beam(&Model::wildfire());
        let action = set.named("exploit_ahead_3").expect("an action");
        let mut planner = crate::planning::BeamSearch::new(200);
        let start = Cell { row: 0, col: 0 };
        let plan = &action.plan(&mut planner, &belief, &[start], 4, (0, 0))[0];
        assert_eq!(plan.moves.len(), 4);
        let end = protocol::path::fly(shape(), start, &plan.moves).end;
        assert!(end.row > 1, "{end}");
    }

    #[test]
    fn exploration_adds_the_entropy_as_a_share_of_the_greatest() {
        let set = ActionSet::beam(&Model::wildfire());
        let belief = Belief::uniform(3, shape());
        let value = |name: &str| set.named(name).expect(name).values(&belief).value()[[0, 0]];
        let more = value("exploit_explore_0.3") - value("exploit");
        assert!((more - 0.3).abs() < 1e-6, "{more}");
    }
}
