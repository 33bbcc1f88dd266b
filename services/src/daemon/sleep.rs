//! Whether a person is on a bed or asleep, by the last thing and the words of the action.

use roomcast_core::text::has_words;

const BEDS: [&str; 8] = ["bed", "beds", "mattress", "crib", "cot", "bunk", "futon", "bassinet"];

pub(super) fn is_bed(label: &str) -> bool {
    label.split(' ').next_back().is_some_and(|word| BEDS.contains(&word))
}

/// Whether a text says that a person sleeps, or wakes; `None` for any other text.
pub(super) fn sleeps(text: &str) -> Option<bool> {
    const SLEEPS: [&str; 8] = ["sleep", "sleeps", "asleep", "nap", "naps", "doze", "dozes", "slept"];
    const WAKES: [&str; 8] = ["wake", "wakes", "woke", "awake", "get up", "gets up", "stand up", "stands up"];
    if has_words(text, &WAKES) { Some(false) } else { has_words(text, &SLEEPS).then_some(true) }
}

/// Whether a person can do this without getting up.
pub(super) fn may_be_done_lying(text: &str) -> bool {
    const UPRIGHT: [&str; 44] = [
        "walk", "walks", "go", "goes", "run", "runs", "stand", "stands", "sit", "sits", "open", "opens", "close",
        "closes", "cook", "cooks", "wash", "washes", "wipe", "wipes", "clean", "cleans", "sweep", "sweeps", "mop",
        "mops", "dress", "dresses", "put on", "puts on", "shower", "showers", "enter", "enters", "leave", "leaves",
        "climb", "climbs", "fold", "folds", "make", "makes", "pour", "pours",
    ];
    !has_words(text, &UPRIGHT)
}

/// The actions in a text, in order: "lies down in bed" and "turns off the lamp".
pub(super) fn clauses(text: &str) -> impl Iterator<Item = &str> {
    text.split(" and ").flat_map(|part| part.split([',', ';'])).map(str::trim).filter(|clause| !clause.is_empty())
}
