//! Worlds that are written down and go on, bit for bit: snapshots, forks, servers that come back.

use crate::harness::{
    ENDLESS, Ended, PATIENCE, Paths, SMALL, Server, eventually, fly, frames_until, new_instance,
    reset, run, small_spec, takeover,
};
use crate::wire::{RawClient, Wire, control_header};
use env_server::snapshot::{Durability, Folder, SnapshotWorld, decode, encode};
use protocol::Client;
use protocol::channels::Instance;
use protocol::client::Observation;
use protocol::connection::ConnectionError;
use protocol::control::Request;
use protocol::message::Status;
use protocol::observer::Observer;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

const N_MOVES: usize = 6;

pub fn server_command(server: &Server, arguments: &[&str]) -> Ended {
    let instance = ["--instance", server.instance.name()];
    run(
        "emberwatch-server",
        &[arguments, &instance].concat(),
        PATIENCE,
    )
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

/// The next few observations of a client's world, on paths of its own.
fn future(client: &mut Client, seed: u64) -> Vec<Observation> {
    let paths = Paths::new(seed).take(N_MOVES, 5);
    paths.into_iter().map(|path| fly(client, path)).collect()
}

fn refused(ended: &Ended, words: &str) {
    assert_eq!(ended.code, Some(1), "{}", ended.stderr);
    assert!(ended.stderr.contains(words), "{words:?}: {}", ended.stderr);
}

#[test]
fn a_restored_world_goes_on_bit_for_bit_and_so_does_what_it_remembers() {
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.snapshot");
    let server = Server::start(&format!("{SMALL} --worlds 2 --seed 5 --start random"));
    let mut client = server.acquire(0..2);
    reset(&mut client, 70);
    for paths in [
        Paths::new(1).take(N_MOVES, 2),
        Paths::new(2).take(N_MOVES, 2),
    ] {
        client.step(0..2, &paths).expect("step");
    }
    let before = client.observe(0..2).expect("observe");
    let past = client.recall(0..2, 1).expect("recall");
    let written = server_command(&server, &["snapshot", text(&file)]);
    assert_eq!(written.code, Some(0), "{}", written.stderr);
    let went_on: Vec<_> = (0..5)
        .map(|n| {
            client
                .step(0..2, &Paths::new(9 + n).take(N_MOVES, 2))
                .expect("step")
        })
        .collect();
    let busy = server_command(&server, &["restore", text(&file)]);
    refused(&busy, &format!("busy: held by pid {}", std::process::id()));
    let restored = server_command(&server, &["restore", text(&file), "--takeover"]);
    assert_eq!(restored.code, Some(0), "{}", restored.stderr);
    let again = |server: &Server| {
        let mut client = server.acquire(0..2);
        assert_eq!(client.observe(0..2).expect("observe"), before);
        assert_eq!(client.recall(0..2, 1).expect("recall"), past);
        let future: Vec<_> = (0..5)
            .map(|n| {
                client
                    .step(0..2, &Paths::new(9 + n).take(N_MOVES, 2))
                    .expect("step")
            })
            .collect();
        assert_eq!(future, went_on);
        // Another reset to the seed that it began with gives what that gave.
        reset(&mut client, 70);
        client.observe(0..2).expect("observe")
    };
    let reset_here = again(&server);
    let flags = format!(
        "{SMALL} --worlds 2 --seed 9 --start random --restore {}",
        text(&file)
    );
    assert_eq!(again(&Server::start(&flags)), reset_here);
}

#[test]
fn one_world_of_a_file_takes_the_place_of_one_and_observers_see_it() {
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.snapshot");
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let mut second = server.acquire(1..2);
    fly(&mut second, Paths::new(3).next(N_MOVES));
    let part = ["snapshot", text(&file), "--first-world", "1"];
    assert_eq!(server_command(&server, &part).code, Some(0));
    let observer = Observer::frames(&server.instance).expect("observe");
    frames_until(&observer, 2, 0);
    let into_first = ["restore", text(&file), "--from", "0", "--worlds", "1"];
    let ended = server_command(&server, &into_first);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    let shown = observer
        .receive(PATIENCE)
        .expect("receive")
        .expect("a frame");
    assert_eq!((shown.header.world, shown.header.result.step), (0, 1));
    assert_eq!(server.observe(0), server.observe(1));
    let mut first = server.acquire(0..1);
    assert_eq!(future(&mut first, 4), future(&mut second, 4));
    let beyond = ["restore", text(&file), "--from", "2"];
    refused(
        &server_command(&server, &beyond),
        "--from: expected a world below 2",
    );
    let too_many = ["restore", text(&file), "--worlds", "3", "--takeover"];
    refused(
        &server_command(&server, &too_many),
        "worlds: expected at least 3, got 2",
    );
    let nowhere = ["restore", text(&file), "--first-world", "2", "--takeover"];
    refused(
        &server_command(&server, &nowhere),
        "the server has robots 0 to 2",
    );
}

#[test]
fn a_fork_has_the_future_of_its_world_and_a_life_of_its_own() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let mut original = server.acquire(0..1);
    fly(&mut original, Paths::new(1).next(N_MOVES));
    let ended = server_command(&server, &["fork", "0", "2"]);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    let mut copy = server.acquire(2..3);
    assert_eq!(future(&mut copy, 5), future(&mut original, 5));
    let elsewhere = future(&mut copy, 6);
    assert_ne!(
        elsewhere,
        future(&mut original, 7),
        "their robots fly on their own"
    );
    refused(
        &server_command(&server, &["fork", "0", "2"]),
        "busy: held by pid",
    );
    refused(
        &server_command(&server, &["fork", "0", "3"]),
        "no such robot",
    );
    refused(
        &server_command(&server, &["fork", "7", "1"]),
        "no such world",
    );
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1, 1).lease;
    let stolen = wire.ask(&Request::Fork {
        lease,
        from: 1,
        to: 0,
    });
    assert_eq!(stolen.status(), Status::NoLease, "{stolen:?}");
}

#[test]
fn a_file_that_is_none_is_refused_by_name_and_changes_nothing() {
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.snapshot");
    let server = Server::start(SMALL);
    let mut client = server.acquire(0..1);
    fly(&mut client, Paths::new(1).next(N_MOVES));
    assert_eq!(
        server_command(&server, &["snapshot", text(&file)]).code,
        Some(0)
    );
    let whole = std::fs::read(&file).expect("the snapshot");
    let before = server.observe(0);
    let check = |bytes: &[u8], words: &str| {
        let other = folder.path().join("other");
        std::fs::write(&other, bytes).expect("write");
        let restore = ["restore", text(&other), "--takeover"];
        refused(&server_command(&server, &restore), words);
        let mut client = Client::acquire(server.connect(), &takeover(0..1)).expect("take over");
        let request = Request::Restore {
            lease: client.lease(),
            first_world: 0,
            n_worlds: 1,
            from: 0,
            path: text(&other).into(),
        };
        let Err(ConnectionError::Refused {
            status, message, ..
        }) = client.connection_mut().control(&request, PATIENCE)
        else {
            panic!("expected a refusal of {words:?}");
        };
        assert_eq!(status, Status::BadFile);
        assert!(message.contains(words), "{words:?}: {message}");
        assert_eq!(server.observe(0), before);
    };
    check(b"", "another kind of file");
    check(
        b"PNG and so on, long enough to be a file",
        "another kind of file",
    );
    check(&whole[..whole.len() - 1], "damaged: expected");
    let mut version = whole.clone();
    version[8] = 3;
    check(&version, "expected a snapshot of version 2, got version 3");
    let mut damaged = whole.clone();
    damaged[whole.len() / 2] ^= 1;
    check(&damaged, "damaged: expected the checksum");
    for (path, words) in [
        ("/no/such/file", "snapshot file /no/such/file"),
        ("/dev/zero", "expected a regular file"),
        ("/dev/null", "expected a regular file"),
        ("relative", "path: expected an absolute one"),
    ] {
        let wire = Wire::open(&server.instance);
        let request = Request::Snapshot {
            first_world: 0,
            n_worlds: 1,
            path: path.into(),
        };
        let reply = format!("{:?}", wire.ask(&request));
        assert!(reply.contains(words), "{reply}");
        let ended = server_command(&server, &["restore", path, "--takeover"]);
        assert_eq!(ended.code, Some(1), "{path}: {}", ended.stderr);
    }
    let other = Server::start("--height 5 --width 8 --moves 6 --burn-in 20");
    let foreign = server_command(&other, &["restore", text(&file)]);
    refused(&foreign, "width: expected 8 as this server's, got 7");
    let flags = format!("{SMALL} --worlds 2 --restore {}", text(&file));
    let flags: Vec<&str> = flags.split_whitespace().collect();
    let ended = Server::start_without_waiting(&new_instance(), &flags)
        .program
        .wait(PATIENCE);
    refused(&ended, "worlds: expected 2, got 1");
}

#[test]
fn a_killed_server_comes_back_where_its_last_snapshot_left_it() {
    let folder = TempDir::new().expect("a folder");
    let flags = format!(
        "{SMALL} --worlds 2 --snapshot-every 10 --snapshot-keep 2 --snapshot-dir {0} --restore {0}",
        text(folder.path())
    );
    let (instance, undisturbed) = (
        new_instance(),
        Server::start(&format!("{SMALL} --worlds 2")),
    );
    let mut expected = undisturbed.acquire(0..2);
    let path = |k: u64| Paths::new(k).take(N_MOVES, 2);
    let expected: Vec<_> = (0..100)
        .map(|k| expected.step(0..2, &path(k)).expect("step"))
        .collect();
    let mut at = 0;
    for round in 1..=3 {
        let server = Server::start_on(&instance, &flags);
        let mut client = Client::acquire(server.connect(), &takeover(0..2)).expect("acquire");
        let stands = client.observe(0..2).expect("observe")[0].world.step;
        assert!(stands <= at && stands + 20 > at, "{stands} after {at}");
        for k in stands..25 * round {
            let seen = client.step(0..2, &path(k)).expect("step");
            assert_eq!(seen, expected[k as usize], "step {k}");
        }
        at = 25 * round;
        // At least two a round: after 10 steps, and when that was written or 10 steps later.
        let names = || {
            let entries = std::fs::read_dir(folder.path()).expect("the folder");
            let names = entries.map(|entry| entry.expect("an entry").file_name());
            let mut names: Vec<String> = names.map(|name| name.to_string_lossy().into()).collect();
            names.retain(|name| name.ends_with(".snapshot"));
            names.sort();
            names
        };
        let least = format!("{}-{:012}.snapshot", instance.name(), 2 * round);
        let written = || names().last().is_some_and(|newest| *newest >= least);
        assert!(eventually(PATIENCE, written), "{:?}", names());
        // The last two, and the first of the round, which outlives a loss of power.
        let tidied_up = || matches!(names().len(), 2 | 3);
        assert!(eventually(PATIENCE, tidied_up), "{:?}", names());
        server.kill();
    }
    let server = Server::start_on(&instance, &flags);
    let stands = server.step_of(0);
    let stopped = server_command(&server, &["stop"]);
    assert_eq!(stopped.code, Some(0), "{}", stopped.stderr);
    drop(server.program.wait(PATIENCE));
    // The newest file is damaged: the one before it serves.
    let mut files: Vec<_> = std::fs::read_dir(folder.path())
        .expect("the folder")
        .map(|entry| entry.expect("an entry").path())
        .collect();
    files.sort();
    std::fs::write(files.last().expect("a snapshot"), "EMBRSNAPnonsense").expect("write");
    let server = Server::start_on(&instance, &flags);
    assert_eq!(server.step_of(0), stands, "{}", server.program.stderr());
    server
        .program
        .wait_for_words("another kind of file", PATIENCE);
}

#[test]
fn the_last_few_are_kept_and_one_that_is_spared() {
    let folder = TempDir::new().expect("a folder");
    let instance = Instance::new("lab").expect("a plain name");
    let files = Folder::new(folder.path(), &instance);
    let save = |outlives, spared: Option<&Path>| {
        files
            .save(b"EMBRSNAP", outlives, 2, spared)
            .expect("written")
    };
    let safe = save(Durability::PowerLoss, None);
    for number in 2..6 {
        let path = save(Durability::Kill, Some(&safe));
        let kept: Vec<PathBuf> = files
            .files()
            .expect("a list")
            .into_iter()
            .map(|(_, path)| path)
            .collect();
        assert_eq!(kept.first(), Some(&safe));
        assert_eq!(kept.last(), Some(&path));
        assert_eq!(kept.len(), number.min(3));
    }
    save(Durability::Kill, None);
    assert!(!safe.exists(), "no longer spared");
}

#[test]
fn nothing_but_snapshots_is_replaced_and_no_other_run_s() {
    let folder = TempDir::new().expect("a folder");
    let (notes, link) = (folder.path().join("notes"), folder.path().join("link"));
    std::fs::write(&notes, "kept").expect("write");
    std::os::unix::fs::symlink(&notes, &link).expect("a link");
    let server = Server::start(SMALL);
    for path in [&notes, &link, &folder.path().to_path_buf()] {
        let ended = server_command(&server, &["snapshot", text(path)]);
        refused(&ended, "expected");
    }
    assert_eq!(std::fs::read_to_string(&notes).expect("read"), "kept");
    // A link where the file is written at first leads nowhere else.
    let file = folder.path().join("lab.snapshot");
    let part = format!("lab.snapshot.{}.part", server.program.pid());
    std::os::unix::fs::symlink(&notes, folder.path().join(part)).expect("a link");
    for _ in 0..2 {
        let ended = server_command(&server, &["snapshot", text(&file)]);
        assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    }
    assert_eq!(std::fs::read_to_string(&notes).expect("read"), "kept");
    let flags = format!(
        "{SMALL} --snapshot-every 10 --snapshot-dir {}",
        text(folder.path())
    );
    let instance = new_instance();
    let first = Server::start_on(&instance, &flags);
    assert_eq!(server_command(&first, &["stop"]).code, Some(0));
    drop(first.program.wait(PATIENCE));
    let flags: Vec<&str> = flags.split_whitespace().collect();
    let second = Server::start_without_waiting(&instance, &flags);
    refused(
        &second.program.wait(PATIENCE),
        "or --restore, got 1 of another run",
    );
}

#[test]
fn snapshots_of_other_instances_alone_are_told_of() {
    let folder = TempDir::new().expect("a folder");
    let flags = format!("{SMALL} --restore {}", text(folder.path()));
    let first = Server::start(&flags);
    first.program.wait_for_words("nothing to restore", PATIENCE);
    let other = folder.path().join("other-000000000001.snapshot");
    let written = server_command(&first, &["snapshot", text(&other)]);
    assert_eq!(written.code, Some(0), "{}", written.stderr);
    let second = Server::start(&flags);
    let name = second.instance.name();
    let words = format!("this instance, {name}-<12 digits>.snapshot, got others, such as other-0");
    second.program.wait_for_words(&words, PATIENCE);
    let log = second.program.stderr();
    assert!(
        log.contains("WARN") && log.contains("new worlds start"),
        "{log}"
    );
}

#[test]
fn snapshots_that_cannot_be_written_are_warned_of_now_and_then() {
    let folder = TempDir::new().expect("a folder");
    let place = folder.path().join("snaps");
    let flags = format!("{SMALL} --snapshot-every 1 --snapshot-dir {}", text(&place));
    let server = Server::start(&flags);
    std::fs::remove_dir(&place).expect("remove");
    std::fs::write(&place, "no folder").expect("write");
    let mut client = server.acquire(0..1);
    for k in 0..300 {
        fly(&mut client, Paths::new(k).next(N_MOVES));
    }
    server.program.wait_for_words("not saved", PATIENCE);
    let log = server.program.stderr();
    assert!(log.matches("not saved").count() < 30, "{log}");
}

#[test]
fn a_world_in_its_burn_in_begins_again_after_a_restart() {
    let folder = TempDir::new().expect("a folder");
    let server = Server::start_with_endless_resets(&format!(
        "--snapshot-every 10 --snapshot-dir {}",
        text(folder.path())
    ));
    let mut stepping = server.acquire(0..1);
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1, 1).lease;
    let reset = format!(r#"{{"op":"reset","lease":{lease},"worlds":[{{"world":1,"seed":77}}]}}"#);
    let pending = wire.send_control(control_header(1), reset.as_bytes());
    assert!(eventually(PATIENCE, || server.status().worlds[1].resetting));
    for k in 0..20 {
        fly(&mut stepping, Paths::new(k).next(N_MOVES));
    }
    let snapshots = || {
        let entries = std::fs::read_dir(folder.path()).expect("the folder");
        let mut paths: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
        paths.retain(|path| path.extension() == Some("snapshot".as_ref()));
        paths
    };
    assert!(eventually(PATIENCE, || !snapshots().is_empty()));
    server.kill();
    drop(pending);
    let copy = with_short_burn_in(&snapshots()[0]);
    let flags = format!("{SMALL} --worlds 2 --restore {}", text(&copy));
    let worlds = Server::start(&flags).status().worlds;
    assert!((10..=20).contains(&worlds[0].info.step), "{worlds:?}");
    let begun = &worlds[1].info;
    assert_eq!((begun.seed, begun.episode, begun.step), (77, 1, 0));
}

/// A copy of a snapshot of a server with endless resets, as if that had been a [`SMALL`] one.
fn with_short_burn_in(file: &Path) -> PathBuf {
    let bytes = std::fs::read(file).expect("the snapshot");
    let spec = small_spec(ENDLESS);
    let snapshot = decode(&bytes).expect("a snapshot");
    let restored = snapshot.restore(&spec).expect("of that server");
    let worlds = restored.iter().map(|world| match world {
        SnapshotWorld::Ready(episode) => SnapshotWorld::Ready(&**episode),
        SnapshotWorld::New(new) => SnapshotWorld::New(*new),
    });
    let worlds: Vec<_> = worlds.collect();
    let copy = file.with_extension("copy");
    let bytes = encode(&small_spec(20).settings, &worlds).expect("small");
    std::fs::write(&copy, bytes).expect("write");
    copy
}
