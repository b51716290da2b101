//! The Rust half of the Python package: the module `emberwatch._native`, whose types are in `_native.pyi`.

mod airspace;
mod answer;
mod arguments;
mod client;
mod detached;
mod dynamics;
mod errors;
mod estimators;
mod flights;
#[cfg(unix)]
mod fork;
mod lease;
mod merit;
mod model;
mod moves;
mod options;
mod origin;
mod owned;
mod planned_worlds;
mod planning;
mod prior;
mod reader;
mod recording;
mod records;
mod refusal;
mod saved;
mod settings;
mod threads;
mod windows;
mod wire;

use emberwatch_acting::beliefs::RECOMMENDED;
use emberwatch_messages::interrupt::interrupt_when;
use emberwatch_model::grid::MAX_SIDE;
use emberwatch_model::maps::{MAX_ARCHIVE_BYTES, MAX_MAP_VALUES};
use emberwatch_model::path::MAX_MOVES;
use emberwatch_model::task::FIRST_TRAINING_SEED;
use emberwatch_model::{MAX_RADIUS, MAX_VALUES};
use emberwatch_network::barrier_pool;
use pyo3::prelude::*;

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    interrupt_when(errors::interrupted);
    start_candle(module.py())?;
    #[cfg(unix)]
    fork::register(module)?;
    module.add_function(wrap_pyfunction!(moves::choices, module)?)?;
    module.add_class::<answer::StepAnswer>()?;
    module.add_function(wrap_pyfunction!(answer::columns, module)?)?;
    module.add_class::<client::Client>()?;
    module.add_class::<flights::Flights>()?;
    module.add_class::<lease::Lease>()?;
    module.add_class::<reader::Observer>()?;
    module.add_class::<reader::OutlookReader>()?;
    module.add_class::<reader::TruthReader>()?;
    module.add_class::<recording::Recording>()?;
    module.add_class::<dynamics::Dynamics>()?;
    module.add_class::<estimators::Estimators>()?;
    module.add_class::<merit::MeritTally>()?;
    module.add_class::<options::Options>()?;
    module.add_function(wrap_pyfunction!(origin::checkpoint_bytes, module)?)?;
    module.add_function(wrap_pyfunction!(options::option_names, module)?)?;
    module.add_function(wrap_pyfunction!(origin::belief_kinds, module)?)?;
    module.add_class::<settings::CheckedSettings>()?;
    module.add_function(wrap_pyfunction!(settings::model_text, module)?)?;
    module.add_function(wrap_pyfunction!(settings::read_again, module)?)?;
    module.add_function(wrap_pyfunction!(prior::simulated_prior, module)?)?;
    module.add("RECOMMENDED", RECOMMENDED.name)?;
    module.add("VERSION", env!("CARGO_PKG_VERSION"))?;
    module.add("FIRST_TRAINING_SEED", FIRST_TRAINING_SEED)?;
    module.add("MAX_ARCHIVE_BYTES", MAX_ARCHIVE_BYTES)?;
    module.add("MAX_MAP_VALUES", MAX_MAP_VALUES)?;
    module.add("MAX_MOVES", MAX_MOVES)?;
    module.add("MAX_RADIUS", MAX_RADIUS)?;
    module.add("MAX_SIDE", MAX_SIDE)?;
    module.add("MAX_VALUES", MAX_VALUES)?;
    module.add_function(wrap_pyfunction!(model::built_in, module)?)?;
    module.add_function(wrap_pyfunction!(model::with_radius, module)?)?;
    module.add_function(wrap_pyfunction!(model::read_description, module)?)?;
    module.add_function(wrap_pyfunction!(model::read_model, module)?)?;
    module.add_function(wrap_pyfunction!(planning::beam_search, module)?)?;
    module.add_function(wrap_pyfunction!(refusal::explain, module)?)
}

/// Starts candle's own pool without threads, so that candle computes on the calling thread. A forked child would wait
/// for ever for such threads, because a fork copies none. candle reads their number from the environment once, here. The
/// variable is then restored, because other libraries and child processes may read it.
fn start_candle(py: Python<'_>) -> PyResult<()> {
    let name = "CANDLE_NUM_THREADS";
    let environment = py.import("os")?.getattr("environ")?;
    let before = environment.call_method1("get", (name,))?;
    environment.set_item(name, "1")?;
    barrier_pool();
    if before.is_none() {
        environment.del_item(name)
    } else {
        environment.set_item(name, before)
    }
}
