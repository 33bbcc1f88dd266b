"""Narrator and planner in Python with a real daemon, in a private domain; and with one another."""

from __future__ import annotations

import pathlib
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

import samples
from roomcast import (
    Decision,
    Domain,
    Forecast,
    ItemScoresSubscription,
    Narrator,
    Planner,
    RoomcastError,
    RoomScores,
    StatusSubscription,
    Subscription,
    change_map,
    layouts,
    moment,
    ports,
    source_of_name,
    status,
)
from samples import ROOMCAST


@pytest.fixture
def domain() -> Iterator[Domain]:
    with samples.private_domain() as domain:
        yield domain


def test_a_decision_arrives(domain: Domain) -> None:
    with Planner("py-planner", domain) as planner, Subscription(Decision, "watcher", domain) as decisions:
        planner.decide("kitchen", "nobody is there", stay_s=60)
        decision = decisions.next(timeout_s=1)
        assert decision is not None
        assert (decision.to_room, decision.reason) == ("kitchen", "nobody is there")
        assert (decision.robot, decision.sequence, decision.action) == (source_of_name("py-planner"), 1, 1)
        assert decision.stay_ns == 60_000_000_000
        planner.decide("hall", "a" * 1000)
        decision = decisions.next(timeout_s=1)
        assert decision is not None and (decision.from_room, decision.reason) == ("kitchen", "a" * 256)


def test_a_name_may_be_in_any_letters(domain: Domain) -> None:
    with Planner("Кухонный помощник нашей бабушки", domain) as planner:
        planner.decide("kitchen", "nobody is there")


def test_what_is_refused_leaves_no_gap(domain: Domain) -> None:
    with Planner("py-planner", domain) as planner, Subscription(Decision, "watcher", domain) as decisions:
        for room, reason, stay_s in [("a" * 49, "", 0.0), ("hall", "two\nlines", 0.0), ("hall", "", -1.0), ("hall", "", float("nan"))]:
            with pytest.raises(ValueError):
                planner.decide(room, reason, stay_s)
        planner.decide("hall", "nobody is there")
        decision = decisions.next(timeout_s=1)
        assert decision is not None and decision.sequence == 1
    narrator = Narrator("py-narrator", domain)
    for text in ["", "two\nlines", "a" * 1025, "left\u202eright"]:
        with pytest.raises(ValueError):
            narrator.say(text)
    assert narrator.sequence == 0
    for person in (-1, 1 << 32):
        with pytest.raises(ValueError, match="give a number from 0 to 4294967295"):
            Narrator("py-narrator", domain, person)


def test_malformed_messages_are_dropped_and_counted(domain: Domain) -> None:
    publisher = ports.Publisher(domain.open("daemon"), ports.ROOM_SCORES)
    with Subscription(RoomScores, "watcher", domain) as scores, Planner("py-planner", domain) as planner:
        for sequence, change in enumerate([lambda m: None, lambda m: setattr(m, "label_mass", float("inf"))] * 2, 1):
            message = samples.scores(sequence)
            change(message)
            publisher.send_unchecked(message)
        # Two wait at most: the last good one, and the malformed one after it.
        told = scores.next(timeout_s=1)
        assert told is not None and told.sequence == 3 and scores.next(timeout_s=0.1) is None and scores.malformed == 1
        newest = planner.newest()
        assert newest is not None and newest.sequence == 3 and planner.malformed == 1
    with pytest.raises(ValueError, match="label_mass: inf, allowed is 0 or more, finite"):
        publisher.send(message)


def test_heartbeats_are_no_news(domain: Domain) -> None:
    publisher = ports.Publisher(domain.open("daemon"), ports.ROOM_SCORES)
    with Subscription(RoomScores, "watcher", domain) as scores:
        # A heartbeat may be the first that is seen of new scores.
        for sequence, flags, news in [(1, 0, True), (1, 1, False), (2, 1, True), (2, 1, False)]:
            message = samples.scores(sequence)
            message.flags = flags
            publisher.send(message)
            told = scores.next(timeout_s=0.1)
            assert (told is not None) == news, (sequence, flags)
        assert scores.malformed == 0


def test_the_next_is_waited_for(domain: Domain) -> None:
    node = domain.open("daemon")
    with Subscription(Forecast, "watcher", domain) as forecasts:
        assert forecasts.next(timeout_s=0) is None
        publisher = ports.Publisher(node, ports.FORECAST)
        started = time.monotonic()
        assert forecasts.next(timeout_s=0.3) is None and time.monotonic() - started >= 0.3
        for sequence in (1, 2):
            publisher.send(samples.forecast(sequence))
        assert [forecast.sequence for _, forecast in zip(range(2), forecasts, strict=False)] == [1, 2]


def test_a_place_is_free_after_leaving(domain: Domain) -> None:
    for _ in range(3):
        kept = [Subscription(Decision, f"watcher-{number}", domain) for number in range(16)]
        for each in kept:
            with each:
                pass


def test_nobody_answers_without_a_daemon(domain: Domain) -> None:
    with pytest.raises(RoomcastError, match="service roomcast/v1/status: no answer within 0.1 s; is the daemon running"):
        status(domain, timeout_s=0.1)
    with StatusSubscription("watcher", domain) as statuses:
        assert statuses.next(timeout_s=0.1) is None
    with pytest.raises(RoomcastError, match="service roomcast/v1/moment: no answer"):
        moment(domain, timeout_s=0.1)


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


def test_every_kind_can_be_followed(daemon: Domain) -> None:
    with (
        Narrator("py-narrator", daemon) as narrator,
        Subscription(RoomScores, "scores", daemon) as scores,
        Subscription(Forecast, "forecasts", daemon) as forecasts,
        ItemScoresSubscription("items", daemon) as items,
        StatusSubscription("statuses", daemon, every_s=0.1) as statuses,
    ):
        narrator.say("They walk to the kitchen.")
        heard = narrator.wait_until_included(20)
        assert heard is not None
        told = [each for each in (scores.next(10), scores.next(0.3)) if each is not None][-1]
        assert (told.sequence, told.rooms, told.window) == (heard.sequence, heard.rooms, 1)
        forecast = forecasts.next(10)
        assert forecast is not None and [room.id for room in forecast.rooms] == [room.id for room in told.rooms]
        item_scores = items.next(10)
        assert item_scores is not None and item_scores.epoch == told.epoch and item_scores.items[0].id
        first, second = statuses.next(10), statuses.next(10)
        assert first is not None and second is not None and second.answered_ns > first.answered_ns
        assert (second.accepted, second.malformed, second.map_fingerprint) == (1, 0, told.map)


def test_the_daemon_counts_what_python_would_refuse(daemon: Domain) -> None:
    """The same malformed narrations are refused on both sides."""
    from test_messages import FAULTS

    publisher = ports.Publisher(daemon.open("hostile"), ports.NARRATION)
    faults = [change for kind, _, change, _ in FAULTS if kind is layouts.NarrationV1]
    status(daemon, 20)
    for change in faults:
        message = samples.narration()
        change(message)
        publisher.send_unchecked(message)
    deadline = time.monotonic() + 10
    while (told := status(daemon)).malformed < len(faults):
        assert time.monotonic() < deadline, told
        publisher.tick()
        time.sleep(0.1)
    assert (told.malformed, told.accepted) == (len(faults), 0)
