//! Finds and starts servers and dashboards as child processes, waits until they answer, and always stops them.

use anyhow::{Context, Result, bail, ensure};
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::connection::Connection;
use emberwatch_protocol::limits::threads::spawn;
use sha2::{Digest, Sha256};
use std::collections::hash_map::RandomState;
use std::fs::File;
use std::hash::BuildHasher;
use std::io::{BufRead, BufReader, copy};
use std::net::SocketAddr;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// How long a starting server or dashboard may take to answer.
const START_TIMEOUT: Duration = Duration::from_secs(20);

/// How long a program may take to stop before it is killed.
const STOP_TIMEOUT: Duration = Duration::from_secs(3);

/// A server that this process started. Dropping it stops the server.
pub struct OwnServer {
    instance: Instance,
    worlds_fingerprint: String,
    program: OwnProgram,
}

/// A dashboard that this process started. Dropping it stops the dashboard.
pub struct OwnDashboard {
    url: String,
    _program: OwnProgram,
}

/// A child process. Dropping it stops the process.
struct OwnProgram(Child);

impl OwnServer {
    /// Starts `emberwatch-server` with the given arguments on a private instance, and waits until it answers. The
    /// server never outlives this process, even if this process is killed.
    pub fn start(program: Option<PathBuf>, arguments: &[String]) -> Result<Self> {
        // The process id alone is not unique: a process in another container may share /dev/shm.
        let random = RandomState::new().hash_one(0);
        let instance = Instance::new(&format!("private-{}-{random:016x}", std::process::id()))?;
        let mut command = private(program.unwrap_or_else(|| neighbour("emberwatch-server")));
        command
            .args(["--instance", instance.name()])
            .args(arguments);
        let program = OwnProgram::start(&mut command)?;
        let mut server = Self {
            instance,
            worlds_fingerprint: String::new(),
            program,
        };
        server.wait_until_it_answers()?;
        Ok(server)
    }

    pub fn instance(&self) -> &Instance {
        &self.instance
    }

    /// Returns the digits that identify the server's worlds, apart from their seeds.
    pub fn worlds_fingerprint(&self) -> &str {
        &self.worlds_fingerprint
    }

    /// Returns a digest of two running programs, this one and the server. A program that is built anew from changed
    /// files has another digest, even if the files have been replaced since the start.
    pub fn build(&self) -> Result<String> {
        let mut hash = Sha256::new();
        for pid in [std::process::id(), self.program.0.id()] {
            let path = format!("/proc/{pid}/exe");
            let program = File::open(&path).and_then(|mut file| copy(&mut file, &mut hash));
            program.with_context(|| format!("read {path}"))?;
        }
        Ok(format!("{:x}", hash.finalize()))
    }

    fn wait_until_it_answers(&mut self) -> Result<()> {
        let deadline = Instant::now() + START_TIMEOUT;
        loop {
            match Connection::open(
                &self.instance,
                "emberwatch-agent (starting)",
                Duration::from_secs(1),
            ) {
                Ok(connection) => {
                    let (instance, pid) = (self.instance.name(), connection.info().pid);
                    let expected = self.program.0.id();
                    ensure!(
                        pid == expected,
                        "instance {instance}: expected the server that was started, pid {expected}, got pid {pid}"
                    );
                    let fingerprint = connection.info().worlds_fingerprint.clone();
                    self.worlds_fingerprint = fingerprint.unwrap_or_default();
                    return Ok(());
                }
                Err(error) if Instant::now() > deadline => return Err(error.into()),
                Err(_) => std::thread::sleep(Duration::from_millis(10)),
            }
            if let Ok(Some(status)) = self.program.0.try_wait() {
                bail!("the server ended with {status} before it was ready");
            }
        }
    }
}

impl OwnDashboard {
    /// Starts `emberwatch-dashboard` for an instance, with its page at `address`. The dashboard never outlives this
    /// process, even if this process is killed.
    pub fn start(instance: &Instance, address: SocketAddr) -> Result<Self> {
        let mut command = private(neighbour("emberwatch-dashboard"));
        let address = address.to_string();
        command
            .args([
                "--instance",
                instance.name(),
                "--listen",
                &address,
                "--open",
            ])
            .stdout(Stdio::piped());
        let mut program = OwnProgram::start(&mut command)?;
        let url = program.first_line(START_TIMEOUT);
        match url.trim() {
            "" => match program.0.try_wait() {
                Ok(Some(status)) => bail!("the dashboard ended with {status} before it was ready"),
                _ => bail!("the dashboard did not print its address within {START_TIMEOUT:?}"),
            },
            url => Ok(Self {
                url: url.into(),
                _program: program,
            }),
        }
    }

    pub fn url(&self) -> &str {
        &self.url
    }
}

impl OwnProgram {
    fn start(command: &mut Command) -> Result<Self> {
        let child = command.spawn();
        let program = command.get_program().display();
        Ok(Self(child.with_context(|| format!("start {program}"))?))
    }

    /// Returns the first line of the program's standard output, or an empty string if it ends or takes too long.
    fn first_line(&mut self, timeout: Duration) -> String {
        let (sender, receiver) = std::sync::mpsc::channel();
        if let Some(out) = self.0.stdout.take() {
            // If the thread cannot start, the line stays empty.
            let _ = spawn("first line", move || {
                let mut line = String::new();
                let _ = BufReader::new(out).read_line(&mut line);
                let _ = sender.send(line);
            });
        }
        receiver.recv_timeout(timeout).unwrap_or_default()
    }
}

impl Drop for OwnProgram {
    fn drop(&mut self) {
        if let Some(pid) = rustix::process::Pid::from_raw(self.0.id() as i32) {
            // The program may have ended already.
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
        }
        let deadline = Instant::now() + STOP_TIMEOUT;
        while matches!(self.0.try_wait(), Ok(None)) {
            if Instant::now() > deadline {
                let _ = self.0.kill();
                let _ = self.0.wait();
                return;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// Returns the command for a program that exits when this process ends, and that logs only warnings unless RUST_LOG is
/// set.
fn private(program: PathBuf) -> Command {
    let mut command = Command::new(program);
    command
        .args(["--exit-with", &std::process::id().to_string()])
        // Ctrl-C in a terminal must not reach the program, because this process still needs the program while it shuts
        // down.
        .process_group(0);
    if std::env::var_os("RUST_LOG").is_none_or(|value| value.is_empty()) {
        command.env("RUST_LOG", "warn");
    }
    command
}

/// Returns the path of a program in this program's folder, or otherwise the bare name, which is looked up on PATH.
fn neighbour(name: &str) -> PathBuf {
    let neighbour = std::env::current_exe()
        .ok()
        .and_then(|path| Some(path.parent()?.join(name)));
    neighbour
        .filter(|path| path.exists())
        .unwrap_or_else(|| name.into())
}
