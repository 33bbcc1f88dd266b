"""The vocabulary: sentencepiece BPE with byte fallback, which llama.cpp reproduces under the name `llama`."""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path

import sentencepiece

from corpus import Corpus, DISTRACTORS, OTHER_BINDINGS, PAPER_BINDINGS
from narration import ALIASES, DEFAULT_BINDING, WORDS

UNKNOWN, BEGIN, END = 0, 1, 2


def sample(corpus: Corpus, seed: int, sequences: int = 6000) -> Counter:
    """Segments of text with their counts: a sentence's parts around its objects, objects, bindings.

    Tokens may span words ("They walk to the", "washing machine"), which makes prompts three times shorter, but never two segments. So a label
    after a binding has the same tokens as alone.
    """
    rng, counts = random.Random(f"tokenizer {seed}"), Counter()
    for _ in range(sequences):
        drawn = corpus.draw(rng)
        for parts in drawn.segments:
            counts.update(part.strip(" .") for part in parts if part.strip(" ."))
        for branch in drawn.branches:
            counts.update((branch.binding, branch.label))
    names = set(WORDS.values()) | set(ALIASES) | {a for aliases in ALIASES.values() for a in aliases} | set(corpus.all_labels)
    names |= {word for step in (s for p in corpus.programs for s in p.steps) for word, _ in step.objects}
    names |= corpus.things.all
    for name in names | {w for answers in DISTRACTORS.values() for w in answers}:
        counts[name] += 3
        for word in name.split():
            counts[word] += 1
    for label in corpus.all_labels:
        counts[label] += 60
    for binding in (DEFAULT_BINDING, *PAPER_BINDINGS):
        counts[binding] += 2000
    for binding in (*OTHER_BINDINGS, *DISTRACTORS):
        for word in binding.split():
            counts[word] += 20
    return counts


def train(corpus: Corpus, seed: int, size: int, prefix: Path) -> sentencepiece.SentencePieceProcessor:
    lines = prefix.with_suffix(".tsv")
    lines.write_text("".join(f"{text}\t{n}\n" for text, n in sorted(sample(corpus, seed).items())))
    sentencepiece.SentencePieceTrainer.train(
        input=str(lines), input_format="tsv", model_prefix=str(prefix), vocab_size=size, model_type="bpe",
        byte_fallback=True, normalization_rule_name="identity", remove_extra_whitespaces=False, add_dummy_prefix=True,
        split_by_whitespace=False, split_by_number=False, split_by_unicode_script=False, max_sentencepiece_length=64,
        required_chars="".join(map(chr, range(33, 127))), character_coverage=1.0,
        unk_id=UNKNOWN, bos_id=BEGIN, eos_id=END, pad_id=-1, num_threads=1, minloglevel=2, hard_vocab_limit=False,
    )
    return load(prefix.with_suffix(".model"))


def load(path: Path) -> sentencepiece.SentencePieceProcessor:
    return sentencepiece.SentencePieceProcessor(model_file=str(path))
