"""Quick checks of the pipeline's parts: narration, splits, generator, batches, export. `pytest training/tests`.

Tests with data use the folder SHARED, by default ../shared next to the repository, and are skipped without it. All tests are skipped without
the training's own requirements (PyTorch and gigabytes of dependencies): Roomcast itself needs none.
"""

import argparse
import os
import random
import sys
from pathlib import Path

import pytest

gguf = pytest.importorskip("gguf", reason="training/requirements.txt is not installed")
sentencepiece = pytest.importorskip("sentencepiece", reason="training/requirements.txt is not installed")
torch = pytest.importorskip("torch", reason="training/requirements.txt is not installed")
np = pytest.importorskip("numpy", reason="training/requirements.txt is not installed")

HERE = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(HERE))

import calibrate
import corpus as corpora
import data
import descriptions
import evaluate
import export
import free_text
import routines
import run
import things
import train
import tokenizer as vocabulary
from model import Household, Shape
from muon import orthogonalised, shared_out
from narration import PRODUCT, Step, Style, bind, next_targets, parse_step, segments, sentence, words

SHARED = Path(os.environ.get("SHARED", HERE.parent.parent / "shared"))
needs_data = pytest.mark.skipif(not (SHARED / "virtualhome").is_dir(), reason=f"no data at {SHARED}: set SHARED")


def step(text):
    return parse_step(text)


def test_product_sentences():
    assert sentence(step("[Walk] <mug> (1)")) == "They walk to the mug."
    assert sentence(step("[PutBack] <plate> (1) <table> (2)")) == "They put the plate on the table."
    assert sentence(step("[Pour] <water> (1) <cup> (1)")) == "They pour the water into the cup."
    assert sentence(step("[SWITCHON] <television> (1) [2]")) == "They switch on the television."
    assert sentence(step("[StandUp]")) == "They stand up."
    assert sentence(step("[Levitate] <coffe_maker> (1)")) == "They levitate the coffee maker."


def test_styles_and_segments():
    assert sentence(step("[Grab] <mug> (1)"), Style("Anna", "past")) == "Anna grabbed the mug."
    assert segments(step("[PutBack] <plate> (1) <table> (2)"), Style("She", "third")) == ["She", " puts the", " plate", " on the", " table", "."]
    assert "".join(segments(step("[Sleep]"))).strip() == "They sleep."


def test_other_words_are_said_of_the_same_things():
    style, pour = Style("A man", "third", other_words=1.0, article="a"), step("[Pour] <drink> (1) <glass> (1)")
    said = {sentence(pour, style, random.Random(seed)) for seed in range(40)}
    assert len(said) > 2 and all(text.startswith("A man ") and " a drink" in text and " a glass" in text for text in said)
    assert sentence(pour, style) == "A man pours a drink into a glass."
    said = {"apple": "an apple", "curtains": "the curtains", "tap_water": "the tap water", "uniform": "a uniform", "umbrella": "an umbrella", "hourglass": "an hourglass"}
    for thing, words in said.items():
        assert sentence(step(f"[Grab] <{thing}> (1)"), Style(article="a")) == f"They grab {words}."
    assert sentence(pour, PRODUCT, random.Random(1)) == sentence(pour)


def test_names():
    assert words("washingmachine") == "washing machine"
    assert words("food_peanut_butter") == "peanut butter"
    assert words("wall_clock") == "wall clock"
    assert bind("couch", {"sofa", "tv"}) == "sofa"
    assert bind("sofa", {"sofa", "couch"}) == "sofa"
    assert bind("volcano", {"sofa"}) is None


def test_next_target_is_another_object():
    steps = [step(t) for t in ("[Walk] <cup> (1)", "[Find] <cup> (1)", "[StandUp]", "[Grab] <cup> (1)", "[Walk] <sink> (1)")]
    assert next_targets(steps) == ["sink", "sink", "cup", "sink", None]


def test_clusters():
    for title in ("Set up table", "Lay tablecloth", "Pick up phone", "Make bed", "Drink", "Turn on light"):
        assert data.split_of(data.cluster_of(title), dev=False) == "test", title
    for title in ("Pay bills", "Greet guests", "Water plants", "Straighten paintings on wall"):
        assert data.split_of(data.cluster_of(title), dev=False) == "calibration", title
    for title in ("Start computer", "Watch TV", "Make coffee", "Check email"):
        assert data.split_of(data.cluster_of(title), dev=False) == "train", title


def test_routines_vary_and_are_well_formed():
    loaded = routines.load(HERE / "routines")
    assert len(loaded) > 120
    fixed = []
    for routine in loaded:
        variants = {routine.program(random.Random(seed)).steps for seed in range(12)}
        if len(variants) == 1:
            fixed.append(routine.title)
        assert routine.program(random.Random(5)).steps == routine.program(random.Random(5)).steps
    assert fixed == []


def test_the_lexicon_is_well_formed_and_finds_things_of_a_kind():
    lexicon = things.Things.load(HERE / "things")
    assert len(lexicon.all) > 5000
    assert [word for word in lexicon.all if word != word.lower().strip() or not word or len(word) > 40] == []
    assert {file for files in things.FILES.values() for file in files} == set(lexicon.kinds)
    rng = random.Random(1)
    mates = {lexicon.another("cup", things.HOME, rng) for _ in range(200)}
    assert "mug" in mates and mates <= {word for kind in [k for f in ("everyday", "house", "living") for k in lexicon.of[f].get("cup", [])] for word in kind}
    assert lexicon.another("xylophone spaceship", things.HOME, rng) is None
    assert len(set(lexicon.some(60, rng))) == 60


def test_descriptions_become_narrations():
    text = "I walk to my kitchen, then I open the cabinets and take a mug. Drink coffee from mug"
    steps = tuple(step(t) for t in ("[Walk] <kitchen> (1)", "[Open] <cabinet> (1)", "[Grab] <mug> (1)", "[Drink] <coffee> (1)"))
    reader = descriptions.Reader.of([data.Program("a", "Drink coffee", "a", steps, text)] * 3, ["bathroom door"])
    clauses = reader.clauses(text)
    assert [c.text for c in clauses] == ["I walk to my kitchen", "I open the cabinets and take a mug", "Drink coffee from mug"]
    assert [[t for *_, t in c.spans] for c in clauses] == [["kitchen"], ["cabinet", "mug"], ["coffee", "mug"]]
    assert descriptions.next_things(clauses) == ["cabinet", "coffee", None]
    assert reader.told(clauses[0], as_written=False) == ["They walk to their", " kitchen", "."]
    assert reader.told(clauses[0], as_written=True) == ["I walk to my", " kitchen", "."]
    assert reader.told(clauses[2], as_written=False) == ["They drink", " coffee", " from", " mug", "."]


@needs_data
def test_no_test_activity_is_trained_on():
    corpus, programs = run.corpus_of(SHARED, dev=False)
    trained = {p.cluster for p in corpus.programs} | {r.cluster for r in corpus.routines} | {p.cluster for day in corpus.days for p in day}
    held = programs["test"] + programs["calibration"]
    assert programs["test"] and programs["calibration"] and not trained & {p.cluster for p in held}
    assert not {p.source for p in corpus.programs} & {p.source for p in held}
    assert not {p.cluster for p in programs["test"]} & {p.cluster for p in programs["calibration"]}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    if not (SHARED / "virtualhome").is_dir():
        pytest.skip(f"no data at {SHARED}: set SHARED")
    corpus, _ = run.corpus_of(SHARED, dev=False)
    return corpus, vocabulary.train(corpus, 1, run.VOCABULARY, tmp_path_factory.mktemp("vocabulary") / "v")


def test_tokens_never_cross_segments(tiny):
    corpus, pieces = tiny
    rng = random.Random(2)
    for _ in range(150):
        drawn = corpus.draw(rng)
        for branch in drawn.branches:
            seen = drawn.sentences[: branch.after]
            joined = pieces.encode(" ".join([*seen, f"{branch.binding} {branch.label}."]))
            apart = [t for text in (*seen, branch.binding, branch.label) for t in pieces.encode(text)]
            assert joined == apart + [pieces.piece_to_id(".")], branch


def test_a_branch_is_the_prompt_that_the_product_sends(tiny):
    corpus, pieces = tiny
    encoder = corpora.Encoder(pieces, roughness=0.0)
    shape = Shape(vocab=-(-pieces.vocab_size() // 32) * 32, width=64, layers=2, heads=2, feed_forward=96)
    torch.manual_seed(0)
    model = Household(shape).eval()
    sequence = corpus.narrate([Step(v, ((w, 1),)) for v, w in (("walk", "kitchen"), ("grab", "mug"), ("walk", "sink"), ("wash", "mug"))], random.Random(7), {})
    part = encoder.encode(sequence, 400, random.Random(0))
    index = np.arange(len(part["token"]))
    # After another sequence of the row, which must stay invisible.
    row = {name: torch.from_numpy(np.concatenate([part[name], part[name]]))[None] for name in part}
    row |= {"place": torch.from_numpy(np.tile(index, 2))[None], "sequence": torch.from_numpy(np.repeat([1, 2], len(index)))[None]}
    packed = model(row["token"], row["position"], train.visible(row))[0, len(index):]
    for number, branch in enumerate(sequence.branches, 1):
        plain = [pieces.bos_id()] + pieces.encode(" ".join([*sequence.sentences[: branch.after], branch.binding, branch.label]))
        causal = torch.ones(len(plain), len(plain), dtype=torch.bool).tril()[None, None]
        alone = model(torch.tensor([plain]), torch.arange(len(plain))[None], causal)[0, -1]
        last = index[part["branch"] == number][-1]
        assert torch.allclose(packed[last], alone, atol=1e-4)


def test_calibration_finds_what_was_put_in(monkeypatch):
    """With fake scores, 1.5 times too confident and with 0.6 of the blank narration's scores, the fit finds both numbers; the temperature is
    multiplied by `SOFTER`."""
    rng = np.random.default_rng(1)
    labels = [f"label {i}" for i in range(30)]
    blank, told = rng.normal(0, 1.5, 30), rng.normal(0, 1.5, (3000, 30))
    truth = (told + rng.gumbel(size=told.shape)).argmax(1)
    scores = 1.5 * told + 0.6 * 1.5 * blank
    pieces = type("Pieces", (), {"bos_id": lambda self: 1})()
    encoder = type("Encoder", (), {"tokenizer": pieces, "ids": lambda self, text: [0]})()
    scene = type("Scene", (), {"labels": labels, "index": {label: i for i, label in enumerate(labels)}})()
    monkeypatch.setattr(calibrate, "Scene", lambda path: scene)
    monkeypatch.setattr(calibrate, "cases_of", lambda programs, scene: [(0, ["They sit."], [], labels[t], None, None) for t in truth])
    monkeypatch.setattr(calibrate, "label_log_probs", lambda *_: np.vstack([scores, 1.5 * blank]))
    fit = calibrate.fit(None, encoder, [], [Path("scene.json")])
    assert abs(fit.temperature / calibrate.SOFTER - 1.5) <= 0.1 and abs(fit.prior - 0.6) <= 0.1


def test_export_keeps_every_weight(tmp_path):
    pieces = type("Pieces", (), dict(
        vocab_size=lambda s: 32, id_to_piece=lambda s, i: f"p{i}", get_score=lambda s, i: -float(i), is_unknown=lambda s, i: i == 0,
        is_control=lambda s, i: i in (1, 2), is_byte=lambda s, i: False, bos_id=lambda s: 1, eos_id=lambda s: 2, unk_id=lambda s: 0))()
    model = Household(Shape(vocab=64, width=64, layers=2, heads=2, feed_forward=96)).eval()
    export.write(model, pieces, tmp_path / "m.gguf", "q8_0", "test", 0.25)
    reader = gguf.GGUFReader(tmp_path / "m.gguf")
    assert [reader.fields[f"roomcast.{key}"].contents() for key in ("continuation", "prior")] == ["labels", 0.25]
    read = {t.name: t for t in reader.tensors}
    for name, value in export.tensors(model).items():
        held = gguf.quants.dequantize(read[name].data, read[name].tensor_type).reshape(value.shape)
        assert np.abs(held - value).max() <= np.abs(value).max() / 127 + 1e-6, name
    query = model.state_dict()["blocks.0.query_key_value.weight"].numpy()[:64]
    assert np.allclose(export.tensors(model)["blk.0.attn_q.weight"][1], query[16])  # second row: partner of the first


@needs_data
def test_variants_of_a_script_are_one_activity():
    titles = {program.title for day in data.homer(SHARED) for program in day}
    assert "socializing" in titles and not [title for title in titles if any(c.isdigit() for c in title)]


@needs_data
def test_a_fold_trains_on_nothing_that_it_holds_out():
    for fold in (2, "sealed"):
        corpus, programs = run.corpus_of(SHARED, False, fold)
        held = {p.cluster for split in ("test", "sealed", "calibration") for p in programs[split]}
        assert programs["sealed"] and bool(programs["test"]) == (fold == 2)
        trained = {p.cluster for p in corpus.programs} | {r.cluster for r in corpus.routines}
        trained |= {data.cluster_of(p.title) for day in corpus.days for p in day}
        assert not trained & held


def test_a_shorter_training_is_the_whole_one_in_proportion():
    whole = train.Schedule()
    assert whole.within(whole.until) == whole
    short = whole.within(whole.until // 3)
    assert abs(train.rate_at(short.until, short) - train.rate_at(whole.until, whole)) < 0.02 * whole.rate
    assert short.averages * short.apart <= short.until
    assert abs(short.apart / short.until - whole.apart / whole.until) < 0.001
    # A trial of the pipeline in a few steps.
    assert whole.within(2).until == 2 and whole.within(2).apart == 1


def test_a_number_of_steps_is_a_whole_one_from_one_on():
    assert run.number_of_steps("2") == 2
    for text in ("0", "-3", "2.5", "many", ""):
        with pytest.raises(argparse.ArgumentTypeError):
            run.number_of_steps(text)


@pytest.mark.parametrize("workers", [1, 2])
def test_an_ended_training_goes_on_as_if_it_had_not_ended(tmp_path, monkeypatch, workers):
    monkeypatch.setattr(train, "CHECKPOINT_STEPS", 2)
    monkeypatch.setattr(train, "pack", lambda encoder, corpus, rng, rows, length: fake_batch(rng))
    shape = Shape(vocab=64, width=64, layers=1, heads=2, feed_forward=96)
    schedule = train.Schedule(steps=12, until=6, workers=workers, rows=workers, warm_up=2, averages=2, apart=2)
    keep = train.Checkpoints.keep

    def keep_and_end(self, step, **state):
        keep(self, step, **state)
        if step == 4:
            os._exit(1) if workers > 1 else (_ for _ in ()).throw(KeyboardInterrupt)

    def weights(folder, ends=False, watch=None):
        (tmp_path / folder).mkdir(exist_ok=True)
        monkeypatch.setattr(train.Checkpoints, "keep", keep_and_end if ends else keep)
        trained = train.train(shape, schedule, None, None, 1, "cpu", tmp_path / folder / "trained.pt", {"of": "a test"}, watch)
        return torch.cat([value.flatten() for value in trained.state_dict().values()])

    whole = weights("whole")
    with pytest.raises((KeyboardInterrupt, torch.multiprocessing.ProcessExitedException)):
        weights("cut", ends=True)
    assert [path.name for path in (tmp_path / "cut").glob("resume-*")]
    assert torch.equal(weights("cut"), whole)
    assert not [*(tmp_path / "cut").glob("resume-*")]
    # `watch` does not change the result.
    assert torch.equal(weights("watched", watch=lambda step, model: None), whole)


def test_the_chain_of_free_text_is_a_forecast_of_a_maps_labels():
    statistics = {"kneser_ney": {"discounts": [[0.5] * 3] * 4, "cache_weight": 0.5, "cache_decay": 0.5}, "markov3": {"^>cup>sink": {"cup": 3, "bed": 1, "ship": 2}, "cup>sink>cup": {"bed": 1}}}
    chain = free_text.Chain(statistics, ["bed", "cup", "sink"])
    after_sink = chain.forecast(["cup", "sink"])
    assert abs(after_sink.sum() - 1) < 1e-9 and after_sink.argmax() == 1
    cached = chain.with_cache(after_sink, ["bed", "cup", "sink"])
    assert abs(cached.sum() - 1) < 1e-9 and cached[0] > after_sink[0] and cached[2] < after_sink[2]
    assert (chain.with_cache(after_sink, ["sink"]) == after_sink).all(), "what is in hand is not next"
    assert chain.with_cache(after_sink, ["cup", "ship"])[1] > after_sink[1], "a thing that the map lacks hides nothing"


def test_no_worker_waits_long_for_the_other_to_orthogonalise():
    matrices = [(module.weight, parts) for block in Household(Shape()).blocks for module, parts in block.matrices()]
    steppers = shared_out([weight for weight, _ in matrices], [parts for _, parts in matrices], 2)
    entries = [sum(weight.numel() for (weight, _), stepper in zip(matrices, steppers) if stepper == worker) for worker in (0, 1)]
    assert max(entries) < 1.2 * min(entries)


def test_matrices_together_are_orthogonalised_as_one_by_one():
    torch.manual_seed(3)
    several = torch.randn(3, 20, 32)
    together = orthogonalised(several)
    for one, given in zip(several, together):
        assert torch.allclose(orthogonalised(one[None])[0], given, atol=1e-5)
    values = torch.linalg.svdvals(together)
    assert 0.6 < values.min() and values.max() < 1.3


@needs_data
def test_the_figures_of_development_are_computed(tiny):
    corpus, pieces = tiny
    scene = evaluate.Scene(SHARED / "virtualhome/scenes/TestScene1_graph.json")
    programs = corpus.programs[:40]
    cases = list(evaluate.cases_of(programs[:2], scene))
    assert cases and all(case[3] in scene.index for case in cases)
    model = Household(Shape(vocab=-(-pieces.vocab_size() // 32) * 32, width=64, layers=1, heads=2, feed_forward=96)).eval()
    rows = evaluate.evaluate(model, corpora.Encoder(pieces), programs, cases, scene, bootstrap=3)["rows"]
    assert rows["object markov2"]["nll"][0] < rows["object uniform"]["nll"][0]


def fake_batch(rng):
    """A row of random tokens in the format of `pack`."""
    length = 12
    token, place = np.array([[rng.randrange(64) for _ in range(length)]]), np.arange(length)[None]
    trunk = {"branch": np.zeros_like(token), "sees": np.full_like(token, length), "sequence": np.ones_like(token), "place": place}
    return {"token": token, "position": place, "target": np.roll(token, -1), "weight": np.ones((1, length), np.float32), **trunk}
