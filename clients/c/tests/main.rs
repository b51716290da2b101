//! Tests of the header. Tests that run programs in C and C++ are in `tests/c.rs` of the repository's root.

mod header;
