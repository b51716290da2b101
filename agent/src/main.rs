//! `emberwatch-agent`: acts on a server's world, trains learners, and compares policies.

use emberwatch_agent::process::Allocator;
use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: Allocator = Allocator;

fn main() -> ExitCode {
    emberwatch_agent::cli::main()
}
