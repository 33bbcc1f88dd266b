"""Good messages, and what the tests share."""

from __future__ import annotations

import math
import os
import pathlib
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

from roomcast import Domain, layouts

ROOMCAST = os.environ.get("ROOMCAST", "")


@contextmanager
def private_domain() -> Iterator[Domain]:
    """A domain of the test's own, of which nothing is left behind."""
    with tempfile.TemporaryDirectory(prefix="rc-", dir="/tmp") as root:
        name = f"py-{os.getpid()}-{time.monotonic_ns() % 100000}"
        try:
            yield Domain(root, name)
        finally:
            # What iceoryx2 keeps per prefix in shared memory.
            for left in pathlib.Path("/dev/shm").glob(f"{name}_*"):
                left.unlink(missing_ok=True)


def narration(text: str = "They grab the mug.") -> layouts.NarrationV1:
    message = layouts.NarrationV1(source=7, epoch=1, sequence=1, observed_ns=5, kind=0)
    message.text_bytes = layouts.write_text("text", message.text, text)
    layouts.write_text("source_name", message.source_name, "kitchen-camera")
    return message


def scores(sequence: int = 1, **rooms: float) -> layouts.RoomScoresV1:
    rooms = rooms or {"kitchen": 0.75, "bathroom": 0.25, "attic": 0.0}
    message = layouts.RoomScoresV1(epoch=3, sequence=sequence, computed_ns=time.clock_gettime_ns(time.CLOCK_BOOTTIME), label_mass=0.8, room_count=len(rooms))
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
    message = layouts.PersonScoresV1(epoch=3, sequence=sequence, computed_ns=time.monotonic_ns(), room_count=2, persons=2, person_count=2)
    for room, name in enumerate(["kitchen", "bathroom"]):
        layouts.write_text("room id", message.id[room], name)
    for number, kitchen in enumerate([0.75, 0.0]):
        person = message.person[number]
        person.person, person.label_mass, person.window, person.flags = number, 0.8, 4, number
        person.probability[:2] = [kitchen, 1 - kitchen]
        for field in ("log_score_nats", "lower_log_score_nats", "upper_log_score_nats"):
            getattr(person, field)[:2] = [math.log(kitchen) if kitchen else -math.inf, math.log(1 - kitchen)]
    return message


def forecast(sequence: int = 1) -> layouts.ForecastV1:
    message = layouts.ForecastV1(epoch=3, sequence=sequence, computed_ns=time.clock_gettime_ns(time.CLOCK_BOOTTIME), room_count=2, horizon_count=3)
    message.horizon_s[:3] = [10.0, 60.0, 600.0]
    for room, (name, row) in enumerate({"kitchen": [0.75, 0.5, 0.25], "bathroom": [0.25, 0.5, 0.75]}.items()):
        layouts.write_text("room id", message.id[room], name)
        message.probability[room][:3] = row
    return message


def decision(sequence: int = 1) -> layouts.DecisionV1:
    message = layouts.DecisionV1(robot=9, epoch=2, sequence=sequence, action=1, probability=0.25, stay_ns=60_000_000_000)
    layouts.write_text("to", message.to, "bathroom")
    layouts.write_text("policy", message.policy, "calm-planner")
    layouts.write_text("reason", message.reason, "the person is least likely to go there next")
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
    layouts.DecisionV1: decision,
}
