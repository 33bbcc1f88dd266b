"""Free descriptions of activities as narrations: "I go to the kitchen, take a glass from the cupboard, fill it with water."

Every clause is a sentence of the narration. The next object after it is the first thing of a later clause that it does not mention itself.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass

from data import Program
from narration import ACTIONS

LONGEST_WORDS = 24  # a clause with more is not one action
RARE = 3  # an object named by fewer steps is not a reliable word for a thing
THIRD_PERSON = (
    (r"\bI am\b|\bI'm\b", "they are"), (r"\bI\b|\b[Yy]ou\b", "they"), (r"\bmyself\b|\byourself\b", "themselves"), (r"\b[Mm]y\b|\b[Yy]our\b", "their"), (r"\bme\b", "them"),
)
BEFORE_A_VERB = ("", "i", "to", "and", "then", "they", "will", "can")
NO_VERBS = {"also", "am", "don", "just", "like", "would"}  # other words after "I"
LEADING = re.compile(r"^(?:(?:and|then|next|now|first|so|afterwards|finally|after that|once there)\b[ ,]*)+", re.IGNORECASE)


@dataclass(frozen=True)
class Clause:
    text: str  # as written, without its full stop
    spans: tuple[tuple[int, int, str], ...]  # the things in it: start, end, and the object's words


@dataclass
class Reader:
    """Finds things in free text: the objects that programs act on and the labels of maps, in singular and plural."""

    things: set[str]
    verbs: set[str]

    @classmethod
    def of(cls, programs: list[Program], labels: list[str]) -> Reader:
        """A reader for the objects of the training split's programs and of maps, and for the verbs of their descriptions."""
        counts = Counter(word for p in programs for s in p.steps for word, _ in s.objects)
        said = Counter(w.lower() for p in programs for w in re.findall(r"\bI (?:will |would |then |can )?(\w+)", p.description))
        verbs = {w for w, n in said.items() if n >= RARE} | {entry["base"].split(" ")[0] for entry in ACTIONS.values()}
        return cls({w for w, n in counts.items() if n >= RARE} | set(labels), verbs - NO_VERBS)

    def thing(self, words: list[str]) -> str | None:
        """The object named by these words in lower case."""
        text = " ".join(words)
        forms = (text, re.sub(r"s$", "", text), re.sub(r"es$", "", text), re.sub(r"ves$", "fe", text), text + "s")
        return next((form for form in forms if form in self.things), None)

    def spans(self, clause: str) -> tuple[tuple[int, int, str], ...]:
        """Prefers the longest names. Of two adjacent names, as in "bathroom door", the first only qualifies the second."""
        found, at = [], 0
        words = list(re.finditer(r"[\w'-]+", clause))
        while at < len(words):
            taken = 0
            for size in (3, 2, 1):
                part = [w[0].lower() for w in words[at : at + size]]
                thing = self.thing(part) if len(part) == size else None
                before = words[at - 1][0].lower() if at else ""
                if thing and not (size == 1 and part[0] in self.verbs and before in BEFORE_A_VERB):
                    if found and clause[found[-1][1] : words[at].start()] == " ":
                        found.pop()
                    found.append((words[at].start(), words[at + size - 1].end(), thing))
                    taken = size
                    break
            at += taken or 1
        return tuple(found)

    def clauses(self, description: str) -> list[Clause]:
        """The texts between commas, full stops and "then", without conjunctions."""
        out = []
        for text in re.split(r"[.,;!?\n]+| and then | then ", re.sub(r"\s+", " ", description)):
            text = LEADING.sub("", text.strip(" ,-\"'()")).strip(" ,")
            if 2 <= len(text.split()) <= LONGEST_WORDS:
                out.append(Clause(text, self.spans(text)))
        return out

    def told(self, clause: Clause, as_written: bool) -> list[str]:
        """A clause as a sentence, in parts: the text around the things, and the things. The subject becomes "they" unless `as_written`."""
        parts, at = [], 0
        for begin, end, _ in clause.spans:
            parts += [clause.text[at:begin], clause.text[begin:end]]
            at = end
        parts.append(clause.text[at:])
        if not as_written:
            for pattern, by in THIRD_PERSON:
                parts = [re.sub(pattern, by, part) for part in parts]
            if parts[0].split(" ")[0].lower() in self.verbs:
                parts[0] = "they " + parts[0][0].lower() + parts[0][1:]
        parts = [part for part in parts if part]
        parts[0] = parts[0][0].upper() + parts[0][1:]
        for k in range(len(parts) - 1):  # a space belongs to the next part
            if parts[k].endswith(" "):
                parts[k], parts[k + 1] = parts[k][:-1], " " + parts[k + 1]
        return [part for part in [*parts, "."] if part]


def next_things(clauses: list[Clause]) -> list[str | None]:
    """For every clause: the first thing of a later clause that it does not mention itself."""
    out: list[str | None] = []
    for k, clause in enumerate(clauses):
        here = {thing for *_, thing in clause.spans}
        later = (thing for c in clauses[k + 1 :] for *_, thing in c.spans if thing not in here)
        out.append(next(later, None))
    return out
