"""Counts over the training split, for the baselines that a forecast is compared with."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

from data import Program


def walk(program: Program) -> list[str]:
    """The objects that a program turns to one after another, without immediate repeats."""
    out: list[str] = []
    for step in program.steps:
        if step.target and (not out or out[-1] != step.target):
            out.append(step.target)
    return out


def count(programs: list[Program]) -> tuple[Counter, dict[str, Counter], dict[str, Counter]]:
    """How often each object is next, after each object, and after each pair "before>last"."""
    frequency, first, second = Counter(), {}, {}
    for program in programs:
        visited = walk(program)
        frequency.update(visited)
        for a, b in zip(visited, visited[1:]):
            first.setdefault(a, Counter())[b] += 1
        for a, b, c in zip(visited, visited[1:], visited[2:]):
            second.setdefault(f"{a}>{b}", Counter())[c] += 1
    return frequency, first, second


def write(programs: list[Program], path: Path) -> None:
    frequency, first, second = count(programs)
    table = lambda counts: {key: dict(sorted(value.items())) for key, value in sorted(counts.items())}
    path.write_text(json.dumps({
        "about": "Objects that activity programs of the training split turn to, immediate repeats dropped: how often each is turned to, "
                 "how often next after `last` (markov1), and after `before>last` (markov2). Words as in names.toml, not bound to any map.",
        "programs": len(programs),
        "frequency": dict(sorted(frequency.items())),
        "markov1": table(first),
        "markov2": table(second),
    }, ensure_ascii=False, separators=(",", ":")) + "\n")
