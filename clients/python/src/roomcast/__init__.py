"""Narrators and planners for Roomcast.

    from roomcast import Planner

    with Planner("my-planner") as planner:
        for scores in planner.scores():
            calmest = min(scores.rooms, key=lambda room: room.probability)
            planner.decide(calmest.id, "where the person is least likely to go next")
"""

from __future__ import annotations

import json
import math
import secrets
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Generic, TypeVar

from . import layouts, ports
from .layouts import MessageError
from .messages import (
    Action,
    Decision,
    DecisionFlags,
    Forecast,
    ForecastFlags,
    ItemScore,
    ItemScores,
    Person,
    PersonFlags,
    PersonScores,
    Reached,
    Room,
    RoomForecast,
    RoomScores,
    ScoreFlags,
    Source,
    Status,
)
from .ports import Domain, NoAnswerError, RoomcastError

__all__ = [
    "Action",
    "Decision",
    "DecisionFlags",
    "Domain",
    "Forecast",
    "ForecastFlags",
    "ItemScore",
    "ItemScores",
    "ItemScoresSubscription",
    "MessageError",
    "Narrator",
    "NoAnswerError",
    "Person",
    "PersonFlags",
    "PersonScores",
    "Planner",
    "Reached",
    "Room",
    "RoomForecast",
    "RoomScores",
    "RoomcastError",
    "ScoreFlags",
    "Source",
    "Status",
    "StatusSubscription",
    "Subscription",
    "change_map",
    "moment",
    "source_of_name",
    "status",
]

SENTENCE, ACTION, DEVICE = 0, 1, 2

T = TypeVar("T")
Kind = TypeVar("Kind", RoomScores, PersonScores, Forecast, Decision)


def source_of_name(name: str) -> int:
    """A source's number from its name: 64-bit FNV-1a, never 0, the same as in Rust."""
    number = 0xCBF29CE484222325
    for byte in name.encode():
        number = ((number ^ byte) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    return max(number, 1)


class _Follows(ABC, Generic[T]):
    """Messages one after the other. A context manager: leaving gives the place to somebody else."""

    @abstractmethod
    def _take(self) -> T | None:
        """What is there already."""

    @abstractmethod
    def _sleep(self, timeout_s: float) -> None:
        """Waits for news, at most this long."""

    @abstractmethod
    def close(self) -> None:
        """Gives the place to somebody else."""

    def next(self, timeout_s: float | None = None) -> T | None:
        """Waits for the next one; none when the time is over."""
        deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while True:
            message = self._take()
            if message is not None:
                return message
            left = deadline - time.monotonic()
            if left <= 0:
                return None
            self._sleep(min(left, 0.1))

    def __iter__(self) -> Iterator[T]:
        """All as they come, without end."""
        while (message := self.next()) is not None:
            yield message

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


Self = TypeVar("Self", bound=_Follows[Any])


class Subscription(_Follows[Kind]):
    """Follows all room scores, persons' scores, forecasts or decisions under a name for people: `Subscription(Forecast, "my-display")`.

    Of scores the heartbeats are left out, which say the same again. Every loss shows as a gap in the sequence numbers.
    """

    def __init__(self, kind: type[Kind], name: str, domain: Domain | None = None) -> None:
        node = (domain or Domain.default_for_user()).open(name)
        self._subscriber: ports.Subscriber[Kind] = ports.Subscriber(node, kind.SERVICE, kind.from_message)
        self._scores: tuple[int, int] | None = None

    @property
    def malformed(self) -> int:
        """Messages that said what no honest sender says, and were dropped."""
        return self._subscriber.malformed

    def _take(self) -> Kind | None:
        while (message := self._subscriber.receive()) is not None:
            if isinstance(message, (RoomScores, PersonScores)):
                scores = (message.epoch, message.sequence)
                if scores == self._scores:
                    continue
                self._scores = scores
            return message
        return None

    def _sleep(self, timeout_s: float) -> None:
        self._subscriber.wait(timeout_s)

    def close(self) -> None:
        self._subscriber.close()


class ItemScoresSubscription(_Follows[ItemScores]):
    """Follows the scores of all items. The daemon sends them as long as somebody does."""

    def __init__(self, name: str, domain: Domain | None = None) -> None:
        node = (domain or Domain.default_for_user()).open(name)
        self._subscriber = ports.ItemScoresSubscriber(node)

    def _take(self) -> ItemScores | None:
        received = self._subscriber.receive()
        return None if received is None else ItemScores.from_message(*received)

    def _sleep(self, timeout_s: float) -> None:
        # Nobody is woken for them.
        time.sleep(min(timeout_s, 0.01))

    def close(self) -> None:
        self._subscriber.close()


class StatusSubscription(_Follows[Status]):
    """Asks the daemon for its status every `every_s` seconds, and goes on asking while none answers."""

    def __init__(self, name: str, domain: Domain | None = None, every_s: float = 1) -> None:
        node = (domain or Domain.default_for_user()).open(name)
        self._client = ports.StatusClient(node)
        self._every_s = every_s
        self._due = time.monotonic()

    def _take(self) -> Status | None:
        if time.monotonic() < self._due:
            return None
        try:
            answer = self._client.ask(0.3)
        except NoAnswerError:
            return None
        self._due = time.monotonic() + self._every_s
        return Status.from_message(answer)

    def _sleep(self, timeout_s: float) -> None:
        time.sleep(max(0.0, min(timeout_s, self._due - time.monotonic())))

    def close(self) -> None:
        self._client.close()


class _Participant:
    def __init__(self, name: str, domain: Domain | None) -> None:
        self.name = name
        self.node = (domain or Domain.default_for_user()).open(name)
        self._scores: ports.Subscriber[RoomScores] = ports.Subscriber(self.node, ports.ROOM_SCORES, RoomScores.from_message)

    @property
    def malformed(self) -> int:
        """Room scores that said what no honest sender says, and were dropped."""
        return self._scores.malformed

    def newest(self) -> RoomScores | None:
        """The newest snapshot that has not been taken yet."""
        return self._scores.newest()


class Narrator(_Participant):
    """Tells the daemon what a person has just done. A context manager: leaving waits until the daemon has taken it in."""

    def __init__(self, name: str, domain: Domain | None = None, person: int = 0) -> None:
        super().__init__(name, domain)
        if not 0 <= person < 1 << 32:
            raise ValueError(f"person {person}: give a number from 0 to {(1 << 32) - 1}")
        self._publisher = ports.Publisher(self.node, ports.NARRATION)
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
        message = layouts.NarrationV1(source=self.source, epoch=self.epoch, sequence=self.sequence + 1, person=self.person, kind=kind)
        message.text_bytes = layouts.write_text("text", message.text, text)
        layouts.write_text("source_name", message.source_name, self.name)
        message.observed_ns, message.observed_unix_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME), time.time_ns()
        self._publisher.send(message)
        self.sequence += 1

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
        self._publisher = ports.Publisher(self.node, ports.DECISION)
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
        if not 0 <= stay_s <= 1e9:
            raise ValueError(f"stay_s is {stay_s}; give seconds from 0 to 1e9")
        message = layouts.DecisionV1(robot=self.robot, epoch=self.epoch, sequence=self.sequence + 1, action=int(room != self.room))
        message.decided_ns, message.decided_unix_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME), time.time_ns()
        message.stay_ns = round(stay_s * 1e9)
        if self._last is not None:
            message.scores_epoch, message.scores_sequence = self._last.epoch, self._last.sequence
            message.scores_age_ns = max(0, message.decided_ns - self._last.computed_ns)
            message.observed_ns = self._last.observed_ns
            message.probability = next((r.probability for r in self._last.rooms if r.id == room), 0.0)
        layouts.write_text("from", getattr(message, "from"), self.room)
        layouts.write_text("to", message.to, room)
        layouts.write_text("policy", message.policy, layouts.cut(self.name, layouts.NAME_BYTES))
        layouts.write_text("reason", message.reason, layouts.cut(reason, layouts.REASON_BYTES))
        self._publisher.send(message)
        self.sequence += 1
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
    question = {"id": secrets.token_hex(8), "changes": changes}
    answer = _ask(node, ports.MAP_CHANGE, question, timeout_s)
    if answer.get("outcome") != "applied":
        raise RoomcastError(f"the daemon did not change its map: {answer.get('reason')}")
    return answer


def moment(domain: Domain | None = None, timeout_s: float = 10) -> dict[str, Any]:
    """All that is behind the newest scores: the map in use, the narration that the model read, every label's tokens, and what the prior
    adds to their sum (`prior_nats`)."""
    node = (domain or Domain.default_for_user()).open("python-moment")
    return _ask(node, ports.MOMENT, {}, timeout_s)


def status(domain: Domain | None = None, timeout_s: float = 10) -> Status:
    """The daemon's status, asked for once; NoAnswerError when no daemon answers in time."""
    node = (domain or Domain.default_for_user()).open("python-status")
    client = ports.StatusClient(node)
    try:
        return Status.from_message(client.ask(timeout_s))
    finally:
        client.close()


def _ask(node: ports.Node, service: str, question: dict[str, Any], timeout_s: float) -> dict[str, Any]:
    try:
        answer = json.loads(ports.ask(node, service, json.dumps(question), timeout_s))
    except json.JSONDecodeError as error:
        raise RoomcastError(f"service {service}: the answer is no JSON: {error}; is the daemon of this version?") from error
    if not isinstance(answer, dict):
        raise RoomcastError(f"service {service}: the answer is no JSON object; is the daemon of this version?")
    return answer
