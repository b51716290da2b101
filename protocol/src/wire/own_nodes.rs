//! The ids of this process's nodes. Process ids are not enough, because a process in another PID namespace may have the
//! same id.

use std::collections::HashSet;
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};

fn nodes() -> MutexGuard<'static, HashSet<u128>> {
    static NODES: LazyLock<Mutex<HashSet<u128>>> = LazyLock::new(Mutex::default);
    NODES.lock().unwrap_or_else(PoisonError::into_inner)
}

pub(super) fn add(node: u128) {
    nodes().insert(node);
}

pub(super) fn has(node: u128) -> bool {
    nodes().contains(&node)
}
