//! Questions on a terminal; whoever is no terminal is asked nothing.

use std::io::{self, BufRead, IsTerminal, Write};

use crate::cli::Failure;
use crate::exit_code;

/// Asks, or does not.
pub(super) struct Asker {
    terminal: Option<Box<dyn BufRead>>,
}

impl Asker {
    /// One that asks where both ends are a terminal, unless it is to ask nothing.
    pub(super) fn new(silent: bool) -> Self {
        let asks = !silent && io::stdin().is_terminal() && io::stdout().is_terminal();
        Self { terminal: asks.then(|| Box::new(io::BufReader::new(io::stdin())) as Box<dyn BufRead>) }
    }

    /// Whether it asks anything.
    pub(super) fn asks(&self) -> bool {
        self.terminal.is_some()
    }

    /// The answer to a question, the default where the line is empty; none where nothing is asked.
    pub(super) fn text(&mut self, question: &str, default: &str) -> Result<Option<String>, Failure> {
        let Some(terminal) = &mut self.terminal else { return Ok(None) };
        let shown = if default.is_empty() { String::new() } else { format!(" [{default}]") };
        let failed = |error: io::Error| {
            Failure::new(exit_code::FAILURE, format!("cannot ask: {error}; give --yes and the options"))
        };
        let mut out = io::stdout().lock();
        write!(out, "{question}{shown}: ").and_then(|()| out.flush()).map_err(failed)?;
        let mut line = String::new();
        if terminal.read_line(&mut line).map_err(failed)? == 0 {
            return Err(Failure::new(
                exit_code::INTERRUPTED,
                "the answers ended before the questions; nothing was written",
            ));
        }
        let answer = line.trim();
        Ok(Some(if answer.is_empty() { default.to_owned() } else { answer.to_owned() }))
    }

    /// Yes or no; none where nothing is asked.
    pub(super) fn yes_or_no(&mut self, question: &str, default: bool) -> Result<Option<bool>, Failure> {
        let hint = if default { "Y/n" } else { "y/N" };
        let answer = self.text(&format!("{question} {hint}"), "")?;
        Ok(answer.map(|answer| match answer.to_lowercase().as_str() {
            "y" | "yes" => true,
            "n" | "no" => false,
            _ => default,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asker(answers: &'static str) -> Asker {
        Asker { terminal: Some(Box::new(answers.as_bytes())) }
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

    #[test]
    fn whoever_is_no_terminal_is_asked_nothing() {
        let mut asker = Asker { terminal: None };
        assert_eq!((asker.text("Which?", "x").unwrap(), asker.yes_or_no("Sure?", true).unwrap()), (None, None));
    }
}
