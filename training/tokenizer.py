"""The vocabulary: sentencepiece BPE with byte fallback, which llama.cpp reproduces under the name `llama`."""

from __future__ import annotations

import random
from pathlib import Path

import sentencepiece

from corpus import Corpus, DISTRACTORS, OTHER_BINDINGS, PAPER_BINDINGS
from narration import ACTIONS, ALIASES, DEFAULT_BINDING, WORDS

UNKNOWN, BEGIN, END = 0, 1, 2


def sample(corpus: Corpus, seed: int, sequences: int = 12000):
    """Text that the vocabulary is fitted on: narrations, labels and every name the project knows."""
    rng = random.Random(f"tokenizer {seed}")
    for _ in range(sequences):
        drawn = corpus.draw(rng)
        yield from drawn.sentences
        yield from (f"{branch.binding} {branch.label}." for branch in drawn.branches)
    names = set(WORDS.values()) | set(ALIASES) | {a for aliases in ALIASES.values() for a in aliases}
    names |= set(corpus.all_labels) | {w for answers in DISTRACTORS.values() for w in answers}
    for binding in (DEFAULT_BINDING, *PAPER_BINDINGS, *OTHER_BINDINGS, *DISTRACTORS):
        yield from [f"{binding} {name}." for name in sorted(names)]
    for entry in ACTIONS.values():
        yield from [f"They {entry[form]}." for form in ("base", "third", "past", "ing")] * 20


def train(corpus: Corpus, seed: int, size: int, prefix: Path) -> sentencepiece.SentencePieceProcessor:
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=sample(corpus, seed), model_prefix=str(prefix), vocab_size=size, model_type="bpe",
        byte_fallback=True, normalization_rule_name="identity", remove_extra_whitespaces=False, add_dummy_prefix=True,
        split_digits=True, character_coverage=1.0, unk_id=UNKNOWN, bos_id=BEGIN, eos_id=END, pad_id=-1,
        num_threads=1, minloglevel=2, hard_vocab_limit=False,
    )
    return load(prefix.with_suffix(".model"))


def load(path: Path) -> sentencepiece.SentencePieceProcessor:
    return sentencepiece.SentencePieceProcessor(model_file=str(path))
