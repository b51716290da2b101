//! A process's place in iceoryx2: the node, its configuration, and the user's own directory.

use crate::channels::{ChannelError, Ipc, ipc_error};
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::prelude::{Config, FileName, Path, SemanticString, SignalHandlingMode};
use std::fs::DirBuilder;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::PathBuf;

/// Makes this process known to iceoryx2, under the user's own directory and prefix.
///
/// # Errors
/// [`ChannelError`] if the directory is somebody else's or the node cannot be created.
pub fn create_node() -> Result<Node<Ipc>, ChannelError> {
    iceoryx2::prelude::set_log_level(iceoryx2::prelude::LogLevel::Fatal);
    let node = NodeBuilder::new()
        .config(&node_config()?)
        .signal_handling_mode(SignalHandlingMode::Disabled);
    node.create().map_err(ipc_error("create a node"))
}

/// The directory of this user's channel files: `/tmp/emberwatch-<uid>/`.
pub fn channel_directory() -> PathBuf {
    PathBuf::from(format!(
        "/tmp/emberwatch-{}/",
        rustix::process::getuid().as_raw()
    ))
}

/// iceoryx2's configuration: its defaults, the user's own directory and prefix.
///
/// # Errors
/// [`ChannelError::Directory`] if the directory cannot be made or is somebody else's.
pub fn node_config() -> Result<Config, ChannelError> {
    let directory = channel_directory();
    own_directory(&directory)?;
    let path = Path::new(directory.as_os_str().as_encoded_bytes())
        .map_err(ipc_error("set the root path"))?;
    let prefix = format!("emberwatch_{}_", rustix::process::getuid().as_raw());
    let prefix = FileName::new(prefix.as_bytes()).map_err(ipc_error("set the prefix"))?;
    let mut config = Config::default();
    config.global.set_root_path(&path);
    config.global.prefix = prefix;
    Ok(config)
}

/// Makes the directory, for this user alone, or checks that it is this user's.
fn own_directory(path: &std::path::Path) -> Result<(), ChannelError> {
    let wrong = |problem: String| ChannelError::Directory {
        path: path.display().to_string(),
        problem,
    };
    match DirBuilder::new().mode(0o700).create(path) {
        Ok(()) => return Ok(()),
        Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
        Err(error) => return Err(wrong(error.to_string())),
    }
    let bare = path.components().as_path(); // without the trailing slash, so that a link is seen
    let found = std::fs::symlink_metadata(bare).map_err(|error| wrong(error.to_string()))?;
    let mine = found.is_dir() && found.uid() == rustix::process::getuid().as_raw();
    if mine && found.mode() & 0o022 == 0 {
        return Ok(());
    }
    Err(wrong(
        "expected a directory that belongs to this user and that others cannot write to".into(),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_that_others_may_write_to_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let path = std::env::temp_dir().join(format!("emberwatch-test-{}", std::process::id()));
        own_directory(&path).expect("a new directory");
        own_directory(&path).expect("the same again");
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o777)).expect("chmod");
        assert!(own_directory(&path).is_err());
        std::fs::remove_dir(&path).expect("clean up");
    }
}
