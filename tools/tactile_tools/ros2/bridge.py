"""The bridge: our streams become ROS 2 topics, and accepted requests from ROS 2 reach our bus.

Messages have ROS 2 types already, so their bytes are passed on unchanged, in the thread that
received them. Nothing is queued on the way out: what the link cannot take is dropped, and shows as
a gap in the sequence numbers. Requests from ROS are refused unless accepted by name, because anyone
who reaches the router may send them, while our bus admits only those who prove a right.
"""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import zenoh

from tactile_core.bus.messages import (
    MSG,
    DecodeError,
    codec,
    diagnostic_status,
    header,
    log_message,
    stamp_ns,
)
from tactile_core.bus.services import ServiceError, call
from tactile_core.bus.streams import BusSample, Publisher, Tap, declare_publisher
from tactile_core.bus.topics import (
    ARM_STATE,
    COMMAND,
    DIAGNOSTICS,
    FEATURES,
    LOG,
    REFERENCE,
    TF,
    Topic,
    find_topic,
    service_key,
)
from tactile_core.types import NS_PER_S
from tactile_tools.ros2.follow import WANTED, planar_twist
from tactile_tools.ros2.names import LATCHED, STREAM, ros_name
from tactile_tools.ros2.node import RosNode, RosPublisher

log = logging.getLogger(__name__)

Request = Literal["goals", "twist", "wrench"]

REQUESTS: Final[tuple[Request, ...]] = ("goals", "twist", "wrench")
"""Requests from ROS that can be accepted."""

NOT_BRIDGED: Final = (COMMAND, REFERENCE)
"""Commands carry a proof that must stay on our bus; references come from ROS, if at all."""

SHARED: Final = {DIAGNOSTICS: "/diagnostics", TF: "/tf", LOG: "/rosout"}
"""Topics that ROS tools look for under one fixed name."""

FRAME: Final = "cupboard"

MAX_ROUTES: Final = 256
"""Most streams that are bridged, so that made-up names cannot fill the ROS graph."""

MAX_GOALS: Final = 4
"""Goals that may wait for reachd's answer."""

GOAL_TIMEOUT_S: Final = 3.0

TWIST_AGE_S: Final = 0.5
"""A twist with an older stamp is refused; the clocks of two machines may differ by part of this."""

GEOMETRY_TIMEOUT_S: Final = 5.0

KEYS: Final = ("tactile/*/*", "arm/*/state", "reach/*/*", "world/*/*", TF.template)

Derive = Callable[[Any], Any]
"""Make a message of a standard type from one of ours; None where nothing is to be sent."""


@dataclass(slots=True)
class _Derived:
    publisher: RosPublisher
    derive: Derive


@dataclass(slots=True)
class _Route:
    """Where the samples of one key go."""

    topic: Topic
    publisher: RosPublisher
    derived: list[_Derived] = field(default_factory=list)
    last: tuple[bytes, int] | None = None

    def lost_before(self, sample: BusSample) -> int:
        """Messages of this stream that were lost on their way to us, just before ``sample``."""
        if sample.source is None or sample.sequence is None:
            return 0
        last, self.last = self.last, (sample.source, sample.sequence)
        if last is None or last[0] != sample.source:
            return 0
        return max(0, sample.sequence - last[1] - 1)


def _contact_wrench(message: Any) -> Any:
    return MSG.WrenchStamped(message.header, message.wrench) if message.valid else None


def _arm_pose(message: Any) -> Any:
    half = message.heading / 2
    turn = MSG.Quaternion(0.0, 0.0, math.sin(half), math.cos(half))
    return MSG.PoseStamped(message.header, MSG.Pose(MSG.Point(message.x, message.y, 0.0), turn))


def _arm_twist(message: Any) -> Any:
    return MSG.TwistStamped(message.header, message.twist)


def _arm_wrench(message: Any) -> Any:
    return MSG.WrenchStamped(message.header, message.wrench)


DERIVED: Final[dict[Topic, tuple[tuple[str, str, Derive], ...]]] = {
    FEATURES: (("tactile/{name}/wrench", "geometry_msgs/msg/WrenchStamped", _contact_wrench),),
    ARM_STATE: (
        ("arm/{name}/pose", "geometry_msgs/msg/PoseStamped", _arm_pose),
        ("arm/{name}/twist", "geometry_msgs/msg/TwistStamped", _arm_twist),
        ("arm/{name}/wrench", "geometry_msgs/msg/WrenchStamped", _arm_wrench),
    ),
}
"""Messages made in types that every ROS tool knows, for subscribers without `tactile_msgs`; made
only while somebody subscribes."""


class Bridge:
    """Bridges between ``bus`` and ``node``; call `tick` often, from one thread.

    ``accept``: requests from ROS that are passed on. ``reach``: the reach that they are for.
    ``counts``: messages passed and not passed, by reason.
    """

    def __init__(
        self,
        bus: zenoh.Session,
        node: RosNode,
        *,
        accept: frozenset[Request] = frozenset(),
        reach: str = "reach",
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._bus = bus
        self._node = node
        self._accept = accept
        self._reach = reach
        self._wall_ns = wall_ns
        self._routes: dict[str, _Route] = {}
        self._new: dict[str, None] = {}  # keys still to be declared
        self._not_bridged: set[str] = set()
        self._boards: set[str] = set()
        self._by_topic: dict[str, RosPublisher] = {}
        self._requests: list[Publisher] = []
        self._closed = threading.Event()
        self._connected = True
        self._diagnosed_ns = 0
        self._said = self._publisher("/rosout", LOG.msgtype, latched=False)
        self._health = self._publisher("/diagnostics", DIAGNOSTICS.msgtype, latched=False)
        self._goals: queue.Queue[tuple[float, float]] = queue.Queue(MAX_GOALS)
        if "goals" in accept:
            threading.Thread(target=self._ask_goals, name="ros2-goals", daemon=True).start()
            node.subscribe(
                f"reach/{ros_name(reach)}/goal", "geometry_msgs/msg/PoseStamped", self._hear_goal
            )
        if "twist" in accept:
            wanted = declare_publisher(bus, WANTED, reach)
            self._requests.append(wanted)
            node.subscribe(
                WANTED.key(ros_name(reach)), WANTED.msgtype, lambda s: self._hear_twist(s, wanted)
            )
        self._taps = [Tap(bus, key, self._hear) for key in KEYS]

    @property
    def boards(self) -> tuple[str, ...]:
        """Names of the boards heard so far."""
        return tuple(sorted(self._boards))

    @property
    def routes(self) -> dict[str, str]:
        """ROS topic of each bridged key."""
        return {key: route.publisher.endpoint.topic for key, route in self._routes.items()}

    def tick(self) -> None:
        """Declare new streams, report the state of the router, publish the bridge's diagnostics."""
        for key in list(self._new):
            self._declare(key)
        self._watch_router()
        now_ns = self._wall_ns()
        if abs(now_ns - self._diagnosed_ns) >= NS_PER_S:
            self._diagnosed_ns = now_ns
            self._publish_health(now_ns)

    def close(self) -> None:
        """Close everything except the two sessions."""
        self._closed.set()
        for tap in self._taps:
            tap.close()
        for publisher in self._requests:
            publisher.close()

    # To ROS

    def _hear(self, sample: BusSample) -> None:
        route = self._routes.get(sample.key)
        if route is None:
            if sample.key in self._not_bridged:
                return
            known = len(self._routes) + len(self._new) + len(self._not_bridged)
            if known < MAX_ROUTES or sample.key in self._new:
                self._new[sample.key] = None
                self.counts["before_declared"] += 1
            else:
                self.counts["too_many_streams"] += 1
            return
        wall_ns = self._wall_ns() if sample.wall_ns is None else sample.wall_ns
        lost = route.lost_before(sample)
        self.counts["lost_on_the_bus"] += lost
        route.publisher.put(sample.data, wall_ns, lost)
        self.counts["to_ros"] += 1
        if any(derived.publisher.matched for derived in route.derived):
            self._derive(route, sample, wall_ns)

    def _derive(self, route: _Route, sample: BusSample, wall_ns: int) -> None:
        try:
            message = codec().decode(route.topic, sample.data)
        except DecodeError:
            self.counts["malformed"] += 1
            return
        for derived in route.derived:
            made = derived.derive(message) if derived.publisher.matched else None
            if made is not None:
                data = codec().encode(derived.publisher.endpoint.type_name, made)
                derived.publisher.put(data, wall_ns)

    def _declare(self, key: str) -> None:
        found = find_topic(key)
        if found is None or found[0] in NOT_BRIDGED:
            self._not_bridged.add(key)
            del self._new[key]
            return
        topic, name = found
        ros_topic = SHARED.get(topic) or topic.key(ros_name(name))
        publisher = self._publisher(ros_topic, topic.msgtype, latched=topic.latched)
        derived = [
            _Derived(self._publisher(t.format(name=ros_name(name)), kind, latched=False), make)
            for t, kind, make in DERIVED.get(topic, ())
        ]
        self._routes[key] = _Route(topic, publisher, derived)
        del self._new[key]
        log.info("%s -> %s", key, publisher.endpoint.topic)
        if topic is FEATURES and name not in self._boards:
            self._add_board(name)

    def _publisher(self, topic: str, msgtype: str, *, latched: bool) -> RosPublisher:
        made = self._by_topic.get(topic)
        if made is None:
            made = self._node.publish(topic, msgtype, LATCHED if latched else STREAM)
            self._by_topic[topic] = made
        return made

    def _add_board(self, board: str) -> None:
        """A new board was heard: ask for its geometry, and listen for its reference."""
        self._boards.add(board)
        self._bus.get(service_key(board, "geometry"), lambda _: None, timeout=GEOMETRY_TIMEOUT_S)
        if "wrench" in self._accept:
            reference = declare_publisher(self._bus, REFERENCE, board)
            self._requests.append(reference)
            self._node.subscribe(
                REFERENCE.key(ros_name(board)),
                REFERENCE.msgtype,
                lambda sample: self._hear_wrench(sample, reference),
            )

    # From ROS

    def _hear_wrench(self, sample: BusSample, reference: Publisher) -> None:
        message = self._decode(REFERENCE.msgtype, sample)
        if message is not None:
            reference.put(sample.data, stamp_ns(message.header.stamp) or self._wall_ns())
            self.counts["from_ros"] += 1

    def _hear_twist(self, sample: BusSample, wanted: Publisher) -> None:
        message = self._decode(WANTED.msgtype, sample)
        if message is None:
            return
        if planar_twist(message) is None:
            self._refuse("twist", f"it is not finite, planar and in the frame {FRAME!r}")
            return
        stamped_ns, now_ns = stamp_ns(message.header.stamp), self._wall_ns()
        if stamped_ns and abs(now_ns - stamped_ns) > TWIST_AGE_S * NS_PER_S:
            self._refuse("twist", f"its stamp is more than {TWIST_AGE_S:g} s from now")
            return
        wanted.put(sample.data, now_ns)
        self.counts["from_ros"] += 1

    def _hear_goal(self, sample: BusSample) -> None:
        message = self._decode("geometry_msgs/msg/PoseStamped", sample)
        if message is None:
            return
        if message.header.frame_id != FRAME:
            self._refuse("goal", f"its frame is {message.header.frame_id!r}, not {FRAME!r}")
            return
        place = message.pose.position
        try:
            self._goals.put_nowait((float(place.x), float(place.y)))
        except queue.Full:
            self._refuse("goal", f"{MAX_GOALS} others wait for an answer")

    def _ask_goals(self) -> None:
        while not self._closed.is_set():
            try:
                x, y = self._goals.get(timeout=0.2)
            except queue.Empty:
                continue
            try:
                key = service_key(self._reach, "goal", "reach")
                call(self._bus, key, {"x": x, "y": y}, GOAL_TIMEOUT_S)
            except (ServiceError, zenoh.ZError) as error:
                self._refuse("goal", str(error))
            else:
                self.counts["from_ros"] += 1
                self._say(20, f"goal {x:g}, {y:g} m accepted by {self._reach}")

    def _decode(self, msgtype: str, sample: BusSample) -> Any:
        try:
            return codec().decode(msgtype, sample.data)
        except DecodeError as error:
            self.counts["malformed"] += 1
            log.debug("%s: %s", sample.key, error)
            return None

    def _refuse(self, what: str, why: str) -> None:
        reason = f"refused_{what}"
        self.counts[reason] += 1
        if self.counts[reason] == 1 or what == "goal":  # twists come a hundred times a second
            self._say(30, f"{what} from ROS refused: {why}")

    # The bridge's own diagnostics

    def _say(self, level: int, text: str) -> None:
        log.log(level, "%s", text)
        wall_ns = self._wall_ns()
        message = log_message(wall_ns, level, self._node.node.name, text)
        self._said.put(codec().encode(LOG, message), wall_ns)

    def _watch_router(self) -> None:
        connected = self._node.connected
        if connected != self._connected:
            self._connected = connected
            if connected:
                log.info("the router is back")
            else:
                log.warning("the router is gone: waiting for it, nothing reaches ROS meanwhile")

    def _publish_health(self, now_ns: int) -> None:
        values = {"boards": ", ".join(self.boards)} | dict(sorted(self.counts.items()))
        level, text = (0, "bridging") if self._boards else (1, "no board on the bus")
        status = diagnostic_status(self._node.node.name, level, text, "", values)
        message = MSG.DiagnosticArray(header(now_ns, ""), [status])
        self._health.put(codec().encode(DIAGNOSTICS, message), now_ns)
