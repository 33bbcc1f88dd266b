"""Counts over the training split, for the baselines that a forecast is compared with, and what Kneser-Ney smoothing fits on the
calibration split.

    python training/statistics_file.py --shared ../shared      # writes models/household-statistics.json; needs no PyTorch
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections import Counter
from pathlib import Path

import data
from data import Program

ROOT = Path(__file__).resolve().parent.parent
# Stands in a context for what lies before the first object.
START = "^"
# What the fit chooses among.
DISCOUNTS = [0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 0.99]
WEIGHTS = [0.0, 0.02, 0.05, 0.08, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]
DECAYS = [0.5, 0.7, 0.8, 0.9, 0.95, 1.0]

Table = dict[str, Counter]


def walk(program: Program) -> list[str]:
    """The objects that a program turns to one after another, without immediate repeats."""
    out: list[str] = []
    for step in program.steps:
        if step.target and (not out or out[-1] != step.target):
            out.append(step.target)
    return out


def count(programs: list[Program]) -> tuple[Counter, Table, Table, Table]:
    """How often each object is next, after each object, after each pair "before>last", and after each three."""
    frequency: Counter = Counter()
    first, second, third = {}, {}, {}
    for program in programs:
        visited = walk(program)
        frequency.update(visited)
        for a, b in zip(visited, visited[1:]):
            first.setdefault(a, Counter())[b] += 1
        for a, b, c in zip(visited, visited[1:], visited[2:]):
            second.setdefault(f"{a}>{b}", Counter())[c] += 1
        for context, following in contexts(visited):
            third.setdefault(">".join(context), Counter())[following] += 1
    return frequency, first, second, third


def contexts(visited: list[str]) -> list[tuple[tuple[str, ...], str]]:
    """Every object with the three before it."""
    padded = [START] * 3 + visited
    return [(tuple(padded[at : at + 3]), padded[at + 3]) for at in range(len(visited))]


class KneserNey:
    """Third-order interpolated Kneser-Ney: shorter contexts count the distinct longer ones that an object followed."""

    def __init__(self, third: Table, objects: list[str]) -> None:
        self.tables: list[dict[tuple[str, ...], Counter]] = [{tuple(key.split(">")): Counter(counts) for key, counts in third.items()}]
        for _ in range(3):
            shorter: dict[tuple[str, ...], Counter] = {}
            for context, counts in self.tables[-1].items():
                shorter.setdefault(context[1:], Counter()).update(counts.keys())
            self.tables.append(shorter)
        self.objects = objects

    def probability(self, context: tuple[str, ...], following: str, discounts: list[float]) -> float:
        p = 1 / len(self.objects)
        for order in range(4):
            counts = self.tables[3 - order].get(context[3 - order :])
            if counts:
                total, discount = sum(counts.values()), discounts[order]
                p = max(counts[following] - discount, 0) / total + discount * len(counts) / total * p
        return p


def recency(before: list[str], following: str, decay: float) -> float:
    """The share of an object in what was turned to in this activity, apart from what is in hand; the latest counts most."""
    last, mass, all_mass, weight = before[-1] if before else None, 0.0, 0.0, 1.0
    for thing in reversed(before):
        if thing != last:
            all_mass += weight
            mass += weight if thing == following else 0.0
        weight *= decay
    return mass / all_mass if all_mass else 0.0


def fit(third: Table, frequency: Counter, calibration: list[Program]) -> dict[str, object]:
    """Discounts by order, and the weight and decay of the recency cache, that make the calibration split likeliest. The first object of
    a program has nothing before it and is no case. Objects that the training split does not know are cases, as a map has such things too:
    how much is kept for them is fitted by them alone."""
    walks = [walk(program) for program in calibration]
    model = KneserNey(third, sorted({*frequency, *itertools.chain(*walks)}))
    cases = []
    for visited in walks:
        for at, (context, following) in enumerate(contexts(visited)):
            if at:
                cases.append((context, following, visited[:at]))
    loss = lambda discounts: -sum(math.log(model.probability(context, following, discounts)) for context, following, _ in cases)
    discounts = [0.75] * 4
    for _ in range(3):
        for order in range(4):
            discounts = min(([*discounts[:order], tried, *discounts[order + 1 :]] for tried in DISCOUNTS), key=loss)
    chained = [(model.probability(context, following, discounts), following, before) for context, following, before in cases]

    def mixed(weight: float, decay: float) -> float:
        total = 0.0
        for p, following, before in chained:
            cached = recency(before, following, decay)
            has_cache = any(thing != before[-1] for thing in before)
            total -= math.log((1 - weight) * p + weight * cached if has_cache else p)
        return total

    weight, decay = min(itertools.product(WEIGHTS, DECAYS), key=lambda tried: mixed(*tried))
    print(f"{len(cases)} calibration cases: Kneser-Ney {loss(discounts) / len(cases):.3f} nats, with its cache {mixed(weight, decay) / len(cases):.3f}")
    return {"discounts": discounts, "cache_weight": weight, "cache_decay": decay}


def write(programs: dict[str, list[Program]], path: Path) -> None:
    frequency, first, second, third = count(programs["train"])
    table = lambda counts: {key: dict(sorted(value.items())) for key, value in sorted(counts.items())}
    path.write_text(json.dumps({
        "about": "Objects that activity programs of the training split turn to, immediate repeats dropped: how often each is turned to, "
                 "how often next after `last` (markov1), after `before>last` (markov2), and after three, where ^ is before the first (markov3). "
                 "kneser_ney is fitted on the calibration split. Words as in names.toml, not bound to any map.",
        "programs": len(programs["train"]),
        "frequency": dict(sorted(frequency.items())),
        "markov1": table(first),
        "markov2": table(second),
        "markov3": table(third),
        "kneser_ney": fit(third, frequency, programs["calibration"]),
    }, ensure_ascii=False, separators=(",", ":")) + "\n")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--shared", type=Path, required=True, help="folder with virtualhome/")
    arguments.add_argument("--out", type=Path, default=ROOT / "models/household-statistics.json")
    given = arguments.parse_args()
    programs: dict[str, list[Program]] = {"train": [], "calibration": [], "test": []}
    for program in data.virtualhome(given.shared):
        programs[data.split_of(program.cluster, False)].append(program)
    if not programs["train"]:
        raise SystemExit(f"no activity programs below {given.shared}/virtualhome/programs: pass the folder that holds virtualhome with --shared")
    write(programs, given.out)


if __name__ == "__main__":
    main()
