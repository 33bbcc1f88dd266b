"""Observations and their sentences, as the product says them and in the other styles of the training corpus."""

from __future__ import annotations

import random
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ACTIONS = tomllib.loads((ROOT / "core/src/narration/actions.toml").read_text())
NAMES = tomllib.loads((ROOT / "core/src/names.toml").read_text())
WORDS, ALIASES = NAMES["words"], NAMES["aliases"]

DEFAULT_BINDING = "Next, the human will go to the"


@dataclass(frozen=True)
class Step:
    """One completed action: its key in actions.toml, its objects as (words, identifier)."""

    action: str
    objects: tuple[tuple[str, int], ...] = ()

    @property
    def target(self) -> str | None:
        return self.objects[0][0] if self.objects else None


def words(name: str) -> str:
    """The words of a dataset's object name: "coffe_maker" is "coffee maker"."""
    name = name.strip().lower()
    return WORDS.get(name) or re.sub(r"[_\-\s]+", " ", name).strip()


def bind(word: str, labels) -> str | None:
    """The label of a map that serves for an object's words, by the rule that names.toml documents."""
    if word in labels:
        return word
    return next((alias for alias in ALIASES.get(word, ()) if alias in labels), None)


STEP = re.compile(r"^\s*\[(\w+)\]((?:\s*<[^>]*>\s*\([^)]*\))*)")
OBJECT = re.compile(r"<([^>]*)>\s*\(([^)]*)\)")


def parse_step(line: str) -> Step | None:
    match = STEP.match(line)
    if not match:
        return None
    objects = []
    for name, identifier in OBJECT.findall(match[2]):
        digits = re.findall(r"\d+", identifier)
        objects.append((words(name), int(digits[-1]) if digits else 0))
    return Step(match[1].lower(), tuple(objects))


def next_targets(steps: list[Step]) -> list[str | None]:
    """For every step k: the object of the first action after it that names another object than step k's last object."""
    targets: list[str | None] = []
    for k, step in enumerate(steps):
        later = (s.target for s in steps[k + 1 :] if s.target and s.target != step.target)
        targets.append(next(later, None))
    return targets


@dataclass(frozen=True)
class Style:
    """Who is spoken of, and in which tense."""

    subject: str = "They"
    tense: str = "base"  # base, third, past or ing


PRODUCT = Style()
NAMES_OF_PEOPLE = (
    "Anna Ben Carla David Emma Felix Grace Hassan Ines Jonas Kate Leo Maria Nadia Omar Paula Quinn Rosa Sam Tara Uma Victor "
    "Wei Yuki Zoe Alice Bob Chen Dana Erik"
).split()


def random_style(rng: random.Random, product_share: float) -> Style:
    """The product's style with the given probability, else one of the others."""
    roll = (rng.random() - product_share) / (1 - product_share)
    if roll < 0:
        return PRODUCT
    if roll < 3 / 19:
        return Style("They", "past")
    if roll < 4 / 19:
        return Style("They are", "ing")
    subject = rng.choice(["He", "She", "The person", "The human", "The resident", rng.choice(NAMES_OF_PEOPLE)])
    if roll < 12 / 19:
        return Style(subject, "third")
    if roll < 17 / 19:
        return Style(subject, "past")
    return Style(f"{subject} is", "ing")


def sentence(step: Step, style: Style = PRODUCT) -> str:
    """One observation as a sentence."""
    return "".join(segments(step, style)).strip()


def segments(step: Step, style: Style = PRODUCT) -> list[str]:
    """A sentence in parts: what is said around the objects, and the objects. Tokens of the vocabulary never cross parts.

    Unknown actions are said by their own name, as in the product.
    """
    objects = [word for word, _ in step.objects[:2]]
    entry = ACTIONS.get(step.action)
    if entry is None:
        verb, tail = step.action, "the {0}" if objects else ""
    else:
        verb, tail = entry[style.tense], entry["tails"][len(objects)]
    subject = [style.subject, f" {verb}"] if style.subject != PRODUCT.subject else [f"{style.subject} {verb}"]
    parts = [part for part in re.split(r"( \{\d\})", f" {tail}" if tail else "") if part]
    filled = [part.format(*objects) for part in parts]
    if filled and not parts[0].startswith(" {"):
        subject[-1] += filled.pop(0)
    return [*subject, *filled, "."]


STATES = {
    "switchon": "The {0} is on.",
    "switchoff": "The {0} is off.",
    "open": "The {0} is open.",
    "close": "The {0} is closed.",
    "plugin": "The {0} is plugged in.",
}
