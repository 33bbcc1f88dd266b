//! Folders of days of activities, in HOMER+'s format.

use std::path::{Path, PathBuf};

use roomcast_simulation::homer::{DAY_BYTES_MAX, Day};

use crate::{Failure, count, report_faults};

/// Sorts names by their numbers: "day 9" before "day 10".
fn in_order(path: &Path) -> Vec<(u64, String)> {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let of_one_kind = |a: &char, b: &char| a.is_ascii_digit() == b.is_ascii_digit();
    let parts = name.chars().collect::<Vec<_>>();
    // Text sorts before any number, and a number that overflows comes last.
    let part = |part: &[char]| {
        let text: String = part.iter().collect();
        let number = part.first().is_some_and(char::is_ascii_digit).then(|| text.parse().unwrap_or(u64::MAX));
        (number.map_or(0, |number: u64| number.saturating_add(1)), text)
    };
    parts.chunk_by(of_one_kind).map(part).collect()
}

/// The days of a folder, in the order of their names. A file counts if it is a day or is named `.txt`.
pub fn read(folder: &Path) -> Result<Vec<Day>, Failure> {
    let fault = |error: String| Failure::input(format!("{}: {error}", folder.display()));
    let entries = std::fs::read_dir(folder).map_err(|error| fault(error.to_string()))?;
    let mut files: Vec<PathBuf> = entries.filter_map(Result::ok).map(|entry| entry.path()).collect();
    files.retain(|path| path.is_file());
    files.sort_by_cached_key(|path| in_order(path));
    let (mut days, mut faults, mut others) = (Vec::new(), Vec::new(), 0);
    for path in files {
        let is_text = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("txt"));
        let too_large = std::fs::metadata(&path).is_ok_and(|file| file.len() > DAY_BYTES_MAX as u64);
        if too_large && !is_text {
            others += 1;
            continue;
        }
        let text = std::fs::read(&path)
            .map_err(|error| Failure::input(format!("failed to read {}: {error}", path.display())))?;
        let text = String::from_utf8_lossy(&text);
        match Day::parse(&text) {
            Ok(day) => days.push(day),
            Err(error) if is_text || Day::recognise(&text) => faults.push(format!("{}: {error}", path.display())),
            Err(_) => others += 1,
        }
    }
    report_faults(&faults);
    if days.is_empty() {
        let others = if others > 0 { format!("; {} in it are none", count(others, "file")) } else { String::new() };
        return Err(fault(format!("no day is in it: give a folder of files in HOMER+'s format{others}")));
    }
    Ok(days)
}
