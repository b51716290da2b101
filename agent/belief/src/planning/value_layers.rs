//! The prospects of a robot: layers of values per cell, such as probability and novelty, and their sums over regions.

use crate::estimation::belief::Belief;
use crate::planning::memory::{Memory, Recent};
use emberwatch_model::{Airspace, Cell, Grid, Shape};
use ndarray::Zip;

/// Radius of a region. A region contains all cells of the grid within this number of rows and columns of its centre.
pub const REGION_RADIUS: usize = 6;

const CENTRE_STRIDE: usize = 4;

/// Probability of the paying state above which a cell is worth flying to.
const LIKELY: f32 = 0.3;

/// A quantity that is defined for each cell, from 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layer {
    /// Probability of the state with the highest reward.
    Probability,
    /// Amount by which the probability of the state with the highest reward exceeds 0.3, or 0 if it does not.
    Surplus,
    /// Entropy of the belief, as a fraction of the maximum `log S`.
    Entropy,
    /// The novelty of the cell (see [`Memory::novelty`]).
    Novelty,
}

impl Layer {
    pub const ALL: [Self; 4] = [
        Self::Probability,
        Self::Surplus,
        Self::Entropy,
        Self::Novelty,
    ];
}

/// The layers at one step, with sums over regions.
#[derive(Debug, Clone)]
pub struct ValueLayers {
    airspace: Airspace,
    layers: [Grid<f32>; 4],
    sums: [Sums; 4],
    /// Number of moves of a path.
    pub n_moves: usize,
    /// The rewards of the robot's recent paths.
    pub recent: Recent,
}

/// A summed-area table: sums over all rectangles that start at the top left cell, shape `[H + 1, W + 1]`.
#[derive(Debug, Clone)]
struct Sums(Grid<f64>);

impl ValueLayers {
    /// Computes the layers. `target` is the state with the highest reward.
    ///
    /// # Panics
    /// If the airspace and the belief have different grids.
    pub fn new(
        belief: &Belief,
        airspace: &Airspace,
        target: usize,
        memory: &Memory,
        n_moves: usize,
    ) -> Self {
        assert_eq!(
            airspace.shape(),
            belief.shape(),
            "airspace: expected the belief's grid"
        );
        let greatest = (belief.n_states() as f32).ln().max(f32::MIN_POSITIVE);
        let probability = belief.probability(target).to_owned();
        let surplus = probability.mapv(|p| (p - LIKELY).max(0.0));
        let entropy = belief.entropy() / greatest;
        let layers = [probability, surplus, entropy, memory.novelty()];
        let layers = Self {
            airspace: airspace.clone(),
            sums: layers.each_ref().map(Sums::of),
            layers,
            n_moves,
            recent: memory.recent,
        };
        let Some(no_fly) = airspace.no_fly() else {
            return layers;
        };
        let closed = no_fly.iter().enumerate().filter(|(_, closed)| **closed);
        layers.cleared(&closed.map(|(cell, _)| cell).collect::<Vec<_>>(), &[])
    }

    /// Sets layers to 0 in the cells that another robot visits, or, if they count in sight, sees.
    pub fn without(self, visited: &[usize]) -> Self {
        let seen = self.airspace.see(visited);
        self.cleared(visited, &seen)
    }

    fn cleared(mut self, visited: &[usize], seen: &[usize]) -> Self {
        for layer in Layer::ALL {
            let in_sight = self.counts_in_sight(layer);
            let cells = self.layers[layer as usize].as_slice_mut();
            let cells = cells.expect("invariant: grids are row-major");
            let cleared = if in_sight { seen } else { visited };
            cleared.iter().for_each(|&cell| cells[cell] = 0.0);
        }
        self.sums = self.layers.each_ref().map(Sums::of);
        self
    }

    pub fn shape(&self) -> Shape {
        self.airspace.shape()
    }

    pub fn airspace(&self) -> &Airspace {
        &self.airspace
    }

    /// Returns whether a layer counts in all cells in sight, not only on the path.
    pub fn counts_in_sight(&self, layer: Layer) -> bool {
        self.airspace.radius() > 0 && matches!(layer, Layer::Entropy | Layer::Novelty)
    }

    /// Returns a layer, shape `[H, W]`.
    pub fn layer(&self, layer: Layer) -> &Grid<f32> {
        &self.layers[layer as usize]
    }

    /// Returns the sum of a layer over the grid.
    pub fn total(&self, layer: Layer) -> f32 {
        let (height, width) = self.shape().dim();
        self.sums[layer as usize].0[[height, width]] as f32
    }

    /// Returns the sum of a layer over the region around a cell.
    pub fn around(&self, layer: Layer, centre: Cell) -> f32 {
        let (height, width) = self.shape().dim();
        let first = |at: usize| at.saturating_sub(REGION_RADIUS);
        let end = |at: usize, side: usize| (at + REGION_RADIUS + 1).min(side);
        let (top, left) = (first(centre.row), first(centre.col));
        let (bottom, right) = (end(centre.row, height), end(centre.col, width));
        let sums = &self.sums[layer as usize].0;
        let sum = sums[[bottom, right]] - sums[[top, right]] - sums[[bottom, left]];
        (sum + sums[[top, left]]).max(0.0) as f32
    }

    /// Lists the centres of the regions that are compared.
    pub fn centres(&self) -> impl Iterator<Item = Cell> + use<> {
        let (height, width) = self.shape().dim();
        let along = |side: usize| ((CENTRE_STRIDE / 2).min(side - 1)..side).step_by(CENTRE_STRIDE);
        along(height).flat_map(move |row| along(width).map(move |col| Cell { row, col }))
    }

    /// Returns the centre of the region with the highest discounted sum of a layer, among regions more than half a path
    /// away. The sum is multiplied by `kept_per_path` for each path on the way to the region. If all sums are 0,
    /// returns the robot's cell.
    pub fn best_region(&self, layer: Layer, robot: Cell, kept_per_path: f32) -> Cell {
        let mut best = (0.0, robot);
        for centre in self.centres() {
            let distance = distance(robot, centre);
            if distance <= self.n_moves / 2 {
                continue;
            }
            let n_paths = distance as f32 / self.n_moves as f32;
            let promise = self.around(layer, centre) * kept_per_path.powf(n_paths);
            if promise > best.0 {
                best = (promise, centre);
            }
        }
        best.1
    }
}

/// Returns the number of moves from one cell to another.
pub fn distance(from: Cell, to: Cell) -> usize {
    from.row.abs_diff(to.row) + from.col.abs_diff(to.col)
}

impl Sums {
    fn of(layer: &Grid<f32>) -> Self {
        let (height, width) = layer.dim();
        let mut sums = Grid::zeros((height + 1, width + 1));
        let mut above = vec![0.0; width];
        for (row, cells) in layer.rows().into_iter().enumerate() {
            let mut sum = 0.0;
            let below = sums.slice_mut(ndarray::s![row + 1, 1..]);
            Zip::from(below)
                .and(&cells)
                .and(&mut above[..])
                .for_each(|below, &cell, above| {
                    sum += f64::from(cell);
                    *above += sum;
                    *below = *above;
                });
        }
        Self(sums)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_around_a_cell_agree_with_plain_sums() {
        for (height, width) in [(1, 1), (3, 20), (20, 15), (64, 64)] {
            let shape = Shape::new(height, width).expect("test shape");
            let states = Grid::from_shape_fn((height, width), |(row, col)| {
                (emberwatch_model::randomness::split_mix(row as u64, col as u64) % 3) as u8
            });
            let belief = Belief::from_states(&states, 3).expect("valid states");
            let open = Airspace::open(shape);
            let layers = ValueLayers::new(&belief, &open, 2, &Memory::new(shape), 12);
            let cells = |layer| layers.layer(layer).indexed_iter();
            for centre in layers.centres().chain([layers.shape().cell(0)]) {
                let near = |(row, col): (usize, usize)| {
                    row.abs_diff(centre.row) <= 6 && col.abs_diff(centre.col) <= 6
                };
                for layer in Layer::ALL {
                    let region = cells(layer).filter(|(at, _)| near(*at));
                    let expected: f32 = region.map(|(_, value)| value).sum();
                    let got = layers.around(layer, centre);
                    assert!((got - expected).abs() < 1e-3, "{centre}: {got} {expected}");
                }
            }
            let total: f32 = cells(Layer::Probability).map(|(_, value)| value).sum();
            assert!((layers.total(Layer::Probability) - total).abs() < 1e-3);
        }
    }

    #[test]
    fn the_best_region_trades_value_against_distance() {
        let shape = Shape::new(64, 64).expect("test shape");
        let mut states = Grid::zeros((64, 64));
        // Two fires: a burning cell nearby, and two burning cells several paths away.
        for (row, col) in [(2, 20), (40, 50), (41, 50)] {
            states[[row, col]] = 2;
        }
        let belief = Belief::from_states(&states, 3).expect("valid states");
        let layers = ValueLayers::new(&belief, &Airspace::open(shape), 2, &Memory::new(shape), 12);
        let robot = Cell { row: 2, col: 2 };
        let best = |kept| layers.best_region(Layer::Surplus, robot, kept);
        assert!(distance(best(1.0), Cell { row: 40, col: 50 }) <= 12);
        assert!(distance(best(0.5), Cell { row: 2, col: 20 }) <= 12);
        assert_eq!(layers.best_region(Layer::Entropy, robot, 1.0), robot);
        let there = Cell { row: 40, col: 50 };
        let left = layers.without(&[40 * 64 + 50, 41 * 64 + 50]);
        assert!(distance(left.best_region(Layer::Surplus, robot, 1.0), there) > 12);
    }
}
