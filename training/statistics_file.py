"""Counts over the training split, for the baselines of forecasts, and the parameters of Kneser-Ney smoothing, fitted on the calibration split.

    python training/statistics_file.py --shared ../shared      # writes models/household-statistics.json; needs no PyTorch
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import data
from data import Program
from narration import bind, next_targets

ROOT = Path(__file__).resolve().parent.parent
# Pads a context before the first object.
START = "^"
# Candidates of the fit: the discounts for counts of one, of two, and of three or more.
DISCOUNTED = [0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 0.99]
WEIGHTS = [0.0, 0.02, 0.05, 0.08, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]
DECAYS = [0.5, 0.7, 0.8, 0.9, 0.95, 1.0]

# Lengths of contexts, 0 to 3 objects, and kinds of counts (one, two, more) with separate discounts.
ORDERS, KINDS = 4, 3

Table = dict[str, Counter]
Counted = tuple[int, int, int, list[int]]
Discounts = list[list[float]]


def walk(program: Program) -> list[str]:
    """A program's objects in order, without immediate repeats."""
    out: list[str] = []
    for step in program.steps:
        if step.target and (not out or out[-1] != step.target):
            out.append(step.target)
    return out


def count(programs: list[Program]) -> tuple[Counter, Table, Table, Table]:
    """How often each object is next: overall, after each object, after each pair "before>last", and after each three."""
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
    """Modified Kneser-Ney, interpolated, of third order (Chen and Goodman 1999): shorter contexts count the distinct longer ones before an object,
    and counts of one, two and more have separate discounts."""

    def __init__(self, third: Table, objects: list[str]) -> None:
        self.tables: list[dict[tuple[str, ...], Counter]] = [{tuple(key.split(">")): Counter(counts) for key, counts in third.items()}]
        for _ in range(3):
            shorter: dict[tuple[str, ...], Counter] = {}
            for context, counts in self.tables[-1].items():
                shorter.setdefault(context[1:], Counter()).update(counts.keys())
            self.tables.append(shorter)
        self.objects = objects

    def counts(self, context: tuple[str, ...], following: str) -> list[Counted]:
        """Per length of context, the empty one first: the object's count, the total count, and how many objects followed once, twice and more
        often. Lengths without any count are left out."""
        out = []
        for order in range(ORDERS):
            counts = self.tables[3 - order].get(context[3 - order :])
            if counts:
                kinds = Counter(min(count, KINDS) for count in counts.values())
                out.append((order, counts[following], sum(counts.values()), [kinds[kind] for kind in range(1, KINDS + 1)]))
        return out

    def probability(self, counted: list[Counted], discounts: Discounts) -> float:
        return probability(counted, 1 / len(self.objects), discounts)


def probability(counted: list[Counted], even: float, discounts: Discounts) -> float:
    """Probability of an object from its counts; `even` is every object's probability without counts."""
    p = even
    for order, count, total, kinds in counted:
        taken = sum(number * discount for number, discount in zip(kinds, discounts[order]))
        left = count - discounts[order][min(count, KINDS) - 1] if count else 0
        p = left / total + taken / total * p
    return p


def recency(before: list[str], following: str, decay: float) -> float:
    """The share of an object in the activity's earlier objects except for the one in hand; the latest counts most."""
    last, mass, all_mass, weight = before[-1] if before else None, 0.0, 0.0, 1.0
    for thing in reversed(before):
        if thing != last:
            all_mass += weight
            mass += weight if thing == following else 0.0
        weight *= decay
    return mass / all_mass if all_mass else 0.0


def bound(third: Table, labels: Iterable[str]) -> Table:
    """The counts over a map's labels. Objects outside the map stay in contexts only; two words of one label are one thing."""
    out: Table = {}
    for context, counts in third.items():
        before = [bind(word, labels) or word for word in context.split(">")]
        own = out.setdefault(">".join(before), Counter())
        for word, number in counts.items():
            label = bind(word, labels)
            if label and label != before[-1]:
                own[label] += number
    return {context: counts for context, counts in out.items() if counts}


def cases_in(programs: list[Program], labels: set[str], model: KneserNey) -> Iterator[tuple[list[Counted], list[Counted] | None, float, str, list[str]]]:
    """Yields for every step with a next thing in the map: the counts of that thing and of the one in hand, the even probability, the thing, and
    the map's earlier things; the last of these is in hand, whether in the map or not."""
    for program in programs:
        turned: list[str] = []
        for step, target in zip(program.steps, next_targets(program.steps)):
            thing = bind(step.target, labels) or step.target if step.target else None
            if thing and (not turned or turned[-1] != thing):
                turned.append(thing)
            label = bind(target, labels) if target else None
            if turned and label and label != turned[-1]:
                context = tuple([START] * 3 + turned)[-3:]
                in_hand = model.counts(context, turned[-1]) if turned[-1] in labels else None
                visited = [thing for thing in turned[:-1] if thing in labels] + turned[-1:]
                yield model.counts(context, label), in_hand, 1 / len(labels), label, visited


def fit(third: Table, calibration: list[Program], maps: list[set[str]]) -> dict[str, object]:
    """Discounts by order and count, and weight and decay of the recency cache, that maximise the likelihood of the calibration split over the
    labels of `maps`, as for the model's temperature: the next thing at every step, given that it differs from the one in hand."""
    cases = [case for labels in maps for case in cases_in(calibration, labels, KneserNey(bound(third, labels), sorted(labels)))]

    def chances(discounts: Discounts) -> list[tuple[float, float]]:
        """Probabilities of the next thing and of the one in hand."""
        p = lambda counted, even: probability(counted, even, discounts) if counted is not None else 0.0
        return [(p(counted, even), p(in_hand, even)) for counted, in_hand, even, *_ in cases]

    loss = lambda discounts: -sum(math.log(p / (1 - hidden)) for p, hidden in chances(discounts))
    discounts = [[0.75 * kind for kind in range(1, KINDS + 1)] for _ in range(ORDERS)]
    best, before = loss(discounts), math.inf
    while best < before:
        before = best
        for order, kind in itertools.product(range(ORDERS), range(KINDS)):
            changed = lambda part: [[part * (kind + 1) if (o, k) == (order, kind) else d for k, d in enumerate(row)] for o, row in enumerate(discounts)]
            discounts = min([discounts, *map(changed, DISCOUNTED)], key=loss)
        best = loss(discounts)
    discounts = [[round(discount, 2) for discount in row] for row in discounts]
    chained = chances(discounts)

    def mixed(weight: float, decay: float) -> float:
        total = 0.0
        for (p, hidden), (*_, label, visited) in zip(chained, cases):
            share = weight if any(thing != visited[-1] for thing in visited) else 0.0
            total -= math.log(((1 - share) * p + share * recency(visited, label, decay)) / (1 - (1 - share) * hidden))
        return total

    weight, decay = min(itertools.product(WEIGHTS, DECAYS), key=lambda tried: mixed(*tried))
    print(f"{len(cases)} calibration cases: Kneser-Ney {loss(discounts) / len(cases):.3f} nats, with its cache {mixed(weight, decay) / len(cases):.3f}")
    return {"discounts": discounts, "cache_weight": weight, "cache_decay": decay}


def write(programs: dict[str, list[Program]], graphs: list[Path], path: Path) -> None:
    frequency, first, second, third = count(programs["train"])
    table = lambda counts: {key: dict(sorted(value.items())) for key, value in sorted(counts.items())}
    path.write_text(json.dumps({
        "about": "Objects that activity programs of the training split turn to, immediate repeats dropped: how often each is turned to, "
                 "how often next after `last` (markov1), after `before>last` (markov2), and after three, where ^ is before the first (markov3). "
                 "kneser_ney is fitted on the calibration split, over the labels of VirtualHome's scenes. Words as in names.toml, not bound to any map.",
        "programs": len(programs["train"]),
        "frequency": dict(sorted(frequency.items())),
        "markov1": table(first),
        "markov2": table(second),
        "markov3": table(third),
        "kneser_ney": fit(third, programs["calibration"], [set(data.graph_labels(graph)) for graph in graphs]),
    }, ensure_ascii=False, separators=(",", ":")) + "\n")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--shared", type=Path, required=True, help="folder with virtualhome/")
    arguments.add_argument("--out", type=Path, default=ROOT / "models/household-statistics.json")
    arguments.add_argument("--fold", type=data.fold_named, metavar="N", help=data.FOLD_HELP)
    given = arguments.parse_args()
    programs: dict[str, list[Program]] = {"train": [], "calibration": [], "test": [], "sealed": []}
    for program in data.virtualhome(given.shared):
        programs[data.split_of(program.cluster, False, given.fold)].append(program)
    if not programs["train"]:
        raise SystemExit(f"no activity programs below {given.shared}/virtualhome/programs: pass the folder that holds virtualhome with --shared")
    graphs = data.scene_graphs(given.shared)
    if not graphs:
        raise SystemExit(f"no scenes below {given.shared}/virtualhome/scenes: the smoothing is fitted over their labels")
    write(programs, graphs, given.out)


if __name__ == "__main__":
    main()
