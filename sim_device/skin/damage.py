"""Faults of a plan that alter readings: broken chips, and changes of the whole skin."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sensor_proto.packets import TaxelStatus
from sim_device.faults import ALL_TAXELS, FaultPlan, TaxelFault, TaxelFaultKind, Window
from sim_device.skin.chips import COUNT_MAX, Reading
from sim_device.skin.environment import Surroundings
from sim_device.skin.skin import SkinModel

_NO_ANSWER = -1
"""Count of a chip that does not answer: an idle I2C bus reads all ones."""

_COUNTS = 1 << 16
JUMP = 24_000
"""Counts by which a chip jumps, wrapping at the end of its range."""
WRAP_ROOM = 2000
"""Counts that remain to the end of the range of a chip that is to wrap under a press."""
HOT_C = 99.0
"""°C that a broken thermometer shows: a value the chip can send, but too hot to be true."""
KEPT = 40
"""Readings kept by a board that sends old frames; it sends the oldest."""
COPY_EVERY = 3
"""One frame in so many is an old one."""


class BrokenTaxels:
    """Applies the taxel faults of ``plan`` to the readings of a board.

    ``taxels``: number of taxels of each array, by name. ValueError for faults of taxels that do
    not exist.
    """

    def __init__(self, plan: FaultPlan, taxels: Mapping[str, int]) -> None:
        self._faults = [(fault, _indices(fault, taxels)) for fault in plan.taxels]
        self._copy = plan.copy
        self._rng = np.random.default_rng([plan.seed, 3])
        self._held: dict[int, NDArray[np.int16]] = {}
        self._shift: dict[int, int] = {}
        self._kept: deque[Reading] = deque(maxlen=KEPT)
        self._readings = 0
        self._count: Counter[str] = Counter()

    @property
    def counters(self) -> dict[str, int]:
        """Readings altered so far, by fault."""
        return {kind.value: self._count[kind] for kind in TaxelFaultKind} | {
            "copy": self._count["copy"]
        }

    def apply(self, reading: Reading, seconds: float) -> Reading:
        """``reading`` as the broken chips give it ``seconds`` s after power-on."""
        self._readings += 1
        active = [f for f in self._faults if f[0].window.covers(seconds)]
        if active:
            reading = self._broken(reading, active)
        elif self._held or self._shift:
            self._held.clear()
            self._shift.clear()
        if self._copy:
            reading = self._copied(reading, seconds, self._copy)
        return reading

    def _broken(self, reading: Reading, active: list[tuple[TaxelFault, range]]) -> Reading:
        counts, status = reading.counts.copy(), reading.status.copy()
        temperature = reading.temperature_c.copy()
        infinite = np.zeros(len(counts), bool)
        for fault, taxels in active:
            for taxel in taxels:
                if fault.share < 1 and self._rng.random() >= fault.share:
                    continue
                self._count[fault.kind] += 1
                self._break(fault.kind, taxel, reading, counts, status, temperature, infinite)
        return Reading(counts, status, temperature, infinite if infinite.any() else None)

    def _break(
        self,
        kind: TaxelFaultKind,
        taxel: int,
        reading: Reading,
        counts: NDArray[np.int16],
        status: NDArray[np.uint8],
        temperature: NDArray[np.float64],
        infinite: NDArray[np.bool_],
    ) -> None:
        own = reading.counts[taxel]
        match kind:
            case TaxelFaultKind.STUCK:
                counts[taxel] = self._held.setdefault(taxel, own.copy())
            case TaxelFaultKind.DITHER:
                held = self._held.setdefault(taxel, own.copy())
                counts[taxel] = held + self._rng.integers(0, 2, 3)
            case TaxelFaultKind.SATURATED:
                counts[taxel] = np.where(own < 0, -COUNT_MAX - 1, COUNT_MAX)
                status[taxel] |= TaxelStatus.SATURATED
            case TaxelFaultKind.RAIL:
                counts[taxel, 2] = -COUNT_MAX - 1 if own[2] < 0 else COUNT_MAX
            case TaxelFaultKind.FAILED:
                counts[taxel] = _NO_ANSWER
                status[taxel] |= TaxelStatus.READ_FAILED
            case TaxelFaultKind.ZEROS:
                counts[taxel] = 0
                temperature[taxel] = 0.0
            case TaxelFaultKind.ONES:
                counts[taxel] = _NO_ANSWER
            case TaxelFaultKind.WRAP:
                end = -COUNT_MAX + WRAP_ROOM if own[2] < 0 else COUNT_MAX - WRAP_ROOM
                shift = self._shift.setdefault(taxel, end - int(own[2]))
                counts[taxel, 2] = _wrapped(int(own[2]) + shift)
            case TaxelFaultKind.JUMP:
                for axis in range(3):
                    counts[taxel, axis] = _wrapped(int(own[axis]) + JUMP)
            case TaxelFaultKind.TWIN:
                counts[taxel] = reading.counts[taxel - 1 if taxel else 1 % len(counts)]
            case TaxelFaultKind.HOT:
                temperature[taxel] = HOT_C
            case TaxelFaultKind.LOOSE:
                pass  # a fault of the skin, not of the chip: see `SkinChanges`
            case TaxelFaultKind.INFINITE:
                infinite[taxel] = True

    def _copied(self, reading: Reading, seconds: float, windows: tuple[Window, ...]) -> Reading:
        """``reading``, or now and then an old one while one of ``windows`` lasts."""
        old = self._kept[0] if len(self._kept) == KEPT else None
        self._kept.append(reading)
        due = self._readings % COPY_EVERY == 0 and any(w.covers(seconds) for w in windows)
        if old is None or not due:
            return reading
        self._count["copy"] += 1
        return old


def _wrapped(count: int) -> int:
    """``count`` wrapped to 16 bits."""
    return (count + _COUNTS // 2) % _COUNTS - _COUNTS // 2


def _indices(fault: TaxelFault, taxels: Mapping[str, int]) -> range:
    """Indices of the broken taxels among all taxels of the board."""
    first = 0
    which = "*" if fault.taxel == ALL_TAXELS else str(fault.taxel)
    called = f"fault {fault.kind}={fault.array}:{which}"
    for name, count in taxels.items():
        if name == fault.array:
            if fault.taxel == ALL_TAXELS:
                return range(first, first + count)
            if fault.taxel >= count:
                raise ValueError(f"{called}: array {name!r} has taxels 0 to {count - 1}")
            return range(first + fault.taxel, first + fault.taxel + 1)
        first += count
    names = ", ".join(repr(name) for name in taxels)
    raise ValueError(f"{called}: there is no array {fault.array!r}; allowed: {names}")


# Faults of a whole skin: lifted off, exchanged, a magnet lost, gain changed, a magnet near.


OTHER_SKIN = 0.2
"""Largest relative difference of another skin's magnets from this one's."""
LEAP_DIRECTION = np.array([0.6, -0.4, 0.693])
"""Direction of a field that leaps: unit vector in world axes."""


class SkinChanges:
    """Applies the changes of ``plan`` to ``skin`` and to its readings.

    ``taxels``: number of taxels of each array, by name. ValueError for magnets that do not exist.
    """

    def __init__(self, plan: FaultPlan, skin: SkinModel, taxels: Mapping[str, int]) -> None:
        self._plan, self._skin = plan, skin
        n = skin.geometry.taxels
        first, starts = 0, {}
        for name, count in taxels.items():
            starts[name] = (first, count)
            first += count
        self._loose = []
        for fault in plan.taxels:
            if fault.kind is not TaxelFaultKind.LOOSE:
                continue
            start, count = starts.get(fault.array, (0, 0))
            chosen = range(count) if fault.taxel == ALL_TAXELS else (fault.taxel,)
            if not all(0 <= taxel < count for taxel in chosen):
                raise ValueError(f"there is no taxel {fault.array}:{fault.taxel}")
            self._loose.append((fault.window, [start + taxel for taxel in chosen]))
        rng = np.random.default_rng([plan.seed, 11])
        self._other = 1.0 + rng.uniform(-OTHER_SKIN, OTHER_SKIN, n)
        self._scale = np.ones(n)

    def surround(self, seconds: float, surroundings: Surroundings) -> Surroundings:
        """Set the magnets as at ``seconds`` s after power-on and return the surroundings then."""
        plan = self._plan
        if plan.newskin or self._loose or plan.skinoff:
            self._set_magnets(seconds)
        leap = sum(size for size, window in plan.leap if window.covers(seconds))
        if not leap:
            return surroundings
        field = surroundings.world_field_ut + leap * LEAP_DIRECTION
        return replace(surroundings, world_field_ut=field)

    def _set_magnets(self, seconds: float) -> None:
        plan = self._plan
        scale = np.ones(len(self._scale))
        if any(window.covers(seconds) for window in plan.newskin):
            scale = self._other.copy()
        for window, magnets in self._loose:
            if window.covers(seconds):
                scale[magnets] = 0.0
        if any(window.covers(seconds) for window in plan.skinoff):
            scale[:] = 0.0
        if not np.array_equal(scale, self._scale):
            self._scale = scale
            self._skin.magnets.scale(scale)

    def amplify(self, seconds: float, reading: Reading) -> Reading:
        """``reading`` with the gain that its chips have ``seconds`` s after power-on."""
        gain = 1.0
        for factor, window in self._plan.gain:
            gain *= factor if window.covers(seconds) else 1.0
        if gain == 1.0:
            return reading
        counts = np.clip(np.round(reading.counts * gain), -COUNT_MAX - 1, COUNT_MAX)
        return replace(reading, counts=counts.astype(np.int16))
