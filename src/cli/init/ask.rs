//! Questions on a terminal. Without a terminal there are no questions.

use std::io::{self, BufRead, IsTerminal, Write};

use crate::cli::Failure;
use crate::columns::prose;
use crate::exit_code;
use roomcast_core::text::{visible, visible_lines};

pub(super) struct Asker {
    terminal: Option<Terminal>,
}

struct Terminal {
    input: Box<dyn BufRead>,
    output: Box<dyn Write>,
}

impl Asker {
    /// Asks if both ends are a terminal, unless `silent`.
    pub(super) fn new(silent: bool) -> Self {
        let asks = !silent && io::stdin().is_terminal() && io::stdout().is_terminal();
        let terminal = || Terminal { input: Box::new(io::BufReader::new(io::stdin())), output: Box::new(io::stdout()) };
        Self { terminal: asks.then(terminal) }
    }

    #[cfg(test)]
    pub(super) fn of(input: impl BufRead + 'static, output: impl Write + 'static) -> Self {
        Self { terminal: Some(Terminal { input: Box::new(input), output: Box::new(output) }) }
    }

    /// Prints a wrapped text if questions are asked.
    pub(super) fn say(&mut self, text: &str) -> Result<(), Failure> {
        let Some(Terminal { output, .. }) = &mut self.terminal else { return Ok(()) };
        // Parts of the text are untrusted, for instance topics.
        writeln!(output, "{}", prose(&visible_lines(text))).and_then(|()| output.flush()).map_err(failed)
    }

    /// The answer to a question, or the default for an empty line; `None` if no questions are asked.
    pub(super) fn text(&mut self, question: &str, default: &str) -> Result<Option<String>, Failure> {
        self.say(question)?;
        let Some(Terminal { input, output, .. }) = &mut self.terminal else { return Ok(None) };
        let shown = if default.is_empty() { String::new() } else { format!("[{}] ", visible(default)) };
        write!(output, "  {shown}> ").and_then(|()| output.flush()).map_err(failed)?;
        let mut line = String::new();
        if input.read_line(&mut line).map_err(failed)? == 0 {
            let text = "the answers ended before the questions; nothing was written";
            return Err(Failure::interrupted(text));
        }
        let answer = line.trim();
        Ok(Some(if answer.is_empty() { default.to_owned() } else { answer.to_owned() }))
    }

    /// The value of an answer. After a fault the reason is printed, and the question asked again. `None` if no questions are asked.
    pub(super) fn until<T>(
        &mut self,
        question: &str,
        default: &str,
        mut take: impl FnMut(&mut Self, &str) -> Result<T, Failure>,
    ) -> Result<Option<T>, Failure> {
        loop {
            let Some(answer) = self.text(question, default)? else { return Ok(None) };
            match take(self, &answer) {
                Ok(taken) => return Ok(Some(taken)),
                // The input has ended.
                Err(failure) if failure.code == exit_code::INTERRUPTED => return Err(failure),
                Err(failure) => self.say(&format!("{failure}.\n"))?,
            }
        }
    }

    /// Yes or no; `None` if no questions are asked.
    pub(super) fn yes_or_no(&mut self, question: &str, default: bool) -> Result<Option<bool>, Failure> {
        let shown = if default { "yes" } else { "no" };
        self.until(question, shown, |_, answer| match answer.to_lowercase().as_str() {
            "y" | "yes" => Ok(true),
            "n" | "no" => Ok(false),
            _ => Err(Failure::input("answer yes or no")),
        })
    }
}

fn failed(error: io::Error) -> Failure {
    Failure::failed(format!("cannot ask: {error}; give --yes and the options"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asker(answers: &'static str) -> Asker {
        Asker::of(answers.as_bytes(), io::sink())
    }

    #[test]
    fn an_empty_line_takes_the_default() {
        let mut asker = asker("\n  mine \ny\n\nno\n");
        assert_eq!(asker.text("Which?", "theirs").unwrap().as_deref(), Some("theirs"));
        assert_eq!(asker.text("Which?", "theirs").unwrap().as_deref(), Some("mine"));
        assert_eq!(
            [true, false, true].map(|default| asker.yes_or_no("Sure?", default).unwrap()),
            [Some(true), Some(false), Some(false)]
        );
        assert!(asker.text("More?", "").unwrap_err().to_string().contains("nothing was written"));
    }

    /// A broker's topics may contain such characters.
    #[test]
    fn a_question_moves_no_cursor() {
        #[derive(Clone, Default)]
        struct Shown(std::rc::Rc<std::cell::RefCell<Vec<u8>>>);
        impl Write for Shown {
            fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
                self.0.borrow_mut().write(bytes)
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let shown = Shown::default();
        let mut asker = Asker::of(&b"\n"[..], shown.clone());
        let topic = "\u{1b}]0;x\u{7}rob/one";
        assert_eq!(asker.text(&format!("Under {topic}?"), topic).unwrap().as_deref(), Some(topic));
        let shown = String::from_utf8(shown.0.borrow().clone()).unwrap();
        assert_eq!(shown, "Under \\u001b]0;x\\u0007rob/one?\n  [\\u001b]0;x\\u0007rob/one] > ");
    }

    #[test]
    fn a_wrong_answer_is_asked_again_and_the_end_of_answers_is_the_end() {
        let mut asker = asker("maybe\nYES\nsix\n7\nsix\n");
        assert_eq!(asker.yes_or_no("Sure?", false).unwrap(), Some(true));
        let number =
            |_: &mut Asker, text: &str| text.parse::<u32>().map_err(|_| Failure::input(format!("{text} is no number")));
        assert_eq!(asker.until("How many?", "", number).unwrap(), Some(7));
        assert_eq!(asker.until("How many?", "", number).unwrap_err().code, exit_code::INTERRUPTED);
    }

    #[test]
    fn whoever_is_no_terminal_is_asked_nothing() {
        let mut asker = Asker { terminal: None };
        assert_eq!((asker.text("Which?", "x").unwrap(), asker.yes_or_no("Sure?", true).unwrap()), (None, None));
    }
}
