"""The shapes load, and their vocabulary tokenises text like a general model's.

    pip install -r benches/peers/requirements.txt && python -m pytest benches/peers
"""

import json
from pathlib import Path

import pytest

np = pytest.importorskip("numpy", reason="needs benches/peers/requirements.txt")
gguf = pytest.importorskip("gguf", reason="needs benches/peers/requirements.txt")
pytest.importorskip("sentencepiece", reason="needs benches/peers/requirements.txt")

import shapes  # noqa: E402

NARRATION = "They walk to the fridge. They open the fridge. They grab the chicken. They put the plate on the table. Next, the human will go to the"


@pytest.fixture(scope="module")
def vocabulary():
    return shapes.vocabulary(49152)


def test_tokens_per_word_are_those_of_a_general_model(vocabulary):
    assert 1.1 < len(vocabulary.encode(NARRATION)) / len(NARRATION.split()) < 1.5


def test_labels_make_a_trie_with_depth(vocabulary):
    scene = json.loads((shapes.ROOT / "scenes/apartment-e0.json").read_text())
    cut = [vocabulary.encode(label) for label in {item["label"] for item in scene["items"]}]
    inner = {tuple(label[:n]) for label in cut for n in range(1, len(label))}
    assert min(map(len, cut)) == 1 and 20 <= len(inner) <= 40


@pytest.mark.parametrize("kind", ["F16", "Q8_0", "Q4_0", "Q4_K", "Q6_K"])
def test_random_blocks_have_the_deviation_asked_for(kind):
    format_ = gguf.GGMLQuantizationType[kind]
    data = shapes.blocks(format_, 64, 512, 0.05, np.random.default_rng(1))
    values = gguf.quants.dequantize(data.view(np.uint8) if kind == "F16" else data, format_)
    assert abs(values.std() / 0.05 - 1) < 0.1 and abs(values.mean()) < 0.01


def test_a_format_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="multiple of 256, not of 576"):
        shapes.blocks(gguf.GGMLQuantizationType.Q4_K, 1, 576, 0.05, np.random.default_rng(1))


@pytest.mark.parametrize("name", ["smollm2-135m", "qwen2.5-0.5b"])
def test_the_small_ones_load_in_llama_cpp_with_finite_logits(name, tmp_path):
    llama_cpp = pytest.importorskip("llama_cpp", reason="needs benches/peers/requirements.txt")
    path = Path(tmp_path) / "shape.gguf"
    shapes.write(name, "q4_0", path)
    llama = llama_cpp.Llama(str(path), n_ctx=64, verbose=False, logits_all=True)
    assert llama.n_vocab() == shapes.SHAPES[name].vocabulary
    tokens = llama.tokenize(NARRATION.encode(), add_bos=True)
    assert tokens[1:] == shapes.vocabulary(49152).encode(NARRATION)
    llama.eval(tokens)
    logits = llama.scores[: len(tokens)]
    assert np.isfinite(logits).all() and 0.5 < logits[-1].std() < 10
