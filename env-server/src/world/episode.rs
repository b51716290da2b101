//! One world with a robot in it: reset, step, reward, truncation.
//!
//! A step flies the path, moves the world from X_k to X_{k+1}, and observes the visited cells of
//! X_{k+1} (paper Algorithm 1; the order is the authors').

use super::hidden::World;
use super::history::{History, PastStep};
use super::rules::Rules;
use super::saved::{InvalidWorld, SavedWorld};
use protocol::message::StepResult;
use protocol::path::{fly, path_from_bytes};
use protocol::{Cell, Coverage, Frame, Grid, Move};

/// One world's episode.
#[derive(Debug, Clone)]
pub struct Episode {
    world: World,
    /// The world at k = 0, so that the next reset to the same seed needs no burn-in.
    beginning: World,
    frame: Frame,
    history: History,
    path: Vec<Move>,
    path_start: Cell,
    robot: Cell,
    result: StepResult,
}

impl Episode {
    /// A new world at k = 0.
    pub fn new(rules: &Rules, seed: u64) -> Self {
        Self::numbered(rules, seed, 0)
    }

    /// A new world at k = 0 that was reset before.
    pub fn numbered(rules: &Rules, seed: u64, episode: u64) -> Self {
        let world = World::new(rules.dynamics.clone(), seed, rules.burn_in);
        Self::beginning(rules, world, episode)
    }

    /// Starts over with a seed: the frame is empty, the robot at its start, k = 0.
    pub fn reset(&mut self, rules: &Rules, seed: u64) {
        let world = if self.beginning.seed() == seed {
            self.beginning.clone()
        } else {
            World::new(rules.dynamics.clone(), seed, rules.burn_in)
        };
        *self = Self::beginning(rules, world, self.result.episode.wrapping_add(1));
    }

    /// Flies a path and moves the world once; `coverage` says what the frame shows.
    pub fn step(&mut self, rules: &Rules, path: &[Move], coverage: Coverage) {
        let flight = fly(rules.shape, self.robot, path);
        self.world.advance();
        self.observe(rules, &flight.visited, coverage);
        let states = self
            .world
            .states()
            .as_slice()
            .expect("invariant: states are row-major");
        let of_visited = || flight.visited.iter().map(|&cell| states[cell]);
        let step = self.world.step();
        self.result = StepResult {
            step,
            reward: of_visited()
                .map(|state| rules.reward[usize::from(state)])
                .sum(),
            n_target_cells: count(self.world.states(), rules.target_state),
            n_visited: flight.visited.len() as u32,
            n_hits: of_visited()
                .filter(|state| *state == rules.target_state)
                .count() as u32,
            row: flight.end.row as u32,
            col: flight.end.col as u32,
            coverage: coverage as u32,
            truncated: u16::from(rules.max_steps > 0 && step >= rules.max_steps),
            ..self.result
        };
        let observed = (coverage != Coverage::Full).then_some(&flight.visited[..]);
        self.history.push(&self.result, &self.frame, observed);
        self.path_start = self.robot;
        self.robot = flight.end;
        self.path.clear();
        self.path.extend_from_slice(path);
    }

    /// The result of the last step or reset.
    pub fn result(&self) -> &StepResult {
        &self.result
    }

    /// The frame of the last step or reset.
    pub fn frame(&self) -> &Frame {
        &self.frame
    }

    /// What step k showed.
    ///
    /// # Errors
    /// If it is not kept; the error is the nearest step that is, the oldest or the present.
    pub fn recall(&self, step: u64) -> Result<&PastStep, u64> {
        let oldest = self.history.all().next().map(|past| past.result.step);
        let present = self.result.step;
        let nearest = oldest.filter(|_| step < present).unwrap_or(present);
        self.history.step(step).ok_or(nearest)
    }

    /// About how many bytes a snapshot of it takes.
    pub fn n_bytes(&self) -> usize {
        3 * self.frame.as_bytes().len() + self.history.n_bytes() + self.path.len() + 256
    }

    /// The hidden states, shape `[H, W]`.
    pub fn states(&self) -> &Grid<u8> {
        self.world.states()
    }

    /// The last path and the cell that it began in; empty after a reset.
    pub fn path(&self) -> (Cell, &[Move]) {
        (self.path_start, &self.path)
    }

    /// Whether the episode was truncated: it takes no step before it is reset.
    pub fn is_over(&self) -> bool {
        self.result.truncated != 0
    }

    /// The hidden states at k = 0, shape `[H, W]`.
    pub fn first_states(&self) -> &Grid<u8> {
        self.beginning.states()
    }

    /// The last steps, the oldest first.
    pub fn history(&self) -> impl ExactSizeIterator<Item = &PastStep> {
        self.history.all()
    }

    /// The episode that was saved: it continues bit for bit as the original.
    ///
    /// # Errors
    /// If something cannot be part of an episode under these rules.
    pub fn restore(rules: &Rules, saved: SavedWorld) -> Result<Self, InvalidWorld> {
        saved.check(rules)?;
        let SavedWorld {
            result,
            states,
            first_states,
            frame,
            path,
            path_start,
            history,
        } = saved;
        let grid = |states| Grid::from_shape_vec(rules.shape.dim(), states);
        let world = |step, states| {
            let states = grid(states).expect("invariant: the length was checked");
            World::at(
                rules.dynamics.clone(),
                result.seed,
                rules.burn_in,
                step,
                states,
            )
        };
        let mut kept = History::new(rules.history, rules.n_moves);
        history.into_iter().for_each(|past| kept.keep(past));
        let n_observations = rules.n_observations;
        let frame = Frame::from_bytes(rules.shape, n_observations, &frame);
        Ok(Self {
            world: world(result.step, states),
            beginning: world(0, first_states),
            frame: frame.map_err(|error| InvalidWorld(error.to_string()))?,
            history: kept,
            path: path_from_bytes(&path).map_err(|error| InvalidWorld(error.to_string()))?,
            path_start,
            robot: Cell {
                row: result.row as usize,
                col: result.col as usize,
            },
            result,
        })
    }

    fn beginning(rules: &Rules, world: World, episode: u64) -> Self {
        let robot = rules.start_cell(world.seed());
        let result = StepResult {
            seed: world.seed(),
            episode,
            n_target_cells: count(world.states(), rules.target_state),
            row: robot.row as u32,
            col: robot.col as u32,
            coverage: Coverage::Empty as u32,
            ..StepResult::default()
        };
        let (beginning, frame) = (world.clone(), Frame::empty(rules.shape));
        let mut history = History::new(rules.history, rules.n_moves);
        history.push(&result, &frame, Some(&[]));
        Self {
            world,
            beginning,
            frame,
            history,
            path: Vec::new(),
            path_start: robot,
            robot,
            result,
        }
    }

    fn observe(&mut self, rules: &Rules, visited: &[usize], coverage: Coverage) {
        let (sensor, states) = (&rules.sensor, self.world.states());
        let (seed, step) = (self.world.seed(), self.world.absolute_step());
        self.frame.clear();
        match coverage {
            Coverage::Empty => {}
            Coverage::Path => {
                let cells = visited.iter().copied();
                sensor.observe(seed, step, states, cells, &mut self.frame);
            }
            Coverage::Full => {
                let cells = 0..rules.shape.n_cells();
                sensor.observe(seed, step, states, cells, &mut self.frame);
            }
        }
    }
}

fn count(states: &Grid<u8>, wanted: u8) -> u32 {
    // Bytes summed in chunks that cannot overflow: the compiler makes vector code of it.
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
    use crate::world::rules::Start;
    use protocol::{Model, Shape};

    fn rules(max_steps: u64, start: Start) -> Rules {
        let shape = Shape::new(12, 20).expect("test shape");
        Rules::new(&Model::wildfire(), shape, 2000, max_steps, start).expect("valid model")
    }

    fn path(bytes: &[u8]) -> Vec<Move> {
        path_from_bytes(bytes).expect("test path")
    }

    #[test]
    fn reward_counts_distinct_visited_cells_on_fire_after_the_transition() {
        let rules = rules(0, Start::Centre);
        let mut episode = Episode::new(&rules, 0);
        let mut total = 0;
        for step in 0..2000 {
            if step % 50 == 0 {
                episode.reset(&rules, step);
            }
            let there_and_back = path(&[3, 3, 0, 1, 2, 2]);
            let flight = fly(rules.shape, episode.robot, &there_and_back);
            episode.step(&rules, &there_and_back, Coverage::Path);
            let states = episode.states();
            let fires = flight
                .visited
                .iter()
                .filter(|&&cell| states.as_slice().expect("row-major")[cell] == 2)
                .count();
            assert_eq!(episode.result().reward, fires as f64);
            assert_eq!(episode.result().n_hits, fires as u32);
            assert_eq!(episode.result().n_visited, flight.visited.len() as u32);
            assert_eq!(
                episode.result().n_target_cells as usize,
                states.iter().filter(|s| **s == 2).count()
            );
            total += fires;
        }
        assert!(total > 0, "the test saw no fire");
    }

    #[test]
    fn a_frame_shows_the_visited_cells_and_no_others() {
        let rules = rules(0, Start::Corner);
        let mut episode = Episode::new(&rules, 1);
        episode.step(&rules, &path(&[1, 3, 3]), Coverage::Path);
        let seen: Vec<usize> = episode.frame().observed().map(|(cell, _)| cell).collect();
        assert_eq!(seen, [20, 21, 22]);
        let masked = episode.frame().clone();
        let mut other = Episode::new(&rules, 1);
        other.step(&rules, &path(&[0, 0, 0]), Coverage::Full);
        assert_eq!(other.frame().observed().count(), 240);
        for (cell, value) in masked.observed() {
            assert_eq!(
                other.frame().as_bytes()[cell],
                value,
                "a reading depends on the path"
            );
        }
        assert_eq!(
            other.states(),
            episode.states(),
            "the world depends on the path"
        );
    }

    #[test]
    fn a_reset_repeats_the_episode_of_its_seed() {
        let rules = rules(0, Start::Random);
        let mut episode = Episode::new(&rules, 9);
        let first = episode.clone();
        episode.step(&rules, &path(&[1, 1, 1]), Coverage::Path);
        for seed in [9, 10, 9] {
            episode.reset(&rules, seed);
            assert_eq!(episode.states(), Episode::new(&rules, seed).states());
            assert_eq!(
                (episode.result().step, episode.frame().observed().count()),
                (0, 0)
            );
        }
        assert_eq!((episode.robot, episode.result().episode), (first.robot, 3));
    }

    #[test]
    fn an_episode_is_truncated_at_max_steps_and_never_terminated() {
        let rules = rules(3, Start::Corner);
        let mut episode = Episode::new(&rules, 1);
        for step in 1..=3 {
            assert!(!episode.is_over());
            episode.step(&rules, &path(&[1]), Coverage::Path);
            assert_eq!(episode.result().step, step);
            assert_eq!(episode.result().terminated, 0);
        }
        assert!(episode.is_over());
    }
}
