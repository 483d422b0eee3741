"""Turn cycles and events into ROS 2 messages, and send those to the bus and into the log."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
import zenoh

from tactile_core.bus.messages import MSG, codec, header, log_message
from tactile_core.bus.streams import Publisher, declare_publisher
from tactile_core.bus.topics import LOG, RAW, Topic
from tactile_core.calibration import BoardCalibration
from tactile_core.log.recorder import Recorder
from tactile_core.throttle import Throttle
from tactile_core.types import Instant, WallClock, monotonic_now
from tactiled.blocks import Chunk, Cycle, Patch
from tactiled.transports.recorded_log import to_raw

RAW_PART = 32_768
"""Most bytes of serial data in one RawChunk: with its header below the 64 KiB of a message."""


MAX_PATCHES = 512
"""Most patches in one message of features, 64 B each; if there are more, the strongest are sent."""

MAX_WITH_SURFACE = 2000
"""Most taxels whose geometry fits whole into one message, 32 B each. The largest board of
PROTOCOL.md has 2048; its unrolled skin, which is for pictures, is left out."""


class MessageMaker:
    """Makes the messages of one board. Pure: no bus and no log.

    ``patches_cut``: patches left out of messages of features so far. ``whole``: whether messages
    of geometry include the unrolled skin.
    """

    def __init__(self, calibration: BoardCalibration, wall: WallClock) -> None:
        self._wall = wall
        self._calibration = calibration
        self._frame = calibration.frame
        taxels = [a.geometry.taxels for a in calibration.arrays]
        self._array_taxels = np.array(taxels, np.uint16)
        self.patches_cut = 0
        self.whole = sum(taxels) <= MAX_WITH_SURFACE

    def features(self, cycle: Cycle) -> Any:
        """``ContactFeatures``."""
        f = cycle.features
        force, moment = f.wrench[:3].tolist(), f.wrench[3:].tolist()
        return MSG.ContactFeatures(
            header=self._header(cycle),
            captured_ns=cycle.captured,
            received_ns=cycle.received,
            uncertainty=cycle.uncertainty,
            sequence=cycle.sequence,
            valid=f.valid,
            reasons=[reason.text for reason in f.reasons],
            reason_codes=[reason.code for reason in f.reasons],
            calibrated=cycle.calibrated,
            peak_force=f.peak_force,
            peak_side=int(f.peak_side),
            peak_position=MSG.Point(*f.peak_position.tolist()),
            normal_force=f.normal_force,
            wrench=MSG.Wrench(MSG.Vector3(*force), MSG.Vector3(*moment)),
            tip_force=f.tip_force,
            tip_contact_time=f.tip_contact_time,
            taxels_in_contact=f.taxels_in_contact,
            taxels_masked=f.taxels_masked,
            patches=[_patch(p) for p in self._strongest(f.patches)],
            peak_force_bound=f.peak_force_bound,
            normal_force_bound=f.normal_force_bound,
            tip_force_bound=f.tip_force_bound,
        )

    def forces(self, cycle: Cycle) -> Any:
        """``TaxelForces``."""
        ambient = cycle.ambient
        return MSG.TaxelForces(
            header=self._header(cycle),
            captured_ns=cycle.captured,
            received_ns=cycle.received,
            uncertainty=cycle.uncertainty,
            sequence=cycle.sequence,
            array_taxels=self._array_taxels,
            force=_flat(cycle.force),
            normal_bound=_flat(cycle.normal_bound),
            status=cycle.health,
            compensated=ambient.method != "off" and bool(ambient.valid.all()),
            calibrated=cycle.calibrated,
        )

    def field(self, cycle: Cycle) -> Any:
        """``TaxelField``."""
        return MSG.TaxelField(
            header=self._header(cycle),
            captured_ns=cycle.captured,
            received_ns=cycle.received,
            sequence=cycle.sequence,
            array_taxels=self._array_taxels,
            field_ut=_flat(cycle.field_ut),
            temperature_c=_flat(cycle.temperature_c),
        )

    def ambient(self, cycle: Cycle) -> Any:
        """``AmbientField``."""
        a = cycle.ambient
        return MSG.AmbientField(
            header=self._header(cycle),
            captured_ns=cycle.captured,
            sequence=cycle.sequence,
            method=a.method,
            plane=_flat(a.plane),
            support=_flat(a.support),
            residual_ut=_flat(a.residual_ut),
            age=_flat(a.age),
            valid=np.asarray(a.valid, np.bool_),
        )

    def geometry(self, wall_ns: int) -> Any:
        """``SkinGeometry``."""
        c = self._calibration
        arrays = [a.geometry for a in c.arrays]
        return MSG.SkinGeometry(
            header=header(wall_ns, self._frame),
            serial_number=c.serial_number,
            model=c.model,
            array_name=[a.name for a in arrays],
            array_side=np.array([int(a.side) for a in arrays], np.uint8),
            array_rows=np.array([a.rows for a in arrays], np.uint16),
            array_columns=np.array([a.columns for a in arrays], np.uint16),
            position=_flat(np.concatenate([a.position for a in arrays])),
            normal=_flat(np.concatenate([a.rotation[:, :, 2] for a in arrays])),
            surface=_flat(np.concatenate([a.surface for a in arrays]) if self.whole else ()),
            array_posed=np.array([a.posed for a in arrays], np.bool_),
        )

    def _strongest(self, patches: tuple[Patch, ...]) -> tuple[Patch, ...]:
        """The patches to send, in their order; counts the others."""
        self.patches_cut += max(0, len(patches) - MAX_PATCHES)
        return strongest(patches, MAX_PATCHES)

    def _header(self, cycle: Cycle) -> Any:
        return header(self._wall.wall_ns(cycle.captured), self._frame)


def strongest(patches: tuple[Patch, ...], count: int) -> tuple[Patch, ...]:
    """The ``count`` patches of most normal force, in their order."""
    if len(patches) <= count:
        return patches
    ordered = sorted(range(len(patches)), key=lambda i: -patches[i].normal_force)
    return tuple(patches[i] for i in sorted(ordered[:count]))


def split(chunk: Chunk) -> Iterable[Chunk]:
    """Split a chunk into parts that each fit into one message."""
    payload = chunk.payload
    if not isinstance(payload, bytes) or len(payload) <= RAW_PART:
        return (chunk,)
    cuts = range(0, len(payload), RAW_PART)
    return tuple(Chunk(chunk.received, payload[at : at + RAW_PART]) for at in cuts)


def _patch(patch: Patch) -> Any:
    return MSG.ContactPatch(
        array=patch.array,
        side=int(patch.side),
        taxels=patch.taxels,
        normal_force=patch.normal_force,
        peak_force=patch.peak_force,
        force=MSG.Vector3(*patch.force.tolist()),
        centroid=MSG.Point(*patch.centroid.tolist()),
        normal=MSG.Vector3(*patch.normal.tolist()),
        normal_force_bound=patch.bound,
    )


def _flat(values: Any) -> Any:
    return np.ascontiguousarray(values, np.float32).ravel()


# Messages leave the daemon here: encoded once, the same bytes to the bus and into the log.


log = logging.getLogger(__name__)

NODE = "tactiled"
"""Name of this program in ``rcl_interfaces/Log``."""


class Sink(Protocol):
    """Where a board's messages go: bus and log, or only the log of a rerun."""

    wall: WallClock
    recorder: Recorder | None

    def now(self) -> Instant:
        """Present instant of the clock that stamps the messages."""

    def send(self, topic: Topic, name: str, message: Any, stamp_ns: int) -> None:
        """Encode and send; ``stamp_ns``: wall-clock time that the message stands for."""

    def announce(self, name: str, level: int, text: str, at: Instant | None = None) -> None:
        """Say something of a board: to people, on the bus and into the log."""

    def firmware_text(
        self, name: str, level: int, speaker: str, text: str, at: Instant | None = None
    ) -> None:
        """``rcl_interfaces/Log`` on the bus and into the log alone."""


class MessagePublisher:
    """Sends messages to the bus and into the log. ``recorder`` None: nothing is logged.

    After `end` nothing is published, whichever thread asks for it. ``late`` counts messages that
    came after it, ``refused`` those that the bus did not take.
    """

    def __init__(
        self,
        session: zenoh.Session,
        recorder: Recorder | None,
        wall: WallClock,
        prefix: str = "",
    ) -> None:
        self.wall = wall
        self.recorder = recorder
        self.recording: Recorder | None = None
        """A second log, of what is published, while one has been asked for."""
        self.late = 0
        self.refused = 0
        self._ended = False
        self._publishing = threading.Lock()
        self._complaints = Throttle(rate=0.1, burst=1)
        self._session = session
        self._prefix = prefix
        self._codec = codec()
        self._publishers: dict[tuple[str, str], Publisher] = {}

    def now(self) -> Instant:
        """Present instant."""
        return monotonic_now()

    def send(self, topic: Topic, name: str, message: Any, stamp_ns: int) -> None:
        """Encode and send. ``stamp_ns``: wall-clock time that the message stands for.

        Raises ValueError or TypeError only for a message that cannot be encoded.
        """
        data = self._codec.encode(topic, message)
        recorder, recording = self.recorder, None
        if topic.published:
            self._publish(topic, name, data, stamp_ns)
            recording = self.recording
        if topic.logged and (recorder is not None or recording is not None):
            now_ns = self.wall.wall_ns(monotonic_now())
            for log_of in (recorder, recording):
                if log_of is not None:
                    log_of.write(topic, name, data, now_ns, stamp_ns)

    def raw(self, name: str, port: str, chunk: Chunk) -> None:
        """Log a chunk; called from the reader's thread."""
        if self.recorder is None:
            return
        stamp_ns = self.wall.wall_ns(chunk.received)
        for part in split(chunk):
            data = self._codec.encode(RAW, to_raw(part, port, self.wall))
            self.recorder.write(RAW, name, data, stamp_ns, stamp_ns)

    def announce(self, name: str, level: int, text: str, at: Instant | None = None) -> None:
        """Say something of a board: to people, on the bus and into the log."""
        log.log(level, "%s: %s", name, text)
        self.firmware_text(name, level, NODE, text, at)

    def firmware_text(
        self, name: str, level: int, speaker: str, text: str, at: Instant | None = None
    ) -> None:
        """``rcl_interfaces/Log`` on the bus and into the log alone."""
        stamp_ns = self.wall.wall_ns(monotonic_now() if at is None else at)
        self.send(LOG, name, log_message(stamp_ns, level, speaker, text), stamp_ns)

    def end(self) -> None:
        """Publish nothing from now on; waits for a message that is just being published."""
        with self._publishing:
            self._ended = True

    def close(self) -> None:
        """Undeclare all publishers."""
        self.end()
        for publisher in self._publishers.values():
            with suppress(zenoh.ZError):  # the session has closed by itself
                publisher.close()
        self._publishers.clear()

    def _publish(self, topic: Topic, name: str, data: bytes, stamp_ns: int) -> None:
        with self._publishing:
            if self._ended:
                self.late += 1
                return
            try:
                publisher = self._publishers.get((topic.template, name))
                if publisher is None:
                    publisher = declare_publisher(self._session, topic, name, self._prefix)
                    self._publishers[topic.template, name] = publisher
                publisher.put(data, stamp_ns)
            except zenoh.ZError as error:
                self.refused += 1
                if self._complaints.allow(self.now()):
                    log.error(
                        "the bus refused %d messages; the log has them: %s", self.refused, error
                    )
