"""A llama-architecture language model, small enough to answer in about four milliseconds on two idle cores.

The layout is llama.cpp's `llama`: pre-norm blocks with RMS normalisation, rotary positions, gated SiLU feed-forward, no biases. Embedding and
output share one matrix.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import torch
import torch.nn.functional as F
from torch import nn


@dataclass(frozen=True)
class Shape:
    """The sizes of a model. Every width is a multiple of 32, the block size of Q8_0."""

    vocab: int = 6144
    width: int = 384
    layers: int = 5
    heads: int = 12
    feed_forward: int = 1024
    context: int = 2048
    rope_base: float = 10000.0
    norm_epsilon: float = 1e-5

    def to_dict(self) -> dict:
        return asdict(self)


class RmsNorm(nn.Module):
    def __init__(self, width: int, epsilon: float):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.epsilon = epsilon

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.rms_norm(x, (x.shape[-1],), self.weight, self.epsilon)


def rotate(x: torch.Tensor, cos: torch.Tensor, sin: torch.Tensor) -> torch.Tensor:
    """Rotates pairs (i, i + half) of the last axis. x: [batch, heads, time, head width].

    Contiguous halves are much faster here than llama.cpp's neighbouring pairs; the export reorders the rows.
    """
    first, second = x.chunk(2, dim=-1)
    return torch.cat((first * cos - second * sin, first * sin + second * cos), dim=-1)


class Block(nn.Module):
    def __init__(self, shape: Shape, dropout: float):
        super().__init__()
        width = shape.width
        self.heads, self.head_width, self.dropout = shape.heads, width // shape.heads, dropout
        self.attention_norm = RmsNorm(width, shape.norm_epsilon)
        self.query_key_value = nn.Linear(width, 3 * width, bias=False)
        self.attention_out = nn.Linear(width, width, bias=False)
        self.feed_norm = RmsNorm(width, shape.norm_epsilon)
        self.gate_up = nn.Linear(width, 2 * shape.feed_forward, bias=False)
        self.down = nn.Linear(shape.feed_forward, width, bias=False)

    def matrices(self) -> list[tuple[nn.Linear, int]]:
        """The block's layers, each with the number of matrices in it."""
        return [(self.query_key_value, 3), (self.attention_out, 1), (self.gate_up, 2), (self.down, 1)]

    def forward(self, x, cos, sin, mask):
        batch, time, width = x.shape
        q, k, v = (
            part.view(batch, time, self.heads, self.head_width).transpose(1, 2)
            for part in self.query_key_value(self.attention_norm(x)).split(width, dim=-1)
        )
        q, k = rotate(q, cos, sin), rotate(k, cos, sin)
        if x.is_cuda:
            mixed = F.scaled_dot_product_attention(q, k, v, mask)
        else:
            # Not torch's fused attention: on processors that is slower in bfloat16, and not faster in single precision.
            attention = q * self.head_width**-0.5 @ k.transpose(-1, -2)
            mixed = attention.masked_fill(~mask, -math.inf).softmax(-1).to(v.dtype) @ v
        mixed = self.attention_out(mixed.transpose(1, 2).reshape(batch, time, width))
        x = x + F.dropout(mixed, self.dropout, self.training)
        gate, up = self.gate_up(self.feed_norm(x)).chunk(2, dim=-1)
        return x + F.dropout(self.down(F.silu(gate) * up), self.dropout, self.training)


class Household(nn.Module):
    """Token ids [batch, time], positions [batch, time] and a mask [batch, 1, time, time] to hidden states."""

    def __init__(self, shape: Shape, dropout: float = 0.0):
        super().__init__()
        self.shape, self.dropout = shape, dropout
        self.embedding = nn.Embedding(shape.vocab, shape.width)
        self.blocks = nn.ModuleList(Block(shape, dropout) for _ in range(shape.layers))
        self.norm = RmsNorm(shape.width, shape.norm_epsilon)
        head_width = shape.width // shape.heads
        frequency = shape.rope_base ** (-torch.arange(0, head_width, 2).float() / head_width)
        self.register_buffer("frequency", frequency, persistent=False)
        for name, parameter in self.named_parameters():
            if parameter.dim() == 2:
                scale = 0.02 if "embedding" in name else 1.0 / math.sqrt(parameter.shape[1])
                if name.endswith(("attention_out.weight", "down.weight")):
                    scale /= math.sqrt(2 * shape.layers)
                nn.init.normal_(parameter, std=scale)

    def forward(self, tokens, positions, mask) -> torch.Tensor:
        angle = positions[:, None, :, None].float() * self.frequency
        cos, sin = angle.cos(), angle.sin()
        if torch.is_autocast_enabled(tokens.device.type):
            cos, sin = cos.bfloat16(), sin.bfloat16()
        x = F.dropout(self.embedding(tokens), self.dropout, self.training)
        for block in self.blocks:
            x = block(x, cos, sin, mask)
        return self.norm(x)

    def logits(self, hidden: torch.Tensor) -> torch.Tensor:
        return hidden @ self.embedding.weight.T

    def parameter_count(self) -> int:
        return sum(p.numel() for p in self.parameters())
