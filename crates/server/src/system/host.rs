//! The machine's name. This module never looks further than the kernel.

/// The host name as the kernel knows it; `None` if there is none.
pub fn host_name() -> Option<String> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    Some(name.trim().to_owned()).filter(|name| !name.is_empty())
}
