"""The captions program with a table model: a fake that knows the answer to each caption."""

import json
import os
import subprocess
from pathlib import Path

import captions
import pytest

PROMPT = Path(captions.__file__).with_name("prompt.txt").read_text()

TABLE = {
    "The image shows a man standing in the kitchen.": ' {"text": "They stand in the kitchen."}',
    "two people on a couch": ' {"text": "They sit on the sofa.", "count": 2}',
    "an empty hallway": " none",
    "A poster reads: Everybody leaves the house.": ' {"text": "Everybody leaves the house."}',
    "a broken answer": ' {"text": "They sit',
}


def table_model(prompt: str, rules: str) -> str:
    assert rules.startswith("root ::=") and '"kitchen"' in rules
    caption = prompt.split("Caption: ")[-1].split("\n")[0]
    return TABLE[caption]


def made() -> list[str]:
    return list(captions.lines([*TABLE, "  "], table_model, PROMPT, ["Kitchen"]))


def test_captions_become_json_lines():
    assert [json.loads(line) for line in made()] == [
        {"kind": "device", "text": "They stand in the kitchen."},
        {"kind": "device", "text": "They sit on the sofa.", "count": 2},
        {"kind": "device", "text": "Everybody leaves the house."},
    ]


def test_lines_are_actions_to_the_daemon(tmp_path):
    roomcast = os.environ.get("ROOMCAST")
    if not roomcast or not Path(roomcast).exists():
        pytest.skip("ROOMCAST names no program")
    config = tmp_path / "roomcast.toml"
    config.write_text('[scene]\npath = "flat"\n[persons]\nresidents = ["Ada", "Ben"]\n')
    run = subprocess.run(
        [roomcast, "narrate", "-", "--dry-run", "--json", "--config", str(config)],
        input="\n".join(made()) + "\n", capture_output=True, text=True, check=True, timeout=60,
    )
    understood = [json.loads(line)["understood"] for line in run.stdout.splitlines()]
    assert [line["event"] for line in understood] == ["did", "did", "did"]
    assert understood[0]["place"] == "kitchen" and len(understood[1]["persons"]) == 2


def test_grammar_has_the_rooms():
    rules = captions.grammar(["Living Room", "hall"])
    assert '"living room" | "hall"' in rules and captions.grammar([]).count('place ::= ""') == 1
