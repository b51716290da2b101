//! A process's place in iceoryx2: the node, its configuration, and the user's own directory.

use crate::channels::{ChannelError, Ipc, ipc_error};
use crate::cleanup::{remove_leftovers, unfinished_segment};
use crate::turn::Turn;
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::prelude::{Config, FileName, Path, SemanticString, SignalHandlingMode};
use iceoryx2::service::service_hash::ServiceHash;
use std::fs::{DirBuilder, Permissions};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::PathBuf;

/// Where iceoryx2 keeps shared memory: a folder that every user may write to.
pub const SHARED_MEMORY: &str = "/dev/shm";

/// Makes this process known to iceoryx2, under the user's own directory and prefix, after removing what dead processes
/// left there.
///
/// # Errors
/// [`ChannelError`] if the directory, or shared memory of this prefix, is somebody else's, or the node
/// cannot be created.
pub fn create_node() -> Result<Node<Ipc>, ChannelError> {
    iceoryx2::prelude::set_log_level(iceoryx2::prelude::LogLevel::Fatal);
    let shared_memory = std::path::Path::new(SHARED_MEMORY);
    let config = node_config()?;
    let turn = Turn::take()?;
    remove_leftovers()?;
    if !turn.is_alone()
        && let Some(segment) = unfinished_segment()
    {
        // iceoryx2 might wait for it for ever.
        let problem = "a stopped process is in the middle of making it: continue that, or kill it";
        return Err(wrong(&segment, problem.into()));
    }
    own_segments(shared_memory, &prefix())?;
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled);
    let node = node.create().map_err(ipc_error("create a node"))?;
    // Of the first node of all, iceoryx2 lets everybody write to the counter of nodes.
    own_segments(shared_memory, &prefix())?;
    Ok(node)
}

/// The directory of this user's channel files: `/dev/shm/emberwatch-<uid>/`.
///
/// Beside the shared memory, so that both are there or neither: no cleaner of old files comes here, and it is the
/// same for every process of the user, of a session or not.
pub fn channel_directory() -> PathBuf {
    PathBuf::from(format!(
        "{SHARED_MEMORY}/emberwatch-{}/",
        rustix::process::getuid().as_raw()
    ))
}

/// The files by which others find a node and services: without them it is cut off.
pub fn entries_of(node: &Node<Ipc>, services: &[&ServiceHash]) -> Vec<PathBuf> {
    let (directory, prefix) = (channel_directory(), prefix());
    let monitor = format!("nodes/{prefix}{}.node_monitor", node.id().value());
    let services = services
        .iter()
        .map(|hash| format!("services/{prefix}{hash}.service"));
    let names = services.chain([monitor]);
    names.map(|name| directory.join(name)).collect()
}

/// The same, made if need be, and checked.
pub(crate) fn own_channel_directory() -> Result<PathBuf, ChannelError> {
    let directory = channel_directory();
    own_directory(&directory)?;
    Ok(directory)
}

/// iceoryx2's configuration: its defaults, the user's own directory and prefix.
///
/// # Errors
/// [`ChannelError::Directory`] if the directory cannot be made or is somebody else's.
pub fn node_config() -> Result<Config, ChannelError> {
    let directory = own_channel_directory()?;
    let path = Path::new(directory.as_os_str().as_encoded_bytes())
        .map_err(ipc_error("set the root path"))?;
    let prefix = FileName::new(prefix().as_bytes()).map_err(ipc_error("set the prefix"))?;
    let mut config = Config::default();
    config.global.set_root_path(&path);
    config.global.prefix = prefix;
    // Not whenever it likes, but in turn.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    Ok(config)
}

/// What names of this user's shared memory begin with.
pub(crate) fn prefix() -> String {
    format!("emberwatch-{}_", rustix::process::getuid().as_raw())
}

/// The error of a file or folder that the system does not let be used.
pub(crate) fn not_usable(path: &std::path::Path, error: std::io::Error) -> ChannelError {
    wrong(
        path,
        match error.kind() {
            std::io::ErrorKind::ReadOnlyFilesystem => format!(
                "{error}: channels need a {SHARED_MEMORY} that can be written to; as root, \
                 `mount -o remount,rw {SHARED_MEMORY}`, or mount a tmpfs there"
            ),
            _ => error.to_string(),
        },
    )
}

fn wrong(path: &std::path::Path, problem: String) -> ChannelError {
    ChannelError::Directory {
        path: path.display().to_string(),
        problem,
    }
}

/// Checks that shared memory of this prefix is this user's, and closes it to all others.
fn own_segments(folder: &std::path::Path, prefix: &str) -> Result<(), ChannelError> {
    let entries = std::fs::read_dir(folder).map_err(|error| wrong(folder, error.to_string()))?;
    for entry in entries.flatten() {
        let name = entry.file_name();
        let found = match name.as_encoded_bytes().starts_with(prefix.as_bytes()) {
            true => entry.metadata(),
            false => continue,
        };
        // What is gone by now belonged to a process that ended.
        let Ok(found) = found else { continue };
        if !found.is_file() || found.uid() != rustix::process::getuid().as_raw() {
            let problem = "expected shared memory of this user, got something of user";
            return Err(wrong(&entry.path(), format!("{problem} {}", found.uid())));
        }
        if found.mode() & 0o077 != 0 {
            match std::fs::set_permissions(entry.path(), Permissions::from_mode(0o600)) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    return Err(wrong(&entry.path(), error.to_string()));
                }
                _ => {}
            }
        }
    }
    Ok(())
}

/// Makes the directory, for this user alone, or checks that it is this user's.
fn own_directory(path: &std::path::Path) -> Result<(), ChannelError> {
    let wrong = |problem: String| wrong(path, problem);
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() != std::io::ErrorKind::AlreadyExists => {
            return Err(not_usable(path, error));
        }
        _ => {}
    }
    let bare = path.components().as_path(); // without the trailing slash, so that a link is seen
    let found = std::fs::symlink_metadata(bare).map_err(|error| wrong(error.to_string()))?;
    let mine = found.is_dir() && found.uid() == rustix::process::getuid().as_raw();
    if !mine || found.mode() & 0o022 != 0 {
        return Err(wrong(
            "expected a directory that belongs to this user and that others cannot write to".into(),
        ));
    }
    // Whatever umask it was made under.
    match found.mode() & 0o777 {
        0o700 => Ok(()),
        _ => std::fs::set_permissions(path, Permissions::from_mode(0o700))
            .map_err(|error| wrong(error.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_memory_of_the_prefix_is_closed_to_others() {
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

    #[test]
    fn a_directory_that_others_may_write_to_is_refused() {
        let path = std::env::temp_dir().join(format!("emberwatch-test-{}", std::process::id()));
        own_directory(&path).expect("a new directory");
        own_directory(&path).expect("the same again");
        std::fs::set_permissions(&path, Permissions::from_mode(0o600)).expect("chmod");
        own_directory(&path).expect("what a umask took is given back");
        assert_eq!(path.metadata().expect("there").mode() & 0o777, 0o700);
        std::fs::set_permissions(&path, Permissions::from_mode(0o777)).expect("chmod");
        assert!(own_directory(&path).is_err());
        std::fs::remove_dir(&path).expect("clean up");
    }
}
