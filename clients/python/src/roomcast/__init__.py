"""Narrators, planners and robots for Roomcast.

    from roomcast import ForecastFlags, Planner

    with Planner("my-planner") as planner:
        while True:
            for forecast in planner.forecasts(timeout_s=2):
                if ForecastFlags.NOT_KNOWN in forecast.flags:
                    planner.pause("no person was observed yet")
                    continue
                calmest = min(forecast.rooms, key=lambda room: forecast.occupied(room.id, 60))
                planner.decide(calmest.id, "the room is least likely to be occupied in a minute")
            planner.pause("no forecast for two seconds")
"""

from __future__ import annotations

import json
import math
import re
import secrets
import time
import unicodedata
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import closing, suppress
from types import NoneType, TracebackType
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
    NarrationKind,
    Person,
    PersonFlags,
    PersonForecast,
    PersonForecasts,
    PersonScores,
    Presence,
    Reached,
    ReportKind,
    RobotReport,
    Room,
    RoomForecast,
    RoomScores,
    RoomSet,
    ScoreFlags,
    Source,
    Status,
)
from .ports import ClosedError, Domain, NoAnswerError, RoomcastError

__all__ = [
    "Action",
    "ClosedError",
    "Decision",
    "DecisionFlags",
    "Decisions",
    "Domain",
    "Forecast",
    "ForecastFlags",
    "Forecasts",
    "ItemScore",
    "ItemScores",
    "ItemScoresSubscription",
    "MessageError",
    "NarrationKind",
    "Narrator",
    "NoAnswerError",
    "NotIncludedError",
    "Person",
    "PersonFlags",
    "PersonForecast",
    "PersonForecasts",
    "PersonScores",
    "Planner",
    "Presence",
    "Reached",
    "ReportKind",
    "Robot",
    "RobotReport",
    "Room",
    "RoomForecast",
    "RoomScores",
    "RoomSet",
    "RoomcastError",
    "ScoreFlags",
    "Scores",
    "Source",
    "Status",
    "StatusSubscription",
    "Subscription",
    "change_map",
    "habits",
    "moment",
    "persons",
    "source_of_name",
    "status",
]

#: Kinds of sensors.
SENSOR_KINDS = ("motion", "presence", "bed", "door", "phone", "appliance", "camera")
#: Longest id of a sensor, in bytes.
SENSOR_ID_BYTES_MAX = 128

T = TypeVar("T")
Kind = TypeVar("Kind", RoomScores, PersonScores, Forecast, PersonForecasts, Decision, RobotReport)
_KINDS = (RoomScores, PersonScores, Forecast, PersonForecasts, Decision, RobotReport)


def source_of_name(name: str) -> int:
    """The number of a source from its name: 64-bit FNV-1a, never 0, the same as in Rust."""
    number = 0xCBF29CE484222325
    for byte in layouts.utf8("name", name):
        number = ((number ^ byte) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    return max(number, 1)


class _Open:
    """Holds places in a domain until it is closed. A context manager: leaving closes it."""

    _ports: tuple[ports.Port, ...]

    def close(self) -> None:
        """Frees the places, even while another thread waits here: the thread's loop ends, and all other calls raise ClosedError."""
        for port in self._ports:
            port.close()

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


Self = TypeVar("Self", bound=_Open)


class _Follows(_Open, ABC, Generic[T]):
    """Follows messages one after the other. A context manager: leaving closes it. Threads may share it; each message goes to one of them."""

    @abstractmethod
    def _take(self, left_s: float) -> T | None:
        """Returns a message that has arrived. A message that must be requested is waited for, at most this long."""

    @abstractmethod
    def _sleep(self, timeout_s: float) -> None:
        """Waits for news, at most this long."""

    def next(self, timeout_s: float | None = None) -> T | None:
        """Waits for the next message; None after the timeout. ClosedError if it is closed."""
        deadline = ports.deadline_of(timeout_s)
        while True:
            for port in self._ports:
                port.refuse_unusable()
            message = self._take(deadline - time.monotonic())
            if message is not None:
                return message
            left = deadline - time.monotonic()
            if left <= 0:
                return None
            self._sleep(min(left, 0.1))

    def __iter__(self) -> Iterator[T]:
        """Yields all messages until it is closed."""
        with suppress(ClosedError):
            while (message := self.next()) is not None:
                yield message


def _join(domain: Domain | None, name: str) -> ports.Node:
    if not isinstance(domain, (Domain, NoneType)):
        raise TypeError(f"domain {domain!r}: give a Domain, or leave it out for the default one")
    return (domain or Domain.default_for_user()).open(name)


class Subscription(_Follows[Kind]):
    """Follows all messages of a kind under a display name: `Subscription(Forecast, "my-display")`. The kinds are `RoomScores`, `PersonScores`,
    `Forecast`, `PersonForecasts`, `Decision` and `RobotReport`.

    Heartbeats of scores, which repeat them, are left out. Every loss shows as a gap in the sequence numbers.
    """

    def __init__(self, kind: type[Kind], name: str, domain: Domain | None = None) -> None:
        # Checked before it joins.
        if kind not in _KINDS:
            allowed = ", ".join(each.__name__ for each in _KINDS)
            raise TypeError(f"kind {kind!r}: give one of {allowed}; ItemScoresSubscription and StatusSubscription follow the rest")
        node = _join(domain, name)
        self._subscriber: ports.Subscriber[Kind] = ports.Subscriber(node, kind.SERVICE, kind.from_message)
        self._ports = (self._subscriber,)
        self._scores: tuple[int, int] | None = None

    @property
    def malformed(self) -> int:
        """Messages that were malformed and dropped."""
        return self._subscriber.malformed

    def _take(self, left_s: float) -> Kind | None:
        with self._subscriber.alone():
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


class Forecasts(Subscription[Forecast]):
    """Follows the forecasts."""

    def __init__(self, name: str = "forecasts", domain: Domain | None = None) -> None:
        super().__init__(Forecast, name, domain)


class Scores(Subscription[RoomScores]):
    """Follows the room scores, without the heartbeats."""

    def __init__(self, name: str = "scores", domain: Domain | None = None) -> None:
        super().__init__(RoomScores, name, domain)


class Decisions(Subscription[Decision]):
    """Follows the decisions of all planners."""

    def __init__(self, name: str = "decisions", domain: Domain | None = None) -> None:
        super().__init__(Decision, name, domain)


class ItemScoresSubscription(_Follows[ItemScores]):
    """Follows the scores of all items. The daemon sends them while they are followed."""

    def __init__(self, name: str, domain: Domain | None = None) -> None:
        node = _join(domain, name)
        self._subscriber = ports.ItemScoresSubscriber(node)
        self._ports = (self._subscriber,)

    def _take(self, left_s: float) -> ItemScores | None:
        received = self._subscriber.receive()
        return None if received is None else ItemScores.from_message(*received)

    def _sleep(self, timeout_s: float) -> None:
        # Item scores wake no subscriber.
        time.sleep(min(timeout_s, 0.01))


class StatusSubscription(_Follows[Status]):
    """Asks the daemon for its status every `every_s` seconds, and keeps asking if it does not answer."""

    def __init__(self, name: str, domain: Domain | None = None, every_s: float = 1) -> None:
        if not every_s >= 0:
            raise ValueError(f"every_s is {every_s}; give seconds, 0 or more")
        node = _join(domain, name)
        self._client = ports.StatusClient(node)
        self._ports = (self._client,)
        self._every_s = every_s
        self._due = time.monotonic()

    def _take(self, left_s: float) -> Status | None:
        if time.monotonic() < self._due:
            return None
        try:
            # Even without a timeout, an answer needs a moment.
            answer = self._client.ask(max(0.01, min(0.3, left_s)))
        except NoAnswerError:
            return None
        self._due = time.monotonic() + self._every_s
        return Status.from_message(answer)

    def _sleep(self, timeout_s: float) -> None:
        time.sleep(max(0.0, min(timeout_s, self._due - time.monotonic())))


class _Participant(_Open):
    """Sends numbered messages under a name, and receives the room scores. Threads may share it."""

    def __init__(self, name: str, service: ports.Service, domain: Domain | None) -> None:
        self.name = name
        # Before it joins, because the name may be invalid.
        self._number = source_of_name(name)
        self.node = _join(domain, name)
        self._scores: ports.Subscriber[RoomScores] = ports.Subscriber(self.node, ports.ROOM_SCORES, RoomScores.from_message)
        self._publisher = ports.Publisher(self.node, service)
        self._ports = (self._publisher, self._scores)
        self.epoch = secrets.randbits(64) | 1
        self.sequence = 0

    @property
    def malformed(self) -> int:
        """Room scores that were malformed and dropped."""
        return self._scores.malformed

    def newest(self) -> RoomScores | None:
        """The newest snapshot that has not been taken yet."""
        return self._scores.newest()


#: A person by number or by name. None is an unknown person: the daemon weighs the event for all.
Who = int | str | None


# Words that are not a person's name: the daemon drops events about them.
_NO_NAMES = frozenset(
    ["nobody", "me", "who", "they", "he", "she", "i", "we", "you", "somebody", "someone", "everybody", "everyone", "all"]
    + ["the whole family", "the entire family", "the whole household", "they all", "we all", "all of them", "all of us"]
)


def _is_number(text: str) -> bool:
    """Whether a text is a number instead of a name, even if no person has it."""
    digits = text.lstrip("-")
    return digits != "" and all(unicodedata.category(character).startswith("N") for character in digits)


def _person(who: Who) -> tuple[int, str]:
    """Number and name of a person for a message; ValueError if the person is invalid."""
    if who is None:
        return layouts.ALL_PERSONS, ""
    number, name = who, ""
    if isinstance(who, str):
        # A text of digits is a number, as in lines of JSON.
        name = who.strip()
        number = int(name) if name.isascii() and name.isdigit() else -1
    if isinstance(number, int) and not isinstance(number, bool) and 0 <= number < layouts.ALL_PERSONS:
        return number, ""
    if any(character.isalnum() for character in name) and not _is_number(name) and name.lower() not in _NO_NAMES:
        return layouts.ALL_PERSONS, name
    raise ValueError(
        f"person {who!r}: give a number from 0 to {layouts.ALL_PERSONS - 1}, or a name with letters that is no word such as 'me', or None for somebody"
    )


# The form of an action.
_ACTION = re.compile(r"\[[^\[\]]+\](\s*<[^<>]+>\s*\(\d+\))*")


#: Most unhandled narrations: the service stores this many for a daemon that restarts.
UNDER_WAY_MAX = ports.NARRATION.history
# Longest wait for the daemon to handle one of them.
_PATIENCE_S = 10.0
# A possible reason: the daemon counts an invalid narration, but does not handle it.
_WHY_UNDER_WAY = "is the daemon running in this domain? If it is, some were no narration: see `malformed` in its status, and its log"
# The daemon may list a dropped narration before an earlier accepted one. After this time the difference counts.
_SURE_S = 2.0


class NotIncludedError(RoomcastError):
    """The daemon's scores do not contain all events."""


class _Account:
    """Counts the narrations that the daemon has handled and accepted; the bridge counts in the same way."""

    def __init__(self) -> None:
        #: Handled, accepted or not.
        self.settled = 0
        self._daemon: int | None = None
        self._dealt_with = self._accepted = self._since = self._before = 0

    @property
    def dropped(self) -> int:
        """Handled and not accepted."""
        return self._before + max(0, self._dealt_with - (self._accepted - self._since))

    def take(self, daemon: int, source: Source, sent: int) -> None:
        """Updates the counts from the scores of a daemon's start."""
        more = max(0, min(source.sequence, sent) - self.settled)
        self.settled += more
        if self._daemon not in (None, daemon):
            # A restarted daemon may have lost events, so for the earlier ones only their handling counts.
            self._before, self._dealt_with, self._since, more = self.dropped, 0, source.accepted, 0
        # The daemon may list a dropped event before an earlier accepted one, so the difference may decrease.
        self._daemon, self._accepted, self._dealt_with = daemon, source.accepted, self._dealt_with + more


class Narrator(_Participant):
    """Reports persons' actions and presence to the daemon. A context manager: leaving waits until the daemon has handled all events, and raises
    NotIncludedError if the daemon did not accept all of them.

    `person` is the default person of all events, by name or number; each call may give another. Without either the person is unknown: the
    daemon weighs the event for all persons. With 32 unhandled events the next call waits until the daemon has handled some, and raises
    NotIncludedError after 10 seconds. Threads may share it.

    Each event returns the number of participants that received it: 0 if no daemon runs. A daemon that starts later receives the event while the
    narrator lives.
    """

    def __init__(self, name: str, domain: Domain | None = None, person: Who = None) -> None:
        _person(person)
        super().__init__(name, ports.NARRATION, domain)
        self.source = self._number
        self.person = person
        self._account = _Account()
        #: The newest scores that contain any of the events, and the last event's number in them.
        self._included: tuple[int, RoomScores] | None = None

    def say(self, sentence: str, person: Who = None, count: int = 0) -> int:
        """A plain sentence: "They grab the mug." `count` is the number of unknown persons it is about, at most 8."""
        if count and (person is not None or self.person is not None):
            raise ValueError("count counts unknown persons: leave person out, or count")
        return self._send(NarrationKind.SENTENCE, sentence, self._who(person), count)

    def act(self, action: str, person: Who = None) -> int:
        """A completed action in VirtualHome's notation: "[Grab] <mug> (1)". The daemon drops actions with unknown verbs."""
        if _ACTION.fullmatch(action.strip()) is None:
            raise ValueError(f"action {action!r}: give a verb in brackets, then things such as \"[Grab] <mug> (1)\"")
        return self._send(NarrationKind.ACTION, action, self._who(person))

    def did(self, person: Who, text: str) -> int:
        """An action of a person: `did("ada", "opens the fridge")`. The text is the action, or a whole sentence."""
        text = text.strip()
        if text[:1].islower():
            _, name = _person(person)
            text = f"{name or 'Somebody'} {text.rstrip('.')}."
        return self._send(NarrationKind.SENTENCE, text, self._who(person))

    def several(self, count: int, sentence: str) -> int:
        """A sentence about a number of unknown persons, at most 8."""
        return self._send(NarrationKind.SENTENCE, sentence, _person(None), count)

    def present(self, person: Who, room: str | None = None) -> int:
        """A person is in the house, in a room if it is known."""
        return self.presence("present", room, person)

    def away(self, person: Who) -> int:
        """A person is out of the house, and expected back."""
        return self.presence("away", person=person)

    def gone(self, person: Who) -> int:
        """A person is out of the house, and not expected back."""
        return self.presence("gone", person=person)

    def empty(self, room: str) -> int:
        """A room has no people in it."""
        return self.presence("empty", room)

    def device(self, state: str, person: Who = None) -> int:
        """A device's state: "the oven is on"."""
        return self._send(NarrationKind.DEVICE, state, self._who(person))

    def presence(self, presence: str | Presence, room: str | None = None, person: Who = None) -> int:
        """A person's presence from a sensor: "present", with or without a room, "away" or "gone"; or "empty" for a room, which is about all
        persons and takes none. It updates the daemon's beliefs; the language model does not read it."""
        said = presence.name.lower() if isinstance(presence, Presence) else presence
        if said not in ("present", "away", "gone", "empty"):
            raise ValueError(f"presence {said!r}: give 'present', 'away', 'gone' or 'empty'")
        if room is not None and (said not in ("present", "empty") or not any(character.isalnum() for character in room)):
            raise ValueError(f"room {room!r}: give a room's name, with presence 'present' or 'empty' alone")
        if said == "empty":
            if room is None or person is not None:
                raise ValueError("presence 'empty' is of a room and of everybody: give a room, and no person")
            return self._send(NarrationKind.PRESENCE, f"nobody in the {room.strip()}", _person(None))
        if room is not None:
            said = f"present in the {room.strip()}"
        return self._send(NarrationKind.PRESENCE, said, self._who(person))

    def sensor(
        self,
        kind: str,
        id: str,
        room: str | None = None,
        *,
        on: bool | None,
        person: Who = None,
        beyond: str | None = None,
        hold_s: float | None = None,
        false_alarms_per_day: float | None = None,
        only_on: bool = False,
    ) -> int:
        """The state of a sensor: "motion", "presence", "bed", "door", "phone", "appliance" or "camera". `id` is the device, the same in each
        report; `room` is the room it observes, and a phone has none. `on` is None if the device is unavailable. `person` is the owner of a bed
        or a phone; the narrator's default person does not apply. `beyond` is the other room of a door between two rooms. The other keys are
        those of a JSON line."""
        if kind not in SENSOR_KINDS:
            raise ValueError(f"sensor {kind!r}: give one of {', '.join(SENSOR_KINDS)}")
        if not any(character.isalnum() for character in id) or len(id.encode()) > SENSOR_ID_BYTES_MAX:
            raise ValueError(f"id {id!r}: give a text of at most {SENSOR_ID_BYTES_MAX} bytes with a letter or digit")
        if (room is None) != (kind == "phone") or beyond is not None and kind != "door":
            raise ValueError("give the room that a sensor sees, none for a phone, and beyond for a door alone")
        if room is not None and not any(character.isalnum() for character in room):
            raise ValueError(f"room {room!r}: give a room's name")
        for key, value, most in (("hold_s", hold_s, 86_400), ("false_alarms_per_day", false_alarms_per_day, 10_000)):
            if value is not None and not 0 <= value <= most:
                raise ValueError(f"{key} {value!r}: give a number from 0 to {most}")
        if on is not True and only_on:
            raise ValueError("a sensor with only_on reports that it is on: give on=True")
        report: dict[str, Any] = {"sensor": kind, "id": id}
        options = {"room": room, "beyond": beyond, "hold_s": hold_s, "false_alarms_per_day": false_alarms_per_day}
        report |= {key: value for key, value in options.items() if value is not None}
        report |= {"only_on": True, "on": on} if only_on else {"on": on}
        return self._send(NarrationKind.PRESENCE, json.dumps(report, ensure_ascii=False, separators=(",", ":")), _person(person))

    def _who(self, person: Who) -> tuple[int, str]:
        return _person(self.person if person is None else person)

    def _send(self, kind: int, text: str, who: tuple[int, str], count: int = 0) -> int:
        person, person_name = who
        # The daemon drops a text without letters and digits.
        if not any(character.isalnum() for character in text):
            raise MessageError("text: no letter and no digit; say something")
        message = layouts.NarrationV1(source=self.source, epoch=self.epoch, sequence=self.sequence + 1, person=person, kind=kind, minor=1, count=count)
        layouts.write_text("person_name", message.person_name, person_name)
        message.text_bytes = layouts.write_text("text", message.text, text)
        layouts.write_cut("source_name", message.source_name, self.name)
        message.observed_ns, message.observed_unix_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME), time.time_ns()
        message.check()
        while True:
            with self._publisher.alone():
                if self.under_way < UNDER_WAY_MAX:
                    message.sequence = self.sequence + 1
                    receivers = self._publisher.send(message)
                    self.sequence += 1
                    return receivers
            self._wait_for_room()

    def understood(self, first: int = 1, timeout_s: float = 10) -> list[dict[str, Any]]:
        """The daemon's interpretation of the events from the number `first` on, oldest first: `sequence`, `event`, `persons`, `by`,
        `place` (a thing or a room), `presence`, and `why` if an event changed no belief. The daemon stores its newest 512 events."""
        question = {"ask": "understood", "source": self.source, "epoch": self.epoch, "from": first}
        return list(_ask(self.node, ports.PERSON, question, timeout_s).get("understood", []))

    def confirmed(self, timeout_s: float = 10) -> dict[str, Any]:
        """Waits until the daemon's scores contain all events, and returns its interpretation of the newest one, as `understood` does.
        NotIncludedError after the timeout, or if the daemon dropped an event."""
        deadline = time.monotonic() + timeout_s
        if self.wait_until_included(timeout_s) is not None:
            for event in self.understood(self.sequence, max(0.1, deadline - time.monotonic())):
                if event.get("sequence") == self.sequence:
                    return event
        raise NotIncludedError(f"narrator {self.name!r}: no scores contain the last event after {timeout_s} s; {_WHY_UNDER_WAY}")

    @property
    def under_way(self) -> int:
        """Events that the daemon has not handled, according to its newest scores."""
        return self.sequence - self._account.settled

    @property
    def dropped(self) -> int:
        """Events that the daemon did not accept: they were too many or too long, sent in another narrator's name, or lost."""
        return self._account.dropped

    def newest(self) -> RoomScores | None:
        with self._scores.alone():
            scores = super().newest()
            for source in scores.included if scores else ():
                if scores and (source.source, source.epoch) == (self.source, self.epoch):
                    self._account.take(scores.epoch, source, self.sequence)
                    self._included = (source.sequence, scores)
            return scores

    def _wait_for_room(self) -> None:
        """Returns as soon as the daemon has handled some; another thread may then be first."""
        settled, deadline = self._account.settled, time.monotonic() + _PATIENCE_S
        self.newest()
        while self.under_way >= UNDER_WAY_MAX:
            if time.monotonic() >= deadline:
                raise NotIncludedError(
                    f"narrator {self.name!r}: {self.under_way} narrations wait for the daemon, which has dealt with {settled} and with no more for "
                    f"{_PATIENCE_S:.0f} s; {_WHY_UNDER_WAY}"
                )
            self._publisher.tick()
            self._scores.wait(0.1)
            self.newest()

    def wait_until_included(self, timeout_s: float = 10) -> RoomScores | None:
        """Waits for scores that contain all events; None after the timeout. Without any events it returns the newest scores, if any, at once.
        NotIncludedError if the daemon has handled all events and not accepted all."""
        if not self.sequence:
            return self.newest()
        deadline, sure = ports.deadline_of(timeout_s), math.inf
        while True:
            self.newest()
            if (included := self._included) and included[0] >= self.sequence:
                if not self.dropped:
                    return included[1]
                sure = min(sure, time.monotonic() + _SURE_S)
            if time.monotonic() >= min(sure, deadline):
                break
            self._publisher.tick()
            self._scores.wait(0.1)
        if self.dropped and not self.under_way:
            raise NotIncludedError(
                f"narrator {self.name!r}: the daemon has not taken {self.dropped} of {self.sequence} narrations: they came too fast, were too "
                "long or no narration, or another process had this name; its log and status (`malformed`, `limited`, `forged`) say which"
            )
        return None

    def _leave(self) -> None:
        when = f"after {_PATIENCE_S:.0f} s"
        try:
            if self.wait_until_included(_PATIENCE_S) is not None:
                return
        except ClosedError:
            # It was closed inside the block.
            if not self.under_way:
                return
            when = "when it was closed"
        raise NotIncludedError(
            f"narrator {self.name!r}: {self.under_way} of {self.sequence} narrations were in no scores {when}, and go with the narrator; "
            f"{_WHY_UNDER_WAY}"
        )

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            # Messages in shared memory are lost with their publisher. After a fork, the parent waits for the messages sent before it.
            if kind is None and self.sequence and not self._publisher.inherited:
                self._leave()
        finally:
            self.close()


class Planner(_Participant):
    """Follows forecasts and scores, and publishes decisions for the robot with its name. A context manager: leaving closes it. Threads may share
    it."""

    def __init__(self, name: str, domain: Domain | None = None) -> None:
        super().__init__(name, ports.DECISION, domain)
        self.robot = self._number
        self.room, self._paused = "", False
        self._last: RoomScores | None = None
        #: Opened by the first call of `forecasts`.
        self._forecasts: ports.Subscriber[Forecast] | None = None
        self._forecast: Forecast | None = None

    def newest(self) -> RoomScores | None:
        with self._scores.alone():
            scores = super().newest()
            self._last = scores or self._last
            return scores

    def scores(self, timeout_s: float | None = None) -> Iterator[RoomScores]:
        """Yields every new snapshot, without heartbeats; ends if none came for `timeout_s`, or if it is closed."""
        deadline = ports.deadline_of(timeout_s)
        with suppress(ClosedError):
            while time.monotonic() < deadline:
                self._publisher.tick()
                self._scores.wait(0.25)
                with self._scores.alone():
                    known, scores = self._last, self.newest()
                    if scores is None or (known and (scores.epoch, scores.sequence) == (known.epoch, known.sequence)):
                        continue
                deadline = ports.deadline_of(timeout_s)
                yield scores

    def forecasts(self, timeout_s: float | None = None) -> Iterator[Forecast]:
        """Yields every forecast; ends if none came for `timeout_s`, or if it is closed."""
        with self._publisher.alone():
            if self._forecasts is None:
                self._forecasts = ports.Subscriber(self.node, ports.FORECAST, Forecast.from_message)
                self._ports = (*self._ports, self._forecasts)
        return self._follow(self._forecasts, timeout_s)

    def next_forecast(self, timeout_s: float | None = None) -> Forecast | None:
        """Waits for the next forecast; None after the timeout, for example if no daemon runs in this domain."""
        return next(self.forecasts(timeout_s), None)

    def next_scores(self, timeout_s: float | None = None) -> RoomScores | None:
        """Waits for the next room scores; None after the timeout."""
        return next(self.scores(timeout_s), None)

    def _follow(self, subscriber: ports.Subscriber[Forecast], timeout_s: float | None) -> Iterator[Forecast]:
        deadline = ports.deadline_of(timeout_s)
        with suppress(ClosedError):
            while time.monotonic() < deadline:
                self._publisher.tick()
                if (forecast := subscriber.newest()) is None:
                    subscriber.wait(0.25)
                    continue
                self._forecast = forecast
                # Decisions name the scores behind them.
                self.newest()
                deadline = ports.deadline_of(timeout_s)
                yield forecast

    def decide(self, room: str, reason: str, stay_s: float = 0, cancels: int = 0) -> int:
        """Publishes that the robot goes to `room`, or stays there. `cancels` is the sequence of an earlier decision of this planner that ends
        early. Returns the number of participants that received the decision: 0 if no robot listens. ValueError if the newest scores lack the
        room. A decision for the same room as before tells the robot to stay, so a planner may decide at each forecast."""
        with self._publisher.alone():
            self.newest()
            known = self._last or self._forecast
            rooms = [each.id for each in known.rooms] if known else []
            if not room:
                raise ValueError(f"room {room!r}: give the id of a room of the map")
            if rooms and room not in rooms:
                raise ValueError(f"room {room!r}: the map has no such room; give one of {', '.join(rooms)}")
            stays = room == self.room and not self._paused
            return self._decide(Action.STAY if stays else Action.GO, room, reason, stay_s, cancels)

    def pause(self, reason: str, cancels: int = 0) -> int:
        """Publishes that the robot stops its work and waits out of the way."""
        with self._publisher.alone():
            return self._decide(Action.PAUSE, self.room, reason, 0, cancels)

    def _decide(self, action: Action, room: str, reason: str, stay_s: float, cancels: int) -> int:
        """For one thread at a time, because the message depends on the previous decision."""
        if not 0 <= stay_s <= 1e9:
            raise ValueError(f"stay_s is {stay_s}; give seconds from 0 to 1e9")
        if not 0 <= cancels <= self.sequence:
            raise ValueError(f"cancels is {cancels}; give the sequence of an earlier decision, at most {self.sequence}, or 0 for none")
        message = layouts.DecisionV1(robot=self.robot, epoch=self.epoch, sequence=self.sequence + 1, action=action, cancels=cancels, minor=2)
        message.decided_ns, message.decided_unix_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME), time.time_ns()
        message.stay_ns = round(stay_s * 1e9)
        if (last := self._last) is not None:
            message.scores_epoch, message.scores_sequence = last.epoch, last.sequence
            message.scores_age_ns = max(0, message.decided_ns - last.computed_ns)
            message.observed_ns = last.observed_ns
            message.probability = next((r.probability for r in last.rooms if r.id == room), 0.0)
        if self._forecast is not None and (occupied := self._forecast.occupied(room, stay_s)) is not None:
            message.probability = min(max(occupied, 0.0), 1.0)
        layouts.write_text("from", getattr(message, "from"), self.room)
        layouts.write_text("to", message.to, room)
        layouts.write_cut("policy", message.policy, self.name)
        layouts.write_cut("robot_name", message.robot_name, self.name)
        layouts.write_cut("reason", message.reason, reason)
        receivers = self._publisher.send(message)
        self.sequence += 1
        self.room, self._paused = room, action == Action.PAUSE
        return receivers


class Robot(_Open):
    """A robot: follows its decisions, and reports its position and progress. A context manager. Threads may share it.

    Its name is `planner.robot` of the planner's configuration. A report refers to the last decision and its room, unless it names another room.
    Reports are not confirmed: the next report replaces a lost one. Each report returns the number of participants that received it: 0 if no
    planner listens.
    """

    def __init__(self, name: str, domain: Domain | None = None) -> None:
        self.name = name
        self.robot = source_of_name(name)
        self.epoch = secrets.randbits(64) | 1
        self.sequence = 0
        #: The current decision.
        self.decision: Decision | None = None
        node = _join(domain, name)
        self._decisions: ports.Subscriber[Decision] = ports.Subscriber(node, ports.DECISION, Decision.from_message)
        self._publisher = ports.Publisher(node, ports.ROBOT_REPORT)
        self._ports = (self._publisher, self._decisions)

    def next(self, timeout_s: float | None = None) -> Decision | None:
        """Waits for the next decision for this robot; None after the timeout. ClosedError if it is closed."""
        deadline = ports.deadline_of(timeout_s)
        while True:
            with self._decisions.alone():
                while (decision := self._decisions.receive()) is not None:
                    known = self.decision
                    again = known is not None and (decision.epoch, decision.sequence) == (known.epoch, known.sequence)
                    is_order = decision.robot == self.robot and DecisionFlags.ELSEWHERE not in decision.flags
                    if is_order and not again:
                        self.decision = decision
                        return decision
            left = deadline - time.monotonic()
            if left <= 0:
                return None
            # Planners that join later get the newest reports.
            self._publisher.tick()
            self._decisions.wait(min(left, 0.1))

    def decisions(self) -> Iterator[Decision]:
        """Yields all decisions for this robot until it is closed."""
        with suppress(ClosedError):
            while (decision := self.next()) is not None:
                yield decision

    def started(self, room: str = "", note: str = "") -> int:
        """The robot is in the room and has begun to work there."""
        return self.report(ReportKind.STARTED, room, note)

    def finished(self, room: str = "", note: str = "") -> int:
        """The work in the room is done."""
        return self.report(ReportKind.FINISHED, room, note)

    def failed(self, room: str = "", note: str = "") -> int:
        """The work in the room failed; the robot is free again."""
        return self.report(ReportKind.FAILED, room, note)

    def blocked(self, room: str = "", note: str = "") -> int:
        """The robot cannot get into the room; it is free again."""
        return self.report(ReportKind.BLOCKED, room, note)

    def cancelled(self, room: str = "", note: str = "") -> int:
        """A person or the robot cancelled the decision; the robot is free again."""
        return self.report(ReportKind.CANCELLED, room, note)

    def docked(self, battery: float | None = None) -> int:
        """The robot is at its dock and charges."""
        return self.report(ReportKind.DOCKED, battery=battery)

    def battery(self, level: float) -> int:
        """Charge of the battery, 0 to 1."""
        return self.report(ReportKind.BATTERY, battery=level)

    def position(self, position_m: tuple[float, float, float], room: str = "") -> int:
        """The robot's position in the map, in metres."""
        return self.report(ReportKind.POSITION, room, position_m=position_m)

    def report(
        self,
        kind: ReportKind,
        room: str = "",
        note: str = "",
        battery: float | None = None,
        position_m: tuple[float, float, float] | None = None,
    ) -> int:
        """Sends a report; MessageError if a value is invalid. A note that is too long is cut."""
        message = layouts.RobotReportV1(robot=self.robot, epoch=self.epoch, sequence=self.sequence + 1, kind=kind)
        message.reported_ns, message.reported_unix_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME), time.time_ns()
        of_a_room = kind in (ReportKind.STARTED, ReportKind.FINISHED, ReportKind.FAILED, ReportKind.BLOCKED, ReportKind.CANCELLED)
        decision = self.decision
        if decision is not None and of_a_room and room in ("", decision.to_room):
            message.decision_epoch, message.decision_sequence = decision.epoch, decision.sequence
            room = decision.to_room
        if battery is not None:
            message.battery, message.flags = battery, message.flags | layouts.HAS_BATTERY
        if position_m is not None:
            if len(position_m) != 3:
                raise ValueError(f"position_m {position_m!r}: give x, y and z in the map's metres")
            message.position_m[:], message.flags = position_m, message.flags | layouts.HAS_POSITION
        layouts.write_cut("robot_name", message.robot_name, self.name)
        layouts.write_text("room", message.room, room)
        layouts.write_cut("note", message.note, note)
        with self._publisher.alone():
            message.sequence = self.sequence + 1
            receivers = self._publisher.send(message)
            self.sequence += 1
            return receivers


def change_map(changes: list[dict[str, Any]], domain: Domain | None = None, timeout_s: float = 10) -> dict[str, Any]:
    """Changes the map of the running daemon: items added, moved, removed, rooms added, all or none.

    `scenes/README.md` documents the changes. Returns the daemon's answer; RoomcastError gives the reason if nothing changed.
    """
    node = _join(domain, "python-map-change")
    # The daemon applies a repeated question with the same id once.
    question = {"id": secrets.token_hex(8), "changes": changes}
    answer = _ask(node, ports.MAP_CHANGE, question, timeout_s)
    if answer.get("outcome") != "applied":
        raise RoomcastError(f"the daemon did not change its map: {answer.get('reason')}")
    return answer


def moment(domain: Domain | None = None, timeout_s: float = 10) -> dict[str, Any]:
    """The data behind the newest scores: the map in use, the narration that the model read, every label's tokens, and the prior's contribution to
    their sum (`prior_nats`)."""
    node = _join(domain, "python-moment")
    return _ask(node, ports.MOMENT, {}, timeout_s)


def persons(domain: Domain | None = None, timeout_s: float = 10) -> list[dict[str, Any]]:
    """The persons that the daemon knows: `person`, `name`, `presence`, `since_s`, `silent_s`, `flags`."""
    node = _join(domain, "python-persons")
    return list(_ask(node, ports.PERSON, {"ask": "list"}, timeout_s).get("persons", []))


def habits(domain: Domain | None = None, timeout_s: float = 10) -> dict[str, Any]:
    """The habits that the daemon has learned."""
    node = _join(domain, "python-habits")
    return _ask(node, ports.HABITS, {"ask": "show"}, timeout_s)


def status(domain: Domain | None = None, timeout_s: float = 10) -> Status:
    """The daemon's status, asked for once; NoAnswerError if the daemon does not answer in time."""
    with closing(ports.StatusClient(_join(domain, "python-status"))) as client:
        return Status.from_message(client.ask(timeout_s))


def _ask(node: ports.Node, service: str, question: dict[str, Any], timeout_s: float) -> dict[str, Any]:
    try:
        with closing(ports.WordsClient(node, service)) as client:
            answer = json.loads(client.ask(json.dumps(question), timeout_s))
    except json.JSONDecodeError as error:
        raise RoomcastError(f"service {service}: the answer is no JSON: {error}; is the daemon of this version?") from error
    if not isinstance(answer, dict):
        raise RoomcastError(f"service {service}: the answer is no JSON object; is the daemon of this version?")
    if answer.get("answer") == "none":
        raise RoomcastError(f"service {service}: {answer.get('reason')}")
    return answer
