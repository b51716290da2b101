//! The output of the programs: a reader that pauses or leaves stops none of them.

use crate::commands::TINY;
use emberwatch_protocol::Connection;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::control::Request;
use rustix::io::ioctl_fionbio;
use rustix::pipe::fcntl_setpipe_size;
use std::fs::File;
use std::io::{Read, Write, pipe};
use std::os::fd::OwnedFd;
use std::process::{Child, Command, ExitStatus, Stdio};
use tests::harness::{
    AGENT, PATIENCE, SERVER, SMALL, Server, eventually, new_instance, program_path,
};

/// Size of a small pipe, in bytes.
const PIPE: usize = 4096;

/// Number of refused requests whose log exceeds what the server keeps for a reader that pauses.
const N_REFUSED: usize = 14_000;

fn start(name: &str, arguments: &str, stdout: Stdio, stderr: impl Into<Stdio>) -> Child {
    let mut command = Command::new(program_path(name));
    command
        .args(arguments.split_whitespace())
        .env("RUST_LOG", "info,emberwatch_server::server::state=debug");
    command.stdin(Stdio::null()).stdout(stdout).stderr(stderr);
    command.spawn().expect("start the program")
}

/// Starts a server that does not outlive a failed test.
fn start_server(instance: &Instance, stderr: OwnedFd) -> Child {
    let (name, pid) = (instance.name(), std::process::id());
    let flags = format!("--instance {name} {SMALL} --exit-with {pid}");
    start(SERVER, &flags, Stdio::null(), stderr)
}

/// Waits until a program ends. Kills it if that takes too long.
fn wait(mut child: Child) -> ExitStatus {
    if !eventually(PATIENCE, || !matches!(child.try_wait(), Ok(None))) {
        let _ = child.kill();
    }
    child.wait().expect("a child process")
}

/// A full pipe, and its reader, which must stay open.
fn full_pipe() -> (OwnedFd, OwnedFd) {
    let (reader, mut writer) = pipe().expect("a pipe");
    let size = fcntl_setpipe_size(&writer, PIPE).expect("a small pipe");
    writer.write_all(&vec![b'\n'; size]).expect("fill the pipe");
    (reader.into(), writer.into())
}

fn connect(instance: &Instance) -> Connection {
    let mut connection = None;
    let connects = || {
        connection = Connection::open(instance, "tests", PATIENCE).ok();
        connection.is_some()
    };
    assert!(eventually(PATIENCE, connects), "no answer");
    connection.expect("checked above")
}

#[test]
fn an_unread_log_stops_no_program() {
    let (_reader, log) = full_pipe();
    let stderr = || log.try_clone().expect("a file descriptor");
    let instance = new_instance();
    let server = start_server(&instance, stderr());
    let mut connection = connect(&instance);
    let agent = start(AGENT, &format!("compare {TINY}"), Stdio::null(), stderr());
    assert!(wait(agent).success());
    let stopped = connection.control(&Request::Shutdown {}, PATIENCE);
    stopped.expect("an answer");
    assert!(wait(server).success());
}

#[test]
fn dropped_lines_are_counted_and_reported() {
    let (reader, writer) = full_pipe();
    let mut reader = File::from(reader);
    let instance = new_instance();
    let server = start_server(&instance, writer);
    let mut connection = connect(&instance);
    for _ in 0..N_REFUSED {
        let refused = connection.control(&Request::Renew { lease: 1 }, PATIENCE);
        refused.expect_err("no lease");
    }
    // The log that is read also has the lines that filled the pipe.
    reader.read_exact(&mut [0; PIPE]).expect("a full pipe");
    ioctl_fionbio(&reader, true).expect("a reader that does not block");
    let mut log = Vec::new();
    let mut is_reported = || {
        // Without further lines, this is an error, and `log` keeps what was read.
        let _ = reader.read_to_end(&mut log);
        String::from_utf8_lossy(&log).contains("lines were dropped")
    };
    // Lines of the server's end would be dropped, too, if they came earlier.
    assert!(eventually(PATIENCE, &mut is_reported), "no report");
    let stopped = connection.control(&Request::Shutdown {}, PATIENCE);
    stopped.expect("an answer");
    assert!(wait(server).success());
    is_reported();
    let log = String::from_utf8(log).expect("text");
    let n_logged = log.matches("refused a control request").count();
    let report = log.lines().find(|line| line.contains("lines were dropped"));
    let n_dropped = report.and_then(|line| line.split(' ').next()?.parse::<usize>().ok());
    assert!(n_logged < N_REFUSED);
    assert_eq!(n_dropped.map(|dropped| n_logged + dropped), Some(N_REFUSED));
    assert!(log.trim_end().ends_with("stopped n_steps=0"), "{report:?}");
}

#[test]
fn readers_that_leave_end_programs_silently() {
    let server = Server::start(SMALL);
    let instance = server.flag();
    for (program, arguments) in [
        (SERVER, "--help"),
        (SERVER, "--check"),
        (SERVER, &format!("status {instance}")),
        (SERVER, &format!("status --json {instance}")),
        (AGENT, "train --help"),
        (AGENT, &format!("compare {TINY}")),
        ("emberwatch-dashboard", "--version"),
    ] {
        let (reader, writer) = pipe().expect("a pipe");
        drop(reader);
        let child = start(program, arguments, writer.into(), Stdio::piped());
        let ended = child.wait_with_output().expect("run the program");
        let log = String::from_utf8_lossy(&ended.stderr);
        assert!(ended.status.success(), "{program} {arguments}: {log}");
        let is_silent = ["ERROR", "panicked", "pipe"]
            .iter()
            .all(|word| !log.contains(word));
        assert!(is_silent, "{program} {arguments}: {log}");
    }
}
