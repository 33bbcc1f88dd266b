"""Trains a model for a fixed number of steps."""

from __future__ import annotations

import math
import random
import time
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from threading import Thread

import torch
import torch.nn.functional as F

from corpus import Corpus, Encoder, pack
from model import Household, Shape


@dataclass(frozen=True)
class Schedule:
    steps: int = 4000
    rows: int = 8
    length: int = 384
    rate: float = 2e-3
    warm_up: int = 150
    weight_decay: float = 0.1
    dropout: float = 0.1
    average: float = 0.998  # decay of the moving average of the weights that is shipped


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


def batches(encoder: Encoder, corpus: Corpus, seed: int, schedule: Schedule, device: str):
    """Batches in a fixed order, one made ahead."""
    queue: Queue = Queue(maxsize=4)

    def produce():
        rng = random.Random(f"batches {seed}")
        for _ in range(schedule.steps):
            queue.put({n: torch.from_numpy(v) for n, v in pack(encoder, corpus, rng, schedule.rows, schedule.length).items()})

    Thread(target=produce, daemon=True).start()
    for _ in range(schedule.steps):
        yield {name: value.to(device) for name, value in queue.get().items()}


def train(shape: Shape, schedule: Schedule, encoder: Encoder, corpus: Corpus, seed: int, device: str, checkpoint: Path, every: int = 250) -> Household:
    torch.manual_seed(seed)
    model = Household(shape, schedule.dropout).to(device)
    averaged = {name: value.detach().clone() for name, value in model.state_dict().items()}
    matrices = [p for n, p in model.named_parameters() if p.dim() == 2]
    others = [p for n, p in model.named_parameters() if p.dim() != 2]
    groups = [{"params": matrices, "weight_decay": schedule.weight_decay}, {"params": others, "weight_decay": 0.0}]
    optimiser = torch.optim.AdamW(groups, lr=schedule.rate, betas=(0.9, 0.98), fused=True)
    model.train()
    began, running = time.monotonic(), 0.0
    for step, batch in enumerate(batches(encoder, corpus, seed, schedule, device)):
        for group in optimiser.param_groups:
            group["lr"] = rate_at(step, schedule)
        with torch.autocast(device, torch.bfloat16):
            loss = loss_of(model, batch)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        keep = min(schedule.average, (step + 1) / (step + 10))
        with torch.no_grad():
            for name, value in model.state_dict().items():
                averaged[name].lerp_(value, 1 - keep)
        running += loss.item()
        if (step + 1) % 50 == 0:
            seconds = time.monotonic() - began
            speed = (step + 1) * schedule.rows * schedule.length / seconds
            print(f"step {step + 1}/{schedule.steps}  loss {running / 50:.4f}  {speed:.0f} tokens/s  {seconds:.0f} s", flush=True)
            running = 0.0
        if (step + 1) % every == 0 or step + 1 == schedule.steps:
            torch.save({"shape": shape.to_dict(), "model": averaged, "step": step + 1}, checkpoint)
    model.load_state_dict(averaged)
    return model.eval()


def restore(checkpoint: Path) -> Household:
    saved = torch.load(checkpoint, weights_only=True, map_location="cpu")
    model = Household(Shape(**saved["shape"]))
    model.load_state_dict(saved["model"])
    return model.eval()
