//! Atomic actions in VirtualHome's notation, `[PutBack] <plate> (1) <table> (2)`, and the sentence each stands for.

use super::{TextError, check_control, refused};
use crate::text::nearest;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::OnceLock;

use serde::Deserialize;

use crate::names::Names;

/// Longest line that is read, in bytes. A VirtualHome step has fewer than 100.
pub const LINE_BYTES_MAX: usize = 1024;
/// Longest name of an object, in bytes.
const NAME_BYTES_MAX: usize = 128;
/// Most objects of one action; no VirtualHome action has more.
const OBJECTS_MAX: usize = 2;

/// An object as a program names it: class name and the number that tells two of a kind apart.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ObjectRef {
    /// Lower-case class name as written, underscores included ("coffe_maker").
    pub name: String,
    /// Which one of that class. Of `(1.205)`, as in scripts bound to a scene, the second number, which is the scene's own.
    pub id: u32,
}

impl ObjectRef {
    /// The words a language model knows it by ("coffee maker").
    #[must_use]
    pub fn words(&self) -> String {
        Names::built_in().words(&self.name)
    }
}

impl fmt::Display for ObjectRef {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "<{}> ({})", self.name, self.id)
    }
}

/// One atomic action: a known verb and at most two objects.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Action {
    verb: &'static str,
    objects: Vec<ObjectRef>,
}

/// The words and the typical duration of one action: an entry of `actions.toml`; its header documents the keys.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct ActionEntry {
    /// "put"
    pub base: String,
    /// "puts"
    pub third: String,
    /// What follows the verb with no, one and two objects; `{0}` and `{1}` are the objects' words.
    pub tails: [String; OBJECTS_MAX + 1],
    /// How long the action typically takes, walking to its object not counted, in seconds.
    pub duration_s: f64,
}

/// Every known action, by lower-case name.
#[must_use]
pub fn table() -> &'static BTreeMap<String, ActionEntry> {
    static TABLE: OnceLock<BTreeMap<String, ActionEntry>> = OnceLock::new();
    #[expect(clippy::expect_used, reason = "the table is part of the program, and a test reads it")]
    TABLE.get_or_init(|| toml::from_str(include_str!("actions.toml")).expect("actions.toml is well formed"))
}

impl Action {
    /// Reads one line, `[Verb] <object> (id) <object> (id)`; case and space around the parts do not matter.
    ///
    /// # Errors
    /// [`TextError`] says at which column the notation is left, or which action is unknown.
    pub fn parse(line: &str) -> Result<Self, TextError> {
        if line.len() > LINE_BYTES_MAX {
            let bytes = line.len();
            return refused(format!(
                "the line has {bytes} bytes, more than {LINE_BYTES_MAX}: one action per line is expected"
            ));
        }
        check_control(line, "the line", |c| c == '\t')?;
        let mut rest = line;
        let written = bracketed(line, &mut rest, ['[', ']'], "`[action]`")?;
        let name: String = written.chars().filter(|c| !matches!(c, ' ' | '_')).flat_map(char::to_lowercase).collect();
        let Some((verb, _)) = table().get_key_value(&name) else {
            let hint = match nearest(&name, table().keys().map(String::as_str)) {
                Some(name) => format!("did you mean `{name}`?"),
                None => "give one of VirtualHome's, such as `walk`, `grab`, `putback` or `switchon`; narration may be a plain sentence, too"
                    .to_owned(),
            };
            return refused(format!("unknown action `{written}`: {hint}"));
        };
        let mut objects = Vec::new();
        while !rest.is_empty() {
            let name = bracketed(line, &mut rest, ['<', '>'], "`<object>` or the end of the line")?.to_lowercase();
            let number = bracketed(line, &mut rest, ['(', ')'], "`(number)`")?;
            let own = number.rsplit('.').next().unwrap_or(number).trim();
            let Ok(id) = own.parse() else { return refused(format!("`({number})` is not a number below 2^32")) };
            objects.push(ObjectRef { name, id });
        }
        if objects.len() > OBJECTS_MAX {
            let objects = objects.len();
            return refused(format!("`{verb}` cannot have {objects} objects: at most {OBJECTS_MAX} are known"));
        }
        Ok(Self { verb, objects })
    }

    /// Lower-case name of the action, a key of [`table`].
    #[must_use]
    pub fn verb(&self) -> &'static str {
        self.verb
    }

    /// Its objects, in the order written.
    #[must_use]
    pub fn objects(&self) -> &[ObjectRef] {
        &self.objects
    }

    /// Its words and duration.
    #[must_use]
    pub fn entry(&self) -> &'static ActionEntry {
        // The verb was found in the table when the action was made.
        &table()[self.verb]
    }

    /// The narration of the completed action: "They put the plate on the table."
    #[must_use]
    pub fn sentence(&self) -> String {
        let entry = self.entry();
        let mut tail = entry.tails[self.objects.len()].clone();
        for (hole, object) in ["{0}", "{1}"].iter().zip(&self.objects) {
            tail = tail.replace(hole, &object.words());
        }
        format!("They {}{}{tail}.", entry.base, if tail.is_empty() { "" } else { " " })
    }
}

impl fmt::Display for Action {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "[{}]", self.verb)?;
        self.objects.iter().try_for_each(|object| write!(f, " {object}"))
    }
}

/// The text between two brackets at the start of the rest of a line. The rest is what stands behind.
fn bracketed<'a>(line: &str, rest: &mut &'a str, brackets: [char; 2], expected: &str) -> Result<&'a str, TextError> {
    let from = rest.trim_start();
    let is_name =
        |text: &str| !text.is_empty() && text.len() <= NAME_BYTES_MAX && !text.contains(['<', '>', '[', ']', '(', ')']);
    let parts = from.strip_prefix(brackets[0]).and_then(|own| own.split_once(brackets[1]));
    let Some((text, behind)) = parts.filter(|(text, _)| is_name(text.trim())) else {
        let column = line[..line.len() - from.len()].chars().count() + 1;
        return refused(format!("expected {expected} at column {column}: an action reads `[Grab] <mug> (1)`"));
    };
    *rest = behind.trim_start();
    Ok(text.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_and_prints_the_notation() {
        let action = Action::parse(" [PutBack]  <Plate> (1) <table> (22) ").unwrap();
        assert_eq!(action.verb(), "putback");
        assert_eq!(action.objects()[1], ObjectRef { name: "table".into(), id: 22 });
        assert_eq!(action.to_string(), "[putback] <plate> (1) <table> (22)");
        assert_eq!(Action::parse(&action.to_string()).unwrap(), action);
        assert_eq!(Action::parse("[StandUp]").unwrap().objects(), []);
        assert_eq!(Action::parse("[walk] <kitchen> (1.205)").unwrap().objects()[0].id, 205);
    }

    #[test]
    fn says_what_is_wrong_and_where() {
        const FAULTS: &str = "[Grab <mug> (1) = `[action]` at column 1|[Grab] mug = column 8|[Grab] <mug> = `(number)`|\
            [Grab] <mug> (-1) = a number|[Grabb] <mug> (1) = did you mean `grab`|[Teleport] <mug> (1) = action `Teleport`|\
            [Grab] <a> (1) <b> (1) <c> (1) = 3 objects|[Grab] <mu\u{1b}g> (1) = U+001B| = `[action]`";
        for (line, fault) in FAULTS.split('|').map(|row| row.split_once(" = ").unwrap()) {
            let error = Action::parse(line).unwrap_err().to_string();
            assert!(error.contains(fault), "{line}: {error}");
        }
        assert!(Action::parse(&"[".repeat(5000)).unwrap_err().to_string().contains("5000 bytes"));
    }

    #[test]
    fn every_action_has_a_sentence_for_each_number_of_objects() {
        assert!(table().len() >= 60);
        for (verb, entry) in table() {
            assert!(entry.duration_s.is_finite() && entry.duration_s >= 0.0, "{verb}");
            for line in [format!("[{verb}]"), format!("[{verb}] <mug> (1)"), format!("[{verb}] <mug> (1) <table> (1)")]
            {
                let sentence = Action::parse(&line).unwrap().sentence();
                assert!(sentence.starts_with("They ") && sentence.ends_with('.'), "{line}: {sentence}");
                assert!(!sentence.contains(['{', '}', '_']) && !sentence.contains("  "), "{line}: {sentence}");
            }
        }
        assert_eq!(Action::parse("[Grab] <mug> (1)").unwrap().sentence(), "They grab the mug.");
    }
}
