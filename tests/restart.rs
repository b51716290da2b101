//! Tests of servers that are ended by a signal or killed, and of their agents and of the next server on the instance.

use emberwatch_protocol::channels::{ChannelError, Instance, create_node};
use emberwatch_protocol::connection::{Connection, ConnectionError};
use emberwatch_protocol::control::Request;
use emberwatch_protocol::observer::Observer;
use iceoryx2::prelude::ServiceName;
use rustix::process::Signal;
use std::collections::BTreeSet;
use std::path::PathBuf;
use tests::harness::{
    ENDLESS, PATIENCE, Paths, Program, SMALL, Server, new_instance, reset, send_paths,
    service_files,
};

fn start_agent(instance: &Instance) -> Program {
    Program::agent(instance, "--policy random_walk")
}

fn is_held_by(server: &Server, agent: &Program) -> bool {
    server.holder() == Some(agent.pid())
}

#[test]
fn an_agent_outlives_a_pause_and_the_end_of_its_server() {
    let instance = new_instance();
    let server = Server::start_on(&instance, &format!("{SMALL} --lease-millis 86400000"));
    let agent = start_agent(&instance);
    let acts = |server: &Server| is_held_by(server, &agent) && server.status().n_steps > 0;
    agent.until(|| acts(&server));
    server.program.stop();
    agent.wait_for_words("no answer to step");
    server.program.signal(Signal::CONT);
    let before = server.status().n_steps;
    agent.until(|| server.status().n_steps > before + 10);
    assert!(acts(&server));
    server.kill();
    agent.wait_for_words("is gone; waiting for the server to come back");
    let server = Server::start_on(&instance, SMALL);
    agent.until(|| acts(&server));
    server.command("stop").check(0);
    // An agent without a server still stops on a signal.
    agent.finish();
}

#[test]
fn clients_learn_of_a_killed_server_and_the_next_takes_its_place() {
    use ConnectionError::{Refused, ServerGone};
    let instance = new_instance();
    let first = Server::start_on(&instance, SMALL);
    let mut client = first.acquire(0..1);
    let step = send_paths(&mut client, Paths::new(0).next(6));
    let mut waiting = first.connect();
    first.program.stop();
    let refused = std::thread::scope(|scope| {
        scope.spawn(|| first.program.signal(Signal::KILL));
        waiting.control(&Request::Status {}, 4 * PATIENCE)
    });
    assert!(matches!(refused, Err(ServerGone { .. })), "{refused:?}");
    first.kill();
    let second = Server::start_on(&instance, SMALL);
    let refused = client.step(0..1, &[Paths::new(0).next(6)]);
    let is_told = matches!(refused, Err(ServerGone { .. } | Refused { .. }));
    assert!(is_told, "{refused:?}");
    let mut next = second.acquire(0..1);
    // The new server starts from the same seed, so the first step is the same.
    assert_eq!(send_paths(&mut next, Paths::new(0).next(6)), step);
}

#[test]
fn a_server_of_another_version_is_called_so() {
    let instance = new_instance();
    let node = create_node().expect("a node");
    let name = format!("emberwatch/v2/{}/control", instance.name());
    let name = ServiceName::new(&name).expect("a name");
    let service = node.service_builder(&name).request_response::<[u8], [u8]>();
    let service = service.create().expect("a service of the last version");
    let refused = Connection::open(&instance, "test", PATIENCE).map(drop);
    let words = refused.expect_err("another version").to_string();
    assert!(
        words.contains("the client speaks 3, the server 2;"),
        "{words}"
    );
    let other = Connection::open(&new_instance(), "test", PATIENCE).map(drop);
    let is_none = matches!(
        &other,
        Err(ConnectionError::Channel(ChannelError::NoServer { .. }))
    );
    assert!(is_none, "{other:?}");
    drop(service);
}

#[test]
fn a_signal_ends_a_server_with_code_0() {
    for (signal, burn_in) in [(Signal::TERM, 0), (Signal::INT, 0), (Signal::TERM, ENDLESS)] {
        let flags = format!("--height 40 --width 40 --burn-in {burn_in}");
        let server = Server::start_without_waiting(&new_instance(), &flags);
        server.program.wait_for_words("serving");
        let agent = start_agent(&server.instance);
        agent.until(|| server.status().n_clients > 1);
        server.program.signal(signal);
        server.program.ends(0);
    }
}

#[test]
fn a_clean_stop_leaves_nothing_behind() {
    let server = Server::start(&format!("{SMALL} --publish-truth --worlds 2"));
    let instance = server.instance.clone();
    let observer = Observer::frames(&instance).expect("observe");
    let agent = start_agent(&instance);
    agent.until(|| is_held_by(&server, &agent));
    let mut client = server.acquire(1..2);
    reset(&mut client, 3);
    send_paths(&mut client, Paths::new(0).next(6));
    let files = shared_files(&[server.program.pid(), agent.pid()]);
    assert!(files.len() > 5, "{files:?}");
    client.release().expect("release");
    agent.finish();
    drop(observer);
    server.program.finish();
    let left: Vec<_> = files
        .iter()
        .filter_map(|path| Some((path, path.metadata().ok()?.len())))
        .filter(|(_, length)| *length > 16)
        .collect();
    assert!(left.is_empty(), "{left:?}");
    assert_eq!(service_files(&instance), Vec::<PathBuf>::new());
}

/// Returns the files in shared memory that these processes have mapped.
fn shared_files(pids: &[u32]) -> BTreeSet<PathBuf> {
    let read = |pid| std::fs::read_to_string(format!("/proc/{pid}/maps")).expect("its memory");
    let maps: String = pids.iter().map(read).collect();
    let paths = maps
        .lines()
        .filter_map(|line| line.split_whitespace().nth(5));
    let shared = paths.filter(|path| path.starts_with("/dev/shm/"));
    shared.map(PathBuf::from).collect()
}
