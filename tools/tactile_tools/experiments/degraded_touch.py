"""Degraded touch: noise, a slow stream, dead taxels, a stretched finger."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from reachd.interfaces import Touch
from sim_device.board.catalogue import identity
from sim_device.board.firmware import SerialBoard
from sim_device.faults import FaultPlan, TaxelFault, TaxelFaultKind, Window
from sim_device.skin.parameters import SkinParameters
from sim_device.skin.skin import SkinModel
from sim_device.world.base import FingerContact, FingerState, World
from sim_device.world.scenes import Scene
from tactile_core.geometry import finger
from tactile_core.types import Instant, after
from tactile_tools.reach.touch_senses import ContactSense, TaxelSense
from tactiled.sensing.bounds import QUANTILE_95
from tactiled.sensing.pipeline import PipelineSettings

BOARD_RATE_HZ = 25.0
"""Rate of a board with default settings, Hz: the paper's."""

FIELD_PER_NEWTON_UT = 152.0
"""Change of a chip's reading by 1 N, µT, in the simulated skin: converts noise from N to µT."""

SAME_COLUMN_M = 1e-3
"""Distance along the outline, m, within which taxels are above one another."""


def dead_taxels(seed: int, fraction: float) -> list[tuple[str, int]]:
    """Array and number of the dead taxels: ``fraction`` of all, drawn by ``seed``.

    With the same seed, a greater fraction contains the taxels of a lesser one.
    """
    every = [(a.name, i) for a in finger().arrays for i in range(a.taxels)]
    order = np.random.default_rng([seed, 4]).permutation(len(every))
    return [every[i] for i in sorted(order[: round(fraction * len(every))].tolist())]


class WorldView:
    """The part of a world that a sense reads, with its contacts changed by ``change``."""

    def __init__(
        self,
        world: World,
        change: Callable[[tuple[FingerContact, ...]], tuple[FingerContact, ...]],
    ) -> None:
        self._world = world
        self._change = change

    @property
    def scene(self) -> Scene:
        """Scene of the world."""
        return self._world.scene

    def contacts(self) -> tuple[FingerContact, ...]:
        """Contacts of the world, changed."""
        return self._change(self._world.contacts())

    def finger(self) -> FingerState:
        """Finger of the world."""
        return self._world.finger()


class FingerStretch:
    """Converts between a finger stretched across by ``stretch`` and the finger as built.

    The skin of the stretched finger has the same taxels at the same places along its outline.
    """

    def __init__(self, stretch: float) -> None:
        self._stretch = stretch

    def contacts(self, contacts: Sequence[FingerContact]) -> tuple[FingerContact, ...]:
        """Contacts of the stretched finger, at their places on the finger as built."""
        if self._stretch == 1.0:
            return tuple(contacts)
        moved = []
        for c in contacts:
            # A normal scales with the inverse of the stretch; normal force and shear stay.
            nx, ny = c.normal_x / self._stretch, c.normal_y
            length = math.hypot(nx, ny)
            ax, ay = nx / length, ny / length
            normal, shear = c.normal_force, c.shear_force
            moved.append(
                FingerContact(
                    x=c.x,
                    y=c.y / self._stretch,
                    normal_x=ax,
                    normal_y=ay,
                    force_x=-normal * ax - shear * ay,
                    force_y=-normal * ay + shear * ax,
                    body=c.body,
                )
            )
        return tuple(moved)

    def touch(self, touch: Touch) -> Touch:
        """``touch`` of the finger as built, on the stretched one."""
        if self._stretch == 1.0:
            return touch
        wrench = touch.wrench
        mz = sum(p.x * p.force_y - p.y * self._stretch * p.force_x for p in touch.patches)
        return replace(
            touch,
            peak_y=touch.peak_y * self._stretch,
            wrench=replace(wrench, mz=mz) if touch.patches else wrench,
            patches=tuple([replace(p, y=p.y * self._stretch) for p in touch.patches]),
        )


class DegradedContacts:
    """Degraded contacts of the engine.

    ``noise``: N, added alike to peak, tip and total force. ``rate``: Hz, None for every cycle.
    ``dead``: fraction of dead taxels; of a contact, the share is felt that is alive among the
    taxels of its column. ``stretch``: factor of the finger's width.
    """

    cycle = None

    def __init__(
        self, seed: int, *, noise: float, rate: float | None, dead: float, stretch: float
    ) -> None:
        self._inner = ContactSense()
        self._rng = np.random.default_rng([seed, 3])
        self._patch_rng = np.random.default_rng([seed, 5])
        self._noise = noise
        self._period = None if rate is None else 1.0 / rate
        self._due: Instant | None = None
        self._touch: Touch | None = None
        self._stretch_map = FingerStretch(stretch)
        self._columns = _columns(seed, dead) if dead > 0 else None

    def settle(self, world: World, now: Instant) -> Instant:
        """Return at once: there is nothing to start."""
        return self._inner.settle(world, now)

    def feel(self, world: World, now: Instant) -> Touch | None:
        """The newest touch; a new one only when it is due."""
        if self._touch is not None and self._due is not None and now < self._due:
            return self._touch
        if self._period is not None:
            self._due = after(now if self._due is None else self._due, self._period)
        seen = WorldView(world, self._felt)
        # A sense only reads a world, and `WorldView` has everything that it reads.
        touch = self._inner.feel(cast(World, seen), now)
        if self._noise > 0:
            touch = self._with_noise(touch)
        self._touch = self._stretch_map.touch(touch)
        return self._touch

    def _felt(self, contacts: tuple[FingerContact, ...]) -> tuple[FingerContact, ...]:
        moved = self._stretch_map.contacts(contacts)
        if self._columns is None:
            return moved
        places, alive = self._columns
        felt = []
        for c in moved:
            away = (places[:, 0] - c.x) ** 2 + (places[:, 1] - c.y) ** 2
            share = float(alive[int(away.argmin())])
            if share > 0:
                felt.append(replace(c, force_x=share * c.force_x, force_y=share * c.force_y))
        return tuple(felt)

    def _with_noise(self, touch: Touch) -> Touch:
        """``touch`` with noise; a force is never below 0.

        The bounds of peak, sum and tip stay 0, as the gate has always judged these trials.
        """
        peak, total, tip = (self._rng.standard_normal(3) * self._noise).tolist()
        # Drawn from a generator of their own: the three above are the same with and without them.
        noise = self._patch_rng.standard_normal(len(touch.patches)) * self._noise
        patches = [
            replace(p, normal_force=max(0.0, p.normal_force + n), bound=QUANTILE_95 * self._noise)
            for p, n in zip(touch.patches, noise.tolist(), strict=True)
        ]
        patches.sort(key=lambda patch: -patch.normal_force)
        return replace(
            touch,
            peak_force=max(0.0, touch.peak_force + peak),
            total_force=max(0.0, touch.total_force + total),
            tip_force=max(0.0, touch.tip_force + tip),
            patches=tuple(patches),
        )


class DegradedTaxels(TaxelSense):
    """The whole chain of taxels with a degraded board: noisier chips, slower, some of them dead."""

    def __init__(
        self, seed: int, *, noise: float, rate: float | None, dead: float, stretch: float
    ) -> None:
        rate = BOARD_RATE_HZ if rate is None else rate
        extra = noise * FIELD_PER_NEWTON_UT
        # A user would set the noise of the board at hand; otherwise every field fit would fail.
        x, y, z = (math.hypot(n, extra) for n in PipelineSettings().noise_ut)
        super().__init__(seed, rate=rate, settings=PipelineSettings(noise_ut=(x, y, z)))
        parameters = SkinParameters()
        chip = parameters.chip
        chip = replace(
            chip,
            noise_xy_ut=math.hypot(chip.noise_xy_ut, extra),
            noise_z_ut=math.hypot(chip.noise_z_ut, extra),
        )
        always = Window(0.0, math.inf)
        plan = FaultPlan(
            taxels=tuple(
                TaxelFault(TaxelFaultKind.FAILED, array, taxel, always)
                for array, taxel in dead_taxels(seed, dead)
            )
        )
        # The same skin as the plain one of this seed: tolerances are drawn before any noise.
        skin = SkinModel(finger(), replace(parameters, chip=chip), np.random.default_rng([seed, 0]))
        self._board = SerialBoard(skin, identity("finger", seed), rate=rate, plan=plan)
        self._stretch_map = FingerStretch(stretch)

    def feel(self, world: World, now: Instant) -> Touch | None:
        """As `TaxelSense`, through the stretched finger."""
        seen = WorldView(world, self._stretch_map.contacts)
        touch = super().feel(cast(World, seen), now)
        return None if touch is None else self._stretch_map.touch(touch)


def _columns(seed: int, fraction: float) -> tuple[Any, Any]:
    """Places (n, 2) m of the taxels, and for each the share of its column that is alive."""
    dead = set(dead_taxels(seed, fraction))
    places, alive = [], []
    for array in finger().arrays:
        for index in range(array.taxels):
            places.append(array.position[index, :2])
            alive.append((array.name, index) not in dead)
    at, up = np.array(places), np.array(alive, dtype=np.float64)
    near = np.linalg.norm(at[:, None] - at[None], axis=2) < SAME_COLUMN_M
    return at, (near * up).sum(axis=1) / near.sum(axis=1)
