//! Limits on the memory and threads of this process, set by the machine, cgroups and `ulimit`.
//!
//! Code whose memory or threads depend on a user's settings checks here first. Otherwise a process under `ulimit -v`
//! would abort, and one in a container would be killed.

mod cgroups;
pub mod memory;
pub mod threads;
