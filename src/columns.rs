//! How lines fit into a terminal.

use std::io::{self, IsTerminal};

/// How wide the terminal is; any width where there is none.
pub(crate) fn columns() -> usize {
    let size = io::stdout().is_terminal().then(crossterm::terminal::size).and_then(Result::ok);
    // A terminal that does not know says 0.
    size.map(|(columns, _)| usize::from(columns)).filter(|columns| *columns > 0).unwrap_or(usize::MAX)
}

/// The longest line of prose, where the terminal has room for more.
const PROSE: usize = 125;

/// A text for the terminal, each of its lines wrapped between words.
pub(crate) fn prose(text: &str) -> String {
    let columns = columns().min(PROSE);
    text.lines().map(|line| wrapped(line, columns, 0)).collect::<Vec<_>>().join("\n")
}

/// A line as several of so many columns, broken between words; those after the first begin with `indent` spaces.
pub(crate) fn wrapped(line: &str, columns: usize, indent: usize) -> String {
    let mut text = String::new();
    let mut rest = line.to_owned();
    loop {
        let fits = cut(&rest, columns);
        let words = fits.rfind(' ').filter(|at| !fits[..*at].trim_start().is_empty());
        let (false, Some(at)) = (fits.len() == rest.len(), words) else {
            // It fits, or has no gap: the terminal breaks it.
            text.push_str(&rest);
            return text;
        };
        // A word that ends where the line does is whole.
        let at = if rest[fits.len()..].starts_with(' ') { fits.len() } else { at };
        text.push_str(rest[..at].trim_end());
        text.push('\n');
        rest = format!("{:indent$}{}", "", rest[at..].trim_start());
    }
}

/// As much of a line as fits into so many columns.
pub(crate) fn cut(line: &str, columns: usize) -> String {
    let mut line = line.to_owned();
    while ratatui::text::Line::raw(&line).width() > columns {
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
        assert_eq!(wrapped("", 0, 0), "");
    }

    #[test]
    fn lines_are_cut_by_the_columns_that_they_take() {
        assert_eq!(cut("kitchen ███", 20), "kitchen ███");
        assert_eq!(cut("kitchen ███", 9), "kitchen █");
        assert_eq!(cut("厨房", 3), "厨");
    }
}
