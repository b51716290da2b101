//! One world with its robots: reset, step, reward, truncation.
//!
//! In a step, the robots fly their paths, the world moves from X_k to X_{k+1}, and the visited cells of X_{k+1} are
//! observed. This is paper Algorithm 1, in the order of the authors' code.

use super::flown::Flown;
use super::hidden::World;
use super::history::{History, PastStep};
use super::outcome::WorldOutcome;
use super::reward::pay;
use super::robot::{Robot, Scratch};
use super::rules::Rules;
use super::saved::{InvalidWorld, SavedRobot, SavedWorld};
use super::sensor::Sensor;
use emberwatch_model::path::path_from_bytes;
use emberwatch_model::{Coverage, Frame, Grid};

#[derive(Debug, Clone)]
pub struct Episode {
    world: World,
    /// A copy of the world at k = 0, so that a reset to the same seed needs no burn-in.
    beginning: World,
    robots: Vec<Robot>,
    outcome: WorldOutcome,
    /// A buffer for [`pay`] with one count per cell. All counts are 0 between calls.
    counts: Vec<u8>,
    scratch: Scratch,
    history: History,
}

impl Episode {
    pub fn new(rules: &Rules, seed: u64) -> Self {
        Self::numbered(rules, seed, 0)
    }

    pub fn numbered(rules: &Rules, seed: u64, episode: u64) -> Self {
        let world = World::new(rules.source.clone(), seed, rules.burn_in, &rules.ended);
        Self::beginning(rules, world, episode)
    }

    /// Starts the next episode with a seed: k = 0, empty frames, and all robots at their starts.
    pub fn reset(&mut self, rules: &Rules, seed: u64) {
        let world = if self.beginning.seed() == seed {
            self.beginning.clone()
        } else {
            World::new(rules.source.clone(), seed, rules.burn_in, &rules.ended)
        };
        *self = Self::beginning(rules, world, self.outcome.episode.wrapping_add(1));
    }

    /// Flies the paths, moves the world by one step, and computes frames and rewards.
    pub fn step(&mut self, rules: &Rules, flown: &Flown<'_>) {
        let n_moves = flown.moves.len() / self.robots.len();
        for (r, robot) in self.robots.iter_mut().enumerate() {
            let path = match flown.coverage(r) {
                Coverage::Empty => &[],
                _ => &flown.moves[r * n_moves..][..n_moves],
            };
            let coverage = flown.coverage(r);
            robot.follow(&rules.airspace, path, coverage, &mut self.scratch);
        }
        self.world.advance();
        self.observe(rules);
        let (states, step) = (self.world.states(), self.world.step());
        self.outcome.step = step;
        self.outcome.hovered = flown.hovered;
        self.outcome.late = flown.late;
        self.outcome.n_target_cells = count(states, rules.target_state);
        self.outcome.is_truncated = rules.truncates(self.outcome.seed, step);
        let states = states.as_slice().expect("invariant: states are row-major");
        pay(
            rules,
            states,
            &mut self.robots,
            &mut self.counts,
            &mut self.outcome,
        );
        self.history.push(&self.outcome, &self.robots);
    }

    pub fn outcome(&self) -> &WorldOutcome {
        &self.outcome
    }

    pub fn robots(&self) -> &[Robot] {
        &self.robots
    }

    /// Returns the outcomes and frames of step k.
    ///
    /// # Errors
    /// If the history does not contain step k. The error is the nearest step that it contains: the oldest or the
    /// current one.
    pub fn recall(&self, step: u64) -> Result<&PastStep, u64> {
        let oldest = self.history.all().next().map(|past| past.outcome.step);
        let present = self.outcome.step;
        let nearest = oldest.filter(|_| step < present).unwrap_or(present);
        self.history.step(step).ok_or(nearest)
    }

    pub fn n_bytes(&self) -> usize {
        let of_robot = |robot: &Robot| robot.frame.as_bytes().len() + robot.path.len() + 128;
        let robots: usize = self.robots.iter().map(of_robot).sum();
        2 * self.counts.len() + robots + self.history.n_bytes() + 256
    }

    /// Returns the hidden states, shape `[H, W]`.
    pub fn states(&self) -> &Grid<u8> {
        self.world.states()
    }

    pub fn is_over(&self) -> bool {
        self.outcome.is_truncated
    }

    /// Returns the hidden states at k = 0, shape `[H, W]`.
    pub fn first_states(&self) -> &Grid<u8> {
        self.beginning.states()
    }

    pub fn history(&self) -> impl ExactSizeIterator<Item = &PastStep> {
        self.history.all()
    }

    /// Restores a saved episode. The restored episode continues exactly as the original, bit for bit.
    pub fn restore(rules: &Rules, saved: SavedWorld) -> Result<Self, InvalidWorld> {
        saved.check(rules)?;
        let SavedWorld {
            outcome,
            states,
            first_states,
            robots,
            history,
        } = saved;
        let grid = |states| Grid::from_shape_vec(rules.shape.dim(), states);
        let world = |step, states| {
            let states = grid(states).expect("invariant: the length was checked");
            World::at(
                rules.source.clone(),
                outcome.seed,
                rules.burn_in,
                step,
                states,
            )
        };
        let mut kept = History::new(rules.history, rules.n_robots, rules.most_seen());
        history.into_iter().for_each(|past| kept.keep(past));
        let robots = robots.into_iter().map(|robot| restored(rules, &robot));
        Ok(Self {
            world: world(outcome.step, states),
            beginning: world(0, first_states),
            robots: robots.collect::<Result<_, _>>()?,
            outcome,
            counts: vec![0; rules.shape.n_cells()],
            scratch: Scratch::default(),
            history: kept,
        })
    }

    fn beginning(rules: &Rules, world: World, episode: u64) -> Self {
        let start = |robot| Robot::at(&rules.airspace, rules.start_cell(world.seed(), robot));
        let robots: Vec<Robot> = (0..rules.n_robots).map(start).collect();
        let outcome = WorldOutcome {
            seed: world.seed(),
            episode,
            n_target_cells: count(world.states(), rules.target_state),
            ..WorldOutcome::default()
        };
        let mut history = History::new(rules.history, rules.n_robots, rules.most_seen());
        history.push(&outcome, &robots);
        Self {
            beginning: world.clone(),
            world,
            robots,
            outcome,
            counts: vec![0; rules.shape.n_cells()],
            scratch: Scratch::default(),
            history,
        }
    }

    fn observe(&mut self, rules: &Rules) {
        let (sensor, states) = (&rules.sensor, self.world.states());
        let key = Sensor::key(self.world.seed(), self.world.absolute_step());
        for Robot {
            outcome,
            frame,
            seen,
            ..
        } in &mut self.robots
        {
            if outcome.coverage == Coverage::Full {
                sensor.observe(key, states, 0..rules.shape.n_cells(), frame);
            } else {
                sensor.observe(key, states, seen.iter().copied(), frame);
            }
        }
    }
}

fn restored(rules: &Rules, saved: &SavedRobot) -> Result<Robot, InvalidWorld> {
    let frame = Frame::from_bytes(rules.shape, rules.n_observations, &saved.frame);
    Ok(Robot {
        outcome: saved.outcome,
        frame: frame.map_err(|error| InvalidWorld(error.to_string()))?,
        path: path_from_bytes(&saved.path).map_err(|error| InvalidWorld(error.to_string()))?,
        visited: Vec::new(),
        seen: Vec::new(),
    })
}

fn count(states: &Grid<u8>, wanted: u8) -> u32 {
    // Counts in chunks of 255 cells, because their count fits a byte and the compiler can then vectorise the sum.
    let states = states.as_slice().expect("invariant: states are row-major");
    let of_chunk = |chunk: &[u8]| {
        u32::from(
            chunk
                .iter()
                .map(|state| u8::from(*state == wanted))
                .sum::<u8>(),
        )
    };
    states.chunks(255).map(of_chunk).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberwatch_model::path::fly;
    use emberwatch_model::settings::Start;
    use emberwatch_model::{Cell, Model, Move, Shape};

    fn rules(radius: usize, start: Start) -> Rules {
        let shape = Shape::new(12, 20).expect("test shape");
        let model = Model::wildfire().with_radius(radius).expect("a radius");
        Rules::new(&model, shape, 2000, 0, start).expect("valid model")
    }

    fn path(bytes: &[u8]) -> Vec<Move> {
        path_from_bytes(bytes).expect("test path")
    }

    /// Flies the only robot, which observes every cell if `full` is 1.
    fn step(episode: &mut Episode, rules: &Rules, moves: &[u8], full: u64) {
        let flown = Flown {
            moves: &path(moves),
            ready: 1,
            full,
            ..Flown::default()
        };
        episode.step(rules, &flown);
    }

    #[test]
    fn reward_counts_distinct_visited_cells_on_fire_after_the_transition() {
        // A wide sensor sees around the path, but only visited cells pay.
        for radius in [0, 2] {
            check_rewards(&rules(radius, Start::Centre));
        }
    }

    fn check_rewards(rules: &Rules) {
        let mut episode = Episode::new(rules, 0);
        let mut total = 0;
        for k in 0..2000 {
            if k % 50 == 0 {
                episode.reset(rules, k);
            }
            let there_and_back = [3, 3, 0, 1, 2, 2];
            let start = episode.robots()[0].cell();
            let flight = fly(rules.shape, start, &path(&there_and_back));
            step(&mut episode, rules, &there_and_back, 0);
            let frame = episode.robots()[0].frame();
            let mut in_sight = rules.airspace.see(&flight.visited);
            in_sight.sort_unstable();
            assert!(frame.observed().map(|(cell, _)| cell).eq(in_sight));
            let states = episode.states().as_slice().expect("row-major");
            let is_fire = |cell: &&usize| states[**cell] == 2;
            let n_hits = flight.visited.iter().filter(is_fire).count();
            let (world, robot) = (episode.outcome(), episode.robots()[0].outcome());
            let rewards = [world.reward, robot.reward, robot.marginal];
            assert_eq!(rewards, [n_hits as f64; 3]);
            let counts = [world.n_hits, robot.n_hits, world.n_visited, robot.n_visited];
            let [n_hits, n_visited] = [n_hits, flight.visited.len()].map(|it| it as u32);
            assert_eq!(counts, [n_hits, n_hits, n_visited, n_visited]);
            let n_fires = states.iter().filter(|state| **state == 2).count();
            assert_eq!(world.n_target_cells as usize, n_fires);
            total += n_hits;
        }
        assert!(total > 0, "the test saw no fire");
    }

    #[test]
    fn robots_that_stay_see_nothing_and_do_not_move() {
        let mut rules = rules(0, Start::Corner);
        rules.n_robots = 4;
        let mut episode = Episode::new(&rules, 1);
        let cells = |episode: &Episode| -> Vec<(usize, usize)> {
            let cells = episode.robots().iter().map(Robot::cell);
            cells.map(|Cell { row, col }| (row, col)).collect()
        };
        assert_eq!(cells(&episode), [(0, 0), (11, 19), (0, 19), (11, 0)]);
        let flown = Flown {
            moves: &path(&[1, 1, 0, 0, 2, 2, 3, 3]),
            ready: 0b0110,
            full: 0,
            hovered: 0b0001,
            late: 0b1000,
        };
        episode.step(&rules, &flown);
        assert_eq!(cells(&episode), [(0, 0), (9, 19), (0, 17), (11, 0)]);
        for (robot, expected) in episode.robots().iter().zip([0, 2, 2, 0]) {
            assert_eq!(robot.frame().observed().count(), expected);
            assert_eq!(robot.outcome().n_moves as usize, expected);
        }
        assert_eq!((episode.outcome().hovered, episode.outcome().late), (1, 8));
    }
}
