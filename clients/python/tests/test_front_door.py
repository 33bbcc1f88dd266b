"""The classes of the first page, which Rust has with the same names."""

from __future__ import annotations

import time
from typing import Any

import pytest

import samples
from roomcast import (
    Action,
    Decisions,
    Forecast,
    Forecasts,
    Narrator,
    NotIncludedError,
    Planner,
    Presence,
    ReportKind,
    Robot,
    RoomcastError,
    Scores,
    layouts,
    persons,
    ports,
)


def forecast_of(age_s: float) -> Forecast:
    message = samples.forecast()
    message.computed_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - round(age_s * 1e9)
    return Forecast.from_message(message)


@pytest.mark.parametrize(("ahead_s", "expected"), [(0, 0.75), (35, 0.625), (60, 0.5), (330, 0.375), (9000, 0.25)])
def test_a_forecast_between_two_horizons_is_interpolated(ahead_s: float, expected: float) -> None:
    assert forecast_of(0).occupied("kitchen", ahead_s) == pytest.approx(expected, abs=1e-3)


def test_an_old_forecast_is_corrected_for_its_age() -> None:
    assert forecast_of(25).occupied("kitchen", 10) == pytest.approx(0.625, abs=1e-3)


def test_an_unknown_room_has_no_forecast() -> None:
    assert forecast_of(0).occupied("cellar") is None


def test_a_narrators_words_become_events() -> None:
    with samples.private_domain() as domain:
        heard: ports.Subscriber[Any] = ports.Subscriber(domain.open("daemon"), ports.NARRATION, lambda message: message)
        narrator = Narrator("hall-camera", domain)
        narrator.did("ada", "opens the fridge")
        narrator.did(None, "sits down.")
        narrator.present("ada", "kitchen")
        narrator.away("ada")
        narrator.gone("ada")
        narrator.empty("hall")
        narrator.several(2, "They dance.")
        said = []
        while (message := heard.receive()) is not None:
            said.append((layouts.read_text("text", message.text), layouts.read_text("person_name", message.person_name), message.count))
        narrator.close()
    assert said == [
        ("ada opens the fridge.", "ada", 0),
        ("Somebody sits down.", "", 0),
        ("present in the kitchen", "ada", 0),
        ("away", "ada", 0),
        ("gone", "ada", 0),
        ("nobody in the hall", "", 0),
        ("They dance.", "", 2),
    ]


def test_a_planner_that_follows_forecasts_decides_by_them() -> None:
    with samples.private_domain() as domain:
        node = domain.open("daemon")
        with Planner("robot", domain) as planner, Decisions("watcher", domain) as decisions, Forecasts("watcher", domain) as forecasts:
            found = planner.forecasts(timeout_s=5)
            publisher = ports.Publisher(node, ports.FORECAST)
            publisher.send(samples.forecast())
            for _ in range(100):
                publisher.tick()
            forecast = next(found)
            planner.decide("bathroom", "it is quiet")
            decision = decisions.next(timeout_s=5)
            assert decision is not None and decision.to_room == "bathroom" and decision.probability == pytest.approx(0.25, abs=1e-2)
            followed = forecasts.next(timeout_s=5)
            assert followed is not None and followed.sequence == forecast.sequence
            with pytest.raises(ValueError, match="bathroom"):
                planner.decide("cellar", "it is quiet")


def test_empty_names_and_rooms_are_refused_with_a_remedy() -> None:
    with samples.private_domain() as domain:
        for join in (Narrator, Planner, Robot, Forecasts):
            with pytest.raises(RoomcastError, match="give a name"):
                join(" ", domain)
        with Planner("robot", domain) as planner, pytest.raises(ValueError, match="give the id of a room"):
            planner.decide("", "a reason")
        with pytest.raises(TypeError, match="give a Domain"):
            persons("bob")  # type: ignore[arg-type]


def test_an_event_without_a_daemon_is_not_confirmed() -> None:
    with samples.private_domain() as domain:
        narrator = Narrator("hall-camera", domain)
        narrator.did("ada", "opens the fridge")
        with pytest.raises(NotIncludedError, match="is the daemon running"):
            narrator.confirmed(timeout_s=0.2)
        narrator.close()


def test_scores_leave_out_heartbeats() -> None:
    with samples.private_domain() as domain:
        publisher = ports.Publisher(domain.open("daemon"), ports.ROOM_SCORES)
        with Scores(domain=domain) as scores:
            publisher.send(samples.scores())
            publisher.send(samples.scores())
            assert scores.next(timeout_s=5) is not None
            assert scores.next(timeout_s=0.05) is None


def test_an_unknown_number_keeps_its_value_and_an_unknown_word_is_none() -> None:
    unknown = Action(99)
    assert (unknown, unknown.word, unknown in list(Action)) == (99, "unknown", False)
    assert (Action.of_word("dance"), Action.of_word("unknown")) == (None, None)
    for kind in (Action, Presence, ReportKind):
        assert [kind.of_word(meaning.word) for meaning in kind] == list(kind)
    with pytest.raises(ValueError):
        Action(-1)


def test_senders_return_the_number_of_receivers() -> None:
    with samples.private_domain() as domain:
        narrator, planner, robot = Narrator("camera", domain), Planner("robot", domain), Robot("robot", domain)
        assert (narrator.say("They sit down."), robot.docked()) == (0, 0)
        heard: ports.Subscriber[Any] = ports.Subscriber(domain.open("daemon"), ports.NARRATION, lambda message: message)
        assert (narrator.present("ada"), planner.decide("hall", "it is quiet")) == (1, 1)
        assert heard.receive() is not None
        for port in (narrator, planner, robot):
            port.close()
