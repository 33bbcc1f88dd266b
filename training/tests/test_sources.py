"""What the training reads of the product is there. Runs without PyTorch, in every `make test`."""

import re
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE))

import data
import narration
import routines
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
