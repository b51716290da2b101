//! Runs programs as child processes. Every wait has a deadline, and dropping a program kills it.

use emberwatch_protocol::channels::Instance;
use rustix::process::{Pid, Signal, kill_process};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Time limit for operations that should take milliseconds. It is shorter than the default duration of a lease, 30 s.
pub const PATIENCE: Duration = Duration::from_secs(25);

pub const LIMIT: Duration = Duration::from_secs(60);

pub const SERVER: &str = "emberwatch-server";

pub const AGENT: &str = "emberwatch-agent";

/// A child process whose output is captured.
pub struct Program {
    child: Child,
    folder: TempDir,
}

/// A temporary folder, removed on drop.
pub struct Folder(TempDir);

impl Default for Folder {
    fn default() -> Self {
        Self(TempDir::new().expect("a folder"))
    }
}

impl Folder {
    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Returns a file's path as an argument of a command.
    pub fn word(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }

    /// Writes a file and returns its path as an argument of a command.
    pub fn write(&self, name: &str, contents: impl AsRef<[u8]>) -> String {
        std::fs::write(self.path(name), contents).expect("write a file");
        self.word(name)
    }

    pub fn bytes(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).expect("read a file")
    }

    pub fn text(&self, name: &str) -> String {
        String::from_utf8(self.bytes(name)).expect("text")
    }
}

#[derive(Debug)]
pub struct Ended {
    /// The exit code, or `None` if a signal ended the program.
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl Program {
    /// Starts a program of this workspace; `arguments` are separated by spaces.
    pub fn start(name: &str, arguments: &str) -> Self {
        let arguments: Vec<&str> = arguments.split_whitespace().collect();
        Self::start_at(&program_path(name), &arguments)
    }

    /// Starts an agent that acts on an instance.
    pub fn agent(instance: &Instance, flags: &str) -> Self {
        Self::start(
            AGENT,
            &format!("run --instance {} {flags}", instance.name()),
        )
    }

    pub fn start_at(program: &Path, arguments: &[&str]) -> Self {
        let folder = TempDir::new().expect("a folder for the program's output");
        let file = |name: &str| File::create(folder.path().join(name)).expect("an output file");
        let child = Command::new(program)
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(file("stdout"))
            .stderr(file("stderr"))
            .env("RUST_LOG", "info")
            // Keeps the program from using the user's cache, because no files can be created below this path.
            .env("XDG_CACHE_HOME", "/dev/null")
            .spawn();
        Self {
            child: child.expect("start the program"),
            folder,
        }
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns the standard output so far.
    pub fn stdout(&self) -> String {
        self.read("stdout")
    }

    /// Returns the standard error so far.
    pub fn stderr(&self) -> String {
        self.read("stderr")
    }

    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.child.id() as i32).expect("a process id");
        kill_process(pid, signal).expect("signal the program");
    }

    /// Pauses the program with SIGSTOP and waits until it is stopped.
    pub fn stop(&self) {
        self.signal(Signal::STOP);
        let stat = format!("/proc/{}/stat", self.pid());
        let is_stopped = || {
            let stat = std::fs::read_to_string(&stat).expect("its state");
            stat.rsplit(") ")
                .next()
                .is_some_and(|rest| rest.starts_with('T'))
        };
        self.until(is_stopped);
    }

    pub fn until(&self, holds: impl FnMut() -> bool) {
        assert!(eventually(PATIENCE, holds), "{}", self.stderr());
    }

    pub fn has_ended(&mut self) -> bool {
        let status = self.child.try_wait();
        status.expect("look at the program").is_some()
    }

    pub fn wait(mut self, limit: Duration) -> Ended {
        let mut status: Option<ExitStatus> = None;
        let ended = eventually(limit, || {
            status = self.child.try_wait().expect("wait for the program");
            status.is_some()
        });
        assert!(ended, "still running after {limit:?}: {}", self.stderr());
        Ended {
            code: status.and_then(|status| status.code()),
            stdout: self.stdout(),
            stderr: self.stderr(),
        }
    }

    pub fn ends(self, code: i32) -> Ended {
        self.wait(PATIENCE).check(code)
    }

    /// Sends SIGTERM and checks that the program ends with exit code 0.
    pub fn finish(self) -> Ended {
        self.signal(Signal::TERM);
        self.ends(0)
    }

    /// Kills the program with SIGKILL and waits for its end.
    pub fn kill(mut self) {
        self.child.kill().expect("kill the program");
        self.child.wait().expect("wait for the program");
    }

    pub fn wait_for_words(&self, words: &str) {
        let said = eventually(PATIENCE, || self.stderr().contains(words));
        assert!(said, "{words:?} not said: {}", self.stderr());
    }

    fn read(&self, file: &str) -> String {
        std::fs::read_to_string(self.folder.path().join(file)).expect("read the output")
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Ended {
    pub fn check(self, code: i32) -> Self {
        assert_eq!(self.code, Some(code), "{}", self.stderr);
        self
    }

    pub fn check_prints(&self, words: &str) -> &Self {
        let printed = &self.stdout;
        assert!(printed.contains(words), "{words:?} not printed: {printed}");
        self
    }

    pub fn check_says(&self, words: &str) -> &Self {
        let said = &self.stderr;
        assert!(said.contains(words), "{words:?} not said: {said}");
        self
    }
}

/// Runs a program to its end; `arguments` are separated by spaces.
pub fn run(name: &str, arguments: &str) -> Ended {
    Program::start(name, arguments).wait(LIMIT)
}

/// Checks a condition every millisecond. Returns whether it held before the time limit.
pub fn eventually(limit: Duration, mut holds: impl FnMut() -> bool) -> bool {
    let deadline = Instant::now() + limit;
    while !holds() {
        if Instant::now() > deadline {
            return false;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    true
}

pub fn repository() -> PathBuf {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    tests.parent().expect("tests lies in the repository").into()
}

/// Returns the Python interpreter of the tests, which `scripts/test` installs.
pub fn python() -> PathBuf {
    let python = repository().join("target/venv/bin/python");
    assert!(python.exists(), "no {}; run scripts/test", python.display());
    python
}

/// Returns the path of a program, which `cargo build --workspace` makes in the folder above the tests. Fails if a source
/// of the program is newer.
pub fn program_path(name: &str) -> PathBuf {
    let test = std::env::current_exe().expect("this program's path");
    let target = test.ancestors().nth(2).expect("target/<profile>/deps/test");
    let path = target.join(name);
    let changed = |path: &Path| path.metadata().and_then(|data| data.modified()).ok();
    // Cargo lists the sources of a program in a file next to it: `PROGRAM: SOURCE SOURCE ...`.
    let sources = std::fs::read_to_string(path.with_extension("d")).unwrap_or_default();
    let newest = sources.split_whitespace().skip(1).map(Path::new);
    let newest = newest.filter_map(changed).max();
    assert!(
        path.exists() && changed(&path) >= newest,
        "{name} is missing or older than a source: run `cargo build --workspace` before the tests"
    );
    path
}
