"""A robot's bridge, as a ROS 2 node of another implementation receives it: ros2.py PORT

rosbags computes type hashes and decodes messages, zenoh-ros2-sdk makes keys and tokens. The script publishes a sentence on the narration topic and
prints the received messages as JSON."""

import json
import sys
import time

import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

PORT = int(sys.argv[1])
PATIENCE_S = 100
# Two packages are missing in rosbags.
DEFINITIONS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/Classification": "std_msgs/Header header\nvision_msgs/ObjectHypothesis[] results\n",
    "nav2_msgs/msg/CostmapFilterInfo": "std_msgs/Header header\nuint8 type\nstring filter_mask_topic\nfloat32 base\nfloat32 multiplier\n",
}
TOPICS = {
    "/roomcast/rooms": "vision_msgs/msg/Classification",
    "/roomcast/rooms/in_60s": "vision_msgs/msg/Classification",
    "/roomcast/person/ada": "vision_msgs/msg/Classification",
    "/roomcast/person/ada/in_600s": "vision_msgs/msg/Classification",
    "/roomcast/keepout_mask": "nav_msgs/msg/OccupancyGrid",
    "/roomcast/keepout_info": "nav2_msgs/msg/CostmapFilterInfo",
    "/roomcast/markers": "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}

store = get_typestore(Stores.ROS2_JAZZY)
for name, definition in DEFINITIONS.items():
    store.register(get_types_from_msg(definition, name))


def plain(value):
    """A message as JSON."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(one) for one in value] if isinstance(value, list) else value


session = ZenohSession.get_instance("127.0.0.1", PORT)
# The SDK would fetch definitions from the network.
session.store = store
for kind in {*TOPICS.values(), "std_msgs/msg/String"}:
    session._registered_types[kind] = kind

heard, attachments = {}, {}
subscribers = []
for topic, kind in TOPICS.items():
    take = lambda message, topic=topic: heard.__setitem__(topic, plain(message))
    subscribers.append(ROS2Subscriber(topic, kind, take, router_port=PORT, domain_id=0, type_hash=store.hash_rihs01(kind)))


def note(sample):
    attachments[str(sample.key_expr)] = sample.attachment.to_bytes() if sample.attachment else b""


raw = session.session.declare_subscriber("0/**", note)
publisher = ROS2Publisher(
    "/roomcast/narration", "std_msgs/msg/String", router_port=PORT, domain_id=0, type_hash=store.hash_rihs01("std_msgs/msg/String")
)
end = time.monotonic() + PATIENCE_S
said = 0


def is_scored():
    """The first diagnostics may be from before the daemon's first scores."""
    status = heard.get("/diagnostics", {}).get("status") or [{}]
    return status[0].get("message") == "rooms are scored"


# Nav2's information about the mask is sent before the script starts.
while time.monotonic() < end and not (is_scored() and {*TOPICS} - {*heard} <= {"/roomcast/keepout_info"}):
    # The topic is volatile: a message without a subscriber is lost, as in ROS 2.
    if said < 20:
        publisher.publish(data=json.dumps({"text": "They walk to the kitchen.", "person": "Ada"}))
        said += 1
    time.sleep(0.5)

# A late subscriber with transient-local durability asks for these.
kept = {}
for topic, kind in TOPICS.items():
    dds = subscribers[list(TOPICS).index(topic)].dds_type_name
    name = topic.lstrip("/")
    key = f"0/{name}/{dds}/{store.hash_rihs01(kind)}"
    for reply in session.session.get(f"{key}/@adv/pub/*/**?_anyke", timeout=5.0):
        if reply.ok is not None:
            kept[topic] = plain(store.deserialize_cdr(reply.ok.payload.to_bytes(), kind))
tokens = [str(reply.ok.key_expr) for reply in session.liveliness.get("@ros2_lv/0/**", timeout=5.0) if reply.ok is not None]
own = str(session.session.info.zid())
print(
    json.dumps(
        {
            "heard": heard,
            "kept": kept,
            "attachment_bytes": {key: len(value) for key, value in attachments.items() if "narration" not in key},
            "gid_lengths": sorted({value[16] for value in attachments.values() if len(value) > 16}),
            "tokens": [token for token in tokens if own not in token],
        }
    )
)
for one in [*subscribers, publisher]:
    one.close()
session.close()
