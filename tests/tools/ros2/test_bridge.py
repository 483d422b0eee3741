"""The bridge between a bus and a ROS 2 router, each with real zenoh sessions."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext

from tactile_core.bus.messages import MSG, codec, header
from tactile_core.bus.services import ServiceError, declare_service
from tactile_core.bus.streams import ATTACHMENT, latest
from tactile_core.bus.topics import (
    ARM_STATE,
    COMMAND,
    DIAGNOSTICS,
    FEATURES,
    GEOMETRY,
    LOG,
    REFERENCE,
    TF,
    TOPICS,
    Topic,
    service_key,
)
from tactile_tools.cli import main
from tactile_tools.ros2.bridge import NOT_BRIDGED
from tactile_tools.ros2.follow import WANTED
from tactile_tools.ros2.names import dds_type
from tactile_tools.ros2.node import RouterError, open_client

OUT = [topic for topic in TOPICS if topic.published and topic not in NOT_BRIDGED]
ROS_TOPIC = {DIAGNOSTICS: "diagnostics", TF: "tf", LOG: "rosout"}


def data_key(topic: str, msgtype: str, domain: int = 0) -> str:
    return f"{domain}/{topic}/{dds_type(msgtype)}/{codec().schema(msgtype).type_hash}"


def ros_key(topic: Topic, name: str = "left", domain: int = 0) -> str:
    return data_key(ROS_TOPIC.get(topic) or topic.key(name), topic.msgtype, domain)


@pytest.mark.parametrize("topic", OUT, ids=lambda topic: topic.template)
def test_every_message_type_goes_out_unchanged(
    topic: Topic, bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    heard = peer.listen(ros_key(topic))
    message = filled(topic.msgtype)
    sent: list[bytes] = []

    def bridged() -> Any:
        sent.append(bus.put(topic, "left", message))
        return [s for s in heard if s.payload.to_bytes() == sent[0]]

    sample = running.until(bridged)[0]
    sequence, wall_ns, length, gid = ATTACHMENT.unpack(sample.attachment.to_bytes())
    assert sequence > 0
    assert wall_ns == 1_700_000_000 * 10**9
    assert length == 16
    assert any(gid)


def test_tokens_announce_node_and_topics(
    bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge(domain=7, namespace="/lab")
    bus.put(FEATURES, "left-1", filled(FEATURES.msgtype))
    bus.put(GEOMETRY, "left-1", filled(GEOMETRY.msgtype))

    def announced() -> bool:
        bus.put(FEATURES, "left-1", filled(FEATURES.msgtype))
        bus.put(GEOMETRY, "left-1", filled(GEOMETRY.msgtype))
        return len(running.bridge.routes) == 2

    running.until(announced)
    tokens = running.until(lambda: (found := peer.tokens()) and len(found) >= 6 and found)
    zid = running.node.node.zid
    assert f"@ros2_lv/7/{zid}/0/0/NN/%/%lab/tactile_bridge" in tokens
    features = codec().schema(FEATURES).type_hash
    geometry = codec().schema(GEOMETRY).type_hash
    assert any(
        t.endswith(
            "/MP/%/%lab/tactile_bridge/%lab%tactile%left_1%features/"
            f"tactile_msgs::msg::dds_::ContactFeatures_/{features}/::,10:,:,:,,"
        )
        for t in tokens
    )
    assert any(t.endswith(f"_/{geometry}/:1:,1:,:,:,,") for t in tokens)
    numbers = [t.split("/")[4] for t in tokens if "/MP/" in t]
    assert len(numbers) == len(set(numbers))


def test_humble_has_no_hashes(
    bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge(distro="humble")
    key = "0/tactile/left/features/tactile_msgs::msg::dds_::ContactFeatures_/TypeHashNotSupported"
    heard = peer.listen(key)
    message = filled(FEATURES.msgtype)
    running.until(lambda: bus.put(FEATURES, "left", message) and heard)


def test_late_subscriber_gets_the_geometry(
    bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    message = filled(GEOMETRY.msgtype)

    def passed_on() -> bool:
        data.append(bus.put(GEOMETRY, "left", message))
        return running.bridge.counts["to_ros"] > 0

    data: list[bytes] = []
    running.until(passed_on)
    got: list[bytes] = []
    # rmw_zenoh subscribes to transient local topics like this.
    late = zenoh.ext.declare_advanced_subscriber(
        peer.session,
        ros_key(GEOMETRY),
        lambda sample: got.append(sample.payload.to_bytes()),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
    )
    running.until(lambda: got)
    assert got[0] == data[0]
    late.undeclare()


def test_new_board_is_asked_for_its_geometry(
    bus: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    asked: list[Any] = []
    declare_service(bus.session, service_key("left", "geometry"), lambda r: asked.append(r) or {})
    running = start_bridge()
    message = filled(FEATURES.msgtype)
    running.until(lambda: bus.put(FEATURES, "left", message) and asked)
    assert running.bridge.boards == ("left",)


def test_losses_on_the_bus_show_in_ros_sequence_numbers(
    bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    heard = peer.listen(ros_key(FEATURES))
    message = filled(FEATURES.msgtype)
    running.until(lambda: bus.put(FEATURES, "left", message) and heard)

    def last_number() -> int:
        number: int = ATTACHMENT.unpack(heard[-1].attachment.to_bytes())[0]
        return number

    message.sequence += 1
    marked = bus.put(FEATURES, "left", message)
    running.until(lambda: heard[-1].payload.to_bytes() == marked)
    count, before = len(heard), last_number()
    lost = running.bridge.counts["lost_on_the_bus"]
    bus.skip(FEATURES, "left", 5)
    bus.put(FEATURES, "left", message)
    running.until(lambda: len(heard) > count)
    assert last_number() == before + 6
    assert running.bridge.counts["lost_on_the_bus"] == lost + 5


def test_standard_types_for_those_without_our_package(
    bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    wrench = peer.listen(data_key("tactile/left/wrench", "geometry_msgs/msg/WrenchStamped"))
    pose = peer.listen(data_key("arm/ur/pose", "geometry_msgs/msg/PoseStamped"))
    features, state = filled(FEATURES.msgtype), filled(ARM_STATE.msgtype)
    features.valid = True

    def passed() -> Any:
        bus.put(FEATURES, "left", features)
        bus.put(ARM_STATE, "ur", state)
        return wrench and pose

    running.until(passed)
    said = codec().decode("geometry_msgs/msg/WrenchStamped", wrench[0].payload.to_bytes())
    assert said.wrench == features.wrench
    assert said.header.frame_id == features.header.frame_id
    where = codec().decode("geometry_msgs/msg/PoseStamped", pose[0].payload.to_bytes())
    assert (where.pose.position.x, where.pose.position.y) == (state.x, state.y)


def test_invalid_features_make_no_wrench(
    bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    wrench = peer.listen(data_key("tactile/left/wrench", "geometry_msgs/msg/WrenchStamped"))
    heard = peer.listen(ros_key(FEATURES))
    features = filled(FEATURES.msgtype)
    features.valid = False
    running.until(lambda: bus.put(FEATURES, "left", features) and len(heard) > 10)
    assert not wrench


def test_commands_and_their_proofs_stay_on_the_bus(
    bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    command, state = filled(COMMAND.msgtype), filled(ARM_STATE.msgtype)
    heard = peer.listen("0/arm/**")

    def passed() -> bool:
        bus.put(COMMAND, "ur", command)
        bus.put(ARM_STATE, "ur", state)
        return len(heard) > 5

    running.until(passed)
    assert not any("cmd_vel" in str(sample.key_expr) for sample in heard)


def test_too_many_streams_are_refused_and_counted(
    bus: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    message = filled(LOG.msgtype)

    def flooded() -> bool:
        for number in range(300):
            bus.put(LOG, f"b{number}", message)
        return running.bridge.counts["too_many_streams"] > 0

    running.until(flooded)
    assert len(running.bridge.routes) <= 256


# From ROS


def test_requests_are_refused_unless_accepted_by_name(
    bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    message = filled(FEATURES.msgtype)
    running.until(lambda: bus.put(FEATURES, "left", message) and running.bridge.boards)
    assert not any("/MS/" in token for token in peer.tokens())


def ros_put(peer: Any, topic: str, message: Any) -> None:
    msgtype = message.__msgtype__
    peer.session.put(data_key(topic, msgtype), codec().encode(msgtype, message))


def test_wrench_becomes_the_reference_of_its_board(
    bus: Any, peer: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge(accept=frozenset({"wrench"}))
    reference = latest(bus.session, REFERENCE.key("left-1"))
    features, wrench = filled(FEATURES.msgtype), filled(REFERENCE.msgtype)
    got: list[Any] = []

    def passed() -> Any:
        bus.put(FEATURES, "left-1", features)
        ros_put(peer, "reference/left_1/wrench", wrench)
        got.extend(s for s in [reference.newest()] if s is not None)
        return got

    running.until(passed)
    assert got[0].data == codec().encode(REFERENCE, wrench)


def twist(x: float = 0.03, *, frame: str = "cupboard", wall_ns: int = 0, z: float = 0.0) -> Any:
    linear, angular = MSG.Vector3(x, 0.0, z), MSG.Vector3(0.0, 0.0, 0.1)
    return MSG.TwistStamped(header(wall_ns, frame), MSG.Twist(linear, angular))


def test_invalid_twists_are_refused(bus: Any, peer: Any, start_bridge: Callable[..., Any]) -> None:
    running = start_bridge(accept=frozenset({"twist"}), reach="reach")
    wanted = latest(bus.session, WANTED.key("reach"))
    counts = running.bridge.counts
    bad = (
        twist(frame="base_link"),
        twist(x=float("nan")),
        twist(z=0.1),
        twist(wall_ns=time.time_ns() - 2 * 10**9),
    )
    for message in bad:
        before = counts["refused_twist"]

        def refused(message: Any = message, before: int = before) -> bool:
            ros_put(peer, "reference/reach/twist", message)
            return counts["refused_twist"] > before

        running.until(refused)
    assert wanted.newest() is None
    peer.session.put(data_key("reference/reach/twist", WANTED.msgtype), b"nonsense")
    running.until(lambda: counts["malformed"] > 0)
    good = twist(wall_ns=time.time_ns())
    got: list[Any] = []

    def passed() -> Any:
        ros_put(peer, "reference/reach/twist", twist(wall_ns=time.time_ns()))
        got.extend(s for s in [wanted.newest()] if s is not None)
        return got

    running.until(passed)
    assert codec().decode(WANTED, got[0].data).twist == good.twist


def test_goals_are_passed_to_reachd_and_refusals_reported(
    bus: Any, peer: Any, start_bridge: Callable[..., Any]
) -> None:
    asked: list[Any] = []

    def goal(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request)
        if request["x"] > 0.5:
            raise ServiceError("the target lies outside")
        return request

    declare_service(bus.session, service_key("reach", "goal", "reach"), goal)
    running = start_bridge(accept=frozenset({"goals"}))
    said = peer.listen(ros_key(LOG))
    turn = MSG.Quaternion(0.0, 0.0, 0.0, 1.0)

    def send(x: float, frame: str = "cupboard") -> None:
        pose = MSG.Pose(MSG.Point(x, 0.02, 0.0), turn)
        ros_put(peer, "reach/reach/goal", MSG.PoseStamped(header(0, frame), pose))

    def texts() -> str:
        return " ".join(codec().decode(LOG, s.payload.to_bytes()).msg for s in said)

    sent = 0

    def accepted() -> bool:
        nonlocal sent
        sent += 1
        if sent % 50 == 1:
            send(0.3)
        return "accepted" in texts()

    running.until(accepted)
    assert {"x": 0.3, "y": 0.02} in asked
    send(0.3, frame="map")
    running.until(lambda: "its frame is 'map'" in texts())
    send(0.9)
    running.until(lambda: "the target lies outside" in texts())
    assert running.bridge.counts["refused_goal"] == 2


def test_bridge_survives_a_restart_of_the_router(
    bus: Any, router: Any, start_bridge: Callable[..., Any], filled: Callable[..., Any]
) -> None:
    running = start_bridge()
    message = filled(FEATURES.msgtype)
    running.until(lambda: bus.put(FEATURES, "left", message) and running.bridge.boards)
    router.stop()
    running.until(lambda: not running.node.connected)
    bus.put(FEATURES, "left", message)
    router.start()
    again = type(running.node)(router.endpoint, "other", distro="jazzy")
    heard: list[Any] = []
    again.subscribe("tactile/left/features", FEATURES.msgtype, heard.append)
    running.until(lambda: bus.put(FEATURES, "left", message) and heard)
    again.close()


# As a process


def bridge_process(bus: Any, router: str, *words: str) -> subprocess.Popen[str]:
    command = Path(sys.executable).with_name("tactile")
    return subprocess.Popen(
        [command, "ros2", "bridge", "--router", router, "--connect", bus.endpoint, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--domain", "500"), "expected 0 to 232"),
        (("--namespace", "/9lives"), "invalid namespace"),
        (("--node-name", "my node"), "invalid node name"),
        (("--accept", "everything"), "allowed: goals, twist, wrench"),
    ],
)
def test_bad_arguments_are_refused(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["ros2", "bridge", *words])
    assert refused.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("endpoint", ["nonsense", "tcp/", "tcp/127.0.0.1:9"])
def test_unreachable_router_is_reported_in_one_sentence(endpoint: str) -> None:
    with pytest.raises(RouterError, match="--router tcp/HOST:PORT"):
        open_client(endpoint, timeout_s=0.2)


def test_sigterm_withdraws_the_tokens_of_the_bridge(
    bus: Any,
    router: Any,
    peer: Any,
    filled: Callable[..., Any],
    wait: Callable[..., Any],
) -> None:
    process = bridge_process(bus, router.endpoint)
    heard = peer.listen(ros_key(FEATURES))
    message = filled(FEATURES.msgtype)
    wait(lambda: bus.put(FEATURES, "left", message) and heard, 60)
    assert any("%tactile%left%features" in token for token in peer.tokens())
    again = bridge_process(bus, "tcp/127.0.0.1:9")
    process.send_signal(signal.SIGTERM)
    out, said = process.communicate(timeout=120)
    assert process.returncode == 0, said
    assert "to ROS" in out
    wait(lambda: not any("tactile_bridge" in token for token in peer.tokens()))
    _, refused = again.communicate(timeout=120)
    assert again.returncode == 3
    assert "no ROS 2 router answers at tcp/127.0.0.1:9" in refused
    assert "rmw_zenohd" in refused
    assert "Traceback" not in refused
