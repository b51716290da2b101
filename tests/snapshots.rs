//! Tests of snapshots, forks and restarted servers: saved worlds continue bit for bit.

use crate::commands::check;
use emberwatch_protocol::Client;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::Observation;
use emberwatch_protocol::control::Request;
use emberwatch_protocol::message::Status;
use emberwatch_protocol::observer::Observer;
use emberwatch_sim::snapshot::{self, Durability};
use std::path::{Path, PathBuf};
use tests::harness::{
    Folder, PATIENCE, Paths, SERVER, SMALL, Server, fly_on, frames_until, new_instance, send_paths,
};
use tests::wire::{RawClient, Wire};

const N_MOVES: usize = 6;

/// Flies random paths in a client's worlds and returns the observations.
fn future(client: &mut Client, seed: u64) -> Vec<Observation> {
    let (mut paths, robots) = (Paths::new(seed), client.robots());
    let mut step = || {
        client
            .step(robots.clone(), &paths.take(N_MOVES, robots.len()))
            .expect("step")
    };
    (0..5).flat_map(|_| step()).collect()
}

/// Runs a command and checks that the server refuses it.
fn refused(server: &Server, command: &str, words: &str) {
    server.command(command).check(1).check_says(words);
}

/// Returns the snapshots in a folder, sorted by name.
fn snapshots_in(folder: &Folder) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder.path(""))
        .expect("the folder")
        .flatten();
    let mut paths: Vec<_> = entries.map(|entry| entry.path()).collect();
    paths.retain(|path| path.extension() == Some("snapshot".as_ref()));
    paths.sort();
    paths
}

#[test]
fn one_world_of_a_file_takes_the_place_of_one_and_observers_see_it() {
    let folder = Folder::default();
    let file = folder.word("lab.snapshot");
    let server = Server::start(&format!("{SMALL} --worlds 3 --lease-millis 86400000"));
    let mut second = server.acquire(1..2);
    send_paths(&mut second, Paths::new(3).next(N_MOVES));
    let part = format!("snapshot {file} --first-world 1");
    server.command(&part).check(0);
    let observer = Observer::frames(&server.instance).expect("observe");
    frames_until(&observer, 2, 0);
    let restore = |flags: &str| format!("restore {file} {flags}");
    server.command(&restore("--from 0 --worlds 1")).check(0);
    let shown = observer
        .receive(PATIENCE)
        .expect("receive")
        .expect("a frame");
    assert_eq!((shown.header.world, shown.header.result.step), (0, 1));
    let at = |robot: u32| server.observe(robot);
    assert_eq!(at(0), at(1));
    // A fork has the same future as the original world, but is independent of it.
    server.command("fork 1 2").check(0);
    refused(&server, "fork 7 2", "no such world");
    assert_eq!(at(2), at(1));
    let mut copies = [0, 2].map(|robot| server.acquire(robot..robot + 1));
    let of_second = future(&mut second, 4);
    for copy in &mut copies {
        assert_eq!(future(copy, 4), of_second);
    }
    assert_ne!(future(&mut copies[0], 6), future(&mut second, 7));
    for (fork, words) in [
        ("fork 0 2", "busy: held by pid"),
        ("fork 0 3", "no such robot"),
    ] {
        refused(&server, fork, words);
    }
    let lease = copies[0].lease();
    let stolen = Wire::open(&server.instance).ask(&Request::Fork {
        lease,
        from: 1,
        to: 0,
    });
    assert_eq!(stolen.status(), Status::NoLease, "{stolen:?}");
    for (flags, words) in [
        ("--from 2", "--from: expected a world below 2"),
        (
            "--worlds 3 --takeover",
            "worlds: expected a file of at least 3 worlds, got 2",
        ),
        ("--first-world 2 --takeover", "there are robots 0 to 2"),
    ] {
        refused(&server, &restore(flags), words);
    }
}

#[test]
fn a_file_that_is_none_is_refused_by_name_and_changes_nothing() {
    let folder = Folder::default();
    let file = folder.word("lab.snapshot");
    let server = Server::start(SMALL);
    send_paths(&mut server.acquire(0..1), Paths::new(1).next(N_MOVES));
    server.command(&format!("snapshot {file}")).check(0);
    let (whole, before) = (folder.bytes("lab.snapshot"), server.observe(0));
    for (at, words) in [
        (whole.len() / 2, "damaged: expected the checksum"),
        (8, "expected a snapshot of version 2, got version 3"),
    ] {
        let mut damaged = whole.clone();
        damaged[at] ^= 1;
        let path = folder.write("other", damaged);
        refused(&server, &format!("restore {path} --takeover"), words);
    }
    assert_eq!(server.observe(0), before);
    for (path, words) in [
        ("/no/such/file", "snapshot file /no/such/file"),
        ("/dev/zero", "expected a regular file"),
        ("relative", "path: expected an absolute path"),
    ] {
        let request = Request::Snapshot {
            first_world: 0,
            n_worlds: 1,
            path: path.into(),
        };
        let reply = format!("{:?}", Wire::open(&server.instance).ask(&request));
        assert!(reply.contains(words), "{reply}");
        server
            .command(&format!("restore {path} --takeover"))
            .check(1);
    }
    for (flags, words) in [
        ("--width 8", "width: expected 8, as on this server, got 7"),
        ("--width 7 --worlds 2", "worlds: expected 2, got 1"),
    ] {
        let flags = format!("--height 5 {flags} --moves 6 --burn-in 20 --restore {file}");
        check(SERVER, &flags, words);
    }
}

#[test]
fn a_killed_server_comes_back_where_its_last_snapshot_left_it() {
    let folder = Folder::default();
    let flags = format!(
        "{SMALL} --worlds 2 --snapshot-every 10 --snapshot-keep 2 --snapshot-dir {0} --restore {0}",
        folder.word("")
    );
    let instance = new_instance();
    let undisturbed = Server::start(&format!("{SMALL} --worlds 2"));
    let mut expected = undisturbed.acquire(0..2);
    let path = |k: u64| Paths::new(k).take(N_MOVES, 2);
    let expected: Vec<_> = (0..75)
        .map(|k| expected.step(0..2, &path(k)).expect("step"))
        .collect();
    let files = || snapshots_in(&folder);
    let mut at = 0;
    for round in 1..=3 {
        let server = Server::start_on(&instance, &flags);
        let mut client = server.take_over(0..2);
        let stands = client.observe(0..2).expect("observe")[0].world.step;
        assert!(stands <= at && stands + 20 > at, "{stands} after {at}");
        at = 25 * round;
        for k in stands..at {
            let seen = client.step(0..2, &path(k)).expect("step");
            assert_eq!(seen, expected[k as usize], "step {k}");
        }
        // Each round writes at least two snapshots: the first after 10 steps, and the second at least 10 steps later,
        // after the first was written.
        let least = folder.path(&format!("{}-{:012}.snapshot", instance.name(), 2 * round));
        server
            .program
            .until(|| files().last().is_some_and(|newest| *newest >= least));
        // The folder keeps the latest two snapshots, and the round's first one if it is older, because that one
        // survives a power failure.
        server.program.until(|| matches!(files().len(), 2 | 3));
        server.kill();
    }
    let server = Server::start_on(&instance, &flags);
    let stands = server.step_of(0);
    server.program.finish();
    // The newest snapshot is damaged, so the previous one is restored.
    std::fs::write(files().last().expect("a snapshot"), "EMBRSNAPnonsense").expect("write");
    let server = Server::start_on(&instance, &flags);
    assert_eq!(server.step_of(0), stands, "{}", server.program.stderr());
    server.program.wait_for_words("another kind of file");
}

#[test]
fn the_last_few_are_kept_and_one_that_is_spared() {
    let folder = Folder::default();
    let instance = Instance::new("lab").expect("a plain name");
    let files = snapshot::Folder::new(&folder.path(""), &instance);
    let save = |outlives, spared: Option<&Path>| {
        files
            .save(b"EMBRSNAP", outlives, 2, spared)
            .expect("written")
    };
    let safe = save(Durability::PowerLoss, None);
    for number in 2..6 {
        let path = save(Durability::Kill, Some(&safe));
        let kept = snapshots_in(&folder);
        assert_eq!((kept.first(), kept.last()), (Some(&safe), Some(&path)));
        assert_eq!(kept.len(), number.min(3));
    }
    save(Durability::Kill, None);
    assert!(!safe.exists(), "no longer protected");
}

#[test]
fn nothing_but_snapshots_is_replaced_and_no_other_run_s() {
    let folder = Folder::default();
    folder.write("notes", "kept");
    let link = |name: &str| {
        std::os::unix::fs::symlink(folder.path("notes"), folder.path(name)).expect("a link");
    };
    link("link");
    let server = Server::start(SMALL);
    for path in ["notes", "link", ""] {
        refused(
            &server,
            &format!("snapshot {}", folder.word(path)),
            "expected",
        );
    }
    // A link at the path of the temporary file is replaced, not followed.
    link(&format!("lab.snapshot.{}.part", server.program.pid()));
    for _ in 0..2 {
        server
            .command(&format!("snapshot {}", folder.word("lab.snapshot")))
            .check(0);
    }
    assert_eq!(folder.text("notes"), "kept");
    let flags = format!(
        "{SMALL} --snapshot-every 10 --snapshot-dir {}",
        folder.word("")
    );
    let instance = new_instance();
    Server::start_on(&instance, &flags).program.finish();
    let second = Server::start_without_waiting(&instance, &flags);
    second
        .program
        .ends(1)
        .check_says("got 1 of an earlier run: continue it with --restore");
    let other = Server::start(&format!("{SMALL} --restore {}", folder.word("")));
    let name = other.instance.name();
    let words = format!("this instance, {name}-<12 digits>.snapshot, got others, such as ");
    for words in [&words, "WARN", "new worlds start"] {
        other.program.wait_for_words(words);
    }
}

#[test]
fn snapshots_that_cannot_be_written_are_warned_of_now_and_then() {
    let folder = Folder::default();
    let flags = format!("--snapshot-every 1 --snapshot-dir {}", folder.word("snaps"));
    let server = Server::start(&format!("{SMALL} {flags}"));
    std::fs::remove_dir(folder.path("snaps")).expect("remove");
    folder.write("snaps", "no folder");
    let mut client = server.acquire(0..1);
    fly_on(&mut client, 0, 300);
    server.program.wait_for_words("no snapshot was written");
    let log = server.program.stderr();
    assert!(log.matches("no snapshot was written").count() < 30, "{log}");
}
