//! The observation matrix `O`, and the loss of paper eqs. 8 and 11, which depends on it.

use crate::ops::cell_loss::LOG_FLOOR;
use crate::window::Window;
use candle_core::{Result, Tensor};
use candle_nn::ops::softmax;
use candle_nn::{Init, VarBuilder};

/// The learned observation matrix `P(y | x)`.
#[derive(Debug)]
pub struct ObservationMatrix {
    /// The logits, `[observations, states]`. The softmax of each column is a column of `O`.
    weight: Tensor,
}

impl ObservationMatrix {
    /// Creates a matrix for the given numbers of observations and states.
    pub fn new(vb: &VarBuilder<'_>, n_observations: usize, n_states: usize) -> Result<Self> {
        let (mean, stdev) = (0.0, 1.0);
        let dims = (n_observations, n_states);
        let weight = vb.get_with_hints(dims, "W_obs_param", Init::Randn { mean, stdev })?;
        Ok(Self { weight })
    }

    /// Returns the matrix, `[observations, states]`. Each column sums to one.
    pub fn matrix(&self) -> Result<Tensor> {
        softmax(&self.weight, 0)
    }

    /// Computes the mean cross-entropy of the cells to predict in a window, from logits `[frames, states, rows, cols]`,
    /// with candle's operators. The loss is computed as a weighted sum over all cells, without gather or scatter
    /// operations.
    pub fn loss(&self, logits: &Tensor, window: &Window) -> Result<Tensor> {
        let matrix = self.matrix()?;
        let u = softmax(logits, 1)?.permute((0, 2, 3, 1))?;
        let q = u.reshape(((), matrix.dim(1)?))?.matmul(&matrix.t()?)?;
        let [hits, misses] = weights(logits, window, &q)?;
        let hit = (hits * (&q + LOG_FLOOR)?.log()?)?;
        // Rounding can make q larger than 1, so limit 1 - q to at least 0.
        let miss = (misses * ((1.0 - &q)?.relu()? + LOG_FLOOR)?.log()?)?;
        (hit + miss)?.sum_all()
    }
}

/// Returns the weights of the terms `log q` and `log(1 - q)` in the loss, each `[cells, observations]` like `q`. The
/// first weights are nonzero for the observed values, the second weights for the other values of observed cells.
fn weights(logits: &Tensor, window: &Window, q: &Tensor) -> Result<[Tensor; 2]> {
    let (_, _, rows, cols) = logits.dims4()?;
    let (n, weight) = (q.dim(1)?, -1.0 / window.all_targets().len() as f32);
    let mut hits = vec![0.0_f32; q.elem_count()];
    let mut misses = hits.clone();
    for frame in 0..window.len() {
        for visit in window.targets(frame) {
            let cell = (frame * rows + usize::from(visit.row)) * cols + usize::from(visit.col);
            misses[cell * n..][..n].fill(weight);
            misses[cell * n + usize::from(visit.value)] = 0.0;
            hits[cell * n + usize::from(visit.value)] = weight;
        }
    }
    let tensor = |numbers| Tensor::from_vec(numbers, q.shape(), q.device())?.to_dtype(q.dtype());
    Ok([tensor(hits)?, tensor(misses)?])
}
