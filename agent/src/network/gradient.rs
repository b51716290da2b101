//! Loss and gradient of trajectories: encoder, recurrence, decoder, and back (paper eqs. 7 to 11).

use super::batch_norm::Norm;
use super::decoder::{Decoder, DecoderLayers};
use super::dropout::Dropout;
use super::encoder::Encoder;
use super::gru::{self, Gru, Trace};
use super::lanes::dispatch;
use super::loss::LossSettings;
use super::parameters::{DECODER_NORMS, ENCODER, Tensors};
use super::shape::NetworkShape;
use super::window::Window;

/// A sampled trajectory, and what is drawn at random for it.
#[derive(Debug, Clone, Copy)]
pub struct Trajectory<'a> {
    /// Its frames.
    pub window: &'a Window,
    /// The channels that it loses.
    pub dropout: &'a Dropout,
    /// `h_0`.
    pub first: &'a [f32],
}

/// Room for windows of one length.
#[derive(Debug)]
pub(crate) struct Workspace {
    shape: NetworkShape,
    n_frames: usize,
    encoder: Encoder,
    decoder: Decoder,
    pub(crate) gradient: Tensors,
}

impl Workspace {
    /// For windows of `n_frames`.
    pub(crate) fn new(shape: &NetworkShape, parameters: &Tensors, n_frames: usize) -> Self {
        let layers = DecoderLayers::new(shape, parameters);
        Self {
            shape: *shape,
            n_frames,
            encoder: Encoder::new(shape, n_frames),
            decoder: Decoder::new(shape, n_frames, &layers),
            gradient: parameters.zeros_like(),
        }
    }

    pub(crate) fn n_frames(&self) -> usize {
        self.n_frames
    }

    /// The mean loss of trajectories (`1 / L` of eqs. 8 and 11), of which each counts alike; leaves its
    /// gradient in `self.gradient` and moves the running statistics by one after the other.
    pub(crate) fn mean_loss_and_gradient(
        &mut self,
        parameters: &Tensors,
        statistics: &mut Tensors,
        trajectories: &[Trajectory<'_>],
        settings: &LossSettings,
    ) -> f64 {
        let mut loss = self.loss_and_gradient(parameters, statistics, trajectories[0], settings);
        for &trajectory in &trajectories[1..] {
            let before = self.gradient.numbers.clone();
            loss += self.loss_and_gradient(parameters, statistics, trajectory, settings);
            let sums = self.gradient.numbers.iter_mut().zip(before);
            sums.for_each(|(sum, d)| *sum += d);
        }
        let share = 1.0 / trajectories.len() as f32;
        let gradient = self.gradient.numbers.iter_mut();
        gradient.for_each(|d| *d *= share);
        loss / trajectories.len() as f64
    }

    /// The loss of a trajectory; leaves the gradient in `self.gradient` and moves the running statistics.
    fn loss_and_gradient(
        &mut self,
        parameters: &Tensors,
        statistics: &mut Tensors,
        trajectory: Trajectory<'_>,
        settings: &LossSettings,
    ) -> f64 {
        let Trajectory {
            window,
            dropout,
            first,
        } = trajectory;
        assert_eq!(window.len(), self.n_frames, "frames of a window");
        let gradient = &mut self.gradient;
        let (encodings, encoder) = self.encoder.forward(parameters, window, dropout);
        let gru = Gru::new(parameters, self.shape.encoding, self.shape.hidden);
        let mut trace = Trace::default();
        dispatch(gru::Forward {
            gru: &gru,
            first,
            encodings: &encodings,
            trace: &mut trace,
        });
        let hidden = &trace.hidden[self.shape.hidden..];
        let mut decoder = DecoderLayers::new(&self.shape, parameters);
        self.decoder
            .forward(parameters, &mut decoder, hidden, dropout);
        let targets = (window, settings);
        let loss = self
            .decoder
            .loss(parameters, &decoder, targets, dropout, gradient);
        let d_hidden = self.decoder.backward(&decoder, hidden, dropout, gradient);
        let mut d_encodings = Vec::new();
        dispatch(gru::Backward {
            gru: &gru,
            trace: &trace,
            encodings: &encodings,
            d_hidden: &d_hidden,
            d_encodings: &mut d_encodings,
            gradient,
        });
        self.encoder
            .backward(&encoder, window, dropout, &d_encodings, gradient);
        let norms = ENCODER
            .map(|[_, norm]| norm)
            .into_iter()
            .zip(&encoder.norms);
        for (name, norm) in norms.chain(DECODER_NORMS.into_iter().zip(&decoder.norms)) {
            update_running(statistics, name, norm);
        }
        loss
    }
}

/// Moves the running statistics of one normalisation.
fn update_running(statistics: &mut Tensors, name: &str, norm: &Norm) {
    let [mean, variance] = ["running_mean", "running_var"].map(|what| format!("{name}.{what}"));
    let mut new_mean = statistics.get(&mean).to_vec();
    let new_variance = statistics.get_mut(&variance);
    norm.statistics()
        .update_running(&mut new_mean, new_variance);
    statistics.get_mut(&mean).copy_from_slice(&new_mean);
}

#[cfg(test)]
mod tests {
    use crate::network::lanes::Width;
    use crate::network::lanes::tests::at_width;
    use crate::network::{Autoencoder, AutoencoderSettings, Dqn, DqnSettings, Transition, Window};
    use protocol::frame::Frame;
    use protocol::grid::Shape;
    use protocol::randomness::split_mix;

    /// Named numbers.
    type Numbers = Vec<(String, Vec<f32>)>;

    /// Frames in which one cell of `one_in` is seen.
    fn frames(shape: Shape, one_in: u64) -> Vec<Frame> {
        let frame = |index: u64| {
            let mut frame = Frame::empty(shape);
            for cell in 0..shape.n_cells() {
                let bits = split_mix(index, cell as u64);
                if bits.is_multiple_of(one_in) {
                    frame.observe(cell, ((bits >> 32) % 3) as u8);
                }
            }
            frame
        };
        (0..24).map(frame).collect()
    }

    /// Loss and gradient of an update, and the prediction of a step after it.
    fn autoencoder(grid: [usize; 2], one_in: u64) -> Numbers {
        let shape = Shape::new(grid[0], grid[1]).expect("shape");
        let frames = frames(shape, one_in);
        let mut network = Autoencoder::new(AutoencoderSettings::paper_large(), shape, 3, 3, 1);
        let loss = network.update(&Window::new(&frames)).expect("finite");
        let gradient = network.gradient().expect("an update").iter();
        let mut numbers: Numbers = gradient
            .map(|(name, _, numbers)| (name.to_owned(), numbers.to_vec()))
            .collect();
        network.step(&frames[0]).expect("possible frame");
        let prediction = network.prediction().as_slice().to_vec();
        numbers.extend([
            ("loss".into(), vec![loss as f32]),
            ("prediction".into(), prediction),
        ]);
        numbers
    }

    fn dqn() -> Numbers {
        let number = |index: u64| (split_mix(7, index) >> 40) as f32 / (1 << 24) as f32;
        let vector = |first: u64| (0..5).map(|i| number(first + i)).collect();
        let transition = |row: u64| Transition {
            input: vector(row * 100),
            action: (row % 3) as usize,
            reward: number(row * 100 + 50),
            next: vector(row * 100 + 20),
        };
        let batch: Vec<Transition> = (0..50).map(transition).collect();
        let mut dqn = Dqn::new(DqnSettings::paper(), 5, 3, 1);
        let loss = dqn.learn(&batch).expect("finite");
        let values = dqn.values(&batch[0].input);
        vec![("loss".into(), vec![loss]), ("values".into(), values)]
    }

    /// No tensor differs by more than a share of its largest number.
    fn check(what: &str, numbers: impl Fn() -> Numbers + Sync) {
        let narrowest = at_width(Width::Portable, &numbers);
        for width in [Width::Avx2, Width::Avx512] {
            let others = at_width(width, &numbers);
            for ((name, one), (_, other)) in narrowest.iter().zip(&others) {
                let largest = one.iter().fold(1e-6_f32, |largest, x| largest.max(x.abs()));
                let apart = one
                    .iter()
                    .zip(other)
                    .map(|(one, other)| (one - other).abs());
                let worst = apart.fold(0.0, f32::max) / largest;
                assert!(worst < 1e-3, "{what}, {width:?}, {name}: off by {worst}");
            }
            if Width::widest() >= Width::Avx2 {
                assert_ne!(narrowest, others, "{what}: both with {width:?}");
            }
        }
    }

    #[test]
    fn every_vector_width_gives_the_same_updates_and_steps_up_to_rounding() {
        check("paths", || autoencoder([64, 64], 100));
        check("full frames", || autoencoder([64, 64], 1));
        check("a padded grid", || autoencoder([20, 33], 10));
        check("dqn", dqn);
    }
}
