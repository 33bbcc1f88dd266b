"""Makes the embedded model from data folders: corpus, vocabulary, training, export, manifest.

    python training/run.py --shared ../shared --out models --seed 1
    python training/run.py --shared ../shared --folds folds       # one model per fold, each below folds/, for `roomcast-lab folds`
    python training/run.py --shared ../shared --folds folds --small

An interrupted run continues if the same command is given again.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

# Freed memory is kept: a training step allocates and frees the same few hundred megabytes, and asking the system for fresh pages costs more than the
# arithmetic. Python's hashes are fixed too, so that no order depends on them. These variables are read at start-up, so the program restarts itself.
SURROUNDINGS = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": "100000000000", "MALLOC_TOP_PAD_": "268435456", "PYTHONHASHSEED": "0"}
if __name__ == "__main__" and any(os.environ.get(name) != value for name, value in SURROUNDINGS.items()):
    os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **SURROUNDINGS})

import torch

import calibrate
import data
import export
import quantise
import routines
import statistics_file
import tokenizer as vocabulary
from corpus import Corpus, Encoder, scene_labels
from model import Shape
from things import Things
from train import Schedule, restore, train

ROOT = Path(__file__).resolve().parent.parent
VOCABULARY = 6144  # tokens
# The model of `--small`, ten minutes on two cores: a quarter of the parameters, a fifth of the steps.
SMALL_SHAPE, SMALL_SCHEDULE = Shape(width=192, layers=3, heads=6, feed_forward=512), Schedule(steps=2100, until=1200, dropout=0.1, apart=130)
DESCRIPTION = (
    "Predicts which object of a home a person turns to next, from a narration of what they just did. "
    "Trained from scratch on VirtualHome programs, HOMER+ days and routines of the project. Knows households; no general language model."
)


def number_of_steps(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of steps, from 1 on")
    return int(text)


def corpus_of(shared: Path, dev: bool, fold: int | str | None = None) -> tuple[Corpus, dict[str, list[data.Program]]]:
    programs = {"train": [], "dev": [], "calibration": [], "test": [], "sealed": []}
    for program in data.virtualhome(shared):
        programs[data.split_of(program.cluster, dev, fold)].append(program)
    if not programs["train"]:
        raise SystemExit(f"no activity programs below {shared}/virtualhome/programs: pass the folder that holds virtualhome and homer_plus with --shared")
    own = [r for r in routines.load(ROOT / "training/routines") if data.split_of(r.cluster, dev, fold) == "train"]
    scenes = scene_labels(shared, ROOT / "scenes")
    return Corpus(programs["train"], data.homer(shared, fold), own, scenes, Things.load(ROOT / "training/things")), programs


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--shared", type=Path, required=True, help="folder with virtualhome/ and homer_plus/")
    arguments.add_argument("--out", type=Path, default=ROOT / "models")
    arguments.add_argument("--work", type=Path, default=ROOT / "training/work", help="vocabulary, checkpoints and the full-precision file")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--dev", action="store_true", help="hold the development clusters out too")
    arguments.add_argument("--watch", action="store_true", help="print the calibration split's nats as training goes on")
    arguments.add_argument("--short", type=number_of_steps, metavar="STEPS", help="train so many steps, with the whole schedule shortened alike")
    arguments.add_argument("--small", action="store_true", help="train a small model in a short time, to compare")
    arguments.add_argument("--export-only", action="store_true", help="take the vocabulary and the trained weights from --work instead of training")
    arguments.add_argument("--fold", type=data.fold_named, metavar="N", help=data.FOLD_HELP)
    arguments.add_argument("--folds", type=Path, metavar="DIR", help="one model per fold, in place of --fold, --out and --work; folds that are done are left as they are")
    given = arguments.parse_args()

    torch.set_num_threads(1)  # sums depend on the number of threads; training uses processes
    if not given.folds:
        make(given)
        return
    for fold in range(1, data.FOLDS + 1):
        out = given.folds / f"fold-{fold}"
        if (out / "manifest.json").exists():
            print(f"fold {fold}: {out} is done")
        else:
            print(f"fold {fold}: into {out}", flush=True)
            make(argparse.Namespace(**{**vars(given), "fold": fold, "out": out, "work": out / "work"}))


def make(given: argparse.Namespace) -> None:
    device = "cuda" if torch.cuda.is_available() else "cpu"
    given.work.mkdir(parents=True, exist_ok=True)
    given.out.mkdir(parents=True, exist_ok=True)
    corpus, programs = corpus_of(given.shared, given.dev, given.fold)
    trained, last = given.work / "trained.pt", given.work / "checkpoint.pt"
    graphs = data.scene_graphs(given.shared)
    if given.export_only:
        pieces = vocabulary.load(given.work / "vocabulary.model")
    else:
        pieces = vocabulary.train(corpus, given.seed, VOCABULARY, given.work / "vocabulary")
    encoder = Encoder(pieces)
    fitted = lambda model: calibrate.fit(model, encoder, programs["calibration"], graphs)
    if given.export_only:
        model = restore(trained)
    else:
        shape, schedule = (SMALL_SHAPE, SMALL_SCHEDULE) if given.small else (Shape(), Schedule())
        schedule = schedule.within(given.short) if given.short else schedule
        # A run continues from a checkpoint only if these agree: the data, through the vocabulary made from them, and the held-out part.
        recipe = {"seed": given.seed, "dev": given.dev, "fold": given.fold, "vocabulary": data.sha256(given.work / "vocabulary.model")}
        shape = replace(shape, vocab=-(-pieces.vocab_size() // 32) * 32)
        watch = (lambda step, model: print(f"step {step}: {fitted(model)}", flush=True)) if given.watch else None
        model = train(shape, schedule, encoder, corpus, given.seed, device, trained, recipe, watch)
    fit = fitted(model.to(device))
    print(fit)
    model = model.cpu()
    calibrate.apply(model, fit.temperature)
    torch.save({"shape": model.shape.to_dict(), "model": model.state_dict(), "temperature": fit.temperature, "prior": fit.prior, "dev": given.dev, "fold": given.fold}, last)
    reference, shipped = given.work / "household-f32.gguf", given.out / "household.gguf"
    export.write(model, pieces, reference, "f32", DESCRIPTION, fit.prior)
    quantise.quantise(reference, shipped, corpus, given.seed)
    write_expected_tokens(corpus, pieces, given.out / "household-tokens.json")
    statistics_file.write(programs, graphs, given.out / "household-statistics.json")
    write_manifest(given, corpus, programs, model, trained, shipped)
    print(f"wrote {shipped}: {shipped.stat().st_size / 1e6:.2f} MB, {model.parameter_count() / 1e6:.2f} M parameters")


HOSTILE = [
    "", " ", "  two  spaces  ", " leading", "trailing ", "\ttab\nline\r\n", "<s>", "</s>", "<unk>", "<0x41>", "a<s>b</s>c", "<|endoftext|>",
    "\u2581They\u2581walk", "\u2581", "\u2581\u2581\u2581", "na\u00efve caf\u00e9", "cafe\u0301", "\u6d17\u8863\u673a", "\U0001f9fa laundry \U0001f468\u200d\U0001f373", "\u00a0nbsp", "\u200bzero", "\ufeffbom", "\ufffd",
    "THEY WALK TO THE KITCHEN.", "Theywalktothekitchen.", "They walk to the kitchen.They open the fridge.", "They  walk to  the kitchen.", "1234567890", "They grab 12 mugs.", "....", "!?#$%&'()*+,-/:;=@[\\]^_`{|}~",
    "x" * 300, "the " * 60, "kitchenkitchenkitchen", "They walk to the xylophone.", "Next, the human will go to the", "Next, the human will go to the ", "\u0000nul", "\u0001\u0002\u007f",
]


def write_expected_tokens(corpus: Corpus, pieces, path: Path) -> None:
    """Texts and their tokens without the leading begin-of-text token, with which the product tests that llama.cpp agrees."""
    rng = random.Random("expected tokens")
    texts = list(HOSTILE)
    for _ in range(60):
        drawn = corpus.draw(rng)
        branch = rng.choice(drawn.branches) if drawn.branches else None
        seen = drawn.sentences[: branch.after] if branch else drawn.sentences
        texts.append(" ".join([*seen, *([branch.binding, branch.label] if branch else [])]))
    texts += [f"Next, the human will go to the {label}" for label in corpus.all_labels]
    rows = ",\n".join(json.dumps([text, pieces.encode(text)]) for text in texts)
    path.write_text(f"[\n{rows}\n]\n")


def write_manifest(given, corpus, programs, model, trained: Path, shipped: Path) -> None:
    """Records the model's data, and the activities of each split."""
    inputs = sorted(
        [p for folder in ("virtualhome/programs", "virtualhome/scenes", "homer_plus") for p in (given.shared / folder).rglob("*") if p.is_file()]
    )
    here = sorted(p for pattern in ("training/*.py", "training/*.toml", "training/routines/*.toml", "training/things/*.toml", "core/src/narration/actions.toml", "core/src/names.toml", "scenes/*.json") for p in ROOT.glob(pattern))
    manifest = {
        "model": {"file": shipped.name, "sha256": data.sha256(shipped), "bytes": shipped.stat().st_size, "parameters": model.parameter_count(), "shape": model.shape.to_dict()},
        "command": f"python training/run.py --shared SHARED --seed {given.seed}" + (" --dev" if given.dev else "") + (f" --fold {given.fold}" if given.fold else "") + (" --small" if given.small else "") + (f" --short {given.short}" if given.short else ""),
        "environment": torch.load(trained, weights_only=True, map_location="cpu").get("environment", {}),
        "splits": {
            split: {
                "programs": len(members),
                "titles": dict(sorted(Counter(p.title for p in members).items())),
                "files": sorted(p.source for p in members),
            }
            for split, members in programs.items() if members
        },
        "activities": data.activities(p for members in programs.values() for p in members),
        "homer": {"days": len(corpus.days), "split": "train", "scripts": sorted({p.title for day in corpus.days for p in day})},
        "routines": {"train": sorted(r.title for r in corpus.routines)},
        "inputs": {"shared/" + str(p.relative_to(given.shared)): data.sha256(p) for p in inputs},
        "pipeline": {str(p.relative_to(ROOT)): data.sha256(p) for p in here},
    }
    (given.out / "manifest.json").write_text(json.dumps(manifest, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
