//! Worlds that are written down and go on, bit for bit: snapshots, forks, servers that come back.

use emberwatch_protocol::Client;
use emberwatch_protocol::channels::Instance;
use emberwatch_protocol::client::Observation;
use emberwatch_protocol::connection::ConnectionError;
use emberwatch_protocol::control::Request;
use emberwatch_protocol::message::Status;
use emberwatch_protocol::observer::Observer;
use emberwatch_sim::snapshot::{Durability, Folder, SnapshotWorld, decode, encode};
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use tests::harness::{
    ENDLESS, PATIENCE, Paths, SMALL, Server, eventually, fly, frames_until, new_instance, reset,
    small_spec,
};
use tests::wire::{RawClient, Wire, control_header};

const N_MOVES: usize = 6;

/// The next few observations of a client's world, on paths of its own.
fn future(client: &mut Client, seed: u64) -> Vec<Observation> {
    let paths = Paths::new(seed).take(N_MOVES, 5);
    paths.into_iter().map(|path| fly(client, path)).collect()
}

/// Runs a command of the program that the server refuses.
fn refused(server: &Server, command: &str, words: &str) {
    server.command(command).check(1).check_says(words);
}

#[test]
fn a_restored_world_and_its_memory_continue_bit_for_bit() {
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.snapshot");
    let file = file.display();
    let server = Server::start(&format!("{SMALL} --worlds 2 --seed 5 --start random"));
    let mut client = server.acquire(0..2);
    reset(&mut client, 70);
    let fly_both = |client: &mut Client, seed| {
        let paths = Paths::new(seed).take(N_MOVES, 2);
        client.step(0..2, &paths).expect("step")
    };
    let future = |client: &mut Client| (9..14).map(|seed| fly_both(client, seed)).collect();
    fly_both(&mut client, 1);
    fly_both(&mut client, 2);
    let before = client.observe(0..2).expect("observe");
    let past = client.recall(0..2, 1).expect("recall");
    server.command(&format!("snapshot {file}")).check(0);
    let went_on: Vec<_> = future(&mut client);
    let busy = format!("busy: held by pid {}", std::process::id());
    refused(&server, &format!("restore {file}"), &busy);
    let restore = format!("restore {file} --takeover");
    server.command(&restore).check(0);
    let again = |server: &Server| {
        let mut client = server.acquire(0..2);
        assert_eq!(client.observe(0..2).expect("observe"), before);
        assert_eq!(client.recall(0..2, 1).expect("recall"), past);
        assert_eq!(future(&mut client), went_on);
        // Another reset to the seed that it began with gives what that gave.
        reset(&mut client, 70);
        client.observe(0..2).expect("observe")
    };
    let reset_here = again(&server);
    let flags = format!("{SMALL} --worlds 2 --seed 9 --start random --restore {file}");
    assert_eq!(again(&Server::start(&flags)), reset_here);
}

#[test]
fn one_world_of_a_file_takes_the_place_of_one_and_observers_see_it() {
    let folder = TempDir::new().expect("a folder");
    let file = folder.path().join("lab.snapshot");
    let file = file.display();
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let mut second = server.acquire(1..2);
    fly(&mut second, Paths::new(3).next(N_MOVES));
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
    assert_eq!(server.observe(0), server.observe(1));
    let mut first = server.acquire(0..1);
    assert_eq!(future(&mut first, 4), future(&mut second, 4));
    for (flags, words) in [
        ("--from 2", "--from: expected a world below 2"),
        (
            "--worlds 3 --takeover",
            "worlds: expected at least 3, got 2",
        ),
        ("--first-world 2 --takeover", "there are robots 0 to 2"),
    ] {
        refused(&server, &restore(flags), words);
    }
}

#[test]
fn a_fork_has_the_future_of_its_world_and_a_life_of_its_own() {
    let server = Server::start(&format!("{SMALL} --worlds 3"));
    let mut original = server.acquire(0..1);
    fly(&mut original, Paths::new(1).next(N_MOVES));
    server.command("fork 0 2").check(0);
    let mut copy = server.acquire(2..3);
    assert_eq!(future(&mut copy, 5), future(&mut original, 5));
    let elsewhere = future(&mut copy, 6);
    let original = future(&mut original, 7);
    assert_ne!(elsewhere, original, "their robots fly on their own");
    refused(&server, "fork 0 2", "busy: held by pid");
    refused(&server, "fork 0 3", "no such robot");
    refused(&server, "fork 7 1", "no such world");
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1..2).lease;
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
    server
        .command(&format!("snapshot {}", file.display()))
        .check(0);
    let whole = std::fs::read(&file).expect("the snapshot");
    let before = server.observe(0);
    let check = |bytes: &[u8], words: &str| {
        let other = folder.path().join("other");
        std::fs::write(&other, bytes).expect("write");
        let restore = format!("restore {} --takeover", other.display());
        refused(&server, &restore, words);
        let mut client = server.take_over(0..1);
        let request = Request::Restore {
            lease: client.lease(),
            first_world: 0,
            n_worlds: 1,
            from: 0,
            path: other.display().to_string(),
        };
        let Err(ConnectionError::Refused {
            status, message, ..
        }) = client.backend().control(&request, PATIENCE)
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
        server
            .command(&format!("restore {path} --takeover"))
            .check(1);
    }
    let other = Server::start("--height 5 --width 8 --moves 6 --burn-in 20");
    let file = file.display();
    let words = "width: expected 8 as this server's, got 7";
    refused(&other, &format!("restore {file}"), words);
    let flags = format!("{SMALL} --worlds 2 --restore {file}");
    let server = Server::start_without_waiting(&new_instance(), &flags);
    let ended = server.program.ends(1);
    ended.check_says("worlds: expected 2, got 1");
}

#[test]
fn a_killed_server_comes_back_where_its_last_snapshot_left_it() {
    let folder = TempDir::new().expect("a folder");
    let flags = format!(
        "{SMALL} --worlds 2 --snapshot-every 10 --snapshot-keep 2 --snapshot-dir {0} --restore {0}",
        folder.path().display()
    );
    let instance = new_instance();
    let undisturbed = Server::start(&format!("{SMALL} --worlds 2"));
    let mut expected = undisturbed.acquire(0..2);
    let path = |k: u64| Paths::new(k).take(N_MOVES, 2);
    let expected: Vec<_> = (0..100)
        .map(|k| expected.step(0..2, &path(k)).expect("step"))
        .collect();
    let mut at = 0;
    for round in 1..=3 {
        let server = Server::start_on(&instance, &flags);
        let mut client = server.take_over(0..2);
        let stands = client.observe(0..2).expect("observe")[0].world.step;
        assert!(stands <= at && stands + 20 > at, "{stands} after {at}");
        for k in stands..25 * round {
            let seen = client.step(0..2, &path(k)).expect("step");
            assert_eq!(seen, expected[k as usize], "step {k}");
        }
        at = 25 * round;
        // At least two a round: after 10 steps, and when that was written or 10 steps later.
        let files = || snapshots_in(folder.path());
        let least = format!("{}-{:012}.snapshot", instance.name(), 2 * round);
        let least = folder.path().join(least);
        let written = || files().last().is_some_and(|newest| *newest >= least);
        assert!(eventually(PATIENCE, written), "{:?}", files());
        // The last two, and the first of the round, which outlives a loss of power.
        let tidied_up = || matches!(files().len(), 2 | 3);
        assert!(eventually(PATIENCE, tidied_up), "{:?}", files());
        server.kill();
    }
    let server = Server::start_on(&instance, &flags);
    let stands = server.step_of(0);
    server.program.finish();
    // The newest file is damaged: the one before it serves.
    let files = snapshots_in(folder.path());
    std::fs::write(files.last().expect("a snapshot"), "EMBRSNAPnonsense").expect("write");
    let server = Server::start_on(&instance, &flags);
    assert_eq!(server.step_of(0), stands, "{}", server.program.stderr());
    server.program.wait_for_words("another kind of file");
}

/// The snapshots in a folder, by name.
fn snapshots_in(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("the folder").flatten();
    let mut paths: Vec<_> = entries.map(|entry| entry.path()).collect();
    paths.retain(|path| path.extension() == Some("snapshot".as_ref()));
    paths.sort();
    paths
}

#[test]
fn the_last_few_are_kept_and_one_that_is_spared() {
    let folder = TempDir::new().expect("a folder");
    let instance = Instance::new("lab").expect("a plain name");
    let files = Folder::new(folder.path(), &instance);
    let save = |outlives, spared: Option<&Path>| {
        let saved = files.save(b"EMBRSNAP", outlives, 2, spared);
        saved.expect("written")
    };
    let safe = save(Durability::PowerLoss, None);
    for number in 2..6 {
        let path = save(Durability::Kill, Some(&safe));
        let kept = files.files().expect("a list").into_iter();
        let kept: Vec<PathBuf> = kept.map(|(_, path)| path).collect();
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
        refused(&server, &format!("snapshot {}", path.display()), "expected");
    }
    assert_eq!(std::fs::read_to_string(&notes).expect("read"), "kept");
    // A link where the file is written at first leads nowhere else.
    let file = folder.path().join("lab.snapshot");
    let part = format!("lab.snapshot.{}.part", server.program.pid());
    std::os::unix::fs::symlink(&notes, folder.path().join(part)).expect("a link");
    for _ in 0..2 {
        server
            .command(&format!("snapshot {}", file.display()))
            .check(0);
    }
    assert_eq!(std::fs::read_to_string(&notes).expect("read"), "kept");
    let folder = folder.path().display();
    let flags = format!("{SMALL} --snapshot-every 10 --snapshot-dir {folder}");
    let instance = new_instance();
    Server::start_on(&instance, &flags).program.finish();
    let second = Server::start_without_waiting(&instance, &flags);
    let ended = second.program.ends(1);
    ended.check_says("or --restore, got 1 of another run");
}

#[test]
fn snapshots_of_other_instances_alone_are_told_of() {
    let folder = TempDir::new().expect("a folder");
    let flags = format!("{SMALL} --restore {}", folder.path().display());
    let first = Server::start(&flags);
    first.program.wait_for_words("nothing to restore");
    let other = folder.path().join("other-000000000001.snapshot");
    first
        .command(&format!("snapshot {}", other.display()))
        .check(0);
    let second = Server::start(&flags);
    let name = second.instance.name();
    let words = format!("this instance, {name}-<12 digits>.snapshot, got others, such as other-0");
    second.program.wait_for_words(&words);
    for words in ["WARN", "new worlds start"] {
        second.program.wait_for_words(words);
    }
}

#[test]
fn snapshots_that_cannot_be_written_are_warned_of_now_and_then() {
    let folder = TempDir::new().expect("a folder");
    let place = folder.path().join("snaps");
    let flags = format!("--snapshot-every 1 --snapshot-dir {}", place.display());
    let server = Server::start(&format!("{SMALL} {flags}"));
    std::fs::remove_dir(&place).expect("remove");
    std::fs::write(&place, "no folder").expect("write");
    let mut client = server.acquire(0..1);
    for k in 0..300 {
        fly(&mut client, Paths::new(k).next(N_MOVES));
    }
    server.program.wait_for_words("not saved");
    let log = server.program.stderr();
    assert!(log.matches("not saved").count() < 30, "{log}");
}

#[test]
fn a_world_in_its_burn_in_begins_again_after_a_restart() {
    let folder = TempDir::new().expect("a folder");
    let flags = format!(
        "--snapshot-every 10 --snapshot-dir {}",
        folder.path().display()
    );
    let server = Server::start_with_endless_resets(&flags);
    let mut stepping = server.acquire(0..1);
    let wire = Wire::open(&server.instance);
    let lease = wire.acquire(1..2).lease;
    let reset = format!(r#"{{"op":"reset","lease":{lease},"worlds":[{{"world":1,"seed":77}}]}}"#);
    let pending = wire.send_control(control_header(1), reset.as_bytes());
    server.program.until(|| server.status().worlds[1].resetting);
    for k in 0..20 {
        fly(&mut stepping, Paths::new(k).next(N_MOVES));
    }
    let snapshots = || snapshots_in(folder.path());
    server.program.until(|| !snapshots().is_empty());
    server.kill();
    drop(pending);
    let copy = with_short_burn_in(&snapshots()[0]);
    let flags = format!("{SMALL} --worlds 2 --restore {}", copy.display());
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
    let worlds: Vec<_> = restored
        .iter()
        .map(|world| match world {
            SnapshotWorld::Ready(episode) => SnapshotWorld::Ready(&**episode),
            SnapshotWorld::New(new) => SnapshotWorld::New(*new),
        })
        .collect();
    let copy = file.with_extension("copy");
    let bytes = encode(&small_spec(20).settings, &worlds).expect("small");
    std::fs::write(&copy, bytes).expect("write");
    copy
}
