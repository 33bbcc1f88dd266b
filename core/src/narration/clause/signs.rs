//! Signs that a few words give: reported, quoted, unreal, of the past, doubtful, denied.

use super::words::{WORDS, has};

/// Whether words after a subject say what was: "was in the kitchen".
pub(in crate::narration) fn is_past_state(rest: &str) -> bool {
    ["was ", "were ", "had been ", "has been "].iter().any(|verb| rest.starts_with(verb))
}

/// Whether words after a subject say what is not done now: "does not sit down", "wants to go to the kitchen", "went there yesterday".
pub(in crate::narration) fn is_unreal(rest: &str) -> bool {
    WORDS.unreal.after(rest).any(|more| more.is_empty() || more.starts_with(' '))
        || rest.ends_with('?')
        || ["yesterday", "last night", "last week", "ago"].iter().any(|past| rest.ends_with(past))
}

/// A plain sentence without the words before its subject that say only when.
pub(in crate::narration) fn without_first(said: &str) -> &str {
    let mut said = said;
    while let Some(rest) = [&WORDS.first, &WORDS.between]
        .into_iter()
        .flat_map(|words| words.after(said))
        .find_map(|rest| rest.strip_prefix([' ', ',']))
    {
        said = rest.trim_start();
    }
    said
}

/// Whether no word makes doubtful what was said.
pub(super) fn is_said(words: &str) -> bool {
    !words.split(' ').any(|word| has(&WORDS.not_said, word))
}

/// What is said of a group without that it is denied, which is said of all of it: "both are not home".
pub(super) fn denied(rest: &str) -> &str {
    ["are not ", "is not "].iter().find_map(|verb| rest.strip_prefix(verb)).unwrap_or(rest)
}

/// Whether what is said of a group may not be so, or not of all of it: "everybody leaves tonight", "nobody is home, is it?".
pub(super) fn is_doubtful(rest: &str) -> bool {
    let mut words = rest.split([' ', ',', ':']);
    rest.ends_with('?')
        || words.any(|word| has(&WORDS.doubtful, word) || has(&WORDS.speaks, word) || has(&WORDS.reports, word))
}

/// Whether a text ends within quotation marks.
pub(in crate::narration) fn is_quoted(text: &str) -> bool {
    text.matches('"').count() % 2 == 1 || text.matches('“').count() > text.matches('”').count()
}

/// Whether words tell what somebody says, thinks or asks, or under which condition something holds.
pub(in crate::narration) fn is_reported(text: &str) -> bool {
    let mut words = text.split([' ', ',']).peekable();
    let mut is_report = || {
        while let Some(word) = words.next() {
            // Who says goodbye tells of nothing.
            if has(&WORDS.reports, word) && !words.peek().is_some_and(|next| has(&WORDS.greetings, next)) {
                return true;
            }
        }
        false
    };
    text.contains(['"', '“', ':']) || is_report()
}
