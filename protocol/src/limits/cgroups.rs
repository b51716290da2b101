//! The limits of the cgroups that this process is in, versions 1 and 2: a container's, and those around it.

use std::path::{Path, PathBuf};

/// Values of at least this many bytes or processes mean "no limit": version 1 writes the largest multiple of a page.
const UNLIMITED: u64 = 1 << 60;

/// A controller of cgroups: the names of its files in versions 1 and 2.
pub(super) struct Controller {
    pub(super) name: &'static str,
    /// What the cgroup may have.
    pub(super) limit: [&'static str; 2],
    /// What it has.
    pub(super) used: [&'static str; 2],
    /// Counts in `memory.stat` that the kernel can take back, such as cached files.
    pub(super) reclaimable: [&'static [&'static str]; 2],
}

/// The limit of one cgroup.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct CgroupLimit {
    /// The file that has it.
    pub(super) file: PathBuf,
    pub(super) limit: u64,
    pub(super) free: u64,
}

/// A hierarchy that is mounted: its version less one, the cgroup at its top, and where that is.
struct Mount {
    version: usize,
    top: PathBuf,
    folder: PathBuf,
}

/// The limits of a controller on this process, by the files below `root`.
pub(super) fn limits(root: &Path, controller: &Controller) -> Vec<CgroupLimit> {
    let read = |path: &str| std::fs::read_to_string(root.join(path)).unwrap_or_default();
    let (own, mounts) = (read("proc/self/cgroup"), read("proc/self/mountinfo"));
    let mounts = mounts.lines().filter_map(|line| mount(line, controller));
    let limits = mounts.flat_map(|mount| {
        let group = own_group(&own, &mount, controller).unwrap_or_default();
        let bottom = root.join(relative(&mount.folder)).join(group);
        let top = root.join(relative(&mount.folder));
        let folders = bottom.ancestors().take_while(|it| it.starts_with(&top));
        let limits = folders.filter_map(|folder| limit(folder, mount.version, controller));
        limits.collect::<Vec<_>>()
    });
    limits.collect()
}

/// A line of `mountinfo`, such as `35 31 0:32 / /sys/fs/cgroup/memory rw,relatime - cgroup cgroup rw,memory`.
fn mount(line: &str, controller: &Controller) -> Option<Mount> {
    let (place, kind) = line.split_once(" - ")?;
    let mut place = place.split(' ').skip(3);
    let (top, folder) = (place.next()?, place.next()?);
    let mut kind = kind.split(' ');
    let version = match kind.next()? {
        "cgroup" => 0,
        "cgroup2" => 1,
        _ => return None,
    };
    let mut options = kind.nth(1)?.split(',');
    let is_of = version == 1 || options.any(|option| option == controller.name);
    is_of.then(|| Mount {
        version,
        top: top.into(),
        folder: folder.into(),
    })
}

/// The cgroup of this process, relative to the top of a mount, by the lines of `/proc/self/cgroup`, such as
/// `4:memory:/docker/id` or, in version 2, `0::/user.slice`.
fn own_group(own: &str, mount: &Mount, controller: &Controller) -> Option<PathBuf> {
    let path = own.lines().find_map(|line| {
        let mut words = line.splitn(3, ':').skip(1);
        let (controllers, path) = (words.next()?, words.next()?);
        let is_of = match mount.version {
            0 => controllers.split(',').any(|name| name == controller.name),
            _ => controllers.is_empty(),
        };
        is_of.then_some(path)
    })?;
    // In a container, the mount may show a part of the hierarchy alone.
    let below = Path::new(path).strip_prefix(&mount.top).ok()?;
    let is_plain = !below.components().any(|it| it.as_os_str() == "..");
    is_plain.then(|| below.to_owned())
}

/// The limit of one cgroup, if it has one.
fn limit(folder: &Path, version: usize, controller: &Controller) -> Option<CgroupLimit> {
    let number = |name: &str| {
        let text = std::fs::read_to_string(folder.join(name)).ok()?;
        text.trim().parse::<u64>().ok()
    };
    let file = folder.join(controller.limit[version]);
    let limit = number(controller.limit[version]).filter(|&limit| limit < UNLIMITED)?;
    let used = number(controller.used[version])?;
    let counts = std::fs::read_to_string(folder.join("memory.stat")).unwrap_or_default();
    let counts = counts.lines().filter_map(|line| line.split_once(' '));
    let reclaimable: u64 = counts
        .filter(|(name, _)| controller.reclaimable[version].contains(name))
        .filter_map(|(_, count)| count.trim().parse::<u64>().ok())
        .sum();
    Some(CgroupLimit {
        file,
        limit,
        free: limit.saturating_sub(used.saturating_sub(reclaimable)),
    })
}

fn relative(path: &Path) -> &Path {
    path.strip_prefix("/").unwrap_or(path)
}
