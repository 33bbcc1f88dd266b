"""A ROS 2 recording, read by two other implementations: recording.py ROS2.mcap OWN.mcap

mcap-ros2-support decodes each message by the schema in the file. rosbags registers the schemas, computes each type's hash from them, and reads the
file in a folder of rosbag2. Both results must agree with each other and with Roomcast's recording of the same time. The script prints the number of
messages of each topic as JSON."""

import json
import sys
import tempfile
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from ruamel.yaml import YAML

THEIRS, OWN = Path(sys.argv[1]), Path(sys.argv[2])


def plain(value):
    """A message of either decoder as JSON."""
    names = getattr(value, "__dataclass_fields__", None) or getattr(value, "__slots__", None)
    if names:
        return {name: plain(getattr(value, name)) for name in names if not name.startswith("_")}
    if isinstance(value, bytes):
        return list(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(one) for one in value] if isinstance(value, list) else value


# mcap-ros2-support needs only the file.
by_schema = []
with THEIRS.open("rb") as file:
    reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
    assert reader.get_header().profile == "ros2", reader.get_header()
    for schema, channel, message, decoded in reader.iter_decoded_messages():
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr"), schema
        by_schema.append((channel.topic, message.log_time, plain(decoded)))
    summary = reader.get_summary()
    channels = [(channel, summary.schemas[channel.schema_id]) for channel in summary.channels.values()]
    statistics = summary.statistics
    assert statistics.message_count == len(by_schema)

# rosbags needs a folder of rosbag2; the types come from the schemas in the file.
store = get_typestore(Stores.EMPTY)
for _, schema in channels:
    store.register(get_types_from_msg(schema.data.decode(), schema.name))
# Types of ROS 2 equal ROS 2's definitions.
jazzy = get_typestore(Stores.ROS2_JAZZY)
for channel, schema in channels:
    assert channel.metadata["topic_type_hash"] == store.hash_rihs01(schema.name), schema.name
    if schema.name in jazzy.types:
        assert channel.metadata["topic_type_hash"] == jazzy.hash_rihs01(schema.name), schema.name
    (profile,) = YAML(typ="safe").load(channel.metadata["offered_qos_profiles"])
    kept = channel.topic.split("/")[2] in {"rooms", "person", "markers", "decision"}
    assert profile["reliability"] == 1 and profile["durability"] == (1 if kept else 2), profile
with tempfile.TemporaryDirectory() as folder:
    folder = Path(folder)
    (folder / "bag.mcap").write_bytes(THEIRS.read_bytes())
    topics = [
        {
            "topic_metadata": {
                "name": channel.topic,
                "type": schema.name,
                "serialization_format": channel.message_encoding,
                "offered_qos_profiles": channel.metadata["offered_qos_profiles"],
                "type_description_hash": channel.metadata["topic_type_hash"],
            },
            "message_count": statistics.channel_message_counts.get(channel.id, 0),
        }
        for channel, schema in channels
    ]
    information = {
        "version": 8,
        "storage_identifier": "mcap",
        "relative_file_paths": ["bag.mcap"],
        "duration": {"nanoseconds": statistics.message_end_time - statistics.message_start_time},
        "starting_time": {"nanoseconds_since_epoch": statistics.message_start_time},
        "message_count": statistics.message_count,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "custom_data": {},
        "ros_distro": "jazzy",
        "files": [],
    }
    with (folder / "metadata.yaml").open("w") as file:
        YAML(typ="safe").dump({"rosbag2_bagfile_information": information}, file)
    with AnyReader([folder], default_typestore=store) as reader:
        by_bag = [(connection.topic, time, plain(store.deserialize_cdr(data, connection.msgtype))) for connection, time, data in reader.messages()]


def key(message):
    return message[1], message[0], json.dumps(message[2], sort_keys=True)


assert sorted(by_schema, key=key) == sorted(by_bag, key=key), "the two implementations read different things"

own = {}
with OWN.open("rb") as file:
    for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
        own.setdefault(channel.topic.rsplit("/", 1)[1], []).append(json.loads(message.data))


def of(topic):
    return [message for name, _, message in by_schema if name == topic]


def scored(message):
    return [(result["class_id"], result["score"]) for result in message["results"]]


def is_among(message, forecasts):
    """Whether a forecast has these places and probabilities. A recorder polls and skips repeated forecasts by its own clock, so two recorders may keep
    forecasts of moments that are milliseconds apart."""
    said = scored(message)

    def is_alike(forecast):
        return [place for place, _ in said] == [place for place, _ in forecast] and all(abs(a[1] - b[1]) < 0.01 for a, b in zip(said, forecast))

    return any(is_alike(forecast) for forecast in forecasts)


# The first horizon is now.
rooms = [[(room["id"], room["probability"][0]) for room in forecast["rooms"]] for forecast in own["forecast"]]
assert of("/roomcast/rooms") and all(is_among(message, rooms) for message in of("/roomcast/rooms"))
minute = own["forecast"][0]["horizon_s"].index(60.0)
ahead = [[(room["id"], room["probability"][minute]) for room in forecast["rooms"]] for forecast in own["forecast"]]
assert of("/roomcast/rooms/in_60s") and all(is_among(message, ahead) for message in of("/roomcast/rooms/in_60s"))
persons = [
    [*((room["id"], room["probability"][0]) for room in person["rooms"]), ("elsewhere", person["elsewhere"][0])]
    for forecasts in own["person-forecasts"]
    for person in forecasts["person"]
]
assert of("/roomcast/person/ada") and all(is_among(message, persons) for message in of("/roomcast/person/ada"))
for said, narration in zip(of("/roomcast/narration"), own["narration"], strict=True):
    assert said["data"] == f"{narration['person_name']}: {narration['text']}", said
for said, decision in zip(of("/roomcast/decision"), own["decision"], strict=True):
    assert decision["to"] in said["data"] and decision["reason"] in said["data"], said
for message in of("/roomcast/markers"):
    texts = [marker["text"] for marker in message["markers"] if marker["type"] == 9]
    shown = sorted(text.rsplit(" ", 2)[1] for text in texts)
    assert any(shown == sorted(f"{score * 100:.0f}" for _, score in scored(forecast)) for forecast in of("/roomcast/rooms")), texts
print(json.dumps(Counter(topic for topic, _, _ in by_schema)))
