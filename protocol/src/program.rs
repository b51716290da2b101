//! Start-up code of every program: logging to standard error, and stopping on signals or when another process ends.

use emberwatch_messages::limits::threads::spawn;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::low_level::exit;
use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;

pub use crate::wire::process::{NotWatched, WatchedProcess, node_pid};
pub use emberwatch_messages::process::pid_namespace;
pub use emberwatch_model::text::{MAX_TEXT_BYTES, read_text};

const SAME_SIGNAL: Duration = Duration::from_millis(500);

/// Starts logging to standard error. `RUST_LOG` sets the level, also per target (`warn`,
/// `warn,emberwatch_agent=debug`); the default is `info`.
pub fn start_logging() {
    let wanted = std::env::var("RUST_LOG");
    let filter = wanted.ok().and_then(|text| text.parse::<Targets>().ok());
    let filter = filter.unwrap_or_else(|| Targets::new().with_default(LevelFilter::INFO));
    let log = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_target(false)
        .with_ansi(std::io::stderr().is_terminal());
    tracing_subscriber::registry()
        .with(log.with_filter(filter))
        .init();
}

/// Returns a flag that SIGINT, SIGTERM or SIGHUP sets. A second signal ends the process at once. `timeout` and shells
/// send one signal to a process and to its group, so signals within half a second of the first count as the same one.
///
/// # Errors
/// If the system does not allow a handler or a thread.
pub fn stop_on_signals() -> std::io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP])?;
    let wait = move || {
        let mut first: Option<Instant> = None;
        for _ in &mut signals {
            flag.store(true, Ordering::SeqCst);
            if first.get_or_insert_with(Instant::now).elapsed() > SAME_SIGNAL {
                exit(1);
            }
        }
    };
    spawn("signals", wait).map_err(std::io::Error::other)?;
    Ok(stop)
}
