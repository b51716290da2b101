//! Tests that another user can do nothing to our instances except block their names, and that this is reported.
//!
//! A thread acts as the other user, which requires root. Without root, these tests print a note and pass.

use emberwatch_protocol::channels::{
    Channel, ChannelError, Instance, Ipc, SHARED_MEMORY, Services, channel_directory, create_node,
};
use emberwatch_protocol::observer::Observer;
use iceoryx2::node::NodeBuilder;
use iceoryx2::prelude::{Config, FileName, Path as IpcPath, SemanticString};
use rustix::process::{Gid, Uid, getuid};
use rustix::thread::{set_thread_groups, set_thread_res_gid, set_thread_res_uid};
use std::fs::{DirBuilder, File, OpenOptions, remove_dir, remove_file};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use tests::harness::{PATIENCE, SMALL, Server, eventually, frames_until};
use tests::meter::all_under;

/// User ids to which no user belongs.
const USERS: [u32; 3] = [64_001, 64_002, 64_003];

/// Runs `act` as another user who is in no other groups. Returns `None` if this process may not change its user.
fn as_user<T: Send>(user: u32, act: impl FnOnce() -> T + Send) -> Option<T> {
    let become_user = || {
        let (uid, gid) = (Uid::from_raw(user), Gid::from_raw(user));
        set_thread_groups(&[])?;
        set_thread_res_gid(gid, gid, gid)?;
        set_thread_res_uid(uid, uid, uid)
    };
    let done = std::thread::scope(|scope| {
        let thread = scope.spawn(|| become_user().ok().map(|()| act()));
        thread.join().expect("what the other user expects")
    });
    if done.is_none() {
        // Writes to standard error directly, because the test harness hides what passing tests print.
        let note = "skipped: this process may not act as another user; run the tests as root\n";
        let _ = std::io::stderr().write_all(note.as_bytes());
    }
    done
}

/// Returns all files of this user's channels: the files in its directory, and the files in shared memory.
fn places() -> (Vec<PathBuf>, Vec<PathBuf>) {
    let segments = segments_of(getuid().as_raw());
    (all_under(&channel_directory()), segments.collect())
}

/// Returns a user's files in shared memory.
fn segments_of(user: u32) -> impl Iterator<Item = PathBuf> {
    let prefix = format!("emberwatch-{user}_");
    let entries = std::fs::read_dir(SHARED_MEMORY).expect("shared memory");
    let segments = entries.flatten();
    let own = segments.filter(move |it| it.file_name().to_string_lossy().starts_with(&prefix));
    own.map(|entry| entry.path())
}

/// Returns the mode of a path. Returns `None` if another test has removed the file meanwhile.
fn mode(path: &Path) -> Option<u32> {
    std::fs::symlink_metadata(path)
        .ok()
        .map(|found| found.mode() & 0o777)
}

#[test]
fn everything_is_closed_to_others() {
    let server = Server::start(&format!("{SMALL} --publish-truth"));
    let observer = Observer::frames(&server.instance).expect("observe");
    let _client = server.acquire(0..1);
    frames_until(&observer, 0, 0);
    assert_eq!(mode(&channel_directory()), Some(0o700));
    let (files, segments) = places();
    assert!(
        files.len() > 10 && segments.len() > 10,
        "{files:?} {segments:?}"
    );
    for segment in segments {
        let mode = mode(&segment).unwrap_or(0);
        assert_eq!(mode & 0o077, 0, "{} has mode {mode:o}", segment.display());
    }
}

#[test]
fn another_user_cannot_connect_observe_read_or_remove() {
    let server = Server::start(SMALL);
    let _client = server.acquire(0..1);
    let (files, segments) = places();
    let ours = channel_directory();
    let prefix = format!("emberwatch-{}_", getuid().as_raw());
    clean_up(USERS[0]);
    as_user(USERS[0], || {
        let denied = |path: &Path, result: std::io::Result<()>| match result {
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => assert_eq!(error.kind(), ErrorKind::PermissionDenied, "{path:?}"),
            Ok(()) => panic!("another user got at {}", path.display()),
        };
        for path in files.iter().chain(&segments).filter(|path| **path != ours) {
            denied(path, File::open(path).map(drop));
            denied(path, OpenOptions::new().write(true).open(path).map(drop));
        }
        denied(&ours, std::fs::read_dir(&ours).map(drop));
        // Whether a user may remove a file depends on its folder. The folder of shared memory has the sticky bit set.
        let removed = remove_file(&segments[0]).expect_err("a segment that is ours");
        assert!(matches!(
            removed.kind(),
            ErrorKind::PermissionDenied | ErrorKind::NotFound
        ));
        let mut config = Config::default();
        let root = ours.as_os_str().as_encoded_bytes();
        let root = IpcPath::new(root).expect("a path");
        config.global.set_root_path(&root);
        config.global.prefix = FileName::new(prefix.as_bytes()).expect("a prefix");
        let node = NodeBuilder::new().config(&config).create::<Ipc>();
        assert!(node.is_err(), "another user's node among ours");
        let node = create_node().expect("its own place is free");
        let services = Services {
            node: &node,
            instance: &server.instance,
        };
        let is_none = matches!(services.open_step(), Err(ChannelError::NoServer { .. }));
        assert!(is_none, "our server from its own place");
    });
    clean_up(USERS[0]);
}

#[test]
fn who_takes_our_place_first_gets_in_the_way_and_is_told_of() {
    let [_, user, other] = USERS;
    let directory = PathBuf::from(format!("{SHARED_MEMORY}/emberwatch-{user}"));
    let segment = Path::new(SHARED_MEMORY).join(format!("emberwatch-{user}_squatter"));
    let refused = |place: &Path| {
        let refusal = create_node()
            .map(drop)
            .expect_err("not our own")
            .to_string();
        assert!(refusal.contains(&*place.to_string_lossy()), "{refusal}");
    };
    clean_up(user);
    as_user(other, || {
        DirBuilder::new()
            .mode(0o777)
            .create(&directory)
            .expect("the name is free")
    });
    as_user(user, || refused(&directory));
    as_user(other, || remove_dir(&directory).expect("its own"));
    as_user(other, || File::create(&segment).expect("the name is free"));
    as_user(user, || refused(&segment));
    as_user(other, || remove_file(&segment).expect("its own"));
    let made = as_user(user, || {
        drop(create_node().expect("nobody is in the way"));
        places().1
    });
    for segment in made.into_iter().flatten() {
        assert_eq!(mode(&segment), Some(0o600), "{}", segment.display());
    }
    clean_up(user);
}

/// iceoryx2 changes the umask while it binds a listener. If two threads do this at once, the umask could stay changed.
#[test]
fn threads_that_listen_leave_the_umask_as_it_was() {
    let umask = || {
        let status = std::fs::read_to_string("/proc/self/status").expect("proc");
        let line = status.lines().find(|line| line.starts_with("Umask:"));
        line.expect("a umask").to_owned()
    };
    let listen = || {
        let node = create_node().expect("a node");
        let services = Services {
            node: &node,
            instance: &Instance::new("umask").expect("a name"),
        };
        for _ in 0..200 {
            drop(services.listener(Channel::WakeClient).expect("a listener"));
        }
    };
    std::thread::scope(|scope| (0..4).for_each(|_| drop(scope.spawn(listen))));
    // Repeats the check, because the umask differs for a moment while another test binds a listener.
    let is_as_before = || !umask().ends_with("0177");
    assert!(eventually(PATIENCE, is_as_before), "{}", umask());
}

/// Removes the files of a nonexistent user.
fn clean_up(user: u32) {
    let _ = std::fs::remove_dir_all(format!("{SHARED_MEMORY}/emberwatch-{user}"));
    segments_of(user).for_each(|path| _ = remove_file(path));
}
