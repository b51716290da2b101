//! The iceoryx2 node of a process.

use super::cleanup::{remove_leftovers, unfinished_segment};
use super::directory::{SHARED_MEMORY, directory_error, node_config, prefix};
use super::error::{ChannelError, Ipc, ipc_error};
use super::turn::Turn;
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::prelude::SignalHandlingMode;
use std::fs::Permissions;
use std::os::unix::fs::{MetadataExt, PermissionsExt};

/// Makes this process known to iceoryx2, under the user's own directory and prefix, after removing what dead processes
/// left there.
///
/// # Errors
/// If the directory, or shared memory of this prefix, belongs to another user, or iceoryx2 cannot create the node.
pub fn create_node() -> Result<Node<Ipc>, ChannelError> {
    iceoryx2::prelude::set_log_level(iceoryx2::prelude::LogLevel::Fatal);
    let shared_memory = std::path::Path::new(SHARED_MEMORY);
    let config = node_config()?;
    let turn = Turn::take()?;
    remove_leftovers()?;
    if !turn.is_alone()
        && let Some(segment) = unfinished_segment()
    {
        // iceoryx2 might wait for it without end.
        let problem = "a stopped process is making it: continue or kill that process";
        return Err(directory_error(&segment, problem.into()));
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

/// Checks that shared memory of this prefix belongs to this user, and closes it to all others.
fn own_segments(folder: &std::path::Path, prefix: &str) -> Result<(), ChannelError> {
    let entries =
        std::fs::read_dir(folder).map_err(|error| directory_error(folder, error.to_string()))?;
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
}
