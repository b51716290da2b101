//! Allocates memory for ports. Files in shared memory are sparse, and a write to a page for which there is no memory
//! ends the process with SIGBUS. So programs allocate the pages that they may write to before they write.

use super::channel_files::ChannelFiles;
use super::directory::{directory_error, not_usable};
use super::ipc::Ipc;
use super::resources::{REMEDY, SHARED_MEMORY, call_error, check_free, no_room};
use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::limits::memory::in_words;
use iceoryx2::node::Node;
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;
use std::cell::Cell;
use std::collections::HashSet;
use std::fs::File;
use std::path::{Path, PathBuf};

/// The memory of one port's messages. The messages are stored consecutively at its end, and a new message takes the
/// first free place. So memory for the first `n` messages is enough while at most `n` messages are in use.
#[derive(Debug)]
pub struct MessageMemory {
    path: PathBuf,
    file: File,
    n_bytes: u64,
    message_bytes: u64,
    n_messages: u64,
    n_ready: Cell<u64>,
}

/// Allocates memory for everything that a node's ports and services write to. The memory of messages is included only
/// if `with_messages` is set. Programs with large messages allocate it with [`MessageMemory`] instead.
///
/// # Errors
/// If there is not enough memory.
pub fn fill_ports(node: &Node<Ipc>, with_messages: bool) -> Result<(), ChannelError> {
    let files = ChannelFiles::of_user();
    let wrong = |error: std::io::Error| not_usable(&files.root, error);
    let used = files
        .used(&HashSet::from([node.id().value()]))
        .map_err(wrong)?;
    let services = files.service_ids(&used).map_err(wrong)?;
    for path in files.segments().map_err(wrong)? {
        let ids = files.ids(&path);
        let is_ours = ids
            .iter()
            .any(|id| used.ids.contains(id) || services.contains(id));
        let is_message_memory = path.extension().is_some_and(|kind| kind == "data");
        if is_ours && (with_messages || !is_message_memory) {
            fill_whole(&path)?;
        }
    }
    Ok(())
}

impl MessageMemory {
    /// Finds the memory of a port, which must have space for at least `n_messages` messages of at least `message_bytes`
    /// bytes.
    ///
    /// # Errors
    /// If the port has no such file.
    pub fn of(port: u128, n_messages: usize, message_bytes: usize) -> Result<Self, ChannelError> {
        let files = ChannelFiles::of_user();
        let wrong = |error: std::io::Error| not_usable(SHARED_MEMORY.as_ref(), error);
        // If the memory of a port can grow, iceoryx2 numbers its files.
        let ends = [format!("_{port}.data"), format!("_{port}__0.data")];
        let is_of_port = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            ends.iter().any(|end| name.ends_with(end))
        };
        let path = files
            .segments()
            .map_err(wrong)?
            .into_iter()
            .find(is_of_port);
        let path =
            path.ok_or_else(|| wrong(std::io::Error::other(format!("no memory of port {port}"))))?;
        let file = open(&path)?;
        let found = file.metadata().map_err(|error| not_usable(&path, error))?;
        Ok(Self {
            n_bytes: found.len(),
            path,
            file,
            message_bytes: message_bytes as u64,
            n_messages: n_messages as u64,
            n_ready: Cell::new(0),
        })
    }

    /// Allocates memory for the first `n_messages` messages.
    ///
    /// # Errors
    /// If there is not enough memory for them.
    pub fn make_ready(&self, n_messages: usize) -> Result<(), ChannelError> {
        let n_messages = (n_messages as u64).min(self.n_messages);
        let n_ready = self.n_ready.get();
        if n_messages <= n_ready {
            return Ok(());
        }
        let unused = (self.n_messages - n_messages) * self.message_bytes;
        if n_ready > 0 {
            check_free((n_messages - n_ready) * self.message_bytes)?;
        }
        fill(&self.path, &self.file, self.n_bytes.saturating_sub(unused))?;
        self.n_ready.set(n_messages);
        Ok(())
    }
}

fn fill_whole(path: &Path) -> Result<(), ChannelError> {
    let file = open(path)?;
    let found = file.metadata().map_err(|error| not_usable(path, error))?;
    fill(path, &file, found.len())
}

fn open(path: &Path) -> Result<File, ChannelError> {
    let opened = File::options().write(true).open(path);
    opened.map_err(|error| not_usable(path, error))
}

/// Allocates memory for the first bytes of a file, and keeps their content.
fn fill(path: &Path, file: &File, n_bytes: u64) -> Result<(), ChannelError> {
    loop {
        match fallocate(file, FallocateFlags::empty(), 0, n_bytes.max(1)) {
            Ok(()) | Err(Errno::OPNOTSUPP) => return Ok(()),
            Err(Errno::INTR) => {}
            Err(errno @ (Errno::NOSPC | Errno::NOMEM | Errno::DQUOT)) => {
                let needed = in_words(n_bytes);
                return no_room(format!(
                    "expected {needed} in {SHARED_MEMORY}, got: {errno}; {REMEDY}"
                ));
            }
            Err(errno @ (Errno::PERM | Errno::ACCESS | Errno::NOSYS)) => {
                return Err(call_error("fallocate", errno));
            }
            Err(errno) => return Err(directory_error(path, errno.to_string())),
        }
    }
}
