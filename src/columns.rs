//! Text in the width of the terminal.

use std::io::{self, IsTerminal};

use textwrap::{Options, WordSeparator, WordSplitter, WrapAlgorithm};

/// The terminal's width; unlimited without a terminal.
pub(crate) fn columns() -> usize {
    let size = io::stdout().is_terminal().then(|| rustix::termios::tcgetwinsize(io::stdout())).and_then(Result::ok);
    // A terminal of unknown width reports 0.
    size.map(|size| usize::from(size.ws_col)).filter(|columns| *columns > 0).unwrap_or(usize::MAX)
}

/// Longest line of prose in a wider terminal.
const PROSE: usize = 125;

pub(crate) fn prose(text: &str) -> String {
    wrapped(text, columns().min(PROSE), 0)
}

/// Wraps a text between words; continuation lines are indented by `indent` spaces. A longer word is left for the terminal to break.
pub(crate) fn wrapped(text: &str, columns: usize, indent: usize) -> String {
    let indent = " ".repeat(indent);
    let line = |line: &str| {
        let words = line.trim_start_matches(' ');
        let options = Options::new(columns)
            .initial_indent(&line[..line.len() - words.len()])
            .subsequent_indent(&indent)
            .break_words(false)
            .word_separator(WordSeparator::AsciiSpace)
            .word_splitter(WordSplitter::NoHyphenation)
            .wrap_algorithm(WrapAlgorithm::FirstFit);
        textwrap::wrap(words, options).join("\n")
    };
    text.split('\n').map(line).collect::<Vec<_>>().join("\n")
}

pub(crate) fn cut(line: &str, columns: usize) -> String {
    let mut line = line.to_owned();
    while textwrap::core::display_width(&line) > columns {
        line.pop();
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_break_between_words() {
        assert_eq!(wrapped("one two three", 20, 0), "one two three");
        assert_eq!(wrapped("one two three", 7, 0), "one two\nthree");
        assert_eq!(wrapped("one two three", 8, 0), "one two\nthree");
        assert_eq!(wrapped("one two three", 6, 0), "one\ntwo\nthree");
        assert_eq!(wrapped("     3 s  robot goes on", 16, 10), "     3 s  robot\n          goes\n          on");
        assert_eq!(wrapped("indivisible", 4, 0), "indivisible", "the terminal breaks it");
        assert_eq!(wrapped("mqtt://a.very.long.name is no broker", 10, 0), "mqtt://a.very.long.name\nis no\nbroker");
        assert_eq!(wrapped("one two\n three-four\n\n", 8, 0), "one two\n three-four\n\n");
        assert_eq!(wrapped("厨房 客厅", 6, 0), "厨房\n客厅", "by the columns that they take");
        assert_eq!(wrapped("", 0, 0), "");
    }

    #[test]
    fn lines_are_cut_by_the_columns_that_they_take() {
        assert_eq!(cut("kitchen ███", 20), "kitchen ███");
        assert_eq!(cut("kitchen ███", 9), "kitchen █");
        assert_eq!(cut("厨房", 3), "厨");
    }
}
