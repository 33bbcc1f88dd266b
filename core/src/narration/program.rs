//! Activity programs: VirtualHome's text format of title, description and steps.

use std::path::Path;

use super::{Action, TextError, refused};
use crate::text::read_text_at_most;

/// Largest program file that is read, in bytes. The longest of VirtualHome's has 7 KiB.
pub const PROGRAM_BYTES_MAX: usize = 1 << 20;
/// Most steps of one program.
pub const STEPS_MAX: usize = 10_000;
/// Most lines left out of one program that its notes name.
const NOTES_MAX: usize = 20;
/// The latest minute of a day of activities, counted from the day's midnight. Activities may go on into the next day.
pub const DAY_MINUTES_MAX: u32 = 48 * 60;

/// Whether the text has the headings of HOMER+'s days, which no program has before its steps.
#[must_use]
pub fn looks_like_a_day(text: &str) -> bool {
    text.lines().any(|line| line.starts_with("### "))
}

/// An activity as a sequence of atomic actions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Program {
    /// First line: "Make coffee".
    pub title: String,
    /// The lines after the title, joined by spaces; may be empty.
    pub description: String,
    /// In order; never empty.
    pub steps: Vec<Action>,
    /// Lines left out because they cannot be read, one sentence each, with the line's number.
    pub notes: Vec<String>,
}

impl Program {
    /// Reads a program: the title, the description, then one action per line. Empty lines and, after the first step,
    /// lines that open with `#` are skipped. A line that cannot be read is left out, with a note.
    ///
    /// # Errors
    /// [`TextError`] names the line.
    pub fn parse(text: &str) -> Result<Self, TextError> {
        if text.len() > PROGRAM_BYTES_MAX {
            return too_large(text.len() as u64);
        }
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let mut lines = text.lines().enumerate().map(|(index, line)| (index + 1, line.trim()));
        let no_title = |found: &str| {
            refused(format!(
                "line 1: expected the activity's title, found {found}: a program opens with a title, a description and an empty line"
            ))
        };
        let title = match lines.next() {
            Some((_, "")) | None => return no_title("nothing"),
            Some((_, line)) if line.starts_with('[') => return no_title("a step"),
            Some((_, line)) => line.to_owned(),
        };
        let is_day = looks_like_a_day(text);
        let mut description = String::new();
        let mut steps = Vec::new();
        let (mut notes, mut unnamed, mut first_fault) = (Vec::new(), 0, None);
        for (line, text) in lines {
            if text.is_empty() || (text.starts_with('#') && !steps.is_empty()) {
                continue;
            }
            if steps.is_empty() && notes.is_empty() && !text.starts_with('[') {
                if !description.is_empty() {
                    description.push(' ');
                }
                description.push_str(text);
                continue;
            }
            if steps.len() == STEPS_MAX {
                return refused(format!("line {line}: more than {STEPS_MAX} steps: split the program"));
            }
            match Action::parse(text) {
                Ok(step) => steps.push(step),
                Err(_) if is_day => {
                    return refused(format!(
                        "line {line} is none of a program's, and the file looks like a day in HOMER+'s format, with activities and times: \
                         `roomcast-lab` reads days, other commands programs in VirtualHome's format"
                    ));
                }
                Err(fault) => {
                    if notes.len() < NOTES_MAX {
                        notes.push(format!("line {line} is left out: {fault}"));
                    } else {
                        unnamed += 1;
                    }
                    first_fault.get_or_insert(TextError(format!("line {line}: {fault}")));
                }
            }
        }
        if steps.is_empty() {
            let none =
                || TextError(format!("the program `{title}` has no step: add lines such as `[Walk] <kitchen> (1)`"));
            return Err(first_fault.unwrap_or_else(none));
        }
        if unnamed > 0 {
            notes.push(format!("{unnamed} more lines are left out"));
        }
        Ok(Self { title, description, steps, notes })
    }

    /// Reads a program from a file.
    ///
    /// # Errors
    /// As [`Program::parse`], with the path, and what reading the file gives.
    pub fn load(path: &Path) -> Result<Self, TextError> {
        // As much of it as shows that it is too long.
        let read = match read_text_at_most(path, PROGRAM_BYTES_MAX as u64) {
            Ok(text) => Self::parse(&text),
            Err(error) if error.kind() == std::io::ErrorKind::FileTooLarge => {
                too_large(std::fs::metadata(path).map_or(0, |file| file.len()).max(PROGRAM_BYTES_MAX as u64 + 1))
            }
            Err(error) => {
                return refused(format!("failed to read the activity program {}: {error}", path.display()));
            }
        };
        read.map_err(|fault| TextError(format!("{}: {fault}", path.display())))
    }
}

fn too_large<T>(bytes: u64) -> Result<T, TextError> {
    refused(format!("the program has {bytes} bytes, more than {PROGRAM_BYTES_MAX}: split it"))
}

impl std::fmt::Display for Program {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(f, "{}\n{}\n\n", self.title, self.description)?;
        self.steps.iter().try_for_each(|step| writeln!(f, "{step}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COFFEE: &str = "Make coffee\nI make coffee.\nSlowly.\n\n\n[Walk] <kitchen> (1)\n\n[Grab] <mug> (1)\n";

    #[test]
    fn reads_and_prints_a_program() {
        let program = Program::parse(COFFEE).unwrap();
        assert_eq!(program.title, "Make coffee");
        assert_eq!(program.description, "I make coffee. Slowly.");
        assert_eq!(program.steps.len(), 2);
        assert_eq!(Program::parse(&program.to_string()).unwrap(), program);
        assert_eq!(Program::parse(&COFFEE.replace('\n', "\r\n")).unwrap(), program);
    }

    #[test]
    fn names_the_line_of_a_fault() {
        let error = |text: &str| Program::parse(text).unwrap_err().to_string();
        assert!(error("Title\ndescription\n\n[Walk] <kitchen>\n").starts_with("line 4: expected `(number)`"));
        let day = "wake_up (06:00 - 06:10)\n\n### wake_up-00.txt\n\n[WALK] <bedroom> (162) [1]\n370.0\n";
        assert!(error(day).starts_with("line 5") && error(day).contains("HOMER+"), "{}", error(day));
        assert!(error("[Walk] <kitchen> (1)").contains("found a step"));
        assert!(error("").contains("found nothing"));
        assert!(error("Title only").contains("no step"));
        assert!(error(&" ".repeat(PROGRAM_BYTES_MAX + 1)).contains("split it"));
        assert!(error(&format!("T\n{}", "[sleep]\n".repeat(STEPS_MAX + 1))).contains("more than 10000 steps"));
        assert!(Program::load(Path::new("/nowhere")).unwrap_err().to_string().contains("/nowhere"));
    }

    #[test]
    fn lines_that_cannot_be_read_are_left_out_with_a_note() {
        let laugh = Program::parse("Have fun\nWe laugh.\n\n[Laugh]\n[LookAt_Short] <tv> (1)\n").unwrap();
        assert_eq!((laugh.notes.len(), laugh.steps[0].sentence().as_str()), (0, "They laugh."));
        let program = Program::parse("Have fun\n\n[Levitate] <sofa> (1)\n[Walk] <sofa> (1)\n[Teleport]\n").unwrap();
        assert_eq!(program.steps.len(), 1);
        assert_eq!(program.notes.len(), 2);
        assert!(program.notes[0].starts_with("line 3 is left out: unknown action `Levitate`"), "{:?}", program.notes);
        let error = Program::parse("Have fun\n\n[Levitate]\n").unwrap_err().to_string();
        assert!(error.starts_with("line 3: unknown action `Levitate`"), "{error}");
        let program = Program::parse("Rest\n\n[Walk] <sofa> (1)\nnot a step\n[Sit] <sofa> 1)\n").unwrap();
        assert!(program.notes[0].starts_with("line 4 is left out: expected `[`"), "{:?}", program.notes);
        assert!(program.notes[1].starts_with("line 5 is left out: expected `(number)`"), "{:?}", program.notes);
        let many = Program::parse(&format!("Title\n\n[Walk]\n{}", "[Levitate]\n".repeat(30))).unwrap();
        assert_eq!((many.notes.len(), &many.notes[20][..7]), (21, "10 more"));
    }

    #[test]
    fn reads_every_program_of_the_shared_collection() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/virtualhome/programs");
        if !folder.exists() {
            crate::skipped::skipped(format_args!("{} is missing", folder.display()));
            return;
        }
        let (mut folders, mut read, mut failed) = (vec![folder], 0, Vec::new());
        while let Some(folder) = folders.pop() {
            let paths = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
            let (inner, files): (Vec<_>, Vec<_>) = paths.partition(|path| path.is_dir());
            folders.extend(inner);
            for path in files.iter().filter(|path| path.extension().is_some_and(|ending| ending == "txt")) {
                read += 1;
                failed.extend(Program::load(path).err());
            }
        }
        assert!(read > 2000);
        assert!(failed.is_empty(), "{} of {read}: {:?}", failed.len(), &failed[..failed.len().min(5)]);
    }
}
