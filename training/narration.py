"""Observations and their sentences, in the product's style and in the other styles of the training corpus."""

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
PARAPHRASES = tomllib.loads((ROOT / "training/paraphrases.toml").read_text())

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
    """The map's label for an object's words, by the rule in names.toml."""
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
    """For every step k: the object of the first later action that names another object than step k's last one."""
    targets: list[str | None] = []
    for k, step in enumerate(steps):
        later = (s.target for s in steps[k + 1 :] if s.target and s.target != step.target)
        targets.append(next(later, None))
    return targets


@dataclass(frozen=True)
class Style:
    """Subject, tense, and share of sentences in other words than the product's."""

    subject: str = "They"
    tense: str = "base"  # base, third, past or ing
    other_words: float = 0.0  # share of sentences
    article: str = "the"  # or "a"


PRODUCT = Style()
NAMES_OF_PEOPLE = (
    "Anna Ben Carla David Emma Felix Grace Hassan Ines Jonas Kate Leo Maria Nadia Omar Paula Quinn Rosa Sam Tara Uma Victor "
    "Wei Yuki Zoe Alice Bob Chen Dana Erik"
).split()


SOMEBODY = ("Someone", "Somebody", "A person", "A man", "A woman", "The man", "The woman")


def random_style(rng: random.Random, product_share: float) -> Style:
    """The product's style with the given probability, else a random other style; half of these use other words too."""
    roll = (rng.random() - product_share) / (1 - product_share)
    if roll < 0:
        return PRODUCT
    paraphrased = rng.random() < 0.5
    other = {"other_words": rng.choice((0.3, 0.8)), "article": rng.choice(("the", "the", "a"))} if paraphrased else {}
    if roll < 3 / 19:
        return Style("They", rng.choice(("base", "past")) if paraphrased else "past", **other)
    if roll < 4 / 19:
        return Style("They are", "ing", **other)
    people = ["He", "She", "The person", "The human", "The resident", rng.choice(NAMES_OF_PEOPLE)]
    subject = rng.choice([*people, rng.choice(SOMEBODY)] if paraphrased else people)
    if roll < 12 / 19:
        return Style(subject, "third", **other)
    if roll < 17 / 19:
        return Style(subject, "past", **other)
    return Style(f"{subject} is", "ing", **other)


def sentence(step: Step, style: Style = PRODUCT, rng: random.Random | None = None) -> str:
    """One observation as a sentence."""
    return "".join(segments(step, style, rng)).strip()


def segments(step: Step, style: Style = PRODUCT, rng: random.Random | None = None) -> list[str]:
    """A sentence in parts: the text around the objects, and the objects. Tokens of the vocabulary never cross parts. `rng` chooses other words, if
    the style has any.

    Unknown actions are narrated by their name, as in the product.
    """
    objects = [word for word, _ in step.objects[:2]]
    entry = ACTIONS.get(step.action)
    if entry is None:
        verb, tail = step.action, "the {0}" if objects else ""
    elif rng and style.other_words and rng.random() < style.other_words:
        base, third, past, ing, *tails = rng.choice(PARAPHRASES[step.action])
        verb, tail = {"base": base, "third": third, "past": past, "ing": ing}[style.tense], tails[len(objects)]
    else:
        verb, tail = entry[style.tense], entry["tails"][len(objects)]
    subject = [style.subject, f" {verb}"] if style.subject != PRODUCT.subject else [f"{style.subject} {verb}"]
    parts = [part for part in re.split(r"( \{\d\})", f" {tail}" if tail else "") if part]
    filled = [part.format(*objects) for part in parts]
    if style.article == "a":
        filled = [indefinite(part, after) for part, after in zip(filled, [*filled[1:], ""])]
    if filled and not parts[0].startswith(" {"):
        subject[-1] += filled.pop(0)
    return [*subject, *filled, "."]


# Last words of things without "a": mass nouns and plurals.
UNCOUNTED = set(
    "water milk juice coffee tea beer wine sugar salt flour rice bread butter cheese food soup sauce oil soap shampoo toothpaste detergent paper hair teeth feet "
    "mail homework laundry clothing underwear furniture trash garbage rubbish music children people scissors jeans shorts lotion cream cereal pasta meat chicken "
    "fish fruit medicine paint glue tape foil dust dirt sand air money news work information equipment makeup jewelry cutlery crockery silverware linen bedding".split()
)


def indefinite(part: str, thing: str) -> str:
    """The text before a thing, with "a" instead of "the" if the thing is countable and singular."""
    last = thing.rpartition(" ")[2]
    many = last.endswith("s") and not last.endswith("ss")
    if not part.endswith(" the") or many or last in UNCOUNTED:
        return part
    vowel = re.match(r"[aeio]|u(?!s[eb]|ni|til)|hour", thing.strip()) and not thing.strip().startswith("eu")
    return part.removesuffix("the") + ("an" if vowel else "a")


STATES = {
    "switchon": "The {0} is on.",
    "switchoff": "The {0} is off.",
    "open": "The {0} is open.",
    "close": "The {0} is closed.",
    "plugin": "The {0} is plugged in.",
}
