"""Simulated AnySkin, ReSkin or eFlesh board: sends floats; has no frame, clock or commands."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from sensor_proto.anyskin import MAX_MAGNETOMETERS, encode_anyskin
from sensor_proto.layouts import FORM, Layout
from sensor_proto.packets import FloatSamples, TaxelStatus
from sim_device.board.wire import SerialWire
from sim_device.faults import FaultPlan
from sim_device.skin.chips import Reading, temperature_of_raw
from sim_device.skin.environment import Environment
from sim_device.skin.sampler import Contacts, Sampler, SkinOwner
from sim_device.skin.skin import SkinModel
from tactile_core.types import Instant, after, seconds_between

# How simulated AnySkin boards write their samples: as published sketches do, or by a layout.


Writer = Callable[[FloatSamples, int], bytes]
"""Makes the bytes of one frame from samples and the frame's number."""

BANNER = (
    b"I2C scan complete.\r\nFound MLX candidates: 0xC 0xD 0xE 0xF 0x10 \r\n"
    b"Init MLX[0] @0xC status=0\r\nStreaming order: 0xC 0xD 0xE 0xF 0x10 \r\n"
)
"""What firmware prints before its frames; `REMARK` is printed now and then between them."""

REMARK = b"loop time 8123 us, errors 0\r\n"
REMARK_EVERY = 50
"""Frames from one remark to the next."""


def writer_of(name: str, chips: int) -> Writer:
    """Writer by the name of a sketch or by a layout; ValueError lists the names."""
    if name in SKETCHES:
        return SKETCHES[name]
    if ":" not in name:
        raise ValueError(
            f"format {name!r} given; allowed: {', '.join(SKETCHES)}, or a layout: {FORM}"
        )
    layout = Layout.parse(name)
    if layout.chips != chips:
        raise ValueError(f"format {name!r} is of {layout.chips} chips, the board has {chips}")
    return layout.encode


def _rows(samples: FloatSamples) -> list[tuple[float, float, float, float]]:
    """(t, x, y, z) of each chip, °C and µT."""
    values = np.column_stack([samples.temperature_c, samples.field_ut]).tolist()
    return [(t, x, y, z) for t, x, y, z in values]


def _anyskin(samples: FloatSamples, number: int) -> bytes:
    del number
    return encode_anyskin(samples)


def _anyskin_text(samples: FloatSamples, number: int) -> bytes:
    """As that sketch does: no separator between the last number of a chip and the next chip."""
    del number
    return b"".join(b"%.2f\t%.2f\t%.2f\t%.2f" % row for row in _rows(samples)) + b"\r\n"


def _reskin_text(samples: FloatSamples, number: int) -> bytes:
    del number
    return (
        b"".join(b"%.2f\t%.2f\t%.2f\t%.2f\t" % (x, y, z, t) for t, x, y, z in _rows(samples))
        + b"\r\n"
    )


def _eflesh_text(samples: FloatSamples, number: int) -> bytes:
    del number
    chips = (
        b"%d:%.6f:%.6f:%.6f:%.6f" % (i, x, y, z, t) for i, (t, x, y, z) in enumerate(_rows(samples))
    )
    return b"\t".join(chips) + b"\r\n"


def _touch_text(samples: FloatSamples, number: int) -> bytes:
    del number
    chips = [
        b"[S%d:ERR] " % (i + 1)
        if samples.status[i] & TaxelStatus.READ_FAILED
        else b"[S%d:%.1f,%.1f,%.1f] " % (i + 1, x, y, z)
        for i, (_, x, y, z) in enumerate(_rows(samples))
    ]
    return b"FRAME: " + b"".join(chips) + b"\r\n"


def _labels_text(samples: FloatSamples, number: int) -> bytes:
    del number
    chips = (
        b"X%d: %.2f\tY%d: %.2f\tZ%d: %.2f" % (i, x, i, y, i, z)
        for i, (_, x, y, z) in enumerate(_rows(samples))
    )
    return b"\t".join(chips) + b"\r\n"


def _adafruit_text(samples: FloatSamples, number: int) -> bytes:
    """A line for each axis; only the first chip."""
    del number
    _, x, y, z = _rows(samples)[0]
    return b"X: %.4f uT\r\nY: %.4f uT\r\nZ: %.4f uT\r\n" % (x, y, z)


SKETCHES: dict[str, Writer] = {
    "anyskin": _anyskin,
    "anyskin-text": _anyskin_text,
    "reskin-text": _reskin_text,
    "eflesh-text": _eflesh_text,
    "touch-text": _touch_text,
    "labels-text": _labels_text,
    "adafruit-text": _adafruit_text,
}
"""Output formats: ``anyskin`` is the usual one; the others follow what public firmware prints."""


LOOP_RATE_HZ = 115.0
"""Hz at which the loop of such firmware reads and sends, whether or not there is new data."""

CONVERSION_RATE_HZ = 100.0
"""Hz at which the chips convert on their own: about one frame in seven is sent twice."""

MAX_BACKLOG = 32
"""Most frames made at once after a pause: what the USB buffer of such a controller holds. More are
lost."""

_DEAD_RAW = (0.0, 65535.0)
"""What a chip that does not answer leaves in the buffer: zeros or an idle bus."""


class AnySkinBoard(SkinOwner):
    """Streams from its first `tick`, takes no commands, and does not report failed chip reads."""

    def __init__(
        self,
        skin: SkinModel,
        environment: Environment | None = None,
        contacts: Contacts = (),
        plan: FaultPlan | None = None,
        loop_rate: float = LOOP_RATE_HZ,
        conversion_rate: float = CONVERSION_RATE_HZ,
        write: Writer | None = None,
        banner: bool = False,
    ) -> None:
        """``write``: how it writes its samples; ``banner``: whether it also prints remarks.

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
        """Ignore the data: such firmware does not read its port."""

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
        """Frame that a board powered at ``start`` sends ``seconds`` s later."""
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
