//! What Python calls of Rust: the module `emberwatch._native`, whose types are in `_native.pyi`.

mod belief;
mod merit;
mod model;
mod planning;
mod refusal;

use pyo3::prelude::*;

#[pymodule]
mod _native {
    #[pymodule_export]
    use super::belief::{Transition, correct, entropy, simulated_prior};
    #[pymodule_export]
    use super::merit::MeritTally;
    #[pymodule_export]
    use super::model::{read_description, read_model};
    #[pymodule_export]
    use super::planning::beam_search;
}
