//! Ends the process with an error when iceoryx2 panics. iceoryx2 panics if it cannot remove a socket file, or if a participant that it took
//! for dead is alive.

use std::io::Write;
use std::panic::{self, PanicHookInfo};
use std::path::{Component, Path};

/// Limit on iceoryx2's reason, which follows the participant that it prints first.
const REASON_CHARS_MAX: usize = 200;

/// From now on a panic in iceoryx2 ends this process with a one-line error and this exit code. Confirmed data stays, and other participants
/// clean up after the process, as after a kill. Other panics stay unchanged.
pub fn end_where_iceoryx2_panics(program: &'static str, code: u8) {
    let before = panic::take_hook();
    panic::set_hook(Box::new(move |panicked| {
        let Some(place) = panicked.location().filter(|place| is_of_iceoryx2(place.file())) else {
            return before(panicked);
        };
        let (reason, file, line) = (reason(panicked), place.file(), place.line());
        let _told = writeln!(
            std::io::stderr(),
            "{program}: iceoryx2 gave up in shared memory: {reason} ({file}:{line}); start it again: what was confirmed is kept"
        );
        std::process::exit(code.into());
    }));
}

/// Looks for a folder name of an iceoryx2 crate; cargo may keep the crates anywhere.
fn is_of_iceoryx2(file: &str) -> bool {
    let folders: Vec<_> = Path::new(file).components().collect();
    let is_own = |name: &Component<'_>| name.as_os_str().to_string_lossy().starts_with("iceoryx2");
    folders.windows(2).any(|pair| is_own(&pair[0]) && pair[1].as_os_str() == "src")
}

/// iceoryx2's message without the participant in front of it, which fills a screen.
fn reason(panicked: &PanicHookInfo<'_>) -> String {
    let payload = panicked.payload();
    let text = payload.downcast_ref::<String>().map(String::as_str).or_else(|| payload.downcast_ref::<&str>().copied());
    let said = text.unwrap_or("it does not say why");
    said.rsplit(" ::: ").next().unwrap_or(said).chars().take(REASON_CHARS_MAX).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn iceoryx2_is_told_from_others() {
        for file in [
            "/home/robot/.cargo/registry/src/index/iceoryx2-0.10.0/src/node/mod.rs",
            "vendor/iceoryx2-bb-posix/src/unix_datagram_socket.rs",
        ] {
            assert!(is_of_iceoryx2(file), "{file}");
        }
        for file in
            ["ipc/src/give_up.rs", "/home/iceoryx2/roomcast/services/src/lib.rs", "/vendor/tokio-1.0/src/lib.rs"]
        {
            assert!(!is_of_iceoryx2(file), "{file}");
        }
    }
}
