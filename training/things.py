"""The lexicon: kinds of things with members that can replace each other in an activity without changing its course.

It imitates the maps of other places: a cup in a cupboard here is a beaker in a sideboard there. Each file of `things/` lists kinds, the
commonest things of a kind first.
"""

from __future__ import annotations

import random
import tomllib
from dataclasses import dataclass
from pathlib import Path

HOME = "home"
# Places other than homes. The files of a place's routines begin with its name, and its map, if it has one, is a scene with that name.
WORKPLACES = ("ward", "warehouse", "office")
# The files of a place, in the order of the search.
FILES = {
    HOME: ("everyday", "house", "living"),
    "ward": ("ward_office", "everyday", "house", "living"),
    "office": ("ward_office", "everyday", "house", "living"),
    "warehouse": ("warehouse", "everyday", "house", "living"),
}


@dataclass
class Things:
    """`kinds[file]` are the kinds in a file."""

    kinds: dict[str, list[list[str]]]

    def __post_init__(self):
        self.of: dict[str, dict[str, list[list[str]]]] = {}
        for file, kinds in self.kinds.items():
            words = self.of[file] = {}
            for kind in kinds:
                for word in kind:
                    words.setdefault(word, []).append(kind)
        self.all = {word for kinds in self.kinds.values() for kind in kinds for word in kind}
        self.pools = [sorted({word for kind in kinds for word in kind}) for kinds in self.kinds.values()]

    @staticmethod
    def load(folder: Path) -> Things:
        files = {path.stem: tomllib.loads(path.read_text())["kinds"] for path in sorted(folder.glob("*.toml"))}
        return Things({file: [[word.strip() for word in kind.split(",")] for kind in kinds.values()] for file, kinds in files.items()})

    def another(self, word: str, place: str, rng: random.Random) -> str | None:
        """A thing of the word's kind, common ones more often; None if the lexicon lacks the word."""
        kinds = [kind for file in FILES[place] for kind in self.of.get(file, {}).get(word, ())]
        if not kinds:
            return None
        kind = kinds[0] if rng.random() < 0.5 else rng.choice(kinds)
        return kind[int(len(kind) * rng.random() ** 1.5)]

    def some(self, number: int, rng: random.Random) -> list[str]:
        """Different things of one file."""
        pool = rng.choice(self.pools)
        return rng.sample(pool, min(number, len(pool)))
