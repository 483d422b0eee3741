"""A scripted indenter: presses on the skin over time, from a TOML script (see docs/press.toml)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_device.scripts import ScriptError, Table, key_lines, read_toml
from sim_device.skin.elastomer import Contact
from tactile_core.geometry import ArrayGeometry, SkinGeometry, finger

Float = NDArray[np.float64]

MAX_NORMAL_N = 100.0
"""N; the elastomer is crushed well before."""

MAX_SECONDS = 1e6
"""s, eleven days: the longest time a script may name."""

MAX_REPEATS = 1_000_000

MAX_OFF_SKIN_MM = 12.0
"""mm from the nearest taxel up to which the skin bears a contact whole (`full_reach`)."""

MAX_PAST_EDGE_MM = 7.0
"""mm past the outermost taxels along each axis: so that a corner is within the same reach."""


@dataclass(frozen=True, slots=True, eq=False)
class Press:
    """A force that rises over ``ramp`` s, stays ``hold`` s, falls over ``ramp`` s.

    ``contact`` carries the full force; times in s; it begins at ``start`` and comes ``repeat``
    times, one every ``every`` s.
    """

    contact: Contact
    start: float
    ramp: float
    hold: float
    repeat: int
    every: float

    @property
    def end(self) -> float:
        """When the last repetition is over, s."""
        return self.start + (self.repeat - 1) * self.every + 2 * self.ramp + self.hold

    def level(self, seconds: float) -> float:
        """Share of the full force at ``seconds``, 0 to 1."""
        since = seconds - self.start
        if since < 0:
            return 0.0
        since -= min(since // self.every, self.repeat - 1) * self.every
        remaining = 2 * self.ramp + self.hold - since
        if remaining <= 0:
            return 0.0
        if self.ramp == 0:
            return 1.0
        return min(1.0, since / self.ramp, remaining / self.ramp)


class Indenter:
    """Presses that go on at the same time; may stand as the ``contacts`` of a board."""

    def __init__(self, presses: Sequence[Press], loop: float | None = None) -> None:
        """``loop``: s after which the script starts again; None: it is played once."""
        self.presses = tuple(presses)
        self.loop = loop

    @property
    def duration(self) -> float:
        """When the script is over (or starts again), s."""
        return self.loop or max((p.end for p in self.presses), default=0.0)

    def contacts(self, seconds: float) -> list[Contact]:
        """Contacts ``seconds`` after power-on."""
        if self.loop is not None:
            seconds %= self.loop
        out = []
        for press in self.presses:
            level = press.level(seconds)
            if level > 0:
                full = press.contact
                out.append(Contact(full.position, full.force * level, full.radius))
        return out

    def __call__(self, seconds: float) -> list[Contact]:
        """Same as `contacts`."""
        return self.contacts(seconds)


def load_script(path: str | Path, geometry: SkinGeometry | None = None) -> Indenter:
    """Indenter of the script at ``path`` for a skin (the finger when left out).

    ScriptError names file, line, key, what was given and what is allowed.
    """
    path = Path(path)
    values, text = read_toml(path)
    geometry = geometry or finger()
    top = Table(values, str(path), key_lines(text, "")[0])
    presses = top.take("press")
    loop = top.number("loop_s", low=0.0, high=MAX_SECONDS, above=True) if "loop_s" in top else None
    top.finish()
    if not isinstance(presses, list) or not presses:
        top.fail("press", "there is no press; write at least one [[press]] table")
    lines = key_lines(text, "press")
    out = []
    for number, press in enumerate(presses):
        if not isinstance(press, dict):
            top.fail("press", f"given {press!r}; allowed: [[press]] tables")
        # Inline tables have no header of their own to point at.
        known = lines[number] if len(lines) == len(presses) else None
        out.append(_press(Table(press, str(path), known), geometry))
    indenter = Indenter(out, loop)
    longest = max(p.end for p in out)
    if loop is not None and longest > loop:
        top.fail("loop_s", f"given {loop:g}; allowed: at least {longest:g}, the last press's end")
    return indenter


def _press(table: Table, geometry: SkinGeometry) -> Press:
    normal = table.number("normal_n", low=0.0, high=MAX_NORMAL_N, above=True)
    shear = table.vector("shear_n", 2, MAX_NORMAL_N, (0.0, 0.0))
    radius = table.number("radius_mm", 4.0, low=0.0, high=50.0, above=True)
    position, axes = _place(table, geometry)
    start = table.number("start_s", 0.0, low=0.0, high=MAX_SECONDS)
    ramp = table.number("ramp_s", 0.2, low=0.0, high=MAX_SECONDS)
    hold = table.number("hold_s", 1.0, low=0.0, high=MAX_SECONDS)
    length = 2 * ramp + hold
    if length == 0:
        table.fail("hold_s", "ramp_s and hold_s are both 0; allowed: one of them above 0")
    repeat = table.integer("repeat", 1, 1, MAX_REPEATS)
    every = table.number("every_s", length + 1.0, low=length, high=MAX_SECONDS)
    table.finish()
    force = axes @ np.array([shear[0], shear[1], -normal])
    return Press(Contact(position, force, radius / 1000), start, ramp, hold, repeat, every)


def _place(table: Table, geometry: SkinGeometry) -> tuple[Float, Float]:
    """Position (3,) m in ``ee`` and the axes (3, 3) of the skin there."""
    by_array = [k for k in ("array", "u_mm", "v_mm") if k in table]
    if "position_mm" in table:
        if by_array:
            table.fail(by_array[0], "allowed: either position_mm or array with u_mm and v_mm")
        position = np.array(table.vector("position_mm", 3, 1000.0)) / 1000
        taxels = np.concatenate([a.position for a in geometry.arrays])
        rotations = np.concatenate([a.rotation for a in geometry.arrays])
        distance = np.linalg.norm(taxels - position, axis=1)
        nearest = int(distance.argmin())
        if distance[nearest] * 1000 > MAX_OFF_SKIN_MM:
            at = ", ".join(f"{1000 * v:.1f}" for v in taxels[nearest])
            table.fail(
                "position_mm",
                f"is {1000 * distance[nearest]:.0f} mm from the nearest taxel, at [{at}]; "
                f"allowed: up to {MAX_OFF_SKIN_MM:g} mm",
            )
        return position, rotations[nearest]
    names = tuple(a.name for a in geometry.arrays)
    array = geometry.arrays[names.index(table.choice("array", names))]
    u = _along(table, "u_mm", array, 0)
    v = _along(table, "v_mm", array, 1)
    return on_surface(array, u, v)


def _along(table: Table, key: str, array: ArrayGeometry, axis: int) -> float:
    """Coordinate in m along one axis of the unrolled skin."""
    edge = array.surface[:, axis]
    low, high = 1000 * edge.min() - MAX_PAST_EDGE_MM, 1000 * edge.max() + MAX_PAST_EDGE_MM
    return table.number(key, 0.0, low=float(low), high=float(high)) / 1000


def on_surface(array: ArrayGeometry, u: float, v: float) -> tuple[Float, Float]:
    """Point (3,) m in ``ee`` at surface coordinates ``u``, ``v`` m, and the axes (3, 3) there.

    The skin is taken as flat round its nearest taxel.
    """
    step = np.array([u, v]) - array.surface
    nearest = int((step**2).sum(axis=1).argmin())
    axes = array.rotation[nearest]
    point: Float = array.position[nearest] + axes[:, :2] @ step[nearest]
    return point, axes


__all__ = ["Indenter", "Press", "ScriptError", "load_script", "on_surface"]
