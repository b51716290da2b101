//! Removes the files of dead processes, which may have died at any instruction, also while they started or ended.
//!
//! During a [`Turn`] no other process makes or removes anything, so every file is one of three: part of a node whose process
//! lives, of a service that such a node uses, or left over. iceoryx2 itself removes dead nodes from services that
//! live on; it cannot remove what was never finished, and it waits without end for an empty segment to become larger.

use super::directory::{SHARED_MEMORY, channel_directory, node_config, prefix};
use super::error::{ChannelError, Ipc};
use super::process::process_state;
use super::turn::Turn;
use iceoryx2::node::{DeadNodeView, Node, NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, Config};
use rustix::time::{ClockId, clock_gettime};
use std::collections::HashSet;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// What is younger and of a living process may be in the making, by a client that takes no turns.
const MAKING: Duration = Duration::from_secs(1);

/// Removes what dead processes left; returns how many files and folders that were.
///
/// # Errors
/// If others hold the turn for too long.
pub fn remove_leftovers() -> Result<usize, ChannelError> {
    let turn = Turn::take()?;
    Ok(match turn.is_alone() {
        true => ChannelFiles::of_user().remove_leftovers(&node_config()?),
        false => 0,
    })
}

/// A segment that is not finished, of this user.
pub(crate) fn unfinished_segment() -> Option<PathBuf> {
    ChannelFiles::of_user()
        .segments()
        .find(|path| is_unfinished(path))
}

/// Where channels' files are, and what their names begin with.
struct ChannelFiles {
    root: PathBuf,
    shared: PathBuf,
    prefix: String,
}

/// What living nodes use: ids of their ports and services, hashes of the services' names.
#[derive(Debug, Default)]
struct Used {
    ids: HashSet<u128>,
    hashes: HashSet<String>,
}

impl ChannelFiles {
    fn of_user() -> Self {
        Self {
            root: channel_directory(),
            shared: SHARED_MEMORY.into(),
            prefix: prefix(),
        }
    }

    fn remove_leftovers(&self, config: &Config) -> usize {
        // Files before nodes and their tags: what a client without turns makes meanwhile is not among them.
        let list = |folder: &str| entries(&self.root.join(folder)).collect::<Vec<_>>();
        let (node_files, services) = (list("nodes"), list("services"));
        let sockets = entries(&self.root).filter(|path| name(path).starts_with(&self.prefix));
        let ports: Vec<PathBuf> = self.segments().chain(sockets).collect();
        let Some((mut living, dead)) = nodes(config) else {
            return 0;
        };
        let mut used = self.used(&living);
        let mut n_removed = self.remove_unfinished(&used);
        for node in dead {
            let id = node.id().value();
            // Unfinished tags were for nothing yet, but iceoryx2 could not remove the folder.
            n_removed += entries(&self.folder(id))
                .filter(|path| is_writable(path))
                .map(remove)
                .sum::<usize>();
            // Else nothing of it is in memory that others use; the details go last.
            let is_shared = node.details().is_some()
                && !used.hashes.is_disjoint(&self.tags(id, ".service_tag"));
            if is_shared && let Err(problem) = node.try_remove_stale_resources() {
                tracing::debug!(?problem, id, "a dead node stays");
                living.insert(id);
            }
        }
        n_removed += self.remove_nodes(node_files, &living);
        used = self.used(&living);
        n_removed += self.remove_services(services, &used);
        n_removed + self.remove_ports(ports, &used)
    }

    /// Unfinished segments of dead processes: to open one could take without end.
    fn remove_unfinished(&self, used: &Used) -> usize {
        let is_left = |path: &PathBuf| {
            let ids = self.ids(path);
            // A port's memory grows without a turn.
            let grows = name(path).ends_with(".data") && ids.iter().any(|id| used.ids.contains(id));
            !grows && !ids.into_iter().any(is_in_the_making) && is_unfinished(path)
        };
        self.segments().filter(is_left).map(remove).sum()
    }

    fn remove_nodes(&self, files: Vec<PathBuf>, living: &HashSet<u128>) -> usize {
        let is_left = |path: &PathBuf| {
            let name = name(path);
            let monitor = name
                .strip_prefix(&self.prefix)
                .and_then(|name| name.split_once(".node_monitor"));
            let id = monitor.map_or(&*name, |(id, _)| id).parse();
            id.is_ok_and(|id| !living.contains(&id) && !is_in_the_making(id))
        };
        files.into_iter().filter(is_left).map(remove).sum()
    }

    fn remove_services(&self, files: Vec<PathBuf>, used: &Used) -> usize {
        let is_left = |path: &PathBuf| {
            self.hash(path)
                .is_some_and(|hash| !used.hashes.contains(&hash))
        };
        files.into_iter().filter(is_left).map(remove).sum()
    }

    /// Segments and sockets that belong to no living port and to no service.
    fn remove_ports(&self, files: Vec<PathBuf>, used: &Used) -> usize {
        let services = self.service_ids(used);
        let is_left = |path: &PathBuf| {
            let ids = self.ids(path);
            let is_used = |id: &u128| used.ids.contains(id) || services.contains(id);
            !ids.is_empty() && !ids.iter().any(is_used) && !ids.into_iter().any(is_in_the_making)
        };
        files.into_iter().filter(is_left).map(remove).sum()
    }

    fn used(&self, living: &HashSet<u128>) -> Used {
        let mut used = Used::default();
        for &node in living {
            let ports = self.tags(node, ".port_tag");
            used.ids
                .extend(ports.iter().filter_map(|id| id.parse::<u128>().ok()));
            used.hashes.extend(self.tags(node, ".service_tag"));
        }
        used
    }

    fn folder(&self, node: u128) -> PathBuf {
        self.root.join("nodes").join(node.to_string())
    }

    /// What a node's folder has finished tags of one kind for.
    fn tags(&self, node: u128, suffix: &str) -> HashSet<String> {
        let tag = |path: PathBuf| {
            let name = name(&path);
            let tag = name.strip_prefix(&self.prefix)?.strip_suffix(suffix)?;
            Some(tag.to_owned())
        };
        let finished = entries(&self.folder(node)).filter(|path| !is_writable(path));
        finished.filter_map(tag).collect()
    }

    /// The ids of services in use, as their files say.
    fn service_ids(&self, used: &Used) -> HashSet<u128> {
        let id = |path: PathBuf| {
            let text = std::fs::read_to_string(&path).ok()?;
            let id = text.parse::<toml::Table>().ok()?;
            let id = id.get("unique_service_id")?;
            let half = |name| Some(id.get(name)?.as_integer()? as u128);
            Some(half("unique_value")? << 64 | half("payload_value")?)
        };
        let services = entries(&self.root.join("services"));
        let services = services.filter(|path| {
            self.hash(path)
                .is_some_and(|hash| used.hashes.contains(&hash))
        });
        services.filter_map(id).collect()
    }

    fn hash(&self, service: &Path) -> Option<String> {
        let name = name(service);
        let hash = name.strip_prefix(&self.prefix)?.strip_suffix(".service")?;
        Some(hash.to_owned())
    }

    /// The ids in the name of a segment, `<prefix><hash>_<id>[_<id>].<kind>`, or a socket, `<prefix><id>.event`.
    fn ids(&self, path: &Path) -> Vec<u128> {
        let name = name(path);
        let stem = name
            .strip_prefix(&self.prefix)
            .and_then(|name| name.split_once('.'));
        let words = stem.map_or("", |(stem, _)| stem).split('_');
        // The segments of one port are numbered.
        let ids = words.filter(|word| word.len() > 10);
        ids.filter_map(|word| word.parse().ok()).collect()
    }

    fn segments(&self) -> impl Iterator<Item = PathBuf> {
        entries(&self.shared).filter(|path| name(path).starts_with(&self.prefix))
    }
}

/// Ids of living nodes, and dead nodes; `None` if they cannot be listed.
fn nodes(config: &Config) -> Option<(HashSet<u128>, Vec<DeadNodeView<Ipc>>)> {
    let (mut living, mut dead) = (HashSet::new(), Vec::new());
    let sort = |state| {
        match state {
            NodeState::Alive(node) => _ = living.insert(node.id().value()),
            NodeState::Inaccessible(id) => _ = living.insert(id.value()),
            NodeState::Dead(node) => dead.push(node),
            NodeState::Undefined(_) => {}
        }
        CallbackProgression::Continue
    };
    match Node::<Ipc>::list(config, sort) {
        Ok(()) => Some((living, dead)),
        Err(error) => {
            tracing::debug!(?error, "nodes were not listed");
            None
        }
    }
}

/// Whether what an id stands for may be in the making: an id has the time when, and the process that, began it.
fn is_in_the_making(id: u128) -> bool {
    let (seconds, nanos, pid) = (id as u32, (id >> 32) as u32, (id >> 64) as i32);
    let age = since_boot().saturating_sub(Duration::new(seconds.into(), nanos));
    age < MAKING && !matches!(process_state(pid), None | Some('Z' | 'X'))
}

/// The clock of ids.
fn since_boot() -> Duration {
    let now = clock_gettime(ClockId::Monotonic);
    Duration::new(now.tv_sec as u64, now.tv_nsec as u32)
}

/// A tag, or a node's details, can be written to until it is finished.
fn is_writable(file: &Path) -> bool {
    file.metadata().is_ok_and(|found| found.mode() & 0o200 != 0)
}

/// A segment can be read only when it is finished.
fn is_unfinished(segment: &Path) -> bool {
    segment
        .metadata()
        .is_ok_and(|found| found.len() == 0 || found.mode() & 0o400 == 0)
}

fn entries(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path())
}

fn name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

/// Removes a file, or a folder of files; returns how many that were.
fn remove(path: PathBuf) -> usize {
    let removed = match path.is_dir() {
        true => std::fs::remove_dir_all(&path),
        false => std::fs::remove_file(&path),
    };
    usize::from(removed.is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;
    use iceoryx2::node::NodeBuilder;
    use iceoryx2::prelude::{FileName, Path as IpcPath, SemanticString};
    use std::fs::{Permissions, create_dir, remove_dir_all, set_permissions};
    use std::os::unix::fs::PermissionsExt;

    /// A process that there cannot be: ids end below 2^22.
    const NOBODY: u32 = 1 << 30;

    fn id(pid: u32, age: Duration) -> u128 {
        let began = since_boot().saturating_sub(age);
        u128::from(pid) << 64 | u128::from(began.subsec_nanos()) << 32 | began.as_secs() as u128
    }

    fn make(path: PathBuf, mode: u32) {
        std::fs::write(&path, "").expect("a file");
        set_permissions(&path, Permissions::from_mode(mode)).expect("chmod");
    }

    fn all(files: &ChannelFiles) -> Vec<PathBuf> {
        let nodes = files.root.join("nodes");
        let folders = [&files.root, &nodes, &files.root.join("services")];
        let mut all: Vec<PathBuf> = folders
            .into_iter()
            .flat_map(|folder| entries(folder))
            .collect();
        all.extend(entries(&nodes).flat_map(|node| entries(&node)));
        all.extend(files.segments());
        all.sort();
        all
    }

    #[test]
    fn what_no_living_process_uses_is_removed_and_nothing_else() {
        let me = std::process::id();
        let files = ChannelFiles {
            root: std::env::temp_dir().join(format!("emberwatch-leftovers-{me}")),
            shared: SHARED_MEMORY.into(),
            prefix: format!("emberwatch-leftovers-{me}_"),
        };
        let (root, prefix) = (&files.root, &files.prefix);
        create_dir(root).expect("a new folder");
        let mut config = node_config().expect("the usual configuration");
        let path = root.as_os_str().as_encoded_bytes();
        config
            .global
            .set_root_path(&IpcPath::new(path).expect("a path"));
        config.global.prefix = FileName::new(prefix.as_bytes()).expect("a name");
        let node = NodeBuilder::new().config(&config).create::<Ipc>();
        let node = node.expect("a node");
        let builder = node.service_builder(&"a/frames".try_into().expect("a name"));
        let service = builder.publish_subscribe::<[u8]>().open_or_create();
        let service = service.expect("a service");
        let publisher = service.publisher_builder().create().expect("a publisher");
        let subscriber = service.subscriber_builder().create().expect("a subscriber");
        let builder = node.service_builder(&"a/wake".try_into().expect("a name"));
        let wake = builder.event().open_or_create().expect("a service");
        let listener = wake.listener_builder().create().expect("a listener");

        let minute = Duration::from_secs(60);
        let (dead, old) = (id(NOBODY, Duration::ZERO), id(me, minute));
        let new = id(me, Duration::ZERO);
        let port = publisher.id().value();
        assert!(is_in_the_making(port), "ids are of our clock: {port}");
        let hash = "0123456789abcdef".repeat(3)[..40].to_owned();
        let segment = |name: String| files.shared.join(format!("{prefix}{hash}_{name}"));
        // Grows now; is in the making by a client without turns; is connected to a living port.
        make(segment(format!("{port}__2.data")), 0o200);
        make(segment(format!("{new}.dynamic")), 0o200);
        create_dir(root.join(format!("nodes/{new}"))).expect("a folder");
        std::fs::write(segment(format!("{port}_{dead}.connection")), "finished").expect("a file");
        let used = all(&files);

        make(segment("node.0_10_1.global_mgmt".into()), 0o200);
        make(segment(format!("{dead}.dynamic")), 0o200);
        make(segment(format!("{old}.dynamic")), 0o600);
        make(segment(format!("{old}_{dead}.connection_2")), 0o200);
        for name in [
            format!("{dead}.data"),
            format!("{old}__mgmt.data"),
            format!("{old}_{dead}.connection"),
            format!("{dead}.event_mgmt"),
        ] {
            std::fs::write(segment(name), "finished").expect("a file");
        }
        make(root.join(format!("{prefix}{dead}.event")), 0o600);
        make(root.join(format!("services/{prefix}{hash}.service")), 0o600);
        for id in [dead, old] {
            let folder = root.join(format!("nodes/{id}"));
            create_dir(&folder).expect("a folder");
            make(folder.join(format!("{prefix}{hash}.service_tag")), 0o600);
            make(folder.join(format!("{prefix}node.details")), 0o600);
        }
        make(
            root.join(format!("nodes/{prefix}{dead}.node_monitor_context")),
            0o200,
        );
        make(
            root.join(format!("nodes/{prefix}{old}.node_monitor")),
            0o200,
        );
        assert_eq!(files.remove_leftovers(&config), 14);
        assert_eq!(all(&files), used);

        drop((subscriber, publisher, service, listener, wake, node));
        files.segments().map(remove).for_each(drop);
        remove_dir_all(root).expect("clean up");
    }
}
