"""The project's own corpus: hand-written everyday routines, and the generator of their variations.

    python training/routines.py --out FOLDER      # one variation of each training routine, as a program for `roomcast-lab forecast --fit`

A routine's `steps` are actions separated by `;`. An action is a key of actions.toml, then up to two objects separated by a comma.

    a|b      one of the alternatives; the same alternatives written again in a routine mean the same choice
    step?    a step that is sometimes left out
    { .. & .. }   parts that may come in any order
    ( .. / .. )   one of the parts; with a `?` after it, sometimes none
"""

from __future__ import annotations

import argparse
import random
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from data import Program, cluster_of, split_of
from narration import ACTIONS, Step
from things import HOME, WORKPLACES

HANDLED = {"grab", "open", "switchon", "switchoff", "sit", "touch", "lie", "close", "wash", "wipe", "read", "scan", "turnon", "unlock", "push", "pull", "puton", "load", "check"}


@dataclass(frozen=True)
class Routine:
    title: str
    place: str
    cluster: str
    text: str

    def program(self, rng: random.Random) -> Program:
        """A random variation of the routine."""
        chosen: dict[str, str] = {}
        steps: list[Step] = []
        verbosity = rng.choice([0.0, 0.3, 0.6, 0.9])
        for text in flatten(self.text, rng):
            if text.endswith("?"):
                if rng.random() < 0.35:
                    continue
                text = text[:-1].strip()
            verb, _, rest = text.partition(" ")
            objects = []
            for part in filter(None, (part.strip() for part in rest.split(","))):
                word = chosen.setdefault(part, rng.choice(part.split("|")).strip())
                objects.append((word, 1))
            step = Step(verb, tuple(objects[:2]))
            if step.target and verb in HANDLED and (not steps or steps[-1].target != step.target):
                if rng.random() < verbosity:
                    steps.append(Step("walk", step.objects[:1]))
                if rng.random() < verbosity * 0.8:
                    steps.append(Step("find", step.objects[:1]))
            steps.append(step)
        return Program(f"routine: {self.title}", self.title, self.cluster, tuple(steps))


GROUP = re.compile(r"(\{[^}]*\}|\([^)]*\)\??)")


def flatten(text: str, rng: random.Random) -> list[str]:
    """The actions in order, with every `{ a & b }` in some order and one part of every `( a / b )`. Groups do not nest."""
    out: list[str] = []
    for part in GROUP.split(text):
        if part.startswith("{"):
            blocks = part[1:-1].split("&")
            rng.shuffle(blocks)
            part = ";".join(blocks)
        elif part.startswith("("):
            left_out = part.endswith("?") and rng.random() < 0.35
            part = "" if left_out else rng.choice(part.rstrip("?")[1:-1].split("/"))
        out += steps_of(part)
    return out


def steps_of(text: str) -> list[str]:
    return [s.strip() for s in text.split(";") if s.strip()]


def place_of(path: Path) -> str:
    """The workplace at the start of a file's name, or a home."""
    first = path.stem.split("_")[0]
    return first if first in WORKPLACES else HOME


def load(folder: Path) -> list[Routine]:
    routines = []
    for path in sorted(folder.glob("*.toml")):
        for entry in tomllib.loads(path.read_text())["routine"]:
            routines.append(Routine(entry["title"], place_of(path), cluster_of(entry["title"]), entry["steps"]))
    for routine in routines:
        check(routine)
    return routines


def check(routine: Routine) -> None:
    """Checks that every part of every choice is a valid action."""
    for part in GROUP.split(routine.text):
        between = "/" if part.startswith("(") else "&"
        inside = part.rstrip("?")[1:-1].replace(between, ";") if GROUP.fullmatch(part) else part
        if set(inside) & set("{}()&/"):
            raise ValueError(f"routine {routine.title!r}: a group that is not closed, or one inside another, in {part!r}")
        for text in steps_of(inside):
            verb, _, rest = text.rstrip("?").strip().partition(" ")
            if verb not in ACTIONS:
                raise ValueError(f"routine {routine.title!r}: unknown action {verb!r} in {text!r}; see core/src/narration/actions.toml")
            if rest.count(",") > 1:
                raise ValueError(f"routine {routine.title!r}: more than two objects in {text!r}")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--out", type=Path, required=True)
    arguments.add_argument("--fold", choices=("sealed",), help="leave the sealed activities out instead of those of the test split")
    given = arguments.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    rng = random.Random("programs")
    trained = [r for r in load(Path(__file__).resolve().parent / "routines") if split_of(r.cluster, False, given.fold) == "train"]
    for number, routine in enumerate(trained):
        lines = (" ".join([f"[{step.action}]", *(f"<{word.replace(' ', '_')}> ({n})" for word, n in step.objects)]) for step in routine.program(rng).steps)
        (given.out / f"{number:04}.txt").write_text(f"{routine.title}\n\n\n" + "\n".join(lines) + "\n")
    print(f"{len(trained)} programs in {given.out}")


if __name__ == "__main__":
    main()
