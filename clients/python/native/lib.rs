//! What Python calls of Rust: the module `emberwatch._native`, whose types are in `_native.pyi`.

mod airspace;
mod answer;
mod backend;
mod belief;
mod connection;
mod detached;
mod errors;
mod flights;
mod lease;
mod merit;
mod model;
mod moves;
mod options;
mod owned;
mod planning;
mod reader;
mod recording;
mod refusal;
mod samples;

use emberwatch_messages::interrupt::interrupt_when;
use emberwatch_protocol::turn;
use pyo3::prelude::*;
use pyo3::types::IntoPyDict;

#[pyfunction]
fn before_fork(py: Python<'_>) {
    py.detach(turn::before_fork);
}

#[pyfunction]
fn after_fork() {
    turn::after_fork();
}

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    interrupt_when(errors::interrupted);
    let after = wrap_pyfunction!(after_fork, module)?;
    let hooks = [
        ("before", wrap_pyfunction!(before_fork, module)?),
        ("after_in_parent", after.clone()),
        ("after_in_child", after),
    ];
    let os = py.import("os")?;
    os.call_method("register_at_fork", (), Some(&hooks.into_py_dict(py)?))?;
    module.add_function(wrap_pyfunction!(moves::choices, module)?)?;
    module.add_function(wrap_pyfunction!(moves::moves, module)?)?;
    module.add_class::<answer::Answer>()?;
    module.add_function(wrap_pyfunction!(answer::columns, module)?)?;
    module.add_class::<connection::Server>()?;
    module.add_class::<flights::Flights>()?;
    module.add_class::<lease::Lease>()?;
    module.add_class::<reader::Frames>()?;
    module.add_class::<reader::Truths>()?;
    module.add_class::<reader::Outlooks>()?;
    module.add_class::<recording::Recording>()?;
    module.add_class::<belief::Transition>()?;
    module.add_class::<merit::MeritTally>()?;
    module.add_class::<options::Options>()?;
    module.add_function(wrap_pyfunction!(options::option_names, module)?)?;
    module.add_function(wrap_pyfunction!(backend::check_settings, module)?)?;
    module.add_function(wrap_pyfunction!(backend::worlds_fingerprint, module)?)?;
    module.add_function(wrap_pyfunction!(belief::correct, module)?)?;
    module.add_function(wrap_pyfunction!(belief::simulated_prior, module)?)?;
    module.add_function(wrap_pyfunction!(model::description_with_radius, module)?)?;
    module.add_function(wrap_pyfunction!(model::grid_of_maps, module)?)?;
    module.add_function(wrap_pyfunction!(model::model_text, module)?)?;
    module.add_function(wrap_pyfunction!(model::model_with_radius, module)?)?;
    module.add_function(wrap_pyfunction!(model::read_description, module)?)?;
    module.add_function(wrap_pyfunction!(model::read_model, module)?)?;
    module.add_function(wrap_pyfunction!(planning::beam_search, module)?)
}
