//! The user's directory and prefix for channel files, and iceoryx2's configuration for them.

use super::ipc::Ipc;
use super::resources::{CLIENT_DESCRIPTORS, REMEDY, ipc_error, no_descriptors};
use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::instance::Instance;
use iceoryx2::node::Node;
use iceoryx2::prelude::{Config, FileName, Path, SemanticString};
use rustix::io::Errno;
use std::cell::Cell;
use std::collections::BTreeSet;
use std::fs::{DirBuilder, Permissions};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::PathBuf;
use std::time::{Duration, Instant};

pub use super::resources::SHARED_MEMORY;

const CHECK_INTERVAL: Duration = Duration::from_millis(200);

/// Returns the directory of this user's channel files: `/dev/shm/emberwatch-<uid>/`.
///
/// It is next to the shared memory, so that either both exist or neither does. It is the same for every process of the
/// user, in any session.
pub fn channel_directory() -> PathBuf {
    PathBuf::from(format!(
        "{SHARED_MEMORY}/emberwatch-{}/",
        rustix::process::getuid().as_raw()
    ))
}

/// The files by which other processes find a node, its services and its ports. If any of these files is missing, the
/// node cannot be found.
#[derive(Debug)]
pub struct Entries {
    paths: Vec<PathBuf>,
    checked: Cell<Instant>,
}

impl Entries {
    /// Lists the files of a node. Call it after the node's ports have been created.
    ///
    /// # Errors
    /// If the files cannot be listed.
    pub fn of(node: &Node<Ipc>) -> Result<Self, ChannelError> {
        let (directory, id) = (channel_directory(), node.id().value());
        let folder = directory.join(format!("nodes/{id}"));
        let monitor = directory.join(format!("nodes/{}{id}.node_monitor", prefix()));
        let mut paths = vec![monitor];
        let wrong = |error: std::io::Error| not_usable(&folder, error);
        for entry in std::fs::read_dir(&folder).map_err(wrong)? {
            let path = entry.map_err(wrong)?.path();
            if path.extension() == Some("service_tag".as_ref()) {
                let service = path.with_extension("service");
                let name = service.file_name().unwrap_or_default();
                paths.push(directory.join("services").join(name));
            }
            paths.push(path);
        }
        Ok(Self {
            paths,
            checked: Cell::new(Instant::now()),
        })
    }

    /// Checks as [`Self::check`] does, but does nothing if the last check was shortly before `now`.
    ///
    /// # Errors
    /// If a file was removed.
    pub fn check_at(&self, now: Instant) -> Result<(), ChannelError> {
        if now.saturating_duration_since(self.checked.get()) < CHECK_INTERVAL {
            return Ok(());
        }
        self.check()?;
        self.checked.set(now);
        Ok(())
    }

    /// Checks that all files still exist.
    ///
    /// # Errors
    /// If a file was removed.
    pub fn check(&self) -> Result<(), ChannelError> {
        let removed = self
            .paths
            .iter()
            .find(|path| matches!(path.try_exists(), Ok(false)));
        removed.map_or(Ok(()), |path| {
            let problem = format!(
                "it was removed while it was in use: keep cleaners of old files away from {SHARED_MEMORY}"
            );
            Err(directory_error(path, problem))
        })
    }
}

pub(crate) fn own_channel_directory() -> Result<PathBuf, ChannelError> {
    let directory = channel_directory();
    own_directory(&directory)?;
    Ok(directory)
}

/// Returns iceoryx2's configuration: its defaults, with the user's directory and prefix.
///
/// # Errors
/// If the directory cannot be created, or belongs to another user.
pub fn node_config() -> Result<Config, ChannelError> {
    let directory = own_channel_directory()?;
    let path = Path::new(directory.as_os_str().as_encoded_bytes())
        .map_err(ipc_error("set the root path"))?;
    let prefix = FileName::new(prefix().as_bytes()).map_err(ipc_error("set the prefix"))?;
    let mut config = Config::default();
    config.global.set_root_path(&path);
    config.global.prefix = prefix;
    // Cleaning up needs the lock of `turn.rs`, which iceoryx2 does not take.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    Ok(config)
}

pub(crate) fn prefix() -> String {
    format!("emberwatch-{}_", rustix::process::getuid().as_raw())
}

/// Returns the error for an instance without a server. If other users have channels here, a hint names them, as their
/// servers cannot be reached.
pub(super) fn no_server(instance: &Instance) -> ChannelError {
    ChannelError::NoServer {
        instance: instance.name().into(),
        others: others(SHARED_MEMORY.as_ref(), rustix::process::getuid().as_raw()),
    }
}

fn others(folder: &std::path::Path, own: u32) -> Option<String> {
    let of = |name: &str| -> Option<u32> {
        // Other files stay after a user's last program.
        let name = name.strip_prefix("emberwatch-")?.strip_suffix(".dynamic")?;
        let (user, _) = name.split_once('_')?;
        user.parse().ok()
    };
    let entries = std::fs::read_dir(folder).ok()?;
    let names = entries.flatten().map(|entry| entry.file_name());
    let users = names.filter_map(|name| of(name.to_str()?));
    let users: BTreeSet<u32> = users.filter(|&user| user != own).collect();
    let users: Vec<String> = users.iter().map(u32::to_string).collect();
    let sentence = || {
        let users = users.join(", ");
        format!(
            "other users (id {users}) have channels here, but this program reaches only servers of user {own}: run both as one user"
        )
    };
    (!users.is_empty()).then(sentence)
}

pub(crate) fn not_usable(path: &std::path::Path, error: std::io::Error) -> ChannelError {
    if error.raw_os_error() == Some(Errno::MFILE.raw_os_error()) {
        return no_descriptors("use the channel directory", CLIENT_DESCRIPTORS);
    }
    directory_error(
        path,
        match error.kind() {
            std::io::ErrorKind::ReadOnlyFilesystem => format!(
                "{error}: channels need a writable {SHARED_MEMORY}; as root, \
                 `mount -o remount,rw {SHARED_MEMORY}`, or mount a tmpfs there"
            ),
            std::io::ErrorKind::StorageFull => {
                format!("{error}: {REMEDY}")
            }
            _ => error.to_string(),
        },
    )
}

pub(crate) fn directory_error(path: &std::path::Path, problem: String) -> ChannelError {
    ChannelError::Directory {
        path: path.display().to_string(),
        problem,
    }
}

/// Creates the directory for this user only, or checks that it belongs to this user.
fn own_directory(path: &std::path::Path) -> Result<(), ChannelError> {
    let wrong = |problem: String| directory_error(path, problem);
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() != std::io::ErrorKind::AlreadyExists => {
            return Err(not_usable(path, error));
        }
        _ => {}
    }
    let bare = path.components().as_path(); // Without the trailing slash, so that a link is detected.
    let found = std::fs::symlink_metadata(bare).map_err(|error| not_usable(path, error))?;
    let mine = found.is_dir() && found.uid() == rustix::process::getuid().as_raw();
    if !mine || found.mode() & 0o022 != 0 {
        return Err(wrong(
            "expected a directory that belongs to this user and that others cannot write to".into(),
        ));
    }
    // The directory's mode depends on the umask of its creator.
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
    fn other_users_with_channels_are_named() {
        let folder = std::env::temp_dir().join(format!("emberwatch-users-{}", std::process::id()));
        std::fs::create_dir(&folder).expect("a new directory");
        let add = |name: &str| std::fs::write(folder.join(name), "").expect("a file");
        // A user's directory stays after the last program; other files are of other programs.
        for name in [
            "emberwatch-7",
            "emberwatch-9_node.0_10_0.global_mgmt",
            "emberwatch-3_1.dynamic",
            "emberwatch-x_1",
            "other-5_1",
        ] {
            add(name);
        }
        assert_eq!(others(&folder, 3), None);
        for name in [
            "emberwatch-1000_2.dynamic",
            "emberwatch-5_7.dynamic",
            "emberwatch-5_8.dynamic",
        ] {
            add(name);
        }
        let hint = others(&folder, 3).expect("two users");
        assert!(
            hint.contains("(id 5, 1000)") && hint.contains("servers of user 3: run"),
            "{hint}"
        );
        assert_eq!(others(&folder.join("none"), 3), None);
        std::fs::remove_dir_all(&folder).expect("clean up");
    }

    #[test]
    fn a_directory_writable_by_others_is_refused() {
        let path = std::env::temp_dir().join(format!("emberwatch-test-{}", std::process::id()));
        own_directory(&path).expect("a new directory");
        own_directory(&path).expect("the same again");
        std::fs::set_permissions(&path, Permissions::from_mode(0o600)).expect("chmod");
        own_directory(&path).expect("permissions removed by a umask are restored");
        assert_eq!(path.metadata().expect("there").mode() & 0o777, 0o700);
        std::fs::set_permissions(&path, Permissions::from_mode(0o777)).expect("chmod");
        assert!(own_directory(&path).is_err());
        let link = path.join("link");
        std::os::unix::fs::symlink(&path, &link).expect("a link");
        assert!(own_directory(&link).is_err(), "a link to somewhere");
        std::fs::write(path.join("file"), "").expect("a file");
        assert!(own_directory(&path.join("file")).is_err(), "a file");
        std::fs::remove_dir_all(&path).expect("clean up");
    }
}
