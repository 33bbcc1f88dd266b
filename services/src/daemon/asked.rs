//! Reads questions and remembers answers: an asker without an answer asks again, and the change must not be made twice.

use std::collections::VecDeque;
use std::fmt::Display;

use serde::Serialize;
use serde::de::DeserializeOwned;

/// Most bytes of the name of a question.
pub const QUESTION_NAME_BYTES_MAX: usize = 128;
/// Remembered answers of one service.
pub const ANSWERS_REMEMBERED: usize = 64;
/// Most characters of a reason, which may quote the question.
const REASON_CHARS_MAX: usize = 1000;

pub(super) trait Question: DeserializeOwned {
    /// The name of a question that asks for a change. The same name gets the same answer, without a second change.
    fn id(&self) -> Option<&str>;
}

pub(super) trait Answer: Clone + Serialize {
    /// The reason for a refusal.
    fn reason(&mut self) -> &mut Option<String>;
}

fn read<Q: Question>(asked: Result<&str, impl Display>) -> Result<Q, String> {
    let text = asked.map_err(|error| error.to_string())?;
    // serde also accepts a list of values in place of keys and values.
    if !text.trim_start().starts_with('{') {
        return Err("it does not begin with `{`: give keys and values".to_owned());
    }
    let parser = &mut serde_json::Deserializer::from_str(text);
    let question: Q = serde_path_to_error::deserialize(&mut *parser).map_err(|error| error.to_string())?;
    parser.end().map_err(|error| error.to_string())?;
    match question.id().map(str::len) {
        Some(bytes) if bytes > QUESTION_NAME_BYTES_MAX => {
            Err(format!("id has {bytes} bytes, and at most {QUESTION_NAME_BYTES_MAX} are allowed: give a shorter one"))
        }
        _ => Ok(question),
    }
}

fn short(reason: &str) -> String {
    reason.chars().take(REASON_CHARS_MAX).collect()
}

/// The newest answers by the names of their questions.
#[derive(Debug)]
pub(super) struct Answered<T>(VecDeque<(String, T)>);

impl<T> Default for Answered<T> {
    fn default() -> Self {
        Self(VecDeque::new())
    }
}

impl<T: Answer> Answered<T> {
    /// Answers a question in JSON: with the remembered answer of the same name, otherwise with `answer`, which also gets a fault of the question.
    pub(super) fn answer<Q: Question>(
        &mut self,
        asked: Result<&str, impl Display>,
        answer: impl FnOnce(Result<Q, String>) -> T,
    ) -> String {
        let question = read::<Q>(asked);
        let id = question.as_ref().ok().and_then(Question::id).map(str::to_owned);
        let known = id.as_deref().and_then(|id| self.get(id)).cloned();
        let answer = known.unwrap_or_else(|| {
            let mut answer = answer(question);
            let reason = answer.reason();
            *reason = reason.take().map(|reason| short(&reason));
            if let Some(id) = id {
                self.put(id, answer.clone());
            }
            answer
        });
        serde_json::to_string(&answer).unwrap_or_default()
    }
}

impl<T> Answered<T> {
    pub(super) fn cut(&mut self, cut: impl FnMut(&mut T)) {
        self.0.iter_mut().map(|(_, answer)| answer).for_each(cut);
    }

    pub(super) fn cut_before_last(&mut self, cut: impl FnMut(&mut T)) {
        let before = self.0.len().saturating_sub(1);
        self.0.iter_mut().take(before).map(|(_, answer)| answer).for_each(cut);
    }

    fn get(&self, id: &str) -> Option<&T> {
        self.0.iter().find(|(known, _)| known == id).map(|(_, answer)| answer)
    }

    /// Drops the oldest answer if there are too many.
    fn put(&mut self, id: String, answer: T) {
        if self.0.len() == ANSWERS_REMEMBERED {
            self.0.pop_front();
        }
        self.0.push_back((id, answer));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::daemon::{HabitsQuestion, MapQuestion, PersonAnswer, PersonQuestion};

    #[test]
    fn an_answer_is_remembered_until_64_others_are() {
        let mut answered = Answered::default();
        for number in 0..=ANSWERS_REMEMBERED {
            answered.put(number.to_string(), number);
        }
        assert_eq!((answered.get("3"), answered.get("0")), (Some(&3), None), "the oldest gave way");
    }

    /// A forgotten person is in no earlier answer.
    #[test]
    fn remembered_answers_can_be_cut_but_for_the_last() {
        let mut answered = Answered::default();
        for number in 1..=3 {
            answered.put(number.to_string(), number);
        }
        answered.cut_before_last(|answer| *answer = 0);
        assert_eq!(["1", "2", "3"].map(|id| *answered.get(id).unwrap()), [0, 0, 3]);
        answered.cut(|answer| *answer = 0);
        assert_eq!(["1", "2", "3"].map(|id| *answered.get(id).unwrap()), [0, 0, 0]);
    }

    #[test]
    fn a_question_with_something_behind_it_is_refused() {
        let of = |text: &str| read::<PersonQuestion>(Ok::<_, String>(text)).is_ok();
        assert!(of(r#" {"ask": "list"} "#));
        for behind in ["x", "{}", ",", r#"{"ask": "forget", "id": "1", "who": "ada"}"#] {
            assert!(!of(&format!(r#"{{"ask": "list"}} {behind}"#)), "{behind}");
        }
    }

    /// `["forget", "7"]` forgot all habits.
    #[test]
    fn a_list_is_no_question() {
        for list in [r#"["forget", "7"]"#, " [\"list\"]", "[]", "\"list\"", "3", ""] {
            assert!(read::<HabitsQuestion>(Ok::<_, String>(list)).is_err(), "{list}");
            assert!(read::<PersonQuestion>(Ok::<_, String>(list)).is_err(), "{list}");
        }
    }

    /// The names count as memory: 64 answers with names of a megabyte took 64 MB for each service.
    #[test]
    fn a_question_with_a_long_name_is_refused() {
        fn of<Q: Question>(question: &str) {
            let with = |bytes: usize| question.replace("NAME", &"n".repeat(bytes));
            let refused = |text: String| read::<Q>(Ok::<_, String>(text.as_str())).err();
            assert_eq!(refused(with(QUESTION_NAME_BYTES_MAX)), None, "{question}");
            let reason = refused(with(QUESTION_NAME_BYTES_MAX + 1)).unwrap();
            assert_eq!(reason, "id has 129 bytes, and at most 128 are allowed: give a shorter one");
        }
        of::<MapQuestion>(r#"{"id": "NAME", "changes": []}"#);
        of::<PersonQuestion>(r#"{"ask": "forget", "id": "NAME", "who": "ada"}"#);
        of::<HabitsQuestion>(r#"{"ask": "forget", "id": "NAME"}"#);
    }

    #[test]
    fn a_reason_that_quotes_a_long_question_is_cut() {
        let long = format!("{{\"ask\": \"{}\"}}", "x".repeat(1 << 20));
        let why = |asked: Result<PersonQuestion, String>| PersonAnswer {
            done: false,
            reason: asked.err(),
            failed: false,
            kept: false,
            persons: Vec::new(),
            understood: Vec::new(),
            whereabouts: None,
        };
        let answer = Answered::default().answer(Ok::<_, String>(long.as_str()), why);
        assert!(answer.contains("xxx") && answer.len() < REASON_CHARS_MAX + 100, "{} bytes", answer.len());
    }
}
