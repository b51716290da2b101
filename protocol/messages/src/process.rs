//! This process, as messages name it.

/// The PID namespace of this process, by its number; `None` if the system does not say.
pub fn pid_namespace() -> Option<u64> {
    let link = std::fs::read_link("/proc/self/ns/pid").ok()?; // "pid:[4026531836]"
    let number = link.to_str()?.strip_prefix("pid:[")?.strip_suffix(']')?;
    number.parse().ok()
}
