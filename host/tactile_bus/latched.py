"""Topics whose last message holds until the next, and their repetition at the start of a file."""

from __future__ import annotations

import re
import zlib
from collections.abc import Hashable, Mapping

from tactile_bus.log_records import Message
from tactile_bus.topics import find_topic

QOS = "offered_qos_profiles"
"""Key of a channel's metadata under which rosbag2 keeps the QoS of its publishers, in YAML."""

LATCHED_QOS = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    "  deadline: {sec: 0, nsec: 0}\n  lifespan: {sec: 0, nsec: 0}\n  liveliness: 0\n"
    "  liveliness_lease_duration: {sec: 0, nsec: 0}\n  avoid_ros_namespace_conventions: false\n"
)
"""That of a latched topic as rosbag2 writes it: keep the last one, reliable, transient local."""

TRANSIENT_LOCAL = re.compile(r"\bdurability['\"]?:\s*['\"]?(?:1\b|transient_local)")

STAYING = ("tf_static", "robot_description")
"""Topics of other programs that are latched whatever their channel says."""


def is_latched(topic: str, metadata: Mapping[str, str]) -> bool:
    """Whether the last message of a channel holds: by its QoS, or because its topic is known."""
    if TRANSIENT_LOCAL.search(metadata.get(QOS, "")) or topic.rpartition("/")[2] in STAYING:
        return True
    found = find_topic(topic)
    return found is not None and found[0].latched


class Repeats:
    """Tells messages that a later file of a log repeats at its start, so that it has what holds.

    Of every latched channel that is the first message of the file, if it is the last one of the
    files before it again: same number, same stamp of its sender, same bytes.
    """

    def __init__(self) -> None:
        self._last: dict[Hashable, tuple[int, int, int]] = {}
        self._begun: set[Hashable] = set()

    def next_file(self) -> None:
        """Another file of the log begins."""
        self._begun.clear()

    def is_repeat(self, channel: Hashable, message: Message) -> bool:
        """Whether a message of a latched channel is one that was there before."""
        told = message.sequence, message.publish_ns, zlib.crc32(message.data)
        if channel in self._begun:
            self._last[channel] = told
            return False
        self._begun.add(channel)
        before = self._last.get(channel)
        self._last[channel] = told
        return before == told
