"""Muon: momentum with matrices made orthogonal before the update (Jordan et al., 2024).

Every direction of a weight matrix changes at the same rate, however rarely the data use it. At this model's size it reaches the loss of Adam in
less than half the steps. Embedding, output and norms stay with Adam. `torch.optim.Muon` computes in bfloat16 even on processors that emulate
it, dozens of times slower than single precision; and it computes every matrix in every worker.
"""

from __future__ import annotations

import math

import torch

# A quintic iteration that moves every singular value from (0, 1] to about 1 (0.7 to 1.2) in five steps.
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
STEPS = 5


def orthogonalised(matrices: torch.Tensor, half: bool = False) -> torch.Tensor:
    """[number, rows, columns], with no more rows than columns: replaces the singular values of each by about 1, without computing them; in
    bfloat16 if `half`, which is exact enough."""
    a, b, c = COEFFICIENTS
    x = matrices / matrices.norm(dim=(1, 2), keepdim=True).clamp(min=1e-7)
    x = x.bfloat16() if half else x
    for _ in range(STEPS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.to(matrices.dtype)


def shared_out(parameters: list[torch.nn.Parameter], parts: list[int], workers: int) -> list[int]:
    """The worker that steps each parameter: the one with the least work so far."""
    loads, steppers = [0] * workers, []
    for parameter, number in zip(parameters, parts):
        rows, columns = sorted((parameter.size(0) // number, parameter.size(1)))
        steppers.append(loads.index(min(loads)))
        loads[steppers[-1]] += number * rows * rows * (4 * columns + 2 * rows)
    return steppers


class Muon(torch.optim.Optimizer):
    """One worker steps each matrix and shares the result with the others.

    `parts` is the number of matrices that are stacked in each parameter; each is made orthogonal separately.
    """

    def __init__(self, parameters, parts: list[int], rate: float, weight_decay: float, momentum: float = 0.95, rank: int = 0, workers: int = 1, half: bool = False):
        super().__init__(parameters, {"lr": rate, "weight_decay": weight_decay})
        self.parts, self.momentum, self.rank, self.workers, self.half = parts, momentum, rank, workers, half
        self.steppers = shared_out(parameters, parts, workers)

    @torch.no_grad()
    def step(self, closure=None) -> None:
        group = self.param_groups[0]
        own = [stepper == self.rank for stepper in self.steppers]
        updates = self.updates([(parameter, parts) for parameter, parts, mine in zip(group["params"], self.parts, own) if mine])
        if self.workers > 1:
            computed = iter(updates)
            updates = [next(computed) if mine else torch.zeros_like(parameter) for parameter, mine in zip(group["params"], own)]
            flat = torch.cat([u.flatten() for u in updates])
            torch.distributed.all_reduce(flat)
            updates = [part.view_as(u) for part, u in zip(flat.split([u.numel() for u in updates]), updates)]
        for parameter, update in zip(group["params"], updates):
            parameter.mul_(1 - group["lr"] * group["weight_decay"]).sub_(update * group["lr"])

    def updates(self, parameters: list[tuple[torch.nn.Parameter, int]]) -> list[torch.Tensor]:
        """The updates to subtract, before the rate. Matrices of equal shape are computed together, because a GPU is efficient with batches."""
        blocks: list[torch.Tensor] = []
        for parameter, parts in parameters:
            state = self.state[parameter]
            mean = state["mean"] if "mean" in state else state.setdefault("mean", torch.zeros_like(parameter))
            mean.lerp_(parameter.grad, 1 - self.momentum)
            blocks += parameter.grad.lerp(mean, self.momentum).chunk(parts)
        flat = [block.T if block.size(0) > block.size(1) else block for block in blocks]
        for shape in {block.shape for block in flat}:
            alike = [i for i, block in enumerate(flat) if block.shape == shape]
            for i, block in zip(alike, orthogonalised(torch.stack([flat[i] for i in alike]), self.half)):
                # The factor gives the update the size of an Adam update, so that rate and weight decay mean the same in both.
                block = block * (0.2 * math.sqrt(max(shape)))
                flat[i] = block if blocks[i].shape == shape else block.T
        given = iter(flat)
        return [torch.cat([next(given) for _ in range(parts)]) for _, parts in parameters]
