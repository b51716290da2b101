//! Tests in which shared memory or the channel directory is unusable, or is removed while programs run.
//!
//! These tests run in a separate mount namespace, because all programs share the real directories. Where a process may
//! not create a namespace, the tests print a note and pass, except in CI, where they fail.

use std::io::Write;
use std::process::Command;
use tests::harness::{SMALL, program_path};

/// A shell line that waits until the server answers.
const ANSWERS: &str = "until $S status >/dev/null 2>&1; do sleep 0.01; done";

/// Runs a shell script in a namespace with its own `/dev/shm`; `$S` is the server program. Returns its output and error
/// output, or `None` if this process may not create a namespace.
fn apart(script: &str) -> Option<String> {
    let run = |script: &str| {
        let is_root = rustix::process::getuid().is_root();
        let script = format!("exec 2>&1; mount -t tmpfs -o size=256m tmpfs /dev/shm && {script}");
        Command::new("unshare")
            .args([
                if is_root { "-m" } else { "-rm" },
                "timeout",
                "60",
                "sh",
                "-c",
                &script,
            ])
            .env("S", program_path("emberwatch-server"))
            .env("RUST_LOG", "info")
            .output()
            .ok()
    };
    if !run("true").is_some_and(|output| output.status.success()) {
        assert!(std::env::var_os("CI").is_none(), "no mount namespace");
        let note = "skipped: this process may not make a mount namespace\n";
        let _ = std::io::stderr().write_all(note.as_bytes());
        return None;
    }
    let output = run(script)?;
    Some(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Runs a script and checks that its output contains all expected words.
fn check(script: &str, expected: &[&str]) {
    let Some(said) = apart(script) else { return };
    for words in expected {
        assert!(said.contains(words), "{words:?} not said: {said}");
    }
}

#[test]
fn a_server_without_its_files_ends_and_spares_its_successor() {
    check(
        &format!(
            "$S {SMALL} & first=$!
             {ANSWERS}; rm -rf /dev/shm/emberwatch-*
             $S {SMALL} & second=$!
             wait $first; echo first ended with $?
             {ANSWERS}; kill $second; wait $second; echo second ended with $?"
        ),
        &[
            "first ended with 1",
            "was removed while it was in use",
            "second ended with 0",
        ],
    );
}

#[test]
fn shared_memory_that_is_read_only_is_called_so() {
    for before in ["true", "$S status --instance nobody"] {
        let script = format!("{before}; mount -o remount,ro /dev/shm; $S {SMALL}");
        check(&script, &["Read-only file system", "remount,rw /dev/shm"]);
    }
}

#[test]
fn what_cannot_be_read_of_a_living_server_stays() {
    check(
        &format!(
            "$S {SMALL} & server=$!
             {ANSWERS}; rm /dev/shm/emberwatch-*/nodes/*node_monitor_owner_lock
             $S status --instance nobody
             $S status && kill $server; wait $server; echo it ended with $?"
        ),
        &["it ended with 0"],
    );
}

#[test]
fn servers_in_other_pid_namespaces_are_called_so_and_go_on() {
    let refusal = "served from another PID namespace";
    let script = format!(
        "$S {SMALL} & server=$!
         {ANSWERS}; unshare -p -f --mount-proc sh -c '$S status; $S stop; $S {SMALL}'
         $S status && kill $server; wait $server; echo it ended with $?"
    );
    let Some(said) = apart(&script) else { return };
    assert!(said.contains("it ended with 0"), "{said}");
    assert_eq!(said.matches(refusal).count(), 3, "{said}");
    // Two servers, each with process id 1 in its own namespace.
    let other = "unshare -p -f --kill-child --mount-proc $S";
    check(
        &format!(
            "{other} {SMALL} & first=$!
             until $S status 2>&1 | grep -q 'another PID namespace'; do sleep 0.01; done
             {other} {SMALL}; echo the second ended with $?; kill -9 $first"
        ),
        &["the second ended with 1", refusal],
    );
}

#[test]
fn a_full_shared_memory_is_called_so_and_kills_nobody() {
    for left in [0, 65536] {
        let free = "$(stat -f -c '%a * %S' /dev/shm)";
        check(
            &format!(
                "$S {SMALL} & server=$!
                 {ANSWERS}; fallocate -l $(({free} - {left})) /dev/shm/filler
                 $S status; echo status ended with $?; rm /dev/shm/filler
                 $S status && kill $server; wait $server; echo it ended with $?"
            ),
            &[
                "expected 512 KiB free in /dev/shm, got",
                "status ended with 1",
                "it ended with 0",
            ],
        );
    }
}
