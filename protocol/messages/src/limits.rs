//! What the system allows this process: memory and threads, by the machine, cgroups and `ulimit`.
//!
//! What a user can make large asks here before it allocates. Without that, a process under `ulimit -v` aborts, and one in
//! a container is killed.

mod cgroups;
pub mod memory;
pub mod threads;
