"""Narrator and planner in Python with a real daemon, in a private domain; and with one another."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import pytest

from roomcast import (
    Domain,
    Narrator,
    Planner,
    RoomcastError,
    RoomScores,
    change_map,
    layouts,
    moment,
    ports,
    source_of_name,
)

ROOMCAST = os.environ.get("ROOMCAST", "")
EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"


@pytest.fixture
def domain() -> Iterator[Domain]:
    with tempfile.TemporaryDirectory(prefix="rc-", dir="/tmp") as root:
        name = f"py-{os.getpid()}-{time.monotonic_ns() % 100000}"
        yield Domain(root, name)
        # What iceoryx2 keeps per prefix in shared memory.
        for left in pathlib.Path("/dev/shm").glob(f"{name}_*"):
            left.unlink(missing_ok=True)


def test_a_decision_arrives(domain: Domain) -> None:
    with Planner("py-planner", domain) as planner:
        watcher: ports.Subscriber[layouts.DecisionV1] = ports.Subscriber(domain.open("watcher"), ports.DECISION)
        planner.decide("kitchen", "nobody is there", stay_s=60)
        watcher.wait(1)
        decision = watcher.receive()
    assert decision is not None
    assert layouts.read_text(decision.to) == "kitchen"
    assert layouts.read_text(decision.reason) == "nobody is there"
    assert (decision.robot, decision.sequence, decision.action) == (source_of_name("py-planner"), 1, 1)
    assert decision.stay_ns == 60_000_000_000


def test_a_name_may_be_in_any_letters(domain: Domain) -> None:
    with Planner("Кухонный помощник нашей бабушки", domain) as planner:
        planner.decide("kitchen", "nobody is there")


def test_malformed_scores_are_refused() -> None:
    message = layouts.RoomScoresV1(epoch=1, sequence=1, room_count=65)
    with pytest.raises(ValueError, match="65 rooms"):
        RoomScores.from_message(message)
    message.room_count = 1
    message.room[0].probability = float("nan")
    with pytest.raises(ValueError, match="probability nan"):
        RoomScores.from_message(message)


@pytest.fixture
def daemon(domain: Domain) -> Iterator[Domain]:
    if not ROOMCAST or subprocess.run([ROOMCAST, "daemon", "--help"], capture_output=True, check=False).returncode:
        pytest.skip("SKIPPED: set ROOMCAST to the built binary")
    process = subprocess.Popen([ROOMCAST, "daemon", "--root", domain.root, "--domain", domain.name])
    yield domain
    process.terminate()
    assert process.wait(10) is not None


def test_a_narrator_is_heard_and_a_planner_sees_the_same_scores(daemon: Domain) -> None:
    with Planner("py-planner", daemon) as planner, Narrator("py-narrator", daemon) as narrator:
        narrator.say("They walk to the kitchen.")
        narrator.act("[Open] <fridge> (1)")
        heard = narrator.wait_until_included(20)
        assert heard is not None and heard.included[0].sequence == 2
        seen = [scores for scores in planner.scores(timeout_s=1)][-1]
        assert (seen.epoch, seen.sequence, seen.rooms) == (heard.epoch, heard.sequence, heard.rooms)
        assert sum(room.probability for room in seen.rooms) == pytest.approx(1)
        assert not [room for room in seen.rooms if not room.id]


def test_a_late_planner_has_the_scores_at_once(daemon: Domain) -> None:
    with Narrator("py-narrator", daemon) as narrator:
        narrator.say("They walk to the bathroom.")
        assert narrator.wait_until_included(20)
        with Planner("late", daemon) as planner:
            started = time.monotonic()
            assert next(planner.scores(timeout_s=5)).included[0].sequence == 1
            print(f"late joiner: {time.monotonic() - started:.3f} s", file=sys.stderr)


def test_the_rust_command_line_agrees(daemon: Domain) -> None:
    """The daemon's numbers for one narration are those of `roomcast score`."""
    import json

    with Narrator("py-narrator", daemon) as narrator:
        narrator.say("They open the fridge.")
        heard = narrator.wait_until_included(20)
    assert heard is not None
    printed = subprocess.run(
        [ROOMCAST, "score", "--narration", "They open the fridge.", "--json"], capture_output=True, text=True, check=True
    )
    once = {p["id"]: p["probability"] for p in json.loads(printed.stdout)["partitions"]}
    assert {room.id: room.probability for room in heard.rooms} == pytest.approx(once, abs=5e-3)


def test_the_map_is_changed_and_the_moment_told(daemon: Domain) -> None:
    with Narrator("py-narrator", daemon) as narrator:
        narrator.say("They open the fridge.")
        before = narrator.wait_until_included(20)
        assert before is not None
        box = {"min_m": [0.2, 0.2, 0.0], "max_m": [0.8, 0.8, 1.6]}
        move = {"change": "move-item", "id": "fridge-1", "position_m": [0.5, 0.5, 0.5], "box": box}
        answer = change_map([move], daemon)
        assert (answer["new_labels"], answer["epoch"]) == (0, f"{before.epoch:016x}")
        with pytest.raises(RoomcastError, match="there is no item"):
            change_map([{"change": "remove-item", "id": "piano-1"}], daemon)
        narrator.say("They close the fridge.")
        after = narrator.wait_until_included(20)
        assert after is not None and after.map == answer["map"] != before.map
    told = moment(daemon)
    assert [read["text"] for read in told["narration"]] == ["They open the fridge.", "They close the fridge."]
    assert told["map_fingerprint"] == after.map
    for label in told["labels"]:
        tokens = sum(token["log_prob_nats"] for token in label["tokens"])
        assert tokens + label["prior_nats"] == pytest.approx(label["log_prob_nats"])
