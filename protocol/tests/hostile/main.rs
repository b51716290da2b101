//! What comes from outside is hostile: every decoder gives an error or a valid value, never a panic,
//! and decodes what was encoded to the same value. What bytes can be damaged to is in `tests/src/fuzz/`.

mod binary;
mod control;
mod model;
#[path = "../models/mod.rs"]
mod models;
