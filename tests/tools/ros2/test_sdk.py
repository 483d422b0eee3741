"""Both directions against zenoh-ros2-sdk, an independent implementation of rmw_zenoh's protocol.

It computes hashes of types from definitions by itself: those of our package in the repository, and
those of standard types.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tactile_core.bus.messages import codec
from tactile_core.bus.streams import latest
from tactile_core.bus.topics import DIAGNOSTICS, FEATURES, LOG, REFERENCE, TF, TOPICS
from tactile_tools.ros2.bridge import NOT_BRIDGED
from tactile_tools.ros2.follow import WANTED
from tests.support.paths import ROOT

PYTHON = "TACTILE_ROS2_SDK_PYTHON"
"""Names an interpreter that has zenoh-ros2-sdk."""

ROS_TOPIC = {DIAGNOSTICS: "/diagnostics", TF: "/tf", LOG: "/rosout"}
OUT = [topic for topic in TOPICS if topic.published and topic not in NOT_BRIDGED]
SHARED = set(ROS_TOPIC.values())


@pytest.fixture
def sdk(router: Any, tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """``sdk(hear=..., publish=...)``: start the other node as a process."""
    python = os.environ.get(PYTHON)
    if python is None:
        pytest.skip(f"{PYTHON} does not name an interpreter with zenoh-ros2-sdk")
    folder = tmp_path / "definitions"
    shutil.copytree(ROOT / "ros2" / "tactile_msgs", folder / "tactile_msgs")
    for msgtype in _standard():
        path = folder / f"{msgtype}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        text, _ = codec()._store.generate_msgdef(msgtype, ros_version=2)
        path.write_text(text.split("=" * 80)[0])

    def start(hear: Any = (), publish: Any = (), seconds: float = 40) -> subprocess.Popen[str]:
        job = {"hear": list(hear), "publish": list(publish), "seconds": seconds}
        port = router.endpoint.rpartition(":")[2]
        return subprocess.Popen(
            [python, Path(__file__).with_name("sdk_peer.py"), port, folder, json.dumps(job)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # For a router that does not forward between peers, as in the shipped configuration.
            env=os.environ | {"ZENOH_CONFIG_OVERRIDE": "scouting/multicast/enabled=false"},
        )

    return start


def _standard() -> set[str]:
    """Standard types that ours contain, directly or nested."""
    found: set[str] = set()
    todo = [t.msgtype for t in TOPICS] + [WANTED.msgtype, "geometry_msgs/msg/PoseStamped"]
    while todo:
        name = todo.pop()
        for _, (kind, detail) in codec().fields(name):
            if kind in (3, 4):
                kind, detail = detail[0]
            if kind == 2 and detail not in found:
                todo.append(detail)
                found.add(detail)
    found |= {t.msgtype for t in TOPICS} | {WANTED.msgtype, "geometry_msgs/msg/PoseStamped"}
    return {name for name in found if not name.startswith("tactile_msgs/")}


def test_every_message_type_is_read_by_the_sdk(
    bus: Any, start_bridge: Callable[..., Any], sdk: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    messages = {topic: filled(topic.msgtype) for topic in OUT}
    hear = [(ROS_TOPIC.get(t) or "/" + t.key("left"), t.msgtype) for t in OUT]
    process = sdk(hear=hear)
    stop = threading.Event()

    def speak() -> None:
        while not stop.wait(0.02):
            for topic, message in messages.items():
                bus.put(topic, "left", message)
            running.bridge.tick()

    speaker = threading.Thread(target=speak)
    speaker.start()
    out, err = process.communicate(timeout=120)
    stop.set()
    speaker.join()
    lines = [json.loads(line) for line in out.splitlines()]
    assert lines, err
    assert lines[-1] == {"missing": []}, err[-2000:]
    by_topic = {line["topic"]: line["message"] for line in lines[:-1]}
    for (topic, msgtype), ours in zip(hear, OUT, strict=True):
        if topic in SHARED - {"/tf"}:  # the bridge itself publishes there, too
            continue
        said = by_topic[topic]
        wanted = codec().decode(msgtype, codec().encode(msgtype, messages[ours]))
        for name, (kind, _) in codec().fields(msgtype):
            if kind == 1:
                assert said[name] == pytest.approx(getattr(wanted, name)), (topic, name)


def test_twist_and_wrench_of_the_sdk_come_to_the_bus(
    bus: Any, start_bridge: Callable[..., Any], sdk: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge(accept=frozenset({"twist", "wrench"}))
    twists = latest(bus.session, WANTED.key("reach"))
    wrenches = latest(bus.session, REFERENCE.key("left"))
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "cupboard"}
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    twist = {"linear": {"x": 0.02, "y": -0.01, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.1}}
    wrench = {"force": {"x": 0.0, "y": 0.0, "z": -3.5}, "torque": zero}
    process = sdk(
        publish=[
            ("/reference/reach/twist", WANTED.msgtype, {"header": header, "twist": twist}),
            ("/reference/left/wrench", REFERENCE.msgtype, {"header": header, "wrench": wrench}),
        ]
    )
    features = filled(FEATURES.msgtype)
    found: dict[str, Any] = {}

    def both() -> bool:
        bus.put(FEATURES, "left", features)
        for name, stream in (("twist", twists), ("wrench", wrenches)):
            sample = stream.newest()
            if sample is not None:
                found[name] = sample
        time.sleep(0.01)
        return len(found) == 2

    running.until(both)
    process.kill()
    process.communicate()
    said = codec().decode(WANTED, found["twist"].data).twist
    assert (said.linear.x, said.linear.y, said.angular.z) == (0.02, -0.01, 0.1)
    assert codec().decode(REFERENCE, found["wrench"].data).wrench.force.z == -3.5
