//! Adam, as PyTorch has it, with moments that can be saved.

use super::lanes::{Arithmetic, Kernel, dispatch};
use serde::{Deserialize, Serialize};

/// Settings of Adam.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdamSettings {
    /// Step size.
    pub learning_rate: f32,
    /// How slowly the two moments forget.
    pub betas: [f32; 2],
    /// Added to the root of the second moment.
    pub epsilon: f32,
}

impl AdamSettings {
    /// The authors' betas, .5 and .9, with a step size.
    pub fn paper(learning_rate: f32) -> Self {
        Self {
            learning_rate,
            betas: [0.5, 0.9],
            epsilon: 1e-8,
        }
    }
}

/// Adam's moments.
#[derive(Debug, Clone)]
pub struct Adam {
    pub(crate) first: Vec<f32>,
    pub(crate) second: Vec<f32>,
    pub(crate) step: u64,
}

impl Adam {
    /// Before the first step.
    pub fn new(n_parameters: usize) -> Self {
        Self {
            first: vec![0.0; n_parameters],
            second: vec![0.0; n_parameters],
            step: 0,
        }
    }

    /// Moves parameters against their gradient.
    pub fn step(&mut self, settings: &AdamSettings, parameters: &mut [f32], gradient: &[f32]) {
        dispatch(Step {
            adam: self,
            settings,
            parameters,
            gradient,
        });
    }

    /// [`Self::step`] with the vectors of the caller. Sums and products are rounded one by one, so it
    /// gives the same bits with all.
    #[inline(always)]
    pub(crate) fn move_by(
        &mut self,
        settings: &AdamSettings,
        parameters: &mut [f32],
        gradient: &[f32],
    ) {
        self.step += 1;
        let bias = |beta: f32| 1.0 - f64::from(beta).powf(self.step as f64);
        let rate = (f64::from(settings.learning_rate) / bias(settings.betas[0])) as f32;
        let root = (1.0 / bias(settings.betas[1]).sqrt()) as f32;
        let [first, second] = settings.betas;
        let moments = self.first.iter_mut().zip(&mut self.second);
        for ((parameter, d), (m, v)) in parameters.iter_mut().zip(gradient).zip(moments) {
            *m = flushed(first * *m + (1.0 - first) * d);
            *v = flushed(second * *v + (1.0 - second) * d * d);
            *parameter -= rate * *m / (v.sqrt() * root + settings.epsilon);
        }
    }
}

/// Zero for a subnormal number, which is where a moment stays whose gradient is zero, and which takes
/// some processors a hundred times as long.
#[inline(always)]
fn flushed(number: f32) -> f32 {
    if number.abs() < f32::MIN_POSITIVE {
        0.0
    } else {
        number
    }
}

struct Step<'a> {
    adam: &'a mut Adam,
    settings: &'a AdamSettings,
    parameters: &'a mut [f32],
    gradient: &'a [f32],
}

impl Kernel for Step<'_> {
    #[inline(always)]
    fn run<A: Arithmetic>(self) {
        self.adam
            .move_by(self.settings, self.parameters, self.gradient);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `torch.optim.Adam([p], lr=.1, betas=(.5, .9))` on `p = 1, -2`, gradients `(.5, -3)`, `(.25, 4)`:
    /// the formulas of Kingma and Ba in 64 bits.
    #[test]
    fn two_steps_are_those_of_the_published_formulas() {
        let settings = AdamSettings::paper(0.1);
        let mut parameters = [1.0, -2.0];
        let mut adam = Adam::new(2);
        let mut exact = [1.0_f64, -2.0];
        let (mut m, mut v) = ([0.0; 2], [0.0; 2]);
        for (step, gradient) in [(1, [0.5_f32, -3.0]), (2, [0.25, 4.0])] {
            adam.step(&settings, &mut parameters, &gradient);
            for index in 0..2 {
                let d = f64::from(gradient[index]);
                m[index] = 0.5 * m[index] + 0.5 * d;
                v[index] = 0.9 * v[index] + 0.1 * d * d;
                let m_hat = m[index] / (1.0 - 0.5_f64.powi(step));
                let v_hat: f64 = v[index] / (1.0 - 0.9_f64.powi(step));
                exact[index] -= 0.1 * m_hat / (v_hat.sqrt() + 1e-8);
                assert!((f64::from(parameters[index]) - exact[index]).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn moments_without_a_gradient_end_at_zero() {
        let mut adam = Adam::new(1);
        let settings = AdamSettings::paper(0.1);
        adam.step(&settings, &mut [0.0], &[1e-3]);
        for _ in 0..2000 {
            adam.step(&settings, &mut [0.0], &[0.0]);
        }
        assert_eq!((adam.first[0], adam.second[0]), (0.0, 0.0));
    }
}
