//! Where the channels are: what happens when it cannot be used, or is taken away.
//!
//! In a mount namespace of its own, as that is everybody's; where none may be made, those tests say so and pass, but
//! in CI they fail.

use std::io::Write;
use std::process::{Command, Output};
use tests::harness::{SMALL, program_path};

/// Runs a shell script where `/dev/shm` is its own; `$S` is the server. `None` if there may be no such place.
fn apart(script: &str) -> Option<Output> {
    let run = |script: &str| {
        let mut command = Command::new("unshare");
        let script = format!("mount -t tmpfs -o size=256m tmpfs /dev/shm && {script}");
        let kind = if rustix::process::getuid().is_root() {
            "-m"
        } else {
            "-rm"
        };
        command
            .args([kind, "timeout", "60", "sh", "-c", &script])
            .env("S", program_path("emberwatch-server"))
            .env("RUST_LOG", "info");
        command.output().ok()
    };
    if !run("true").is_some_and(|output| output.status.success()) {
        assert!(std::env::var_os("CI").is_none(), "no mount namespace");
        let note = "skipped: this process may not make a mount namespace\n";
        let _ = std::io::stderr().write_all(note.as_bytes());
        return None;
    }
    run(script)
}

#[test]
fn a_server_without_its_files_ends_and_spares_its_successor() {
    let script = format!(
        "$S {SMALL} & first=$!
         until $S status >/dev/null 2>&1; do sleep 0.01; done
         rm -rf /dev/shm/emberwatch-*
         $S {SMALL} & second=$!
         wait $first; echo first ended with $?
         until $S status >/dev/null 2>&1; do sleep 0.01; done
         sleep 0.5; $S status && kill $second; wait $second; echo second ended with $?"
    );
    let Some(output) = apart(&script) else { return };
    let (said, warned) = (
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    );
    assert!(said.contains("first ended with 1"), "{said} {warned}");
    assert!(
        warned.contains("was removed while it was in use"),
        "{warned}"
    );
    assert!(said.contains("second ended with 0"), "{said} {warned}");
}

#[test]
fn shared_memory_that_is_read_only_is_called_so() {
    for before in ["true", "$S status --instance nobody"] {
        let script = format!("{before} 2>/dev/null; mount -o remount,ro /dev/shm; $S {SMALL}");
        let Some(output) = apart(&script) else { return };
        let words = String::from_utf8_lossy(&output.stderr);
        for expected in ["Read-only file system", "remount,rw /dev/shm"] {
            assert!(words.contains(expected), "{words}");
        }
    }
}

#[test]
fn what_cannot_be_read_of_a_living_server_stays() {
    let script = format!(
        "$S {SMALL} & server=$!
         until $S status >/dev/null 2>&1; do sleep 0.01; done
         rm /dev/shm/emberwatch-*/nodes/*node_monitor_owner_lock
         $S status --instance nobody
         sleep 0.5; $S status && kill $server; wait $server; echo it ended with $?"
    );
    let Some(output) = apart(&script) else { return };
    let said = String::from_utf8_lossy(&output.stdout);
    let warned = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("it ended with 0"), "{said} {warned}");
}

#[test]
fn a_server_in_another_pid_namespace_is_called_so_and_goes_on() {
    let script = format!(
        "$S {SMALL} & server=$!
         until $S status >/dev/null 2>&1; do sleep 0.01; done
         unshare -p -f --mount-proc sh -c '$S status; $S stop; $S {SMALL}'
         $S status && kill $server; wait $server; echo it ended with $?"
    );
    let Some(output) = apart(&script) else { return };
    let said = String::from_utf8_lossy(&output.stdout);
    let warned = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("it ended with 0"), "{said} {warned}");
    let refusal = "served from another PID namespace";
    assert_eq!(warned.matches(refusal).count(), 3, "{warned}");
}

#[test]
fn two_servers_with_pid_1_are_told_apart() {
    let other = "unshare -p -f --kill-child --mount-proc $S";
    let script = format!(
        "{other} {SMALL} & first=$!
         until $S status 2>&1 | grep -q 'another PID namespace'; do sleep 0.01; done
         {other} {SMALL}; echo the second ended with $?; kill -9 $first"
    );
    let Some(output) = apart(&script) else { return };
    let said = String::from_utf8_lossy(&output.stdout);
    let warned = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("the second ended with 1"), "{said} {warned}");
    let refusal = "served from another PID namespace";
    assert!(warned.contains(refusal), "{warned}");
}

#[test]
fn a_full_shared_memory_is_called_so_and_kills_nobody() {
    let fill = "fallocate -l $(($(stat -f -c '%a * %S' /dev/shm) - LEFT)) /dev/shm/filler";
    for left in [0, 8192, 65536] {
        let fill = fill.replace("LEFT", &left.to_string());
        let script = format!(
            "$S {SMALL} & server=$!
             until $S status >/dev/null 2>&1; do sleep 0.01; done
             {fill}; $S status; echo status ended with $?; rm /dev/shm/filler
             $S status && kill $server; wait $server; echo it ended with $?"
        );
        let Some(output) = apart(&script) else { return };
        let said = String::from_utf8_lossy(&output.stdout);
        let warned = String::from_utf8_lossy(&output.stderr);
        let refusal = "expected 512 KiB free in /dev/shm, got";
        assert!(warned.contains(refusal), "{left}: {warned}");
        for expected in ["status ended with 1", "it ended with 0"] {
            assert!(said.contains(expected), "{left}: {said} {warned}");
        }
    }
}
