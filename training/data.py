"""Reads activity programs, HOMER days and the project's own routines, and splits them by activity."""

from __future__ import annotations

import hashlib
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from narration import Step, parse_step

HERE = Path(__file__).resolve().parent
SPLITS = tomllib.loads((HERE / "splits.toml").read_text())


@dataclass(frozen=True)
class Program:
    source: str  # path relative to the shared folder, or the routine's title
    title: str
    cluster: str
    steps: tuple[Step, ...]
    description: str = ""  # what somebody wrote about it, in free words


def cluster_of(title: str) -> str:
    title = re.sub(r"\s+", " ", title.strip().lower())
    for name, patterns in SPLITS["clusters"].items():
        if any(re.search(pattern, title) for pattern in patterns):
            return name
    return title


def split_of(cluster: str, dev: bool) -> str:
    for split in ("test", "calibration"):
        if cluster in SPLITS[split]:
            return split
    return "dev" if dev and cluster in SPLITS["dev"] else "train"


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


def homer(shared: Path) -> list[list[Program]]:
    """Whole days, each a list of activities in order. Days marked as test by HOMER are left alone."""
    days = []
    for path in sorted((shared / "homer_plus").glob("*/scripts_train/*.txt")):
        day: list[Program] = []
        title, steps = "", []
        for line in path.read_text(errors="replace").splitlines() + ["### end"]:
            if line.startswith("### "):
                if steps:
                    day.append(Program(f"{path.relative_to(shared)}#{title}", title, "homer " + title, tuple(steps)))
                title, steps = re.sub(r"(-\d+)?\.txt.*", "", line[4:]).strip().replace("_", " "), []
            elif step := parse_step(line):
                steps.append(step)
        days.append(day)
    return days


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
