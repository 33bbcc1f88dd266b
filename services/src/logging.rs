//! Logs: to the journal when systemd listens, else to standard error; filtered by `ROOMCAST_LOG` (`FILTER_DEFAULT` when unset).
//!
//! Standard error may be a pipe without a reader, or a file on a disk that is busy for seconds. So one thread writes it, `LINES_MAX` lines
//! may wait, and further lines are lost: the log never delays the scorer.

use std::io::{self, IsTerminal, Write};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender, bounded};
use roomcast_core::ids::BootNs;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::fmt;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// The environment variable of the filter, for example `roomcast=debug`.
const FILTER_VARIABLE: &str = "ROOMCAST_LOG";

/// llama.cpp logs many details that matter only when a model does not load.
const FILTER_DEFAULT: &str = "info,llama-cpp-2=warn,llama_cpp_2=error,rumqttc=error";

/// The filter of `--verbose`.
const FILTER_VERBOSE: &str = "info,llama-cpp-2=warn,llama_cpp_2=error,rumqttc=error,roomcast=debug";
static IS_VERBOSE: AtomicBool = AtomicBool::new(false);

/// Most lines that wait to be written. The memory for their places is taken at the start, 32 bytes each.
const LINES_MAX: usize = 8_192;
/// The longest time that the end of the program waits for the last lines.
const LAST_LINES: Duration = Duration::from_secs(1);

/// The first writer of the process, for [`finish`].
static WRITER: OnceLock<Writer> = OnceLock::new();

/// Keeps the log's thread alive. The drop writes the waiting lines, for a second at most.
#[must_use = "the log ends when this is dropped"]
#[derive(Debug)]
pub struct Log {
    writer: Option<Writer>,
}

impl Drop for Log {
    fn drop(&mut self) {
        self.writer.iter().for_each(Writer::finish);
    }
}

/// Writes the waiting lines and ends the log, for an end of the process without drops.
pub fn finish() {
    WRITER.get().into_iter().for_each(Writer::finish);
}

/// The filter of a text: `info,roomcast=debug`, with or without spaces, and without the fields and spans of other filters.
fn filter_of(text: &str) -> Result<Targets, String> {
    if text.contains(['[', '{']) {
        return Err(
            "spans and fields are no part of it; give targets with levels, such as info,roomcast=debug".to_owned()
        );
    }
    let parts: Vec<&str> = text.split(',').map(str::trim).filter(|part| !part.is_empty()).collect();
    parts.join(",").parse().map_err(|error: tracing_subscriber::filter::ParseError| error.to_string())
}

/// Logs each step, unless `ROOMCAST_LOG` is set. Call it before [`init`].
pub fn verbose() {
    IS_VERBOSE.store(true, Ordering::Relaxed);
}

/// Sets up logging, once per process; a second call changes nothing.
pub fn init() -> Log {
    let wanted = std::env::var(FILTER_VARIABLE).ok().filter(|text| !text.trim().is_empty());
    let (given, refused) = match wanted.map(|wanted| filter_of(&wanted)).transpose() {
        Ok(given) => (given, None),
        Err(error) => (None, Some(error)),
    };
    let default = if IS_VERBOSE.load(Ordering::Relaxed) { FILTER_VERBOSE } else { FILTER_DEFAULT };
    let filter = given.or_else(|| default.parse().ok()).unwrap_or_default();
    let journal = std::env::var_os("JOURNAL_STREAM").and_then(|_| tracing_journald::layer().ok());
    let registry = tracing_subscriber::registry().with(filter);
    // An error means that logging is set up already, for example by a test.
    let log = match journal {
        Some(journal) => {
            let _set = registry.with(journal).try_init();
            Log { writer: None }
        }
        None => {
            let colours = io::stderr().is_terminal();
            let started = writer();
            let _set = match &started {
                Some((lines, _)) => {
                    let lines = lines.clone();
                    registry.with(fmt::layer().with_writer(move || lines.clone()).with_ansi(colours)).try_init()
                }
                None => registry.with(fmt::layer().with_writer(io::stderr).with_ansi(colours)).try_init(),
            };
            if started.is_none() {
                tracing::warn!(
                    "no thread can be started for the log, so what is logged may hold up what acts; is a limit on tasks set too low?"
                );
            }
            let writer = started.map(|(_, writer)| writer);
            if let Some(writer) = &writer {
                let _earlier = WRITER.set(writer.clone());
            }
            Log { writer }
        }
    };
    if let Some(error) = refused {
        tracing::warn!(%error, "{FILTER_VARIABLE} is no filter of logs, so the default holds; write for instance warn or info,roomcast=debug");
    }
    log
}

/// Sends lines to the thread that writes them. If the queue is full, a line is lost.
#[derive(Debug, Clone)]
struct Lines(Sender<Vec<u8>>);

impl Write for Lines {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        // An empty line is the end.
        if !line.is_empty() {
            let _lost = self.0.try_send(line.to_vec());
        }
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[derive(Debug, Clone)]
struct Writer {
    lines: Sender<Vec<u8>>,
    ended: Receiver<()>,
}

impl Writer {
    fn finish(&self) {
        if self.lines.send_timeout(Vec::new(), LAST_LINES).is_ok() {
            // When the channel closes, the thread has ended.
            let _ended = self.ended.recv_timeout(LAST_LINES);
        }
    }
}

fn writer() -> Option<(Lines, Writer)> {
    let (lines, waiting) = bounded::<Vec<u8>>(LINES_MAX);
    let (end, ended) = bounded::<()>(1);
    let write = move || {
        let _end = end;
        for line in waiting.iter().take_while(|line| !line.is_empty()) {
            // A full disk, or a pipe without a reader: the line is lost.
            let _lost = io::stderr().write_all(&line);
        }
    };
    std::thread::Builder::new().name("log".to_owned()).spawn(write).ok()?;
    Some((Lines(lines.clone()), Writer { lines, ended }))
}

/// An error with its causes, in one line.
#[must_use]
pub fn chain(error: &dyn std::error::Error) -> String {
    let mut said = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let text = error.to_string();
        // Many errors quote their cause already.
        if !said.contains(&text) {
            said = format!("{said}: {text}");
        }
        cause = error.source();
    }
    said
}

/// Lets one message per interval through, and some at once after a silence; counts the others.
#[derive(Debug)]
pub struct Limiter {
    interval_ns: u64,
    /// The time by which messages may be early, a multiple of the interval.
    ahead_ns: u64,
    next_ns: BootNs,
    held: u64,
}

impl Limiter {
    /// One message per `interval_ns`.
    #[must_use]
    pub fn new(interval_ns: u64) -> Self {
        Self::with_burst(interval_ns, 1)
    }

    /// One message per `interval_ns` over time, with a burst of `burst`.
    #[must_use]
    pub(crate) fn with_burst(interval_ns: u64, burst: u64) -> Self {
        Self { interval_ns, ahead_ns: interval_ns.saturating_mul(burst.saturating_sub(1)), next_ns: BootNs(0), held: 0 }
    }

    /// `None` to hold the message back. To log it, the number of messages held back since the last one.
    pub fn pass(&mut self, now_ns: BootNs) -> Option<u64> {
        if now_ns.saturating_add(self.ahead_ns) < self.next_ns {
            self.held += 1;
            return None;
        }
        self.next_ns = self.next_ns.max(now_ns).saturating_add(self.interval_ns);
        Some(std::mem::take(&mut self.held))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_filter_is_read_and_a_misspelt_level_is_refused() {
        let default: Targets = FILTER_DEFAULT.parse().unwrap();
        assert!(default.would_enable("roomcast_services::daemon", &tracing::Level::INFO));
        assert!(!default.would_enable("roomcast_services::daemon", &tracing::Level::DEBUG));
        assert!(!default.would_enable("llama-cpp-2", &tracing::Level::INFO));
        assert!(!default.would_enable("rumqttc::state", &tracing::Level::WARN));
        let verbose: Targets = FILTER_VERBOSE.parse().unwrap();
        assert!(verbose.would_enable("roomcast_services::daemon", &tracing::Level::DEBUG));
        assert!(!verbose.would_enable("rumqttc::state", &tracing::Level::WARN));
        assert!(filter_of("info,roomcast=loud").is_err() && filter_of("info,roomcast[step]=debug").is_err());
        let spaced = filter_of(" info , roomcast_services=debug,").unwrap();
        assert!(spaced.would_enable("roomcast_services::daemon", &tracing::Level::DEBUG));
        assert!(spaced.would_enable("rumqttc", &tracing::Level::INFO));
    }

    #[test]
    fn the_writer_ends_when_its_lines_are_written_and_later_lines_are_lost_without_a_wait() {
        let (mut lines, writer) = writer().unwrap();
        lines.write_all(b"the last line\n").unwrap();
        drop(writer);
        for _ in 0..2 * LINES_MAX {
            lines.write_all(b"too late\n").unwrap();
        }
    }

    #[test]
    fn a_flood_of_messages_is_one_line_per_interval() {
        let mut limiter = Limiter::new(100);
        let passed: Vec<_> = (0..250).filter_map(|now| limiter.pass(BootNs(now))).collect();
        assert_eq!(passed, [0, 99, 99]);
    }

    #[test]
    fn a_few_messages_come_at_once_and_a_flood_does_not() {
        let mut limiter = Limiter::with_burst(100, 3);
        let mut passed =
            |from: u64, until: u64| (from..until).filter_map(|now| limiter.pass(BootNs(now))).collect::<Vec<_>>();
        assert_eq!(passed(1000, 1250), [0, 0, 0, 97, 99]);
        // A silence fills it up again, and no more than that.
        assert_eq!(passed(9000, 9003), [49, 0, 0]);
        assert_eq!(passed(9003, 9100), Vec::<u64>::new());
    }
}
