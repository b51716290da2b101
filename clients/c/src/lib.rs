//! The C interface. `include/emberwatch.h` is generated from this crate (`tests/header.rs`), and states its rules.
//!
//! Every function that can fail runs in [`error::guard`], which catches panics and describes errors. Handles are boxes
//! with a tag ([`handle`]); other pointers that a function returns belong to a handle, in a [`view::View`].

#![allow(
    unsafe_code,
    reason = "C passes pointers; each unsafe block relies on the rules in emberwatch.h"
)]
#![allow(
    clippy::too_many_arguments,
    reason = "C has no named arguments and no default values"
)]

mod belief;
mod error;
mod fork;
mod handle;
mod info;
mod lease;
mod report;
mod samples;
mod server;
mod view;
