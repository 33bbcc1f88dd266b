//! What was read in a text, kept for when it is asked again: each sentence is asked about a score of things, and a home says the same ones day
//! after day.

use std::cell::{Cell, OnceCell, RefCell};
use std::rc::Rc;

use foldhash::{HashMap, HashMapExt};

use super::presence::PresenceStatement;
use super::{clause, several};

/// A thread keeps what it read in so many texts, sentences and clauses; where there are more it begins again. Of the longest ones that is 2 MB.
const KEPT: usize = 512;

/// What the text alone decides, yes or no; the functions say what each means.
#[derive(Debug, Clone, Copy)]
pub(super) enum Fact {
    MaybeSeveral,
    MayHaveCompanions,
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

impl Fact {
    /// Whether it is so of a text and its plain form.
    fn read(self, text: &str, plain: &str) -> bool {
        match self {
            Self::MaybeSeveral => several::may_be_several(text),
            Self::MayHaveCompanions => clause::may_have_companions(plain),
            Self::IsArrival => clause::is_arrival(plain),
            Self::IsOfAnEnd => clause::is_of_an_end(plain),
            Self::IsFromAfar => clause::is_from_afar(plain),
            Self::MayBeElsewhere => clause::may_be_elsewhere(plain),
            Self::IsOfAPronoun => clause::is_of_a_pronoun(plain),
            Self::IsDeedOfGuests => clause::is_deed_of_guests(plain),
            Self::IsDeedOfAll => clause::is_deed_of_all(plain),
            Self::GoesHome => clause::goes_home(plain),
            Self::IsVisit => clause::is_visit(plain),
            Self::IsOfWhatWasLeft => clause::is_of_what_was_left(plain),
            Self::IsOfANewGuest => clause::is_of_a_new_guest(plain),
            Self::IsOwnArrival => clause::is_own_arrival(plain),
            Self::GoesToAnOffice => clause::goes_to_an_office(plain),
            Self::MovesNobody => with_plain(several::sentences(text).next().unwrap_or_default(), clause::moves_nobody),
            Self::IsSpeech => clause::is_speech(plain),
        }
    }
}

/// What was read in one text so far.
#[derive(Debug)]
struct Reading {
    /// In lower case, with short forms written out.
    plain: Box<str>,
    /// A bit for each fact that was asked for, and one for each that is so.
    asked: Cell<u32>,
    so: Cell<u32>,
    statement: OnceCell<Option<PresenceStatement>>,
}

thread_local! {
    static READINGS: RefCell<HashMap<Box<str>, Rc<Reading>>> = RefCell::new(HashMap::with_capacity(KEPT));
}

fn of(text: &str) -> Rc<Reading> {
    if let Some(known) = READINGS.with_borrow(|readings| readings.get(text).map(Rc::clone)) {
        return known;
    }
    let plain = clause::plain(text).into_boxed_str();
    let reading = Rc::new(Reading { plain, asked: Cell::new(0), so: Cell::new(0), statement: OnceCell::new() });
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

/// Whether something is so of a text.
pub(super) fn is(fact: Fact, text: &str) -> bool {
    let (reading, bit) = (of(text), 1 << fact as u32);
    if reading.asked.get() & bit == 0 {
        let so = if fact.read(text, &reading.plain) { bit } else { 0 };
        reading.so.set(reading.so.get() | so);
        reading.asked.set(reading.asked.get() | bit);
    }
    reading.so.get() & bit != 0
}

/// What a text says of where its persons are, if it says that.
pub(super) fn statement(text: &str) -> Option<PresenceStatement> {
    let reading = of(text);
    reading.statement.get_or_init(|| PresenceStatement::of_plain(&reading.plain)).clone()
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
                assert!(!is(Fact::IsOfAPronoun, &text) && is(Fact::IsOfAPronoun, &format!("She sits {number}.")));
                assert!(is(Fact::MayBeElsewhere, &other), "{other}");
                assert_eq!(statement("Ada leaves the house.").unwrap().subject(), Some("ada"));
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
