//! Atomic actions in VirtualHome's notation, `[PutBack] <plate> (1) <table> (2)`, and the sentence each stands for.

use crate::text::{is_hidden, nearest};
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

/// Why a line is no action.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ActionError {
    /// The line is longer than [`LINE_BYTES_MAX`].
    #[error("the line has {bytes} bytes, more than {LINE_BYTES_MAX}: one action per line is expected")]
    TooLong {
        /// Its length.
        bytes: usize,
    },
    /// A control character, which no notation needs.
    #[error("the line holds the control character U+{code:04X}: remove it")]
    Control {
        /// Its code point.
        code: u32,
    },
    /// The text does not follow the notation.
    #[error("expected {expected} at column {column}: an action reads `[Grab] <mug> (1)`")]
    Notation {
        /// What should stand there.
        expected: &'static str,
        /// Column in characters, from 1.
        column: usize,
    },
    /// The action is unknown.
    #[error("unknown action `{verb}`{}", hint(.nearest))]
    UnknownVerb {
        /// As written.
        verb: String,
        /// The most similar known action, if any is similar.
        nearest: Option<String>,
    },
    /// The action does not take this many objects.
    #[error("`{verb}` cannot have {objects} objects: at most {OBJECTS_MAX} are known")]
    Objects {
        /// The action.
        verb: String,
        /// How many objects the line names.
        objects: usize,
    },
}

fn hint(nearest: &Option<String>) -> String {
    match nearest {
        Some(name) => format!(": did you mean `{name}`?"),
        None => ": give one of VirtualHome's, such as `walk`, `grab`, `putback` or `switchon`; narration may be a plain sentence, too"
            .to_owned(),
    }
}

/// An object as a program names it: class name and the number that tells two of a kind apart.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ObjectRef {
    /// Lower-case class name as written, underscores included ("coffe_maker").
    pub name: String,
    /// Which one of that class. Of the form `(1.205)` that scripts bound to a scene use, the second number, which is
    /// the scene's own.
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
#[serde(deny_unknown_fields)]
pub struct ActionEntry {
    /// "put"
    pub base: String,
    /// "puts"
    pub third: String,
    /// "put"
    pub past: String,
    /// "putting"
    pub ing: String,
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
    /// [`ActionError`] says at which column the notation is left, or which action is unknown.
    pub fn parse(line: &str) -> Result<Self, ActionError> {
        if line.len() > LINE_BYTES_MAX {
            return Err(ActionError::TooLong { bytes: line.len() });
        }
        if let Some(c) = line.chars().find(|c| is_hidden(*c) && *c != '\t') {
            return Err(ActionError::Control { code: c.into() });
        }
        let mut cursor = Cursor { line, rest: line };
        cursor.skip_space();
        cursor.expect('[', "`[`")?;
        let written = cursor.until(']', "the action's name and `]`")?;
        let name: String = written.chars().filter(|c| !matches!(c, ' ' | '_')).flat_map(char::to_lowercase).collect();
        let Some((verb, _)) = table().get_key_value(&name) else {
            return Err(ActionError::UnknownVerb {
                verb: written.to_owned(),
                nearest: nearest(&name, table().keys().map(String::as_str)).map(str::to_owned),
            });
        };
        let mut objects = Vec::new();
        cursor.skip_space();
        while !cursor.rest.is_empty() {
            cursor.expect('<', "`<object>` or the end of the line")?;
            let name = cursor.until('>', "the object's name and `>`")?.to_lowercase();
            cursor.skip_space();
            cursor.expect('(', "`(number)`")?;
            let id = cursor.number()?;
            cursor.skip_space();
            objects.push(ObjectRef { name, id });
        }
        if objects.len() > OBJECTS_MAX {
            return Err(ActionError::Objects { verb: verb.clone(), objects: objects.len() });
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
        let tail = &entry.tails[self.objects.len()];
        let mut sentence = format!("They {}", entry.base);
        if !tail.is_empty() {
            sentence.push(' ');
            let mut rest = tail.as_str();
            while let Some(at) = rest.find('{') {
                let (before, hole) = rest.split_at(at);
                sentence.push_str(before);
                let object = if hole.starts_with("{0}") { self.objects.first() } else { self.objects.get(1) };
                if let Some(object) = object {
                    sentence.push_str(&object.words());
                }
                rest = hole.get(3..).unwrap_or("");
            }
            sentence.push_str(rest);
        }
        sentence.push('.');
        sentence
    }
}

impl fmt::Display for Action {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "[{}]", self.verb)?;
        self.objects.iter().try_for_each(|object| write!(f, " {object}"))
    }
}

struct Cursor<'a> {
    line: &'a str,
    rest: &'a str,
}

impl<'a> Cursor<'a> {
    fn error(&self, expected: &'static str) -> ActionError {
        let read = &self.line[..self.line.len() - self.rest.len()];
        ActionError::Notation { expected, column: read.chars().count() + 1 }
    }

    fn skip_space(&mut self) {
        self.rest = self.rest.trim_start();
    }

    fn expect(&mut self, c: char, expected: &'static str) -> Result<(), ActionError> {
        self.rest = self.rest.strip_prefix(c).ok_or_else(|| self.error(expected))?;
        Ok(())
    }

    /// The non-empty text before `end`, which is consumed too.
    fn until(&mut self, end: char, expected: &'static str) -> Result<&'a str, ActionError> {
        let (text, rest) = self.rest.split_once(end).ok_or_else(|| self.error(expected))?;
        let text = text.trim();
        if text.is_empty() || text.len() > NAME_BYTES_MAX || text.contains(['<', '>', '[', ']', '(', ')']) {
            return Err(self.error(expected));
        }
        self.rest = rest;
        Ok(text)
    }

    fn number(&mut self) -> Result<u32, ActionError> {
        const EXPECTED: &str = "a number below 2^32 and `)`";
        let (text, rest) = self.rest.split_once(')').ok_or_else(|| self.error(EXPECTED))?;
        let own = text.rsplit('.').next().unwrap_or(text);
        let id = own.trim().parse().map_err(|_| self.error(EXPECTED))?;
        self.rest = rest;
        Ok(id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

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
        let error = |line: &str| Action::parse(line).unwrap_err().to_string();
        assert!(error("[Grab <mug> (1)").contains("column 2"), "{}", error("[Grab <mug> (1)"));
        assert!(error("[Grab] mug").contains("column 8"));
        assert!(error("[Grab] <mug>").contains("`(number)`"));
        assert!(error("[Grab] <mug> (-1)").contains("a number"));
        assert!(error("[Grabb] <mug> (1)").contains("did you mean `grab`"));
        assert!(error("[Teleport] <mug> (1)").contains("unknown action `Teleport`"));
        assert!(error("[Grab] <a> (1) <b> (1) <c> (1)").contains("3 objects"));
        assert!(error("[Grab] <mu\u{1b}g> (1)").contains("U+001B"));
        assert!(error(&"[".repeat(5000)).contains("5000 bytes"));
        assert!(error("").contains("`[`"));
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

    proptest! {
        #[test]
        fn hostile_text_never_panics(text in "\\PC{0,80}|[\\[\\]<>() a-z0-9.]{0,60}") {
            let _ = Action::parse(&text);
        }
    }
}
