//! A robot's memory in addition to its belief: the age of each cell's last observation, and the rewards of its paths.

use emberwatch_model::{Frame, Grid, Shape};

/// Number of steps in which the freshness of a cell decays to `1/e`.
const FADING_STEPS: f32 = 300.0;

const LATEST_SHARE: f32 = 0.2;

/// The freshness of each cell, and recent rewards.
#[derive(Debug, Clone, PartialEq)]
pub struct Memory {
    /// `exp(-age / 300)`, with the steps since the cell was last seen as its age. 0 if it was never seen.
    freshness: Grid<f32>,
    pub recent: Recent,
}

/// The rewards of a robot's recent paths.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Recent {
    /// Reward per move of the last path.
    pub last_reward: f32,
    /// Exponential running mean of the reward per move.
    pub mean_reward: f32,
    /// Number of paths flown.
    pub n_paths: u64,
}

impl Memory {
    /// Creates the memory before the first frame.
    pub fn new(shape: Shape) -> Self {
        Self {
            freshness: Grid::zeros(shape.dim()),
            recent: Recent::default(),
        }
    }

    /// Ages all cells by one step, then records the cells of the step's frame as fresh.
    pub fn see(&mut self, frame: &Frame) {
        let fading = (-1.0 / FADING_STEPS).exp();
        self.freshness.mapv_inplace(|fresh| fresh * fading);
        let cells = self.freshness.as_slice_mut();
        let cells = cells.expect("invariant: grids are row-major");
        for (cell, _) in frame.observed() {
            cells[cell] = 1.0;
        }
    }

    /// Records the reward of a path.
    pub fn earn(&mut self, reward: f64, n_moves: usize) {
        let recent = &mut self.recent;
        recent.last_reward = reward as f32 / n_moves as f32;
        recent.mean_reward += LATEST_SHARE * (recent.last_reward - recent.mean_reward);
        recent.n_paths += 1;
    }

    /// Returns the novelty of each cell, shape `[H, W]`: 0 if the cell was just seen, 1 if it was never seen.
    pub fn novelty(&self) -> Grid<f32> {
        self.freshness.mapv(|fresh| 1.0 - fresh)
    }

    /// Returns the number of bytes of [`Self::to_bytes`] on a grid.
    pub fn n_bytes(shape: Shape) -> usize {
        4 * shape.n_cells() + 16
    }

    /// Encodes the memory as little-endian numbers: the freshness `[H, W]`, the last and the mean reward as `f32`, then
    /// the number of paths as `u64`.
    pub fn to_bytes(&self) -> Vec<u8> {
        let Recent {
            last_reward,
            mean_reward,
            n_paths,
        } = self.recent;
        let floats = self.freshness.iter().chain([&last_reward, &mean_reward]);
        let bytes = floats.flat_map(|number| number.to_le_bytes());
        bytes.chain(n_paths.to_le_bytes()).collect()
    }

    /// Decodes the bytes of [`Self::to_bytes`], or returns `None` if they are not a valid memory of the grid.
    pub fn from_bytes(bytes: &[u8], shape: Shape) -> Option<Self> {
        if bytes.len() != Self::n_bytes(shape) {
            return None;
        }
        let (floats, n_paths) = bytes.split_at(bytes.len() - 8);
        let floats = floats.as_chunks::<4>().0;
        let mut floats = floats.iter().map(|number| f32::from_le_bytes(*number));
        let cells = floats.by_ref().take(shape.n_cells()).collect();
        let memory = Self {
            freshness: Grid::from_shape_vec(shape.dim(), cells).ok()?,
            recent: Recent {
                last_reward: floats.next()?,
                mean_reward: floats.next()?,
                n_paths: u64::from_le_bytes(n_paths.try_into().ok()?),
            },
        };
        memory.is_of(shape).then_some(memory)
    }

    fn is_of(&self, shape: Shape) -> bool {
        let rewards = [self.recent.last_reward, self.recent.mean_reward];
        self.freshness.dim() == shape.dim()
            && self
                .freshness
                .iter()
                .all(|fresh| (0.0..=1.0).contains(fresh))
            && rewards.iter().all(|reward| reward.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn novelty_grows_with_time_since_the_last_visit() {
        let shape = Shape::new(1, 2).expect("test shape");
        let mut memory = Memory::new(shape);
        memory.see(&Frame::from_bytes(shape, 2, &[0, 255]).expect("a frame"));
        assert_eq!(memory.novelty().as_slice(), Some(&[0.0, 1.0][..]));
        for _ in 0..300 {
            memory.see(&Frame::empty(shape));
        }
        let novelty = memory.novelty();
        assert!((novelty[[0, 0]] - (1.0 - (-1.0_f32).exp())).abs() < 1e-4);
        assert_eq!(novelty[[0, 1]], 1.0);
        assert!(memory.is_of(shape));
        memory.earn(3.0, 4);
        let bytes = memory.to_bytes();
        assert_eq!(Memory::from_bytes(&bytes, shape), Some(memory.clone()));
        assert_eq!(Memory::from_bytes(&bytes[1..], shape), None);
        assert_eq!(Memory::from_bytes(&[0xff; 24], shape), None, "not numbers");
        assert!(!memory.is_of(Shape::new(2, 1).expect("test shape")));
    }

    #[test]
    fn rewards_are_remembered_per_move() {
        let mut memory = Memory::new(Shape::new(1, 1).expect("test shape"));
        [6.0, 0.0]
            .into_iter()
            .for_each(|reward| memory.earn(reward, 12));
        let recent = memory.recent;
        assert_eq!((recent.last_reward, recent.n_paths), (0.0, 2));
        assert!((recent.mean_reward - 0.08).abs() < 1e-6);
    }
}
