"""The messages between processes, with the byte layout and the checks of `roomcast-ipc`.

`cargo run -p roomcast-ipc --example layout` prints the layouts, and a test compares the two; another compares them with `clients/c/roomcast.h`.
Texts are UTF-8 and zero padded, `*_ns` is the boot clock (`CLOCK_BOOTTIME`), scores are in nats.
"""

from __future__ import annotations

import ctypes
import math
import re
import sys
from collections.abc import Iterable
from typing import ClassVar

NAME_BYTES = 48
TEXT_BYTES = 1024
REASON_BYTES = 256
NOTE_BYTES = 120
MAX_ROOMS = 64
MAX_PERSONS = 8
MAX_SOURCES = 16
MAX_HORIZONS = 16
ALL_PERSONS = 0xFFFFFFFF
NO_PARTITION = 0xFFFFFFFF
# Largest time ahead. All participants read one clock, so a valid time is hardly ever in the future.
AHEAD_NS = 1_000_000_000
# Bits of a robot report's flags: the valid numbers.
HAS_POSITION = 1
HAS_BATTERY = 2

_Name = ctypes.c_uint8 * NAME_BYTES
# Control characters, and characters that make a text look like another text.
_HIDDEN = re.compile(
    "[\x00-\x1f\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb\U000e0000-\U000e007f]"
)


class MessageError(ValueError):
    """A malformed message; the text names the field and its allowed values."""


class Layout(ctypes.Structure):
    """A structure with the layout of shared memory."""

    @classmethod
    def type_name(cls) -> str:
        """The name with which iceoryx2 compares types."""
        return f"roomcast.{cls.__name__}"


class Message(Layout):
    """The payload of a publish-subscribe service."""

    #: The field with the time of creation; empty if the message has no age.
    MADE: ClassVar[str] = ""

    def check(self) -> None:
        """Checks a copy of a message like `Message::check` in Rust; MessageError is the first fault. A message must not be trusted before."""
        raise NotImplementedError

    def refuse_ahead(self, now_ns: int) -> None:
        """MessageError if the time of creation is after `now_ns`: the age would be negative."""
        made_ns = getattr(self, self.MADE) if self.MADE else 0
        if made_ns > now_ns + AHEAD_NS:
            raise MessageError(f"{self.MADE}: {made_ns}, allowed is at most the time now, {now_ns}")


def _distinct(field: str, names: Iterable[ctypes.Array[ctypes.c_uint8]]) -> None:
    """Refuses a list with a duplicate name: a look-up would be ambiguous."""
    seen = [bytes(name) for name in names]
    if len(set(seen)) < len(seen):
        raise MessageError(f"{field}: the same one twice")


def _in_range(field: str, value: float, low: float, high: float, allowed: str) -> None:
    """Refuses values outside `low` to `high`, and NaN."""
    if not low <= value <= high:
        raise MessageError(f"{field}: {value}, allowed is {allowed}")


def _not_zero(field: str, value: int) -> None:
    if value == 0:
        raise MessageError(f"{field}: 0, allowed is not 0")


def _refuse_hidden(field: str, text: str) -> None:
    if hidden := _HIDDEN.search(text):
        at = len(text[: hidden.start()].encode())
        raise MessageError(f"{field}: control character U+{ord(hidden[0]):04X} at byte {at}")


def read_text(name: str, field: ctypes.Array[ctypes.c_uint8]) -> str:
    """The text of a zero-padded field; MessageError if it is malformed."""
    data, _, tail = bytes(field).partition(b"\0")
    if any(tail):
        raise MessageError(f"{name}: bytes after the end of the text are not zero")
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise MessageError(f"{name}: not UTF-8 from byte {error.start} on") from None
    _refuse_hidden(name, text)
    return text


def text_or_empty(field: ctypes.Array[ctypes.c_uint8]) -> str:
    """The text of a structure without a check; empty if it is malformed, as in Rust."""
    try:
        return read_text("", field)
    except MessageError:
        return ""


def utf8(name: str, text: str) -> bytes:
    """Encodes a text; MessageError if it is not a valid text: a Python text may have lone surrogates."""
    try:
        return text.encode()
    except UnicodeEncodeError as error:
        raise MessageError(f"{name}: half a character at {error.start}; send whole ones") from None


def write_text(name: str, field: ctypes.Array[ctypes.c_uint8], text: str) -> int:
    """Writes a text into a zero-padded field and returns its length in bytes; MessageError if it does not fit."""
    data = utf8(name, text)
    _refuse_hidden(name, text)
    if len(data) > len(field):
        raise MessageError(f"{name}: text of {len(data)} bytes, at most {len(field)} fit; shorten it")
    ctypes.memset(field, 0, len(field))
    ctypes.memmove(field, data, len(data))
    return len(data)


def write_cut(name: str, field: ctypes.Array[ctypes.c_uint8], text: str) -> None:
    """As `write_text`, but cuts the text after the last character that fits, as in Rust; control characters become spaces."""
    data = utf8(name, _HIDDEN.sub(" ", text))
    write_text(name, field, data[: len(field)].decode(errors="ignore"))


class NarrationV1(Message):
    """One observation of a person, from a narrator."""

    _fields_ = [
        ("source", ctypes.c_uint64),
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("observed_ns", ctypes.c_uint64),
        ("observed_unix_ns", ctypes.c_uint64),
        ("person", ctypes.c_uint32),
        ("kind", ctypes.c_uint32),
        ("text_bytes", ctypes.c_uint32),
        ("minor", ctypes.c_uint32),
        ("source_name", _Name),
        ("person_name", _Name),
        ("count", ctypes.c_uint32),
        ("reserved", ctypes.c_uint8 * 36),
        ("text", ctypes.c_uint8 * TEXT_BYTES),
    ]

    def check(self) -> None:
        for field in ("source", "epoch", "sequence"):
            _not_zero(field, getattr(self, field))
        _in_range("kind", self.kind, 0, 3, "0 to 3")
        _in_range("count", self.count, 0, 8, "0 to 8")
        _in_range("text_bytes", self.text_bytes, 0, TEXT_BYTES, "1 to 1024")
        text = read_text("text", self.text)
        if not text:
            raise MessageError("text: empty")
        if len(text.encode()) != self.text_bytes:
            raise MessageError(f"text_bytes: {self.text_bytes}, allowed is the number of bytes before the first zero")
        read_text("source_name", self.source_name)
        read_text("person_name", self.person_name)


class IncludedV1(Layout):
    """The newest narration of one source in a message's scores."""

    _fields_ = [
        ("source", ctypes.c_uint64),
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("observed_ns", ctypes.c_uint64),
        ("accepted", ctypes.c_uint64),
    ]


class RoomV1(Layout):
    """The probability that a person is in one room soon."""

    _fields_ = [
        ("id", _Name),
        ("log_score_nats", ctypes.c_double),
        ("lower_log_score_nats", ctypes.c_double),
        ("upper_log_score_nats", ctypes.c_double),
        ("probability", ctypes.c_double),
    ]


class RoomScoresV1(Message):
    """A full snapshot of the daemon's knowledge."""

    MADE = "computed_ns"
    _fields_ = [
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("computed_ns", ctypes.c_uint64),
        ("computed_unix_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("observed_ns", ctypes.c_uint64),
        ("received_ns", ctypes.c_uint64),
        ("model_fingerprint", ctypes.c_uint8 * 32),
        ("map_fingerprint", ctypes.c_uint8 * 32),
        ("label_mass", ctypes.c_double),
        ("window", ctypes.c_uint64),
        ("wait_ns", ctypes.c_uint64),
        ("tokenise_ns", ctypes.c_uint64),
        ("prefix_ns", ctypes.c_uint64),
        ("trie_ns", ctypes.c_uint64),
        ("ground_ns", ctypes.c_uint64),
        ("person", ctypes.c_uint32),
        ("persons", ctypes.c_uint32),
        ("room_count", ctypes.c_uint32),
        ("source_count", ctypes.c_uint32),
        ("reached", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("minor", ctypes.c_uint32),
        ("reserved", ctypes.c_uint8 * 52),
        ("included", IncludedV1 * MAX_SOURCES),
        ("room", RoomV1 * MAX_ROOMS),
    ]

    def check(self) -> None:
        _not_zero("epoch", self.epoch)
        _not_zero("sequence", self.sequence)
        if self.room_count == 0:
            raise MessageError("room: empty")
        _in_range("room_count", self.room_count, 1, MAX_ROOMS, "1 to 64")
        _in_range("source_count", self.source_count, 0, MAX_SOURCES, "0 to 16")
        _in_range("reached", self.reached, 0, 3, "0 to 3")
        # Rounding can make a sum of probabilities exceed 1, and the labels of a chain overlap.
        _in_range("label_mass", self.label_mass, 0, sys.float_info.max, "0 or more, finite")
        for room in self.room[: self.room_count]:
            if not read_text("room id", room.id):
                raise MessageError("room id: empty")
            _in_range("probability", room.probability, 0, 1, "0 to 1")
            for field in ("log_score_nats", "lower_log_score_nats", "upper_log_score_nats"):
                _in_range(field, getattr(room, field), -math.inf, sys.float_info.max, "-inf or finite")
        _distinct("room id", (room.id for room in self.room[: self.room_count]))


class PersonV1(Layout):
    """One person's scores, independent of other persons."""

    _fields_ = [
        ("person", ctypes.c_uint32),
        ("reached", ctypes.c_uint32),
        ("observed_ns", ctypes.c_uint64),
        ("window", ctypes.c_uint64),
        ("label_mass", ctypes.c_double),
        ("flags", ctypes.c_uint32),
        ("presence", ctypes.c_uint32),
        ("elsewhere", ctypes.c_double),
        ("since_ns", ctypes.c_uint64),
        ("name", _Name),
        ("reserved", ctypes.c_uint8 * 24),
        ("log_score_nats", ctypes.c_double * MAX_ROOMS),
        ("lower_log_score_nats", ctypes.c_double * MAX_ROOMS),
        ("upper_log_score_nats", ctypes.c_double * MAX_ROOMS),
        ("probability", ctypes.c_double * MAX_ROOMS),
    ]


class PersonScoresV1(Message):
    """The scores of each person behind the room scores of the same epoch and sequence."""

    MADE = "computed_ns"
    _fields_ = [
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("computed_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("map_fingerprint", ctypes.c_uint8 * 32),
        ("persons", ctypes.c_uint32),
        ("person_count", ctypes.c_uint32),
        ("room_count", ctypes.c_uint32),
        ("minor", ctypes.c_uint32),
        ("reserved", ctypes.c_uint8 * 48),
        ("id", _Name * MAX_ROOMS),
        ("person", PersonV1 * MAX_PERSONS),
    ]

    def check(self) -> None:
        _not_zero("epoch", self.epoch)
        _not_zero("sequence", self.sequence)
        if self.room_count == 0:
            raise MessageError("room: empty")
        _in_range("room_count", self.room_count, 1, MAX_ROOMS, "1 to 64")
        _in_range("person_count", self.person_count, 0, MAX_PERSONS, "0 to 8")
        for room in range(self.room_count):
            if not read_text("room id", self.id[room]):
                raise MessageError("room id: empty")
        _distinct("room id", self.id[: self.room_count])
        for person in self.person[: self.person_count]:
            _in_range("reached", person.reached, 0, 3, "0 to 3")
            _in_range("presence", person.presence, 0, 3, "0 to 3")
            _in_range("label_mass", person.label_mass, 0, sys.float_info.max, "0 or more, finite")
            _in_range("elsewhere", person.elsewhere, 0, 1, "0 to 1")
            read_text("name", person.name)
            for probability in person.probability[: self.room_count]:
                _in_range("probability", probability, 0, 1, "0 to 1")
            for field in ("log_score_nats", "lower_log_score_nats", "upper_log_score_nats"):
                for value in getattr(person, field)[: self.room_count]:
                    _in_range(field, value, -math.inf, sys.float_info.max, "-inf or finite")


class ItemScoresHeaderV1(Layout):
    """User header of a slice of item scores: identifies their snapshot."""

    _fields_ = [
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("computed_ns", ctypes.c_uint64),
        ("minor", ctypes.c_uint32),
        ("items", ctypes.c_uint32),
        ("reserved", ctypes.c_uint8 * 32),
    ]


class ItemScoreV1(Layout):
    """The score of one item of the map. Sent only while it is followed."""

    _fields_ = [
        ("id", _Name),
        ("label", _Name),
        ("log_score_nats", ctypes.c_double),
        ("partition", ctypes.c_uint32),
        ("label_items", ctypes.c_uint32),
    ]


class ForecastV1(Message):
    """P(room is occupied at computed_ns + horizon), for a grid of horizons."""

    MADE = "computed_ns"
    _fields_ = [
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("computed_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("room_count", ctypes.c_uint32),
        ("horizon_count", ctypes.c_uint32),
        ("person", ctypes.c_uint32),
        ("minor", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("elsewhere", ctypes.c_float * MAX_HORIZONS),
        ("reserved", ctypes.c_uint8 * 12),
        ("horizon_s", ctypes.c_float * MAX_HORIZONS),
        ("id", _Name * MAX_ROOMS),
        ("probability", (ctypes.c_float * MAX_HORIZONS) * MAX_ROOMS),
    ]

    def check(self) -> None:
        _in_range("room_count", self.room_count, 0, MAX_ROOMS, "0 to 64")
        _in_range("horizon_count", self.horizon_count, 0, MAX_HORIZONS, "0 to 16")
        for horizon_s in self.horizon_s[: self.horizon_count]:
            _in_range("horizon_s", horizon_s, 0, sys.float_info.max, "0 or more, finite")
        for elsewhere in self.elsewhere[: self.horizon_count]:
            _in_range("elsewhere", elsewhere, 0, 1, "0 to 1")
        for room in range(self.room_count):
            read_text("room id", self.id[room])
            for probability in self.probability[room][: self.horizon_count]:
                _in_range("probability", probability, 0, 1, "0 to 1")
        _distinct("room id", self.id[: self.room_count])


class PersonForecastV1(Layout):
    """One person's forecast."""

    _fields_ = [
        ("person", ctypes.c_uint32),
        ("presence", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("reserved_a", ctypes.c_uint8 * 4),
        ("name", _Name),
        ("elsewhere", ctypes.c_float * MAX_HORIZONS),
        ("room_set", ctypes.c_uint64 * MAX_HORIZONS),
        ("set_coverage", ctypes.c_float),
        ("set_elsewhere", ctypes.c_uint32),
        ("observations", ctypes.c_float),
        ("learned_share", ctypes.c_float * 3),
        ("reserved", ctypes.c_uint8 * 40),
        ("probability", (ctypes.c_float * MAX_HORIZONS) * MAX_ROOMS),
    ]


class PersonForecastsV1(Message):
    """All persons' forecasts."""

    MADE = "computed_ns"
    _fields_ = [
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("computed_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("room_count", ctypes.c_uint32),
        ("horizon_count", ctypes.c_uint32),
        ("persons", ctypes.c_uint32),
        ("person_count", ctypes.c_uint32),
        ("minor", ctypes.c_uint32),
        ("reserved", ctypes.c_uint8 * 76),
        ("horizon_s", ctypes.c_float * MAX_HORIZONS),
        ("id", _Name * MAX_ROOMS),
        ("person", PersonForecastV1 * MAX_PERSONS),
    ]

    def check(self) -> None:
        _in_range("room_count", self.room_count, 0, MAX_ROOMS, "0 to 64")
        _in_range("horizon_count", self.horizon_count, 0, MAX_HORIZONS, "0 to 16")
        _in_range("person_count", self.person_count, 0, MAX_PERSONS, "0 to 8")
        for horizon_s in self.horizon_s[: self.horizon_count]:
            _in_range("horizon_s", horizon_s, 0, sys.float_info.max, "0 or more, finite")
        for room in range(self.room_count):
            if not read_text("room id", self.id[room]):
                raise MessageError("room id: empty")
        _distinct("room id", self.id[: self.room_count])
        for person in self.person[: self.person_count]:
            _in_range("presence", person.presence, 0, 3, "0 to 3")
            read_text("name", person.name)
            _in_range("set_coverage", person.set_coverage, 0, 1, "0 to 1")
            _in_range("observations", person.observations, 0, sys.float_info.max, "0 or more, finite")
            for share in person.learned_share:
                _in_range("learned_share", share, 0, 1, "0 to 1")
            for row in (*person.probability[: self.room_count], person.elsewhere):
                for probability in row[: self.horizon_count]:
                    _in_range("probability", probability, 0, 1, "0 to 1")


class DecisionV1(Message):
    """A robot's next room, with the reason."""

    MADE = "decided_ns"
    _fields_ = [
        ("robot", ctypes.c_uint64),
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("decided_ns", ctypes.c_uint64),
        ("decided_unix_ns", ctypes.c_uint64),
        ("scores_epoch", ctypes.c_uint64),
        ("scores_sequence", ctypes.c_uint64),
        ("scores_age_ns", ctypes.c_uint64),
        ("observed_ns", ctypes.c_uint64),
        ("covered", ctypes.c_uint64),
        ("probability", ctypes.c_double),
        ("stay_ns", ctypes.c_uint64),
        ("action", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("minor", ctypes.c_uint32),
        ("reserved_a", ctypes.c_uint8 * 4),
        ("from", _Name),
        ("to", _Name),
        ("policy", _Name),
        ("reason", ctypes.c_uint8 * REASON_BYTES),
        ("cancels", ctypes.c_uint64),
        ("robot_name", _Name),
        ("held_until_unix_ns", ctypes.c_uint64),
        ("cleaned_min", ctypes.c_uint16 * MAX_ROOMS),
        ("reserved", ctypes.c_uint8 * 64),
    ]

    def check(self) -> None:
        for field in ("robot", "epoch", "sequence"):
            _not_zero(field, getattr(self, field))
        _in_range("action", self.action, 0, 2, "0 to 2")
        _in_range("probability", self.probability, 0, 1, "0 to 1")
        for field in ("from", "to", "policy", "robot_name", "reason"):
            read_text(field, getattr(self, field))


class RobotReportV1(Message):
    """A robot's report: its position, and the result of a decision."""

    MADE = "reported_ns"
    _fields_ = [
        ("robot", ctypes.c_uint64),
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("reported_ns", ctypes.c_uint64),
        ("reported_unix_ns", ctypes.c_uint64),
        ("decision_epoch", ctypes.c_uint64),
        ("decision_sequence", ctypes.c_uint64),
        ("position_m", ctypes.c_double * 3),
        ("battery", ctypes.c_double),
        ("kind", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("minor", ctypes.c_uint32),
        ("reserved_a", ctypes.c_uint8 * 4),
        ("robot_name", _Name),
        ("room", _Name),
        ("note", ctypes.c_uint8 * NOTE_BYTES),
        ("until_unix_ns", ctypes.c_uint64),
        ("reserved", ctypes.c_uint8 * 184),
    ]

    def check(self) -> None:
        for field in ("robot", "epoch", "sequence"):
            _not_zero(field, getattr(self, field))
        _in_range("kind", self.kind, 0, 11, "0 to 11")
        if self.flags & HAS_POSITION:
            for metres in self.position_m:
                _in_range("position_m", metres, -sys.float_info.max, sys.float_info.max, "finite")
        if self.flags & HAS_BATTERY:
            _in_range("battery", self.battery, 0, 1, "0 to 1")
        for field in ("robot_name", "room", "note"):
            read_text(field, getattr(self, field))


class StatusRequestV1(Layout):
    """Asks the daemon for its status."""

    _fields_ = [
        ("minor", ctypes.c_uint32),
        ("reserved", ctypes.c_uint8 * 12),
    ]


class StatusResponseV1(Layout):
    """The daemon's health, versions and counters. Counters count since the daemon's start."""

    _fields_ = [
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("started_unix_ns", ctypes.c_uint64),
        ("answered_ns", ctypes.c_uint64),
        ("received", ctypes.c_uint64),
        ("accepted", ctypes.c_uint64),
        ("duplicates", ctypes.c_uint64),
        ("missed", ctypes.c_uint64),
        ("malformed", ctypes.c_uint64),
        ("limited", ctypes.c_uint64),
        ("steps", ctypes.c_uint64),
        ("merged", ctypes.c_uint64),
        ("failed_steps", ctypes.c_uint64),
        ("published", ctypes.c_uint64),
        ("heartbeats", ctypes.c_uint64),
        ("restored", ctypes.c_uint64),
        ("waiting", ctypes.c_uint64),
        ("latency_p50_ns", ctypes.c_uint64),
        ("latency_p99_ns", ctypes.c_uint64),
        ("latency_max_ns", ctypes.c_uint64),
        ("model_fingerprint", ctypes.c_uint8 * 32),
        ("map_fingerprint", ctypes.c_uint8 * 32),
        ("process", ctypes.c_uint32),
        ("sources", ctypes.c_uint32),
        ("persons", ctypes.c_uint32),
        ("minor", ctypes.c_uint32),
        ("version", _Name),
        ("map", _Name),
        ("model", _Name),
        ("journal_bytes", ctypes.c_uint64),
        ("journal_failures", ctypes.c_uint64),
        ("forged", ctypes.c_uint64),
        ("costly", ctypes.c_uint64),
        ("learned", ctypes.c_uint64),
        ("habits_bytes", ctypes.c_uint64),
        ("habits_counts", ctypes.c_uint64),
        ("habits_names", ctypes.c_uint32),
        ("habits_persons", ctypes.c_uint32),
        ("asked", ctypes.c_uint64),
        ("prepared", ctypes.c_uint64),
        ("prepared_used", ctypes.c_uint64),
        ("prepare_ns", ctypes.c_uint64),
        ("ahead", ctypes.c_uint64),
        ("ahead_ns", ctypes.c_uint64),
        ("reserved", ctypes.c_uint8 * 16),
    ]


LAYOUTS: tuple[type[Layout], ...] = (
    NarrationV1,
    IncludedV1,
    RoomV1,
    RoomScoresV1,
    PersonV1,
    PersonScoresV1,
    ItemScoresHeaderV1,
    ItemScoreV1,
    ForecastV1,
    PersonForecastV1,
    PersonForecastsV1,
    DecisionV1,
    RobotReportV1,
    StatusRequestV1,
    StatusResponseV1,
)
MESSAGES: tuple[type[Message], ...] = (
    NarrationV1,
    RoomScoresV1,
    PersonScoresV1,
    ForecastV1,
    PersonForecastsV1,
    DecisionV1,
    RobotReportV1,
)
