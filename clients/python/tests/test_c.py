"""The examples in C, compiled: what they make of messages, byte for byte as they lie in shared memory."""

from __future__ import annotations

import ctypes
import math
import pathlib
import shutil
import subprocess
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

import samples
from roomcast import Action, DecisionFlags, ReportKind, RobotReport, layouts, source_of_name
from test_messages import FAULTS

SOURCES = pathlib.Path(__file__).parents[2] / "c"


def compiled(source: pathlib.Path, folder: pathlib.Path, *flags: str) -> pathlib.Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("SKIPPED: no C compiler (cc)")
    program = folder / source.stem
    subprocess.run([compiler, "-Wall", "-Wextra", "-Werror", *flags, "-I", SOURCES, "-o", program, source], check=True)
    return program


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    return compiled(SOURCES / "rooms.c", tmp_path_factory.mktemp("c"), "-std=c11")


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    return compiled(SOURCES / "report.c", tmp_path_factory.mktemp("c"), "-std=gnu11")


@pytest.fixture(scope="module")
def is_text(tmp_path_factory: pytest.TempPathFactory) -> Callable[[bytes, int], int]:
    """That of check.h."""
    folder = tmp_path_factory.mktemp("c")
    (folder / "text.c").write_text('#include "check.h"\nint text(const uint8_t *field, size_t size) { return is_text(field, size); }\n')
    return ctypes.CDLL(str(compiled(folder / "text.c", folder, "-std=c11", "-shared", "-fPIC"))).text


def agree(is_text: Callable[[bytes, int], int], data: bytes) -> None:
    try:
        layouts.read_text("text", (ctypes.c_uint8 * len(data))(*data))
    except layouts.MessageError as error:
        assert not is_text(data, len(data)), error
    else:
        assert is_text(data, len(data)), data


def test_every_character_is_judged_in_c_as_in_python(is_text: Callable[[bytes, int], int]) -> None:
    for character in map(chr, range(0x110000)):
        data = character.encode(errors="surrogatepass")
        surrogate, ends = 0xD800 <= ord(character) <= 0xDFFF, character == "\0"
        assert bool(is_text(data, len(data))) == (ends or not (surrogate or layouts._HIDDEN.match(character))), hex(ord(character))


# Bytes that begin, go on, are too many, or end a text.
BYTES = st.sampled_from([*b"a\0\x1b\x7f\x80\x9f\xa0\xbf\xc0\xc1\xc2\xdf\xe0\xe2\xed\xef\xf0\xf4\xf5\xf8\xff"])


@given(st.one_of(st.binary(max_size=12), st.lists(BYTES, max_size=8).map(bytes), st.text(max_size=6).map(lambda text: text.encode(errors="replace"))))
def test_every_field_is_judged_in_c_as_in_python(is_text: Callable[[bytes, int], int], data: bytes) -> None:
    for cut in range(len(data) + 1):
        agree(is_text, data[:cut])
    agree(is_text, data + bytes(3))


def named(data: bytes) -> Callable[[layouts.RoomScoresV1], None]:
    def change(message: layouts.RoomScoresV1) -> None:
        message.room[1].id[:] = data.ljust(layouts.NAME_BYTES, b"\0")

    return change


def likely(probability: float) -> Callable[[layouts.RoomScoresV1], None]:
    def change(message: layouts.RoomScoresV1) -> None:
        message.room[1].probability = probability

    return change


def counted(rooms: int) -> Callable[[layouts.RoomScoresV1], None]:
    def change(message: layouts.RoomScoresV1) -> None:
        message.room_count = rooms

    return change


def chosen(program: pathlib.Path, folder: pathlib.Path, data: bytes) -> subprocess.CompletedProcess[str]:
    (folder / "message").write_bytes(data)
    return subprocess.run([program, folder / "message"], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", ["bathroom", "wohnküche", "à côté", "台所", "a" * layouts.NAME_BYTES])
def test_the_calmest_room_is_chosen(rooms: pathlib.Path, tmp_path: pathlib.Path, name: str) -> None:
    message = samples.scores(1, **{"kitchen": 0.75, name: 0.25})
    ended = chosen(rooms, tmp_path, bytes(message))
    assert (ended.returncode, ended.stdout) == (0, f"scores 1: go to {name} (next with 0.250)\n")


@pytest.mark.parametrize(
    "change",
    [
        *map(named, [b"", b"\x1b[2Jhall", b"hall\n", b"hall\x7f", "hall\x9b2J".encode(), b"hall\x9b2J", b"hall\0kitchen"]),
        *map(named, [b"\xff", "a\u202eb".encode()]),
        *map(likely, [math.nan, -0.1, 1.1, math.inf]),
        *map(counted, [0, layouts.MAX_ROOMS + 1]),
    ],
)
def test_what_no_honest_sender_says_is_refused(
    rooms: pathlib.Path, tmp_path: pathlib.Path, change: Callable[[layouts.RoomScoresV1], None]
) -> None:
    message = samples.scores()
    change(message)
    with pytest.raises(layouts.MessageError):
        message.check()
    ended = chosen(rooms, tmp_path, bytes(message))
    assert (ended.returncode, ended.stdout) == (1, "") and "this is no roomcast.RoomScoresV1" in ended.stderr


def test_a_message_of_another_length_is_refused(rooms: pathlib.Path, tmp_path: pathlib.Path) -> None:
    whole = bytes(samples.scores())
    for data in [b"", whole[:-1], whole + b"\0"]:
        assert chosen(rooms, tmp_path, data).returncode == 1


def answered(program: pathlib.Path, folder: pathlib.Path, message: layouts.DecisionV1) -> subprocess.CompletedProcess[str]:
    (folder / "decision").write_bytes(bytes(message))
    return subprocess.run([program, folder / "decision", folder / "report"], capture_output=True, text=True, check=False)


def test_a_robot_in_c_answers_what_receivers_take(report: pathlib.Path, tmp_path: pathlib.Path) -> None:
    assert answered(report, tmp_path, samples.decision(3)).returncode == 0
    said = layouts.RobotReportV1.from_buffer_copy((tmp_path / "report").read_bytes())
    told = RobotReport.from_message(said)
    assert (told.robot, told.robot_name, told.room) == (source_of_name("robot"), "robot", "bathroom")
    assert (told.kind, told.decision_epoch, told.decision_sequence) == (ReportKind.FINISHED, 2, 3)


@pytest.mark.parametrize("change", [change for kind, _, change, _ in FAULTS if kind is layouts.DecisionV1])
def test_a_robot_in_c_follows_no_malformed_decision(
    report: pathlib.Path, tmp_path: pathlib.Path, change: Callable[[layouts.Message], object]
) -> None:
    message = samples.decision()
    change(message)
    ended = answered(report, tmp_path, message)
    assert (ended.returncode, ended.stdout, ended.stderr) == (1, "", "report: this is no roomcast.DecisionV1\n")
    assert not (tmp_path / "report").exists()


def test_a_robot_in_c_follows_its_own_decisions_alone(report: pathlib.Path, tmp_path: pathlib.Path) -> None:
    for field, value in [
        ("robot", source_of_name("another")),
        ("action", Action.STAY),
        ("action", Action.PAUSE),
        ("flags", DecisionFlags.ELSEWHERE),
    ]:
        message = samples.decision()
        setattr(message, field, value)
        ended = answered(report, tmp_path, message)
        assert (ended.returncode, ended.stderr) == (1, 'report: this sends "robot" nowhere\n')
