//! A belief in a few numbers: what a learner outside, or a DQN, sees in place of the paper's `h_k`.
//!
//! The numbers are as many for every grid, from 0 to 1. With S states there are S + 1 layers: the
//! probability of each state, and the entropy of each cell as a share of the greatest, `log S`. Each
//! layer gives its mean over the grid, its mean around the robot, and its means over 4 x 4 blocks.

use crate::estimation::belief::{Belief, EntropyKind};
use ndarray::{ArrayView2, s};
use protocol::{Cell, Grid, Model};
use std::ops::Range;

/// Blocks along each side of the grid.
pub const N_BLOCKS: usize = 4;

/// Numbers in the summary of a model with this many states: `18 (S + 1) + 2`.
pub fn summary_length(n_states: usize) -> usize {
    (n_states + 1) * (2 + N_BLOCKS * N_BLOCKS) + 2
}

/// A name for each number: `mean_<layer>` of all layers, `near_<layer>` of all, then
/// `block_<layer>_<row>_<col>` layer by layer, then `robot_row` and `robot_col`. The layers are the
/// model's states, then `entropy`.
pub fn summary_names(model: &Model) -> Vec<String> {
    let states = model.file().states.iter().map(|state| state.name.as_str());
    let layers: Vec<&str> = states.chain(["entropy"]).collect();
    let of_all = |kind: &str| -> Vec<String> {
        let name = |layer| format!("{kind}_{layer}");
        layers.iter().map(name).collect()
    };
    let blocks = layers.iter().flat_map(|layer| {
        block_indices().map(move |(row, col)| format!("block_{layer}_{row}_{col}"))
    });
    let robot = ["robot_row", "robot_col"].map(String::from);
    [of_all("mean"), of_all("near"), blocks.collect()]
        .concat()
        .into_iter()
        .chain(robot)
        .collect()
}

/// The summary of a belief; the robot's cell must lie on its grid.
///
/// `near_*` are means over the cells within `n_moves / 2` rows and columns of the robot; the window ends
/// at the grid's edge. `block_*` are means over blocks as equal as possible, block (0, 0) at the top left;
/// where the grid has fewer than 4 rows or columns, neighbouring blocks show the same cells. `robot_row`
/// and `robot_col` are 0 in the first row or column and 1 in the last.
pub fn summarise(belief: &Belief, robot: Cell, n_moves: usize) -> Vec<f32> {
    let (height, width) = belief.shape().dim();
    let (rows, cols) = (
        near(robot.row, n_moves / 2, height),
        near(robot.col, n_moves / 2, width),
    );
    let entropy = normalised_entropy(belief);
    let states = (0..belief.n_states()).map(|state| belief.probability(state));
    let layers: Vec<ArrayView2<'_, f32>> = states.chain([entropy.view()]).collect();
    let means = layers.iter().map(|layer| mean(layer, 0..height, 0..width));
    let around = layers
        .iter()
        .map(|layer| mean(layer, rows.clone(), cols.clone()));
    let blocks = layers.iter().flat_map(|layer| {
        block_indices().map(move |(row, col)| mean(layer, block(row, height), block(col, width)))
    });
    let robot = [scaled(robot.row, height), scaled(robot.col, width)];
    means.chain(around).chain(blocks).chain(robot).collect()
}

/// What a DQN sees of a belief: the summary's square roots, which spread small probabilities.
pub fn spread_summary(belief: &Belief, robot: Cell, n_moves: usize) -> Vec<f32> {
    let summary = summarise(belief, robot, n_moves);
    summary.into_iter().map(f32::sqrt).collect()
}

/// Entropy of each cell as a share of `log S`, shape `[H, W]`; 0 for a model of one state.
fn normalised_entropy(belief: &Belief) -> Grid<f32> {
    let greatest = (belief.n_states() as f32).ln();
    let mut entropy = belief.entropy(EntropyKind::Sum);
    if greatest > 0.0 {
        entropy.mapv_inplace(|h| h / greatest);
    }
    entropy
}

/// Mean over some rows and columns, neither empty: row by row in `f32`, across rows in `f64`.
fn mean(layer: &ArrayView2<'_, f32>, rows: Range<usize>, cols: Range<usize>) -> f32 {
    let part = layer.slice(s![rows, cols]);
    let total: f64 = part
        .rows()
        .into_iter()
        .map(|row| f64::from(row.sum()))
        .sum();
    // Rounding may leave a mean a hair outside of what it is a mean of.
    ((total / part.len() as f64) as f32).clamp(0.0, 1.0)
}

fn block_indices() -> impl Iterator<Item = (usize, usize)> {
    (0..N_BLOCKS * N_BLOCKS).map(|index| (index / N_BLOCKS, index % N_BLOCKS))
}

/// The rows or columns of a block of the grid, of [`N_BLOCKS`] on this side; never none.
pub(crate) fn block(index: usize, side: usize) -> Range<usize> {
    let start = index * side / N_BLOCKS;
    start..((index + 1) * side / N_BLOCKS).max(start + 1)
}

/// The rows or columns at most this far away.
fn near(at: usize, radius: usize, side: usize) -> Range<usize> {
    at.saturating_sub(radius)..(at + radius + 1).min(side)
}

fn scaled(at: usize, side: usize) -> f32 {
    at as f32 / (side - 1).max(1) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Probabilities, Shape};

    fn named(belief: &Belief, robot: Cell, n_moves: usize, name: &str) -> f32 {
        let names = summary_names(&Model::wildfire());
        let at = names.iter().position(|known| known == name).expect(name);
        summarise(belief, robot, n_moves)[at]
    }

    #[test]
    fn every_number_has_a_name_of_its_own() {
        let names = summary_names(&Model::wildfire());
        assert_eq!(names.len(), 74);
        assert_eq!(names.len(), summary_length(3));
        let distinct: std::collections::BTreeSet<&String> = names.iter().collect();
        assert_eq!(distinct.len(), names.len());
        assert_eq!(
            names[..4],
            ["mean_normal", "mean_latent", "mean_fire", "mean_entropy"]
        );
        assert_eq!([&names[4], &names[8]], ["near_normal", "block_normal_0_0"]);
        assert_eq!([&names[71], &names[72]], ["block_entropy_3_3", "robot_row"]);
    }

    #[test]
    fn blocks_cover_every_grid_and_are_as_equal_as_can_be() {
        for side in 1..=70 {
            let blocks: Vec<Range<usize>> = (0..N_BLOCKS).map(|i| block(i, side)).collect();
            let lengths = blocks.iter().map(|block| block.len());
            let (least, most) = (lengths.clone().min(), lengths.clone().max());
            assert!(
                least >= Some(1) && blocks[3].end == side,
                "{side}: {blocks:?}"
            );
            assert!(blocks[0].start == 0 && most <= least.map(|least| least + 1));
            if side >= N_BLOCKS {
                assert_eq!(lengths.sum::<usize>(), side);
            }
        }
    }

    #[test]
    fn a_fire_is_found_where_it_burns() {
        let shape = Shape::new(8, 12).expect("test shape");
        let mut states = Grid::zeros((8, 12));
        states[[0, 11]] = 2;
        states[[1, 9]] = 2;
        let belief = Belief::from_states(&states, 3).expect("valid states");
        let (near, far) = (Cell { row: 2, col: 9 }, Cell { row: 7, col: 0 });
        let fire = |name| named(&belief, near, 4, name);
        assert_eq!(fire("mean_fire"), 2.0 / 96.0);
        assert_eq!(fire("block_fire_0_3"), 2.0 / 6.0);
        assert_eq!(fire("block_fire_1_3"), 0.0);
        // Rows 0 to 4, columns 7 to 11.
        assert_eq!(fire("near_fire"), 2.0 / 25.0);
        assert_eq!(fire("mean_entropy"), 0.0);
        assert_eq!(fire("robot_row"), 2.0 / 7.0);
        assert_eq!(named(&belief, far, 4, "near_fire"), 0.0);
        assert_eq!(named(&belief, far, 4, "robot_row"), 1.0);
        let unsure = Belief::uniform(3, shape);
        assert!((named(&unsure, far, 4, "mean_entropy") - 1.0).abs() < 1e-6);
    }

    #[test]
    fn small_grids_show_the_same_cells_in_several_blocks() {
        let numbers = [[0.25, 0.75], [0.75, 0.25]];
        let numbers = Probabilities::from_shape_fn((2, 1, 2), |(m, _, col)| numbers[m][col]);
        let belief = Belief::from_probabilities(numbers).expect("valid");
        let summary = summarise(&belief, Cell { row: 0, col: 1 }, 1);
        assert_eq!(summary.len(), summary_length(2));
        // Means and surroundings of three layers, then the blocks of the first.
        assert_eq!(summary[6..10], [0.25, 0.25, 0.75, 0.75]);
        assert_eq!(summary[6..10], summary[18..22]);
        assert_eq!(summary[3], 0.75, "radius 0: the robot's cell alone");
        assert_eq!(summary[summary.len() - 2..], [0.0, 1.0]);
    }
}
