"""Example messages, bus sessions, and recorders on a disk that fails on demand."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_core.bus import topics
from tactile_core.bus.markers import CYLINDER, SPHERE_LIST, frame_transform, marker, wipe
from tactile_core.bus.messages import MSG, codec, diagnostic_status, header, log_message
from tactile_core.bus.session import BusConfig, close_session, open_session
from tactile_core.log.info import LogInfo, info
from tactile_core.log.reader import read_messages
from tactile_core.log.recorder import Recorder, RecorderSettings
from tests.support.fragile_disk import FragileDisk

WALL_NS = 1_700_000_000_123_456_789


def example_messages() -> dict[topics.Topic, Any]:
    """One message of every topic, with values that distinguish the fields."""
    head = header(WALL_NS, "ee")
    vector, point = MSG.Vector3(0.5, -1.5, 2.25), MSG.Point(0.125, 0.25, -0.5)
    twist, wrench = MSG.Twist(vector, vector), MSG.Wrench(vector, vector)
    f32, u8, u16 = np.float32, np.uint8, np.uint16
    return {
        topics.FEATURES: MSG.ContactFeatures(
            head, 11, 12, 0.5, 7, True, ["tare", "few taxels"], True, 1.5, 2, point, 3.5,
            MSG.Wrench(vector, vector), 0.75, 0.25, 3, 4,
            [MSG.ContactPatch(1, 2, 3, 1.5, 0.5, vector, point, vector, 0.5)],
            ["taring", "few:tip"], 0.5, 0.25, 0.125,
        ),
        topics.FORCES: MSG.TaxelForces(
            head, 11, 12, 0.5, 7, np.array([2, 1], u16), np.arange(9, dtype=f32),
            np.array([0, 1, 32], u8), True, False, np.array([0.5, 0.25, 1.0], f32),
        ),
        topics.FIELD: MSG.TaxelField(
            head, 11, 12, 7, np.array([1], u16), np.array([1, 2, 3], f32), np.array([25.5], f32)
        ),
        topics.AMBIENT: MSG.AmbientField(
            head, 11, 7, "consensus", np.arange(9, dtype=f32), np.ones(1, f32),
            np.zeros(1, f32), np.full(1, 0.5, f32), np.array([True]),
        ),
        topics.GEOMETRY: MSG.SkinGeometry(
            head, "0011223344556677", "finger", ["left"], np.array([1], u8), np.array([1], u16),
            np.array([1], u16), np.arange(3, dtype=f32), np.arange(3, dtype=f32),
            np.arange(2, dtype=f32), np.array([True]),
        ),
        topics.RAW: MSG.RawChunk(
            head, 12, 1, np.array([0x1234], np.uint32), np.array([3], u8), np.array([1, 2, 3], u8)
        ),
        topics.PORT: MSG.PortEvent(
            header(WALL_NS, "/dev/ttyACM0"), 12, 11, "set_rate", 3, 0, 100.5, "grüße"
        ),
        topics.CONTACTS: MSG.MarkerArray(
            [
                wipe(WALL_NS, "ee"),
                marker(
                    WALL_NS, "ee", "taxels", 1, SPHERE_LIST, (0.0, 0.0, 0.0, 0.0),
                    (0.5, 0.5, 0.5), (0.25, 0.5, 0.75, 1.0), points=[(0.5, 0.25, 0.125)],
                    colours=[(0.25, 0.5, 0.75, 1.0)], text="1 N",
                ),
            ]
        ),
        topics.TF: frame_transform(WALL_NS, "cupboard", "ee", (0.5, 0.25, 0.0, 1.0)),
        topics.DIAGNOSTICS: MSG.DiagnosticArray(
            header(WALL_NS, ""), [diagnostic_status("b0", 1, "ok", "0011", {"drops.crc": 5})]
        ),
        topics.LOG: log_message(WALL_NS, 30, "b0", "grüße"),
        topics.ARM_STATE: MSG.ArmState(
            header(WALL_NS, "cupboard"), 1, 2, 0.1, -0.2, 0.3, twist, wrench,
            "moving", 0.05, 0.35, 10.0, 1.5, "reach-1", 7, 1,
        ),
        topics.REFERENCE: MSG.WrenchStamped(head, wrench),
        topics.COMMAND: MSG.ArmCommand(
            header(WALL_NS, "cupboard"), twist, 1, 2, 0.0625, "reach-1",
            np.arange(16, dtype=np.uint8),
        ),
        topics.REACH_STATE: MSG.ReachState(
            header(WALL_NS, "cupboard"), 1, 2, "reaching", "burrow", "hybrid_event",
            MSG.Point(0.358, 0.03, 0.0), 0.0075, 0.2, 3.5, twist, twist, True, "",
            ["wrench"], 0.25, 0.125, 0.0625,
        ),
        topics.REACH_EVENT: MSG.ReachEvent(
            header(WALL_NS, ""), 1, "excavation", "ccw", "push at the tip"
        ),
        topics.WORLD: MSG.MarkerArray(
            [
                marker(
                    WALL_NS, "cupboard", "objects", 3, CYLINDER,
                    (0.1, 0.2, 0.06, 0.5), (0.08, 0.08, 0.12), (0.25, 0.5, 0.75, 1.0),
                )
            ]
        ),
    }  # fmt: skip


@pytest.fixture(scope="session")
def messages() -> dict[topics.Topic, Any]:
    return example_messages()


@pytest.fixture(scope="session")
def payloads(messages: dict[topics.Topic, Any]) -> dict[topics.Topic, bytes]:
    return {topic: codec().encode(topic, message) for topic, message in messages.items()}


@pytest.fixture
def bus() -> Iterator[Callable[..., Any]]:
    """``bus(listen=port)``, ``bus(connect=port)``: sessions, closed after the test."""
    sessions = []

    def join(listen: int | None = None, connect: int | None = None) -> Any:
        config = BusConfig(
            listen=() if listen is None else (f"tcp/127.0.0.1:{listen}",),
            connect=() if connect is None else (f"tcp/127.0.0.1:{connect}",),
        )
        sessions.append(open_session(config))
        return sessions[-1]

    yield join
    for session in sessions:
        close_session(session)


@pytest.fixture
def disk() -> FragileDisk:
    return FragileDisk()


@pytest.fixture
def record(disk: FragileDisk) -> Iterator[Callable[..., Recorder]]:
    """``record(path, **settings)``: a recorder on ``disk`` with quick flushes."""
    recorders = []

    def start(path: Path, **settings: Any) -> Recorder:
        quick = {"flush_period": 0.05, "retry_seconds": 0.05, "min_free_bytes": 0} | settings
        recorders.append(Recorder(path, RecorderSettings(**quick), storage=disk))
        return recorders[-1]

    yield start
    disk.room = None
    disk.free_bytes = 1 << 40
    disk.moving.set()
    for recorder in recorders:
        recorder.close(5)


@pytest.fixture(scope="session")
def logs() -> Callable[[Path], list[LogInfo]]:
    """``logs(directory)``: content of each log in it, by name."""

    def read(directory: Path) -> list[LogInfo]:
        return [info(path) for path in sorted(directory.glob("*.mcap"))]

    return read


@pytest.fixture(scope="session")
def sequences() -> Callable[[Path], dict[str, list[int]]]:
    """Sequence numbers in all logs of a directory by channel, without repetitions."""

    def read(directory: Path) -> dict[str, list[int]]:
        found = defaultdict(list)
        for path in sorted(directory.glob("*.mcap")):
            for channel, message in read_messages(path):
                if message.sequence not in found[channel.topic]:
                    found[channel.topic].append(message.sequence)
        return found

    return read
