//! The system's limits on this process, in words. The errors of the system and of iceoryx2 do not name the limit.

use std::fs;

use rustix::process::{Resource, getrlimit};

/// Stack that the main thread needs, in bytes. With less than a quarter of this it overflows, and a signal ends the process.
const STACK_BYTES_MIN: u64 = 512 << 10;
/// Address space that a process needs in addition to its program, in bytes. When an allocation fails, Rust aborts the process.
const ADDRESS_SPACE_BYTES_MIN: u64 = 68 << 20;
/// Address space that a daemon needs in addition to its program and its model, in bytes: shared memory, and threads with their stacks.
pub const DAEMON_BYTES_MIN: u64 = 352 << 20;
/// Address space that one step may need, in bytes: shared memory, or a thread with its stack.
const ADDRESS_SPACE_BYTES: u64 = 128 << 20;

/// The limit that is too low for any command, if there is one. It needs little stack, so that it can run first.
#[must_use]
pub fn too_low() -> Option<String> {
    if let Some(limit) = getrlimit(Resource::Stack).current.filter(|limit| *limit < STACK_BYTES_MIN) {
        return Some(format!(
            "the stack may have {limit} bytes, and {STACK_BYTES_MIN} are needed: raise the limit (ulimit -s, LimitSTACK=)"
        ));
    }
    too_little_address_space(ADDRESS_SPACE_BYTES_MIN)
}

/// The limit on address space, if it does not allow `more` bytes in addition to those in use.
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

fn used_bytes() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let used =
        status.lines().find_map(|line| line.strip_prefix("VmSize:")?.trim().strip_suffix("kB")?.trim().parse().ok());
    used.map_or(0, |kilobytes: u64| kilobytes.saturating_mul(1_024))
}

/// Used address space and its limit, in bytes, if little is left.
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
