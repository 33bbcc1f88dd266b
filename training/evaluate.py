"""Next-object and next-room forecasts of a model and of the baselines, on held-out programs in given scenes.

This guides training. The figures of the model card come from `roomcast-lab forecast`, which scores with the product itself.

    python training/evaluate.py --shared ../shared --work training/work --split test

The held-out programs are those of the model's own training: the checkpoint records its fold or development run.
"""

from __future__ import annotations

import argparse
import json
import math
import random
from collections import Counter
from pathlib import Path

import numpy as np
import torch

import data
import export
import tokenizer as vocabulary
from corpus import Encoder, PAPER_BINDINGS
from descriptions import Reader, next_things
from model import Household
from narration import DEFAULT_BINDING, PRODUCT, Style, bind, next_targets, sentence, words
from statistics_file import count
from train import restore

WINDOW = 16


class Scene:
    """Labels of a VirtualHome graph, with the graph's room of each of their items."""

    def __init__(self, path: Path):
        graph = json.loads(path.read_text())
        nodes = {n["id"]: n for n in graph["nodes"]}
        rooms = {i: words(n["class_name"]) for i, n in nodes.items() if n["category"] == "Rooms"}
        room_of = {e["from_id"]: rooms[e["to_id"]] for e in graph["edges"] if e["relation_type"] == "INSIDE" and e["to_id"] in rooms}
        room_of |= rooms
        self.name, self.rooms = path.stem.removesuffix("_graph"), sorted(set(rooms.values()))
        items: dict[str, list[str]] = {}
        for i, node in nodes.items():
            if node["class_name"] not in ("character", "floor", "wall", "ceiling") and i in room_of:
                items.setdefault(words(node["class_name"]), []).append(room_of[i])
        self.items, self.labels = items, sorted(items)
        self.index = {label: k for k, label in enumerate(self.labels)}
        # [labels, rooms]: the share of a label's items in each room
        self.share = np.array([[items[l].count(r) / len(items[l]) for r in self.rooms] for l in self.labels])

    def room(self, label: str, identifier: int, seed: str) -> str:
        """The room of the item for an object: the same identifier is the same item."""
        return random.Random(f"{seed} {label} {identifier}").choice(self.items[label])


def label_log_probs(model: Household, encoder: Encoder, prompts: list[list[int]], labels: list[list[int]]) -> np.ndarray:
    """[prompts, labels], in nats: the sum over a label's tokens. First tokens come from one row, the rest are decoded."""
    out = np.zeros((len(prompts), len(labels)))
    first = [l[0] for l in labels]
    longer = [k for k, l in enumerate(labels) if len(l) > 1]

    device = model.embedding.weight.device

    def decode(rows: list[list[int]], wanted: list[list[int]]) -> torch.Tensor:
        """[rows, places, vocabulary]: log-probabilities after the wanted places of each row."""
        size = max(map(len, rows))
        tokens = torch.tensor([row + [0] * (size - len(row)) for row in rows], device=device)
        mask = torch.ones(size, size, dtype=torch.bool, device=device).tril()[None, None]
        hidden = model(tokens, torch.arange(size, device=device).expand(len(rows), size), mask)
        places = torch.tensor(wanted, device=device)
        return model.logits(hidden.gather(1, places[:, :, None].expand(-1, -1, hidden.shape[-1]))).log_softmax(-1)

    with torch.no_grad():
        for at in range(0, len(prompts), 64):
            chunk = prompts[at : at + 64]
            after = decode(chunk, [[len(p) - 1] for p in chunk])
            out[at : at + len(chunk)] = after[:, 0, first].cpu().numpy()
            for k in longer:
                rest = labels[k][1:]
                after = decode([p + labels[k][:-1] for p in chunk], [[len(p) + j for j in range(len(rest))] for p in chunk])
                out[at : at + len(chunk), k] += after[:, range(len(rest)), rest].sum(1).cpu().numpy()
    return out


class Baselines:
    """Frequency and Markov chains over the labels of one scene, counted on the training split; each order backs off to the next lower one."""

    def __init__(self, programs: list[data.Program], scene: Scene):
        self.scene, size = scene, len(scene.labels)
        frequency, first, second, *_ = count(programs)
        column = lambda counts: self.vector(counts)
        self.frequency = column(frequency) + 0.5
        self.frequency /= self.frequency.sum()
        self.first = {a: column(c) for a, c in first.items()}
        self.second = {a: column(c) for a, c in second.items()}
        self.uniform = np.full(size, 1 / size)

    def vector(self, counts: Counter) -> np.ndarray:
        out = np.zeros(len(self.scene.labels))
        for word, n in counts.items():
            if label := bind(word, self.scene.index):
                out[self.scene.index[label]] += n
        return out

    def predict(self, visited: list[str]) -> dict[str, np.ndarray]:
        """Witten-Bell back-off: second order to first order to frequency."""
        def blend(counts, lower):
            kinds = (counts > 0).sum()
            return (counts + kinds * lower) / (counts.sum() + kinds) if kinds else lower
        zero = np.zeros_like(self.uniform)
        one = blend(self.first.get(visited[-1], zero) if visited else zero, self.frequency)
        two = blend(self.second.get(">".join(visited[-2:]), zero), one)
        return {"uniform": self.uniform, "frequency": self.frequency, "markov1": one, "markov2": two}


def cases_of(programs: list[data.Program], scene: Scene, style: Style = PRODUCT):
    """Every step of every program with a next object that is in the scene and has another label than the step's own, narrated in a style.

    Yields the program's number, the sentences of the window, the objects visited, the next object's label, the room now and the room next.
    """
    for number, program in enumerate(programs):
        steps, targets = list(program.steps), next_targets(list(program.steps))
        identifiers = [next((o for s in steps[k + 1 :] for o in s.objects[:1] if o[0] == t), None) for k, t in enumerate(targets)]
        rng = random.Random(program.source)
        said = [sentence(step, style, rng) for step in steps]
        room, visited = None, []
        for k, step in enumerate(steps):
            if step.target and (not visited or visited[-1] != step.target):
                visited.append(step.target)
            if step.objects and (label := bind(step.objects[0][0], scene.index)):
                room = scene.room(label, step.objects[0][1], program.source)
            here = bind(step.objects[-1][0], scene.index) if step.objects else None
            if targets[k] and (label := bind(targets[k], scene.index)) and label != here:
                yield number, said[max(0, k + 1 - WINDOW) : k + 1], list(visited), label, room, scene.room(label, identifiers[k][1], program.source)


def cases_of_descriptions(programs: list[data.Program], scene: Scene, reader: Reader):
    """As `cases_of` for free descriptions: every clause before a thing of the scene that the clause does not mention."""
    for number, program in enumerate(programs):
        clauses = reader.clauses(program.description)
        told = ["".join(reader.told(clause, as_written=False)) for clause in clauses]
        room, visited = None, []
        for k, (clause, target) in enumerate(zip(clauses, next_things(clauses))):
            visited += [thing for *_, thing in clause.spans]
            here = [label for *_, thing in clause.spans if (label := bind(thing, scene.index))]
            room = scene.room(here[-1], 0, program.source) if here else room
            if target and (label := bind(target, scene.index)):
                yield number, told[max(0, k + 1 - WINDOW) : k + 1], list(visited), label, room, scene.room(label, 0, program.source)


def evaluate(model, encoder, train_programs, cases: list, scene: Scene, binding: str = DEFAULT_BINDING, narrated: bool = True, bootstrap: int = 300, prior: float = 0.0) -> dict:
    """Rows by (target, predictor): the mean of each measure and its 95 % interval. The bootstrap resamples programs."""
    label_tokens = [encoder.ids(l) for l in scene.labels]
    cue = encoder.ids(binding)
    bos = encoder.tokenizer.bos_id()
    prompts = [[bos] + [t for text in told if narrated for t in encoder.ids(text)] + cue for _, told, *_ in cases]
    order = np.argsort([len(p) for p in prompts])
    scores = np.zeros((len(cases), len(scene.labels)))
    scores[order] = label_log_probs(model, encoder, [prompts[i] for i in order], label_tokens)
    blank = label_log_probs(model, encoder, [[bos] + cue], label_tokens)
    normal = lambda log: np.exp(log - np.logaddexp.reduce(log, axis=1)[:, None])
    probability, nothing = normal(scores - prior * blank), normal((1 - prior) * blank)
    baselines = Baselines(train_programs, scene)
    stay = fitted_stay(train_programs, scene)
    truth = np.array([scene.index[c[3]] for c in cases])
    rooms = np.array([scene.rooms.index(c[5]) for c in cases])
    now = np.array([scene.rooms.index(c[4]) if c[4] else -1 for c in cases])
    predicted = {"model": probability, "no-narration": np.tile(nothing, (len(cases), 1))}
    rows_of = [baselines.predict(c[2]) for c in cases]
    for name in ("uniform", "frequency", "markov1", "markov2"):
        predicted[name] = np.stack([row[name] for row in rows_of])
    group = np.array([c[0] for c in cases])
    result = {"scene": scene.name, "cases": len(cases), "rows": {}, "mass": float(np.exp(scores).sum(1).mean())}
    for name, p in predicted.items():
        own = p[np.arange(len(p)), truth]
        rank = 1 + (p > own[:, None]).sum(1) + 0.5 * ((p == own[:, None]).sum(1) - 1)
        measures = {"nll": -np.log(own), "top1": rank == 1, "top5": rank <= 5, "mrr": 1 / rank}
        result["rows"][f"object {name}"] = summarise(measures, group, bootstrap)
    in_room = {name: p @ scene.share for name, p in predicted.items()}
    kept = np.full((len(cases), len(scene.rooms)), (1 - stay) / (len(scene.rooms) - 1))
    kept[now >= 0, now[now >= 0]] = stay
    kept[now < 0] = 1 / len(scene.rooms)
    in_room["stay"] = kept
    change = (now >= 0) & (now != rooms)
    for name, p in in_room.items():
        own = p[np.arange(len(p)), rooms]
        result["rows"][f"room {name}"] = summarise({"nll": -np.log(own + 1e-12), "top1": p.argmax(1) == rooms}, group, bootstrap)
        result["rows"][f"room-change {name}"] = summarise({"top1": (p.argmax(1) == rooms)[change], "nll": -np.log(own + 1e-12)[change]}, group[change], bootstrap)
    return result


EXPENSIVE = "The most expensive object in the world is the"
PROMPTS = {  # the paper's, by name: binding sequence, and whether the narration precedes it
    "default": (DEFAULT_BINDING, True), "P0": (PAPER_BINDINGS[0], True), "P1": (PAPER_BINDINGS[1], True), "P2": (PAPER_BINDINGS[2], True),
    "P3": ("The most tasty object in the world is the", True), "P4": (EXPENSIVE, False), "P5": (PAPER_BINDINGS[0], False),
}


def compare_prompts(model, encoder, train_programs, cases: list, scene: Scene, prior: float) -> None:
    """One line per prompt of the paper; the chance level for rooms is one over the number of rooms."""
    for name, (binding, narrated) in PROMPTS.items():
        rows = evaluate(model, encoder, train_programs, cases, scene, binding, narrated, prior=prior)["rows"]
        shown = {"object": rows["object model"], "room": rows["room model"]}
        print(f"  {name:8}", "  ".join(f"{t} {m} {v[0]:.3f} [{v[1]:.3f} {v[2]:.3f}]" for t, ms in shown.items() for m, v in ms.items()), flush=True)


def fitted_stay(programs, scene: Scene) -> float:
    stays = [c[4] == c[5] for c in cases_of(programs[:400], scene) if c[4]]
    return (sum(stays) + 1) / (len(stays) + 2)


def summarise(measures: dict[str, np.ndarray], group: np.ndarray, bootstrap: int) -> dict:
    rng = np.random.default_rng(0)
    units = np.unique(group)
    size = {u: k for k, u in enumerate(units)}
    slot = np.array([size[g] for g in group])
    counts = np.bincount(slot, minlength=len(units))
    draws = rng.integers(0, len(units), (bootstrap, len(units)))
    out = {}
    for name, values in measures.items():
        sums = np.bincount(slot, values.astype(float), minlength=len(units))
        resampled = sums[draws].sum(1) / counts[draws].sum(1)
        out[name] = [float(np.mean(values)), *np.percentile(resampled, [2.5, 97.5]).tolist()]
    return out


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--shared", type=Path, required=True)
    arguments.add_argument("--work", type=Path, required=True)
    arguments.add_argument("--split", choices=("dev", "calibration", "test", "sealed"), default="test")
    arguments.add_argument("--scenes", nargs="*", default=["TestScene1", "TestScene2", "TestScene5"])
    arguments.add_argument("--limit", type=int, default=0, help="only so many programs")
    arguments.add_argument("--descriptions", action="store_true", help="narrate what people wrote about the programs instead of their steps")
    arguments.add_argument("--prompts", action="store_true", help="compare the paper's prompts instead of the predictors")
    arguments.add_argument("--quantised", action="store_true", help="round the matrices as the shipped file does")
    given = arguments.parse_args()
    torch.set_num_threads(1)
    checkpoint = given.work / "checkpoint.pt"
    made = torch.load(checkpoint, weights_only=True, map_location="cpu")
    if not {"dev", "fold"} <= made.keys():
        raise SystemExit(f"{checkpoint} does not say what its training held out: run training/run.py once more with its own options and --export-only")
    fit, held = data.held_out(data.virtualhome(given.shared), given.split, made["dev"], made["fold"])
    prior = made["prior"]
    model, encoder = restore(checkpoint), Encoder(vocabulary.load(given.work / "vocabulary.model"))
    if given.quantised:
        model.load_state_dict(export.quantised(model, "q8_0"))
    if given.limit:
        held = random.Random(0).sample(held, min(given.limit, len(held)))
    for name in given.scenes:
        scene = Scene(given.shared / f"virtualhome/scenes/{name}_graph.json")
        cases = list(cases_of_descriptions(held, scene, Reader.of(fit, scene.labels)) if given.descriptions else cases_of(held, scene))
        if given.prompts:
            print(name)
            compare_prompts(model, encoder, fit, cases, scene, prior)
            continue
        result = evaluate(model, encoder, fit, cases, scene, prior=prior)
        print(f"{name}: {result['cases']} cases, label mass {result['mass']:.2f}")
        for row, measures in result["rows"].items():
            print(f"  {row:28}", "  ".join(f"{m} {v[0]:.3f} [{v[1]:.3f} {v[2]:.3f}]" for m, v in measures.items()), flush=True)


if __name__ == "__main__":
    main()
