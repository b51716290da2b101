//! Adam (Kingma and Ba, 2015, algorithm 1) for the filter's three tensors.

use emberwatch_belief::estimation::parameters::{Dimensions, Parameters};

const BETAS: [f64; 2] = [0.9, 0.99];

const EPSILON: f64 = 1e-8;

#[derive(Debug, Clone, PartialEq)]
pub struct Adam {
    pub first: Parameters,
    pub second: Parameters,
    pub n_steps: u64,
}

impl Adam {
    pub fn new(dimensions: Dimensions) -> Self {
        Self {
            first: Parameters::zeros(dimensions),
            second: Parameters::zeros(dimensions),
            n_steps: 0,
        }
    }

    /// Makes one step. `rates` contains the step size of each tensor.
    pub fn step(&mut self, parameters: &mut Parameters, gradient: &Parameters, rates: [f64; 3]) {
        let [beta1, beta2] = BETAS;
        self.n_steps += 1;
        let steps = self.n_steps.min(1 << 30) as i32;
        let corrections = BETAS.map(|beta| 1.0 - beta.powi(steps));
        for (tensor, rate) in rates.into_iter().enumerate() {
            let moments = self.first.tensors[tensor]
                .iter_mut()
                .zip(&mut self.second.tensors[tensor]);
            let numbers = parameters.tensors[tensor].iter_mut();
            let slopes = &gradient.tensors[tensor];
            for ((number, (first, second)), &slope) in numbers.zip(moments).zip(slopes) {
                let slope = f64::from(slope);
                let mean = beta1 * f64::from(*first) + (1.0 - beta1) * slope;
                let square = beta2 * f64::from(*second) + (1.0 - beta2) * slope * slope;
                (*first, *second) = (mean as f32, square as f32);
                let root = (square / corrections[1]).sqrt();
                *number -= (rate * mean / corrections[0] / (root + EPSILON)) as f32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_has_the_size_of_the_rate() {
        let dimensions = Dimensions {
            n_states: 2,
            n_observations: 2,
            kernel: (1, 1),
        };
        let mut parameters = Parameters::zeros(dimensions);
        let mut gradient = Parameters::zeros(dimensions);
        gradient.tensors[0] = vec![3.0, -0.2, 0.0, 1.0];
        let rates = [0.5, 0.1, 0.1];
        let mut adam = Adam::new(dimensions);
        adam.step(&mut parameters, &gradient, rates);
        let close = |got: &[f32], expected: &[f32]| {
            let near = got.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6);
            assert!(near, "{got:?} {expected:?}");
        };
        close(&parameters.tensors[0], &[-0.5, 0.5, 0.0, -0.5]);
        // The second gradient is -g: the mean is (.9 * .1 - .1) g = -.01 g, divided by 1 - .81. The mean square is g^2
        // again.
        gradient.tensors[0] = vec![-3.0, 0.2, 0.0, -1.0];
        adam.step(&mut parameters, &gradient, rates);
        let back = 0.5 * 0.01 / 0.19;
        close(&parameters.tensors[0][..2], &[-0.5 + back, 0.5 - back]);
    }
}
