//! Clears away what processes leave that die at any moment, also while they begin or end.
//!
//! iceoryx2 0.10 clears away nodes that died in between. Three kinds stay for ever: a node without its details
//! is looked for where the global configuration says; a folder that is not empty but for its details is not
//! removed; and one whose monitor was never finished is not seen.

use crate::channels::{ChannelError, Ipc, ipc_error};
use crate::node::{channel_directory, create_node, node_config, prefix};
use iceoryx2::node::{Node, NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, Config, FilePath, SemanticString};
use std::fs::DirEntry;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A node is created in milliseconds: what has no monitor for so long died before it got one.
const BIRTH: Duration = Duration::from_secs(60);

/// How long whoever takes a dead process's place waits for another that is clearing it away, which takes
/// milliseconds: without that its ports are still taken.
pub const BURIAL: Duration = Duration::from_secs(5);

/// Clears away dead nodes of this user.
pub struct Undertaker {
    node: Node<Ipc>,
}

impl Undertaker {
    /// Makes iceoryx2's global configuration in this process the user's own. To be called before the process
    /// creates its first node.
    ///
    /// # Errors
    /// [`ChannelError`] if the file that says so cannot be written or is not read.
    pub fn prepare() -> Result<(), ChannelError> {
        node_config()?; // makes the directory
        let directory = channel_directory();
        let (root, prefix) = (directory.display(), prefix());
        let text = format!("[global]\nroot-path = \"{root}\"\nprefix = \"{prefix}\"\n");
        let path = directory.join(format!("prepare-{}.toml", std::process::id()));
        let wrong = |error: std::io::Error| ChannelError::Directory {
            path: path.display().to_string(),
            problem: error.to_string(),
        };
        std::fs::write(&path, text).map_err(wrong)?;
        let file = FilePath::new(path.as_os_str().as_encoded_bytes());
        let prepared = file.map_err(ipc_error("name a file")).and_then(|file| {
            let prepared = Config::setup_global_config_from_file(&file).map(|_| ());
            prepared.map_err(ipc_error("read the configuration"))
        });
        std::fs::remove_file(&path).map_err(wrong)?;
        prepared
    }

    /// One with a node of its own.
    ///
    /// # Errors
    /// As [`create_node`].
    pub fn new() -> Result<Self, ChannelError> {
        let node = create_node()?;
        Ok(Self { node })
    }

    /// Clears away what can be; returns of how many nodes.
    pub fn clear(&self) -> usize {
        let state = self.node.try_cleanup_dead_nodes();
        let others = match state.failed_cleanups {
            0 => 0,
            _ => self.clear_halves(),
        };
        state.cleanups as usize + others + clear_unborn(&nodes_directory(), &prefix(), BIRTH)
    }

    /// Dead nodes without details: nothing in their folders is of use to anybody.
    fn clear_halves(&self) -> usize {
        let mut n_cleared = 0;
        let clear = |state| {
            if let NodeState::Dead(node) = state
                && node.details().is_none()
            {
                empty(&nodes_directory().join(node.id().value().to_string()));
                n_cleared += usize::from(node.try_remove_stale_resources().is_ok());
            }
            CallbackProgression::Continue
        };
        if let Err(error) = Node::<Ipc>::list(self.node.config(), clear) {
            tracing::debug!("list the nodes: {error:?}");
        }
        n_cleared
    }
}

fn nodes_directory() -> PathBuf {
    channel_directory().join("nodes")
}

/// Nodes that are older than `birth` and whose monitor was never finished: that can be read only then.
fn clear_unborn(nodes: &Path, prefix: &str, birth: Duration) -> usize {
    let entries = std::fs::read_dir(nodes).into_iter().flatten().flatten();
    let monitors = |entry: &DirEntry| {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        ["", "_context", "_owner_lock"]
            .map(|end| nodes.join(format!("{prefix}{name}.node_monitor{end}")))
    };
    let is_unborn = |entry: &DirEntry| {
        let name = entry.file_name();
        let is_node = name.as_encoded_bytes().iter().all(u8::is_ascii_digit);
        let age = entry.metadata().and_then(|metadata| metadata.modified());
        let age = age.ok().and_then(|modified| modified.elapsed().ok());
        let monitor = monitors(entry)[0].metadata();
        let is_born = monitor.is_ok_and(|monitor| monitor.mode() & 0o400 != 0);
        is_node && age.is_some_and(|age| age > birth) && !is_born
    };
    let mut n_cleared = 0;
    for entry in entries.filter(is_unborn) {
        empty(&entry.path());
        for monitor in monitors(&entry) {
            let _ = std::fs::remove_file(monitor);
        }
        n_cleared += usize::from(std::fs::remove_dir(entry.path()).is_ok());
    }
    n_cleared
}

/// Removes the files of a folder.
fn empty(folder: &Path) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        // What has gone meanwhile was cleared away by another.
        let _ = std::fs::remove_file(entry.path());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn nodes_without_a_finished_monitor_are_cleared_away_when_they_are_old() {
        let nodes = std::env::temp_dir().join(format!("emberwatch-nodes-{}", std::process::id()));
        for id in ["12", "34", "56", "other"] {
            std::fs::create_dir_all(nodes.join(id)).expect("a folder");
            std::fs::write(nodes.join(id).join("p_node.details"), "").expect("a file");
        }
        for (name, mode) in [("p_34.node_monitor", 0o600), ("p_56.node_monitor", 0o200)] {
            std::fs::write(nodes.join(name), "").expect("a file");
            std::fs::set_permissions(nodes.join(name), Permissions::from_mode(mode))
                .expect("chmod");
        }
        assert_eq!(clear_unborn(&nodes, "p_", Duration::from_secs(60)), 0);
        std::thread::sleep(Duration::from_millis(20));
        assert_eq!(clear_unborn(&nodes, "p_", Duration::from_millis(1)), 2);
        let gone = ["12", "56", "p_56.node_monitor"];
        assert!(gone.iter().all(|name| !nodes.join(name).exists()));
        assert!(nodes.join("34").exists() && nodes.join("other").exists());
        std::fs::remove_dir_all(&nodes).expect("clean up");
    }
}
