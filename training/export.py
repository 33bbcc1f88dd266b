"""Writes a trained model as GGUF, in full precision or with its matrices in Q8_0."""

from __future__ import annotations

from pathlib import Path

import gguf
import numpy as np
import sentencepiece
import torch

from model import Household

KINDS = {"f32": gguf.GGMLQuantizationType.F32, "q8_0": gguf.GGMLQuantizationType.Q8_0}


def tensors(model: Household) -> dict[str, np.ndarray]:
    """llama.cpp's names and its order of rotary pairs. There is no output matrix: llama.cpp uses the embedding."""
    width, out = model.shape.width, {}

    def neighbours(rows: np.ndarray) -> np.ndarray:
        """Pairs (i, i + half) of each head become pairs (2 i, 2 i + 1)."""
        return rows.reshape(model.shape.heads, 2, -1, width).swapaxes(1, 2).reshape(width, width)

    state = {name: value.detach().float().numpy() for name, value in model.state_dict().items()}
    out["token_embd.weight"] = state["embedding.weight"]
    out["output_norm.weight"] = state["norm.weight"]
    for i in range(model.shape.layers):
        block, name = f"blocks.{i}.", f"blk.{i}."
        query, key, value = np.split(state[block + "query_key_value.weight"], [width, 2 * width])
        gate, up = np.split(state[block + "gate_up.weight"], 2)
        out |= {
            name + "attn_norm.weight": state[block + "attention_norm.weight"],
            name + "attn_q.weight": neighbours(query), name + "attn_k.weight": neighbours(key), name + "attn_v.weight": value,
            name + "attn_output.weight": state[block + "attention_out.weight"],
            name + "ffn_norm.weight": state[block + "feed_norm.weight"],
            name + "ffn_gate.weight": gate, name + "ffn_up.weight": up, name + "ffn_down.weight": state[block + "down.weight"],
        }
    return out


def quantised(model: Household, kind: str) -> dict[str, torch.Tensor]:
    """The model's state with every matrix rounded as in the file, to measure the cost of quantisation."""
    def round_trip(value: torch.Tensor) -> torch.Tensor:
        if value.dim() != 2 or kind == "f32":
            return value
        packed = gguf.quants.quantize(value.detach().float().numpy(), KINDS[kind])
        return torch.from_numpy(gguf.quants.dequantize(packed, KINDS[kind]).reshape(value.shape))
    return {name: round_trip(value) for name, value in model.state_dict().items()}


def write(model: Household, tokenizer: sentencepiece.SentencePieceProcessor, path: Path, kind: str, description: str, prior: float) -> None:
    """Writes a GGUF file. It recommends the prior weight `prior`, and `labels` for continuations."""
    shape = model.shape
    writer = gguf.GGUFWriter(path, "llama")
    writer.add_name("Roomcast household")
    writer.add_description(description)
    writer.add_license("Apache-2.0 OR MIT")
    writer.add_languages(["en"])
    # The keys of src/scorer/correction.rs.
    writer.add_string("roomcast.continuation", "labels")
    writer.add_float32("roomcast.prior", prior)
    writer.add_context_length(shape.context)
    writer.add_embedding_length(shape.width)
    writer.add_block_count(shape.layers)
    writer.add_feed_forward_length(shape.feed_forward)
    writer.add_head_count(shape.heads)
    writer.add_head_count_kv(shape.heads)
    writer.add_layer_norm_rms_eps(shape.norm_epsilon)
    writer.add_rope_dimension_count(shape.width // shape.heads)
    writer.add_rope_freq_base(shape.rope_base)
    writer.add_vocab_size(shape.vocab)
    writer.add_file_type(gguf.LlamaFileType.ALL_F32 if kind == "f32" else gguf.LlamaFileType.MOSTLY_Q8_0)
    add_vocabulary(writer, tokenizer, shape.vocab)
    for name, value in tensors(model).items():
        if value.ndim == 2 and kind != "f32":
            packed = gguf.quants.quantize(value, KINDS[kind])
            writer.add_tensor(name, packed, raw_dtype=KINDS[kind])
        else:
            writer.add_tensor(name, value)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


def add_vocabulary(writer: gguf.GGUFWriter, tokenizer: sentencepiece.SentencePieceProcessor, size: int) -> None:
    pieces, scores, types = [], [], []
    for i in range(size):
        if i >= tokenizer.vocab_size():  # padding rows
            pieces.append(f"<unused{i}>".encode())
            scores.append(-1e4)
            types.append(gguf.TokenType.UNUSED)
            continue
        pieces.append(tokenizer.id_to_piece(i).encode())
        scores.append(tokenizer.get_score(i))
        types.append(
            gguf.TokenType.UNKNOWN if tokenizer.is_unknown(i)
            else gguf.TokenType.CONTROL if tokenizer.is_control(i)
            else gguf.TokenType.BYTE if tokenizer.is_byte(i)
            else gguf.TokenType.NORMAL
        )
    writer.add_tokenizer_model("llama")
    writer.add_tokenizer_pre("default")
    writer.add_token_list(pieces)
    writer.add_token_scores(scores)
    writer.add_token_types(types)
    writer.add_bos_token_id(tokenizer.bos_id())
    writer.add_eos_token_id(tokenizer.eos_id())
    writer.add_unk_token_id(tokenizer.unk_id())
    writer.add_add_bos_token(True)
    writer.add_add_eos_token(False)
    writer.add_add_space_prefix(True)
