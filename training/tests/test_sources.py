"""The product's sources that training reads exist. Runs without PyTorch, in every `make test`."""

import random
import re
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent.parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE))

import data
import narration
import routines
import statistics_file
import things


def test_the_tables_of_the_product_are_read():
    assert narration.sentence(narration.parse_step("[Grab] <coffe_maker> (1)")) == "They grab the coffee maker."


def test_the_projects_own_data_are_read():
    assert data.SPLITS and routines and things


def test_every_path_that_the_pipeline_names_is_there():
    missing = []
    for path in [*HERE.glob("*.py"), *(ROOT / "benches/peers").glob("*.py")]:
        named = re.findall(r'"((?:core|src|llama|services|lab|scenes|training|models)/[\w./-]+\.(?:toml|json|rs|txt))"', path.read_text())
        missing += [f"{path.relative_to(ROOT)}: {name}" for name in named if not (ROOT / name).exists()]
    assert not missing


def test_every_activity_is_held_out_by_one_fold_or_sealed():
    splits = data.SPLITS
    listed = [cluster for fold in splits["folds"] for cluster in fold]
    assert len(listed) == len(set(listed))
    assert not set(listed) & ({*splits["calibration"], *splits["sealed"]})
    assert not set(splits["sealed"]) & {*splits["test"], *splits["dev"], *splits["calibration"]}
    assert {*listed, *splits["sealed"], *splits["calibration"]} == set(splits["clusters"])
    folds = range(1, data.FOLDS + 1)
    for cluster in [*splits["clusters"], "annoy your dog", "tell jokes", "whine"]:
        found = [data.split_of(cluster, False, fold) for fold in [*folds, "sealed"]]
        if cluster in splits["calibration"]:
            assert set(found) == {"calibration"}, cluster
        elif cluster in splits["sealed"]:
            assert set(found) == {"sealed"}, cluster
        else:
            assert sorted(found) == ["test"] + ["train"] * data.FOLDS and found[-1] == "train", cluster


def test_a_model_is_measured_on_nothing_that_it_was_trained_on():
    """For every kind of training, exactly its held-out splits are accepted."""
    programs = [data.Program(cluster, cluster, cluster, ()) for cluster in [*data.SPLITS["clusters"], "annoy your dog", "tell jokes", "whine"]]
    for dev, fold in [(False, None), (True, None), *[(False, fold) for fold in [*range(1, data.FOLDS + 1), "sealed"]]]:
        splits = {data.split_of(program.cluster, dev, fold) for program in programs} - {"train"}
        for split in ("calibration", "test", "dev", "sealed"):
            if split not in splits:
                with pytest.raises(SystemExit, match=f"holds no programs out as '{split}', and its model was trained on them: choose calibration"):
                    data.held_out(programs, split, dev, fold)
                continue
            trained, held = data.held_out(programs, split, dev, fold)
            assert trained and held and not {p.cluster for p in trained} & {p.cluster for p in held}
            assert {data.split_of(p.cluster, dev, fold) for p in trained} == {"train"}


def test_titles_near_each_other_are_one_activity():
    for titles in (("Watch TV", "Turn on TV with remote"), ("Write an email", "Browse internet"), ("Wash teeth", "Change toothbrush"), ("Read book", "Read  newspaper")):
        assert len({data.cluster_of(title) for title in titles}) == 1, titles
    programs = [data.Program("", title, data.cluster_of(title), ()) for title in ("Watch TV", "watch  movie", "Whine")]
    assert data.activities(programs) == {"television": ["watch movie", "watch tv"]}


def test_every_action_has_other_wordings():
    assert list(narration.PARAPHRASES) == list(narration.ACTIONS)
    for action, wordings in narration.PARAPHRASES.items():
        entry = narration.ACTIONS[action]
        known = {(entry["base"], *entry["tails"])}
        for base, third, past, ing, *tails in wordings:
            assert all((base, third, past, ing)) and len(tails) == 3 and (base, *tails) not in known, (action, base)
            known.add((base, *tails))
            for objects, tail in enumerate(tails):
                assert sorted(re.findall(r"the \{(\d)\}", tail)) == sorted(re.findall(r"\{(.*?)\}", tail)) == [str(n) for n in range(objects)], (action, tail)


def test_groups_of_a_routine_go_every_way():
    def ways(text):
        return {tuple(routines.flatten(text, random.Random(seed))) for seed in range(200)}

    assert ways("walk a; (grab b; open c / sit d); walk e") == {("walk a", "grab b", "open c", "walk e"), ("walk a", "sit d", "walk e")}
    assert ways("(sit d)?; walk e") == {("sit d", "walk e"), ("walk e",)}
    assert ways("{ sit d & grab b }") == {("sit d", "grab b"), ("grab b", "sit d")}


def test_routines_that_are_none_are_refused():
    assert len(routines.load(HERE / "routines")) > 7000
    for text in ("fly kitchen", "sit a, b, c", "(sit a; { grab b & grab c }; open d", "(sit a / fly b)", "(grab a & grab b)", "{ sit a / sit b }"):
        with pytest.raises(ValueError):
            routines.check(routines.Routine("x", "home", "x", text))


def test_kneser_ney_keeps_for_the_unknown_what_the_calibration_split_has_of_it():
    program = lambda *objects: data.Program("", "", "", tuple(narration.parse_step(f"[Walk] <{name}> (1)") for name in objects))
    known = ["fridge", "sofa", "bed", "table"]
    unknown = ["harp", "loom", "kiln", "anvil"]
    *_, third = statistics_file.count([program(*known)] * 20)
    kept = lambda *calibration: statistics_file.fit(third, list(calibration), [{*known, *unknown}])["discounts"][0][0]
    # Every second object is in the map that the training split does not know.
    assert kept(program("fridge", "harp", "sofa", "loom"), program("bed", "kiln", "table", "anvil")) > 0.9
    assert kept(program(*known), program("sofa", "fridge", "table", "bed")) < 0.5


def test_kneser_ney_shares_out_all_that_it_takes_from_counts_of_one_of_two_and_of_more():
    third = {"^>^>cup": {"sink": 5, "bed": 2, "sofa": 1}, "^>bed>cup": {"sink": 1}, "cup>sink>cup": {"bed": 9}}
    model = statistics_file.KneserNey(third, ["bed", "cup", "sink", "sofa", "lamp"])
    discounts = [[0.9, 1.1, 0.3], [0.2, 0.1, 2.9], [0.5, 2.0, 3.0], [1.0, 0.4, 1.5]]
    for context in (("^", "^", "cup"), ("x", "y", "cup"), ("x", "y", "z")):
        chances = [model.probability(model.counts(context, label), discounts) for label in model.objects]
        assert abs(sum(chances) - 1) < 1e-9 and min(chances) > 0
