"""Samples of one array on their way in: counted, scaled to µT, stamped in order. Pure."""

from __future__ import annotations

import numpy as np

from sensor_proto.packets import ArrayDescriptor, Samples
from tactile_bus.instant import Instant, seconds_between
from tactiled.blocks import SampleBlock
from tactiled.links.clock import Stamp, StepWatch
from tactiled.links.sequence import SequenceTracker


class ArrayIntake:
    """One array of a board; outlives the board's resets, so that its counts go on."""

    def __init__(self) -> None:
        self.tracker = SequenceTracker()
        self.steps = StepWatch()
        self._index = self._taxels = 0
        self._lsb_ut = (1.0, 1.0)
        self._scale = np.ones(3)
        self._captured = Instant(0)

    def describe(self, index: int, array: ArrayDescriptor) -> None:
        """Take over what the board says of the array; ``index``: its place in the descriptor."""
        self._index, self._taxels = index, array.taxels
        self._lsb_ut = array.lsb_xy_nt * 1e-3, array.lsb_z_nt * 1e-3
        self._scale = np.array([self._lsb_ut[0], self._lsb_ut[0], self._lsb_ut[1]])

    def fits(self, message: Samples) -> bool:
        """Whether these are as many taxels as the board said."""
        return len(message.field) == self._taxels

    def block(
        self, message: Samples, stamp: Stamp, arrival: Instant, clock_usable: bool = True
    ) -> SampleBlock:
        """The samples in µT. Their stamp is after that of earlier ones, whatever the ticks.

        What that moves the stamp by is added to its uncertainty.
        """
        captured = Instant(max(stamp.captured, min(self._captured + 1, arrival)))
        self._captured = captured
        return SampleBlock(
            array=self._index,
            sequence=message.sequence,
            captured=captured,
            received=arrival,
            uncertainty=stamp.uncertainty + seconds_between(stamp.captured, captured),
            clock_usable=clock_usable,
            field_ut=message.field * self._scale,
            temperature_c=np.array([message.temperature_cc / 100]),
            status=message.status,
            lsb_ut=self._lsb_ut,
        )
