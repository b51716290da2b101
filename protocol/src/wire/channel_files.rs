//! The files of channels, and what they reveal: the node, port or service that each belongs to, whether its process
//! lives, and whether the file is finished.
//!
//! iceoryx2 stores nodes and services in a directory, and memory segments next to it. A port's id contains the process
//! that created the port, and the time of creation.

use super::directory::{SHARED_MEMORY, channel_directory, prefix};
use super::ipc::Ipc;
use super::own_nodes;
use super::process::{if_there, lock_holder, node_pid, process_state};
use emberwatch_messages::message::VERSION;
use iceoryx2::node::{DeadNodeView, Node, NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, Config};
use rustix::process::{Flock, FlockType, Pid, fcntl_getlk, getpid};
use rustix::time::{ClockId, clock_gettime};
use std::collections::HashSet;
use std::fs::{File, Metadata};
use std::io::Error;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Minimum age at which a file of a living process can count as left over. A client that does not take the lock of
/// `turn.rs` may still be creating a younger file.
const MAKING: Duration = Duration::from_secs(1);

pub(super) struct ChannelFiles {
    pub(super) root: PathBuf,
    pub(super) shared: PathBuf,
    pub(super) prefix: String,
}

/// The ids of the ports and services of living nodes, and the hashes of the services' names.
#[derive(Debug, Default)]
pub(super) struct Used {
    pub(super) ids: HashSet<u128>,
    pub(super) hashes: HashSet<String>,
}

impl ChannelFiles {
    pub(super) fn of_user() -> Self {
        Self {
            root: channel_directory(),
            shared: SHARED_MEMORY.into(),
            prefix: prefix(),
        }
    }

    pub(super) fn unfinished_segment(&self) -> Result<Option<PathBuf>, Error> {
        for path in self.segments()? {
            if self.is_unfinished(&path)? {
                return Ok(Some(path));
            }
        }
        Ok(None)
    }

    /// Returns whether a segment is unfinished: it is empty, or not yet readable. The memory of a living port does not
    /// count as unfinished: it grows without the lock of `turn.rs`, but is opened only when it is finished.
    pub(super) fn is_unfinished(&self, segment: &Path) -> Result<bool, Error> {
        let unfinished = |found: Metadata| found.len() == 0 || found.mode() & 0o400 == 0;
        let grows =
            || Ok::<_, Error>(name(segment).ends_with(".data") && any(&self.ids(segment), lives)?);
        Ok(metadata(segment)?.is_some_and(unfinished) && !grows()?)
    }

    pub(super) fn used(&self, living: &HashSet<u128>) -> Result<Used, Error> {
        let mut used = Used::default();
        for &node in living {
            let ports = self.tags(node, ".port_tag")?;
            used.ids
                .extend(ports.iter().filter_map(|id| id.parse::<u128>().ok()));
            used.hashes.extend(self.tags(node, ".service_tag")?);
        }
        Ok(used)
    }

    pub(super) fn folder(&self, node: u128) -> PathBuf {
        self.root.join("nodes").join(node.to_string())
    }

    pub(super) fn tags(&self, node: u128, suffix: &str) -> Result<HashSet<String>, Error> {
        let mut tags = HashSet::new();
        for path in entries(&self.folder(node))? {
            let name = name(&path);
            let tag = name
                .strip_prefix(&self.prefix)
                .and_then(|name| name.strip_suffix(suffix));
            if let Some(tag) = tag
                && !is_writable(&path)?
            {
                tags.insert(tag.to_owned());
            }
        }
        Ok(tags)
    }

    pub(super) fn service_ids(&self, used: &Used) -> Result<HashSet<u128>, Error> {
        let mut ids = HashSet::new();
        for path in entries(&self.root.join("services"))? {
            if self
                .hash(&path)
                .is_some_and(|hash| used.hashes.contains(&hash))
                && let Some(text) = if_there(std::fs::read_to_string(&path))?
            {
                let unread = || Error::other(format!("{}: expected an id", path.display()));
                ids.insert(service_id(&text).ok_or_else(unread)?);
            }
        }
        Ok(ids)
    }

    pub(super) fn hash(&self, service: &Path) -> Option<String> {
        let name = name(service);
        let hash = name.strip_prefix(&self.prefix)?.strip_suffix(".service")?;
        Some(hash.to_owned())
    }

    /// Returns the ids in the name of a segment, `<prefix><hash>_<id>[_<id>].<kind>`, or of a socket,
    /// `<prefix><id>.event`.
    pub(super) fn ids(&self, path: &Path) -> Vec<u128> {
        let name = name(path);
        let stem = name
            .strip_prefix(&self.prefix)
            .and_then(|name| name.split_once('.'));
        let words = stem.map_or("", |(stem, _)| stem).split('_');
        // Short numbers are not ids: they number the segments of a port.
        let ids = words.filter(|word| word.len() > 10);
        ids.filter_map(|word| word.parse().ok()).collect()
    }

    pub(super) fn node(&self, path: &Path) -> Option<u128> {
        let name = name(path);
        let monitor = name.strip_prefix(&self.prefix);
        let monitor = monitor.and_then(|name| name.split_once(".node_monitor"));
        monitor.map_or(&*name, |(id, _)| id).parse().ok()
    }

    /// Returns whether another copy of this library has a node in this process, such as a plugin's copy. iceoryx2 marks
    /// living nodes with locks of `fcntl`, which belong to the process: closing such a file releases the lock.
    pub(super) fn has_another_copy(&self) -> Result<bool, Error> {
        let own_pid = getpid().as_raw_nonzero().get();
        for path in entries(&self.root.join("nodes"))? {
            let node = self.node(&path);
            if node.is_some_and(|id| node_pid(id) == own_pid && !own_nodes::has(id))
                && let Some(found) = metadata(&path)?
                && lock_holder("POSIX", found.dev(), found.ino()) == Some(own_pid)
            {
                return Ok(true);
            }
        }
        Ok(false)
    }

    pub(super) fn segments(&self) -> Result<Vec<PathBuf>, Error> {
        self.of_prefix(&self.shared)
    }

    pub(super) fn of_prefix(&self, folder: &Path) -> Result<Vec<PathBuf>, Error> {
        let mut paths = entries(folder)?;
        paths.retain(|path| name(path).starts_with(&self.prefix));
        Ok(paths)
    }
}

pub(super) fn nodes(config: &Config) -> Result<(HashSet<u128>, Vec<DeadNodeView<Ipc>>), Error> {
    let (mut living, mut unclear, mut dead) = (HashSet::new(), Vec::new(), Vec::new());
    let sort = |state| {
        match state {
            NodeState::Alive(node) => _ = living.insert(node.id().value()),
            NodeState::Inaccessible(id) => _ = living.insert(id.value()),
            NodeState::Dead(node) => dead.push(node),
            // The process died while it started, or the files cannot be read.
            NodeState::Undefined(id) => unclear.push(id.value()),
        }
        CallbackProgression::Continue
    };
    Node::<Ipc>::list(config, sort)
        .map_err(|error| Error::other(format!("list nodes: {error:?}")))?;
    for id in unclear {
        if lives(id)? {
            living.insert(id);
        }
    }
    Ok((living, dead))
}

/// Returns whether a node lives in another PID namespace: the process that holds its lock has a different id here, or
/// none.
pub fn lives_elsewhere(node: u128) -> bool {
    let monitor = format!("nodes/{}{node}.node_monitor", prefix());
    // If this process has the node, opening and closing the file here would release the node's lock.
    if own_nodes::has(node) {
        return false;
    }
    let locked = File::open(channel_directory().join(monitor))
        .and_then(|file| Ok(fcntl_getlk(file, &Flock::from(FlockType::ReadLock))?));
    locked.is_ok_and(|lock| lock.is_some_and(|lock| Pid::as_raw(lock.pid) != node_pid(node)))
}

fn service_id(text: &str) -> Option<u128> {
    let table = text.parse::<toml::Table>().ok()?;
    let id = table.get("unique_service_id")?;
    let half = |name| Some(id.get(name)?.as_integer()? as u128);
    Some(half("unique_value")? << 64 | half("payload_value")?)
}

/// Returns whether the object with this id may still be under construction. The id contains the process that creates
/// the object, and the time at which its creation began.
pub(super) fn is_in_the_making(id: u128) -> Result<bool, Error> {
    let (seconds, nanos) = (id as u32, (id >> 32) as u32);
    let age = since_boot().saturating_sub(Duration::new(seconds.into(), nanos));
    Ok(age < MAKING && lives(id)?)
}

/// Returns whether the process that created an id is alive. Also returns true if another process has the same process
/// id.
pub(super) fn lives(id: u128) -> Result<bool, Error> {
    Ok(!matches!(
        process_state(node_pid(id))?,
        None | Some('Z' | 'X')
    ))
}

pub(super) fn since_boot() -> Duration {
    let now = clock_gettime(ClockId::Monotonic);
    Duration::new(now.tv_sec as u64, now.tv_nsec as u32)
}

/// Returns whether a file is writable. Tags and the details of nodes are writable until they are finished.
pub(super) fn is_writable(file: &Path) -> Result<bool, Error> {
    Ok(metadata(file)?.is_some_and(|found| found.mode() & 0o200 != 0))
}

pub(super) fn metadata(path: &Path) -> Result<Option<Metadata>, Error> {
    if_there(path.symlink_metadata())
}

pub(super) fn entries(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    match if_there(std::fs::read_dir(folder))? {
        Some(entries) => entries.map(|entry| Ok(entry?.path())).collect(),
        None => Ok(Vec::new()),
    }
}

/// Returns the protocol version of an instance's channel, if it differs from ours. Reads the files directly, because
/// iceoryx2 would open each service, which could block forever.
pub(super) fn other_version(instance: &str, channel: &str) -> Option<u32> {
    let end = format!("/{instance}/{channel}\"");
    let version = |text: &str| {
        let (_, name) = text.split_once("service_name = \"emberwatch/v")?;
        let (name, _) = name.split_once('\n')?;
        name.strip_suffix(&end)?.parse().ok()
    };
    let files = entries(&channel_directory().join("services")).unwrap_or_default();
    let texts = files.iter().filter_map(|path| std::fs::read(path).ok());
    let versions = texts.filter_map(|text| version(&String::from_utf8_lossy(&text)));
    versions.filter(|&version| version != VERSION).max()
}

fn name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

pub(super) fn any(ids: &[u128], is: fn(u128) -> Result<bool, Error>) -> Result<bool, Error> {
    for &id in ids {
        if is(id)? {
            return Ok(true);
        }
    }
    Ok(false)
}
