"""A recording of `roomcast record`, read by the mcap package: an implementation that shares no line with the one that wrote it."""

from __future__ import annotations

import json
import pathlib
import signal
import subprocess
import time

import pytest

from roomcast import Domain, Narrator, layouts, ports
from samples import ROOMCAST
from test_processes import daemon, domain  # noqa: F401

reader = pytest.importorskip("mcap.reader", reason="SKIPPED: pip install mcap")


def test_another_reader_finds_the_recording_sound(daemon: Domain, tmp_path: pathlib.Path) -> None:  # noqa: F811
    file = tmp_path / "day.mcap"
    recorder = subprocess.Popen([ROOMCAST, "record", str(file), "--root", daemon.root, "--domain", daemon.name])
    # It makes the file when its subscribers stand.
    deadline = time.monotonic() + 60
    while not file.exists():
        assert time.monotonic() < deadline and recorder.poll() is None
        time.sleep(0.02)
    with Narrator("py-narrator", daemon) as narrator:
        for sentence in ["They open the fridge.", "They grab the milk."]:
            narrator.say(sentence)
            assert narrator.wait_until_included(20)
        time.sleep(0.2)
    recorder.send_signal(signal.SIGTERM)
    assert recorder.wait(20) == 0

    with open(file, "rb") as stream:
        recording = reader.make_reader(stream, validate_crcs=True)
        messages = [(schema, channel, json.loads(message.data)) for schema, channel, message in recording.iter_messages()]
        statistics = recording.get_summary().statistics
        assert len(messages) == statistics.message_count
    moments = [data for _, channel, data in messages if channel.topic == "roomcast/v1/moment"]
    for schema, channel, data in messages:
        if channel.topic == "roomcast/v1/moment":
            continue
        declared = json.loads(schema.data)
        assert schema.encoding == "jsonschema" and set(data) == set(declared["properties"])
    told = [data for _, channel, data in messages if channel.topic == ports.NARRATION.name]
    assert [data["text"] for data in told] == ["They open the fridge.", "They grab the milk."]
    # The message itself, as it lay in shared memory.
    image = layouts.NarrationV1.from_buffer_copy(bytes.fromhex(told[0]["bytes"]))
    assert layouts.read_text("text", image.text) == "They open the fridge."
    assert moments and moments[0]["scene"]["format"] == "roomcast-scene"
