//! What was read in a text, kept for when it is asked again: each sentence is asked about a score of things, and a home says the same ones day
//! after day.

use std::cell::{Cell, RefCell};
use std::rc::Rc;

use foldhash::{HashMap, HashMapExt};

use super::clause;

/// A thread keeps what it read in so many texts, sentences and clauses; where there are more it begins again. Of the longest ones that is 2 MB.
const KEPT: usize = 512;

/// What the text alone decides, yes or no; who asks says how it is read, always in the same way.
#[derive(Debug, Clone, Copy)]
pub(super) enum Fact {
    MaybeSeveral,
    IsStatement,
    IsArrival,
    IsOfAnEnd,
    IsFromAfar,
    MayBeElsewhere,
    IsOfAPronoun,
    IsDeedOfGuests,
    IsDeedOfAll,
    GoesHome,
    IsVisit,
    IsOfWhatWasLeft,
    IsOfANewGuest,
    IsOwnArrival,
    GoesToAnOffice,
    MovesNobody,
    IsSpeech,
}

/// What was read in one text so far.
#[derive(Debug)]
struct Reading {
    /// In lower case, with short forms written out.
    plain: Box<str>,
    /// A bit for each fact that was asked for, and one for each that is so.
    asked: Cell<u32>,
    so: Cell<u32>,
}

thread_local! {
    static READINGS: RefCell<HashMap<Box<str>, Rc<Reading>>> = RefCell::new(HashMap::with_capacity(KEPT));
}

fn of(text: &str) -> Rc<Reading> {
    if let Some(known) = READINGS.with_borrow(|readings| readings.get(text).map(Rc::clone)) {
        return known;
    }
    let plain = clause::plain(text).into_boxed_str();
    let reading = Rc::new(Reading { plain, asked: Cell::new(0), so: Cell::new(0) });
    READINGS.with_borrow_mut(|readings| {
        if readings.len() == KEPT {
            readings.clear();
        }
        readings.insert(text.into(), Rc::clone(&reading));
    });
    reading
}

/// Reads a text in lower case, with short forms written out: "Ada isn't home." is "ada is not home".
pub(super) fn with_plain<T>(text: &str, read: impl FnOnce(&str) -> T) -> T {
    read(&of(text).plain)
}

/// Whether something is so of a text, as `read` finds it in its plain form the first time.
pub(super) fn is(fact: Fact, text: &str, read: impl FnOnce(&str) -> bool) -> bool {
    let (reading, bit) = (of(text), 1 << fact as u32);
    if reading.asked.get() & bit == 0 {
        let so = if read(&reading.plain) { bit } else { 0 };
        reading.so.set(reading.so.get() | so);
        reading.asked.set(reading.asked.get() | bit);
    }
    reading.so.get() & bit != 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_texts_than_are_kept_are_read_all_the_same() {
        for turn in 0..2 {
            for number in 0..2 * KEPT {
                let (text, other) = (format!("Ada LEAVES room {number}."), format!("Ada is at the gym {number}."));
                assert_eq!(with_plain(&text, str::to_owned), format!("ada leaves room {number}"), "{turn}");
                for _ in 0..2 {
                    assert!(is(Fact::MayBeElsewhere, &other, clause::may_be_elsewhere), "{other}");
                    assert!(!is(Fact::IsOfAPronoun, &text, clause::is_of_a_pronoun), "{text}");
                }
            }
        }
        assert!(READINGS.with_borrow(HashMap::len) <= KEPT);
    }

    /// A clause is read while its sentence is.
    #[test]
    fn a_text_is_read_while_it_is_read() {
        let text = "Mia isn't home.";
        with_plain(text, |plain| with_plain(text, |again| assert_eq!((plain, again), ("mia is not home", plain))));
    }
}
