"""A ROS 2 node made with zenoh-ros2-sdk; run by an interpreter that has it.

``sdk_peer.py ROUTER_PORT DEFINITIONS JOB``: definitions as PACKAGE/msg/NAME.msg. JOB is JSON:
topics to hear (topic, type), messages to publish, and for how long. Prints what was heard, one JSON
object per line.
"""

import json
import os
import sys
import threading
import time
from pathlib import Path

import numpy as np
import zenoh_ros2_sdk.message_registry as registry
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.session import ZenohSession


def plain(value: object) -> object:
    """A message as plain values for JSON."""
    if isinstance(value, np.ndarray):
        return [plain(each) for each in value.tolist()]
    if isinstance(value, list):
        return [plain(each) for each in value]
    if isinstance(value, float) and value != value:
        return "nan"
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if name != "__msgtype__"]
        return {name: plain(getattr(value, name)) for name in names}
    return value


def build(session: ZenohSession, msgtype: str, values: dict) -> dict:
    """Keyword arguments of a message from plain values."""
    made = {}
    for name, (kind, detail) in session.store.fielddefs[msgtype][1]:
        value = values[name]
        if kind == 2:
            inner = session.store.types[detail]
            made[name] = inner(**build(session, detail, value))
        else:
            made[name] = value
    return made


def main() -> None:
    port, folder, job = int(sys.argv[1]), Path(sys.argv[2]), json.loads(sys.argv[3])
    # The library offers no way to name the folder, and its own downloads definitions.
    registry._registry = registry.MessageRegistry(str(folder))
    session = ZenohSession.get_instance("127.0.0.1", port)
    end = time.monotonic() + job["seconds"]
    kept = []
    printing = threading.Lock()  # several topics are heard in several threads
    left = {topic for topic, _ in job["hear"]}

    def heard(topic: str, message: object) -> None:
        with printing:
            left.discard(topic)
            print(json.dumps({"topic": topic, "message": plain(message)}), flush=True)

    for topic, msgtype in job["hear"]:
        latched = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
        kept.append(
            ROS2Subscriber(
                topic, msgtype, lambda m, topic=topic: heard(topic, m), router_ip="127.0.0.1",
                router_port=port, domain_id=0, qos=latched if "geometry" in topic else None,
            )
        )  # fmt: skip
    publishers = [
        (ROS2Publisher(topic, msgtype, router_ip="127.0.0.1", router_port=port, domain_id=0),
         build(session, msgtype, values))
        for topic, msgtype, values in job["publish"]
    ]  # fmt: skip
    while time.monotonic() < end and (left or publishers):
        for publisher, values in publishers:
            publisher.publish(**values)
        time.sleep(0.05)
    with printing:
        print(json.dumps({"missing": sorted(left)}), flush=True)
        os._exit(0)  # without waiting for what is still being heard


if __name__ == "__main__":
    main()
