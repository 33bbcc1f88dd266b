"""Reads activity programs, HOMER days and the project's own routines, and splits them by activity."""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from narration import Step, parse_step, words

HERE = Path(__file__).resolve().parent
SPLITS = tomllib.loads((HERE / "splits.toml").read_text())


@dataclass(frozen=True)
class Program:
    source: str  # path relative to the shared folder, or the routine's title
    title: str
    cluster: str
    steps: tuple[Step, ...]
    description: str = ""  # a person's free description


def normal(title: str) -> str:
    return re.sub(r"\s+", " ", title.strip().lower())


def cluster_of(title: str) -> str:
    title = normal(title)
    for name, patterns in SPLITS["clusters"].items():
        if any(re.search(pattern, title) for pattern in patterns):
            return name
    return title


FOLDS = len(SPLITS["folds"])
FOLD_HELP = f"hold out fold 1 to {FOLDS} of splits.toml and the sealed clusters; or `sealed`: hold out these alone"


def fold_of(cluster: str) -> int:
    """The fold that holds a cluster out, from 1; for a title without a cluster by its hash."""
    for number, clusters in enumerate(SPLITS["folds"], 1):
        if cluster in clusters:
            return number
    return 1 + int(hashlib.sha256(cluster.encode()).hexdigest(), 16) % FOLDS


def fold_named(text: str) -> int | str:
    """Parses the value of `--fold`."""
    if text == "sealed":
        return text
    if text.isdigit() and 1 <= int(text) <= FOLDS:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is neither 1 to {FOLDS} nor `sealed`")


def split_of(cluster: str, dev: bool, fold: int | str | None = None) -> str:
    """The split of a cluster; under a fold `test` is the fold's held-out part."""
    if cluster in SPLITS["calibration"]:
        return "calibration"
    if fold is not None:
        return "sealed" if cluster in SPLITS["sealed"] else "test" if fold_of(cluster) == fold else "train"
    if cluster in SPLITS["test"]:
        return "test"
    return "dev" if dev and cluster in SPLITS["dev"] else "train"


def held_out(programs: list[Program], split: str, dev: bool, fold: int | str | None) -> tuple[list[Program], list[Program]]:
    """The training programs and the held-out programs of a split, for a model made with these options of `run.py`."""
    members: dict[str, list[Program]] = {}
    for program in programs:
        members.setdefault(split_of(program.cluster, dev, fold), []).append(program)
    if split not in members:
        made = " ".join(["run.py", *["--dev"] * dev, *[f"--fold {fold}"] * (fold is not None)])
        raise SystemExit(f"`{made}` holds no programs out as {split!r}, and its model was trained on them: choose {' or '.join(sorted(members.keys() - {'train'}))}")
    return members.get("train", []), members[split]


def activities(programs: Iterable[Program]) -> dict[str, list[str]]:
    """The clusters with several titles, by their matched titles: similar titles are one activity."""
    titles: dict[str, set[str]] = {}
    for program in programs:
        titles.setdefault(program.cluster, set()).add(normal(program.title))
    return {cluster: sorted(members) for cluster, members in sorted(titles.items()) if members != {cluster}}


def virtualhome(shared: Path) -> list[Program]:
    """Every program below virtualhome/programs: a title line, a description, then one action per line."""
    programs = []
    for path in sorted((shared / "virtualhome/programs").rglob("*.txt")):
        lines = path.read_text(errors="replace").splitlines()
        steps = tuple(step for step in map(parse_step, lines) if step)
        if steps:
            head = next(k for k, line in enumerate(lines) if parse_step(line))
            programs.append(Program(str(path.relative_to(shared)), lines[0].strip(), cluster_of(lines[0]), steps, " ".join(lines[1:head]).strip()))
    return programs


def homer(shared: Path, fold: int | str | None = None) -> list[list[Program]]:
    """Whole days, each a list of activities in order. Days that HOMER marks as test are left out; under a fold, so are held-out activities."""
    days = []
    for path in sorted((shared / "homer_plus").glob("*/scripts_train/*.txt")):
        day: list[Program] = []
        title, steps = "", []
        for line in path.read_text(errors="replace").splitlines() + ["### end"]:
            if line.startswith("### "):
                if steps and (fold is None or split_of(cluster_of(title), False, fold) == "train"):
                    day.append(Program(f"{path.relative_to(shared)}#{title}", title, "homer " + title, tuple(steps)))
                title, steps = re.sub(r"(-\d+[a-z]?)?\.txt.*", "", line[4:]).strip().replace("_", " "), []
            elif step := parse_step(line):
                steps.append(step)
        if day:
            days.append(day)
    return days


def scene_graphs(shared: Path) -> list[Path]:
    return sorted((shared / "virtualhome/scenes").glob("*_graph.json"))


def graph_labels(graph: Path) -> list[str]:
    """A scene's labels, without the person and the boundaries of rooms."""
    nodes = json.loads(graph.read_text())["nodes"]
    return sorted({words(node["class_name"]) for node in nodes} - {"character", "floor", "wall", "ceiling"})


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
