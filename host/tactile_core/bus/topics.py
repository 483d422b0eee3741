"""Table of all topics: key, type, rate, whether logged, and when a value is too old to act on.

Keys are built only here, so that another scheme (that of rmw_zenoh) would change one file.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,63}")
"""Valid name of a board, arm or reach: one chunk of a key expression, without wildcards."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream. ``stale_after`` in s, None if age does not matter; ``rate`` in Hz, nominal."""

    template: str
    msgtype: str
    rate: float
    published: bool = True
    logged: bool = True
    stale_after: float | None = None
    latched: bool = False  # holds until the next value: repeated in every log file

    def key(self, name: str, prefix: str = "") -> str:
        """Key expression for ``name``. Raises ValueError unless it is a single plain chunk."""
        if not NAME.fullmatch(name):
            raise ValueError(f"{name!r} is not a valid name: letters, digits, _ and -, at most 64")
        key = self.template.format(name=name)
        return f"{prefix}/{key}" if prefix else key

    def channel(self, name: str) -> str:
        """Channel name in a log: the key with the leading slash of a ROS topic."""
        return "/" + self.key(name)


_OWN = "tactile_msgs/msg"

FEATURES = Topic("tactile/{name}/features", f"{_OWN}/ContactFeatures", 100, stale_after=0.2)
FORCES = Topic("tactile/{name}/forces", f"{_OWN}/TaxelForces", 100, stale_after=0.2)
FIELD = Topic("tactile/{name}/field", f"{_OWN}/TaxelField", 100)
AMBIENT = Topic("tactile/{name}/ambient", f"{_OWN}/AmbientField", 100)
GEOMETRY = Topic("tactile/{name}/geometry", f"{_OWN}/SkinGeometry", 0, latched=True)
RAW = Topic("tactile/{name}/raw", f"{_OWN}/RawChunk", 100, published=False)
PORT = Topic("tactile/{name}/port", f"{_OWN}/PortEvent", 8, published=False)
CONTACTS = Topic("tactile/{name}/contacts", "visualization_msgs/msg/MarkerArray", 10)
DIAGNOSTICS = Topic("tactile/{name}/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 1)
LOG = Topic("tactile/{name}/log", "rcl_interfaces/msg/Log", 0)

ARM_STATE = Topic("arm/{name}/state", f"{_OWN}/ArmState", 100, stale_after=0.05)
COMMAND = Topic("arm/{name}/cmd_vel", f"{_OWN}/ArmCommand", 100, stale_after=0.1)
REACH_STATE = Topic("reach/{name}/state", f"{_OWN}/ReachState", 100)
REACH_EVENT = Topic("reach/{name}/event", f"{_OWN}/ReachEvent", 0)
TF = Topic("tf", "tf2_msgs/msg/TFMessage", 25)
REFERENCE = Topic("reference/{name}/wrench", "geometry_msgs/msg/WrenchStamped", 100)
"""Reference force on board ``name`` during calibration, from a load cell, weight or gauge: N that
the environment exerts on the skin, in the axes of the pressed taxels, so that a press has a
negative z. The header's stamp is the time of the measurement."""
WORLD = Topic("world/{name}/objects", "visualization_msgs/msg/MarkerArray", 10)

TOPICS = (
    FEATURES,
    FORCES,
    FIELD,
    AMBIENT,
    GEOMETRY,
    RAW,
    PORT,
    CONTACTS,
    DIAGNOSTICS,
    LOG,
    ARM_STATE,
    COMMAND,
    REACH_STATE,
    REACH_EVENT,
    TF,
    REFERENCE,
    WORLD,
)


def find_topic(key: str) -> tuple[Topic, str] | None:
    """Topic and name from which ``key`` (a key expression or log channel) was built; None if
    unknown.

    A leading slash (log channels) and a replay prefix are ignored. A topic shared by all has its
    own name.
    """
    parts = key.strip("/").split("/")
    for topic in TOPICS:
        template = topic.template.split("/")
        tail = parts[-len(template) :]
        if len(tail) == len(template) and all(
            a == b or b == "{name}" for a, b in zip(tail, template, strict=True)
        ):
            return topic, tail[template.index("{name}") if "{name}" in template else 0]
    return None


def service_key(name: str, service: str, kind: str = "tactile") -> str:
    """Key of a daemon's service.

    ``kind`` tactile: status, tare, set_rate, record, recalibrate, geometry; arm: claim, release,
    limits, clear, status; reach: goal, stop, reset, arm, clear, status.
    """
    return Topic(kind + "/{name}/srv/" + service, "", 0).key(name)


def alive_key(name: str, kind: str = "tactile") -> str:
    """Key of the liveliness token of the publisher for ``name``. For information only."""
    return Topic(kind + "/{name}/alive", "", 0).key(name)


def commander_key(arm: str, reach: str) -> str:
    """Key of the liveliness token of an arm's commander. For information only."""
    return Topic(f"arm/{arm}/commander/{{name}}", "", 0).key(reach)
