//! The system's limits on this process, in words: where one is reached, the system and iceoryx2 do not say which.

use std::fs;

use rustix::process::{Resource, getrlimit};

/// Stack that the main thread needs, in bytes. Below a quarter of this it overflows, which ends the process by a signal.
const STACK_BYTES_MIN: u64 = 512 << 10;
/// Address space that a process needs besides its program, in bytes. Where an allocation fails, Rust ends the process by a signal.
const ADDRESS_SPACE_BYTES_MIN: u64 = 68 << 20;
/// Address space that a daemon needs besides its program and its model, in bytes: shared memory, and threads with their stacks.
pub const DAEMON_BYTES_MIN: u64 = 352 << 20;
/// So much address space may be asked for at once, in bytes: shared memory, or a thread with its stack.
const ADDRESS_SPACE_BYTES: u64 = 128 << 20;

/// The limit that is too low for any command, if there is one. Needs little of the stack: to be called first of all.
#[must_use]
pub fn too_low() -> Option<String> {
    if let Some(limit) = getrlimit(Resource::Stack).current.filter(|limit| *limit < STACK_BYTES_MIN) {
        return Some(format!(
            "the stack may have {limit} bytes, and {STACK_BYTES_MIN} are needed: raise the limit (ulimit -s, LimitSTACK=)"
        ));
    }
    too_little_address_space(ADDRESS_SPACE_BYTES_MIN)
}

/// The limit on address space, if this process may not have `more` bytes besides those that it has.
#[must_use]
pub fn too_little_address_space(more: u64) -> Option<String> {
    let limit = getrlimit(Resource::As).current?;
    let needed = used_bytes().saturating_add(more);
    (needed > limit).then(|| {
        format!(
            "this process may have {limit} bytes of address space, and {needed} are needed: raise the limit (ulimit -v, LimitAS=)"
        )
    })
}

/// How much address space this process has, in bytes.
fn used_bytes() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let used =
        status.lines().find_map(|line| line.strip_prefix("VmSize:")?.trim().strip_suffix("kB")?.trim().parse().ok());
    used.map_or(0, |kilobytes: u64| kilobytes.saturating_mul(1_024))
}

/// How much address space this process has and how much it may have, in bytes, if little of it is left.
#[must_use]
pub(crate) fn address_space() -> Option<(u64, u64)> {
    let limit = getrlimit(Resource::As).current?;
    let used = used_bytes();
    (used.saturating_add(ADDRESS_SPACE_BYTES) > limit).then_some((used, limit))
}

/// The limit that may keep a thread from starting, as the end of an error.
#[must_use]
pub fn on_threads() -> String {
    match address_space() {
        Some((_, limit)) => {
            format!("this process may have {limit} bytes of address space: raise the limit (ulimit -v, LimitAS=)")
        }
        None => "is a limit on tasks set too low (ulimit -u, TasksMax=)?".to_owned(),
    }
}
