//! Programs that are killed at any moment of their start or end: the next ones find nothing in their way.

use std::path::PathBuf;
use std::time::Duration;
use tests::harness::Server;
use tests::kills::{FLAGS, Kills, files_of, kill_in_loops, look_up_nobody};

#[test]
fn killed_programs_leave_nothing_in_the_way() {
    let kills = Kills {
        starts: 40,
        ends: 10,
        connects: 10,
        with_python: false,
    };
    let left = kill_in_loops(3, kills);
    look_up_nobody();
    for instance in &left.instances {
        Server::start_on(instance, FLAGS).program.finish();
    }
    emberwatch_protocol::cleanup::remove_leftovers().expect("a turn");
    assert_eq!(files_of(&left), Vec::<PathBuf>::new());
}

#[test]
fn an_idle_server_reads_no_files_of_others() {
    let server = Server::start(FLAGS);
    let n_bytes = || {
        let usage = format!("/proc/{}/io", server.program.pid());
        let usage = std::fs::read_to_string(usage).expect("what it read");
        let line = usage.lines().find_map(|line| line.strip_prefix("rchar: "));
        line.expect("a line").parse::<u64>().expect("a number")
    };
    let before = n_bytes();
    std::thread::sleep(Duration::from_secs(5));
    let read = n_bytes() - before;
    assert!(read < 1000, "{read} bytes");
}
