"""The examples in C, compiled: what they make of messages, byte for byte as they lie in shared memory."""

from __future__ import annotations

import math
import pathlib
import shutil
import subprocess
from collections.abc import Callable

import pytest

import samples
from roomcast import layouts

SOURCES = pathlib.Path(__file__).parents[2] / "c"


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("SKIPPED: no C compiler (cc)")
    program = tmp_path_factory.mktemp("c") / "rooms"
    flags = ["-std=c11", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler, *flags, "-o", program, SOURCES / "rooms.c"], check=True)
    return program


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
