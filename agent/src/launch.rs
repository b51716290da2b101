//! A server of our own: found, started, waited for, and stopped whatever happens.

use protocol::channels::{ChannelError, Instance};
use protocol::connection::{Connection, ConnectionError};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command};
use std::time::{Duration, Instant};
use thiserror::Error;

/// How long a server may take to answer its first hello.
const START_TIMEOUT: Duration = Duration::from_secs(20);

/// How long it may take to stop before it is killed.
const STOP_TIMEOUT: Duration = Duration::from_secs(3);

/// Why there is no server.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LaunchError {
    /// The program cannot be started.
    #[error("start {program}: {problem}")]
    Start {
        /// The program.
        program: String,
        /// The system's reason.
        problem: String,
    },
    /// It ended at once; its own words stand above.
    #[error("the server ended with {status} before it served")]
    Ended {
        /// Its exit status.
        status: String,
    },
    /// It does not answer.
    #[error(transparent)]
    Connection(#[from] ConnectionError),
    /// The instance's name.
    #[error(transparent)]
    Channel(#[from] ChannelError),
}

/// A running server of ours; dropping it stops it.
pub struct OwnServer {
    instance: Instance,
    child: Child,
}

impl OwnServer {
    /// Starts `emberwatch-server` with the given arguments on an instance of its own, and waits until
    /// it answers. It ends with this process, however that ends.
    ///
    /// # Errors
    /// [`LaunchError`].
    pub fn start(program: Option<PathBuf>, arguments: &[String]) -> Result<Self, LaunchError> {
        let pid = std::process::id().to_string();
        let instance = Instance::new(&format!("private-{pid}"))?;
        let program = program.unwrap_or_else(beside_this_program);
        let mut command = Command::new(&program);
        command
            .args(["--instance", instance.name(), "--exit-with", &pid])
            .args(arguments)
            // A terminal's Ctrl-C is for this program, which still needs the server then.
            .process_group(0);
        if std::env::var_os("RUST_LOG").is_none() {
            command.env("RUST_LOG", "warn");
        }
        let child = command.spawn().map_err(|error| LaunchError::Start {
            program: program.display().to_string(),
            problem: error.to_string(),
        })?;
        let mut server = Self { instance, child };
        server.wait_until_it_answers()?;
        Ok(server)
    }

    /// Its instance.
    pub fn instance(&self) -> &Instance {
        &self.instance
    }

    fn wait_until_it_answers(&mut self) -> Result<(), LaunchError> {
        let deadline = Instant::now() + START_TIMEOUT;
        loop {
            match Connection::open(
                &self.instance,
                "emberwatch-agent (starting)",
                Duration::from_secs(1),
            ) {
                Ok(_) => return Ok(()),
                Err(error) if Instant::now() > deadline => return Err(error.into()),
                Err(_) => std::thread::sleep(Duration::from_millis(10)),
            }
            if let Ok(Some(status)) = self.child.try_wait() {
                return Err(LaunchError::Ended {
                    status: status.to_string(),
                });
            }
        }
    }
}

impl Drop for OwnServer {
    fn drop(&mut self) {
        if let Some(pid) = rustix::process::Pid::from_raw(self.child.id() as i32) {
            // A server that has ended already is what we want.
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
        }
        let deadline = Instant::now() + STOP_TIMEOUT;
        while matches!(self.child.try_wait(), Ok(None)) {
            if Instant::now() > deadline {
                let _ = self.child.kill();
                let _ = self.child.wait();
                return;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

fn beside_this_program() -> PathBuf {
    let name = "emberwatch-server";
    let beside = std::env::current_exe()
        .ok()
        .and_then(|path| Some(path.parent()?.join(name)));
    beside
        .filter(|path| path.exists())
        .unwrap_or_else(|| name.into())
}
