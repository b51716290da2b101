//! The limits that cgroups (versions 1 and 2) set for this process. The process's cgroup and all enclosing cgroups can
//! set limits.

use std::path::{Path, PathBuf};

/// Values of at least this mean "no limit": version 1 writes the largest multiple of the page size.
const UNLIMITED: u64 = 1 << 60;

/// A cgroup controller, such as `memory`. Each of its files has one name in version 1 and another in version 2.
pub(super) struct Controller {
    pub(super) name: &'static str,
    pub(super) limit: [&'static str; 2],
    pub(super) used: [&'static str; 2],
    /// Entries of `memory.stat` that count reclaimable memory, such as cached files.
    pub(super) reclaimable: [&'static [&'static str]; 2],
}

#[derive(Debug, PartialEq, Eq)]
pub(super) struct CgroupLimit {
    pub(super) file: PathBuf,
    pub(super) limit: u64,
    pub(super) free: u64,
}

/// A mounted hierarchy: its version minus one, the cgroup at its top, and the folder where it is mounted.
struct Mount {
    version: usize,
    top: PathBuf,
    folder: PathBuf,
}

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

/// Parses a line of `mountinfo`, such as `35 31 0:32 / /sys/fs/cgroup/memory rw,relatime - cgroup cgroup rw,memory`.
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

/// Returns the cgroup of this process, relative to the top of a mount, from the lines of `/proc/self/cgroup`. A line
/// is, for example, `4:memory:/docker/id` or, in version 2, `0::/user.slice`.
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
    // In a container, the mount may show only a part of the hierarchy.
    let below = Path::new(path).strip_prefix(&mount.top).ok()?;
    let is_plain = !below.components().any(|it| it.as_os_str() == "..");
    is_plain.then(|| below.to_owned())
}

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

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{create_dir_all, remove_dir_all, write};

    const MEMORY: Controller = Controller {
        name: "memory",
        limit: ["memory.limit_in_bytes", "memory.max"],
        used: ["memory.usage_in_bytes", "memory.current"],
        reclaimable: [&["total_inactive_file"], &["inactive_file"]],
    };

    /// Checks the limits found in a system with these files. Each line of `files` describes one file, whose own lines
    /// end with `;`. Each expected limit consists of the folder, the limit and the free amount, from the innermost
    /// cgroup outward.
    fn check(name: &str, files: &str, expected: &[&str]) {
        let root = std::env::temp_dir().join(format!("emberwatch-{name}-{}", std::process::id()));
        for line in files.trim().lines() {
            let (path, text) = line.split_once(" = ").expect(line);
            let path = root.join(path.trim());
            create_dir_all(path.parent().expect("a folder")).expect("make it");
            write(path, text.replace(';', "\n")).expect("write a file");
        }
        let found = limits(&root, &MEMORY).into_iter().map(|it| {
            let folder = it.file.parent().expect("a folder").strip_prefix(&root);
            let folder = folder.expect("below the root").display();
            format!("{folder} {} {}", it.limit, it.free)
        });
        assert_eq!(found.collect::<Vec<_>>(), expected);
        remove_dir_all(&root).expect("clean up");
    }

    #[test]
    fn version_2_includes_all_enclosing_groups() {
        let outer = "
            proc/self/cgroup = 0::/outer/inner;
            proc/self/mountinfo = 30 23 0:26 / /sys/fs/cgroup rw,nosuid - cgroup2 cgroup2 rw,nsdelegate
            sys/fs/cgroup/outer/memory.max = 1000;
            sys/fs/cgroup/outer/memory.current = 900;
            sys/fs/cgroup/outer/memory.stat = anon 1;inactive_file 300;slab 2;
            sys/fs/cgroup/outer/inner/memory.current = 500;
            sys/fs/cgroup/outer/inner/memory.max = ";
        let expected = "sys/fs/cgroup/outer 1000 400";
        check("v2", &format!("{outer}max;"), &[expected]);
        let inner = "sys/fs/cgroup/outer/inner 600 100";
        check("v2-both", &format!("{outer}600;"), &[inner, expected]);
        // In a separate cgroup namespace, a process sees its cgroup as the root, or a cgroup outside the namespace with
        // a path that begins with "..".
        for own in ["0::/", "0::/../other"] {
            let top = format!(
                "proc/self/cgroup = {own}
                proc/self/mountinfo = 30 23 0:26 / /sys/fs/cgroup rw - cgroup2 cgroup2 rw
                sys/fs/cgroup/memory.max = 1000
                sys/fs/cgroup/memory.current = 1500"
            );
            check("v2-top", &top, &["sys/fs/cgroup 1000 0"]);
        }
    }

    #[test]
    fn version_1_finds_a_group_below_the_top_of_a_mount() {
        let mounts = [
            "34 31 0:31 / /sys/fs/cgroup/cpuset rw - cgroup cgroup rw,cpuset",
            "35 31 0:32 /docker/id /sys/fs/cgroup/memory rw,relatime shared:9 - cgroup cgroup rw,memory",
            "41 31 0:38 / /sys/fs/cgroup/unified rw,relatime - cgroup2 cgroup2 rw",
        ];
        let files = "
            proc/self/cgroup = 5:cpuset:/;4:memory:/docker/id/job;0::/;
            sys/fs/cgroup/memory/job/memory.limit_in_bytes = 800
            sys/fs/cgroup/memory/job/memory.usage_in_bytes = 300
            sys/fs/cgroup/memory/job/memory.stat = total_inactive_file 100;inactive_file 7
            sys/fs/cgroup/memory/memory.limit_in_bytes = 9223372036854771712
            sys/fs/cgroup/memory/memory.usage_in_bytes = 5
            proc/self/mountinfo = ";
        let files = format!("{files}{}", mounts.join(";"));
        check("v1", &files, &["sys/fs/cgroup/memory/job 800 600"]);
        check("none", "proc/self/cgroup = garbage", &[]);
    }
}
