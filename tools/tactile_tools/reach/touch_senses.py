"""Two depths of touch for a trial in lockstep: exact contacts, or the whole chain of taxels."""

from __future__ import annotations

import math
from functools import cache, lru_cache
from typing import Protocol

import numpy as np

from reachd.interfaces import Patch, Touch, Wrench, planar_patch
from sim_device.board.catalogue import build_skin, factory_calibration, identity
from sim_device.board.firmware import SerialBoard
from sim_device.skin.environment import rotation_about
from sim_device.world.base import World
from sim_device.world.touch import on_skin
from tactile_core.arrays import FloatArray
from tactile_core.geometry import Side, finger
from tactile_core.types import Instant, after, seconds_between
from tactiled.blocks import Chunk, Cycle
from tactiled.blocks import Patch as FeltPatch
from tactiled.boards.events import Event, Identity, Refusal, Refused, Sampled
from tactiled.boards.line import SerialLine
from tactiled.sensing.pipeline import BoardPipeline, PipelineSettings

UP = np.array([0.0, 0.0, 1.0])

CELL_M = 1e-4
"""Size of a cell for finding the nearest taxel, m; fifty times finer than their spacing. A search
costs more than a trial's whole control cycle, and a finger is touched in few of these cells."""

LIGHT_N = PipelineSettings().tip_light_n
"""N, least and greatest force of a light tip contact; as tactiled is set up by default."""

SETTLE_S = 1.0
"""Seconds for a board to be identified, its clock to be mapped and its first fits to be made."""


class Sense(Protocol):
    """Source of a trial's touch."""

    def settle(self, world: World, now: Instant) -> Instant:
        """Start up before the trial. Returns the instant at which that is done. The world stands
        still."""
        ...

    def feel(self, world: World, now: Instant) -> Touch | None:
        """Newest touch at ``now``; None before the first."""
        ...

    @property
    def cycle(self) -> Cycle | None:
        """Cycle behind the newest touch; None if contacts are felt directly."""
        ...


class ContactSense:
    """Touch from the engine's contacts, exact, at every control cycle."""

    cycle: Cycle | None = None

    def __init__(self) -> None:
        self._light_since: Instant | None = None

    def settle(self, world: World, now: Instant) -> Instant:
        """Return at once: there is nothing to start."""
        del world
        return now

    def feel(self, world: World, now: Instant) -> Touch:
        """Touch from the contacts of the last physics step."""
        tip, total = 0.0, 0.0
        fx = fy = mz = 0.0
        peak: Patch | None = None
        patches = []
        for c in world.contacts():
            force, side = c.normal_force, side_of(c.x, c.y)
            total += force
            if side is Side.TIP:
                tip += force
            fx, fy, mz = fx + c.force_x, fy + c.force_y, mz + c.x * c.force_y - c.y * c.force_x
            patch = Patch(c.x, c.y, c.normal_x, c.normal_y, force, c.shear_force, side, 0.0)
            patches.append(patch)
            if peak is None or force > peak.normal_force:
                peak = patch
        if peak is None:
            self._light_since = None
            return Touch(now, now, True, 0.0, Side.NONE, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        if len(patches) > 1:
            patches.sort(key=_strength, reverse=True)
        return Touch(
            captured=now,
            received=now,
            valid=True,
            peak_force=peak.normal_force,
            peak_side=peak.side,
            peak_x=peak.x,
            peak_y=peak.y,
            total_force=total,
            tip_force=tip,
            peak_force_bound=0.0,  # the engine's own contacts are exact
            normal_force_bound=0.0,
            tip_force_bound=0.0,
            tip_contact_time=self._tip_time(tip, now),
            wrench=Wrench(fx, fy, mz),
            patches=tuple(patches),
        )

    def _tip_time(self, tip_force: float, now: Instant) -> float:
        """Seconds that the tip has been in light contact, as tactiled counts them."""
        least, greatest = LIGHT_N
        if not least <= tip_force <= greatest:
            self._light_since = None
            return 0.0
        if self._light_since is None:
            self._light_since = now
        return seconds_between(self._light_since, now)


def _strength(patch: Patch) -> float:
    return patch.normal_force


def side_of(x: float, y: float) -> Side:
    """Part of the skin that feels a contact at (x, y) m in ``ee``: that of the nearest taxel.

    Places are resolved to `CELL_M`.
    """
    return _side_of_cell(math.floor(x / CELL_M), math.floor(y / CELL_M))


@lru_cache(maxsize=1 << 16)
def _side_of_cell(column: int, row: int) -> Side:
    """Part of the skin to which the middle of a cell belongs."""
    places, sides = _taxels()
    middle = ((column + 0.5) * CELL_M, (row + 0.5) * CELL_M)
    return sides[int(((places - middle) ** 2).sum(axis=1).argmin())]


@cache
def _taxels() -> tuple[FloatArray, list[Side]]:
    """Places (n, 2) m in ``ee`` and sides of the finger's taxels."""
    skin = finger()
    places = np.concatenate([a.position[:, :2] for a in skin.arrays])
    return places, [a.side for a in skin.arrays for _ in range(a.taxels)]


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
        """Admit every board: it is our own."""
        del node, identity
        return None

    def settle(self, world: World, now: Instant) -> Instant:
        """Identify the board, map its clock, take the first cycles; the finger touches nothing."""
        self._line.connect(now)
        end = after(now, SETTLE_S)
        while now < end:
            now = after(now, 0.01)
            self.feel(world, now)
        return now

    def feel(self, world: World, now: Instant) -> Touch | None:
        """Pass the waiting bytes both ways. Returns the newest touch, None before the first."""
        board = self._board
        # As functions: a board samples four times less often than it is asked for bytes.
        board.contacts = lambda _: on_skin(world.contacts(), world.scene)
        board.attitude = lambda _: rotation_about(UP, world.finger().heading)
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
    """Touch that a strategy gets from a cycle; the same fields as go over the bus."""
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
        peak_force_bound=features.peak_force_bound,
        normal_force_bound=features.normal_force_bound,
        tip_force_bound=features.tip_force_bound,
        tip_contact_time=features.tip_contact_time,
        wrench=Wrench(*(float(features.wrench[i]) for i in (0, 1, 5))),
        patches=tuple([_patch_of(patch) for patch in features.patches]) if features.valid else (),
    )


def _patch_of(felt: FeltPatch) -> Patch:
    x, y, _ = felt.centroid.tolist()
    nx, ny, _ = felt.normal.tolist()
    fx, fy, _ = felt.force.tolist()
    return planar_patch((x, y), (nx, ny), felt.normal_force, (fx, fy), felt.side, felt.bound)
