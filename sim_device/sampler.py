"""The sensing half of a board: its skin in its surroundings, with the taxels that a plan breaks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sensor_proto.packets import TaxelStatus
from sim_device.chips import COUNT_MAX, Reading
from sim_device.environment import Environment
from sim_device.faults import FaultPlan, TaxelFault, TaxelFaultKind
from sim_device.skin import Contact, SkinModel
from tactile_bus.geometry import SkinGeometry
from tactile_bus.instant import Instant

Float = NDArray[np.float64]
Contacts = Sequence[Contact] | Callable[[float], Sequence[Contact]]
Attitude = Float | Callable[[float], Float] | None

_NO_ANSWER = -1
"""Count of a chip that does not answer: an I2C bus left alone reads all ones."""


class Sampler:
    """Reads a skin in its surroundings.

    ``contacts`` and ``attitude`` may be set at any time, as values or as functions of the seconds
    since power-on; no attitude means the environment's script.
    """

    def __init__(
        self,
        skin: SkinModel,
        environment: Environment,
        contacts: Contacts = (),
        plan: FaultPlan | None = None,
    ) -> None:
        """ValueError when ``plan`` breaks taxels that ``skin`` does not have."""
        self.skin = skin
        self.environment = environment
        self.contacts: Contacts = contacts
        self.attitude: Attitude = None
        self.temperature_c = environment.at(0.0).temperature_c
        self._broken = BrokenTaxels(plan or FaultPlan(), skin.geometry)

    @property
    def fault_counters(self) -> dict[str, int]:
        """Readings of single taxels spoilt so far, by fault."""
        return self._broken.counters

    def read(self, now: Instant, seconds: float) -> Reading:
        """Conversion that ends at ``now``, ``seconds`` after power-on."""
        contacts = self.contacts(seconds) if callable(self.contacts) else self.contacts
        attitude = self.attitude(seconds) if callable(self.attitude) else self.attitude
        surroundings = self.environment.at(seconds, attitude)
        self.temperature_c = surroundings.temperature_c
        return self._broken.spoil(self.skin.sample(now, contacts, surroundings), seconds)


class SkinOwner:
    """A board as seen by whoever moves it and presses on it."""

    def __init__(self, sampler: Sampler) -> None:
        self._sampler = sampler

    @property
    def skin(self) -> SkinModel:
        """The field model, with the true forces of the last sample."""
        return self._sampler.skin

    @property
    def contacts(self) -> Contacts:
        """Contacts on the skin: a sequence, or a function of the seconds since power-on."""
        return self._sampler.contacts

    @contacts.setter
    def contacts(self, contacts: Contacts) -> None:
        self._sampler.contacts = contacts

    @property
    def attitude(self) -> Attitude:
        """Rotation (3, 3) from ``ee`` to world, a function giving it, or None: the script's."""
        return self._sampler.attitude

    @attitude.setter
    def attitude(self, attitude: Attitude) -> None:
        self._sampler.attitude = attitude


class BrokenTaxels:
    """Applies the taxel faults of ``plan``; ValueError for taxels that are not in ``geometry``."""

    def __init__(self, plan: FaultPlan, geometry: SkinGeometry) -> None:
        self._faults = [(fault, _index(fault, geometry)) for fault in plan.taxels]
        self._frozen: dict[int, NDArray[np.int16]] = {}
        self._count: Counter[str] = Counter()

    @property
    def counters(self) -> dict[str, int]:
        """Readings spoilt so far, by fault."""
        return {kind.value: self._count[kind] for kind in TaxelFaultKind}

    def spoil(self, reading: Reading, seconds: float) -> Reading:
        """``reading`` as the broken chips give it ``seconds`` after power-on."""
        active = [f for f in self._faults if f[0].window.covers(seconds)]
        if not active:
            self._frozen.clear()
            return reading
        counts, status = reading.counts.copy(), reading.status.copy()
        for fault, taxel in active:
            self._count[fault.kind] += 1
            if fault.kind is TaxelFaultKind.STUCK:
                counts[taxel] = self._frozen.setdefault(taxel, reading.counts[taxel].copy())
            elif fault.kind is TaxelFaultKind.SATURATED:
                counts[taxel] = np.where(reading.counts[taxel] < 0, -COUNT_MAX - 1, COUNT_MAX)
                status[taxel] |= TaxelStatus.SATURATED
            else:
                counts[taxel] = _NO_ANSWER
                status[taxel] |= TaxelStatus.READ_FAILED
        return Reading(counts, status, reading.temperature_c)


def _index(fault: TaxelFault, geometry: SkinGeometry) -> int:
    """Number of the broken taxel among all of the board."""
    for array, taxels in zip(geometry.arrays, geometry.slices, strict=True):
        if array.name == fault.array:
            if fault.taxel >= array.taxels:
                raise ValueError(
                    f"fault {fault.kind}={fault.array}:{fault.taxel}: array {array.name!r} has "
                    f"taxels 0 to {array.taxels - 1}"
                )
            return int(taxels.start) + fault.taxel
    names = ", ".join(repr(a.name) for a in geometry.arrays)
    raise ValueError(
        f"fault {fault.kind}={fault.array}:{fault.taxel}: there is no array {fault.array!r}; "
        f"allowed: {names}"
    )
