"""The messages between processes, byte for byte as `roomcast-ipc` lays them out.

`cargo run -p roomcast-ipc --example layout` prints the same, and a test compares the two. Texts are UTF-8 and zero padded, `*_ns` is
the monotonic clock (`time.monotonic_ns()`), scores are in nats.
"""

from __future__ import annotations

import ctypes

NAME_BYTES = 48
TEXT_BYTES = 1024
REASON_BYTES = 256
MAX_ROOMS = 64
MAX_SOURCES = 16
MAX_HORIZONS = 16

_Name = ctypes.c_uint8 * NAME_BYTES


class NarrationV1(ctypes.Structure):
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
        ("reserved", ctypes.c_uint8 * 88),
        ("text", ctypes.c_uint8 * TEXT_BYTES),
    ]

    @staticmethod
    def type_name() -> str:
        """The name by which iceoryx2 compares types."""
        return "roomcast.NarrationV1"


class IncludedV1(ctypes.Structure):
    """The newest narration of one source that a message's scores contain."""

    _fields_ = [
        ("source", ctypes.c_uint64),
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("observed_ns", ctypes.c_uint64),
        ("accepted", ctypes.c_uint64),
    ]

    @staticmethod
    def type_name() -> str:
        """The name by which iceoryx2 compares types."""
        return "roomcast.IncludedV1"


class RoomV1(ctypes.Structure):
    """How likely a person is to be in one room soon."""

    _fields_ = [
        ("id", _Name),
        ("log_score_nats", ctypes.c_double),
        ("lower_log_score_nats", ctypes.c_double),
        ("upper_log_score_nats", ctypes.c_double),
        ("probability", ctypes.c_double),
    ]

    @staticmethod
    def type_name() -> str:
        """The name by which iceoryx2 compares types."""
        return "roomcast.RoomV1"


class RoomScoresV1(ctypes.Structure):
    """A full snapshot of what the daemon knows."""

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

    @staticmethod
    def type_name() -> str:
        """The name by which iceoryx2 compares types."""
        return "roomcast.RoomScoresV1"


class ForecastV1(ctypes.Structure):
    """P(room is occupied at computed_ns + horizon), for a grid of horizons."""

    _fields_ = [
        ("epoch", ctypes.c_uint64),
        ("sequence", ctypes.c_uint64),
        ("computed_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("room_count", ctypes.c_uint32),
        ("horizon_count", ctypes.c_uint32),
        ("person", ctypes.c_uint32),
        ("minor", ctypes.c_uint32),
        ("reserved", ctypes.c_uint8 * 80),
        ("horizon_s", ctypes.c_float * MAX_HORIZONS),
        ("id", _Name * MAX_ROOMS),
        ("probability", (ctypes.c_float * MAX_HORIZONS) * MAX_ROOMS),
    ]

    @staticmethod
    def type_name() -> str:
        """The name by which iceoryx2 compares types."""
        return "roomcast.ForecastV1"


class DecisionV1(ctypes.Structure):
    """Where a robot goes next, and why."""

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
        ("reserved", ctypes.c_uint8 * 256),
    ]

    @staticmethod
    def type_name() -> str:
        """The name by which iceoryx2 compares types."""
        return "roomcast.DecisionV1"


MESSAGES: tuple[type[ctypes.Structure], ...] = (
    NarrationV1,
    IncludedV1,
    RoomV1,
    RoomScoresV1,
    ForecastV1,
    DecisionV1,
)


def read_text(field: ctypes.Array[ctypes.c_uint8]) -> str:
    """The text of a zero-padded field."""
    return bytes(field).split(b"\0", 1)[0].decode()


def write_text(field: ctypes.Array[ctypes.c_uint8], text: str, name: str) -> int:
    """Writes a text into a zero-padded field and returns its length in bytes; ValueError names what does not fit."""
    data = text.encode()
    if len(data) > len(field):
        raise ValueError(f"{name} has {len(data)} bytes, the limit is {len(field)}: {text[:40]!r}")
    if any(character < " " or "\x7f" <= character <= "\x9f" for character in text):
        raise ValueError(f"{name} has a control character: {text[:40]!r}")
    ctypes.memset(field, 0, len(field))
    ctypes.memmove(field, data, len(data))
    return len(data)
