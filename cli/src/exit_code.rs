//! Exit codes of the `roomcast` command. Scripts may rely on them; `roomcast --help` lists them.

/// Success.
pub const OK: u8 = 0;
/// Any failure without another code.
pub const FAILURE: u8 = 1;
/// The command line cannot be understood (clap's own code).
pub const USAGE: u8 = 2;
/// An input file or text is malformed or missing: scene, program, narration, recording.
pub const INPUT: u8 = 3;
/// The configuration is malformed or contradicts itself.
pub const CONFIG: u8 = 4;
/// The model cannot be loaded, or cannot do the requested work.
pub const MODEL: u8 = 5;
/// A service cannot be opened or was lost: shared memory, versions, a second daemon.
pub const IPC: u8 = 6;
/// A check ran and found faults (`scene check`, `model check`, `doctor`).
pub const CHECK: u8 = 7;
/// Interrupted by ctrl-C or a termination signal before the work was done, or by a second signal. A service ends with [`OK`] when it is asked to
/// stop.
pub const INTERRUPTED: u8 = 130;
