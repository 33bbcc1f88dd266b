"""Models of real size without their weights: GGUF files with the shapes of known models and random values.

    python shapes.py smollm2-135m qwen2.5-0.5b --kind q4_0 --out DIR

A model's speed depends on its shape and quantisation, and hardly on its values. So these files have the layers, widths, heads, feed-forward,
vocabulary, rope base and tied or untied embeddings of the originals, and seeded random weights with a scale that keeps activations and logits
finite and moderate. They contain nothing of the originals: the vocabulary is trained on Roomcast's own texts and padded to the original size.
Quantised matrices are drawn as blocks of their format (random digits under a common scale), so a file of seven billion weights takes about a
minute.
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import json
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import gguf
import numpy as np
import sentencepiece

ROOT = Path(__file__).resolve().parents[2]
Kind = gguf.GGMLQuantizationType


@dataclasses.dataclass(frozen=True)
class Shape:
    """The shape of a model, from the config.json that its authors publish."""

    architecture: str
    layers: int
    width: int
    heads: int
    kv_heads: int
    feed_forward: int
    vocabulary: int
    rope_base: float
    norm_epsilon: float
    context: int
    tied: bool

    @property
    def head_width(self) -> int:
        return self.width // self.heads

    @property
    def kv_width(self) -> int:
        return self.kv_heads * self.head_width


SHAPES = {
    "smollm2-135m": Shape("llama", 30, 576, 9, 3, 1536, 49152, 100_000.0, 1e-5, 8192, tied=True),
    "qwen2.5-0.5b": Shape("qwen2", 24, 896, 14, 2, 4864, 151_936, 1_000_000.0, 1e-6, 32_768, tied=True),
    "tinyllama-1.1b": Shape("llama", 22, 2048, 32, 4, 5632, 32_000, 10_000.0, 1e-5, 2048, tied=False),
    "llama-2-7b": Shape("llama", 32, 4096, 32, 32, 11_008, 32_000, 10_000.0, 1e-5, 4096, tied=False),
}
FILE_TYPES = {
    "f16": gguf.LlamaFileType.MOSTLY_F16,
    "q8_0": gguf.LlamaFileType.MOSTLY_Q8_0,
    "q4_0": gguf.LlamaFileType.MOSTLY_Q4_0,
    "q4_k": gguf.LlamaFileType.MOSTLY_Q4_K_S,
}
UNKNOWN, BEGIN, END = 0, 1, 2
# With this many pieces, a narration has about as many tokens per word, and a flat's labels about as many inner nodes, as with general vocabularies:
# 29 of 141 nodes, and 28 of 137 with one that knows these words (`benches/peers/run` prints them).
LEARNT_PIECES = 2000


def texts() -> Iterator[str]:
    """Narrations and labels of Roomcast's data: words that a general vocabulary has as a whole. Documents are left out, because their words would
    displace the labels', and every new page would change the trie."""
    labels = sorted({item["label"] for path in ROOT.glob("scenes/*.json") for item in json.loads(path.read_text())["items"]})
    actions = tomllib.loads((ROOT / "core/src/narration/actions.toml").read_text())
    for action in actions.values():
        for tail in action["tails"]:
            for subject, verb in (("They", action["base"]), ("She", action["third"])):
                for label in labels[:: max(1, len(labels) // 8)]:
                    yield f"{subject} {verb} {tail.format(label, labels[0])}."
    yield from labels * 5
    yield from ["Next, the human will go to the"] * 20


def vocabulary(size: int) -> sentencepiece.SentencePieceProcessor:
    """A byte-fallback BPE vocabulary of words and pieces of words; the same on every machine."""
    model = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=texts(), model_writer=model, vocab_size=min(size, LEARNT_PIECES), model_type="bpe", byte_fallback=True,
        normalization_rule_name="identity", remove_extra_whitespaces=False, add_dummy_prefix=True, character_coverage=1.0,
        required_chars="".join(map(chr, range(33, 127))), unk_id=UNKNOWN, bos_id=BEGIN, eos_id=END, pad_id=-1, num_threads=1,
        hard_vocab_limit=False, minloglevel=2,
    )
    return sentencepiece.SentencePieceProcessor(model_proto=model.getvalue())


def add_vocabulary(writer: gguf.GGUFWriter, size: int) -> None:
    learnt = vocabulary(size)
    pieces, scores, types = [], [], []
    for index in range(size):
        if index < learnt.vocab_size():
            pieces.append(learnt.id_to_piece(index).encode())
            scores.append(learnt.get_score(index))
            types.append(
                gguf.TokenType.UNKNOWN if learnt.is_unknown(index)
                else gguf.TokenType.CONTROL if learnt.is_control(index)
                else gguf.TokenType.BYTE if learnt.is_byte(index)
                else gguf.TokenType.NORMAL
            )
        else:  # No merge produces them.
            pieces.append(f"<filler{index}>".encode())
            scores.append(-1e6)
            types.append(gguf.TokenType.UNUSED)
    writer.add_tokenizer_model("llama")
    writer.add_tokenizer_pre("default")
    writer.add_token_list(pieces)
    writer.add_token_scores(scores)
    writer.add_token_types(types)
    writer.add_bos_token_id(BEGIN)
    writer.add_eos_token_id(END)
    writer.add_unk_token_id(UNKNOWN)
    writer.add_add_bos_token(True)
    writer.add_add_eos_token(False)
    writer.add_add_space_prefix(True)


def blocks(kind: Kind, rows: int, columns: int, std: float, rng: np.random.Generator) -> np.ndarray:
    """Random values with a standard deviation of about `std`, in the bytes of a format: one row of bytes per row of the matrix."""
    if kind == Kind.F32:
        return rng.standard_normal((rows, columns), np.float32) * np.float32(std)
    if kind == Kind.F16:
        return (rng.standard_normal((rows, columns), np.float32) * np.float32(std)).astype(np.float16)
    elements, size = gguf.GGML_QUANT_SIZES[kind]
    if columns % elements:
        raise ValueError(f"{kind.name} needs rows of a multiple of {elements}, not of {columns}: choose q8_0 or q4_0 for this shape")
    count = rows * columns // elements
    out = np.frombuffer(rng.bytes(count * size), np.uint8).reshape(count, size).copy()

    def put(at: int, value: np.ndarray | np.floating) -> None:
        """Writes bytes or half-precision numbers at offset `at` of every block: one for all blocks, or one per block."""
        data = np.ascontiguousarray(value).view(np.uint8)
        out[:, at : at + data.shape[-1]] = data

    def half(value: float) -> np.ndarray:
        return np.array([value], np.float16)

    if kind == Kind.Q8_0:  # scale, 32 signed bytes; uniform over -128..127 has a deviation of 73.9
        put(0, half(std / 73.9))
    elif kind == Kind.Q4_0:  # scale, 32 digits 0..15 less 8: 4.61
        put(0, half(std / 4.61))
    elif kind == Kind.Q6_K:  # 256 digits of 6 bits less 32 (18.5), 16 signed scales, scale
        put(192, np.full(16, 64, np.uint8))
        put(208, half(std / (64 * 18.5)))
    elif kind == Kind.Q4_K:  # scale, scale of the minima, 8 pairs of 6 bits in 12 bytes, 256 digits 0..15
        # Every scale and minimum is 32, with two of its bits in another byte; 7.5 is the mean of a digit.
        put(0, half(std / (32 * 4.61)))
        put(2, half(7.5 * std / (32 * 4.61)))
        put(4, np.array([32 | 2 << 6] * 8 + [0] * 4, np.uint8))
    else:
        raise ValueError(f"no random blocks for {kind.name}")
    return out.reshape(rows, columns // elements * size)


def tensors(shape: Shape, kind: str) -> Iterator[tuple[str, tuple[int, ...], Kind, float]]:
    """Name, shape (rows first), format and deviation of every tensor; norms have a deviation of 0 and are ones."""
    width, kv_width, feed = shape.width, shape.kv_width, shape.feed_forward
    body = {"f16": Kind.F16, "q8_0": Kind.Q8_0, "q4_0": Kind.Q4_0, "q4_k": Kind.Q4_K}[kind]
    # As llama.cpp's quantiser, keeps the output matrix at a higher precision.
    coarse = kind in ("q4_0", "q4_k")
    logits = (Kind.Q6_K if width % 256 == 0 else Kind.Q8_0) if coarse else body
    # Logits with a deviation of about 2.5 nats, so that the next token is neither certain nor uniform.
    vocabulary_std = 2.5 / width**0.5
    yield "token_embd.weight", (shape.vocabulary, width), logits if shape.tied else body, vocabulary_std
    residual = 1 / (2 * shape.layers) ** 0.5
    for layer in range(shape.layers):
        name = f"blk.{layer}."
        yield name + "attn_norm.weight", (width,), Kind.F32, 0.0
        for part, rows in (("q", width), ("k", kv_width), ("v", kv_width)):
            yield f"{name}attn_{part}.weight", (rows, width), body, width**-0.5
            if shape.architecture == "qwen2":
                yield f"{name}attn_{part}.bias", (rows,), Kind.F32, 0.1
        yield name + "attn_output.weight", (width, width), body, residual * width**-0.5
        yield name + "ffn_norm.weight", (width,), Kind.F32, 0.0
        yield name + "ffn_gate.weight", (feed, width), body, width**-0.5
        yield name + "ffn_up.weight", (feed, width), body, width**-0.5
        yield name + "ffn_down.weight", (width, feed), body, residual * feed**-0.5
    yield "output_norm.weight", (width,), Kind.F32, 0.0
    if not shape.tied:
        yield "output.weight", (shape.vocabulary, width), logits, vocabulary_std


def write(name: str, kind: str, path: Path, seed: int = 1) -> None:
    """Writes one file, tensor by tensor, with at most one tensor in memory."""
    shape = SHAPES[name]
    writer = gguf.GGUFWriter(path, shape.architecture)
    writer.add_name(f"{name} shape, random weights")
    writer.add_description(f"random values in the shape of {name}, to measure speed with; it has learnt nothing")
    writer.add_license("Apache-2.0 OR MIT")
    writer.add_context_length(shape.context)
    writer.add_embedding_length(shape.width)
    writer.add_block_count(shape.layers)
    writer.add_feed_forward_length(shape.feed_forward)
    writer.add_head_count(shape.heads)
    writer.add_head_count_kv(shape.kv_heads)
    writer.add_layer_norm_rms_eps(shape.norm_epsilon)
    writer.add_rope_dimension_count(shape.head_width)
    writer.add_rope_freq_base(shape.rope_base)
    writer.add_vocab_size(shape.vocabulary)
    writer.add_file_type(FILE_TYPES[kind])
    add_vocabulary(writer, shape.vocabulary)
    planned = list(tensors(shape, kind))
    for tensor, dimensions, format_, _ in planned:
        elements, size = gguf.GGML_QUANT_SIZES[format_]
        count = int(np.prod(dimensions))
        writer.add_tensor_info(tensor, dimensions, np.float32, count // elements * size, raw_dtype=format_)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_ti_data_to_file()
    rng = np.random.default_rng(seed)
    for tensor, dimensions, format_, std in planned:
        if len(dimensions) == 2:
            data = blocks(format_, *dimensions, std, rng)
        elif std:
            data = rng.standard_normal(dimensions, np.float32) * np.float32(std)
        else:
            data = np.ones(dimensions, np.float32)
        writer.write_tensor_data(data)
    writer.close()


def widened(source: Path, out: Path) -> None:
    """Writes the same model with every tensor in f32: the same values, computed without quantised products."""
    reader = gguf.GGUFReader(source)
    writer = gguf.GGUFWriter(out, reader.get_field("general.architecture").contents())
    for key, field in reader.fields.items():
        if key.startswith("GGUF.") or key == "general.architecture":
            continue
        value = gguf.LlamaFileType.ALL_F32 if key == "general.file_type" else field.contents()
        writer.add_key_value(key, value, field.types[0], field.types[-1] if len(field.types) > 1 else None)
    for tensor in reader.tensors:
        dimensions = [int(n) for n in reversed(tensor.shape)]
        writer.add_tensor_info(tensor.name, dimensions, np.float32, 4 * int(np.prod(dimensions)), raw_dtype=Kind.F32)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_ti_data_to_file()
    for tensor in reader.tensors:
        writer.write_tensor_data(gguf.quants.dequantize(tensor.data, tensor.tensor_type).astype(np.float32))
    writer.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+", choices=SHAPES, metavar="NAME", help=", ".join(SHAPES))
    parser.add_argument("--kind", choices=FILE_TYPES, default="q4_0", help="the format of the matrices (q4_0)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("."), help="a folder (.)")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.names:
        path = arguments.out / f"{name}-{arguments.kind}.gguf"
        try:
            write(name, arguments.kind, path, arguments.seed)
        except ValueError as error:
            path.unlink(missing_ok=True)
            print(f"{name}: {error}", file=sys.stderr)
            return 1
        print(f"{path}: {path.stat().st_size / 1e6:.0f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
