//! The identity of this process in messages.

/// Returns the number of this process's PID namespace, or `None` if the system does not provide it.
pub fn pid_namespace() -> Option<u64> {
    let link = std::fs::read_link("/proc/self/ns/pid").ok()?; // "pid:[4026531836]"
    let number = link.to_str()?.strip_prefix("pid:[")?.strip_suffix(']')?;
    number.parse().ok()
}
