"""The messages as dataclasses. Times `*_ns` are of the boot clock (`CLOCK_BOOTTIME`, which counts suspension), `*_unix_ns` are wall-clock times."""

from __future__ import annotations

import enum
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from . import layouts, ports

if TYPE_CHECKING:
    from typing_extensions import Self


class Word(enum.IntEnum):
    """The meaning of a number in a message. A number that is unknown to this version keeps its value, and its name is UNKNOWN."""

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
        """The meaning of a word; None if this version does not know the word."""
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
    """The reason why scoring stopped."""

    EXACT = 0
    RANKING = 1
    TOP = 2
    DEADLINE = 3


class ScoreFlags(enum.IntFlag):
    """Flags of scores."""

    #: An unchanged repetition, as a sign that the daemon lives.
    HEARTBEAT = 1
    #: No event yet: the scores are the model's without a known past.
    NO_NARRATION = 2
    #: More events had arrived at publication: newer scores follow.
    BEHIND = 4
    #: An event was lost on the way.
    GAP = 8
    #: More sources than places: `included` names the most recent ones.
    SOURCES_CUT = 16
    #: The last scoring attempt failed; these are the last good scores.
    SCORER_FAILED = 32
    #: All known persons and residents are away: no room is likely, and their scores are `-inf`.
    NOBODY_HOME = 64
    PREPARED = 128
    #: The model does not know the words of a narration or of the map's labels: the scores say little.
    UNFAMILIAR = 256
    #: The model fails the check of its first scores: all scores are noise.
    MODEL_WEAK = 512


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
    """Flags of a person's scores."""

    #: All events of the person are from before the daemon's start.
    RESTORED = 1
    #: Long without an event, on a bed: possibly asleep.
    ASLEEP = 2
    #: The newest event named no person, and fitted this person best.
    BY_FIT = 4
    #: Not a member of the household: forgotten after a silence.
    VISITOR = 8
    #: The model does not know the words of the person's narration or of the map's labels.
    UNFAMILIAR = 16


class ForecastFlags(enum.IntFlag):
    """Flags of a forecast."""

    #: No person was observed, and no sensor shows one: every room is equally likely.
    NOT_KNOWN = 1
    #: For at least one person, all events are from before the daemon's start.
    RESTORED = 2
    #: All known persons and residents are away now.
    NOBODY_HOME = 4
    #: A resident was never observed and may be in any room. Without sensors, the probabilities do not include them.
    RESIDENT_UNKNOWN = 8
    #: The scores have this flag: belief, stays and habits take the place of the model.
    UNFAMILIAR = 16
    #: The scores have this flag: the forecast rests on belief, stays and habits alone.
    MODEL_WEAK = 32


class Action(Word):
    """The robot's action."""

    #: No work: it waits in `to_room`, which may be another room than its own, or in place if that is empty.
    STAY = 0
    #: It goes to `to_room` and works there.
    GO = 1
    #: It stops its work and waits out of the way, at its dock if it has one.
    PAUSE = 2


class DecisionFlags(enum.IntFlag):
    """Flags of a decision."""

    #: The safe fallback instead of the policy's choice.
    FALLBACK = 1
    #: The scores were older than the planner's deadline.
    STALE = 2
    #: No scores were received.
    NO_SCORES = 4
    #: The daemon was silent for longer than its heartbeat allows.
    DAEMON_SILENT = 8
    #: Every room has been covered.
    COVERED = 16
    #: A person came into the robot's room: the work there is not done.
    INTERRUPTED = 32
    #: `covered` counts the reports of finished work; without this flag, the planned time.
    REPORTED = 64
    #: The round's deadline leaves no later slot for this room.
    DEADLINE = 128
    #: No person is known: the room scores are uninformative.
    NOT_KNOWN = 256
    #: All known persons are away.
    NOBODY_HOME = 512
    #: The robot has reported before and has been silent for longer than allowed.
    ROBOT_SILENT = 1024
    #: The work was requested before and its time is over: the robot owes a report, and must not begin it again.
    OWED = 2048
    #: Decided in another domain and repeated here, so that this domain's robots keep clear of that robot. It is not an order.
    ELSEWHERE = 4096
    #: A person holds the robot: it does not work until the hold ends, or a person resumes.
    HELD = 8192


class ReportKind(Word):
    """The kind of a robot's report."""

    #: The robot's position.
    POSITION = 0
    #: The robot is in the room and has begun to work there.
    STARTED = 1
    #: The work in the room is done.
    FINISHED = 2
    #: The work in the room failed; the robot is free again.
    FAILED = 3
    #: The robot cannot get into the room; it is free again.
    BLOCKED = 4
    #: The robot is at its dock and charges.
    DOCKED = 5
    #: Charge of the battery.
    BATTERY = 6
    #: A person or the robot cancelled the decision; the robot is free again.
    CANCELLED = 7
    #: A person's order instead of a report: the robot must not work.
    HOLD = 8
    #: A person's order: the hold ends.
    RESUME = 9
    #: A person's order: clean the room now.
    CLEAN = 10
    #: A person's order: skip the room today.
    SKIP = 11


@dataclass(frozen=True)
class Room:
    """A room of the map, and its scores in nats (`-inf` if it has no item)."""

    id: str
    #: For one person, the score's share of all rooms' scores, 0 to 1: the probability that the person goes to this room next. For several, the
    #: probability that at least one person does.
    probability: float
    log_score_nats: float
    lower_log_score_nats: float
    upper_log_score_nats: float


@dataclass(frozen=True)
class Source:
    """The newest narration of one source in the scores."""

    source: int
    epoch: int
    sequence: int
    observed_ns: int
    accepted: int


@dataclass(frozen=True)
class RoomScores:
    """A full snapshot of the daemon's knowledge."""

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
        """Whether the scores are an unchanged repetition, as a sign that the daemon lives."""
        return bool(self.flags & ScoreFlags.HEARTBEAT)

    @staticmethod
    def from_message(message: layouts.RoomScoresV1) -> RoomScores:
        """Checks and reads a message; MessageError if it is malformed."""
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
    """One person's scores, independent of other persons."""

    person: int
    reached: Reached
    #: Time of the last event; 0 if it was before the machine's start.
    observed_ns: int
    window: int
    label_mass: float
    flags: PersonFlags
    #: Probability that the person goes to each room next; with `elsewhere` the probabilities add up to 1.
    rooms: tuple[Room, ...]
    presence: Presence = Presence.UNKNOWN
    #: Probability that the person goes outside the map's rooms next; 1 while away or gone.
    elsewhere: float = 0.0
    #: Start of `presence`; 0 if it was before the machine's start.
    since_ns: int = 0
    #: Empty for a person without a name.
    name: str = ""


@dataclass(frozen=True)
class PersonScores:
    """The scores of each person behind the room scores of the same epoch and sequence."""

    SERVICE: ClassVar[ports.Service] = ports.PERSON_SCORES

    epoch: int
    sequence: int
    computed_ns: int
    published_ns: int
    map: str
    #: Number of known persons; a message holds at most 8, the most recently observed.
    known: int
    persons: tuple[Person, ...]

    @staticmethod
    def from_message(message: layouts.PersonScoresV1) -> PersonScores:
        """Checks and reads a message; MessageError if it is malformed."""
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
    """The probability that a room is occupied, 0 to 1, at each of a forecast's horizons."""

    id: str
    probabilities: tuple[float, ...]


@dataclass(frozen=True)
class Forecast:
    """The probability that each room is occupied, at `computed_ns` and each of `horizons_s` seconds later. For one person, rooms and `elsewhere`
    add up to 1 at each horizon."""

    SERVICE: ClassVar[ports.Service] = ports.FORECAST

    epoch: int
    sequence: int
    computed_ns: int
    published_ns: int
    person: int
    horizons_s: tuple[float, ...]
    rooms: tuple[RoomForecast, ...]
    flags: ForecastFlags = ForecastFlags(0)
    #: Probability that all persons are outside the map's rooms, per horizon.
    elsewhere: tuple[float, ...] = ()

    @property
    def age_s(self) -> float:
        """Seconds since the forecast was computed."""
        return max(0.0, (time.clock_gettime_ns(time.CLOCK_BOOTTIME) - self.computed_ns) * 1e-9)

    def occupied(self, room: str, ahead_s: float = 0) -> float | None:
        """The probability that people are in a room `ahead_s` seconds from now; None if the map has no such room. The forecast's age counts.
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
        """Checks and reads a message; MessageError if it is malformed."""
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
    """The smallest set of places that contains a person with a given probability."""

    #: The ids of the rooms in it.
    rooms: tuple[str, ...]
    #: Whether the set includes the outside of the map's rooms.
    elsewhere: bool


@dataclass(frozen=True)
class PersonForecast:
    """One person's forecast; rooms and `elsewhere` add up to 1 at each horizon."""

    person: int
    #: Empty for a person without a name.
    name: str
    presence: Presence
    flags: PersonFlags
    rooms: tuple[RoomForecast, ...]
    #: Probability that the person is outside the map's rooms, per horizon.
    elsewhere: tuple[float, ...]
    #: Probability that each of `sets` contains the person; 0 without sets.
    set_coverage: float
    #: One per horizon; empty without sets.
    sets: tuple[RoomSet, ...]
    #: Number of observations behind the habits; 0 if there are none.
    observations: float
    #: Share of habits in the forecast for a minute, a quarter of an hour and an hour ahead, 0 to 1.
    learned_share: tuple[float, ...]


@dataclass(frozen=True)
class PersonForecasts:
    """All persons' forecasts at `computed_ns` and each of `horizons_s` seconds later. The daemon sends them while they are followed."""

    SERVICE: ClassVar[ports.Service] = ports.PERSON_FORECASTS

    epoch: int
    sequence: int
    computed_ns: int
    published_ns: int
    #: Number of known persons; a message holds at most 8.
    known: int
    horizons_s: tuple[float, ...]
    persons: tuple[PersonForecast, ...]

    @staticmethod
    def from_message(message: layouts.PersonForecastsV1) -> PersonForecasts:
        """Checks and reads a message; MessageError if it is malformed."""
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
    """A robot's next room, with the reason."""

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
    #: Probability that the robot's next room is occupied: by the forecast over the stay if the policy uses it, else the room's score. 0 without
    #: scores.
    probability: float
    stay_ns: int
    action: Action
    flags: DecisionFlags
    #: The robot's present room; empty if unknown.
    from_room: str
    to_room: str
    policy: str
    reason: str
    #: Sequence of a decision of this epoch that no longer holds; 0 for none.
    cancels: int = 0
    #: Empty if the planner does not send it.
    robot_name: str = ""

    @staticmethod
    def from_message(message: layouts.DecisionV1) -> Decision:
        """Checks and reads a message; MessageError if it is malformed."""
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
    """A robot's report: its position, and the result of a decision."""

    SERVICE: ClassVar[ports.Service] = ports.ROBOT_REPORT

    #: The robot's number in decisions.
    robot: int
    epoch: int
    sequence: int
    reported_ns: int
    reported_unix_ns: int
    #: The decision that the report answers; both are 0 for none.
    decision_epoch: int
    decision_sequence: int
    kind: ReportKind
    #: In the map's metres; None if not reported.
    position_m: tuple[float, float, float] | None
    #: 0 to 1; None if not reported.
    battery: float | None
    robot_name: str
    #: Empty if the position or the decision gives the room.
    room: str
    note: str

    @staticmethod
    def from_message(message: layouts.RobotReportV1) -> RobotReport:
        """Checks and reads a message; MessageError if it is malformed."""
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

    #: Cut to 48 bytes, like the label.
    id: str
    label: str
    #: The label's score in nats, divided among its items.
    log_score_nats: float
    #: Index of its room in the rooms of the scores; None if it is in no room.
    room: int | None
    #: Items of the map with this label.
    label_items: int


@dataclass(frozen=True)
class ItemScores:
    """The scores of the map's items, which add up to the room scores of the same epoch and sequence. For a map with more than 1 024 items, only
    the best. `of` is the number of items of the map."""

    epoch: int
    sequence: int
    computed_ns: int
    of: int
    items: tuple[ItemScore, ...]

    @staticmethod
    def from_message(header: layouts.ItemScoresHeaderV1, items: list[layouts.ItemScoreV1]) -> ItemScores:
        """Reads a message; malformed texts are empty."""
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
    #: Memory in bytes, counts and names of things of the habits, and the number of persons with learned habits.
    habits_bytes: int
    habits_counts: int
    habits_names: int
    habits_persons: int
    #: Prompts that steps asked about, prefetched answers, answers that a step used, and nanoseconds of prefetching.
    asked: int
    prepared: int
    prepared_used: int
    prepare_ns: int
    #: Narrations that a fast clock dated more than a second ahead, and the lead of the newest one. Their time of arrival counts.
    ahead: int
    ahead_ns: int

    @staticmethod
    def from_message(message: layouts.StatusResponseV1) -> Status:
        """Reads a message; malformed texts are empty."""
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
