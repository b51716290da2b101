//! Common figures of merit of one run, as defined in `docs/figures-of-merit.md`.
//!
//! The figures need no model, only the index of the target state. Two figures also need the hidden states.

use emberwatch_model::path::Flight;
use emberwatch_model::{Cell, Grid, Shape};

/// Number of steps for which a cell counts as seen after a visit.
pub const RECENT_STEPS: u32 = 10;

/// The figures of one run. A figure is `None` if there was nothing to measure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Merit {
    /// Number of steps until a robot first visited a burning cell.
    pub steps_to_detection: Option<u64>,
    /// Number of burning cells in the world at the step of that visit.
    pub burning_cells_at_detection: Option<u32>,
    /// Fraction of the burning cells that a robot visited in the last [`RECENT_STEPS`] steps, averaged over steps with
    /// fire.
    pub burning_seen_share: Option<f64>,
    /// Number of moves from the nearest robot to the nearest burning cell that no robot visited in these steps,
    /// averaged over the steps in which there is such a cell.
    pub front_distance: Option<f64>,
    /// Fraction of all cells that any robot visited during the run.
    pub grid_seen_share: f64,
}

/// The reward counts of one step, as the server reports them.
#[derive(Debug, Clone, Copy)]
pub struct Found {
    /// Number of distinct burning cells that the robots visited.
    pub n_hits: u32,
    /// Number of burning cells of the world.
    pub n_burning: u32,
}

/// The running computation of the figures.
#[derive(Debug, Clone)]
pub struct MeritTally {
    shape: Shape,
    target: u8,
    step: u32,
    /// The step of the last visit to each cell, row-major. 0 if the cell was never visited.
    last_visits: Vec<u32>,
    n_seen: usize,
    detection: Option<(u32, u32)>,
    burning_seen: Mean,
    distance: Mean,
}

#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    n: u32,
}

impl MeritTally {
    /// Creates the tally before the first step. `target` is the burning state.
    pub fn new(shape: Shape, target: u8) -> Self {
        Self {
            shape,
            target,
            step: 0,
            last_visits: vec![0; shape.n_cells()],
            n_seen: 0,
            detection: None,
            burning_seen: Mean::default(),
            distance: Mean::default(),
        }
    }

    /// Adds a step. `flights` contains one flight per robot, and must not be empty. `states` are the hidden states
    /// during the flights, shape `[H, W]`, if they are known.
    pub fn update(&mut self, flights: &[Flight], found: Found, states: Option<&Grid<u8>>) {
        self.step += 1;
        for &cell in flights.iter().flat_map(|flight| &flight.visited) {
            self.n_seen += usize::from(self.last_visits[cell] == 0);
            self.last_visits[cell] = self.step;
        }
        if self.detection.is_none() && found.n_hits > 0 {
            self.detection = Some((self.step, found.n_burning));
        }
        if let Some(states) = states {
            self.watch(flights, states);
        }
    }

    /// Returns the figures so far.
    pub fn merit(&self) -> Merit {
        Merit {
            steps_to_detection: self.detection.map(|(step, _)| step.into()),
            burning_cells_at_detection: self.detection.map(|(_, n_burning)| n_burning),
            burning_seen_share: self.burning_seen.get(),
            front_distance: self.distance.get(),
            grid_seen_share: self.n_seen as f64 / self.last_visits.len() as f64,
        }
    }

    fn watch(&mut self, flights: &[Flight], states: &Grid<u8>) {
        let states = states.as_slice().expect("invariant: grids are row-major");
        let forgotten = self.step.saturating_sub(RECENT_STEPS);
        // Avoid branches, so that the compiler vectorises the loop.
        let (mut n_burning, mut n_seen) = (0_u32, 0_u32);
        for (&state, &visit) in states.iter().zip(&self.last_visits) {
            let burns = u32::from(state == self.target);
            n_burning += burns;
            n_seen += burns & u32::from(visit > forgotten);
        }
        if n_burning > 0 {
            let share = f64::from(n_seen) / f64::from(n_burning);
            self.burning_seen.add(share);
        }
        if n_seen < n_burning {
            let is_front =
                |cell: usize| states[cell] == self.target && self.last_visits[cell] <= forgotten;
            let ends = flights.iter().map(|flight| flight.end);
            let nearest = ends.fold(usize::MAX, |best, end| {
                nearest(self.shape, end, best, is_front)
            });
            self.distance.add(nearest as f64);
        }
    }
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.n += 1;
    }

    fn get(self) -> Option<f64> {
        (self.n > 0).then(|| self.sum / f64::from(self.n))
    }
}

/// Returns the moves to the nearest cell that satisfies `is_one`, or `best` if none is nearer.
fn nearest(shape: Shape, from: Cell, mut best: usize, is_one: impl Fn(usize) -> bool) -> usize {
    let (height, width) = shape.dim();
    for row_moves in 0..height {
        if row_moves >= best {
            break;
        }
        let above = from.row.checked_sub(row_moves);
        let below = Some(from.row + row_moves).filter(|&row| row_moves > 0 && row < height);
        for row in above.into_iter().chain(below) {
            let reach = best - row_moves;
            let last = from.col.saturating_add(reach).min(width - 1);
            for col in from.col.saturating_sub(reach)..=last {
                if is_one(row * width + col) {
                    best = best.min(row_moves + from.col.abs_diff(col));
                }
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    const FIRE: u8 = 2;

    /// For each step, the world and the cells that each robot visits.
    type Steps<'a> = [(&'a str, &'a [&'a [usize]])];

    /// Creates a world of one row, in which `#` burns.
    fn world(row: &str) -> Grid<u8> {
        let states = row.bytes().map(|cell| u8::from(cell == b'#') * FIRE);
        Grid::from_shape_vec((1, row.len()), states.collect()).expect("test world")
    }

    fn merit(steps: &Steps<'_>) -> Merit {
        let shape = Shape::new(1, steps[0].0.len()).expect("test shape");
        let mut tally = MeritTally::new(shape, FIRE);
        for (row, robots) in steps {
            let flight = |visited: &&[usize]| Flight {
                visited: visited.to_vec(),
                end: shape.cell(*visited.last().expect("a cell")),
            };
            let flights: Vec<Flight> = robots.iter().map(flight).collect();
            let states = world(row);
            let burns = |cell: &usize| states[[0, *cell]] == FIRE;
            let visited: BTreeSet<usize> = robots.concat().into_iter().collect();
            let found = Found {
                n_hits: visited.iter().filter(|cell| burns(cell)).count() as u32,
                n_burning: (0..row.len()).filter(burns).count() as u32,
            };
            tally.update(&flights, found, Some(&states));
        }
        tally.merit()
    }

    #[test]
    fn detection_is_the_first_visit_to_a_burning_cell() {
        // Cell 1 is visited before it burns, then missed. Cell 2 is found when two cells burn.
        // Later detections do not count.
        let worlds: [&Steps<'_>; 4] = [
            &[("....", &[&[0, 1]]), (".#..", &[&[2]]), (".##.", &[&[2]])],
            &[("#...", &[&[0]]), ("####", &[&[1]])],
            &[("...#", &[&[0]]), ("...#", &[&[1]])],
            &[("#....#.#", &[&[0, 1], &[4, 5]])],
        ];
        let got = worlds
            .map(merit)
            .map(|it| it.steps_to_detection.zip(it.burning_cells_at_detection));
        assert_eq!(got, [Some((3, 2)), Some((1, 1)), None, Some((1, 3))]);
    }

    #[test]
    fn recent_visits_of_all_robots_count_as_seen() {
        // Cell 0 counts as seen in steps 1 to 10, with the nearest unseen fire 3 moves away in the first, then 2. In the
        // steps after these, cell 0 is unseen fire, 1 move away.
        let mut long: Vec<(&str, &[&[usize]])> = vec![("#..#", &[&[1]]); 12];
        long[0].1 = &[&[0]];
        let front = (3.0 + 9.0 * 2.0 + 2.0) / 12.0;
        let worlds: [&Steps<'_>; 6] = [
            &long,
            &[("...#", &[&[0]]), ("...#", &[&[1]])],
            &[("....", &[&[0]]), ("....", &[&[1, 2]])],
            &[("....", &[&[0]]), ("#..#", &[&[1]])],
            &[("##..", &[&[1, 0]]), ("##..", &[&[2, 3]])],
            &[("#....#.#", &[&[0, 1], &[4, 5]])],
        ];
        for (steps, expected) in worlds.into_iter().zip([
            (Some(0.5 * 10.0 / 12.0), Some(front), 0.5),
            // The front is 3 moves away in one step and 2 in the other.
            (Some(0.0), Some(2.5), 0.5),
            // Without fire there is no share. Steps without fire do not count.
            (None, None, 0.75),
            (Some(0.5), Some(2.0), 0.5),
            // If all fire is seen, there is no front.
            (Some(1.0), None, 1.0),
            // The front is measured from cell 5 to cell 7, not from cell 1.
            (Some(2.0 / 3.0), Some(2.0), 0.5),
        ]) {
            let got = merit(steps);
            let got = (
                got.burning_seen_share,
                got.front_distance,
                got.grid_seen_share,
            );
            assert_eq!(got, expected, "{steps:?}");
        }
    }

    #[test]
    fn nearest_agrees_with_a_full_scan() {
        let shape = Shape::new(5, 7).expect("test shape");
        for seed in 0..100 {
            let drawn = |index: usize| emberwatch_model::randomness::split_mix(seed, index as u64);
            let is_one = |cell: usize| drawn(cell) % (seed + 2) == 0;
            let from = shape.cell(drawn(99) as usize % shape.n_cells());
            let moves = |cell: Cell| from.row.abs_diff(cell.row) + from.col.abs_diff(cell.col);
            let ones = (0..shape.n_cells()).filter(|&cell| is_one(cell));
            let expected = ones.map(|cell| moves(shape.cell(cell))).min();
            for best in [usize::MAX, 4] {
                let expected = expected.map_or(best, |moves| moves.min(best));
                assert_eq!(nearest(shape, from, best, is_one), expected, "seed {seed}");
            }
        }
    }
}
