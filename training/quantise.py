"""Rounds a trained model's matrices to four bits (IQ4_NL), so that its outputs change least on the training text.

    python training/quantise.py --shared DATA household-f32.gguf models/household.gguf

Plain rounding takes the nearest step for each weight. Here later columns of a matrix compensate for the rounding of earlier ones, weighted by
the matrix's inputs on the training text (GPTQ, Frantar et al. 2023). Each matrix is fitted to the inputs from the rounded matrices before it.
"""

from __future__ import annotations

import argparse
import random
from pathlib import Path

import gguf
import numpy as np

import data
import routines
from corpus import Corpus, scene_labels
from things import Things

ROOT = Path(__file__).resolve().parent.parent
KIND, FILE_KIND, BLOCK = gguf.GGMLQuantizationType.IQ4_NL, gguf.LlamaFileType.MOSTLY_IQ4_NL, 32
STEPS = np.array([-127, -104, -83, -65, -49, -35, -22, -10, 1, 13, 25, 38, 53, 69, 89, 113], np.float32)
# The index of the nearest step for each half from -128 to 128.
NEAREST = np.abs(np.arange(-256, 257)[:, None] / 2 - STEPS).argmin(1)
# Fractions of the plain scale to try for each block, of either sign.
FACTORS = np.r_[np.linspace(0.7, 1.25, 23), -np.linspace(0.8, 1.25, 16)]
# Added to the second moments, as a share of their mean, so that rarely used columns stay bounded.
DAMPING = 0.01
# The token table is both output and input matrix. As input, all of its columns have the same weight.
INPUT_SHARE = 0.3
SEQUENCES = 3000
BATCH_TOKENS = 16384
TABLE = "token_embd.weight"


def numbers(scaled: np.ndarray) -> np.ndarray:
    return NEAREST[np.clip(np.rint(2 * scaled), -256, 256).astype(np.int16) + 256]


def divisor(scale: np.ndarray) -> np.ndarray:
    return np.where(scale == 0, 1, scale)


def half(scale: np.ndarray) -> np.ndarray:
    return scale.astype(np.float16).astype(np.float32)


def scales(block: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """For each row of a block the half-precision scale with the least weighted error."""
    plain = np.take_along_axis(block, np.abs(block).argmax(1)[:, None], 1) / STEPS[0]
    best, least = half(plain), np.full((len(block), 1), np.inf, np.float32)
    for factor in FACTORS:
        scale = half(plain * factor)
        steps = STEPS[numbers(block / divisor(scale))]
        power = (weight * steps * steps).sum(1, keepdims=True)
        scale = half((weight * block * steps).sum(1, keepdims=True) / divisor(power))
        steps = STEPS[numbers(block / divisor(scale))]
        error = (weight * (block - scale * steps) ** 2).sum(1, keepdims=True)
        best, least = np.where(error < least, scale, best), np.minimum(error, least)
    return best


def rounded(matrix: np.ndarray, moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The matrix as llama.cpp will read it, and the file's bytes. `moments` are sums of products of its inputs."""
    matrix, (rows, columns) = matrix.copy(), matrix.shape
    moments = moments.astype(np.float64) + DAMPING * np.mean(np.diag(moments)) * np.eye(columns)
    upper = np.linalg.cholesky(np.linalg.inv(moments)).T.astype(np.float32)
    out, packed = np.empty_like(matrix), []
    for start in range(0, columns, BLOCK):
        end = start + BLOCK
        scale = scales(matrix[:, start:end], 1 / np.diag(upper)[start:end] ** 2)
        chosen, errors = np.empty((rows, BLOCK), np.uint8), np.empty((rows, BLOCK), np.float32)
        for k in range(BLOCK):
            at = start + k
            chosen[:, k] = numbers(matrix[:, at] / divisor(scale)[:, 0])
            out[:, at] = scale[:, 0] * STEPS[chosen[:, k]]
            errors[:, k] = (matrix[:, at] - out[:, at]) / upper[at, at]
            matrix[:, at + 1 : end] -= errors[:, k : k + 1] * upper[at, at + 1 : end]
        matrix[:, end:] -= errors @ upper[start:end, end:]
        packed += [scale.astype(np.float16).view(np.uint8), chosen[:, :16] | chosen[:, 16:] << 4]
    return out, np.concatenate(packed, 1)


class Cutter:
    """Tokenises text with the file's own vocabulary like sentencepiece: the best pair of neighbours is merged first."""

    def __init__(self, reader: gguf.GGUFReader):
        pieces = reader.fields["tokenizer.ggml.tokens"].contents()
        self.ids = {piece: i for i, piece in reversed(list(enumerate(pieces)))}
        self.scores, self.known = reader.fields["tokenizer.ggml.scores"].contents(), {}
        self.begin = reader.fields["tokenizer.ggml.bos_token_id"].contents()

    def cut(self, text: str) -> list[int]:
        if text not in self.known:
            parts = list("\u2581" + text.replace(" ", "\u2581"))
            while pairs := [(-self.scores[self.ids[a + b]], k) for k, (a, b) in enumerate(zip(parts, parts[1:])) if a + b in self.ids]:
                _, k = min(pairs)
                parts[k : k + 2] = ["".join(parts[k : k + 2])]
            bytes_of = lambda part: [self.ids[f"<0x{byte:02X}>"] for byte in part.encode()]
            self.known[text] = [i for part in parts for i in ([self.ids[part]] if part in self.ids else bytes_of(part))]
        return self.known[text]


def batches(corpus: Corpus, cutter: Cutter, number: int, seed: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Prompts with their answers: tokens, a mask of the text without padding, and a mask of the answered tokens."""
    rng, rows = random.Random(f"quantise {seed}"), []
    while len(rows) < number:
        drawn = corpus.draw(rng)
        if not drawn.branches:
            continue
        branch = rng.choice(drawn.branches)
        asked = [cutter.begin] + [i for text in (*drawn.sentences[: branch.after], branch.binding) for i in cutter.cut(text)]
        rows.append((asked, cutter.cut(branch.label)))
    rows.sort(key=lambda row: len(row[0]) + len(row[1]))
    out = []
    while rows:
        width = len(rows[-1][0]) + len(rows[-1][1])
        count = max(1, BATCH_TOKENS // width)
        taken, rows = rows[-count:], rows[:-count]
        tokens, text, answered = np.zeros((len(taken), width), int), np.zeros((len(taken), width), bool), np.zeros((len(taken), width), bool)
        for k, (asked, label) in enumerate(taken):
            size = len(asked) + len(label)
            tokens[k, :size], text[k, :size], answered[k, len(asked) - 1 : size - 1] = asked + label, True, True
        out.append((tokens, text, answered))
    return out


class Llama:
    """The model's arithmetic in single precision, one layer at a time."""

    def __init__(self, reader: gguf.GGUFReader):
        number = lambda key: reader.fields[f"llama.{key}"].contents()
        self.layers, self.heads, self.base = number("block_count"), number("attention.head_count"), number("rope.freq_base")
        self.epsilon = np.float32(number("attention.layer_norm_rms_epsilon"))
        shape = lambda tensor: [int(extent) for extent in reversed(tensor.shape)]
        self.weights = {t.name: gguf.quants.dequantize(t.data, t.tensor_type).astype(np.float32).reshape(shape(t)) for t in reader.tensors}

    def normal(self, x: np.ndarray, name: str) -> np.ndarray:
        return x / np.sqrt((x * x).mean(-1, keepdims=True) + self.epsilon) * self.weights[name]

    def turned(self, x: np.ndarray) -> np.ndarray:
        """Heads of [batch, time, width], with neighbouring pairs rotated by their position: [batch, heads, time, head width]."""
        x = x.reshape(*x.shape[:2], self.heads, -1).transpose(0, 2, 1, 3)
        angle = np.arange(x.shape[2])[:, None] * self.base ** (-np.arange(0, x.shape[3], 2) / x.shape[3])
        cos, sin, out = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32), np.empty_like(x)
        out[..., 0::2], out[..., 1::2] = x[..., 0::2] * cos - x[..., 1::2] * sin, x[..., 0::2] * sin + x[..., 1::2] * cos
        return out

    def attended(self, query: np.ndarray, key: np.ndarray, value: np.ndarray) -> np.ndarray:
        batch, time, width = query.shape
        value = value.reshape(batch, time, self.heads, -1).transpose(0, 2, 1, 3)
        scores = self.turned(query) @ self.turned(key).swapaxes(2, 3) / np.float32(np.sqrt(width // self.heads))
        scores += np.triu(np.full((time, time), -1e30, np.float32), 1)
        scores = np.exp(scores - scores.max(-1, keepdims=True))
        return (scores / scores.sum(-1, keepdims=True) @ value).transpose(0, 2, 1, 3).reshape(batch, time, width)

    def run(self, inputs: list[np.ndarray], see=lambda names, inputs: None) -> list[np.ndarray]:
        """Hidden states of embedded tokens, batch by batch; calls `see` with each matrix's inputs before the matrix is used."""
        for layer in range(self.layers):
            name = lambda part: f"blk.{layer}.{part}.weight"
            times = lambda xs, part: [x @ self.weights[name(part)].T for x in xs]
            normal = [self.normal(x, name("attn_norm")) for x in inputs]
            see([name("attn_q"), name("attn_k"), name("attn_v")], normal)
            mixed = [self.attended(*of) for of in zip(*(times(normal, part) for part in ("attn_q", "attn_k", "attn_v")))]
            see([name("attn_output")], mixed)
            inputs = [x + y for x, y in zip(inputs, times(mixed, "attn_output"))]
            normal = [self.normal(x, name("ffn_norm")) for x in inputs]
            see([name("ffn_gate"), name("ffn_up")], normal)
            inner = [gate / (1 + np.exp(-gate)) * up for gate, up in zip(times(normal, "ffn_gate"), times(normal, "ffn_up"))]
            see([name("ffn_down")], inner)
            inputs = [x + y for x, y in zip(inputs, times(inner, "ffn_down"))]
        return [self.normal(x, "output_norm.weight") for x in inputs]


def moments(inputs: list[np.ndarray], wanted: list[np.ndarray]) -> np.ndarray:
    return sum(x[which].T @ x[which] for x, which in zip(inputs, wanted))


def quantise(source: Path, target: Path, corpus: Corpus, seed: int) -> None:
    """Writes the file's model with every matrix rounded to four bits. Everything else stays the same."""
    reader = gguf.GGUFReader(source)
    model, packed = Llama(reader), {}
    tokens, text, answered = zip(*batches(corpus, Cutter(reader), SEQUENCES, seed))
    table = model.weights[TABLE]
    hidden = moments(model.run([table[ids] for ids in tokens]), answered)
    hidden += INPUT_SHARE * np.mean(np.diag(hidden)) * np.eye(len(hidden))
    model.weights[TABLE], packed[TABLE] = rounded(table, hidden)

    def see(names: list[str], inputs: list[np.ndarray]) -> None:
        of = moments(inputs, text)
        for name in names:
            model.weights[name], packed[name] = rounded(model.weights[name], of)

    model.run([model.weights[TABLE][ids] for ids in tokens], see)
    writer = gguf.GGUFWriter(target, "llama")
    for field in reader.fields.values():
        if field.name == "general.file_type":
            writer.add_file_type(FILE_KIND)
        elif not field.name.startswith("GGUF.") and field.name != "general.architecture":
            inner = field.types[-1] if field.types[0] == gguf.GGUFValueType.ARRAY else None
            writer.add_key_value(field.name, field.contents(), field.types[0], sub_type=inner)
    for name, value in model.weights.items():
        if name in packed:
            writer.add_tensor(name, packed[name], raw_dtype=KIND)
        else:
            writer.add_tensor(name, value)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--shared", type=Path, required=True, help="folder with virtualhome/ and homer_plus/")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("source", type=Path, help="the model in single precision (or in eight bits)")
    arguments.add_argument("target", type=Path)
    given = arguments.parse_args()
    trained_on = lambda cluster: data.split_of(cluster, dev=False) == "train"
    programs = [program for program in data.virtualhome(given.shared) if trained_on(program.cluster)]
    own = [routine for routine in routines.load(ROOT / "training/routines") if trained_on(routine.cluster)]
    scenes = scene_labels(given.shared, ROOT / "scenes")
    corpus = Corpus(programs, data.homer(given.shared), own, scenes, Things.load(ROOT / "training/things"))
    quantise(given.source, given.target, corpus, given.seed)


if __name__ == "__main__":
    main()
