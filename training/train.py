"""Trains a model for a fixed number of steps."""

from __future__ import annotations

import math
import os
import platform
import random
import socket
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
import torch.distributed
import torch.multiprocessing
import torch.nn.functional as F
from torch.utils.data import DataLoader

from corpus import Corpus, Encoder, pack
from model import Household, Shape
from muon import Muon


# Steps between two checkpoints.
CHECKPOINT_STEPS = 200
# Processes that prepare batches, per CPU worker and per GPU: one prepares about 100 000 tokens a second, and an H100 trains on 860 000.
MAKERS = {"cpu": 0, "cuda": max(1, min(12, (os.cpu_count() or 1) - 2))}
# Steps on a GPU before the step is recorded.
UNRECORDED = 4


@dataclass(frozen=True)
class Schedule:
    """Length and rates of training. Training stops while the rate is still high; the result is the mean of moving averages of the weights."""

    steps: int = 11000  # over which the rate falls
    until: int = 6300  # training stops after this step
    workers: int = 2  # processes, on CPUs
    rows: int = 32  # of a batch, over all workers
    length: int = 192
    rate: float = 2e-3
    warm_up: int = 150
    weight_decay: float = 0.1
    dropout: float = 0.3
    average: float = 0.999  # decay of the moving average of the weights
    averages: int = 3  # number of averages in the result, the last one at the end
    apart: int = 700  # steps between two of them

    def within(self, until: int) -> Schedule:
        """The schedule for another number of steps, with the rate's fall and the averages in proportion. The warm-up stays the same, so below some
        600 steps the rate falls less."""
        part = until / self.until
        return replace(self, steps=max(1, round(self.steps * part)), until=until, apart=max(1, round(self.apart * part)))


def rate_at(step: int, schedule: Schedule) -> float:
    """Linear warm-up, then a cosine to a twentieth."""
    if step < schedule.warm_up:
        return schedule.rate * (step + 1) / schedule.warm_up
    progress = (step - schedule.warm_up) / max(1, schedule.steps - schedule.warm_up)
    return schedule.rate * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * progress)))


def loss_of(model: Household, batch: dict[str, torch.Tensor]) -> torch.Tensor:
    """Weighted cross-entropy, in nats, over the tokens with a weight."""
    hidden, target, weight = model(batch["token"], batch["position"], visible(batch)), batch["target"], batch["weight"]
    if not hidden.is_cuda:  # only if sizes may depend on the data
        wanted = weight > 0
        hidden, target, weight = hidden[wanted], target[wanted], weight[wanted]
    each = F.cross_entropy(model.logits(hidden).float().flatten(0, -2), target.flatten(), reduction="none")
    return (each * weight.flatten()).sum() / weight.sum()


def visible(batch: dict[str, torch.Tensor]) -> torch.Tensor:
    """[rows, 1, length, length]: whether a token sees another one. It sees earlier tokens of its sequence: the trunk as far as its branch does,
    and its own branch."""
    branch, sequence, place = batch["branch"], batch["sequence"], batch["place"]
    row, column = (lambda value: value[:, :, None]), (lambda value: value[:, None, :])
    trunk = (column(branch) == 0) & (column(place) < row(batch["sees"]))
    own = (column(branch) == row(branch)) & (row(branch) > 0)
    before = (row(sequence) == column(sequence)) & (column(place) <= row(place))
    return (before & (trunk | own))[:, None]


class Batches(torch.utils.data.Dataset):
    """Batch `n` depends only on the seed, the worker and `n`, not on the process or the restart."""

    def __init__(self, encoder: Encoder, corpus: Corpus, seed: str, rows: int, length: int):
        self.encoder, self.corpus, self.seed, self.rows, self.length = encoder, corpus, seed, rows, length

    def __getitem__(self, number: int) -> dict[str, torch.Tensor]:
        rng = random.Random(f"batches {self.seed} {number}")
        return {name: torch.from_numpy(value) for name, value in pack(self.encoder, self.corpus, rng, self.rows, self.length).items()}


class Checkpoints:
    """The state that workers need to continue: one file per worker at regular steps, so that all can continue from the last common step."""

    def __init__(self, folder: Path, recipe: dict, rank: int):
        self.folder, self.recipe, self.rank = folder, recipe, rank

    def path(self, rank: int, step: int) -> Path:
        return self.folder / f"resume-{step:06}-{rank}.pt"

    def steps(self, rank: int) -> list[int]:
        return sorted(int(path.name.split("-")[1]) for path in self.folder.glob(f"resume-*-{rank}.pt"))

    def last(self, workers: int) -> dict | None:
        """The files of the last step common to all workers; None if they have another recipe."""
        common = set.intersection(*(set(self.steps(rank)) for rank in range(workers)))
        if not common:
            return None
        # These are the program's own files; optimisers and generator states cannot be loaded as plain weights.
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


def train(
    shape: Shape, schedule: Schedule, encoder: Encoder, corpus: Corpus, seed: int, device: str, checkpoint: Path, recipe: dict,
    watch: Callable[[int, Household], None] | None = None,
) -> Household:
    """Trains, and returns the mean of the averaged weights, which `checkpoint` contains, too. Continues from the files of an interrupted run with
    the same `recipe`. `watch` is called with the averaged weights every `schedule.apart` steps.

    On CPUs every worker is a process with one thread and a part of the batch. They synchronise once per step, whereas threads synchronise in
    every operation and lose most of their time if other programs run.
    """
    workers = schedule.workers if device == "cpu" else 1
    recipe = {**recipe, "shape": shape.to_dict(), "schedule": asdict(schedule), "workers": workers}
    arguments = (workers, shape, schedule, encoder, corpus, seed, device, checkpoint, recipe, watch)
    if workers == 1:
        work(0, *arguments)
    else:
        with socket.create_server(("127.0.0.1", 0)) as server:
            os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(server.getsockname()[1]))
        torch.multiprocessing.start_processes(work, arguments, nprocs=workers, start_method="fork")
    return restore(checkpoint)


def work(
    rank: int, workers: int, shape: Shape, schedule: Schedule, encoder: Encoder, corpus: Corpus, seed: int, device: str, checkpoint: Path, recipe: dict,
    watch: Callable[[int, Household], None] | None,
) -> None:
    if workers > 1:
        torch.set_num_threads(1)
        torch.distributed.init_process_group("gloo", rank=rank, world_size=workers)
    checkpoints = Checkpoints(checkpoint.parent, recipe, rank)
    found = checkpoints.last(workers)
    done = found["step"] if found else 0
    # Forks the batch processes before this process uses the GPU.
    data = Batches(encoder, corpus, f"{seed} {rank}", schedule.rows // workers, schedule.length)
    ahead = {"num_workers": MAKERS[device], "prefetch_factor": 8, "pin_memory": True, "multiprocessing_context": "fork"} if MAKERS[device] else {}
    batches = iter(DataLoader(data, batch_size=None, sampler=range(done, schedule.until), **ahead))
    torch.manual_seed(seed)
    model = Household(shape, schedule.dropout).to(device)
    torch.manual_seed(seed * workers + rank)
    weights = dict(model.named_parameters())
    averaged = {name: value.detach().clone() for name, value in weights.items()}
    kept = []
    # Without tiles (AMX), processors compute bfloat16 slower than single precision: half as fast with AVX512_BF16, dozens of times slower in
    # emulation.
    half = device != "cpu" or torch.cpu.get_capabilities().get("amx_bf16", False)
    optimisers = optimisers_of(model, schedule, rank, workers, half)
    model.train()
    if found:
        model.load_state_dict(found["model"])
        if not rank:
            averaged = {name: value.to(device) for name, value in found["averaged"].items()}
            kept = [{name: value.to(device) for name, value in one.items()} for one in found["kept"]]
        for optimiser, was in zip(optimisers, found["optimisers"]):
            optimiser.load_state_dict(was)
        set_chance(device, found["chance"])
        if not rank:
            print(f"goes on after step {done}", flush=True)
    take = Step(model, optimisers, workers, half)
    began = time.monotonic()
    for step, batch in enumerate(batches, done + 1):
        take(batch, rate_at(step - 1, schedule))
        to_go = schedule.until - step
        if not rank:
            keep = min(schedule.average, step / (step + 9))
            with torch.no_grad():
                torch._foreach_lerp_(list(averaged.values()), list(weights.values()), 1 - keep)
            if step % 50 == 0:
                seconds = time.monotonic() - began
                speed = (step - done) * schedule.rows * schedule.length / seconds
                print(f"step {step}/{schedule.until}  loss {take.mean_loss():.4f}  {speed:.0f} tokens/s  {seconds:.0f} s", flush=True)
            if to_go % schedule.apart == 0 and to_go < schedule.averages * schedule.apart:
                kept.append({name: value.clone() for name, value in averaged.items()})
            if watch and to_go % schedule.apart == 0:
                watch(step, model_of(shape, averaged))
            if to_go == 0:
                averaged = {name: sum(one[name] for one in kept) / len(kept) for name in averaged}
            if step % CHECKPOINT_STEPS == 0 or to_go == 0:
                torch.save({"shape": shape.to_dict(), "model": averaged, "step": step, "environment": environment(device, workers)}, checkpoint)
        if step % CHECKPOINT_STEPS == 0 and to_go:
            own = {"kept": kept, "averaged": averaged} if not rank else {}
            checkpoints.keep(step, model=model.state_dict(), optimisers=[o.state_dict() for o in optimisers], chance=chance(device), **own)
    if workers > 1:
        # Checkpoint files stay until the result is written.
        torch.distributed.barrier()
        torch.distributed.destroy_process_group()
    checkpoints.remove()


class Step:
    """A training step: a batch's gradients, and the optimisers' updates.

    On a GPU the first few steps run normally; then the step is recorded and replayed: its thousand small kernels take longer to launch than to
    run.
    """

    def __init__(self, model: Household, optimisers: list[torch.optim.Optimizer], workers: int, half: bool):
        self.model, self.optimisers, self.workers, self.half = model, optimisers, workers, half
        self.device = model.embedding.weight.device
        self.loss, self.counted, self.taken = torch.zeros((), device=self.device), 0, 0
        self.batch: dict[str, torch.Tensor] = {}
        if self.device.type == "cuda":
            # A recorded step reads the rate from this tensor.
            self.rate, self.graph, self.beside = torch.zeros((), device=self.device), torch.cuda.CUDAGraph(), torch.cuda.Stream()
            self.set_rate(self.rate)

    def set_rate(self, rate: float | torch.Tensor) -> None:
        for group in (group for optimiser in self.optimisers for group in optimiser.param_groups):
            group["lr"] = rate

    def __call__(self, batch: dict[str, torch.Tensor], rate: float) -> None:
        self.taken += 1
        self.counted += 1
        if self.device.type == "cpu":
            self.batch = batch
            self.set_rate(rate)
            self.take()
            return
        self.rate.fill_(rate)
        for name, value in batch.items():
            if name in self.batch:
                self.batch[name].copy_(value, non_blocking=True)
            else:
                self.batch[name] = value.to(self.device)
        if self.taken <= UNRECORDED:
            self.beside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(self.beside):
                self.take()
            torch.cuda.current_stream().wait_stream(self.beside)
            return
        if self.taken == UNRECORDED + 1:
            self.model.zero_grad(set_to_none=True)
            # The loader's thread may allocate pinned memory during the recording.
            with torch.cuda.graph(self.graph, capture_error_mode="thread_local"):
                self.take()
        self.graph.replay()

    def take(self) -> None:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.half, cache_enabled=False):
            loss = loss_of(self.model, self.batch)
        self.model.zero_grad(set_to_none=True)
        loss.backward()
        if self.workers > 1:
            share_gradients(self.model, self.workers)
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        for optimiser in self.optimisers:
            optimiser.step()
        self.loss += loss.detach()

    def mean_loss(self) -> float:
        """Mean loss since the last call."""
        mean = self.loss.item() / self.counted
        self.loss.zero_()
        self.counted = 0
        return mean


def chance(device: str) -> list[torch.Tensor]:
    """The states of the generators for dropout."""
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
        torch.optim.AdamW(groups, lr=schedule.rate, betas=(0.9, 0.98), fused=True, capturable=model.embedding.weight.is_cuda),
    ]


def share_gradients(model: Household, workers: int) -> None:
    """Replaces every worker's gradient by the mean over the workers."""
    gradients = [p.grad for p in model.parameters()]
    flat = torch.cat([g.flatten() for g in gradients])
    torch.distributed.all_reduce(flat)
    for gradient, part in zip(gradients, flat.div_(workers).split([g.numel() for g in gradients])):
        gradient.copy_(part.view_as(gradient))


def environment(device: str, workers: int) -> dict[str, str]:
    """The software and hardware of a training: another environment gives another file."""
    name = torch.cuda.get_device_name() if device == "cuda" else f"{workers} processes"
    return {"python": platform.python_version(), "torch": str(torch.__version__), "device": name, "machine": platform.machine()}


def model_of(shape: Shape, weights: dict[str, torch.Tensor]) -> Household:
    """Does not use the generators of training."""
    with torch.random.fork_rng(devices=[]):
        model = Household(shape).to(weights["embedding.weight"].device)
    model.load_state_dict(weights)
    return model.eval()


def restore(checkpoint: Path) -> Household:
    saved = torch.load(checkpoint, weights_only=True, map_location="cpu")
    return model_of(Shape(**saved["shape"]), saved["model"])
