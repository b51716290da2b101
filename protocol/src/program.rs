//! Code of every program: flags, printing, and stopping on signals or when another process ends.

use clap::Parser;
use clap::error::ContextKind::{InvalidArg, InvalidSubcommand, InvalidValue};
use clap::error::ContextValue;
use emberwatch_messages::limits::threads::spawn;
use emberwatch_model::text::shortened;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::low_level::exit;
use std::io::{Error, ErrorKind, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

pub use crate::flags::Flags;
pub use crate::logging::{Log, start_logging};
pub use crate::wire::process::{NotWatched, WatchedProcess, node_pid};
pub use emberwatch_messages::process::pid_namespace;
pub use emberwatch_model::text::{MAX_TEXT_BYTES, read_text};

const SAME_SIGNAL: Duration = Duration::from_millis(500);

/// Parses the program's flags. An error, which ends the program, quotes at most 80 characters of a value.
pub fn parse_flags<T: Parser>() -> T {
    T::try_parse().unwrap_or_else(|mut error| {
        for kind in [InvalidValue, InvalidArg, InvalidSubcommand] {
            if let Some(ContextValue::String(given)) = error.get(kind) {
                let quoted = shortened(given).into_owned();
                error.insert(kind, ContextValue::String(quoted));
            }
        }
        error.exit()
    })
}

/// Prints a text to standard output. A reader that has closed its end, as `head` does, is no error: it needs no more.
///
/// # Errors
/// If the text cannot be written for another reason.
pub fn print(text: &str) -> std::io::Result<()> {
    let mut out = std::io::stdout();
    let printed = out.write_all(text.as_bytes()).and_then(|()| out.flush());
    match printed {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            let problem = format!("write to standard output: {error}");
            Err(Error::new(error.kind(), problem))
        }
        _ => Ok(()),
    }
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
    spawn("signals", wait).map_err(Error::other)?;
    Ok(stop)
}
