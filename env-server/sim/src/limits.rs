//! The memory and threads that worlds need, and the checks that the system has them.

use crate::config::{Checked, ServerConfig};
use crate::world::{MIN_HISTORY_BYTES, bytes_of_history, bytes_of_robot, most_seen};
use emberwatch_messages::control::CoverageRule;
use emberwatch_messages::limits::memory::{self, NoMemory};
use emberwatch_messages::limits::threads::NoThreads;
use emberwatch_messages::payload::{ROBOT_BYTES, WORLD_BYTES};
use emberwatch_model::Dynamics;
use rayon::{ThreadPool, ThreadPoolBuilder};

/// Returns the number of threads that step worlds, which is also the number of threads that reset worlds.
pub fn n_threads(config: &ServerConfig) -> usize {
    match config.threads {
        0 => std::thread::available_parallelism().map_or(1, usize::from),
        n_threads => n_threads,
    }
}

pub fn start(pool: ThreadPoolBuilder, n_threads: usize) -> Result<ThreadPool, NoThreads> {
    let started = pool.num_threads(n_threads).build();
    let pool = started.map_err(|error| NoThreads::new(n_threads, &error))?;
    // Each thread allocates once, because its first allocation reserves address space and `check_memory` must measure
    // the free address space after that.
    pool.broadcast(|_| drop(std::hint::black_box(Box::new(0_u8))));
    Ok(pool)
}

/// Checks that there is memory for all worlds, for the `n_threads` worlds that may be reset at the same time, and for
/// the longest answer. Call this function after the threads have started.
///
/// # Errors
/// If there is too little memory.
pub fn check_memory(checked: &Checked, n_threads: usize) -> Result<(), NoMemory> {
    let n_worlds = checked.config.worlds as usize;
    let n_at_once = (n_worlds + n_threads.min(n_worlds)) as u64;
    let n_bytes = n_at_once.saturating_mul(bytes_of_world(checked) as u64);
    let n_bytes = n_bytes.saturating_add(answer_bytes(checked) as u64);
    // Adds an eighth for the overhead of allocators, which measurements showed to be enough.
    let n_bytes = n_bytes.saturating_add(n_bytes / 8);
    let worlds = if n_worlds == 1 { "world" } else { "worlds" };
    let what = format!("{n_worlds} {worlds} of {} cells", checked.shape);
    memory::check(what, n_bytes)
}

pub fn answer_bytes(checked: &Checked) -> usize {
    let (config, n_cells) = (&checked.config, checked.shape.n_cells());
    config.worlds as usize * (WORLD_BYTES + config.world.robots as usize * (ROBOT_BYTES + n_cells))
}

fn bytes_of_world(checked: &Checked) -> usize {
    let (config, n_cells) = (&checked.config, checked.shape.n_cells());
    let sensor = checked.model.file().sensor.as_ref();
    let radius = sensor.map_or(0, |sensor| sensor.radius);
    let n_robots = config.world.robots as usize;
    let n_seen = most_seen(radius, config.world.moves, n_cells);
    let work_space = match &checked.recorded {
        Some(_) => 0,
        None => Dynamics::n_bytes(&checked.model, checked.shape),
    };
    let of_states = 2 * (n_cells + work_space);
    let robots = n_robots * bytes_of_robot(config.world.moves, n_seen, n_cells);
    let sees_all = config.coverage != CoverageRule::Path;
    let history = bytes_of_history(config.history as usize, n_robots, n_seen);
    let whole_frames = if sees_all {
        MIN_HISTORY_BYTES + n_robots * n_cells
    } else {
        0
    };
    // The 3 bytes per cell are for the visit counts and the scratch buffers of flights.
    of_states + 3 * n_cells + robots + history + whole_frames
}
