"""What the messages say, as dataclasses. Times `*_ns` are of the boot clock (`CLOCK_BOOTTIME`, which counts suspension), `*_unix_ns` are for people."""

from __future__ import annotations

import enum
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from . import layouts, ports

if TYPE_CHECKING:
    from typing_extensions import Self


class Word(enum.IntEnum):
    """The meaning of a number in a message. A number that this version does not know keeps its value, and its name is UNKNOWN."""

    @classmethod
    def _missing_(cls, value: object) -> Word | None:
        if not isinstance(value, int) or not 0 <= value < 2**32:
            return None
        unknown = int.__new__(cls, value)
        unknown._name_, unknown._value_ = "UNKNOWN", value
        return unknown

    @property
    def word(self) -> str:
        """The word for it, as in Rust and on the command line."""
        return self.name.lower()

    @classmethod
    def of_word(cls, word: str) -> Self | None:
        """The meaning of a word; None for a word that this version does not know."""
        return next((meaning for meaning in cls if meaning.word == word), None)


class NarrationKind(Word):
    """The kind of a narration."""

    SENTENCE = 0
    #: An action in VirtualHome's notation.
    ACTION = 1
    #: The state of a device.
    DEVICE = 2
    #: The presence of a person, an empty room, or the state of a sensor.
    PRESENCE = 3


class Reached(Word):
    """Why scoring stopped where it did."""

    EXACT = 0
    RANKING = 1
    TOP = 2
    DEADLINE = 3


class ScoreFlags(enum.IntFlag):
    """What is to be known about scores."""

    #: Sent again unchanged, to say that the daemon lives.
    HEARTBEAT = 1
    #: No narration yet: the scores are what the model says about an unknown past.
    NO_NARRATION = 2
    #: More narration had arrived when this was published: newer scores follow.
    BEHIND = 4
    #: Narration was lost on the way.
    GAP = 8
    #: There are more sources than places: `included` names the most recent ones.
    SOURCES_CUT = 16
    #: The last scoring attempt failed; these are the last good scores.
    SCORER_FAILED = 32
    #: Everybody who is known or lives here is away: no room is likely, and their scores are `-inf`.
    NOBODY_HOME = 64
    PREPARED = 128


class Presence(Word):
    """Whether a person is in the house."""

    #: Nothing was observed of the person.
    UNKNOWN = 0
    PRESENT = 1
    #: Out of the house, and expected back.
    AWAY = 2
    #: Out of the house, and not expected back.
    GONE = 3


class PersonFlags(enum.IntFlag):
    """What is to be known about a person's scores."""

    #: All that is known of the person was observed before the daemon's start.
    RESTORED = 1
    #: Nothing for long, on a bed: possibly asleep.
    ASLEEP = 2
    #: The newest narration named nobody, and fitted this person best.
    BY_FIT = 4
    #: Not of the household: forgotten after a silence.
    VISITOR = 8


class ForecastFlags(enum.IntFlag):
    """What is to be known about a forecast."""

    #: Nobody was observed: every room is as likely, which says nothing.
    NOT_KNOWN = 1
    #: Of somebody, all that is known was observed before the daemon's start.
    RESTORED = 2
    #: Everybody who is known or lives here is away now.
    NOBODY_HOME = 4
    #: Of somebody who lives here nothing was observed: they are in no probability, and may be in any room.
    RESIDENT_UNKNOWN = 8


class Action(Word):
    """What a robot does."""

    #: Nothing is to be done: it waits in `to_room`, which may be another room than its own, or where it is if that is empty.
    STAY = 0
    #: It goes to `to_room` and works there.
    GO = 1
    #: It stops its work and waits where it disturbs nobody, at its dock if it has one.
    PAUSE = 2


class DecisionFlags(enum.IntFlag):
    """What is to be known about a decision."""

    #: Not the policy's choice but the safe fallback.
    FALLBACK = 1
    #: The scores were older than the planner's deadline.
    STALE = 2
    #: No scores were received at all.
    NO_SCORES = 4
    #: The daemon was silent for longer than its heartbeat allows.
    DAEMON_SILENT = 8
    #: Every room has been covered.
    COVERED = 16
    #: A person came into the room that the robot was in: what it did there is not done.
    INTERRUPTED = 32
    #: `covered` counts what the robot reported as finished; without this flag, the clock.
    REPORTED = 64
    #: The round's deadline leaves no later slot for this room.
    DEADLINE = 128
    #: Nothing is known of anybody: the room scores say nothing about persons.
    NOT_KNOWN = 256
    #: Everybody who is known is away.
    NOBODY_HOME = 512
    #: The robot has reported before and has been silent for longer than allowed.
    ROBOT_SILENT = 1024
    #: The work was asked for before and its time is over: the robot owes a report of it, and is not to begin it again.
    OWED = 2048
    #: Decided in another domain and repeated here, so that this domain's robots keep clear of that one. It is an order to none.
    ELSEWHERE = 4096


class ReportKind(Word):
    """What a robot reports."""

    #: Where the robot is.
    POSITION = 0
    #: It is in the room and has begun to work there.
    STARTED = 1
    #: The work in the room is done.
    FINISHED = 2
    #: The work in the room failed; the robot is free again.
    FAILED = 3
    #: It does not get into the room; the robot is free again.
    BLOCKED = 4
    #: It is at its dock, and charges.
    DOCKED = 5
    #: How full the battery is.
    BATTERY = 6
    #: Somebody, or the robot itself, took the decision back; the robot is free again.
    CANCELLED = 7


@dataclass(frozen=True)
class Room:
    """A room of the map, and its scores in nats (`-inf` when it has no item)."""

    id: str
    #: Of one person, the score's share of all rooms' scores, 0 to 1: how likely it is the room that they go to next. Of several, how likely
    #: somebody does.
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
    accepted: int


@dataclass(frozen=True)
class RoomScores:
    """A full snapshot of what the daemon knows."""

    SERVICE: ClassVar[ports.Service] = ports.ROOM_SCORES

    epoch: int
    sequence: int
    computed_ns: int
    computed_unix_ns: int
    published_ns: int
    observed_ns: int
    received_ns: int
    label_mass: float
    window: int
    person: int
    persons: int
    reached: Reached
    flags: ScoreFlags
    model: str
    map: str
    rooms: tuple[Room, ...]
    included: tuple[Source, ...]

    @property
    def age_s(self) -> float:
        """Seconds since the scores were computed."""
        return (time.clock_gettime_ns(time.CLOCK_BOOTTIME) - self.computed_ns) / 1e9

    @property
    def heartbeat(self) -> bool:
        """Whether the scores were sent before, and come again to say that the daemon lives."""
        return bool(self.flags & ScoreFlags.HEARTBEAT)

    @staticmethod
    def from_message(message: layouts.RoomScoresV1) -> RoomScores:
        """Checks and reads a message; MessageError says what is malformed."""
        message.check()
        return RoomScores(
            epoch=message.epoch,
            sequence=message.sequence,
            computed_ns=message.computed_ns,
            computed_unix_ns=message.computed_unix_ns,
            published_ns=message.published_ns,
            observed_ns=message.observed_ns,
            received_ns=message.received_ns,
            label_mass=message.label_mass,
            window=message.window,
            person=message.person,
            persons=message.persons,
            reached=Reached(message.reached),
            flags=ScoreFlags(message.flags),
            model=bytes(message.model_fingerprint).hex(),
            map=bytes(message.map_fingerprint).hex(),
            rooms=tuple(
                Room(
                    layouts.read_text("room id", room.id),
                    room.probability,
                    room.log_score_nats,
                    room.lower_log_score_nats,
                    room.upper_log_score_nats,
                )
                for room in message.room[: message.room_count]
            ),
            included=tuple(
                Source(each.source, each.epoch, each.sequence, each.observed_ns, each.accepted)
                for each in message.included[: message.source_count]
            ),
        )


@dataclass(frozen=True)
class Person:
    """One person's scores: those that they would have alone."""

    person: int
    reached: Reached
    #: When they were observed last; 0 where that was before the machine's start.
    observed_ns: int
    window: int
    label_mass: float
    flags: PersonFlags
    #: How likely the person goes to each room next; with `elsewhere` the probabilities add up to 1.
    rooms: tuple[Room, ...]
    presence: Presence = Presence.UNKNOWN
    #: How likely the person is outside the map's rooms next; 1 while away or gone.
    elsewhere: float = 0.0
    #: Since when `presence` holds; 0 where that was before the machine's start.
    since_ns: int = 0
    #: Empty for a person who has a number only.
    name: str = ""


@dataclass(frozen=True)
class PersonScores:
    """The scores of each person, which the room scores of the same epoch and sequence speak of together."""

    SERVICE: ClassVar[ports.Service] = ports.PERSON_SCORES

    epoch: int
    sequence: int
    computed_ns: int
    published_ns: int
    map: str
    #: How many persons are known; at most 8 are told of, those who were observed last.
    known: int
    persons: tuple[Person, ...]

    @staticmethod
    def from_message(message: layouts.PersonScoresV1) -> PersonScores:
        """Checks and reads a message; MessageError says what is malformed."""
        message.check()
        ids = [layouts.read_text("room id", message.id[room]) for room in range(message.room_count)]
        return PersonScores(
            epoch=message.epoch,
            sequence=message.sequence,
            computed_ns=message.computed_ns,
            published_ns=message.published_ns,
            map=bytes(message.map_fingerprint).hex(),
            known=message.persons,
            persons=tuple(
                Person(
                    person=each.person,
                    reached=Reached(each.reached),
                    observed_ns=each.observed_ns,
                    window=each.window,
                    label_mass=each.label_mass,
                    flags=PersonFlags(each.flags),
                    rooms=tuple(
                        Room(
                            name,
                            each.probability[room],
                            each.log_score_nats[room],
                            each.lower_log_score_nats[room],
                            each.upper_log_score_nats[room],
                        )
                        for room, name in enumerate(ids)
                    ),
                    presence=Presence(each.presence),
                    elsewhere=each.elsewhere,
                    since_ns=each.since_ns,
                    name=layouts.read_text("name", each.name),
                )
                for each in message.person[: message.person_count]
            ),
        )


@dataclass(frozen=True)
class RoomForecast:
    """How likely somebody is in a room, 0 to 1, at each of a forecast's horizons."""

    id: str
    probabilities: tuple[float, ...]


@dataclass(frozen=True)
class Forecast:
    """How likely each room is occupied at `computed_ns` and each of `horizons_s` seconds later. Of one person, rooms and `elsewhere` add up
    to 1 at each horizon."""

    SERVICE: ClassVar[ports.Service] = ports.FORECAST

    epoch: int
    sequence: int
    computed_ns: int
    published_ns: int
    person: int
    horizons_s: tuple[float, ...]
    rooms: tuple[RoomForecast, ...]
    flags: ForecastFlags = ForecastFlags(0)
    #: How likely everybody is outside the map's rooms, per horizon.
    elsewhere: tuple[float, ...] = ()

    @property
    def age_s(self) -> float:
        """Seconds since the forecast was computed."""
        return max(0.0, (time.clock_gettime_ns(time.CLOCK_BOOTTIME) - self.computed_ns) * 1e-9)

    def occupied(self, room: str, ahead_s: float = 0) -> float | None:
        """The probability that people are in a room `ahead_s` seconds from now; none if the map has no such room. The forecast's age counts.
        Between two horizons the probability is interpolated. After the last horizon it stays the same."""
        row = next((each.probabilities for each in self.rooms if each.id == room), None)
        if row is None:
            return None
        at_s, before = self.age_s + ahead_s, None
        for horizon_s, probability in zip(self.horizons_s, row):
            if horizon_s >= at_s:
                if before is None:
                    return probability
                return before[1] + (at_s - before[0]) / (horizon_s - before[0]) * (probability - before[1])
            before = (horizon_s, probability)
        return before[1] if before else 0.0

    @staticmethod
    def from_message(message: layouts.ForecastV1) -> Forecast:
        """Checks and reads a message; MessageError says what is malformed."""
        message.check()
        horizons = message.horizon_count
        return Forecast(
            epoch=message.epoch,
            sequence=message.sequence,
            computed_ns=message.computed_ns,
            published_ns=message.published_ns,
            person=message.person,
            horizons_s=tuple(message.horizon_s[:horizons]),
            rooms=tuple(
                RoomForecast(layouts.read_text("room id", message.id[room]), tuple(message.probability[room][:horizons]))
                for room in range(message.room_count)
            ),
            flags=ForecastFlags(message.flags),
            elsewhere=tuple(message.elsewhere[:horizons]),
        )


@dataclass(frozen=True)
class RoomSet:
    """The smallest set of places that holds a person with a given probability."""

    #: The ids of the rooms in it.
    rooms: tuple[str, ...]
    #: Whether outside the map's rooms belongs to it.
    elsewhere: bool


@dataclass(frozen=True)
class PersonForecast:
    """Where one person will be; rooms and `elsewhere` add up to 1 at each horizon."""

    person: int
    #: Empty for a person who has a number only.
    name: str
    presence: Presence
    flags: PersonFlags
    rooms: tuple[RoomForecast, ...]
    #: How likely the person is outside the map's rooms, per horizon.
    elsewhere: tuple[float, ...]
    #: The probability that each of `sets` is for; 0 where there are none.
    set_coverage: float
    #: One per horizon; empty where there are none.
    sets: tuple[RoomSet, ...]
    #: Observations that habits rest on; 0 where nothing was learned.
    observations: float
    #: How much of the forecast for a minute, a quarter of an hour and an hour ahead comes from what was learned of the home, 0 to 1.
    learned_share: tuple[float, ...]


@dataclass(frozen=True)
class PersonForecasts:
    """Where each person will be at `computed_ns` and each of `horizons_s` seconds later. The daemon sends them as long as somebody follows
    them."""

    SERVICE: ClassVar[ports.Service] = ports.PERSON_FORECASTS

    epoch: int
    sequence: int
    computed_ns: int
    published_ns: int
    #: How many persons are known; at most 8 are told of.
    known: int
    horizons_s: tuple[float, ...]
    persons: tuple[PersonForecast, ...]

    @staticmethod
    def from_message(message: layouts.PersonForecastsV1) -> PersonForecasts:
        """Checks and reads a message; MessageError says what is malformed."""
        message.check()
        horizons = message.horizon_count
        ids = [layouts.read_text("room id", message.id[room]) for room in range(message.room_count)]

        def room_set(each: layouts.PersonForecastV1, horizon: int) -> RoomSet:
            rooms = tuple(name for room, name in enumerate(ids) if each.room_set[horizon] >> room & 1)
            return RoomSet(rooms, bool(each.set_elsewhere >> horizon & 1))

        return PersonForecasts(
            epoch=message.epoch,
            sequence=message.sequence,
            computed_ns=message.computed_ns,
            published_ns=message.published_ns,
            known=message.persons,
            horizons_s=tuple(message.horizon_s[:horizons]),
            persons=tuple(
                PersonForecast(
                    person=each.person,
                    name=layouts.read_text("name", each.name),
                    presence=Presence(each.presence),
                    flags=PersonFlags(each.flags),
                    rooms=tuple(RoomForecast(name, tuple(each.probability[room][:horizons])) for room, name in enumerate(ids)),
                    elsewhere=tuple(each.elsewhere[:horizons]),
                    set_coverage=each.set_coverage,
                    sets=tuple(room_set(each, horizon) for horizon in range(horizons)) if each.set_coverage > 0 else (),
                    observations=each.observations,
                    learned_share=tuple(each.learned_share),
                )
                for each in message.person[: message.person_count]
            ),
        )


@dataclass(frozen=True)
class Decision:
    """Where a robot goes next, and why."""

    SERVICE: ClassVar[ports.Service] = ports.DECISION

    robot: int
    epoch: int
    sequence: int
    decided_ns: int
    decided_unix_ns: int
    scores_epoch: int
    scores_sequence: int
    scores_age_ns: int
    observed_ns: int
    #: Bit i: room i has been covered.
    covered: int
    #: How likely somebody is in the room gone to: by the forecast over the stay, where the policy plans by it; else the room's score.
    #: 0 without scores.
    probability: float
    stay_ns: int
    action: Action
    flags: DecisionFlags
    #: The room the robot is in; empty when unknown.
    from_room: str
    to_room: str
    policy: str
    reason: str
    #: Sequence of the decision of this epoch that does not hold any more; 0 for none.
    cancels: int = 0
    #: Empty where whoever decides does not tell it.
    robot_name: str = ""

    @staticmethod
    def from_message(message: layouts.DecisionV1) -> Decision:
        """Checks and reads a message; MessageError says what is malformed."""
        message.check()
        return Decision(
            robot=message.robot,
            epoch=message.epoch,
            sequence=message.sequence,
            decided_ns=message.decided_ns,
            decided_unix_ns=message.decided_unix_ns,
            scores_epoch=message.scores_epoch,
            scores_sequence=message.scores_sequence,
            scores_age_ns=message.scores_age_ns,
            observed_ns=message.observed_ns,
            covered=message.covered,
            probability=message.probability,
            stay_ns=message.stay_ns,
            action=Action(message.action),
            flags=DecisionFlags(message.flags),
            from_room=layouts.read_text("from", getattr(message, "from")),
            to_room=layouts.read_text("to", message.to),
            policy=layouts.read_text("policy", message.policy),
            reason=layouts.read_text("reason", message.reason),
            cancels=message.cancels,
            robot_name=layouts.read_text("robot_name", message.robot_name),
        )


@dataclass(frozen=True)
class RobotReport:
    """What a robot says of itself: where it is, and what became of a decision."""

    SERVICE: ClassVar[ports.Service] = ports.ROBOT_REPORT

    #: The number that decisions name the robot with.
    robot: int
    epoch: int
    sequence: int
    reported_ns: int
    reported_unix_ns: int
    #: The decision that it answers; both are 0 for none.
    decision_epoch: int
    decision_sequence: int
    kind: ReportKind
    #: In the map's metres; none where the report does not say.
    position_m: tuple[float, float, float] | None
    #: 0 to 1; none where the report does not say.
    battery: float | None
    robot_name: str
    #: Empty where the position or the decision tells.
    room: str
    note: str

    @staticmethod
    def from_message(message: layouts.RobotReportV1) -> RobotReport:
        """Checks and reads a message; MessageError says what is malformed."""
        message.check()
        x, y, z = message.position_m
        return RobotReport(
            robot=message.robot,
            epoch=message.epoch,
            sequence=message.sequence,
            reported_ns=message.reported_ns,
            reported_unix_ns=message.reported_unix_ns,
            decision_epoch=message.decision_epoch,
            decision_sequence=message.decision_sequence,
            kind=ReportKind(message.kind),
            position_m=(x, y, z) if message.flags & layouts.HAS_POSITION else None,
            battery=message.battery if message.flags & layouts.HAS_BATTERY else None,
            robot_name=layouts.read_text("robot_name", message.robot_name),
            room=layouts.read_text("room", message.room),
            note=layouts.read_text("note", message.note),
        )


@dataclass(frozen=True)
class ItemScore:
    """The score of one item of the map."""

    #: Cut to 48 bytes, as the label.
    id: str
    label: str
    #: The label's score, shared among the items that have it, in nats.
    log_score_nats: float
    #: Index of its room in the rooms of the scores; none when it lies in no room.
    room: int | None
    #: Items of the map with this label.
    label_items: int


@dataclass(frozen=True)
class ItemScores:
    """The scores of the map's items, which add up to the room scores of the same epoch and sequence; of a map with more than 1 024 items
    those of the best. `of` is how many the map has."""

    epoch: int
    sequence: int
    computed_ns: int
    of: int
    items: tuple[ItemScore, ...]

    @staticmethod
    def from_message(header: layouts.ItemScoresHeaderV1, items: list[layouts.ItemScoreV1]) -> ItemScores:
        """Reads a message; texts that are malformed are empty."""
        return ItemScores(
            epoch=header.epoch,
            sequence=header.sequence,
            computed_ns=header.computed_ns,
            of=header.items if header.minor else len(items),
            items=tuple(
                ItemScore(
                    id=layouts.text_or_empty(item.id),
                    label=layouts.text_or_empty(item.label),
                    log_score_nats=item.log_score_nats,
                    room=None if item.partition == layouts.NO_PARTITION else item.partition,
                    label_items=item.label_items,
                )
                for item in items
            ),
        )


@dataclass(frozen=True)
class Status:
    """The daemon's health, versions and counters. Counters count since the daemon's start; `roomcast.h` explains each."""

    epoch: int
    sequence: int
    started_unix_ns: int
    answered_ns: int
    received: int
    accepted: int
    duplicates: int
    missed: int
    malformed: int
    limited: int
    steps: int
    merged: int
    failed_steps: int
    published: int
    heartbeats: int
    restored: int
    waiting: int
    latency_p50_ns: int
    latency_p99_ns: int
    latency_max_ns: int
    model_fingerprint: str
    map_fingerprint: str
    process: int
    sources: int
    persons: int
    version: str
    map: str
    model: str
    journal_bytes: int
    journal_failures: int
    forged: int
    costly: int
    learned: int
    #: Bytes of memory, counts and names of things of the habits, and persons of whom something was learned.
    habits_bytes: int
    habits_counts: int
    habits_names: int
    habits_persons: int
    #: Prompts that steps asked about, answers prepared, those that a step used, and the nanoseconds that preparing took.
    asked: int
    prepared: int
    prepared_used: int
    prepare_ns: int
    #: Narrations that a fast clock dated more than a second ahead, and how far ahead the newest was dated. They count as observed when they came.
    ahead: int
    ahead_ns: int

    @staticmethod
    def from_message(message: layouts.StatusResponseV1) -> Status:
        """Reads a message; texts that are malformed are empty."""
        return Status(
            epoch=message.epoch,
            sequence=message.sequence,
            started_unix_ns=message.started_unix_ns,
            answered_ns=message.answered_ns,
            received=message.received,
            accepted=message.accepted,
            duplicates=message.duplicates,
            missed=message.missed,
            malformed=message.malformed,
            limited=message.limited,
            steps=message.steps,
            merged=message.merged,
            failed_steps=message.failed_steps,
            published=message.published,
            heartbeats=message.heartbeats,
            restored=message.restored,
            waiting=message.waiting,
            latency_p50_ns=message.latency_p50_ns,
            latency_p99_ns=message.latency_p99_ns,
            latency_max_ns=message.latency_max_ns,
            model_fingerprint=bytes(message.model_fingerprint).hex(),
            map_fingerprint=bytes(message.map_fingerprint).hex(),
            process=message.process,
            sources=message.sources,
            persons=message.persons,
            version=layouts.text_or_empty(message.version),
            map=layouts.text_or_empty(message.map),
            model=layouts.text_or_empty(message.model),
            journal_bytes=message.journal_bytes,
            journal_failures=message.journal_failures,
            forged=message.forged,
            costly=message.costly,
            learned=message.learned,
            habits_bytes=message.habits_bytes,
            habits_counts=message.habits_counts,
            habits_names=message.habits_names,
            habits_persons=message.habits_persons,
            asked=message.asked,
            prepared=message.prepared,
            prepared_used=message.prepared_used,
            prepare_ns=message.prepare_ns,
            ahead=message.ahead,
            ahead_ns=message.ahead_ns,
        )
