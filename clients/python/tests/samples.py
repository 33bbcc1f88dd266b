"""Good messages, and what the tests share."""

from __future__ import annotations

import itertools
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager

from roomcast import Domain, layouts, source_of_name

ROOMCAST = os.environ.get("ROOMCAST", "")
_NUMBERS = itertools.count()


def now_ns() -> int:
    """The clock of the messages."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


#: What can be open in a domain, as a script makes it.
KINDS = {
    "room scores": "Subscription(RoomScores, 'x', domain)",
    "decisions": "Subscription(Decision, 'x', domain)",
    "item scores": "ItemScoresSubscription('x', domain)",
    "status": "StatusSubscription('x', domain)",
    "narrator": "Narrator('x', domain)",
    "planner": "Planner('x', domain)",
    "robot": "Robot('x', domain)",
}
# All that can be done with what is open.
USES = """
    import gc, os, pathlib, signal, sys, threading, time
    from roomcast import *

    domain = Domain(*sys.argv[1:])
    each = {kind}

    def uses():
        if isinstance(each, Narrator):
            return [lambda: each.say("They sit."), each.newest, lambda: each.wait_until_included(0)]
        if isinstance(each, Planner):
            return [lambda: each.decide("hall", "it is empty"), lambda: each.pause("somebody comes"), each.newest]
        if isinstance(each, Robot):
            return [lambda: each.next(0), each.docked]
        return [lambda: each.next(0)]
"""


def of_a_kind(kind: str, script: str, domain: Domain) -> subprocess.CompletedProcess[str]:
    """Runs a script with one of `KINDS` open as `each`, in a process of its own: iceoryx2 ends the process that uses what was deleted."""
    script = textwrap.dedent(USES).replace("{kind}", KINDS[kind]) + textwrap.dedent(script)
    return subprocess.run([sys.executable, "-c", script, domain.root, domain.name], capture_output=True, text=True, check=False)


@contextmanager
def private_domain() -> Iterator[Domain]:
    """A domain of the test's own, of which nothing is left behind."""
    with tempfile.TemporaryDirectory(prefix="rc-", dir="/tmp") as root:
        name = f"py-{os.getpid()}-{next(_NUMBERS)}"
        try:
            yield Domain(root, name)
        finally:
            # What iceoryx2 keeps per prefix in shared memory.
            for left in pathlib.Path("/dev/shm").glob(f"{name}-*"):
                left.unlink(missing_ok=True)


def narration(text: str = "They grab the mug.") -> layouts.NarrationV1:
    message = layouts.NarrationV1(source=7, epoch=1, sequence=1, observed_ns=5, kind=0)
    message.text_bytes = layouts.write_text("text", message.text, text)
    layouts.write_text("source_name", message.source_name, "kitchen-camera")
    return message


def scores(sequence: int = 1, **rooms: float) -> layouts.RoomScoresV1:
    rooms = rooms or {"kitchen": 0.75, "bathroom": 0.25, "attic": 0.0}
    message = layouts.RoomScoresV1(epoch=3, sequence=sequence, computed_ns=now_ns(), label_mass=0.8, room_count=len(rooms))
    message.published_ns = message.computed_ns
    message.source_count = 1
    message.included[0] = layouts.IncludedV1(source=7, epoch=1, sequence=4, observed_ns=5, accepted=4)
    for room, (name, probability) in zip(message.room, rooms.items(), strict=False):
        layouts.write_text("room id", room.id, name)
        room.probability = probability
        nats = math.log(probability) if probability else -math.inf
        room.log_score_nats = room.lower_log_score_nats = room.upper_log_score_nats = nats
    return message


def person_scores(sequence: int = 1) -> layouts.PersonScoresV1:
    """Person 0 is at home, and person 1, whose name is Ada, is not."""
    message = layouts.PersonScoresV1(epoch=3, sequence=sequence, computed_ns=now_ns(), room_count=2, persons=2, person_count=2)
    for room, name in enumerate(["kitchen", "bathroom"]):
        layouts.write_text("room id", message.id[room], name)
    for number, kitchen in enumerate([0.75, 0.0]):
        person = message.person[number]
        person.presence = 1 + number
        person.person, person.label_mass, person.window, person.flags = number, 0.8, 4, number
        person.probability[:2] = [kitchen, 0.25 if kitchen else 0.0]
        for field in ("log_score_nats", "lower_log_score_nats", "upper_log_score_nats"):
            getattr(person, field)[:2] = [math.log(each) if each else -math.inf for each in person.probability[:2]]
    ada = message.person[1]
    ada.elsewhere, ada.since_ns = 1.0, 5
    layouts.write_text("name", ada.name, "Ada")
    return message


def forecast(sequence: int = 1) -> layouts.ForecastV1:
    message = layouts.ForecastV1(epoch=3, sequence=sequence, computed_ns=now_ns(), room_count=2, horizon_count=3)
    message.horizon_s[:3] = [10.0, 60.0, 600.0]
    for room, (name, row) in enumerate({"kitchen": [0.75, 0.5, 0.25], "bathroom": [0.25, 0.5, 0.75]}.items()):
        layouts.write_text("room id", message.id[room], name)
        message.probability[room][:3] = row
    return message


def person_forecasts(sequence: int = 1) -> layouts.PersonForecastsV1:
    """Ada is in the kitchen, and leaves the house within ten minutes, more likely than not."""
    message = layouts.PersonForecastsV1(epoch=3, sequence=sequence, computed_ns=now_ns(), room_count=2, horizon_count=2, persons=1, person_count=1)
    message.horizon_s[:2] = [0.0, 600.0]
    ada = message.person[0]
    ada.person, ada.presence, ada.set_coverage, ada.set_elsewhere = 7, 1, 0.9, 0b10
    layouts.write_text("name", ada.name, "Ada")
    for room, (name, row) in enumerate({"kitchen": [1.0, 0.25], "bathroom": [0.0, 0.125]}.items()):
        layouts.write_text("room id", message.id[room], name)
        ada.probability[room][:2] = row
    ada.elsewhere[:2] = [0.0, 0.625]
    ada.room_set[:2] = [0b01, 0b11]
    ada.observations, ada.learned_share[:] = 240.0, [0.25, 0.5, 0.75]
    return message


def decision(sequence: int = 1) -> layouts.DecisionV1:
    message = layouts.DecisionV1(robot=source_of_name("robot"), epoch=2, sequence=sequence, action=1, probability=0.25, stay_ns=60_000_000_000)
    layouts.write_text("to", message.to, "bathroom")
    layouts.write_text("policy", message.policy, "calm-planner")
    layouts.write_text("reason", message.reason, "the person is least likely to go there next")
    return message


def robot_report(sequence: int = 1) -> layouts.RobotReportV1:
    message = layouts.RobotReportV1(robot=source_of_name("robot"), epoch=4, sequence=sequence, kind=2, decision_epoch=2, decision_sequence=1)
    message.flags, message.battery, message.position_m[:] = 3, 0.5, [1.0, 2.0, 0.0]
    layouts.write_text("robot_name", message.robot_name, "robot")
    layouts.write_text("room", message.room, "bathroom")
    layouts.write_text("note", message.note, "the carpet too")
    return message


def status() -> layouts.StatusResponseV1:
    message = layouts.StatusResponseV1(epoch=3, sequence=1, received=5, accepted=4, malformed=1, process=os.getpid())
    layouts.write_text("version", message.version, "0.1.0")
    layouts.write_text("map", message.map, "flat")
    layouts.write_text("model", message.model, "household")
    return message


GOOD = {
    layouts.NarrationV1: narration,
    layouts.RoomScoresV1: scores,
    layouts.PersonScoresV1: person_scores,
    layouts.ForecastV1: forecast,
    layouts.PersonForecastsV1: person_forecasts,
    layouts.DecisionV1: decision,
    layouts.RobotReportV1: robot_report,
}
