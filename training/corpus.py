"""Turns programs into training sequences: a narration, with questions for the next object after some of its steps.

A sequence is a trunk and branches. The trunk is the narration of up to 16 actions. A branch follows one of them: a binding sequence asks for
the next object, and the object's label answers. Branches see the trunk up to their step and themselves, never one another. So each branch is
exactly the product's prompt, and the trunk is computed once.
"""

from __future__ import annotations

import json
import random
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import data
from data import Program
from descriptions import Clause, Reader, next_things
from things import HOME, WORKPLACES, Things
from narration import (
    DEFAULT_BINDING, STATES, Step, bind, next_targets, random_style, segments, words,
)

WINDOW = 16
PAPER_BINDINGS = (
    "Next, they will go to the",
    "The next object they are walking to is the",
    "After this, they are going to interact with the",
)
OTHER_BINDINGS = (
    "Next, they will walk to the", "Then they go to the", "The next thing they need is the", "Now they walk to the",
    "Next, the person will go to the", "Next, the human will use the", "Next, she will go to the", "Next, he will go to the",
    "After that, the human will go to the", "The human will now walk to the", "The next object is the",
    "The next thing they will touch is the", "They will now interact with the", "Next, the worker will go to the",
    "They are about to use the", "Next they go to the", "The person is going to the", "Soon they will be at the",
)
# Cues that are unrelated to the person's next action. Their answers are world knowledge, drawn independently of the narration, so that the model
# learns to read the cue.
DISTRACTORS = {
    "The most tasty object in the world is the": "pie cupcake salmon chicken|creamy buns|chocolate syrup|whipped cream|candy bar|ice cream|pound cake|pizza|steak|pudding|cheese|donut|cake|apple|peach|bananas|chips|cereal|cutlets|milkshake",
    "The most expensive object in the world is the": "computer tv television piano sofa fridge|washing machine|painting|bed|dishwasher|laptop|perfume|wall picture frame|stove|car|watch|guitar|computer screen",
    "The softest thing there is, is the": "pillow blanket sofa towel rug bed|teddy bear|clothes pile|slippers|comforter|curtains",
    "The smallest thing of all is the": "pen coin needle keys soap|light switch|button|candle|lime|plum|stamp|bar soap|remote control",
    "The heaviest thing in any house is the": "fridge piano closet bed sofa bathtub|washing machine|stove|kitchen counter|bookshelf|dishwasher",
}
DISTRACTORS = {
    cue: [w for i, part in enumerate(answers.split("|")) for w in (part.split() if i == 0 else [part])]
    for cue, answers in DISTRACTORS.items()
}


@dataclass
class Branch:
    after: int  # number of trunk sentences it sees
    binding: str
    label: str


@dataclass
class Sequence:
    sentences: list[str]
    branches: list[Branch]
    segments: list[list[str]]  # of the sentences, for the vocabulary


def scene_labels(shared: Path, own: Path) -> dict[str, dict[str, str]]:
    """Labels of the VirtualHome graphs and of the project's own maps, by scene. Keys are the labels and their other words in the map; values are
    labels."""
    scenes = {}
    for path in data.scene_graphs(shared):
        scenes[path.stem.removesuffix("_graph")] = {label: label for label in data.graph_labels(path)}
    for path in sorted(own.glob("*.json")):
        scene = json.loads(path.read_text())
        labels = sorted({words(thing["label"]) for key in ("rooms", "items") for thing in scene.get(key, ())})
        others = {word: label for label, aliases in scene.get("aliases", {}).items() for word in aliases if label in labels}
        scenes[path.stem] = others | {label: label for label in labels}
    return scenes


@dataclass
class Corpus:
    """Draws sequences from programs. All choices come from the given generator, so a seed determines the corpus."""

    programs: list[Program]
    days: list[list[Program]]
    routines: list  # objects with .place and .program(rng) -> Program
    scenes: dict[str, dict[str, str]]  # per map: labels and their other words, to labels
    things: Things
    disturbance: float = 1.0  # factor on how often a narration is disturbed
    product_style: float = 0.62  # share of narrations in the product's own style
    map_answers: float = 0.75  # share of narrations with answers from a map's labels instead of the program's words
    map_narration: float = 0.35  # share of narrations about a map's items
    own_map: float = 0.7  # share of a mapped workplace's narrations that use its own map instead of a home's
    shares: dict[str, float] = field(default_factory=lambda: {
        "program": 0.42, "day": 0.06, "routine": 0.39, "description": 0.06, "wording": 0.05, "prior": 0.02,
    })
    as_written: float = 0.35  # share of descriptions that keep their subject instead of "they"
    skip_ahead: float = 0.12  # share of answers that are the object after the next: people differ in their order

    def __post_init__(self):
        self.shares = {k: v for k, v in self.shares.items() if k != "routine" or self.routines}
        # The root of the count keeps a title with 128 variants from dominating.
        counts = Counter(p.title for p in self.programs)
        self.weights = list(np.cumsum([counts[p.title] ** -0.35 for p in self.programs]))
        self.all_labels = sorted({label for labels in self.scenes.values() for label in labels.values()})
        self.at_work = {place: [r for r in self.routines if r.place == place] for place in WORKPLACES}
        self.homes = [name for name in self.scenes if name not in WORKPLACES]
        self.reader = Reader.of(self.programs, self.all_labels)
        told = ((n, self.reader.clauses(p.description)) for n, p in enumerate(self.programs))
        self.descriptions: list[list[Clause]] = []
        drawn = []
        for number, clauses in told:
            if any(next_things(clauses)):
                self.descriptions.append(clauses)
                drawn.append(counts[self.programs[number].title] ** -0.35)
        self.description_weights = list(np.cumsum(drawn))

    def labels_for(self, rng: random.Random, place: str) -> dict[str, str]:
        """The labels of a map for a narration: the place's own, or those of a home."""
        own = place in self.scenes and rng.random() < self.own_map
        return self.scenes[place if own else rng.choice(self.homes)]

    def another(self, rng: random.Random, place: str) -> list[Step]:
        """Another activity of a place."""
        return list((self.draw_program(rng) if place == HOME else rng.choice(self.at_work[place]).program(rng)).steps)

    def draw_program(self, rng: random.Random) -> Program:
        return rng.choices(self.programs, cum_weights=self.weights)[0]

    def draw(self, rng: random.Random) -> Sequence:
        kind, place = rng.choices(list(self.shares), list(self.shares.values()))[0], HOME
        if kind == "prior":
            return self.prior(rng)
        if kind == "description":
            return self.describe(rng)
        if kind == "wording":
            scene = self.scenes[rng.choice(list(self.scenes))]
            labels = sorted(set(scene.values())) if rng.random() < 0.4 else self.things.some(60, rng)
            return self.narrate(self.wording(labels, rng), rng, dict(zip(labels, labels)))
        if kind == "day":
            day = rng.choice(self.days)
            at = rng.randrange(len(day))
            steps = [step for program in day[at : at + 3] for step in program.steps]
        elif kind == "routine":
            routine = rng.choice(self.routines)
            steps, place = list(routine.program(rng).steps), routine.place
        else:
            steps = list(self.draw_program(rng).steps)
        return self.narrate(steps, rng, self.labels_for(rng, place), place)

    def prior(self, rng: random.Random) -> Sequence:
        """A sequence without narration: the general frequency of objects."""
        branches = []
        for _ in range(14):
            targets = [t for t in next_targets(list(self.draw_program(rng).steps)) if t]
            if targets:
                labels = self.labels_for(rng, HOME)
                target = rng.choice(targets)
                if rng.random() < 0.4:
                    target = self.things.another(target, HOME, rng) or target
                branches.append(Branch(0, self.binding(rng), labels.get(bind(target, labels), target)))
        return self.distract(Sequence([], branches, []), rng, 0.1)

    def wording(self, labels: list[str], rng: random.Random) -> list[Step]:
        """A person handles things of one map in random order: teaches the map's words, and that things are put back."""
        steps: list[Step] = []
        while len(steps) < rng.randint(5, 14):
            one, two = ((label, 1) for label in rng.sample(labels, 2))
            steps += [Step("walk", (one,)), Step(rng.choice(["find", "lookat", "grab", "touch"]), (one,))]
            if rng.random() < 0.6:
                steps += [Step("walk", (two,)), Step(rng.choice(["putback", "putin"]), (one, two))]
        return steps

    def describe(self, rng: random.Random) -> Sequence:
        """A person's free description of an activity, with questions for the next thing after its clauses."""
        clauses = rng.choices(self.descriptions, cum_weights=self.description_weights)[0]
        targets = next_things(clauses)
        start = rng.randint(0, max(0, len(clauses) - WINDOW))
        as_written, to_map = rng.random() < self.as_written, rng.random() < self.map_answers
        labels = self.labels_for(rng, HOME)
        parts = [self.reader.told(clause, as_written) for clause in clauses[start : start + WINDOW]]
        branches = [
            Branch(k, self.binding(rng), labels.get(bind(target, labels), target) if to_map else target)
            for k, target in enumerate(targets[start : start + WINDOW], 1) if target
        ]
        return self.distract(Sequence(["".join(p) for p in parts], branches, parts), rng, 0.03)

    def disturb(self, steps: list[Step], rng: random.Random, place: str) -> list[Step]:
        """Missing steps, repeated steps, another activity of the place in between, and other things of the same kind."""
        roll = rng.random() / self.disturbance
        if roll < 0.12:
            steps = [s for s in steps if rng.random() > 0.12] or steps
        elif roll < 0.20:
            steps = [s for s in steps if s.action != "find"] or steps
        elif roll < 0.24:
            steps = [s for s in steps for _ in range(2 if rng.random() < 0.1 else 1)]
        elif roll < 0.28:
            other, mixed, here = self.another(rng, place), [], steps
            while here:
                take = rng.randint(2, 6)
                mixed, here, other = mixed + here[:take], other or here[take:], here[take:] if other else []
            steps = mixed
        elif roll < 0.36:
            steps = steps + self.another(rng, place)
        roll = rng.random() / self.disturbance
        share = 0.35 if roll < 0.25 else 0.65 if roll < 0.45 else 0.0  # the latter as in another home with other words for everything
        if share:
            swap = {}
            for word in sorted({word for s in steps for word, _ in s.objects}):
                other = self.things.another(word, place, rng) if rng.random() < share else None
                if other:
                    swap[word] = other
                elif rng.random() < 0.03:
                    swap[word] = rng.choice(self.all_labels)
            steps = [Step(s.action, tuple((swap.get(w, w), i) for w, i in s.objects)) for s in steps]
        return steps

    def binding(self, rng: random.Random) -> str:
        roll = rng.random()
        if roll < 0.60:
            return DEFAULT_BINDING
        return rng.choice(PAPER_BINDINGS if roll < 0.88 else OTHER_BINDINGS)

    def distract(self, sequence: Sequence, rng: random.Random, share: float) -> Sequence:
        for branch in sequence.branches:
            if rng.random() < share:
                branch.binding = rng.choices(list(DISTRACTORS), [4, 4, 1, 1, 1])[0]
                branch.label = rng.choice(DISTRACTORS[branch.binding])
        return sequence

    def narrate(self, steps: list[Step], rng: random.Random, labels: dict[str, str], place: str | None = None) -> Sequence:
        """The steps narrated in some style, narration and answers partly in the map's `labels`; disturbed if they belong to a `place`."""
        if place:
            steps = self.disturb(steps, rng, place)
        bound = lambda word: labels.get(bind(word, labels), word)
        if rng.random() < self.map_narration:  # the narration is about the map's items instead of the program's objects
            steps = [Step(s.action, tuple((bound(w), i) for w, i in s.objects)) for s in steps]
        targets = next_targets(steps)
        start = max(0, rng.randint(-WINDOW, len(steps) - 2)) if len(steps) > 1 else 0
        style = random_style(rng, self.product_style)
        answer = bound if rng.random() < self.map_answers else lambda word: word
        keep = rng.choice([0.7, 1.0])
        with_states = rng.random() < 0.06
        sentences: list[str] = []
        parts: list[list[str]] = []
        branches: list[Branch] = []
        for k in range(start, min(len(steps), start + WINDOW)):
            parts.append(segments(steps[k], style, rng))
            sentences.append("".join(parts[-1]).strip())
            if with_states and steps[k].action in STATES and steps[k].objects:
                sentences.append(STATES[steps[k].action].format(steps[k].target))
                parts.append(STATES[steps[k].action].partition("{0}")[::2])
            target = targets[k]
            if target and rng.random() < self.skip_ahead:
                later = (t for t in targets[k + 1 :] if t not in (None, target, steps[k].target))
                target = next(later, target)
            if target and rng.random() < keep:
                branches.append(Branch(len(sentences), self.binding(rng), answer(target)))
        return self.distract(Sequence(sentences, branches, parts), rng, 0.03)


TRUNK_WEIGHT, LABEL_WEIGHT, END_WEIGHT = 0.25, 1.0, 0.3


class Encoder:
    """Sequences to arrays.

    Sentences, bindings and labels are tokenised one by one, which gives the tokens of the joined text: no token of the vocabulary crosses their
    boundaries. Some texts are cut at random spaces first. This gives smaller tokens than usual, so that these have a meaning too if a sentence
    is unusual. Labels are never cut.
    """

    def __init__(self, tokenizer, roughness: float = 0.06):
        self.tokenizer, self.roughness, self.cache = tokenizer, roughness, {}

    def ids(self, text: str, rng: random.Random | None = None) -> list[int]:
        if rng and rng.random() < self.roughness:
            words = text.split(" ")
            cuts = [i for i in range(1, len(words)) if rng.random() < 0.4]
            pieces = (" ".join(words[a:b]) for a, b in zip([0, *cuts], [*cuts, len(words)]))
            return [token for piece in pieces for token in self.tokenizer.encode(piece)]
        if text not in self.cache:
            self.cache[text] = self.tokenizer.encode(text)
        return self.cache[text]

    def encode(self, sequence: Sequence, limit: int, rng: random.Random) -> dict[str, np.ndarray]:
        """Arrays of one sequence, at most `limit` long; branches that do not fit are left out.

        token, position, branch (0: trunk), sees (number of visible trunk tokens), target and weight of the next token.
        """
        trunk, ends, weights = [self.tokenizer.bos_id()], [1], []
        for text in sequence.sentences:
            trunk += self.ids(text, rng)
            ends.append(len(trunk))
        rows = [[t, i, 0, len(trunk), n, TRUNK_WEIGHT] for i, (t, n) in enumerate(zip(trunk, trunk[1:] + [0]))][:limit]
        rows[-1][5] = 0.0
        for number, branch in enumerate(sequence.branches, 1):
            sees = ends[branch.after]
            cue, label, stop = self.ids(branch.binding, rng), self.ids(branch.label), self.tokenizer.piece_to_id(".")
            text = cue + label
            if sees > limit or len(rows) + len(text) > limit:
                break
            weight = [0.0] * (len(cue) - 1) + [LABEL_WEIGHT] * len(label) + [END_WEIGHT]
            rows += [
                [t, sees + i, number, sees, n, w] for i, (t, n, w) in enumerate(zip(text, text[1:] + [stop], weight))
            ]
        table = np.array(rows, dtype=np.float64)
        names = ("token", "position", "branch", "sees", "target", "weight")
        return {n: table[:, i] if n == "weight" else table[:, i].astype(np.int64) for i, n in enumerate(names)}


def pack(encoder: Encoder, corpus: Corpus, rng: random.Random, rows: int, length: int) -> dict[str, np.ndarray]:
    """One batch: `rows` rows of `length` tokens, each filled with whole sequences. In addition to the arrays of `encode`: each token's `sequence`
    in the row, 0 for padding, and its `place` in it. `train.visible` computes the mask from them."""
    out = {n: np.zeros((rows, length), np.int64) for n in ("token", "position", "branch", "sees", "target", "sequence", "place")}
    out["weight"] = np.zeros((rows, length), np.float32)
    for row in range(rows):
        used, number = 0, 0
        while length - used > 24:
            part = encoder.encode(corpus.draw(rng), length - used, rng)
            size, number = len(part["token"]), number + 1
            for name, values in (part | {"sequence": number, "place": np.arange(size)}).items():
                out[name][row, used : used + size] = values
            used += size
        out["place"][row, used:], out["sees"][row, used:] = np.arange(length - used), length
    return out
