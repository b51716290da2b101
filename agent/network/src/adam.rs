//! The Adam optimiser for candle variables, equivalent to PyTorch's, with moments that can be saved.

use crate::error::{NetworkError, NotFinite};
use crate::tensors::{Change, copied, set, zero_if_finite};
use crate::variables::{Variables, is_statistic};
use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor, Var};

/// A constant that is added to moments and subtracted again. Because of rounding, moments whose gradients stay zero
/// then stop decaying at a few rounding errors of this constant. Moments therefore never become subnormal numbers,
/// which some processors handle a hundred times more slowly.
const FLUSH: f64 = 1e-30;

/// Settings of Adam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamSettings {
    /// The learning rate.
    pub learning_rate: f32,
    /// Decay rates of the two moments.
    pub betas: [f32; 2],
    /// A constant that is added to the square root of the second moment.
    pub epsilon: f32,
    /// Maximum Euclidean norm of all gradients together. Larger gradients are scaled down to it.
    pub max_norm: Option<f32>,
}

impl AdamSettings {
    /// Returns the authors' settings, with betas 0.5 and 0.9, and the given learning rate.
    pub fn paper(learning_rate: f32) -> Self {
        Self {
            learning_rate,
            betas: [0.5, 0.9],
            epsilon: 1e-8,
            max_norm: None,
        }
    }
}

/// The optimiser: variables to learn, and the two moments of each parameter.
#[derive(Debug, Clone)]
pub struct Adam {
    variables: Variables,
    /// The two moments of each parameter, named `first.<name>` and `second.<name>`.
    moments: Variables,
    steps: u64,
}

impl Adam {
    /// Creates the optimiser before the first step.
    pub fn new(variables: Variables) -> Result<Self> {
        let parameters = variables.iter().filter(|(name, _)| !is_statistic(name));
        let moments = parameters.flat_map(|(name, var)| {
            names(name).map(|name| Ok((name, Var::from_tensor(&var.zeros_like()?)?)))
        });
        Ok(Self {
            moments: moments.collect::<Result<_>>()?,
            variables,
            steps: 0,
        })
    }

    /// Performs one optimisation step on a loss, and returns the loss.
    ///
    /// # Errors
    /// [`NetworkError`] if the loss or a new value is not finite. All variables are then unchanged.
    pub fn update(
        &mut self,
        settings: &AdamSettings,
        loss: &Tensor,
    ) -> std::result::Result<f32, NetworkError> {
        self.update_with(settings, loss, Vec::new(), "")
    }

    /// `prefix` precedes the names of variables in errors.
    pub(crate) fn update_with(
        &mut self,
        settings: &AdamSettings,
        loss: &Tensor,
        statistics: Vec<Change>,
        prefix: &'static str,
    ) -> std::result::Result<f32, NetworkError> {
        let gradients = loss.backward()?;
        let mut changes = statistics;
        changes.extend(self.changes(settings, &gradients)?);
        let after = changes.iter();
        let after = after.map(|(name, _, tensor)| (format!("{prefix}{name}"), tensor));
        let all: Vec<_> = [("loss".into(), loss)].into_iter().chain(after).collect();
        let zeros = all.iter().map(|(_, tensor)| zero_if_finite(tensor));
        let numbers = copied(
            &zeros
                .chain([Ok(loss.clone())])
                .collect::<Result<Vec<_>>>()?,
        )?;
        let mut zeros = all.iter().zip(&numbers);
        if let Some(((name, _), _)) = zeros.find(|(_, zero)| **zero != 0.0) {
            return Err(self.not_finite(name.clone()));
        }
        set(&changes)?;
        self.steps += 1;
        Ok(numbers[all.len()])
    }

    pub(crate) fn not_finite(&self, tensor: String) -> NetworkError {
        let update = self.steps;
        NotFinite { update, tensor }.into()
    }

    fn changes(&self, settings: &AdamSettings, gradients: &GradStore) -> Result<Vec<Change>> {
        let betas = settings.betas.map(f64::from);
        let bias = betas.map(|beta| 1.0 - beta.powf((self.steps + 1) as f64));
        let rate = f64::from(settings.learning_rate) / bias[0];
        let scale = match settings.max_norm {
            Some(max_norm) => (f64::from(max_norm) / self.norm(gradients)?).min(1.0),
            None => 1.0,
        };
        let mut changes = Vec::new();
        for (name, var) in &self.variables {
            let Some(gradient) = gradients.get(var) else {
                continue;
            };
            let gradient = &if scale < 1.0 {
                (gradient * scale)?
            } else {
                gradient.clone()
            };
            let names = names(name);
            let [first, second] = names.each_ref().map(|name| &self.moments[name]);
            let mean = towards(first, gradient, betas[0])?;
            let square = towards(second, &gradient.sqr()?, betas[1])?;
            let root = (square.sqrt()? * (1.0 / bias[1].sqrt()))?;
            let step = ((&mean * rate)? / (root + f64::from(settings.epsilon))?)?;
            let moved = (var.as_detached_tensor() - step)?;
            changes.push((format!("{name} after the update"), var.clone(), moved));
            let [of_mean, of_square] = names.map(|name| format!("adam.{name}"));
            changes.push((of_mean, first.clone(), mean));
            changes.push((of_square, second.clone(), square));
        }
        Ok(changes)
    }

    fn norm(&self, gradients: &GradStore) -> Result<f64> {
        let gradients = self.variables.values().filter_map(|var| gradients.get(var));
        let squares = gradients.map(|it| it.sqr()?.sum_all());
        let squares = copied(&squares.collect::<Result<Vec<_>>>()?)?.into_iter();
        Ok(squares.map(f64::from).sum::<f64>().sqrt())
    }

    /// Returns the variables to learn.
    pub fn variables(&self) -> &Variables {
        &self.variables
    }

    /// Returns the moments, as `first.<name>` and `second.<name>`.
    pub fn moments(&self) -> &Variables {
        &self.moments
    }

    /// Returns the number of steps so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    pub(crate) fn set_steps(&mut self, steps: u64) {
        self.steps = steps;
    }
}

fn names(variable: &str) -> [String; 2] {
    ["first", "second"].map(|which| format!("{which}.{variable}"))
}

fn towards(old: &Var, new: &Tensor, beta: f64) -> Result<Tensor> {
    let mean = ((old.as_detached_tensor() * beta)? + (new * (1.0 - beta))?)?;
    (mean + FLUSH)? - FLUSH
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    fn variables() -> Variables {
        let var = Var::new(&[1.0_f32, -2.0], &Device::Cpu).expect("variable");
        [("p".to_owned(), var)].into()
    }

    /// Performs a step of the variable `p` on the loss `sum(p * g)`, whose gradients are `g`.
    fn step(adam: &mut Adam, settings: &AdamSettings, g: [f32; 2]) {
        let g = Tensor::new(&g, &Device::Cpu).expect("tensor");
        let sum = (adam.variables["p"].as_tensor() * g).and_then(|product| product.sum_all());
        let loss = adam.update(settings, &sum.expect("sum"));
        loss.expect("finite");
    }

    /// `torch.optim.Adam([p], lr=.1, betas=(.5, .9))` on `p = 1, -2`: the first step has the size of the rate, and the
    /// second is `.1 m / (1 - .25) / sqrt(v / (1 - .81))` with `m = .25, 1.25` and `v = .02875, 2.41`.
    #[test]
    fn two_steps_agree_with_the_published_formulas() {
        let mut adam = Adam::new(variables()).expect("moments");
        for (gradient, expected) in [
            ([0.5, -3.0], [0.9, -1.9]),
            ([0.25, 4.0], [0.814_309, -1.946_797]),
        ] {
            step(&mut adam, &AdamSettings::paper(0.1), gradient);
            let got: Vec<f32> = adam.variables["p"].to_vec1().expect("numbers");
            let mut pairs = got.iter().zip(expected);
            assert!(
                pairs.all(|(a, b): (_, f32)| (a - b).abs() < 2e-6),
                "{got:?}"
            );
        }
    }

    #[test]
    fn only_large_gradients_are_scaled_to_the_maximum_norm() {
        for (g, expected) in [([3.0, 4.0], [0.3, 0.4]), ([0.3, 0.4], [0.15, 0.2])] {
            let settings = AdamSettings {
                max_norm: Some(1.0),
                ..AdamSettings::paper(0.1)
            };
            let mut adam = Adam::new(variables()).expect("moments");
            step(&mut adam, &settings, g);
            let first: Vec<f32> = adam.moments["first.p"].to_vec1().expect("numbers");
            let off = first.iter().zip(expected).map(|(a, b)| (a - b).abs());
            assert!(off.fold(0.0_f32, f32::max) < 1e-6, "{first:?}");
        }
    }

    #[test]
    fn moments_without_a_gradient_do_not_become_subnormal() {
        let settings = AdamSettings::paper(0.1);
        let mut adam = Adam::new(variables()).expect("moments");
        step(&mut adam, &settings, [1e-3, 1.0]);
        for _ in 0..2000 {
            step(&mut adam, &settings, [0.0, 0.0]);
        }
        for moment in adam.moments.values() {
            for number in moment.to_vec1::<f32>().expect("numbers") {
                assert!(number < 1e-30 && !number.is_subnormal(), "{number}");
            }
        }
    }
}
