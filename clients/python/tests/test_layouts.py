"""The ctypes structures against what the Rust crate prints of its own."""

from __future__ import annotations

import ctypes
import os
import pathlib
import re
import subprocess

import pytest

from roomcast import layouts


def rust_layouts() -> dict[str, tuple[int, list[tuple[int, int, str]]]]:
    """Per type name its size and (offset, size, name) of each field, as the example `layout` prints them."""
    binary = pathlib.Path(os.environ.get("ROOMCAST", "")).parent / "examples" / "layout"
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


@pytest.mark.parametrize("message", layouts.MESSAGES, ids=lambda message: message.__name__)
def test_every_field_is_where_rust_has_it(message: type[ctypes.Structure]) -> None:
    size, fields = rust_layouts()[message.type_name()]  # type: ignore[attr-defined]
    assert ctypes.sizeof(message) == size
    own = [(getattr(message, name).offset, getattr(message, name).size, name) for name, *_ in message._fields_]
    assert own == fields


def test_texts_that_do_not_fit_are_refused() -> None:
    message = layouts.NarrationV1()
    assert layouts.write_text(message.text, "They grab the mug.", "text") == 18
    assert layouts.read_text(message.text) == "They grab the mug."
    with pytest.raises(ValueError, match="limit is 1024"):
        layouts.write_text(message.text, "a" * 1025, "text")
    with pytest.raises(ValueError, match="control character"):
        layouts.write_text(message.text, "two\nlines", "text")
