"""Counts successive sentences over the training split, for guesses at the next sentence.

    python training/forms_file.py --shared ../shared      # writes models/household-forms.json; needs no PyTorch
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path

import data
from data import Program
from narration import ACTIONS, Step

ROOT = Path(__file__).resolve().parent.parent
# Number of recent things that a sentence can refer to, as in core/src/guess.rs.
RECENT = 5
# Least count of a pair of sentences before another sentence.
PAIR_MIN = 2


def form_of(step: Step, recent: list[str]) -> tuple[str, str, list[str]]:
    """A step's sentence with each object replaced by its rank among the recent ones, or n; then with empty places; and the objects."""
    entry = ACTIONS.get(step.action)
    things = [name for name, _ in step.objects][:2]
    base = entry["base"] if entry else step.action
    tail = entry["tails"][len(things)] if entry else " and ".join(f"the {{{at}}}" for at in range(len(things)))
    places = [str(recent.index(thing)) if thing in recent else "n" for thing in things]
    typed, bare = tail, tail
    for at, place in enumerate(places):
        typed = typed.replace(f"{{{at}}}", f"<{place}>")
        bare = bare.replace(f"{{{at}}}", "<>")
    # Places in the order of the sentence.
    order = sorted(range(len(things)), key=lambda at: tail.find(f"{{{at}}}"))
    whole = lambda text: f"They {base}{' ' if text else ''}{text}."
    return whole(typed), whole(bare), [things[at] for at in order if f"{{{at}}}" in tail]


def remember(recent: list[str], things: list[str]) -> list[str]:
    """The distinct recent things, those of the last sentence first and in its order."""
    first = list(dict.fromkeys(things))
    return (first + [thing for thing in recent if thing not in first])[:RECENT]


def count(programs: list[Program]) -> tuple[Counter, Counter, Counter]:
    singles, pairs, things_of = Counter(), Counter(), Counter()
    for program in programs:
        recent: list[str] = []
        before = ("", "")
        for step in program.steps:
            typed, bare, things = form_of(step, recent)
            singles[before[1], typed] += 1
            pairs[before, typed] += 1
            for place, thing in enumerate(things):
                things_of[bare, place, thing] += 1
            recent = remember(recent, things)
            before = (before[1], typed)
    return singles, pairs, things_of


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--shared", type=Path, required=True, help="folder with virtualhome/")
    arguments.add_argument("--out", type=Path, default=ROOT / "models/household-forms.json")
    given = arguments.parse_args()
    programs = [p for p in data.virtualhome(given.shared) if data.split_of(p.cluster, False) == "train"]
    if not programs:
        raise SystemExit(f"no activity programs below {given.shared}/virtualhome/programs: pass the folder that holds virtualhome with --shared")
    singles, pairs, things_of = count(programs)
    forms = sorted({form for pair in singles for form in pair} | {bare for bare, _, _ in things_of})
    number = {form: at for at, form in enumerate(forms)}
    given.out.write_text(json.dumps({
        "about": "Of activity programs of the training split: how often a sentence follows another one (after: before, next, times), and "
                 "two others (after_two: before the last, last, next, times; from 2 times on); and which things stand in it (things: form, place, thing, times). "
                 "A form is a sentence with a place for each thing: <0> to <4> for one of those mentioned last, <n> for another one, <> for any.",
        "programs": len(programs),
        "forms": forms,
        "after": [[number[a], number[b], n] for (a, b), n in sorted(singles.items())],
        "after_two": [[number[a], number[b], number[c], n] for ((a, b), c), n in sorted(pairs.items()) if n >= PAIR_MIN],
        "things": [[number[bare], place, thing, n] for (bare, place, thing), n in sorted(things_of.items())],
    }, ensure_ascii=False, separators=(",", ":")) + "\n")
    print(f"{len(programs)} programs, {len(forms)} forms, {sum(singles.values())} sentences")


if __name__ == "__main__":
    main()
