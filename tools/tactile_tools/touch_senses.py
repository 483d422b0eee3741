"""Two depths of touch for a trial in lockstep: exact contacts, or the whole chain of taxels."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from reachd.seam import Touch
from sim_device.catalogue import build_skin, factory_calibration, identity
from sim_device.environment import rotation_about
from sim_device.firmware import SerialBoard
from sim_device.world.base import FingerContact, World
from sim_device.world.touch import on_skin
from tactile_bus.geometry import Side, finger
from tactile_bus.instant import Instant, after
from tactiled.blocks import Chunk, Cycle
from tactiled.events import Event, Identity, Refusal, Refused, Sampled
from tactiled.line import SerialLine
from tactiled.pipeline import BoardPipeline, PipelineSettings

UP = np.array([0.0, 0.0, 1.0])

SETTLE_S = 1.0
"""s that a board is given to be identified, its clock to be mapped and its first fits made."""


class Sense(Protocol):
    """Where a trial's touch comes from."""

    def settle(self, world: World, now: Instant) -> Instant:
        """Start up before the trial; returns when it is done. The world stands still."""
        ...

    def feel(self, world: World, now: Instant) -> Touch | None:
        """Return the newest touch at ``now``; None before the first."""
        ...

    @property
    def cycle(self) -> Cycle | None:
        """The cycle behind the newest touch; None where contacts are felt as they are."""
        ...


class ContactSense:
    """The engine's contacts as they are, at every control cycle, in the features' own type."""

    cycle: Cycle | None = None

    def __init__(self) -> None:
        skin = finger()
        self._places = np.concatenate([a.position[:, :2] for a in skin.arrays])
        self._sides = [a.side for a in skin.arrays for _ in range(a.taxels)]

    def settle(self, world: World, now: Instant) -> Instant:
        """There is nothing to start."""
        del world
        return now

    def feel(self, world: World, now: Instant) -> Touch:
        """Touch from the contacts of the last physics step."""
        contacts = world.contacts()
        if not contacts:
            return Touch(now, now, True, 0.0, Side.NONE, 0.0, 0.0, 0.0, 0.0)
        peak = max(contacts, key=lambda c: c.normal_force)
        sides = [self.side(c) for c in contacts]
        return Touch(
            captured=now,
            received=now,
            valid=True,
            peak_force=peak.normal_force,
            peak_side=sides[contacts.index(peak)],
            peak_x=peak.x,
            peak_y=peak.y,
            total_force=sum(c.normal_force for c in contacts),
            tip_force=sum(
                c.normal_force for c, side in zip(contacts, sides, strict=True) if side is Side.TIP
            ),
        )

    def side(self, contact: FingerContact) -> Side:
        """Part of the skin that a contact would be felt by: that of the nearest taxel."""
        away = (self._places[:, 0] - contact.x) ** 2 + (self._places[:, 1] - contact.y) ** 2
        return self._sides[int(away.argmin())]


class TaxelSense:
    """Contacts → elastomer → magnetometers → bytes → decoder → pipeline, as in the daemon."""

    def __init__(self, seed: int, rate: float = 25.0, settings: PipelineSettings | None = None):
        """``seed``: which board, its tolerances and noise. ``rate``: Hz (the paper has 25)."""
        self._board = SerialBoard(build_skin("finger", seed), identity("finger", seed), rate=rate)
        self._pipeline = BoardPipeline(factory_calibration("finger", seed), settings)
        self._line = SerialLine("lockstep", self._admit, "tactile", rate)
        self._touch: Touch | None = None
        self.cycle: Cycle | None = None

    @staticmethod
    def _admit(node: int, identity: Identity) -> Refusal | None:
        """Every board of ours is welcome."""
        del node, identity
        return None

    def settle(self, world: World, now: Instant) -> Instant:
        """Identify the board, map its clock, see the first cycles; the finger touches nothing."""
        self._line.connect(now)
        end = after(now, SETTLE_S)
        while now < end:
            now = after(now, 0.01)
            self.feel(world, now)
        return now

    def feel(self, world: World, now: Instant) -> Touch | None:
        """Pass the bytes there are both ways; the newest touch, if a cycle was completed."""
        board = self._board
        board.contacts = on_skin(world.contacts(), world.scene)
        board.attitude = rotation_about(UP, world.finger().heading)
        events: list[Event] = [e.event for e in self._line.tick(now)]
        for payload in self._line.outgoing():
            if isinstance(payload, bytes):
                board.receive(payload, now)
        if data := board.tick(now):
            events += [e.event for e in self._line.receive(Chunk(now, data))]
        for event in events:
            if isinstance(event, Sampled):
                for cycle in self._pipeline.feed(event.block):
                    self._touch, self.cycle = touch_of(cycle), cycle
            elif isinstance(event, Refused):
                raise RuntimeError(f"the simulated board was refused: {event}")
        return self._touch


def touch_of(cycle: Cycle) -> Touch:
    """Return what a strategy sees of a cycle; the same fields as go over the bus."""
    features = cycle.features
    x, y = (float(v) for v in features.peak_position[:2])
    return Touch(
        captured=cycle.captured,
        received=cycle.received,
        valid=features.valid and math.isfinite(features.peak_force),
        peak_force=features.peak_force,
        peak_side=features.peak_side,
        peak_x=x,
        peak_y=y,
        total_force=features.normal_force,
        tip_force=features.tip_force,
    )
