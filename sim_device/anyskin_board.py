"""A simulated AnySkin, ReSkin or eFlesh board: floats without frame, clock or commands."""

from __future__ import annotations

from collections import deque

import numpy as np

from sensor_proto.anyskin_search import MAX_MAGNETOMETERS
from sensor_proto.packets import FloatSamples, TaxelStatus
from sim_device.chips import Reading, temperature_of_raw
from sim_device.environment import Environment
from sim_device.faults import FaultPlan
from sim_device.faulty_wire import SerialWire
from sim_device.formats import BANNER, REMARK, REMARK_EVERY, SKETCHES, Writer
from sim_device.sampler import Contacts, Sampler, SkinOwner
from sim_device.skin import SkinModel
from tactile_bus.instant import Instant, after, seconds_between

LOOP_RATE = 115.0
"""Hz at which the loop of such firmware reads and sends; it does not ask for fresh data."""

CONVERSION_RATE = 100.0
"""Hz at which the chips convert on their own: about one frame in seven is sent twice."""

MAX_BACKLOG = 32
"""Frames made at once after a pause: what the USB buffer of such a controller holds; more are
lost."""

_DEAD_RAW = (0.0, 65535.0)
"""What a chip that does not answer leaves in the buffer: zeros or an idle bus."""


class AnySkinBoard(SkinOwner):
    """Streams from its first `tick`, hears nothing, and says nothing of failed chip reads."""

    def __init__(
        self,
        skin: SkinModel,
        environment: Environment | None = None,
        contacts: Contacts = (),
        plan: FaultPlan | None = None,
        loop_rate: float = LOOP_RATE,
        conversion_rate: float = CONVERSION_RATE,
        write: Writer | None = None,
        banner: bool = False,
    ) -> None:
        """``write``: how it writes its samples; ``banner``: it prints remarks as well.

        ValueError beyond 20 magnetometers, for rates not above 0, for faults of other boards."""
        if skin.geometry.taxels > MAX_MAGNETOMETERS:
            raise ValueError(f"{skin.geometry.taxels} magnetometers: 1 to {MAX_MAGNETOMETERS}")
        if not (loop_rate > 0 and conversion_rate > 0):
            raise ValueError(f"rates {loop_rate}, {conversion_rate} Hz: both must be above 0")
        plan = plan or FaultPlan()
        if plan.reset:
            raise ValueError("reset is not seen from outside on a board without sequence or clock")
        super().__init__(Sampler(skin, environment or Environment(), contacts, plan))
        self._wire = SerialWire(plan, delimited=False)
        self._rng = np.random.default_rng([plan.seed, 2])
        self._write = write or SKETCHES["anyskin"]
        self._banner = banner
        self._loop = 1.0 / loop_rate
        self._conversion = 1.0 / conversion_rate
        self._power_on: Instant | None = None
        self._frames = 0
        self._conversions = 0
        self._reading: Reading | None = None
        self._overruns = 0
        self._duplicates = 0

    @property
    def counters(self) -> dict[str, int]:
        """Everything counted since power-on; ``repeated`` frames hold no new conversion."""
        return {
            "overruns": self._overruns,
            "repeated": self._duplicates,
            **self._sampler.fault_counters,
            **self._wire.counters,
        }

    def receive(self, data: bytes, now: Instant) -> None:
        """Nothing: such firmware does not read its port."""

    def tick(self, now: Instant) -> bytes:
        """Bytes for the host up to ``now``."""
        if self._power_on is None:
            self._power_on = now
        start = self._power_on
        due = int(seconds_between(start, now) / self._loop)
        if due < self._frames - 1:
            raise ValueError("time went back")
        skipped = due + 1 - self._frames - MAX_BACKLOG
        if skipped > 0:
            self._overruns += skipped
            self._frames += skipped
        frames: deque[bytes] = deque()
        if self._banner and not self._frames:
            frames.append(BANNER)
        while self._frames <= due:
            frames.append(self._frame(start, self._frames * self._loop))
            self._frames += 1
        return b"".join(self._wire.pass_on(frames, seconds_between(start, now)))

    def _frame(self, start: Instant, seconds: float) -> bytes:
        """What the loop of a board powered at ``start`` sends ``seconds`` later."""
        converted = int(seconds / self._conversion) + 1
        if self._reading is None or converted > self._conversions:
            self._conversions = converted
            ended = (converted - 1) * self._conversion
            self._reading = self._sampler.read(after(start, ended), ended)
        else:
            self._duplicates += 1
        written = self._write(self._floats(self._reading), self._frames)
        remark = self._banner and self._frames % REMARK_EVERY == REMARK_EVERY - 1
        return written + REMARK if remark else written

    def _floats(self, reading: Reading) -> FloatSamples:
        lsb = self._sampler.skin.chips.lsb_ut
        field = reading.counts * lsb
        temperature = reading.temperature_c.copy()
        failed = np.flatnonzero(reading.status & TaxelStatus.READ_FAILED)
        if len(failed):
            raw = self._rng.choice(_DEAD_RAW, len(failed))
            temperature[failed] = temperature_of_raw(raw)
            field[failed] = np.where(raw > 0, -1.0, 0.0)[:, None] * lsb[failed]
        if reading.infinite is not None:
            field[reading.infinite] = np.inf, -np.inf, np.nan
        return FloatSamples(
            field.astype(np.float32), temperature.astype(np.float32), reading.status
        )
