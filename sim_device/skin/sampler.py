"""Sensing part of a board: its skin in its surroundings, with the faults of a plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sim_device.faults import FaultPlan
from sim_device.skin.chips import Reading
from sim_device.skin.damage import BrokenTaxels, SkinChanges
from sim_device.skin.environment import Environment
from sim_device.skin.skin import Contact, SkinModel
from tactile_core.arrays import FloatArray
from tactile_core.types import Instant

Contacts = Sequence[Contact] | Callable[[float], Sequence[Contact]]
Attitude = FloatArray | Callable[[float], FloatArray] | None


class Sampler:
    """Reads a skin in its surroundings.

    ``contacts`` and ``attitude`` may be set at any time, as values or as functions of the seconds
    since power-on. Without an attitude, the environment's script applies.
    """

    def __init__(
        self,
        skin: SkinModel,
        environment: Environment,
        contacts: Contacts = (),
        plan: FaultPlan | None = None,
    ) -> None:
        """ValueError if ``plan`` breaks taxels that ``skin`` does not have."""
        self.skin = skin
        self.environment = environment
        self.contacts: Contacts = contacts
        self.attitude: Attitude = None
        self.temperature_c = environment.at(0.0).temperature_c
        taxels = {array.name: array.taxels for array in skin.geometry.arrays}
        self._broken = BrokenTaxels(plan or FaultPlan(), taxels)
        self._changes = SkinChanges(plan or FaultPlan(), skin, taxels)

    @property
    def fault_counters(self) -> dict[str, int]:
        """Readings of single taxels altered so far, by fault."""
        return self._broken.counters

    def read(self, now: Instant, seconds: float) -> Reading:
        """Conversion that ends at ``now``, ``seconds`` s after power-on."""
        contacts = self.contacts(seconds) if callable(self.contacts) else self.contacts
        attitude = self.attitude(seconds) if callable(self.attitude) else self.attitude
        surroundings = self.environment.at(seconds, attitude)
        self.temperature_c = surroundings.temperature_c
        surroundings = self._changes.surround(seconds, surroundings)
        reading = self._changes.amplify(seconds, self.skin.sample(now, contacts, surroundings))
        return self._broken.apply(reading, seconds)


class SkinOwner:
    """Board as seen by whoever moves it and presses on it."""

    def __init__(self, sampler: Sampler) -> None:
        self._sampler = sampler

    @property
    def skin(self) -> SkinModel:
        """Field model, with the true forces of the last sample."""
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
