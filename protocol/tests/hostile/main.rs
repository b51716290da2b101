//! What comes from outside is hostile: every decoder gives an error or a valid value, never a panic,
//! and decodes what was encoded to the same value.

mod binary;
mod control;
mod damage;
mod model;
#[path = "../models/mod.rs"]
mod models;
