"""Narrators and planners for Roomcast.

    from roomcast import Planner

    with Planner("my-planner") as planner:
        for scores in planner.scores():
            calmest = min(scores.rooms, key=lambda room: room.probability)
            planner.decide(calmest.id, "least likely to be occupied")
"""

from __future__ import annotations

import json
import math
import secrets
import time
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from . import layouts, ports
from .ports import Domain, RoomcastError

__all__ = [
    "Domain",
    "Narrator",
    "Planner",
    "Room",
    "RoomScores",
    "RoomcastError",
    "Source",
    "change_map",
    "moment",
    "source_of_name",
]

SENTENCE, ACTION, DEVICE = 0, 1, 2


def source_of_name(name: str) -> int:
    """A source's number from its name: 64-bit FNV-1a, never 0, the same as in Rust."""
    number = 0xCBF29CE484222325
    for byte in name.encode():
        number = ((number ^ byte) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    return max(number, 1)


@dataclass(frozen=True)
class Room:
    """A room of the map, and how likely a person is there soon."""

    id: str
    probability: float
    log_score_nats: float
    lower_log_score_nats: float
    upper_log_score_nats: float


@dataclass(frozen=True)
class Source:
    """The newest narration of one source that scores contain."""

    source: int
    epoch: int
    sequence: int
    observed_ns: int


@dataclass(frozen=True)
class RoomScores:
    """A full snapshot of what the daemon knows; times are of the monotonic clock."""

    epoch: int
    sequence: int
    computed_ns: int
    published_ns: int
    observed_ns: int
    label_mass: float
    heartbeat: bool
    flags: int
    model: str
    map: str
    rooms: tuple[Room, ...]
    included: tuple[Source, ...]

    @property
    def age_s(self) -> float:
        """Seconds since the scores were computed."""
        return (time.monotonic_ns() - self.computed_ns) / 1e9

    @staticmethod
    def from_message(message: layouts.RoomScoresV1) -> RoomScores:
        """Reads and checks a message; ValueError names what is malformed."""
        if not 1 <= message.room_count <= layouts.MAX_ROOMS or message.source_count > layouts.MAX_SOURCES:
            raise ValueError(f"room scores of {message.room_count} rooms and {message.source_count} sources")
        rooms = []
        for room in message.room[: message.room_count]:
            if not 0 <= room.probability <= 1 or math.isnan(room.log_score_nats):
                raise ValueError(f"room {layouts.read_text(room.id)!r} has the probability {room.probability}")
            rooms.append(
                Room(
                    layouts.read_text(room.id),
                    room.probability,
                    room.log_score_nats,
                    room.lower_log_score_nats,
                    room.upper_log_score_nats,
                )
            )
        sources = message.included[: message.source_count]
        return RoomScores(
            epoch=message.epoch,
            sequence=message.sequence,
            computed_ns=message.computed_ns,
            published_ns=message.published_ns,
            observed_ns=message.observed_ns,
            label_mass=message.label_mass,
            heartbeat=bool(message.flags & 1),
            flags=message.flags,
            model=bytes(message.model_fingerprint).hex(),
            map=bytes(message.map_fingerprint).hex(),
            rooms=tuple(rooms),
            included=tuple(Source(s.source, s.epoch, s.sequence, s.observed_ns) for s in sources),
        )


class _Participant:
    def __init__(self, name: str, domain: Domain | None) -> None:
        self.name = name
        self.node = (domain or Domain.default_for_user()).open(name)
        self._scores: ports.Subscriber[layouts.RoomScoresV1] = ports.Subscriber(self.node, ports.ROOM_SCORES)

    def newest(self) -> RoomScores | None:
        """The newest snapshot that has not been taken yet; malformed ones are passed over."""
        newest = None
        while (message := self._scores.receive()) is not None:
            try:
                newest = RoomScores.from_message(message)
            except ValueError:
                continue
        return newest


class Narrator(_Participant):
    """Tells the daemon what a person has just done. A context manager: leaving waits until the daemon has taken it in."""

    def __init__(self, name: str, domain: Domain | None = None, person: int = 0) -> None:
        super().__init__(name, domain)
        self._publisher: ports.Publisher[layouts.NarrationV1] = ports.Publisher(self.node, ports.NARRATION)
        self.source = source_of_name(name)
        self.epoch = secrets.randbits(64) | 1
        self.sequence = 0
        self.person = person

    def say(self, sentence: str) -> None:
        """A plain sentence: "They grab the mug." """
        self._send(SENTENCE, sentence)

    def act(self, action: str) -> None:
        """A completed action in VirtualHome's notation: "[Grab] <mug> (1)"."""
        self._send(ACTION, action)

    def device(self, state: str) -> None:
        """A device's state: "the oven is on"."""
        self._send(DEVICE, state)

    def _send(self, kind: int, text: str) -> None:
        message = layouts.NarrationV1()
        message.text_bytes = layouts.write_text(message.text, text, "a narration")
        if message.text_bytes == 0:
            raise ValueError("a narration is empty")
        layouts.write_text(message.source_name, self.name, "the narrator's name")
        self.sequence += 1
        message.source, message.epoch, message.sequence = self.source, self.epoch, self.sequence
        message.observed_ns, message.observed_unix_ns = time.monotonic_ns(), time.time_ns()
        message.person, message.kind = self.person, kind
        self._publisher.send(message)

    def wait_until_included(self, timeout_s: float = 10) -> RoomScores | None:
        """Waits for scores that contain all that was said; none when the time is over."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            self._publisher.tick()
            self._scores.wait(0.1)
            scores = self.newest()
            for source in scores.included if scores else ():
                if (source.source, source.epoch) == (self.source, self.epoch) and source.sequence >= self.sequence:
                    return scores
        return None

    def __enter__(self) -> Narrator:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        # What waits in shared memory dies with its publisher.
        if kind is None and self.sequence:
            self.wait_until_included()


class Planner(_Participant):
    """Follows the room scores and publishes decisions."""

    def __init__(self, name: str, domain: Domain | None = None) -> None:
        super().__init__(name, domain)
        self._publisher: ports.Publisher[layouts.DecisionV1] = ports.Publisher(self.node, ports.DECISION)
        self.robot = source_of_name(name)
        self.epoch = secrets.randbits(64) | 1
        self.sequence = 0
        self.room = ""
        self._last: RoomScores | None = None

    def scores(self, timeout_s: float | None = None) -> Iterator[RoomScores]:
        """Every new snapshot as it comes, heartbeats left out; ends when none came for `timeout_s`."""
        last = time.monotonic()
        while timeout_s is None or time.monotonic() - last < timeout_s:
            self._publisher.tick()
            self._scores.wait(0.25)
            scores = self.newest()
            if scores is None:
                continue
            if self._last is None or (scores.epoch, scores.sequence) != (self._last.epoch, self._last.sequence):
                self._last, last = scores, time.monotonic()
                yield scores

    def decide(self, room: str, reason: str, stay_s: float = 0) -> None:
        """Publishes that the robot goes to `room`, or stays there."""
        message = layouts.DecisionV1()
        self.sequence += 1
        message.robot, message.epoch, message.sequence = self.robot, self.epoch, self.sequence
        message.decided_ns, message.decided_unix_ns = time.monotonic_ns(), time.time_ns()
        message.action = int(room != self.room)
        message.stay_ns = round(stay_s * 1e9)
        if self._last is not None:
            message.scores_epoch, message.scores_sequence = self._last.epoch, self._last.sequence
            message.scores_age_ns = max(0, message.decided_ns - self._last.computed_ns)
            message.observed_ns = self._last.observed_ns
            message.probability = next((r.probability for r in self._last.rooms if r.id == room), 0.0)
        layouts.write_text(getattr(message, "from"), self.room, "a room's id")
        layouts.write_text(message.to, room, "a room's id")
        layouts.write_text(message.policy, self.name.encode()[: layouts.NAME_BYTES].decode(errors="ignore"), "the policy's name")
        layouts.write_text(message.reason, reason[: layouts.REASON_BYTES // 4], "a reason")
        self._publisher.send(message)
        self.room = room

    def __enter__(self) -> Planner:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        pass


def change_map(changes: list[dict[str, Any]], domain: Domain | None = None, timeout_s: float = 10) -> dict[str, Any]:
    """Changes the map of the running daemon: items added, moved, removed, rooms added, all or none.

    `scenes/README.md` documents the changes. Returns the daemon's answer; RoomcastError says why nothing changed.
    """
    node = (domain or Domain.default_for_user()).open("python-map-change")
    # Asked again under the same name, a change is done once.
    question = json.dumps({"id": secrets.token_hex(8), "changes": changes})
    answer: dict[str, Any] = json.loads(ports.ask(node, ports.MAP_CHANGE, question, timeout_s))
    if answer["outcome"] != "applied":
        raise RoomcastError(f"the daemon did not change its map: {answer.get('reason')}")
    return answer


def moment(domain: Domain | None = None, timeout_s: float = 10) -> dict[str, Any]:
    """All that is behind the newest scores: the map in use, the narration that the model read, every label's tokens, and what the prior
    adds to their sum (`prior_nats`)."""
    node = (domain or Domain.default_for_user()).open("python-moment")
    answer: dict[str, Any] = json.loads(ports.ask(node, ports.MOMENT, "{}", timeout_s))
    return answer
