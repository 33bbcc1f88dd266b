//! Days of a simulated household in HOMER+'s format: activities one after another, each action with the minute it was done.
//!
//! A day opens with its schedule. Each activity begins with `### name.txt`; an action reads `[GRAB] <mug> (12) [3]` and the
//! line after it gives minutes since midnight. Everything else (`## ...`, graph changes, sensor lines) is skipped.

use std::path::Path;

use roomcast_core::narration::{Action, PROGRAM_BYTES_MAX, Program, STEPS_MAX, TextError};

/// The latest minute of a day of activities, counted from the day's midnight. Activities may go on into the next day.
pub const DAY_MINUTES_MAX: u32 = 48 * 60;
/// Largest file of a day, in bytes. The longest of HOMER+ have 200 KiB.
pub const DAY_BYTES_MAX: usize = 16 * PROGRAM_BYTES_MAX;

/// An action of a day.
#[derive(Debug, Clone, PartialEq)]
pub struct TimedAction {
    /// The activity ("wake_up-00").
    pub activity: String,
    /// The action.
    pub action: Action,
    /// The time when it was complete, in minutes since midnight. It does not decrease, and exceeds 1440 after midnight.
    pub done_min: f64,
}

/// A day of one person.
#[derive(Debug, Clone, PartialEq)]
pub struct Day {
    /// In order; never empty.
    pub actions: Vec<TimedAction>,
}

impl Day {
    /// Whether the text is a day and not a program.
    #[must_use]
    pub fn recognise(text: &str) -> bool {
        text.lines().any(|line| line.starts_with("### "))
    }

    /// Reads a day. An action without a time gets the time of the previous action; the first action needs one.
    ///
    /// # Errors
    /// [`TextError`] names the line.
    pub fn parse(text: &str) -> Result<Self, TextError> {
        if text.len() > DAY_BYTES_MAX {
            return too_large(text.len() as u64);
        }
        let mut actions: Vec<TimedAction> = Vec::new();
        let mut activity = String::new();
        let (mut now_min, mut awaits_time) = (0.0, false);
        let mut untimed = None;
        for (index, text) in text.lines().enumerate() {
            let (line, text) = (index + 1, text.trim());
            if let Some(name) = text.strip_prefix("### ") {
                name.trim_end_matches(".txt").clone_into(&mut activity);
            } else if text.starts_with('[') {
                if actions.len() == STEPS_MAX {
                    return Err(TextError(format!("line {line}: more than {STEPS_MAX} steps: split the day")));
                }
                // The count at the end of the line is not part of VirtualHome's notation.
                let notation = match text.rfind(" [") {
                    Some(at) => &text[..at],
                    None => text,
                };
                let action = Action::parse(notation).map_err(|fault| TextError(format!("line {line}: {fault}")))?;
                if actions.is_empty() {
                    untimed = Some(line);
                } else if let Some(line) = untimed {
                    return Err(without_time(line));
                }
                actions.push(TimedAction { activity: activity.clone(), action, done_min: now_min });
                awaits_time = true;
            } else if awaits_time
                && let Ok(minute) = text.parse::<f64>()
                && minute.is_finite()
                && let Some(last) = actions.last_mut()
            {
                if minute > f64::from(DAY_MINUTES_MAX) {
                    return Err(TextError(format!(
                        "line {line}: minute {minute} of the day, more than {DAY_MINUTES_MAX}: give minutes since midnight"
                    )));
                }
                now_min = minute.max(now_min);
                last.done_min = now_min;
                (awaits_time, untimed) = (false, None);
            }
        }
        if actions.is_empty() {
            return Err(TextError("the day has no step: add lines such as `[WALK] <kitchen> (1)`".into()));
        }
        if let Some(line) = untimed {
            return Err(without_time(line));
        }
        Ok(Self { actions })
    }

    /// The day's actions as one program.
    #[must_use]
    pub fn program(&self, title: &str) -> Program {
        let steps = self.actions.iter().map(|timed| timed.action.clone()).collect();
        Program { title: title.to_owned(), steps, notes: Vec::new() }
    }
}

fn too_large<T>(bytes: u64) -> Result<T, TextError> {
    Err(TextError(format!("the day has {bytes} bytes, more than {DAY_BYTES_MAX}: split it")))
}

fn without_time(line: usize) -> TextError {
    TextError(format!(
        "line {line}: the first action has no time, as in a program of one activity: give a day in HOMER+'s format, with minutes since \
         midnight below each action"
    ))
}

/// Reads a file that holds an activity program or a day.
///
/// # Errors
/// As [`Program::load`] and [`Day::parse`].
pub fn load_any(path: &Path) -> Result<Program, TextError> {
    let unread = |error| TextError(format!("failed to read the activity program {}: {error}", path.display()));
    let within = |fault| TextError(format!("{}: {fault}", path.display()));
    let bytes = std::fs::metadata(path).map_err(unread)?.len();
    if bytes > DAY_BYTES_MAX as u64 {
        return too_large(bytes).map_err(within);
    }
    let text = std::fs::read_to_string(path).map_err(unread)?;
    if Day::recognise(&text) {
        let title = path.file_stem().unwrap_or_default().to_string_lossy();
        return Ok(Day::parse(&text).map_err(within)?.program(&title));
    }
    Program::parse(&text).map_err(within)
}

#[cfg(test)]
mod tests {
    use super::*;

    const DAY: &str = "wake_up (06:00 - 06:10)\n\n### wake_up-00.txt\n\n[WALK] <bedroom> (162) [1]\n370.0\n## Wakeup until 06:10\n\n\
        ### brush.txt\n\n[GRAB] <toothbrush> (1204) [4]\n371.0\n[WALK] <sink> (17) [5]\n<<Graph Changes>>\n   - a ON b\n\
        373.0: tooth_paste moved\n[STANDUP]  [6]\n372.0\n";

    #[test]
    fn a_day_is_read_with_its_times() {
        assert!(Day::recognise(DAY) && !Day::recognise("T\nd\n\n[Sleep]"));
        let day = Day::parse(DAY).unwrap();
        let times: Vec<_> = day.actions.iter().map(|a| (a.activity.as_str(), a.action.verb(), a.done_min)).collect();
        assert_eq!(
            times,
            [
                ("wake_up-00", "walk", 370.0),
                ("brush", "grab", 371.0),
                ("brush", "walk", 371.0),
                ("brush", "standup", 372.0)
            ]
        );
        assert_eq!(day.program("x").steps.len(), 4);
    }

    #[test]
    fn faults_are_named_by_line() {
        assert!(
            Day::parse("### a\n[FLY] <x> (1) [1]\n").unwrap_err().to_string().starts_with("line 2: unknown action")
        );
        assert!(Day::parse("### a\n").unwrap_err().to_string().contains("no step"));
        // A program of one activity has no times.
        for steps in ["[SIT] <x> (1)", "[SIT] <x> (1) [1]\n[SIT] <y> (2) [2]\n370.0"] {
            let fault = Day::parse(&format!("Sit\nOn a chair.\n\n{steps}\n")).unwrap_err().to_string();
            assert!(fault.starts_with("line 4: the first action has no time"), "{fault}");
        }
        // A day ends after midnight, and not in the year 19 000.
        let ends = |minute: &str| Day::parse(&format!("### a\n[SIT] <x> (1) [1]\n{minute}\n"));
        assert!(ends("1670.5").is_ok() && ends("2880").is_ok());
        assert!(ends("1e13").unwrap_err().to_string().starts_with("line 3: minute 10000000000000"));
    }

    #[test]
    fn reads_every_shared_day() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/homer_plus");
        if !folder.exists() {
            crate::skipped::skipped(format_args!("{} is missing", folder.display()));
            return;
        }
        let mut read = 0;
        for household in ["HouseholdA", "HouseholdB"] {
            for entry in std::fs::read_dir(folder.join(household).join("scripts_test")).unwrap() {
                let path = entry.unwrap().path();
                if path.extension().is_some_and(|e| e == "txt") {
                    load_any(&path).unwrap();
                    read += 1;
                }
            }
        }
        assert_eq!(read, 20);
    }
}
