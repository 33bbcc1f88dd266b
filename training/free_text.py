"""Next-object forecasts of the shipped product on narrations in other words, compared with Kneser-Ney with its recency cache on the same cases.

    python training/free_text.py --shared DATA --roomcast target/release/roomcast

The first cases are free descriptions of the test split's activities, then the calibration split's steps in the product's words and in others.
The other words are those of paraphrases.toml, which training used. All forecasters know the thing in hand, because the next one must differ.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import data
from descriptions import Reader
from evaluate import Scene, cases_of, cases_of_descriptions, summarise
from narration import PRODUCT, Style, bind
from statistics_file import KneserNey, bound, recency

ROOT = Path(__file__).resolve().parent.parent
STYLES = {
    "the product's words": PRODUCT,
    "they, other words": Style("They", "base", 1.0),
    "the man, past": Style("The man", "past"),
    "a person is ...ing, other words": Style("A person is", "ing", 1.0, "a"),
}
ECE_BINS = 15


class Product:
    """`roomcast score` on a VirtualHome graph."""

    def __init__(self, program: Path, graph: Path, folder: Path):
        self.program, self.map = program, folder / "map.json"
        self.run("scene", "import", str(graph), "--out", str(self.map))
        self.labels = sorted(self.scores(["They walk to the kitchen."]))

    def run(self, *arguments: str) -> str:
        try:
            ended = subprocess.run([self.program, *arguments], capture_output=True, text=True)
        except OSError as error:
            raise SystemExit(f"{self.program} cannot be run: {error.strerror}; give the program with --roomcast") from None
        if ended.returncode:
            raise SystemExit(f"{self.program} {' '.join(arguments)}: {ended.stderr.strip()}")
        return ended.stdout

    def scores(self, told: list[str]) -> dict[str, float]:
        text = self.run("score", "--scene", str(self.map), "--json", "--narration", "\n".join(told))
        return {label["label"]: label["log_prob_nats"] for label in json.loads(text)["labels"]}

    def forecast(self, told: list[str]) -> np.ndarray:
        scores = self.scores(told)
        log = np.array([scores[label] for label in self.labels])
        return np.exp(log - np.logaddexp.reduce(log))


class Chain:
    """Kneser-Ney over a map's labels, bound as in the product's experiments."""

    def __init__(self, statistics: dict, labels: list[str]):
        self.fit, self.index = statistics["kneser_ney"], {label: k for k, label in enumerate(labels)}
        self.model = KneserNey(bound(statistics["markov3"], self.index), labels)

    def key(self, word: str) -> str:
        return bind(word, self.index) or word

    def forecast(self, visited: list[str]) -> np.ndarray:
        context = tuple(["^", "^", "^", *map(self.key, visited)][-3:])
        return np.array([self.model.probability(self.model.counts(context, label), self.fit["discounts"]) for label in self.index])

    def with_cache(self, chain: np.ndarray, visited: list[str]) -> np.ndarray:
        turned = [self.key(word) for word in visited]
        before = [thing for thing in turned if thing in self.index]
        # A thing in hand that is not on the map excludes none of the map's things.
        before += [turned[-1]] if turned and turned[-1] not in self.index else []
        cached = np.array([recency(before, label, self.fit["cache_decay"]) for label in self.index])
        weight = self.fit["cache_weight"] if cached.sum() else 0.0
        return (1 - weight) * chain + weight * cached


def measures(forecast: np.ndarray, truth: np.ndarray) -> dict[str, np.ndarray]:
    own = forecast[np.arange(len(forecast)), truth]
    greater, ties = (forecast > own[:, None]).sum(1), (forecast == own[:, None]).sum(1)
    rank = np.array([np.mean([1 / (g + i) for i in range(1, t + 1)]) for g, t in zip(greater, ties)])
    return {"nll": -np.log(own), "mrr": rank}


def calibration_error(forecast: np.ndarray, truth: np.ndarray) -> float:
    confidence, right = forecast.max(1), forecast.argmax(1) == truth
    bins = np.minimum((confidence * ECE_BINS).astype(int), ECE_BINS - 1)
    return sum(abs(confidence[bins == k].sum() - right[bins == k].sum()) for k in range(ECE_BINS)) / len(truth)


def compare(product: Product, chain: Chain, cases: list) -> None:
    """Prints the means over cases, with 95 % intervals over programs, and the differences from the product."""
    index, group, truth = chain.index, [], []
    rows: dict[str, list[np.ndarray]] = {"model": [], "Kneser-Ney": [], "Kneser-Ney, cache": []}
    for number, told, visited, target, *_ in cases:
        turned = [word for k, word in enumerate(visited) if not k or word != visited[k - 1]]
        label, in_hand = bind(target, index), bind(turned[-1], index) if turned else None
        if label is None or label == in_hand:
            continue

        def another(forecast: np.ndarray) -> np.ndarray:
            kept = np.array([name != in_hand for name in index])
            return forecast * kept / (forecast * kept).sum()

        chained = another(chain.forecast(turned))
        rows["model"].append(another(product.forecast(told)))
        rows["Kneser-Ney"].append(chained)
        rows["Kneser-Ney, cache"].append(chain.with_cache(chained, turned))
        group.append(number)
        truth.append(index[label])
    units, right = np.array(group), np.array(truth)
    shown = lambda value: f"{value[0]:.3f} [{value[1]:.3f} {value[2]:.3f}]"
    print(f"  {len(right)} cases of {len(set(group))} programs")
    own = measures(np.stack(rows["model"]), right)
    for name, forecasts in rows.items():
        forecast = np.stack(forecasts)
        found = measures(forecast, right)
        means = summarise(found, units, 1000)
        less = summarise({m: own[m] - found[m] for m in own}, units, 1000)
        text = "  ".join(f"{m} {shown(means[m])}" for m in means) + f"  ece {calibration_error(forecast, right):.3f}"
        print(f"  {name:18}", text, "" if name == "model" else "  model less this: " + "  ".join(f"{m} {shown(less[m])}" for m in less), flush=True)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--shared", type=Path, required=True, help="folder with virtualhome/")
    arguments.add_argument("--roomcast", type=Path, required=True, help="the program")
    given = arguments.parse_args()
    programs, graph = data.virtualhome(given.shared), given.shared / "virtualhome/scenes/TestScene1_graph.json"
    if not programs or not graph.is_file():
        raise SystemExit(f"no activity programs and scenes below {given.shared}/virtualhome: pass the folder that holds virtualhome with --shared")
    scene, statistics = Scene(graph), json.loads((ROOT / "models/household-statistics.json").read_text())
    with tempfile.TemporaryDirectory() as folder:
        product = Product(given.roomcast, graph, Path(folder))
        chain = Chain(statistics, product.labels)
        fit, held = data.held_out(programs, "test", False, None)
        print("test split, as writers describe it")
        compare(product, chain, list(cases_of_descriptions(held, scene, Reader.of(fit, scene.labels))))
        _, held = data.held_out(programs, "calibration", False, None)
        for name, style in STYLES.items():
            print(f"calibration split, {name}")
            compare(product, chain, list(cases_of(held, scene, style)))


if __name__ == "__main__":
    main()
