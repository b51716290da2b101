//! Named variables with initial values from our own seeded streams, because candle's random numbers on the CPU cannot
//! be seeded.

use candle_core::{DType, Device, Result, Shape, Tensor, Var};
use candle_nn::var_builder::SimpleBackend;
use candle_nn::{Init, VarBuilder, VarMap};
use emberwatch_model::randomness::{Purpose, stream};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use std::collections::BTreeMap;

/// Variables by name, in alphabetical order.
pub type Variables = BTreeMap<String, Var>;

/// Builds a model whose layers request their variables from a [`VarBuilder`]. Returns the model and its variables.
///
/// A variable's initial value depends only on the seed and on the variable's name. Adding a layer therefore does not
/// change the initial values of other layers.
pub fn build<M>(
    seed: u64,
    dtype: DType,
    device: &Device,
    model: impl FnOnce(VarBuilder<'static>) -> Result<M>,
) -> Result<(M, Variables)> {
    let variables = VarMap::new();
    let backend = Seeded {
        seed,
        variables: variables.clone(),
    };
    let vb = VarBuilder::from_backend(Box::new(backend), dtype, device.clone());
    let model = model(vb)?;
    let named = variables
        .data()
        .lock()
        .expect("invariant: no layer panicked");
    let named = named.iter().map(|(name, var)| (name.clone(), var.clone()));
    Ok((model, named.collect()))
}

/// Returns whether a name denotes a running statistic, which has no gradient.
pub(crate) fn is_statistic(name: &str) -> bool {
    name.ends_with("running_mean") || name.ends_with("running_var")
}

/// Returns the initialisation of PyTorch's layers: uniform within ±`1 / sqrt(fan_in)`.
pub(crate) fn uniform_init(fan_in: usize) -> Init {
    let up = 1.0 / (fan_in.max(1) as f64).sqrt();
    Init::Uniform { lo: -up, up }
}

/// Draws a uniform number from `0..1`, in steps of 2^-24.
pub(crate) fn uniform(rng: &mut ChaCha8Rng) -> f32 {
    (rng.next_u32() >> 8) as f32 / (1 << 24) as f32
}

/// Draws a standard normal number by the Box-Muller method.
pub(crate) fn normal(rng: &mut ChaCha8Rng) -> f32 {
    let radius = (-2.0 * (1.0 - uniform(rng)).ln()).sqrt();
    radius * (std::f32::consts::TAU * uniform(rng)).cos()
}

struct Seeded {
    seed: u64,
    variables: VarMap,
}

impl Seeded {
    fn draw(&self, name: &str, shape: &Shape, init: Init) -> Vec<f32> {
        let mut rng = stream(self.seed, Purpose::Weights, hash(name));
        let mut uniform = |lo: f64, up: f64| lo + (up - lo) * f64::from(uniform(&mut rng));
        let mut rng = stream(self.seed, Purpose::Weights, hash(name));
        let mut normal = |mean: f64, stdev: f64| mean + stdev * f64::from(normal(&mut rng));
        let mut draw = || match init {
            Init::Const(value) => value,
            Init::Uniform { lo, up } => uniform(lo, up),
            Init::Randn { mean, stdev } => normal(mean, stdev),
            Init::Kaiming { .. } => unreachable!("invariant: no layer asks for it"),
        };
        (0..shape.elem_count()).map(|_| draw() as f32).collect()
    }
}

impl SimpleBackend for Seeded {
    fn get(
        &self,
        shape: Shape,
        name: &str,
        init: Init,
        dtype: DType,
        device: &Device,
    ) -> Result<Tensor> {
        if !self.contains_tensor(name) {
            let numbers = self.draw(name, &shape, init);
            let first = Tensor::from_vec(numbers, shape.clone(), device)?.to_dtype(dtype)?;
            let variables = self.variables.data().lock();
            let mut variables = variables.expect("invariant: no layer panicked");
            variables.insert(name.to_owned(), Var::from_tensor(&first)?);
        }
        // An existing variable is shared if its shape is the same.
        self.variables.get(shape, name, init, dtype, device)
    }

    fn get_unchecked(&self, name: &str, _: DType, _: &Device) -> Result<Tensor> {
        candle_core::bail!("variable {name}: expected a shape, got none")
    }

    fn contains_tensor(&self, name: &str) -> bool {
        let variables = self.variables.data().lock();
        let variables = variables.expect("invariant: no layer panicked");
        variables.contains_key(name)
    }
}

/// Computes the FNV-1a hash (Fowler, Noll, Vo).
fn hash(name: &str) -> u64 {
    name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(seed: u64, name: &str, init: Init) -> Vec<f32> {
        let build = build(seed, DType::F32, &Device::Cpu, |vb| {
            vb.get_with_hints(1000, name, init)
        });
        build.expect("a tensor").0.to_vec1().expect("numbers")
    }

    #[test]
    fn initial_values_have_the_requested_distribution_and_depend_only_on_seed_and_name() {
        let init = uniform_init(16);
        assert_eq!(numbers(1, "a", init), numbers(1, "a", init));
        assert_ne!(numbers(1, "a", init), numbers(2, "a", init));
        assert_ne!(numbers(1, "a", init), numbers(1, "b", init));
        let largest = |numbers: Vec<f32>| numbers.iter().fold(0.0_f32, |max, x| max.max(x.abs()));
        assert!((0.24..=0.25).contains(&largest(numbers(1, "a", init))));
        let normal = Init::Randn {
            mean: 0.0,
            stdev: 2.0,
        };
        // With 1,000 draws, a deviation of 0.1 from 2 is more than two standard deviations.
        let squares: f32 = numbers(1, "a", normal).iter().map(|x| x * x).sum();
        let spread = (squares / 1000.0).sqrt();
        assert!((1.9..2.1).contains(&spread), "{spread}");
        assert_eq!(largest(numbers(1, "a", Init::Const(3.0))), 3.0);
    }
}
