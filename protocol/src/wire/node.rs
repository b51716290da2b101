//! The iceoryx2 node of a process.

use super::channel_files::ChannelFiles;
use super::cleanup::make_way;
use super::directory::{Entries, SHARED_MEMORY, directory_error, node_config, not_usable, prefix};
use super::ipc::Ipc;
use super::own_nodes;
use super::resources::{check_room_for_ports, ipc_error};
use super::turn::Turn;
use emberwatch_messages::errors::ChannelError;
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::prelude::SignalHandlingMode;
use std::fs::Permissions;
use std::ops::{Deref, DerefMut};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::time::Instant;

/// Creates an iceoryx2 node for this process, in the user's directory and with the user's prefix. Removes the files of
/// dead processes there first.
///
/// # Errors
/// If the directory, or shared memory with this prefix, belongs to another user, or iceoryx2 cannot create the node.
pub fn create_node() -> Result<Node<Ipc>, ChannelError> {
    iceoryx2::prelude::set_log_level(iceoryx2::prelude::LogLevel::Fatal);
    let shared_memory = std::path::Path::new(SHARED_MEMORY);
    let config = node_config()?;
    check_room_for_ports(0)?;
    let _turn = Turn::take()?;
    check_only_copy(&ChannelFiles::of_user())?;
    make_way()?;
    own_segments(shared_memory, &prefix())?;
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled);
    let node = node.create().map_err(ipc_error("create a node"))?;
    own_nodes::add(node.id().value());
    // iceoryx2 creates its node counter together with the first node, and makes the counter writable for everybody.
    own_segments(shared_memory, &prefix())?;
    Ok(node)
}

/// Ports and their node, which are closed while this process holds the lock of `turn.rs`.
#[derive(Debug)]
pub(crate) struct Opened<T> {
    ports: Option<T>,
    entries: Entries,
}

impl<T> Opened<T> {
    pub(crate) fn new(entries: Entries, ports: T) -> Self {
        Self {
            ports: Some(ports),
            entries,
        }
    }

    pub(crate) fn check(&self) -> Result<(), ChannelError> {
        self.entries.check_at(Instant::now())
    }
}

impl<T> Deref for Opened<T> {
    type Target = T;

    fn deref(&self) -> &T {
        self.ports.as_ref().expect("invariant: taken on drop only")
    }
}

impl<T> DerefMut for Opened<T> {
    fn deref_mut(&mut self) -> &mut T {
        self.ports.as_mut().expect("invariant: taken on drop only")
    }
}

impl<T> Drop for Opened<T> {
    fn drop(&mut self) {
        let _turn = Turn::take_to_end();
        let ports = self.ports.take();
        if self.entries.check().is_err() {
            // Closing the ports would remove their files, but other programs may have created files with the same names
            // meanwhile.
            std::mem::forget(ports);
        }
    }
}

/// Checks that no other copy of this library has a node in this process. The cleanup of this copy would release the
/// lock of that node, and take it for dead.
fn check_only_copy(files: &ChannelFiles) -> Result<(), ChannelError> {
    let unread = |error| not_usable(&files.root, error);
    if files.has_another_copy().map_err(unread)? {
        return Err(ChannelError::AnotherCopy);
    }
    Ok(())
}

/// Checks that shared memory with this prefix belongs to this user, and revokes the access of all other users.
fn own_segments(folder: &std::path::Path, prefix: &str) -> Result<(), ChannelError> {
    let entries = std::fs::read_dir(folder).map_err(|error| not_usable(folder, error))?;
    for entry in entries.flatten() {
        let name = entry.file_name();
        if !name.as_encoded_bytes().starts_with(prefix.as_bytes()) {
            continue;
        }
        // A file that is gone belonged to a process that has ended.
        let Ok(found) = entry.metadata() else {
            continue;
        };
        if !found.is_file() || found.uid() != rustix::process::getuid().as_raw() {
            let problem = "expected shared memory of this user, got a file of user";
            return Err(directory_error(
                &entry.path(),
                format!("{problem} {}", found.uid()),
            ));
        }
        if found.mode() & 0o077 != 0 {
            match std::fs::set_permissions(entry.path(), Permissions::from_mode(0o600)) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    return Err(directory_error(&entry.path(), error.to_string()));
                }
                _ => {}
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::{FlockOperation, fcntl_lock};
    use std::fs::File;

    #[test]
    fn a_node_of_another_copy_is_refused_until_it_is_closed() {
        let root = std::env::temp_dir().join(format!("emberwatch-copies-{}", std::process::id()));
        let nodes = root.join("nodes");
        std::fs::create_dir_all(&nodes).expect("a new directory");
        let files = ChannelFiles {
            shared: root.clone(),
            root,
            prefix: "emberwatch_1_".into(),
        };
        let lock = |pid: u32| {
            let monitor = format!("emberwatch_1_{}.node_monitor", (u128::from(pid) << 64) + 77);
            let file = File::create(nodes.join(monitor)).expect("a file");
            fcntl_lock(&file, FlockOperation::LockExclusive).expect("a free file");
            file
        };
        let elsewhere = lock(std::process::id() + 1);
        check_only_copy(&files).expect("a node whose id has another process");
        let another = lock(std::process::id());
        let refusal = check_only_copy(&files).expect_err("a copy has a node");
        assert!(matches!(refusal, ChannelError::AnotherCopy), "{refusal}");
        drop(another);
        check_only_copy(&files).expect("the node of a process that ended has no lock");
        drop(elsewhere);
        std::fs::remove_dir_all(&files.root).expect("clean up");
    }

    #[test]
    fn shared_memory_with_the_prefix_is_closed_to_other_users() {
        let folder = std::env::temp_dir().join(format!("emberwatch-shm-{}", std::process::id()));
        std::fs::create_dir(&folder).expect("a new directory");
        let make = |name: &str| {
            std::fs::write(folder.join(name), "").expect("a file");
            let open = Permissions::from_mode(0o666);
            std::fs::set_permissions(folder.join(name), open).expect("chmod");
        };
        let mode = |name: &str| folder.join(name).metadata().expect("there").mode() & 0o777;
        make("emberwatch_1_a");
        make("emberwatch_10_a");
        own_segments(&folder, "emberwatch_1_").expect("all are this user's");
        assert_eq!(
            (mode("emberwatch_1_a"), mode("emberwatch_10_a")),
            (0o600, 0o666)
        );
        std::fs::create_dir(folder.join("emberwatch_1_b")).expect("no segment");
        assert!(own_segments(&folder, "emberwatch_1_").is_err());
        std::fs::remove_dir_all(&folder).expect("clean up");
    }
}
