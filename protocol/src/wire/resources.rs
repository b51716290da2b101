//! The system resources of ports: shared memory, files and file descriptors. They are checked before ports are created.
//! If iceoryx2 fails nevertheless, the error names the missing resource.

use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::limits::memory::in_words;
use rustix::event::{EventfdFlags, eventfd};
use rustix::fs::statvfs;
use rustix::io::Errno;
use rustix::process::{Resource, getrlimit};
use std::fmt::Debug;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixDatagram;

/// The folder of iceoryx2's shared memory, which every user may write to.
pub const SHARED_MEMORY: &str = "/dev/shm";

pub(super) const REMEDY: &str = "free some, or give the container more (docker: --shm-size)";

/// Shared memory in bytes that the ports of a client or an observer need, in addition to the memory for their longest
/// messages. Measured: 190 KiB.
const PORT_BYTES: u64 = 512 << 10;

/// Number of files that the ports of a client or an observer need. Measured: 25.
const PORT_FILES: u64 = 48;

/// Number of file descriptors of a connection to a server or an agent. Measured: 31, and briefly one more.
pub(super) const CLIENT_DESCRIPTORS: usize = 33;

/// Number of file descriptors of an observer. Measured: 9, and briefly 3 more.
pub(super) const OBSERVER_DESCRIPTORS: usize = 12;

/// Number of file descriptors that a server needs for one more client.
pub(super) const SERVER_DESCRIPTORS: usize = 10;

/// If fewer file descriptors than this are free, their shortage is the likely reason for an error of iceoryx2.
const FEW_DESCRIPTORS: usize = 10;

/// Checks that there is enough shared memory for the ports of a connection, and for a message on them.
pub(super) fn check_room_for_ports(message_bytes: usize) -> Result<(), ChannelError> {
    let n_bytes = PORT_BYTES + message_bytes as u64;
    check_room(n_bytes, n_bytes)
}

/// Checks that `n_bytes` bytes of shared memory and enough files for the ports of a connection are free, and that a
/// file may have `longest_file` bytes.
///
/// # Errors
/// If less is available.
pub fn check_room(n_bytes: u64, longest_file: u64) -> Result<(), ChannelError> {
    let limit = getrlimit(Resource::Fsize).current.unwrap_or(u64::MAX);
    if limit < longest_file {
        let (needed, limit) = (in_words(longest_file), in_words(limit));
        return no_room(format!(
            "expected a limit on file sizes of at least {needed}, got {limit}; raise it (`ulimit -f`)"
        ));
    }
    check_free(n_bytes)?;
    // A file system without a limit on the number of files reports 0 free files of 0.
    let found = statvfs(SHARED_MEMORY).ok();
    let found = found.filter(|found| found.f_files > 0 && found.f_favail < PORT_FILES);
    found.map_or(Ok(()), |found| {
        let free = found.f_favail;
        no_room(format!(
            "expected {PORT_FILES} free files in {SHARED_MEMORY}, got {free}; remove some, or allow more (mount -o \
             nr_inodes)"
        ))
    })
}

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

/// Adds context to an error of iceoryx2. If iceoryx2 does not report the cause, finds it in the system's limits.
pub fn ipc_error<E: Debug>(what: &'static str) -> impl Fn(E) -> ChannelError {
    limited_error(what, "64 processes")
}

/// Adds context as [`ipc_error`] does, for resources whose number is limited. `most` is the limit, such as `16
/// clients`.
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

/// Checks that the system allows sockets, which are needed to wake other processes.
fn check_sockets() -> Result<(), ChannelError> {
    let socket = UnixDatagram::unbound();
    let errno = socket.err().and_then(|error| Errno::from_io_error(&error));
    errno.map_or(Ok(()), |errno| Err(call_error("socket (AF_UNIX)", errno)))
}

/// Checks that `needed` descriptors are free before any is used, because an iceoryx2 operation that fails halfway may
/// leave descriptors open.
pub(super) fn check_descriptors(what: &'static str, needed: usize) -> Result<(), ChannelError> {
    free_descriptors(needed).map_err(|_| no_descriptors(what, needed))
}

pub fn call_error(call: &'static str, errno: Errno) -> ChannelError {
    match errno {
        Errno::MFILE | Errno::NFILE => no_descriptors(call, CLIENT_DESCRIPTORS),
        errno => ChannelError::RefusedCall {
            call,
            problem: errno.to_string(),
        },
    }
}

pub(super) fn no_descriptors(what: &'static str, needed: usize) -> ChannelError {
    let limit = getrlimit(Resource::Nofile).current;
    ChannelError::NoDescriptors {
        what,
        needed,
        limit: limit.map_or("the system".into(), |n| n.to_string()),
    }
}

/// Checks that `n` descriptors are free, by opening and closing them.
pub(super) fn free_descriptors(n: usize) -> Result<(), Errno> {
    let opened = (0..n).map(|_| eventfd(0, EventfdFlags::CLOEXEC));
    match opened.collect::<Result<Vec<OwnedFd>, Errno>>() {
        Err(errno @ (Errno::MFILE | Errno::NFILE)) => Err(errno),
        // If the system refuses the call, the number is unknown.
        _ => Ok(()),
    }
}
