//! Removes the files of dead processes. A process may have died at any instruction, even while it started or ended.
//!
//! While a process holds the lock (during a [`Turn`]), no other process creates or removes anything. So every file
//! belongs to a node whose process lives, belongs to a service that such a node uses, or is left over. iceoryx2 itself
//! removes dead nodes from services that are still in use. But it cannot remove unfinished files, and it waits forever
//! for an empty segment to grow.
//!
//! Names of files:
//!
//! - For each port and service of a node, a finished `.port_tag` or `.service_tag` is in the node's folder
//!   `nodes/<id>/` before the port or service exists.
//! - Segments are `<prefix><hash>_<id>[_<id>].<kind>`, sockets `<prefix><id>.event`. A hash contains letters or at
//!   least 40 digits; an id has at most 39 decimal digits. The low three 32-bit words of an id are the time of its
//!   creation (seconds and nanoseconds of `CLOCK_MONOTONIC`) and the process that created it.
//! - A finished tag cannot be written to. A finished segment can be read and is not empty. An exception is the `.data`
//!   of a living port, which grows without the lock.
//!
//! The cleanup lists files before nodes and tags. It keeps files that appeared later, and files whose id a living
//! process created less than a second ago. First it removes unfinished segments, except `.data` of living processes and
//! of living nodes' ports. Then it removes the unfinished tags of dead nodes, and lets iceoryx2 remove those dead nodes
//! that have their details and share a service with a living node. Finally it removes the folders and `.node_monitor*`
//! files of all other dead nodes, `services/*.service` files for which no living node has a tag, and segments and
//! sockets whose ids belong to no living port and no remaining service (`unique_service_id` in its file). A node in an
//! undefined state counts as alive while the process in its id is alive. A file that cannot be listed or read may
//! belong to a living process, so an error ends the cleanup.

use super::channel_files::{
    ChannelFiles, Used, any, entries, is_in_the_making, is_writable, metadata, nodes,
};
use super::directory::{
    SHARED_MEMORY, channel_directory, directory_error, node_config, not_usable,
};
use super::turn::Turn;
use emberwatch_messages::errors::ChannelError;
use emberwatch_messages::interrupt::check_interrupt;
use iceoryx2::node::NodeView;
use iceoryx2::prelude::Config;
use std::collections::HashSet;
use std::io::Error;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Maximum wait until a segment is finished or removed.
const UNFINISHED: Duration = Duration::from_millis(1500);

const INTERVAL: Duration = Duration::from_millis(10);

/// Removes the files of dead processes, and returns the number of removed files and folders.
///
/// # Errors
/// If another process keeps the turn for too long, or a file cannot be read. The process of such a file may be alive,
/// so the remaining files are kept.
pub fn remove_leftovers() -> Result<usize, ChannelError> {
    let turn = Turn::take_to_end()?;
    if !turn.is_alone() {
        return Ok(0);
    }
    let removed = ChannelFiles::of_user().remove_leftovers(&node_config()?);
    removed.map_err(|error| not_usable(&channel_directory(), error))
}

/// Removes the files of dead processes, and waits until processes that do not take the lock have finished the segments
/// that they are creating. Otherwise iceoryx2 could wait forever for an unfinished segment.
pub(crate) fn make_way() -> Result<(), ChannelError> {
    await_finished(&ChannelFiles::of_user(), || {
        if let Err(error) = remove_leftovers() {
            tracing::debug!("files of dead processes were not removed: {error}");
        }
    })
}

/// Waits until no segment is unfinished. `remove` removes the segments of dead processes.
fn await_finished(files: &ChannelFiles, remove: impl Fn()) -> Result<(), ChannelError> {
    let start = Instant::now();
    loop {
        remove();
        let unfinished = files.unfinished_segment();
        let wrong = |error: Error| not_usable(SHARED_MEMORY.as_ref(), error);
        let Some(segment) = unfinished.map_err(wrong)? else {
            return Ok(());
        };
        if start.elapsed() > UNFINISHED {
            let problem = "a process is creating it, perhaps one that is stopped: continue or kill that process";
            return Err(directory_error(&segment, problem.into()));
        }
        std::thread::sleep(INTERVAL);
        check_interrupt()?;
    }
}

impl ChannelFiles {
    /// Removes the files of dead processes. Stops at the first error, because an unreadable file may belong to a living
    /// process.
    fn remove_leftovers(&self, config: &Config) -> Result<usize, Error> {
        // Files are listed before nodes and tags, so that the list does not include files that a client creates
        // meanwhile without taking the lock.
        let list = |folder: &str| entries(&self.root.join(folder));
        let (node_files, services) = (list("nodes")?, list("services")?);
        let mut ports = self.segments()?;
        ports.extend(self.of_prefix(&self.root)?);
        let (mut living, dead) = nodes(config)?;
        let mut used = self.used(&living)?;
        let mut n_removed = self.remove_unfinished(&used)?;
        for node in dead {
            let id = node.id().value();
            // iceoryx2 cannot remove a folder with unfinished tags. No service uses these tags yet.
            n_removed += remove_if(entries(&self.folder(id))?, is_writable)?;
            let has_details = node.details().is_some();
            let details = self.folder(id).join(format!("{}node.details", self.prefix));
            // A node's details are removed last, so a node whose details are gone uses no service any more.
            let is_shared =
                has_details && !used.hashes.is_disjoint(&self.tags(id, ".service_tag")?);
            let is_unread = !has_details && metadata(&details)?.is_some();
            if is_unread || is_shared && node.try_remove_stale_resources().is_err() {
                tracing::debug!(id, "a dead node could not be removed");
                living.insert(id);
            }
        }
        n_removed += self.remove_nodes(node_files, &living)?;
        used = self.used(&living)?;
        n_removed += self.remove_services(services, &used)?;
        Ok(n_removed + self.remove_ports(ports, &used)?)
    }

    /// Removes unfinished segments of dead processes, because opening one may block forever.
    fn remove_unfinished(&self, used: &Used) -> Result<usize, Error> {
        remove_if(self.segments()?, |path| {
            let ids = self.ids(path);
            // Keeps segments of living ports: a port in another PID namespace may be creating the segment, and its
            // process cannot be checked.
            let is_of_living = !ids.is_empty() && ids.iter().all(|id| used.ids.contains(id));
            Ok(self.is_unfinished(path)? && !is_of_living && !any(&ids, is_in_the_making)?)
        })
    }

    fn remove_nodes(&self, files: Vec<PathBuf>, living: &HashSet<u128>) -> Result<usize, Error> {
        remove_if(files, |path| match self.node(path) {
            Some(id) => Ok(!living.contains(&id) && !is_in_the_making(id)?),
            None => Ok(false),
        })
    }

    fn remove_services(&self, files: Vec<PathBuf>, used: &Used) -> Result<usize, Error> {
        let is_left = |hash| !used.hashes.contains(&hash);
        remove_if(files, |path| Ok(self.hash(path).is_some_and(is_left)))
    }

    /// Removes segments and sockets that belong to no living port and to no service.
    fn remove_ports(&self, files: Vec<PathBuf>, used: &Used) -> Result<usize, Error> {
        let services = self.service_ids(used)?;
        remove_if(files, |path| {
            let ids = self.ids(path);
            let is_used = |id: &u128| used.ids.contains(id) || services.contains(id);
            Ok(!ids.is_empty() && !ids.iter().any(is_used) && !any(&ids, is_in_the_making)?)
        })
    }
}

fn remove_if(
    paths: Vec<PathBuf>,
    is_left: impl Fn(&Path) -> Result<bool, Error>,
) -> Result<usize, Error> {
    let mut n_removed = 0;
    for path in paths {
        if is_left(&path)? {
            let removed = if path.is_dir() {
                std::fs::remove_dir_all(&path)
            } else {
                std::fs::remove_file(&path)
            };
            n_removed += usize::from(removed.is_ok());
        }
    }
    Ok(n_removed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::channel_files::since_boot;
    use crate::wire::ipc::Ipc;
    use iceoryx2::node::NodeBuilder;
    use iceoryx2::prelude::{FileName, Path as IpcPath, SemanticString};
    use std::collections::BTreeSet;
    use std::fs::{Permissions, create_dir, remove_dir_all, set_permissions};
    use std::os::unix::fs::PermissionsExt;

    /// An impossible process id: ids are below 2^22.
    const NOBODY: u32 = 1 << 30;

    fn id(pid: u32, age: Duration) -> u128 {
        let began = since_boot().saturating_sub(age);
        u128::from(pid) << 64 | u128::from(began.subsec_nanos()) << 32 | began.as_secs() as u128
    }

    fn make(path: PathBuf, mode: u32) {
        std::fs::write(&path, "").expect("a file");
        set_permissions(&path, Permissions::from_mode(mode)).expect("chmod");
    }

    fn below(folder: &Path) -> Vec<PathBuf> {
        let mut all = entries(folder).expect("a folder");
        for path in all.clone().iter().filter(|path| path.is_dir()) {
            all.extend(below(path));
        }
        all
    }

    fn all(files: &ChannelFiles) -> BTreeSet<PathBuf> {
        let mut all = below(&files.root);
        all.extend(files.segments().expect("a folder"));
        all.into_iter().collect()
    }

    fn files_of_test(name: &str, shared: PathBuf) -> ChannelFiles {
        let name = format!("emberwatch-{name}-{}", std::process::id());
        ChannelFiles {
            root: std::env::temp_dir().join(&name),
            shared,
            prefix: format!("{name}_"),
        }
    }

    #[test]
    fn the_wait_for_an_unfinished_segment_is_limited() {
        // The temporary folder is used so that leftovers do no harm if this process is killed.
        let files = files_of_test("unfinished", std::env::temp_dir());
        let young = id(std::process::id(), Duration::ZERO);
        let segment = files
            .shared
            .join(format!("{}{young}.dynamic", files.prefix));
        make(segment.clone(), 0o200);
        let refused = await_finished(&files, || ()).expect_err("nobody finishes it");
        let (words, name) = (refused.to_string(), segment.display().to_string());
        assert!(words.contains(&name), "{words}");
        let finish = || {
            std::fs::write(&segment, "finished").expect("write");
            set_permissions(&segment, Permissions::from_mode(0o600)).expect("chmod");
        };
        await_finished(&files, finish).expect("it is finished");
        std::fs::remove_file(&segment).expect("clean up");
    }

    #[test]
    fn files_of_a_dead_process_are_removed_while_its_peer_lives() {
        let files = files_of_test("half-dead", std::env::temp_dir());
        let minutes = |n: u64| id(std::process::id(), Duration::from_secs(60 * n));
        let (living, other, dead) = (minutes(1), minutes(2), id(NOBODY, Duration::ZERO));
        let used = Used {
            ids: [living, other].into(),
            ..Used::default()
        };
        let connection = |from: u128, to: u128| {
            let name = format!("{}{from}_{to}.connection", files.prefix);
            files.shared.join(name)
        };
        let (left, grows) = (connection(living, dead), connection(living, other));
        make(left.clone(), 0o200);
        make(grows.clone(), 0o200);
        assert_eq!(files.remove_unfinished(&used).expect("all is read"), 1);
        assert!(!left.exists() && grows.exists());
        std::fs::remove_file(&grows).expect("clean up");
    }

    #[test]
    fn exactly_the_files_of_no_living_process_are_removed() {
        let me = std::process::id();
        let files = files_of_test("leftovers", SHARED_MEMORY.into());
        let (root, prefix) = (&files.root, &files.prefix);
        create_dir(root).expect("a new folder");
        let mut config = node_config().expect("the usual configuration");
        let path = IpcPath::new(root.as_os_str().as_encoded_bytes());
        config.global.set_root_path(&path.expect("a path"));
        config.global.prefix = FileName::new(prefix.as_bytes()).expect("a name");
        let node = NodeBuilder::new().config(&config).create::<Ipc>();
        let node = node.expect("a node");
        let named = |name: &str| node.service_builder(&name.try_into().expect("a name"));
        let service = named("a/frames").publish_subscribe::<[u8]>();
        let service = service.open_or_create().expect("a service");
        let publisher = service.publisher_builder().create().expect("a publisher");
        let subscriber = service.subscriber_builder().create().expect("a subscriber");
        let wake = named("a/wake").event().open_or_create().expect("a service");
        let listener = wake.listener_builder().create().expect("a listener");

        let minute = Duration::from_secs(60);
        let (dead, old) = (id(NOBODY, Duration::ZERO), id(me, minute));
        let new = id(me, Duration::ZERO);
        let port = publisher.id().value();
        let is_young = is_in_the_making(port).expect("its process is ours");
        assert!(is_young, "ids are of our clock: {port}");
        let hash = "0123456789abcdef".repeat(3)[..40].to_owned();
        let segment = |name: String| files.shared.join(format!("{prefix}{hash}_{name}"));
        // Three files that must stay: the memory of a growing port, the memory of a port that a client is creating
        // without the lock, and a connection to a living port.
        make(segment(format!("{port}__2.data")), 0o200);
        make(segment(format!("{new}.dynamic")), 0o200);
        create_dir(root.join(format!("nodes/{new}"))).expect("a folder");
        std::fs::write(segment(format!("{port}_{dead}.connection")), "finished").expect("a file");
        let used = all(&files);

        for (name, mode) in [
            ("node.0_10_1.global_mgmt".into(), 0o200),
            (format!("{dead}.dynamic"), 0o200),
            (format!("{old}.dynamic"), 0o600),
            (format!("{old}_{dead}.connection_2"), 0o200),
        ] {
            make(segment(name), mode);
        }
        for name in [
            format!("{dead}.data"),
            format!("{old}__mgmt.data"),
            format!("{old}_{dead}.connection"),
            format!("{dead}.event_mgmt"),
        ] {
            std::fs::write(segment(name), "finished").expect("a file");
        }
        for (name, mode) in [
            (format!("{prefix}{dead}.event"), 0o600),
            (format!("services/{prefix}{hash}.service"), 0o600),
            (format!("nodes/{prefix}{dead}.node_monitor_context"), 0o200),
            (format!("nodes/{prefix}{old}.node_monitor"), 0o200),
        ] {
            make(root.join(name), mode);
        }
        for id in [dead, old] {
            let folder = root.join(format!("nodes/{id}"));
            create_dir(&folder).expect("a folder");
            make(folder.join(format!("{prefix}{hash}.service_tag")), 0o600);
            make(folder.join(format!("{prefix}node.details")), 0o600);
        }
        assert_eq!(files.remove_leftovers(&config).expect("all is read"), 14);
        assert_eq!(all(&files), used);

        drop((subscriber, publisher, service, listener, wake, node));
        remove_if(files.segments().expect("a folder"), |_| Ok(true)).expect("clean up");
        remove_dir_all(root).expect("clean up");
    }
}
