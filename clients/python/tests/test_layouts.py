"""The ctypes structures against what the Rust crate prints of its own, and against the C header that is made from it."""

from __future__ import annotations

import ctypes
import pathlib
import re
import subprocess

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import roomcast
from roomcast import MessageError, layouts, ports
from samples import ROOMCAST

HEADER = pathlib.Path(__file__).parents[2] / "c" / "roomcast.h"


def rust_layouts() -> dict[str, tuple[int, list[tuple[int, int, str]]]]:
    """Per type name its size and (offset, size, name) of each field, as the example `layout` prints them."""
    binary = pathlib.Path(ROOMCAST).parent / "examples" / "layout"
    if not binary.exists():
        pytest.skip("SKIPPED: set ROOMCAST to the built binary, and build the example: cargo build --release -p roomcast-ipc --examples")
    found: dict[str, tuple[int, list[tuple[int, int, str]]]] = {}
    for line in subprocess.run([binary], capture_output=True, text=True, check=True).stdout.splitlines():
        if head := re.fullmatch(r"(\S+) \((\d+) bytes\)", line):
            fields: list[tuple[int, int, str]] = []
            found[head[1]] = (int(head[2]), fields)
        elif field := re.fullmatch(r"\s+(\d+)\s+(\d+)  (\w+): .*", line):
            fields.append((int(field[1]), int(field[2]), field[3]))
    return found


@pytest.mark.parametrize("message", layouts.LAYOUTS, ids=lambda message: message.__name__)
def test_every_field_is_where_rust_has_it(message: type[layouts.Layout]) -> None:
    size, fields = rust_layouts()[message.type_name()]
    assert ctypes.sizeof(message) == size
    own = [(getattr(message, name).offset, getattr(message, name).size, name) for name, *_ in message._fields_]
    assert own == fields


def test_there_is_every_structure_of_the_c_header() -> None:
    named = re.findall(r"typedef struct Roomcast(\w+)", HEADER.read_text())
    assert named == [message.__name__ for message in layouts.LAYOUTS]


@pytest.mark.parametrize("message", layouts.LAYOUTS, ids=lambda message: message.__name__)
def test_every_field_is_where_c_has_it(message: type[layouts.Layout]) -> None:
    name, header = f"Roomcast{message.__name__}", HEADER.read_text()
    offsets = re.findall(rf"_Static_assert\(offsetof\({name}, (\w+)\) == (\d+)", header)
    assert offsets == [(field, str(getattr(message, field).offset)) for field, *_ in message._fields_]
    size = re.search(rf"_Static_assert\(sizeof\({name}\) == (\d+)", header)
    assert size and ctypes.sizeof(message) == int(size[1])


SERVICES = [
    ports.NARRATION,
    ports.ROOM_SCORES,
    ports.PERSON_SCORES,
    ports.FORECAST,
    ports.PERSON_FORECASTS,
    ports.DECISION,
    ports.ROBOT_REPORT,
]


@pytest.mark.parametrize("service", SERVICES, ids=lambda service: service.name)
def test_every_service_is_as_in_the_c_header(service: ports.Service) -> None:
    defined = dict(re.findall(r"#define ROOMCAST_(\w+) (.+)", HEADER.read_text()))
    name = service.name.rsplit("/", 1)[1].upper().replace("-", "_")
    assert defined[f"SERVICE_{name}"] == f'"{service.name}"'
    assert defined[f"TYPE_NAME_{service.payload.__name__.upper()}"] == f'"{service.payload.type_name()}"'
    quality = [defined[f"{name}_{which}"] for which in ("MAX_PUBLISHERS", "MAX_SUBSCRIBERS", "BUFFER_SIZE", "HISTORY_SIZE")]
    assert quality == [str(number) for number in (service.publishers, service.subscribers, service.buffer, service.history)]


def test_the_limits_are_those_of_the_c_header() -> None:
    defined = dict(re.findall(r"#define ROOMCAST_(\w+) (\d+)", HEADER.read_text()))
    for name, own in {
        "NAME_BYTES": layouts.NAME_BYTES,
        "NARRATION_TEXT_BYTES": layouts.TEXT_BYTES,
        "REASON_TEXT_BYTES": layouts.REASON_BYTES,
        "NOTE_TEXT_BYTES": layouts.NOTE_BYTES,
        "MAX_ROOMS": layouts.MAX_ROOMS,
        "MAX_PERSONS": layouts.MAX_PERSONS,
        "MAX_SOURCES": layouts.MAX_SOURCES,
        "MAX_HORIZONS": layouts.MAX_HORIZONS,
    }.items():
        assert int(defined[name]) == own


@pytest.mark.parametrize(
    "prefix, own",
    [
        ("ACTION", roomcast.Action),
        ("DECISION_FLAGS", roomcast.DecisionFlags),
        ("FORECAST_FLAGS", roomcast.ForecastFlags),
        ("NARRATION_KIND", roomcast.NarrationKind),
        ("PERSON_FLAGS", roomcast.PersonFlags),
        ("PRESENCE", roomcast.Presence),
        ("REACHED", roomcast.Reached),
        ("REPORT_FLAGS", {"HAS_POSITION": layouts.HAS_POSITION, "HAS_BATTERY": layouts.HAS_BATTERY}),
        ("REPORT_KIND", roomcast.ReportKind),
        ("SCORE_FLAGS", roomcast.ScoreFlags),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_values_are_those_of_the_c_header(prefix: str, own: object) -> None:
    defined = re.findall(rf"#define ROOMCAST_{prefix}_(\w+) (?:\(1 << )?(\d+)(\)?)", HEADER.read_text())
    values = {name: 1 << int(number) if shifted else int(number) for name, number, shifted in defined}
    named = own if isinstance(own, dict) else {member.name: member.value for member in own}  # type: ignore[attr-defined]
    assert values == named


def test_texts_that_do_not_fit_are_refused() -> None:
    message = layouts.NarrationV1()
    assert layouts.write_text("text", message.text, "They grab the mug.") == 18
    assert layouts.read_text("text", message.text) == "They grab the mug."
    with pytest.raises(MessageError, match="text of 1025 bytes, at most 1024 fit; shorten it"):
        layouts.write_text("text", message.text, "a" * 1025)
    for hidden in ["two\nlines", "\x9b2J", "left\u202eright", "zero\u200bwidth", "tag\U000e0041", "\ufeffmark", "two\u2028lines", "a\0b"]:
        with pytest.raises(MessageError, match="control character U"):
            layouts.write_text("text", message.text, hidden)
    with pytest.raises(MessageError, match="half a character"):
        layouts.write_text("text", message.text, "\ud800")


@settings(max_examples=50)
@given(st.text(max_size=60))
def test_a_text_that_is_cut_ends_at_a_character(text: str) -> None:
    """Any text gives a field that receivers take: as much of it as fits, and spaces for what is hidden."""
    field = (ctypes.c_uint8 * layouts.NAME_BYTES)()
    if any("\ud800" <= character <= "\udfff" for character in text):
        with pytest.raises(MessageError, match="half a character"):
            layouts.write_cut("name", field, text)
        return
    layouts.write_cut("name", field, text)
    read = layouts.read_text("name", field)
    assert len(read) <= len(text) and all(a == b or (a == " " and layouts._HIDDEN.match(b)) for a, b in zip(read, text, strict=False))
    assert len(read) == len(text) or len((read + text[len(read)]).encode()) > layouts.NAME_BYTES or layouts._HIDDEN.match(text[len(read)])
