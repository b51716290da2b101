//! What ports take of the system: shared memory, files, descriptors. Who makes ports asks first, and if iceoryx2 fails
//! all the same, the error names what is missing.

use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::limits::memory::in_words;
use rustix::event::{EventfdFlags, eventfd};
use rustix::fs::statvfs;
use rustix::io::Errno;
use rustix::process::{Resource, getrlimit};
use std::fmt::Debug;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixDatagram;

/// Where iceoryx2 keeps shared memory: a folder that every user may write to.
pub const SHARED_MEMORY: &str = "/dev/shm";

/// What to do if it is full.
pub(super) const REMEDY: &str = "free some, or give the container more (docker: --shm-size)";

/// What the ports of a client or an observer take, beside its longest messages: 190 KiB (measured).
const PORT_BYTES: u64 = 512 << 10;

/// The files of these: 25 (measured).
const PORT_FILES: u64 = 48;

/// File descriptors of a connection to a server, or to an agent: 31, and one for a moment (measured).
pub(super) const CLIENT_DESCRIPTORS: usize = 33;

/// File descriptors of an observer: 9, and 3 for a moment (measured).
pub(super) const OBSERVER_DESCRIPTORS: usize = 12;

/// File descriptors that a server takes for one more client.
pub(super) const SERVER_DESCRIPTORS: usize = 10;

/// With fewer free descriptors, their lack is the likely reason why iceoryx2 fails.
const FEW_DESCRIPTORS: usize = 10;

/// Checks that there is room for the ports of a connection, and for a message of them.
///
/// # Errors
/// If not.
pub(super) fn check_room_for_ports(message_bytes: usize) -> Result<(), ChannelError> {
    let n_bytes = PORT_BYTES + message_bytes as u64;
    check_room(n_bytes, n_bytes)
}

/// Checks that so many bytes of shared memory are free, as many files as the ports of a connection are, and that a file
/// may be as long as the longest of them.
///
/// # Errors
/// If not.
pub fn check_room(n_bytes: u64, longest_file: u64) -> Result<(), ChannelError> {
    let limit = getrlimit(Resource::Fsize).current.unwrap_or(u64::MAX);
    if limit < longest_file {
        let (needed, limit) = (in_words(longest_file), in_words(limit));
        return no_room(format!(
            "expected a limit on file sizes of at least {needed}, got {limit}; raise it (`ulimit -f`)"
        ));
    }
    check_free(n_bytes)?;
    // A file system without a limit says 0 of 0.
    let found = statvfs(SHARED_MEMORY).ok();
    let found = found.filter(|found| found.f_files > 0 && found.f_favail < PORT_FILES);
    found.map_or(Ok(()), |found| {
        let free = found.f_favail;
        no_room(format!(
            "expected room for {PORT_FILES} files in {SHARED_MEMORY}, got {free}; remove some, or allow more (mount -o \
             nr_inodes)"
        ))
    })
}

/// Checks that so many bytes of shared memory are free.
///
/// # Errors
/// If not.
pub(super) fn check_free(n_bytes: u64) -> Result<(), ChannelError> {
    let Ok(found) = statvfs(SHARED_MEMORY) else {
        return Ok(());
    };
    let free = found.f_bavail.saturating_mul(found.f_frsize);
    if free >= n_bytes {
        return Ok(());
    }
    let (needed, free) = (in_words(n_bytes), in_words(free));
    no_room(format!(
        "expected {needed} free in {SHARED_MEMORY}, got {free}; {REMEDY}"
    ))
}

pub(super) fn no_room<T>(problem: String) -> Result<T, ChannelError> {
    Err(ChannelError::NoRoom { problem })
}

/// Adds context to an error of iceoryx2, whose cause is asked of the system where iceoryx2 does not tell it.
pub fn ipc_error<E: Debug>(what: &'static str) -> impl Fn(E) -> ChannelError {
    limited_error(what, "64 processes")
}

/// As [`ipc_error`], for what there may be so many of.
pub fn limited_error<E: Debug>(
    what: &'static str,
    most: &'static str,
) -> impl Fn(E) -> ChannelError {
    move |error| {
        let problem = format!("{error:?}");
        if problem.contains("ExceedsMaxSupported") || problem.contains("ExceedsMaxNumberOf") {
            return ChannelError::NoPlace { what, most };
        }
        let has_few = free_descriptors(FEW_DESCRIPTORS).is_err();
        has_few
            .then(|| no_descriptors(what, CLIENT_DESCRIPTORS))
            .or_else(|| check_room_for_ports(0).err())
            .or_else(|| check_sockets().err())
            .unwrap_or(ChannelError::Ipc { what, problem })
    }
}

/// Checks that the system gives sockets, which wake other processes.
fn check_sockets() -> Result<(), ChannelError> {
    let socket = UnixDatagram::unbound();
    let errno = socket.err().and_then(|error| Errno::from_io_error(&error));
    errno.map_or(Ok(()), |errno| Err(call_error("socket (AF_UNIX)", errno)))
}

/// Checks that so many descriptors are free, before any of them is used: what iceoryx2 began and could not finish may stay
/// open.
pub(super) fn check_descriptors(what: &'static str, needed: usize) -> Result<(), ChannelError> {
    free_descriptors(needed).map_err(|_| no_descriptors(what, needed))
}

/// The error of a system call that does not depend on a file.
pub fn call_error(call: &'static str, errno: Errno) -> ChannelError {
    match errno {
        Errno::MFILE | Errno::NFILE => no_descriptors(call, CLIENT_DESCRIPTORS),
        errno => ChannelError::RefusedCall {
            call,
            problem: errno.to_string(),
        },
    }
}

/// The error of a process that may open no more files.
pub(super) fn no_descriptors(what: &'static str, needed: usize) -> ChannelError {
    let limit = getrlimit(Resource::Nofile).current;
    ChannelError::NoDescriptors {
        what,
        needed,
        limit: limit.map_or("the system".into(), |n| n.to_string()),
    }
}

/// Opens so many descriptors and closes them again.
///
/// # Errors
/// The system's, if there are not as many.
pub(super) fn free_descriptors(n: usize) -> Result<(), Errno> {
    let opened = (0..n).map(|_| eventfd(0, EventfdFlags::CLOEXEC));
    match opened.collect::<Result<Vec<OwnedFd>, Errno>>() {
        Err(errno @ (Errno::MFILE | Errno::NFILE)) => Err(errno),
        // Where the call is refused, nothing is known.
        _ => Ok(()),
    }
}
