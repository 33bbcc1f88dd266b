//! Reads and writes the files of the commands for scenes.

use std::collections::HashMap;
use std::path::Path;

use roomcast_core::grounding::{Grounding, GroundingOptions, PartitionLevel};
use roomcast_core::semantic_map::import::{self, ImportError};
use roomcast_core::semantic_map::{SceneError, SemanticMap, read_limited};
use roomcast_core::text::read_text_at_most;
use roomcast_services::sensor_log::RULES_BYTES_MAX;
use roomcast_services::{logging, setup, state_file};

use super::{CommandResult, Failure};

pub(super) fn input(error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Failure {
    Failure::input(error)
}

pub(super) fn in_file(what: &str, path: &Path, error: &dyn std::error::Error) -> Failure {
    input(format!("{what} {}: {}", path.display(), logging::chain(error)))
}

/// A fault of a robot's map, or of the file with the names of its segments.
pub(super) fn in_map(map: &Path, names: Option<&Path>, error: &ImportError) -> Failure {
    match (error, names) {
        (ImportError::Names { .. }, Some(names)) => in_file("names", names, error),
        _ => in_file("map", map, error),
    }
}

pub(super) fn read(what: &str, path: &Path) -> Result<String, Failure> {
    read_limited(path).map_err(|error| match &error {
        SceneError::Read(inner) if inner.kind() == std::io::ErrorKind::InvalidData => {
            input(format!("{what} {}: it is no text: unpack it, or give another file", path.display()))
        }
        error => in_file(what, path, error),
    })
}

/// The names of a map's segments. The size limit is the same as for rules, so a map that is given by mistake is refused at once.
pub(super) fn segment_names(path: &Path) -> Result<HashMap<String, String>, Failure> {
    let fault = |error: std::io::Error| {
        input(format!("names {}: {error}; give a file with lines as 11 = \"kitchen\"", path.display()))
    };
    let text = read_text_at_most(path, RULES_BYTES_MAX).map_err(fault)?;
    import::segment_names(&text).map_err(|error| in_file("names", path, &error))
}

/// Writes a new file and renames it, so that no reader sees half a file. Links and FIFOs are refused.
pub(super) fn write(path: &Path, bytes: &[u8]) -> CommandResult {
    let fail = |error: std::io::Error| {
        let is_refused = error.kind() == std::io::ErrorKind::Other;
        // tempfile's errors end with the temporary file's name.
        let said = error.to_string();
        let (path, error) = (path.display(), said.rsplit_once(" at path ").map_or(&said[..], |(said, _)| said));
        // A refused place has its own remedy.
        let remedy = if is_refused { "" } else { "; check the folder and its permissions" };
        Failure::failed(format!("cannot write {path}: {error}{remedy}"))
    };
    state_file::write_out(path, bytes).map_err(fail)
}

pub(super) fn load(path: &Path, level: PartitionLevel) -> Result<(SemanticMap, Grounding), Failure> {
    let map = setup::load_map(Some(path))?;
    let grounding = Grounding::new(&map, &GroundingOptions { level, room_labels: true })?;
    Ok((map, grounding))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_names_the_file_that_was_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("nowhere/plan.svg");
        let error = write(&path, b"<svg/>").unwrap_err().to_string();
        let path = path.display();
        let fault = "No such file or directory (os error 2); check the folder and its permissions";
        assert_eq!(error, format!("cannot write {path}: {fault}"));
        let link = folder.path().join("link");
        std::os::unix::fs::symlink("plan.svg", &link).unwrap();
        let error = write(&link, b"<svg/>").unwrap_err().to_string();
        assert_eq!(
            error,
            format!("cannot write {}: a symbolic link is there; give the name of a file", link.display())
        );
    }
}
