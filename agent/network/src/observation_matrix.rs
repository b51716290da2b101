//! The observation matrix `O`, and the loss of paper eqs. 8 and 11 behind it.

use crate::ops::cell_loss::LOG_FLOOR;
use crate::window::Window;
use candle_core::{Result, Tensor};
use candle_nn::ops::softmax;
use candle_nn::{Init, VarBuilder};

/// `P(y | x)`, learned.
#[derive(Debug)]
pub struct ObservationMatrix {
    /// Before the softmax of each column, `[observations, states]`.
    weight: Tensor,
}

impl ObservationMatrix {
    /// A matrix for so many observations and states.
    pub fn new(vb: &VarBuilder<'_>, n_observations: usize, n_states: usize) -> Result<Self> {
        let (mean, stdev) = (0.0, 1.0);
        let dims = (n_observations, n_states);
        let weight = vb.get_with_hints(dims, "W_obs_param", Init::Randn { mean, stdev })?;
        Ok(Self { weight })
    }

    /// The matrix, `[observations, states]`; each column sums to one.
    pub fn matrix(&self) -> Result<Tensor> {
        softmax(&self.weight, 0)
    }

    /// The cross-entropy of what a window's targets showed, the mean over them, from logits `[frames, states,
    /// rows, cols]`, by stock operators.
    pub fn loss(&self, logits: &Tensor, window: &Window) -> Result<Tensor> {
        let (matrix, targets) = (self.matrix()?, window.all_targets());
        let u = softmax(&at_targets(logits, window)?, 1)?;
        let q = u.matmul(&matrix.t()?)?;
        let y = one_hot(window, &q)?;
        let hit = (&y * (&q + LOG_FLOOR)?.log()?)?;
        // Rounding may take q above one.
        let miss = ((1.0 - &y)? * ((1.0 - &q)?.relu()? + LOG_FLOOR)?.log()?)?;
        (hit + miss)?.sum_all()?.neg()? / targets.len() as f64
    }
}

/// The logits of the targets, `[targets, states]`.
fn at_targets(logits: &Tensor, window: &Window) -> Result<Tensor> {
    let (_, n_states, rows, cols) = logits.dims4()?;
    let cells = (0..window.len()).flat_map(|frame| {
        let targets = window.targets(frame).iter();
        targets.map(move |visit| {
            let (row, col) = (usize::from(visit.row), usize::from(visit.col));
            ((frame * rows + row) * cols + col) as u32
        })
    });
    let cells = Tensor::new(cells.collect::<Vec<u32>>(), logits.device())?;
    let by_cell = logits.permute((0, 2, 3, 1))?.reshape(((), n_states))?;
    by_cell.index_select(&cells, 0)
}

/// What the targets showed, as rows like those of `q`.
fn one_hot(window: &Window, q: &Tensor) -> Result<Tensor> {
    let mut rows = vec![0.0_f32; q.elem_count()];
    let n_observations = q.dim(1)?;
    for (row, visit) in rows
        .chunks_exact_mut(n_observations)
        .zip(window.all_targets())
    {
        row[usize::from(visit.value)] = 1.0;
    }
    let rows = Tensor::from_vec(rows, q.shape(), q.device())?;
    rows.to_dtype(q.dtype())
}
