//! Activity programs: VirtualHome's text format of title, description and steps.

use std::path::Path;

use super::{Action, TextError, refused};
use crate::text::{read_text_at_most, without_mark};

/// Largest program file that is read, in bytes. The longest of VirtualHome's has 7 KiB.
pub const PROGRAM_BYTES_MAX: usize = 1 << 20;
/// Most steps of one program.
pub const STEPS_MAX: usize = 10_000;

/// An activity as a sequence of atomic actions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Program {
    /// First line: "Make coffee".
    pub title: String,
    /// In order; never empty.
    pub steps: Vec<Action>,
    /// A sentence for each line that is no action and is left out, with the line's number.
    pub notes: Vec<String>,
}

impl Program {
    /// Reads a program: the title, a description up to the first line that opens with `[`, then one action per line. Between actions, empty lines and
    /// lines that open with `#` are skipped. A line that is no action is left out, with a note.
    ///
    /// # Errors
    /// [`TextError`] names the line.
    pub fn parse(text: &str) -> Result<Self, TextError> {
        if text.len() > PROGRAM_BYTES_MAX {
            let bytes = text.len();
            return refused(format!("the program has {bytes} bytes, more than {PROGRAM_BYTES_MAX}: split it"));
        }
        let mut lines = (1..).zip(without_mark(text).lines().map(str::trim)).peekable();
        let title = lines.next().map_or("", |(_, line)| line);
        if title.is_empty() || title.starts_with('[') {
            let found = if title.is_empty() { "nothing" } else { "a step" };
            return refused(format!(
                "line 1: expected the activity's title, found {found}: a program opens with a title, a description and an empty line"
            ));
        }
        while lines.next_if(|(_, line)| !line.starts_with('[')).is_some() {}
        let (mut steps, mut notes) = (Vec::new(), Vec::new());
        for (line, step) in lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#')) {
            if steps.len() + notes.len() == STEPS_MAX {
                return refused(format!("line {line}: more than {STEPS_MAX} steps: split the program"));
            }
            match Action::parse(step) {
                Ok(step) => steps.push(step),
                Err(fault) => notes.push(format!("line {line} is left out: {fault}")),
            }
        }
        if steps.is_empty() {
            let day = if text.contains("\n### ") { " (`roomcast-lab` reads days in HOMER+'s format)" } else { "" };
            let why = notes.first().map_or("add lines such as `[Walk] <kitchen> (1)`", |note| note);
            return refused(format!("the program `{title}` has no step{day}: {why}"));
        }
        Ok(Self { title: title.to_owned(), steps, notes })
    }

    /// Reads a program from a file.
    ///
    /// # Errors
    /// As [`Program::parse`], with the path, and what reading the file gives.
    pub fn load(path: &Path) -> Result<Self, TextError> {
        let unread = |error| TextError(format!("failed to read the activity program {}: {error}", path.display()));
        let text = read_text_at_most(path, PROGRAM_BYTES_MAX as u64).map_err(unread)?;
        Self::parse(&text).map_err(|fault| TextError(format!("{}: {fault}", path.display())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_is_its_title_and_its_actions() {
        const COFFEE: &str = "\u{feff}Make coffee\nI make coffee.\n# Slowly.\n\n[Walk] <kitchen> (1)\n\n# Then\n[Grab] <mug> (1)\n[Laugh]\n";
        for text in [COFFEE.to_owned(), COFFEE.replace('\n', "\r\n")] {
            let program = Program::parse(&text).unwrap();
            let steps: Vec<_> = program.steps.iter().map(Action::sentence).collect();
            assert_eq!(program.title, "Make coffee");
            assert_eq!(steps, ["They walk to the kitchen.", "They grab the mug.", "They laugh."]);
        }
    }

    #[test]
    fn a_line_that_is_no_action_is_left_out_with_a_note() {
        let Program { steps, notes, .. } =
            Program::parse("Rest\n\n[Fly] <sofa> (1)\n[Walk] <sofa> (1)\nno step\n").unwrap();
        assert!(steps.len() == 1 && notes.len() == 2, "{notes:?}");
        assert!(notes[0].starts_with("line 3 is left out: unknown action `Fly`"), "{notes:?}");
        assert!(notes[1].starts_with("line 5 is left out: expected `["), "{notes:?}");
    }

    #[test]
    fn an_error_names_the_line() {
        for (text, parts) in [
            (
                "Title\ndescription\n\n[Walk] <kitchen>\n",
                ["the program ", "no step: line 4 is left out: expected `(number)`"],
            ),
            ("[Walk] <kitchen> (1)", ["line 1: ", "found a step"]),
            ("", ["line 1: ", "found nothing"]),
            ("Title only", ["the program ", "no step"]),
            (&" ".repeat(PROGRAM_BYTES_MAX + 1), ["the program ", "split it"]),
            (&format!("T\n{}", "[sleep]\n".repeat(STEPS_MAX + 1)), ["line 10002: ", "more than 10000 steps"]),
        ] {
            let error = Program::parse(text).unwrap_err().to_string();
            assert!(error.starts_with(parts[0]) && error.contains(parts[1]), "{error}");
        }
        assert!(Program::load(Path::new("/nowhere")).unwrap_err().to_string().contains("/nowhere"));
    }

    #[test]
    fn reads_every_program_of_the_shared_collection() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/virtualhome/programs");
        if !folder.exists() {
            crate::skipped::skipped(format_args!("{} is missing", folder.display()));
            return;
        }
        fn load(folder: &Path) -> Vec<Result<Program, TextError>> {
            let paths = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
            let of = |path: std::path::PathBuf| if path.is_dir() { load(&path) } else { vec![Program::load(&path)] };
            paths
                .filter(|path| path.is_dir() || path.extension().is_some_and(|ending| ending == "txt"))
                .flat_map(of)
                .collect()
        }
        let (read, failed): (Vec<_>, Vec<_>) = load(&folder).into_iter().partition(Result::is_ok);
        assert!(read.len() > 2000 && failed.is_empty(), "{} of {}: {:?}", failed.len(), read.len(), failed.first());
    }
}
