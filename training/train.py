"""Trains a model for a fixed number of steps."""

from __future__ import annotations

import math
import os
import random
import socket
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Queue
from threading import Thread

import torch
import torch.distributed
import torch.multiprocessing
import torch.nn.functional as F

from corpus import Corpus, Encoder, pack
from model import Household, Shape
from muon import Muon


# Steps between two checkpoints.
CHECKPOINT_STEPS = 200


@dataclass(frozen=True)
class Schedule:
    """How long and how fast. Training is broken off while the rate is still high: what is kept is the mean of moving averages of the weights."""

    steps: int = 18000  # over which the rate falls
    until: int = 7200  # and after which training stops
    workers: int = 2  # processes, on CPUs
    rows: int = 4  # per worker
    length: int = 192
    rate: float = 2e-3
    warm_up: int = 150
    weight_decay: float = 0.1
    dropout: float = 0.2
    average: float = 0.999  # decay of the moving average of the weights
    averages: int = 3  # of which so many are taken, the last at the end, and their mean is kept
    apart: int = 900  # steps between two of them


def rate_at(step: int, schedule: Schedule) -> float:
    """Linear warm-up, then a cosine to a twentieth."""
    if step < schedule.warm_up:
        return schedule.rate * (step + 1) / schedule.warm_up
    progress = (step - schedule.warm_up) / max(1, schedule.steps - schedule.warm_up)
    return schedule.rate * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * progress)))


def loss_of(model: Household, batch: dict[str, torch.Tensor]) -> torch.Tensor:
    """Weighted cross-entropy, in nats, over the tokens that have a weight."""
    hidden = model(batch["token"], batch["position"], batch["mask"])
    wanted = batch["weight"] > 0
    logits = model.logits(hidden[wanted]).float()
    weight = batch["weight"][wanted]
    return (F.cross_entropy(logits, batch["target"][wanted], reduction="none") * weight).sum() / weight.sum()


def batches(encoder: Encoder, corpus: Corpus, seed: str, schedule: Schedule, device: str, done: int, state):
    """Batches in a fixed order, some made ahead, from after the `done`-th on; each with the state of the draws after it. `state` is that of the
    last one done."""
    queue: Queue = Queue(maxsize=4)

    def produce():
        rng = random.Random(f"batches {seed}")
        if state:
            rng.setstate(state)
        for _ in range(done, schedule.until):
            drawn = {n: torch.from_numpy(v) for n, v in pack(encoder, corpus, rng, schedule.rows, schedule.length).items()}
            queue.put((drawn, rng.getstate()))

    Thread(target=produce, daemon=True).start()
    for _ in range(done, schedule.until):
        drawn, after = queue.get()
        yield {name: value.to(device) for name, value in drawn.items()}, after


class Checkpoints:
    """All that a worker needs to go on: after every so many steps a file per worker, so that all can go on from the last step that all have."""

    def __init__(self, folder: Path, recipe: dict, rank: int):
        self.folder, self.recipe, self.rank = folder, recipe, rank

    def path(self, rank: int, step: int) -> Path:
        return self.folder / f"resume-{step:06}-{rank}.pt"

    def steps(self, rank: int) -> list[int]:
        return sorted(int(path.name.split("-")[1]) for path in self.folder.glob(f"resume-*-{rank}.pt"))

    def last(self, workers: int) -> dict | None:
        """What was kept at the last step that every worker has; none if that is of another recipe."""
        common = set.intersection(*(set(self.steps(rank)) for rank in range(workers)))
        if not common:
            return None
        # Own files, made by this program: they hold optimisers and the states of generators, which are no plain weights.
        kept = torch.load(self.path(self.rank, max(common)), weights_only=False, map_location="cpu")
        if kept["recipe"] == self.recipe:
            return kept
        if not self.rank:
            print("the checkpoints are of another recipe: training starts from the beginning", flush=True)
        return None

    def keep(self, step: int, **state) -> None:
        path = self.path(self.rank, step)
        unfinished = path.with_suffix(".part")
        torch.save({"recipe": self.recipe, "step": step, **state}, unfinished)
        unfinished.replace(path)
        for old in self.steps(self.rank)[:-2]:
            self.path(self.rank, old).unlink()

    def remove(self) -> None:
        for step in self.steps(self.rank):
            self.path(self.rank, step).unlink()


def train(shape: Shape, schedule: Schedule, encoder: Encoder, corpus: Corpus, seed: int, device: str, checkpoint: Path, recipe: dict) -> Household:
    """Trains, and returns the mean of the averaged weights, which is also left in `checkpoint`. Goes on from the files that an ended run of the same
    `recipe` left beside it.

    On CPUs every worker is a process with one thread and a part of the batch: they meet once per step, whereas threads meet
    in every operation and lose most of their time when something else runs beside them.
    """
    workers = schedule.workers if device == "cpu" else 1
    recipe = {**recipe, "shape": shape.to_dict(), "schedule": asdict(schedule), "workers": workers}
    if workers == 1:
        work(0, 1, shape, schedule, encoder, corpus, seed, device, checkpoint, recipe)
    else:
        with socket.create_server(("127.0.0.1", 0)) as server:
            os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(server.getsockname()[1]))
        arguments = (workers, shape, schedule, encoder, corpus, seed, device, checkpoint, recipe)
        torch.multiprocessing.start_processes(work, arguments, nprocs=workers, start_method="fork")
    return restore(checkpoint)


def work(rank: int, workers: int, shape: Shape, schedule: Schedule, encoder: Encoder, corpus: Corpus, seed: int, device: str, checkpoint: Path, recipe: dict) -> None:
    if workers > 1:
        torch.set_num_threads(1)
        torch.distributed.init_process_group("gloo", rank=rank, world_size=workers)
    torch.manual_seed(seed)
    model = Household(shape, schedule.dropout).to(device)
    torch.manual_seed(seed * workers + rank)
    averaged = {name: value.detach().clone() for name, value in model.state_dict().items()}
    kept = []
    # Processors without bfloat16 arithmetic imitate it, dozens of times slower than single precision.
    half = device != "cpu" or torch.cpu.get_capabilities().get("avx512_bf16", False)
    optimisers = optimisers_of(model, schedule, rank, workers, half)
    model.train()
    done, state = 0, None
    checkpoints = Checkpoints(checkpoint.parent, recipe, rank)
    if found := checkpoints.last(workers):
        done, state, kept = found["step"], found["draws"], found["kept"]
        model.load_state_dict(found["model"])
        averaged = {name: value.to(device) for name, value in found["averaged"].items()}
        for optimiser, was in zip(optimisers, found["optimisers"]):
            optimiser.load_state_dict(was)
        set_chance(device, found["chance"])
        kept = [{name: value.to(device) for name, value in one.items()} for one in kept]
        if not rank:
            print(f"goes on after step {done}", flush=True)
    began, running = time.monotonic(), 0.0
    for step, (batch, draws) in enumerate(batches(encoder, corpus, f"{seed} {rank}", schedule, device, done, state), done + 1):
        for group in (group for optimiser in optimisers for group in optimiser.param_groups):
            group["lr"] = rate_at(step - 1, schedule)
        with torch.autocast(device, torch.bfloat16, enabled=half):
            loss = loss_of(model, batch)
        model.zero_grad(set_to_none=True)
        loss.backward()
        if workers > 1:
            share_gradients(model, workers)
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        for optimiser in optimisers:
            optimiser.step()
        running += loss.item()
        if rank:
            if step % CHECKPOINT_STEPS == 0:
                checkpoints.keep(step, draws=draws, kept=[], model=model.state_dict(), averaged={}, optimisers=[o.state_dict() for o in optimisers], chance=chance(device))
            continue
        keep = min(schedule.average, step / (step + 9))
        with torch.no_grad():
            for name, value in model.state_dict().items():
                averaged[name].lerp_(value, 1 - keep)
        if step % 50 == 0:
            seconds = time.monotonic() - began
            speed = (step - done) * workers * schedule.rows * schedule.length / seconds
            print(f"step {step}/{schedule.until}  loss {running / 50:.4f}  {speed:.0f} tokens/s  {seconds:.0f} s", flush=True)
            running = 0.0
        to_go = schedule.until - step
        if to_go % schedule.apart == 0 and to_go < schedule.averages * schedule.apart:
            kept.append({name: value.clone() for name, value in averaged.items()})
        if to_go == 0:
            averaged = {name: sum(one[name] for one in kept) / len(kept) for name in averaged}
        if step % CHECKPOINT_STEPS == 0:
            checkpoints.keep(step, draws=draws, kept=kept, model=model.state_dict(), averaged=averaged, optimisers=[o.state_dict() for o in optimisers], chance=chance(device))
        if step % CHECKPOINT_STEPS == 0 or to_go == 0:
            torch.save({"shape": shape.to_dict(), "model": averaged, "step": step}, checkpoint)
    checkpoints.remove()
    if workers > 1:
        torch.distributed.destroy_process_group()


def chance(device: str) -> list[torch.Tensor]:
    """The state of the generators that dropout draws from."""
    return [torch.get_rng_state(), *([torch.cuda.get_rng_state()] if device == "cuda" else [])]


def set_chance(device: str, state: list[torch.Tensor]) -> None:
    torch.set_rng_state(state[0])
    if device == "cuda":
        torch.cuda.set_rng_state(state[1])


def optimisers_of(model: Household, schedule: Schedule, rank: int, workers: int, half: bool) -> list[torch.optim.Optimizer]:
    """Muon for the matrices of the blocks, Adam for the rest."""
    blocks = [(module.weight, parts) for block in model.blocks for module, parts in block.matrices()]
    inside = {id(weight) for weight, _ in blocks}
    rest = [p for p in model.parameters() if id(p) not in inside]
    groups = [{"params": [p for p in rest if p.dim() == 2], "weight_decay": schedule.weight_decay}, {"params": [p for p in rest if p.dim() != 2], "weight_decay": 0.0}]
    return [
        Muon([weight for weight, _ in blocks], [parts for _, parts in blocks], schedule.rate, schedule.weight_decay, rank=rank, workers=workers, half=half),
        torch.optim.AdamW(groups, lr=schedule.rate, betas=(0.9, 0.98), fused=True),
    ]


def share_gradients(model: Household, workers: int) -> None:
    """Replaces every worker's gradient by the mean over the workers."""
    gradients = [p.grad for p in model.parameters()]
    flat = torch.cat([g.flatten() for g in gradients])
    torch.distributed.all_reduce(flat)
    for gradient, part in zip(gradients, flat.div_(workers).split([g.numel() for g in gradients])):
        gradient.copy_(part.view_as(gradient))


def restore(checkpoint: Path) -> Household:
    saved = torch.load(checkpoint, weights_only=True, map_location="cpu")
    model = Household(Shape(**saved["shape"]))
    model.load_state_dict(saved["model"])
    return model.eval()
