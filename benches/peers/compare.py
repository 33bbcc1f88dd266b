"""Compares Roomcast with its peers: the same model, labels, prompts, threads and machine, one event of each in turn.

Run by `benches/peers/run`; README.md in this folder lists the peers.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import shapes

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PROGRAMS = sorted((ROOT / "scenes/programs").glob("p*.txt"))
PEERS = ["ranking", "shared-prefix", "llama.cpp-layout", "transformers", "cappr", "independent"]
TOLERANCE_NATS = 1e-2
# It guarantees the order of the rooms, not every label's score.
UNCHECKED = {"ranking"}
# Pause between two peers, so that busy-waiting threads fall asleep.
SILENCE_S = 0.05
# Events of the check with f32 weights. The window is cut within them, which changes the kept prefix.
CHECKED = 7


class Worker:
    """A process that answers one event at a time."""

    def __init__(self, name: str, command: list[str]) -> None:
        self.name, self.times_ms, self.decoder_ms, self.ratios, self.difference_nats = name, [], [], [], 0.0
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def read(self) -> dict:
        for line in self.process.stdout:
            line = line.removeprefix("answer ")
            if line.startswith("{"):
                return json.loads(line)
        raise SystemExit(f"{self.name} ended with exit code {self.process.wait()}; its message stands above")

    def send(self, message: dict) -> None:
        self.process.stdin.write(json.dumps(message) + "\n")
        self.process.stdin.flush()

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()


def measure(
    model: Path, cache: str, embedded: bool, peers: list[str], events: int, warm: int, arguments: argparse.Namespace
) -> list[Worker]:
    """Runs `events` events on every peer in turn; the first worker is Roomcast. All peers on llama.cpp have the same `cache`."""
    def roomcast(method: str) -> Worker:
        observations = arguments.observations or (44 if embedded else 21)
        settings = [method, str(model), cache, arguments.scene, str(arguments.threads), str(observations)]
        return Worker(method, [arguments.bench, *settings, *map(str, PROGRAMS)])

    workers = []
    try:
        for name in ["trie", *peers]:
            ours = name in ("trie", "ranking", "shared-prefix", "independent")
            command = [sys.executable, str(HERE / "worker.py"), name, str(model), cache, str(arguments.threads)]
            workers.append(roomcast(name) if ours else Worker(name, command))
            if ours:
                labels = workers[-1].read()
            else:
                workers[-1].send(labels)
        tokens = []
        for event in range(warm + events):
            # Roomcast writes the prompt. The others follow in random order, each after a pause in which threads fall asleep.
            others = workers[1:]
            for worker in [workers[0], *others[event % len(others):], *others[: event % len(others)]] if others else workers:
                time.sleep(SILENCE_S)
                worker.send({"prompt": prompt} if worker is not workers[0] else {})
                answer = worker.read()
                scores = np.array(answer["log_prob_nats"])
                if worker is workers[0]:
                    prompt, expected, ours_ns = answer["prompt"], scores, answer["ns"]
                    tokens.append(answer["prompt_tokens"])
                if scores.shape != expected.shape or not np.isfinite(scores).all():
                    raise SystemExit(f"{worker.name} gave {scores.shape} scores, not all of them numbers, for {expected.shape} labels")
                if worker.name not in UNCHECKED:
                    worker.difference_nats = max(worker.difference_nats, float(np.abs(scores - expected).max()))
                if event >= warm:
                    worker.times_ms.append(answer["ns"] / 1e6)
                    worker.ratios.append(answer["ns"] / ours_ns)
                    if answer.get("decoder_ns"):
                        worker.decoder_ms.append(answer["decoder_ns"] / 1e6)
        workers[0].labels, workers[0].prompt_tokens = len(labels["labels"]), int(np.median(tokens))
        workers[0].inner = len({tuple(own[:n]) for own in labels["tokens"] for n in range(1, len(own))})
        return workers
    finally:
        for worker in workers:
            worker.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bench", required=True, help=argparse.SUPPRESS)
    parser.add_argument("--model", nargs="+", default=["embedded"], help=f"embedded, a GGUF file, or a shape: {', '.join(shapes.SHAPES)}")
    parser.add_argument("--kind", choices=shapes.FILE_TYPES, default="q4_0", help="the format of the shapes' matrices (q4_0)")
    parser.add_argument("--scene", default="apartment-e0", help="a shipped scene or a scene file (apartment-e0, 118 labels and 3 rooms)")
    parser.add_argument("--events", type=int, default=10)
    parser.add_argument("--observations", type=int, default=0, help="in the window; by default as many as make about 150 tokens")
    parser.add_argument("--threads", type=int, default=max(2, (os.cpu_count() or 2) - 1))
    parser.add_argument("--cache", choices=["mixed", "q8", "f32"], default="mixed", help="the key-value cache of all engines on llama.cpp (mixed)")
    parser.add_argument("--peers", nargs="*", default=PEERS, choices=PEERS)
    parser.add_argument("--checked", type=int, default=CHECKED, help=f"events whose scores are compared with f32 weights ({CHECKED})")
    parser.add_argument("--no-check", action="store_true", help="leave out the comparison of scores with f32 weights")
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    rows, failed = [], False
    with tempfile.TemporaryDirectory(prefix="roomcast-peers-") as folder:
        for name in arguments.model:
            path = Path(name)
            if name == "embedded":
                path = ROOT / "models/household.gguf"
            elif name in shapes.SHAPES:
                path = Path(folder) / f"{name}-{arguments.kind}.gguf"
                shapes.write(name, arguments.kind, path)
            checked = {}
            if not arguments.no_check:
                wide = Path(folder) / "f32.gguf"
                shapes.widened(path, wide)
                peers = [peer for peer in arguments.peers if peer not in UNCHECKED]
                check = measure(wide, "f32", name == "embedded", peers, arguments.checked, 0, arguments)
                checked = {worker.name: worker.difference_nats for worker in check}
                failed |= any(not difference <= TOLERANCE_NATS for difference in checked.values())
            workers = measure(path, arguments.cache, name == "embedded", arguments.peers, arguments.events, 1, arguments)
            ours = workers[0]
            print(f"\n{name}: {ours.labels} labels, {ours.inner} inner nodes, {ours.prompt_tokens} prompt tokens, {arguments.threads} threads, "
                  f"{arguments.events} events")
            print(f"{'':18}{'median ms':>11}{'fastest':>10}{'decoder':>10}{'ratio':>8}{'nats apart':>12}{'with f32':>11}")
            for worker in workers:
                decoder = f"{np.median(worker.decoder_ms):.3f}" if worker.decoder_ms else ""
                row = [name, worker.name, f"{np.median(worker.times_ms):.3f}", f"{min(worker.times_ms):.3f}", decoder, f"{np.median(worker.ratios):.2f}", "" if worker.name in UNCHECKED else f"{worker.difference_nats:.2g}",
                       f"{checked[worker.name]:.2g}" if worker.name in checked else ""]
                rows.append(row)
                print(f"{row[1]:18}{row[2]:>11}{row[3]:>10}{row[4]:>10}{row[5]:>8}{row[6]:>12}{row[7]:>11}", flush=True)
    if arguments.csv:
        with arguments.csv.open("w", newline="") as out:
            csv.writer(out).writerows([["model", "method", "median_ms", "fastest_ms", "decoder_ms", "ratio", "difference_nats", "difference_f32_nats"], *rows])
    if failed:
        print(f"scores differ by more than {TOLERANCE_NATS} nats with f32 weights", file=sys.stderr)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
