//! The log of a program, on standard error. A thread writes it, so a reader that pauses never stops the program.
//!
//! tracing-appender 0.2 does not serve: it panics if the system has no thread left, and prints to standard output, which
//! may be a file of results.

use emberwatch_messages::limits::threads::spawn;
use emberwatch_model::text::shortened;
use std::backtrace::{Backtrace, BacktraceStatus};
use std::ffi::OsString;
use std::io::{IsTerminal, Write, stderr};
use std::mem::take;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;

/// Maximum number of bytes that wait to be written. Further lines are dropped.
const MAX_WAITING: usize = 1 << 20;

const PATIENCE: Duration = Duration::from_secs(1);

const DEFAULT: &str = "info";

/// Our crates, each without the prefix `emberwatch_`.
const CRATES: &str =
    "acting agent belief c dashboard gradient learning messages model network protocol server sim";

static WAITING: Mutex<Waiting> = Mutex::new(Waiting {
    text: Vec::new(),
    n_dropped: 0,
    has_writer: false,
    is_writing: false,
});
static CHANGED: Condvar = Condvar::new();

struct Waiting {
    text: Vec<u8>,
    /// Number of lines that were dropped after the text.
    n_dropped: usize,
    /// Whether the thread runs. Without it, lines are written at once.
    has_writer: bool,
    is_writing: bool,
}

/// The running log. Dropping it waits until all lines are written, unless the reader pauses.
#[must_use]
pub struct Log;

struct Lines;

/// Starts logging to standard error. `RUST_LOG` sets the level, also per target (`warn`,
/// `warn,emberwatch_agent=debug`); the default is `info`. Colours follow `NO_COLOR`, `CLICOLOR_FORCE` and `TERM`.
pub fn start_logging() -> Log {
    let wanted = std::env::var_os("RUST_LOG").unwrap_or_default();
    let wanted = wanted.to_string_lossy();
    let filter = targets(&wanted);
    lock().has_writer = spawn("log", write_log).is_ok();
    let log = tracing_subscriber::fmt::layer()
        .with_writer(|| Lines)
        .with_target(false)
        .with_ansi(has_colours(
            |name| std::env::var_os(name),
            stderr().is_terminal(),
        ));
    let default = || Targets::new().with_default(LevelFilter::INFO);
    tracing_subscriber::registry()
        .with(log.with_filter(filter.clone().unwrap_or_else(default)))
        .init();
    std::panic::set_hook(Box::new(|panic| {
        let thread = std::thread::current();
        let calls = Backtrace::capture();
        let calls = match calls.status() {
            BacktraceStatus::Captured => calls.to_string(),
            _ => "RUST_BACKTRACE=1 shows the calls".into(),
        };
        let name = thread.name().unwrap_or("unnamed");
        let text = format!("thread '{name}' {panic}\n{calls}\n");
        // `Lines` never fails.
        let _ = Lines.write_all(text.as_bytes());
    }));
    if filter.is_none() {
        tracing::warn!(
            "RUST_LOG: expected a level (off, error, warn, info, debug, trace) or CRATE=LEVEL, such as \
             emberwatch_agent=debug, separated by commas, got {}; logging at {DEFAULT}",
            shortened(&wanted)
        );
    }
    Log
}

impl Drop for Log {
    fn drop(&mut self) {
        let is_unfinished = |waiting: &mut Waiting| waiting.is_writing || !waiting.text.is_empty();
        let _ = CHANGED.wait_timeout_while(lock(), PATIENCE, is_unfinished);
    }
}

impl Write for Lines {
    fn write(&mut self, line: &[u8]) -> std::io::Result<usize> {
        let mut waiting = lock();
        if !waiting.has_writer {
            return stderr().write(line);
        }
        if waiting.text.is_empty() || waiting.text.len() + line.len() <= MAX_WAITING {
            waiting.text.extend_from_slice(line);
        } else {
            waiting.n_dropped += 1;
        }
        CHANGED.notify_all();
        Ok(line.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Writes lines as they come, for as long as the program runs.
fn write_log() {
    let mut waiting = lock();
    loop {
        let next = CHANGED.wait_while(waiting, |waiting| waiting.text.is_empty());
        waiting = next.unwrap_or_else(PoisonError::into_inner);
        let (text, n_dropped) = (take(&mut waiting.text), take(&mut waiting.n_dropped));
        waiting.is_writing = true;
        drop(waiting);
        // If nobody can read the log any more, the program still runs.
        let _ = stderr().write_all(&text);
        if n_dropped > 0 {
            let _ = writeln!(
                stderr(),
                "{n_dropped} lines were dropped: nobody read the log"
            );
        }
        waiting = lock();
        waiting.is_writing = false;
        CHANGED.notify_all();
    }
}

fn lock() -> MutexGuard<'static, Waiting> {
    WAITING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the filter for a text like the value of `RUST_LOG`, or `None` if a part of it is neither a level nor one of
/// our crates, and sets no level of another crate.
fn targets(text: &str) -> Option<Targets> {
    let parts = text.split(',').map(str::trim);
    let parts: Vec<&str> = parts.filter(|part| !part.is_empty()).collect();
    if parts.is_empty() {
        return targets(DEFAULT);
    }
    let is_known = |part: &&str| match part.strip_prefix("emberwatch") {
        Some(rest) => is_ours(rest.split(['=', ':', '[']).next().unwrap_or_default()),
        None => part.contains('=') || part.parse::<LevelFilter>().is_ok(),
    };
    parts
        .iter()
        .all(is_known)
        .then_some(parts.join(","))?
        .parse()
        .ok()
}

/// Returns whether `emberwatch` and this end of a name begin the name of one of our crates.
fn is_ours(end: &str) -> bool {
    let name = end.strip_prefix('_').unwrap_or(end);
    end.is_empty() || CRATES.split(' ').any(|known| known == name && end != name)
}

/// Returns whether the log has colours: on a terminal, unless the environment decides (no-color.org, bixense.com/clicolors).
fn has_colours(variable: impl Fn(&str) -> Option<OsString>, is_terminal: bool) -> bool {
    let set = |name| variable(name).filter(|value| !value.is_empty());
    if set("NO_COLOR").is_some() {
        return false;
    }
    set("CLICOLOR_FORCE").is_some_and(|value| value != "0")
        || is_terminal && set("TERM").is_none_or(|term| term != "dumb")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_follow_the_terminal_and_the_environment() {
        for (environment, on_terminal, elsewhere) in [
            ("TERM=xterm", true, false),
            ("TERM=dumb", false, false),
            ("NO_COLOR=1", false, false),
            ("NO_COLOR=", true, false),
            ("CLICOLOR_FORCE=1", true, true),
            ("CLICOLOR_FORCE=0", true, false),
            ("TERM=dumb CLICOLOR_FORCE=1", true, true),
            ("NO_COLOR=1 CLICOLOR_FORCE=1", false, false),
        ] {
            let variable = |name: &str| {
                let mut set = environment.split(' ').filter_map(|set| set.split_once('='));
                Some(set.find(|(known, _)| *known == name)?.1.into())
            };
            let coloured = [true, false].map(|is_terminal| has_colours(variable, is_terminal));
            assert_eq!(coloured, [on_terminal, elsewhere], "{environment}");
        }
    }

    #[test]
    fn levels_and_crates_of_ours_are_known() {
        let manifest = include_str!("../../Cargo.toml").lines();
        let names = manifest
            .filter_map(|line| Some(line.strip_prefix("emberwatch-")?.split_once(" = { path")?.0));
        let all: Vec<String> = names
            .map(|name| format!("emberwatch_{name}=info"))
            .collect();
        assert!(all.len() > 5, "{all:?}");
        for text in [
            &all.join(","),
            "",
            " , ",
            "emberwatch",
            "warn,emberwatch_sim=info,tokio=warn",
        ] {
            assert!(targets(text).is_some(), "{text:?}");
        }
        for text in [
            "inof",
            "info,emberwatch-server=debug",
            "emberwatch_sever=info",
            "info=info=info",
        ] {
            assert!(targets(text).is_none(), "{text:?}");
        }
    }
}
