"""A peer in its own process: reads prompts as JSON lines, answers with log-probabilities in nats and nanoseconds.

    python worker.py PEER MODEL CACHE THREADS

The first input line has the labels and their tokens.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

Score = Callable[[str], list[float]]
# Context size of every peer, in tokens.
CONTEXT = 1024
# llama.cpp's own limit (LLAMA_MAX_SEQ).
SEQUENCES_MAX = 256


def cache_types(c, cache: str) -> tuple[int, int, bool]:
    """llama.cpp's types for keys and values in a cache that Roomcast calls `cache`, and whether its fused attention reads them."""
    return {"mixed": (c.GGML_TYPE_F16, c.GGML_TYPE_F32, False), "f32": (c.GGML_TYPE_F32, c.GGML_TYPE_F32, False),
            "q8": (c.GGML_TYPE_Q8_0, c.GGML_TYPE_Q8_0, True)}[cache]


def cappr(model: str, cache: str, threads: int, labels: list[str], _: list[list[int]]) -> Score:
    """CAPPr with its best settings: the narration stays in the model from event to event (`cache_model`), the binding sequence is read once, and
    the labels follow one by one, or all at once if each is a single token."""
    # CAPPr imports its other back end if transformers is installed, and does not support its newest versions.
    sys.modules["transformers"] = None
    from cappr.llama_cpp.classify import cache_model, log_probs_conditional
    import llama_cpp as c

    keys, values, fused = cache_types(c, cache)
    llama = c.Llama(model, n_ctx=CONTEXT, n_threads=threads, n_threads_batch=threads, logits_all=True, verbose=False,
                    type_k=keys, type_v=values, flash_attn=fused)
    kept = ""

    def score(prompt: str) -> list[float]:
        nonlocal kept
        narration, stop, binding = prompt.rpartition(". ")
        narration += stop.strip()
        if not kept or not narration.startswith(kept):
            llama.reset()
            kept = ""
        cache_model(llama, narration[len(kept):].strip())
        kept = narration
        return [sum(one) for one in log_probs_conditional(binding, labels, llama, show_progress_bar=False, reset_model=False)]

    return score


def llama_cpp_layout(model: str, cache: str, threads: int, labels: list[str], tokens: list[list[int]]) -> Score:
    """The layout of llama.cpp's HellaSwag scoring: the common prompt on all sequences, then every label on its own sequence, repeated for every
    task. llama-perplexity supports only four endings per task, so this makes its calls through llama-cpp-python."""
    import ctypes

    import llama_cpp as c

    if len(labels) > SEQUENCES_MAX:
        raise SystemExit(f"{len(labels)} labels, and llama.cpp has {SEQUENCES_MAX} sequences: choose a scene with fewer")
    quiet = c.llama_log_callback(lambda *_: None)
    c.llama_log_set(quiet, ctypes.c_void_p(0))
    c.llama_backend_init()
    weights = c.llama_model_load_from_file(model.encode(), c.llama_model_default_params())
    parameters = c.llama_context_default_params()
    parameters.n_ctx = parameters.n_batch = parameters.n_ubatch = CONTEXT
    parameters.n_seq_max = len(labels)
    parameters.n_threads = parameters.n_threads_batch = threads
    parameters.type_k, parameters.type_v, fused = cache_types(c, cache)
    parameters.flash_attn_type = int(fused)
    parameters.kv_unified = True
    context = c.llama_init_from_model(weights, parameters)
    vocabulary, memory = c.llama_model_get_vocab(weights), c.llama_get_memory(context)
    size = c.llama_vocab_n_tokens(vocabulary)
    batch = c.llama_batch_init(CONTEXT, 0, 1)
    room = (c.llama_token * CONTEXT)()
    # Created once, so that filling a batch from Python is cheap.
    each = [(c.llama_seq_id * 1)(label) for label in range(len(labels))]
    all_of_them = (c.llama_seq_id * len(labels))(*range(len(labels)))

    def score(prompt: str) -> list[float]:
        text = prompt.encode()
        prefix = list(room[: c.llama_tokenize(vocabulary, text, len(text), room, CONTEXT, True, False)])
        batch.n_tokens = 0

        def add(token: int, position: int, sequences: ctypes.Array, wanted: bool) -> None:
            at = batch.n_tokens
            if at >= CONTEXT:
                raise SystemExit(f"prompt and labels have more than {CONTEXT} tokens: choose a smaller scene or window")
            batch.token[at], batch.pos[at], batch.n_seq_id[at], batch.logits[at] = token, position, len(sequences), wanted
            batch.seq_id[at] = sequences
            batch.n_tokens += 1

        for position, token in enumerate(prefix):
            add(token, position, all_of_them, position == len(prefix) - 1)
        rows, wanted = [], []
        for label, own in enumerate(tokens):
            before = 0
            for place, token in enumerate(own):
                rows.append(before)
                wanted.append(token)
                if place + 1 < len(own):  # The last token's logits are not needed.
                    before = batch.n_tokens - len(prefix) + 1
                    add(token, len(prefix) + place, each[label], True)
        c.llama_memory_clear(memory, True)
        start = time.perf_counter_ns()
        if c.llama_decode(context, batch):
            raise RuntimeError("llama_decode failed")
        count = batch.n_tokens - len(prefix) + 1
        logits = np.ctypeslib.as_array(c.llama_get_logits(context), (count, size))
        score.decoder_ns = time.perf_counter_ns() - start
        # One pass over every row instead of one per label.
        top = logits.max(axis=1)
        total = np.log(np.exp(logits - top[:, None]).sum(axis=1)) + top
        chosen = logits[rows, wanted] - total[rows]
        ends = np.cumsum([0] + [len(own) for own in tokens])
        return np.add.reduceat(chosen.astype(np.float64), ends[:-1]).tolist()

    score.quiet = quiet  # Kept alive while llama.cpp may call it.
    return score


def transformers(model: str, _: str, threads: int, labels: list[str], tokens: list[list[int]]) -> Score:
    """Hugging Face transformers with a prefix cached from event to event, followed by a batch of all labels with several tokens. llama.cpp's
    vocabulary tokenises the text, at negligible cost."""
    import copy

    import torch
    from llama_cpp import Llama
    from transformers import AutoModelForCausalLM, DynamicCache

    torch.set_num_threads(threads)
    path = Path(model)
    network = AutoModelForCausalLM.from_pretrained(path.parent, gguf_file=path.name, dtype=torch.float32).eval()
    text = Llama(model, vocab_only=True, verbose=False)
    long = [label for label, own in enumerate(tokens) if len(own) > 1]
    width = max((len(tokens[label]) - 1 for label in long), default=0)
    # Padding follows a label, so causal attention does not see it.
    batch = torch.tensor([tokens[label][:-1] + [0] * (width - len(tokens[label]) + 1) for label in long])
    kept: list[int] = []
    cache = DynamicCache(config=network.config)

    @torch.inference_mode()
    def score(prompt: str) -> list[float]:
        nonlocal kept, cache
        prefix = text.tokenize(prompt.encode(), add_bos=True)
        same = next((i for i, (a, b) in enumerate(zip(kept, prefix)) if a != b), min(len(kept), len(prefix)))
        same = min(same, len(prefix) - 1)
        if kept and same < cache.get_seq_length():
            cache.crop(same - cache.get_seq_length())
        first = network(torch.tensor([prefix[same:]]), past_key_values=cache, use_cache=True, logits_to_keep=1).logits[0, -1]
        kept = prefix
        first = first.log_softmax(-1)
        out = [first[own[0]].item() for own in tokens]
        if long:
            branches = copy.deepcopy(cache)
            branches.batch_repeat_interleave(len(long))
            rest = network(batch, past_key_values=branches, use_cache=True).logits.log_softmax(-1)
            for row, label in enumerate(long):
                for place, token in enumerate(tokens[label][1:]):
                    out[label] += rest[row, place, token].item()
        return out

    return score


def main() -> None:
    peer, model, cache, threads = sys.argv[1:]
    given = json.loads(sys.stdin.readline())
    makers = {"cappr": cappr, "llama.cpp-layout": llama_cpp_layout, "transformers": transformers}
    score = makers[peer](model, cache, int(threads), given["labels"], given["tokens"])
    for line in sys.stdin:
        prompt = json.loads(line)["prompt"]
        start = time.perf_counter_ns()
        scores = score(prompt)
        nanoseconds = time.perf_counter_ns() - start
        answer = {"ns": nanoseconds, "decoder_ns": getattr(score, "decoder_ns", None), "log_prob_nats": scores}
        print("answer " + json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
