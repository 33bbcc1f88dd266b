//! Writes an MCAP file with messages of any type.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::{McapError, WriteOptions, Writer};
use roomcast_core::ids::{BootNs, UnixNs};

use super::RecordingError;

/// The encoding of a channel's messages.
pub(super) struct Form<'a> {
    /// The type's name.
    pub name: &'a str,
    pub schema_encoding: &'a str,
    /// Its schema.
    pub schema: &'a str,
    pub message_encoding: &'a str,
    /// Further data about the channel.
    pub metadata: BTreeMap<String, String>,
}

/// The time of receipt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Received {
    /// By the wall clock.
    pub unix_ns: UnixNs,
    /// By the monotonic clock, at the same time.
    pub monotonic_ns: BootNs,
}

pub(super) struct Tape {
    writer: Writer<BufWriter<File>>,
    path: PathBuf,
    written: u64,
    begun: Option<Received>,
}

fn unwritten(path: &Path, error: McapError) -> RecordingError {
    let source = match error {
        McapError::Io(source) => source,
        other => std::io::Error::other(other),
    };
    RecordingError::Write(path.to_owned(), source)
}

impl Tape {
    /// Creates the file; an existing one is not overwritten.
    pub(super) fn create(path: &Path, profile: &str) -> Result<Self, RecordingError> {
        let file = File::create_new(path).map_err(|source| match source.kind() {
            std::io::ErrorKind::AlreadyExists => RecordingError::Exists(path.to_owned()),
            _ => RecordingError::Io(path.to_owned(), source),
        })?;
        let library = concat!("roomcast ", env!("CARGO_PKG_VERSION"));
        let writer = WriteOptions::new().profile(profile).library(library).create(BufWriter::new(file));
        let writer = writer.map_err(|error| unwritten(path, error))?;
        Ok(Self { writer, path: path.to_owned(), written: 0, begun: None })
    }

    fn done<T>(&self, result: Result<T, McapError>) -> Result<T, RecordingError> {
        result.map_err(|error| unwritten(&self.path, error))
    }

    pub(super) fn channel(&mut self, topic: &str, form: &Form<'_>) -> Result<u16, RecordingError> {
        let schema = self.writer.add_schema(form.name, form.schema_encoding, form.schema.as_bytes());
        let schema = self.done(schema)?;
        let channel = self.writer.add_channel(schema, topic, form.message_encoding, &form.metadata);
        self.done(channel)
    }

    /// The time of a receipt in the file. It starts by the wall clock and continues by the monotonic one. A set wall clock, as on a robot
    /// that finds the network after its start, would create gaps or overlaps.
    pub(super) fn time_ns(&mut self, received: Received) -> UnixNs {
        let begun = *self.begun.get_or_insert(received);
        begun.unix_ns.saturating_add(received.monotonic_ns.since(begun.monotonic_ns))
    }

    pub(super) fn write(&mut self, header: &MessageHeader, data: &[u8]) -> Result<(), RecordingError> {
        self.write_uncounted(header, data)?;
        self.written += 1;
        Ok(())
    }

    pub(super) fn write_uncounted(&mut self, header: &MessageHeader, data: &[u8]) -> Result<(), RecordingError> {
        let written = self.writer.write_to_known_channel(header, data);
        self.done(written)
    }

    pub(super) fn tell(&mut self, metadata: &Metadata) -> Result<(), RecordingError> {
        let told = self.writer.write_metadata(metadata);
        self.done(told)
    }

    pub(super) fn written(&self) -> u64 {
        self.written
    }

    pub(super) fn flush(&mut self) -> Result<(), RecordingError> {
        let flushed = self.writer.flush();
        self.done(flushed)
    }

    pub(super) fn finish(&mut self) -> Result<(), RecordingError> {
        let finished = self.writer.finish();
        self.done(finished).map(|_| ())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_no_damaged_recording() {
        let full = std::io::Error::from(std::io::ErrorKind::StorageFull);
        let said = crate::logging::chain(&unwritten(Path::new("day.mcap"), McapError::Io(full)));
        assert!(said.starts_with("failed to write the recording day.mcap: no storage space; make room"), "{said}");
        assert!(!said.contains("damaged") && said.matches("no storage space").count() == 1, "{said}");
    }
}
